"""Animations: what the page holds, what a GIF has, bad input. The script of the page: test_player.py."""

import itertools
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from matplotlib.colors import to_rgb
from pages import Page, world
from PIL import Image

import lgsens as lg
from lgsens import plotting
from lgsens.examples import QuarterCar, four_bar, free_rigid_body, spinning_top
from lgsens.liegroups import SE3, Pose


@pytest.fixture(scope="module")
def car():
    """A wheel on a road with a bump, without the links."""
    wheel = lg.RigidBody(10.0, (0.5, 1.0, 0.5), position=(0.0, 0.7, 0.3), free="z ry")
    body = lg.RigidBody(300.0, (60.0, 200.0, 200.0), position=(0.0, 0.0, 0.8), free="z")
    road = lg.BumpRoad(height=0.05, duration=0.25, start=0.05)
    forces = {
        "tyre": lg.TyreSpring("wheel", at=(0.0, 0.7, 0.3), stiffness=2e5, road=road),
        "strut": lg.SpringDamper(
            "wheel", "body", at_a=(0.0, 0.7, 0.3), at_b=(0.0, 0.7, 0.8), stiffness=2e4, damping=2e3
        ),
        "absorber": lg.SpringDamper(
            "wheel", "body", at_a=(0.1, 0.7, 0.3), at_b=(0.1, 0.7, 0.8), stiffness=0.0, damping=1e2
        ),
    }
    return lg.simulate(lg.Model({"wheel": wheel, "body": body}, {}, forces), t1=0.3, num_steps=60)


def test_the_page_holds_the_motion(linkage, tmp_path):
    """Poses to 1e-6 of the scene and of a turn, at the times they say."""
    page = Page(plotting.animate(linkage, tmp_path / "a.html", title="A <four-bar> & more"))
    data = page.data
    chosen = np.abs(np.asarray(linkage.t)[:, None] - data["values"]).argmin(axis=0)
    np.testing.assert_allclose(data["values"], linkage.t[chosen], rtol=0, atol=1e-9)
    np.testing.assert_allclose(data["clock"], data["values"], rtol=0, atol=1e-6)
    assert len(chosen) == 16  # half a second of 30 frames, and the first
    names = linkage.system.body_names
    for i, name in enumerate(names):
        motion = linkage.body(name)
        np.testing.assert_allclose(np.array(data["position"])[:, i], motion.position[chosen], rtol=0, atol=1e-6)
        orientation = np.array(data["orientation"])[:, i].reshape(-1, 3, 3)
        np.testing.assert_allclose(orientation, motion.orientation[chosen], rtol=0, atol=1e-6)
    assert (data["label"], data["unit"]) == ("t", "s")
    assert data["view"] == [90.0, -90.0]  # across its plane
    # Nothing comes from anywhere else.
    assert page.references == []
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert not re.search(r"https?:|//cdn|@import|\bfetch\(|XMLHttpRequest|import\(", text)
    assert "<title>A &lt;four-bar&gt; &amp; more</title>" in text and "__" not in re.sub(r'id="data">.*', "", text)


def test_bars_of_a_linkage_are_between_its_joints(linkage, tmp_path):
    data = Page(plotting.animate(linkage, tmp_path / "a.html")).data
    names = linkage.system.body_names
    ends = {names[o["body"]]: world(data, 0, o["body"], o["points"]) for o in data["outlines"]}
    joints = {name: np.asarray(joint.at) for name, joint in four_bar().joints.items()}
    for body, (first, second) in {"crank": "AB", "coupler": "BC", "rocker": "DC"}.items():
        expected = sorted([joints[first].tolist(), joints[second].tolist()])
        np.testing.assert_allclose(sorted(ends[body].tolist()), expected, rtol=0, atol=2e-6)
    (spring,) = data["struts"]
    assert (spring["role"], spring["a"], names[spring["b"]]) == ("spring", -1, "coupler")


def test_a_body_without_joints_is_the_box_of_its_inertia(tmp_path):
    model = free_rigid_body()
    motion = lg.simulate(model, t1=0.2, num_steps=20)
    data = Page(plotting.animate(motion, tmp_path / "a.html")).data
    (body,) = model.bodies.values()
    corners = np.unique(np.concatenate([o["points"] for o in data["outlines"]]).round(5), axis=0)
    assert corners.shape == (8, 3) and len(data["outlines"]) == 6
    half = np.abs(corners[0])
    # a cuboid of its mass: J₁ = m (b² + c²)/3 of the half lengths
    moments = float(body.mass) / 3 * (np.sum(half**2) - half**2)
    np.testing.assert_allclose(np.sort(moments), np.sort(np.diag(body.inertia_matrix)), rtol=1e-4)


def test_a_top_is_a_bar_with_a_box(tmp_path):
    motion = lg.simulate(spinning_top(0.7), t1=0.2, num_steps=20)
    data = Page(plotting.animate(motion, tmp_path / "a.html", speed=0.5)).data
    bars = [o for o in data["outlines"] if o["role"] == "link"]
    np.testing.assert_allclose(world(data, 3, 0, bars[0]["points"])[0], np.zeros(3), atol=2e-6)  # at the pivot
    assert data["clock"][-1] == 0.4 and data["values"][-1] == 0.2  # at half speed


@pytest.mark.slow  # `test_elements_of_a_beam_have_their_stress` is in the quick run
def test_elements_of_a_beam_are_bent_as_they_are(swinging, tmp_path):
    """Each on the helix between its sections, to 2e-3 of its length where it turns by less than a quarter."""
    data = Page(plotting.animate(swinging, tmp_path / "a.html")).data
    beams = [strut for strut in data["struts"] if strut["role"] == "beam"]
    assert len(beams) == 3 and len(data["joints"]) == 1  # the clamp
    drawn, group = plotting._shapes.shapes(swinging.system), SE3()
    position, orientation = (np.asarray(array[-1]) for array in swinging.states.q)
    bends = []
    for strut in drawn.struts:
        a, b = (Pose(jnp.asarray(position[body]), jnp.asarray(orientation[body])) for body in (strut.a, strut.b))
        screw = group.log(group.compose(group.inverse(a), b))
        pieces = jnp.linspace(0.0, 1.0, 9)[:, None] * screw[None]
        helix = jax.vmap(lambda piece, a=a: group.compose(a, group.exp(piece)).position)(pieces)
        (line,) = plotting._shapes.stretched(strut, position, orientation)
        np.testing.assert_allclose(line, helix, rtol=0, atol=2e-3 * np.linalg.norm(screw[:3]))
        bends.append(np.linalg.norm(screw[3:]))
    assert 0.2 < max(bends) < np.pi / 2


def test_elements_of_a_beam_have_their_stress(swinging, tmp_path):
    """In MPa at each frame, to 1e-4 of a scale that ends with the largest of the whole motion."""
    data = Page(plotting.animate(swinging, tmp_path / "a.html")).data
    chosen = np.abs(np.asarray(swinging.t)[:, None] - data["values"]).argmin(axis=0)
    stresses = {name: 1e-6 * np.asarray(swinging.force(name).stress) for name in ("b.0", "b.1", "b.2")}
    top = max(of.max() for of in stresses.values())
    assert data["stress"]["top"] == pytest.approx(top, rel=1e-4)
    for strut in data["struts"]:
        np.testing.assert_allclose(strut["stress"], stresses[strut["owner"]][chosen], rtol=0, atol=1e-4 * top)
    few = Page(plotting.animate(swinging, tmp_path / "b.html", max_frames=1)).data
    assert few["stress"] == data["stress"] and max(strut["stress"][0] for strut in few["struts"]) == 0.0  # at first
    plain = Page(plotting.animate(swinging, tmp_path / "c.html", colour_beams=None)).data
    assert plain["stress"] is None and not any("stress" in strut for strut in plain["struts"])


def test_a_gif_has_the_colours_of_stress(swinging, tmp_path):
    """The end of its scale, beside the beam and at last in it; without stress that colour is nowhere."""
    counts = {}
    for by in ("stress", None):
        path = plotting.animate(swinging, tmp_path / "a.gif", max_frames=2, colour_beams=by)
        with Image.open(path) as image:
            assert image.n_frames == 2
            pictures = [np.asarray((image.seek(i), image.convert("RGB"))[1], int) for i in range(2)]
        end = np.round(255 * np.array(to_rgb(plotting._stress.SCALE[-1])))
        # a GIF has 256 colours: within 10 of 255
        counts[by] = [int((np.abs(picture - end).max(axis=-1) <= 10).sum()) for picture in pictures]
    assert counts["stress"][1] > counts["stress"][0] + 100 > 100
    assert counts[None] == [0, 0]


@pytest.mark.slow
def test_a_rig_is_swept_through(rig, tmp_path):
    data = Page(plotting.animate(rig, tmp_path / "a.html")).data
    assert (data["label"], data["unit"], data["digits"]) == ("travel", "m", 2)
    np.testing.assert_allclose(data["values"], np.linspace(-0.06, 0.06, 13), atol=1e-9)
    assert data["clock"][-1] == 4.0 and data["tyres"] == []
    assert {s["role"] for s in data["struts"]} == {"spring", "damper"}
    assert {o["role"] for o in data["outlines"]} == {"link", "body", "wheel"}
    (rim,) = [o for o in data["outlines"] if o["role"] == "wheel"]
    wheel = world(data, 6, rim["body"], rim["points"])  # at the design position
    centre = np.asarray(QuarterCar.load().wheel.centre)
    np.testing.assert_allclose(np.linalg.norm(wheel - centre, axis=1), centre[2], atol=1e-5)
    np.testing.assert_allclose(wheel[:, 1], centre[1], atol=1e-5)  # its axis is along y


@pytest.mark.slow
def test_a_driven_angle_has_its_unit(tmp_path):
    model = four_bar()
    motor = {"motor": lg.RotationDriver(None, "crank", axis=(0.0, 0.0, 1.0))}
    motion = lg.kinematics(lg.Model(model.bodies, model.joints | motor), {"motor": [0.0, 0.25]})
    data = Page(plotting.animate(motion, tmp_path / "a.html")).data
    assert (data["label"], data["unit"], data["values"]) == ("motor", "rad", [0.0, 0.25])


def test_a_mechanism_driven_by_signals_moves_in_time(tmp_path):
    crank = lg.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), free="rz")
    motor = lg.RotationDriver(None, "crank", axis=(0.0, 0.0, 1.0), value=lg.Polynomial((0.0, 2.0)))
    motion = lg.kinematics(lg.Model({"crank": crank}, {"motor": motor}), t=[0.0, 0.25])
    data = Page(plotting.animate(motion, tmp_path / "a.html")).data
    assert (data["label"], data["unit"], data["values"]) == ("t", "s", [0.0, 0.25])


def test_the_road_is_under_the_wheel(car, tmp_path):
    data = Page(plotting.animate(car, tmp_path / "a.html")).data
    (tyre,) = data["tyres"]
    t = np.array(data["values"])
    expected = 0.05 * np.sin(np.pi * (t - 0.05) / 0.25) ** 2 * ((t > 0.05) & (t < 0.3))
    np.testing.assert_allclose(tyre["road"], expected, atol=1e-5)
    assert max(tyre["road"]) > 0.04
    assert sorted(s["role"] for s in data["struts"]) == ["damper", "spring"]


@pytest.mark.parametrize("max_frames", [1, 7])
def test_frames_are_steps_of_the_motion(linkage, max_frames, tmp_path):
    data = Page(plotting.animate(linkage, tmp_path / "a.html", max_frames=max_frames)).data
    assert len(data["values"]) == max_frames
    t = np.asarray(linkage.t)
    assert all(np.abs(t - value).min() < 1e-9 for value in data["values"])


def test_a_gif_has_the_frames_and_the_time(linkage, tmp_path):
    path = plotting.animate(linkage, tmp_path / "a.gif", max_frames=6, title="four-bar", speed=0.5)
    with Image.open(path) as image:
        assert image.n_frames == 6
        pictures, duration = [], 0
        for i in range(image.n_frames):
            image.seek(i)
            duration += image.info["duration"]
            pictures.append(np.asarray(image.convert("L"), int))
    assert duration == pytest.approx(1200, abs=60)  # 6 frames a fifth of 1 s apart, in hundredths of a second
    assert all(picture.std() > 5 for picture in pictures)
    assert all((first != second).mean() > 1e-3 for first, second in itertools.pairwise(pictures))


def test_a_video_needs_ffmpeg(linkage, tmp_path, monkeypatch):
    from matplotlib.animation import FFMpegWriter

    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    with pytest.raises(OSError, match=r"needs ffmpeg on the path; install it, or write \.html or \.gif"):
        plotting.animate(linkage, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"path": "a.avi"}, says("`path` must end in .html, .gif or .mp4", "a.avi")),
        ({"speed": 0.0}, says("`speed` must be positive, got 0.0")),
        ({"max_frames": 0}, says("`max_frames` must be at least 1, got 0")),
        ({"colour_beams": "heat"}, says("`colour_beams` must be \"stress\" or None, got 'heat'")),
        ({"motion": 3.0}, says("`motion` must be a Trajectory or a Kinematics of a Model, got float")),
    ],
)
def test_bad_input(linkage, arguments, message, tmp_path):
    arguments = {"motion": linkage, "path": "a.html"} | arguments
    with pytest.raises(ValueError, match=message):
        plotting.animate(arguments.pop("motion"), tmp_path / arguments.pop("path"), **arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_motion_is_refused(linkage, tmp_path):
    failed = jax.tree.map(lambda leaf: leaf, linkage)
    object.__setattr__(failed, "result", jnp.asarray(lg.RESULTS.newton_failed))
    with pytest.raises(ValueError, match="`motion` failed"):
        plotting.animate(failed, tmp_path / "a.html")
    lost = eqx.tree_at(lambda run: run.states.q.position, failed, replace_fn=lambda x: x.at[-1].set(jnp.nan))
    with pytest.raises(ValueError, match="`models`: a motion failed"):
        plotting.mechanism(lost)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), linkage)
    film = lambda run: plotting.animate(run, tmp_path / "a.html")
    for draw, name in ((film, "motion"), (plotting.mechanism, "models")):
        with pytest.raises(ValueError, match=rf"`{name}`: this is a batch of motions, of shape \(2,\)"):
            draw(batch)
