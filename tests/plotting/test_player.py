"""The script of the page, run by Node where there is one: it draws what NumPy projects, controls do what they say."""

import json
import re
import shutil
import subprocess

import numpy as np
from pages import Page, world

from lgsens import plotting

NODE = shutil.which("node")

# The script itself, where Node is at hand: a document and a canvas that record what is done to them.
HARNESS = """
const fs = require("fs"), [path, script] = process.argv.slice(2);
const text = fs.readFileSync(path, "utf8");
const part = (id) => text.split(`id="${id}">`)[1].split("</script>")[0];
const elements = {}, on = {};
let calls = [], next = null;
const context = new Proxy({}, {
  get: (target, key) => (key in target ? target[key] : (...args) => { calls.push([key, ...args]); }),
  set: (target, key, value) => { target[key] = value; return true; },
});
const element = (id) => elements[id] ??= {
  on: {}, addEventListener(name, f) { this.on[name] = f; }, getContext: () => context, setPointerCapture() {},
  clientWidth: 900, clientHeight: 640,
  value: id === "speed" ? "1" : "0", textContent: id === "data" ? part("data") : "",
};
const document = { getElementById: element, addEventListener: (name, f) => { on[name] = f; } };
const window = { devicePixelRatio: 2, requestAnimationFrame: (f) => { next = f; }, addEventListener() {} };
const module_ = {};
new Function("module", part("player"))(module_);
const Player = module_.exports, data = JSON.parse(part("data"));
const open = () => new Function("document", "window", part("player"))(document, window);
const event = (more) => ({ preventDefault() {}, buttons: 1, movementX: 0, movementY: 0, ...more });
const shown = (act) => { calls = []; act(); return calls; };
console.log(JSON.stringify(eval(fs.readFileSync(script, "utf8"))));
"""

if NODE:

    def run_script(page, body, tmp_path):
        """What a piece of JavaScript returns that has the page's script and a recording document at hand."""
        harness, script = tmp_path / "harness.js", tmp_path / "body.js"
        harness.write_text(HARNESS, encoding="utf-8")
        script.write_text(body, encoding="utf-8")
        done = subprocess.run([NODE, harness, page, script], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0 and done.stderr == "", done.stderr
        return json.loads(done.stdout)

    def projected(points, elevation, azimuth, centre, scale, x, y):
        """Orthographic projection: what is right and what is up for an eye at this elevation and azimuth."""
        e, a = np.deg2rad([elevation, azimuth])
        eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        moved = (np.asarray(points) - centre) @ np.stack([right, np.cross(eye, right), eye], axis=1)
        return moved * [scale, -scale, 1.0] + [x, y, 0.0]

    def test_the_script_projects_as_numpy_does(rig, tmp_path):
        page = plotting.animate(rig, tmp_path / "a.html")
        data = Page(page).data
        camera = {
            "elevation": 23.0,
            "azimuth": -51.0,
            "centre": [0.1, -0.5, 0.3],
            "scale": 700.0,
            "x": 450.0,
            "y": 320.0,
        }
        frame = 9
        items = run_script(page, f"Player.scene(data, {frame}, {json.dumps(camera)})", tmp_path)
        found = {kind: [np.array(item["points"]) for item in items if item["kind"] == kind] for kind in ("face", "dot")}
        look = lambda points: projected(points, **camera)
        faces = [look(world(data, frame, o["body"], o["points"])) for o in data["outlines"] if o["filled"]]
        dots = [look(world(data, frame, j["body"], j["at"]))[None] for j in data["joints"]]
        for kind, expected in (("face", faces), ("dot", dots)):
            assert len(found[kind]) == len(expected) > 0
            for points in expected:  # drawn from back to front, in another order
                nearest = min(np.abs(other - points).max() for other in found[kind] if other.shape == points.shape)
                assert nearest < 1e-9
        depths = [item["depth"] for item in items]
        assert depths == sorted(depths)
        (coil,) = [np.array(item["points"]) for item in items if item["role"] == "spring"]
        (spring,) = [strut for strut in data["struts"] if strut["role"] == "spring"]
        ends = [look(world(data, frame, spring[side], spring[f"at_{side}"])) for side in "ab"]
        np.testing.assert_allclose(coil[[0, -1]], ends, rtol=0, atol=1e-9)
        inner = plotting._shapes.coil(
            *(world(data, frame, spring[s], spring[f"at_{s}"]) for s in "ab"), spring["radius"]
        )
        np.testing.assert_allclose(coil, look(inner), rtol=0, atol=1e-9)

    def test_the_script_bends_beams_as_numpy_does(swinging, tmp_path):
        page = plotting.animate(swinging, tmp_path / "a.html")
        data = Page(page).data
        camera = {
            "elevation": 20.0,
            "azimuth": -70.0,
            "centre": [0.5, 0.0, -0.2],
            "scale": 600.0,
            "x": 450.0,
            "y": 320.0,
        }
        last = len(data["clock"]) - 1
        items = run_script(page, f"Player.scene(data, {last}, {json.dumps(camera)})", tmp_path)
        found = [np.array(item["points"]) for item in items if item["role"] == "beam"]
        assert len(found) == len(data["struts"]) == 3
        for strut in data["struts"]:
            ends = [world(data, last, strut[s], strut[f"at_{s}"]) for s in "ab"]
            frames = [np.reshape(data["orientation"][last][strut[s]], (3, 3)) for s in "ab"]
            along = [frame @ strut[f"along_{s}"] for frame, s in zip(frames, "ab")]
            expected = projected(plotting._shapes.bent(*map(np.asarray, ends), *along), **camera)
            assert min(np.abs(points - expected).max() for points in found) < 1e-6

    def test_the_script_colours_beams_as_matplotlib_does(swinging, tmp_path):
        """By their stress at the frame; and its scale stands in the legend in place of beams."""
        page = plotting.animate(swinging, tmp_path / "a.html")
        data = Page(page).data
        last = len(data["clock"]) - 1
        camera = {"elevation": 0.0, "azimuth": 0.0, "centre": [0.0, 0.0, 0.0], "scale": 1.0, "x": 0.0, "y": 0.0}
        body = f"""
        open();
        [Player.scene(data, {last}, {json.dumps(camera)}).filter((item) => item.role === "beam").map((i) => i.colour),
         elements.legend.innerHTML]
        """
        colours, legend = run_script(page, body, tmp_path)
        shares = [strut["stress"][last] / data["stress"]["top"] for strut in data["struts"]]
        expected = 255 * plotting._stress._map()(shares)[:, :3]
        found = [[int(number) for number in re.findall(r"\d+", colour)] for colour in colours]
        # matplotlib has 256 colours, 1/512 of the map off, which is 1 of 255; both are rounded
        np.testing.assert_allclose(sorted(found), sorted(expected.tolist()), rtol=0, atol=2.0)
        assert "von Mises" in legend and "linear-gradient" in legend and f"{data['stress']['top']:.3g}" in legend
        assert ">beam<" not in legend and ">body<" in legend

    def test_the_slider_moves_the_bodies_and_the_time(linkage, tmp_path):
        page = plotting.animate(linkage, tmp_path / "a.html")
        data = Page(page).data
        body = """
        open();
        [0, 12].map((frame) => {
          elements.slider.value = String(frame);
          const calls = shown(() => elements.slider.on.input());
          return { calls, time: elements.time.textContent, play: elements.play.textContent, max: elements.slider.max };
        })
        """
        first, second = run_script(page, body, tmp_path)
        camera = {"elevation": 90.0, "azimuth": -90.0, "centre": data["centre"], "x": 450.0, "y": 320.0}
        camera["scale"] = 0.46 * 640 / data["radius"]
        for frame, shown in ((0, first), (12, second)):
            assert shown["time"] == f"t = {data['values'][frame]:.2f} s"
            assert shown["play"] == "Play" and shown["max"] == 15  # touching the slider pauses
            arcs = np.array([call[1:3] for call in shown["calls"] if call[0] == "arc"])
            joints = [world(data, frame, j["body"], j["at"]) for j in data["joints"]]
            expected = projected(joints, **camera)[:, :2]
            assert sorted(arcs.round(6).tolist()) == sorted(expected.round(6).tolist())
        assert first["calls"] != second["calls"]
        assert ["setTransform", 2, 0, 0, 2, 0, 0] in first["calls"]  # sharp on a screen of twice the resolution

    def test_playing_turning_and_zooming(linkage, tmp_path):
        page = plotting.animate(linkage, tmp_path / "a.html")
        body = """
        open();
        const time = () => elements.time.textContent, view = elements.view, found = {};
        next(1000); next(1200);
        found.played = time();
        elements.speed.value = "0.5"; next(1400);
        found.slower = time();
        next(3000);
        found.begun_again = time();
        elements.play.on.click();
        found.paused = [elements.play.textContent, (next(9000), time())];
        const redraw = (act) => shown(act).filter((call) => call[0] === "arc").map((call) => call.slice(1, 3));
        found.still = redraw(() => view.on.dblclick());
        found.idle = redraw(() => view.on.pointermove(event({ buttons: 0, movementX: 50 })));
        found.turned = redraw(() => view.on.pointermove(event({ movementX: 50, movementY: -100 })));
        found.reset = redraw(() => view.on.dblclick());
        found.moved = redraw(() => view.on.pointermove(event({ movementX: 7, movementY: -3, shiftKey: true })));
        view.on.dblclick();
        found.zoomed = redraw(() => view.on.wheel(event({ deltaY: -200 })));
        const before = time();
        on.keydown(event({ key: "ArrowRight" }));
        found.stepped = [before, time()];
        found.other = redraw(() => on.keydown(event({ key: "a" })));
        found
        """
        found = run_script(page, body, tmp_path)
        assert found["played"] == "t = 0.20 s" and found["slower"] == "t = 0.30 s"
        assert found["begun_again"] == "t = 0.00 s"
        assert found["paused"] == ["Play", "t = 0.00 s"]
        assert found["idle"] == [] and found["other"] == []
        assert found["reset"] == found["still"] != found["turned"]
        still, centre = np.array(found["still"]), np.array([450.0, 320.0])
        np.testing.assert_allclose(found["moved"], still + np.array([7.0, -3.0]), rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            np.array(found["zoomed"]) - centre, np.exp(0.3) * (still - centre), rtol=0, atol=1e-9
        )
        assert found["stepped"] == ["t = 0.00 s", "t = 0.03 s"]
