"""`lgsens kc`: what it writes, that ideal joints give the curves of kinematics, and what it says about bad input."""

import csv
import json
import re

import numpy as np
import pytest

from lgsens import rigs
from lgsens.cli import _kc
from lgsens.cli._main import main
from lgsens.examples import Axle

FILE = "semi_trailing_arm"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("kc") / "new"
    status = main(["kc", FILE, "--rigid", "--sweeps", "parallel", "--points", "5", "--out", str(out), "--quiet"])
    return status, out, json.loads((out / "kc.json").read_text(encoding="utf-8"))


def test_the_report_is_complete(written):
    status, out, document = written
    assert status == 0
    assert {path.name for path in out.iterdir()} == {"kc.html", "kc.json", "kc.csv", "parallel.png"}
    page = (out / "kc.html").read_text(encoding="utf-8")
    assert "<svg" in page and "wheel rate" in page
    assert not re.findall(r"<(?:script|img|link)\b", page)  # nothing comes from elsewhere
    with (out / "kc.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    sweep = document["sweeps"]["parallel"]
    np.testing.assert_array_equal([float(row["wheels.toe.left"]) for row in rows], np.array(sweep["wheels.toe"])[:, 0])
    rate = document["characteristics"]["wheel_rate"]["value"]
    assert rate == pytest.approx(np.mean(sweep["wheel_rate"][2]), rel=1e-12)


@pytest.mark.slow  # another report
def test_ideal_joints_give_the_curves_of_kinematics(written):
    """Of the corner on the left, at the travels of its wheel centre."""
    sweep = {name: np.array(values) for name, values in written[2]["sweeps"]["parallel"].items() if name != "shares"}
    axle = Axle.load(FILE)
    curves = axle.left.curves(sweep["wheels.travel"][:, 0])
    for name, found in (
        ("camber", sweep["wheels.camber"][:, 0]),
        ("toe", sweep["wheels.toe"][:, 0]),
        ("track_change", sweep["track_change"]),
        ("wheelbase_change", sweep["wheelbase_change"]),
        ("spring_motion_ratio", sweep["spring_motion_ratio"][:, 0]),
        ("roll_centre_height", sweep["roll_centre_height"]),
    ):
        np.testing.assert_allclose(found, getattr(curves, name), rtol=0, atol=1e-10, err_msg=name)


def test_largest_derivatives_come_first():
    """On the terminal, three of each characteristic, in its unit per mm."""
    axle = Axle.load(FILE)
    found = np.zeros((len(axle.hardpoint_names), 3))
    found[0, 1], found[1, 2], found[1, 0] = 1.0, -2.0, 0.5  # rad/m per m
    factor, unit = rigs.CHARACTERISTICS["bump_steer"].shown
    line = _kc._of_gradients(axle, {"bump_steer": found}).splitlines()[-1]
    first, second, third = (1e-3 * factor * value for value in (-2.0, 1.0, 0.5))
    names = axle.hardpoint_names
    shares = f"{names[1]} z {first:+.3g}, {names[0]} y {second:+.3g}, {names[1]} x {third:+.3g}"
    assert line.startswith(f"{rigs.CHARACTERISTICS['bump_steer'].label} [{unit}]") and line.endswith(shares)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sweeps", "paralel"], "argument --sweeps: 'paralel' is not one of"),
        (["--sweeps", "steering"], "this axle has no rack"),
        (["--points", "4"], "argument --points: must be odd and at least 3, got 4"),
        (["--sweeps", "parallel", "--gradient", "bump"], "argument --gradient: 'bump' is not one of"),
        (["--sweeps", "parallel", "--gradient", "lateral_steer"], "'lateral_steer' is of the sweep 'lateral', which"),
    ],
)
def test_bad_input(tmp_path, capsys, arguments, message):
    status = main(["kc", FILE, "--out", str(tmp_path / "out"), *arguments])
    said = capsys.readouterr().err
    assert status == 2 and message in said and len(said.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_what_asks_for_too_much_is_named(tmp_path, capsys):
    asked = ["--rigid", "--sweeps", "opposite,parallel", "--points", "3", "--travel", "0.9", "--quiet"]
    status = main(["kc", FILE, *asked, "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert status == 2 and "error: argument --travel 0.9: too much for this suspension, give less" in said


def test_an_interrupt_keeps_what_is_written(tmp_path, capsys, monkeypatch):
    """In the second file of a report without a test; before the first nothing is left behind."""

    class Nothing:
        sweeps, result = (), 0

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(_kc.rigs, "kc", lambda *_, **__: Nothing)
    monkeypatch.setattr(_kc, "_figure", lambda *_: None)
    monkeypatch.setattr(_kc, "_document", lambda *_: {})
    monkeypatch.setattr(_kc.rigs, "characteristics", lambda _: {})
    monkeypatch.setattr(_kc, "_write_table", stop)
    status = main(["kc", FILE, "--rigid", "--out", str(tmp_path / "out"), "--quiet"])
    said = capsys.readouterr().err
    assert status == 130 and "kc.json written; the same command with --overwrite begins anew" in said
