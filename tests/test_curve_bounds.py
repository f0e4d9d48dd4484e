"""Camber and toe kept within bands: the constraints of the design, and what the command line says of them."""

import csv
import json
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgsens import plotting
from lgsens.cli._curves import axle_of
from lgsens.cli._main import main
from lgsens.cli._optimize_quarter_car import Outcome
from lgsens.examples import CurveBounds, QuarterCar, SuspensionDesign

CAMBER, TOE = np.radians(0.3), np.radians(0.1)


@pytest.fixture(scope="module")
def car():
    return QuarterCar.load()


@pytest.fixture(scope="module")
def bounds(car):
    return CurveBounds.around(car, travel=0.05, camber=CAMBER, toe=TOE)


def test_the_start_is_in_the_middle(car, bounds):
    """Each of 9 travels, two angles and two sides; −1 in the middle of the band, in half widths."""
    found = bounds.constraints(bounds.curves(car))
    assert found.shape == (36,)
    np.testing.assert_allclose(found, -1.0, rtol=0, atol=1e-9)  # round-off of the curves, 1e-13, over 1e-3
    one = CurveBounds.around(car, travel=0.05, toe=TOE, num_points=3)
    assert list(one.bands) == ["toe"] and one.constraints(one.curves(car)).shape == (6,)


def test_a_hardpoint_that_moves_leaves_the_band(car, bounds):
    """The constraint is how far the worst curve strays, on the side where it does."""
    moved = eqx.tree_at(lambda c: c.links["track_strut"].chassis, car, car.links["track_strut"].chassis + 0.01)
    before, after = bounds.curves(car), bounds.curves(moved)
    change = np.asarray(after.toe - before.toe)
    found = np.asarray(bounds.constraints(after)).reshape(4, 9)
    np.testing.assert_allclose(found[2], -change / TOE - 1, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[3], change / TOE - 1, rtol=0, atol=1e-9)
    assert found[2:].max() > 0.1  # a centimetre is too much


@pytest.mark.slow
def test_the_design_has_them_and_their_gradient(car, bounds):
    """In a row after those of the path; their gradient by the hardpoints against differences."""
    with_curves = SuspensionDesign.load(parameters="hardpoints", keep=bounds, t1=0.02, num_steps=4)
    shape = jax.eval_shape(with_curves, with_curves.start)[1].shape
    assert shape == (5 * 3 + 36,)

    def worst(points):
        return jnp.max(bounds.constraints(bounds.curves(with_curves.with_design({"hardpoints": points}))))

    rng = np.random.default_rng(1)
    points = with_curves.start["hardpoints"] + 0.005 * jnp.asarray(rng.normal(size=(5, 3)))
    direction = jnp.asarray(rng.normal(size=(5, 3)))
    value_and_grad = jax.jit(jax.value_and_grad(worst))
    _, gradient = value_and_grad(points)
    h = 1e-6
    difference = (value_and_grad(points + h * direction)[0] - value_and_grad(points - h * direction)[0]) / (2 * h)
    # constraints of order 1 change by 1e3 per metre; round-off 1e-10 (see above) over h is 1e-4 of 1e3, h²·f‴ less
    assert float(jnp.vdot(gradient, direction)) == pytest.approx(float(difference), rel=1e-6)


def test_the_report_says_how_far_they_stray(car, bounds):
    design = SuspensionDesign.load(parameters="hardpoints", keep=bounds)
    points = design.start["hardpoints"].at[0, 2].add(0.004)
    x = {"hardpoints": points}
    found = SimpleNamespace(result=SimpleNamespace(x=x))
    camber, toe = Outcome(design, found).kept_curves()
    assert (camber["name"], toe["name"]) == ("change of camber", "change of toe")
    expected = np.asarray(bounds.curves(design.with_design(x)).toe - bounds.curves(car).toe)
    worst = np.argmax(np.abs(expected))
    assert toe["after"]["worst_value"] == pytest.approx(expected[worst], abs=1e-12)
    assert toe["after"]["violation_over_scale"] == pytest.approx(abs(expected[worst]) / TOE - 1, abs=1e-9)
    assert toe["before"]["violation_over_scale"] == pytest.approx(-1, abs=1e-9)
    assert Outcome(SuspensionDesign.load(), found).kept_curves() == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"travel": 0.0, "toe": TOE}, "`travel` must be positive, got 0.0"),
        ({"travel": 0.05, "toe": -1.0}, "`toe` must be positive, got -1.0"),
        ({"travel": 0.05, "camber": np.nan}, "`camber` must be positive, got nan"),
        ({"travel": 0.5, "camber": CAMBER}, "No position satisfies"),
    ],
)
def test_bad_bounds(car, arguments, message):
    with pytest.raises(ValueError, match=message):
        CurveBounds.around(car, **arguments)


@pytest.mark.slow
def test_the_command_draws_lists_and_animates(tmp_path, capsys, car, monkeypatch):
    out = tmp_path / "out"
    arguments = ["curves", "quarter-car", "--out", str(out), "--travel", "0.06", "--points", "5", "--axle", "front"]
    assert main(arguments) == 0
    assert sorted(path.name for path in out.iterdir()) == ["curves.csv", "curves.png", "travel.html"]
    with (out / "curves.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    expected = car.curves(np.linspace(-0.06, 0.06, 5), axle="front")
    for name, column in expected._asdict().items():
        np.testing.assert_array_equal([float(row[name]) for row in rows], column)
    printed = capsys.readouterr().out
    assert "camber [deg]" in printed and f"{np.degrees(float(expected.toe[0])):.4f}" in printed
    assert main(arguments) == 2 and "exists already" in capsys.readouterr().err

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(plotting, "animate", stop)
    (out / "curves.csv").unlink()
    assert main([*arguments, "--overwrite"]) == 130
    assert sorted(path.name for path in out.iterdir()) == ["curves.csv", "curves.png"]
    said = capsys.readouterr().err
    assert "interrupted: curves.csv and curves.png written; the same command with --overwrite begins anew" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["curves", "quarter-car", "--points", "1"], "--points: must be at least 2, got 1"),
        (["curves", "quarter-car", "--travel", "0.5", "--quiet"], "No position satisfies the joints"),
        (["optimize", "quarter-car", "--keep-toe", "0.1"], "--keep-toe is about hardpoints, which --parameters k,c"),
    ],
)
def test_bad_arguments_give_one_line(arguments, message, tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*arguments, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not out.exists()


@pytest.mark.slow
def test_hardpoints_that_keep_the_curves(tmp_path):
    """Less gain than without, but the curves are kept, and the bands are what holds the design back."""
    out = tmp_path / "out"
    options = ["--parameters", "hardpoints", "--keep-camber", "0.3", "--keep-toe", "0.1"]
    assert main(["optimize", "quarter-car", "--out", str(out), *options, "--quiet"]) == 0
    assert (out / "curves.png").exists()
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    rows = {row["name"]: row for row in result["constraints"]}
    assert {"change of camber", "change of toe"} <= set(rows)
    for row in rows.values():
        assert row["after"]["violation_over_scale"] <= 1e-3
    assert result["objective"]["reduction"] > 0.05


def test_the_axle_is_that_of_the_file(tmp_path):
    for text, expected in (("[vehicle]\naxle = 'front'\n", "front"), ("[vehicle]\n", "rear"), ("", "rear")):
        path = tmp_path / "suspension.toml"
        path.write_text(text, encoding="utf-8")
        assert axle_of(path) == expected
