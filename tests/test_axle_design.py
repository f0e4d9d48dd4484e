"""Design of an axle: its numbers by the keys of its file, half of it over the bump, and bands on what the rig says."""

import dataclasses
import json
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.cli import main
from lgsens.cli._optimize_axle import _si
from lgsens.examples import Axle, AxleNumbers
from lgsens.examples._axle_numbers import places
from lgsens.rigs import AxleDesign

AXLE = Axle.load("multi_link")
FILE = Path(lg.examples.__file__).parent / "data" / "multi_link.toml"


def test_numbers_have_the_keys_of_their_file():
    """A name followed through the file, read by tomllib, ends at the value that the axle has."""
    data = tomllib.loads(FILE.read_text(encoding="utf-8"))
    values = jax.tree.leaves(AXLE)
    for name, key, index in (
        ("links.tie_rod.knuckle.x", ("links", "tie_rod", "knuckle"), 0),
        ("spring.stiffness", ("spring", "stiffness"), None),
        ("damper.damping", ("damper", "damping"), None),
        ("tyre.stiffness", ("tyre", "stiffness"), None),
    ):
        place = next(place for of in places(AXLE).values() for place in of if place.name == name)
        expected = data
        for step in key:
            expected = expected[step]
        expected = expected if index is None else expected[index]
        assert float(values[place.leaf].ravel()[place.index]) == expected


def test_chosen_numbers_are_replaced_on_both_sides_and_no_others():
    numbers = AxleNumbers.select(AXLE, {"links.tie_rod.knuckle": 0.01, "spring.stiffness": 0.3})
    x = numbers.of(AXLE)
    assert numbers.names == {
        "hardpoints": tuple(f"links.tie_rod.knuckle.{axis}" for axis in "xyz"),
        "rates": ("spring.stiffness",),
    }
    np.testing.assert_allclose(numbers.upper["hardpoints"] - x["hardpoints"], 0.01, rtol=1e-12)
    np.testing.assert_allclose(numbers.lower["rates"] / x["rates"], 0.7, rtol=1e-12)
    moved = numbers.replaced(AXLE, {"hardpoints": x["hardpoints"] + 0.002, "rates": 1.1 * x["rates"]})
    changed = [not np.array_equal(a, b) for a, b in zip(jax.tree.leaves(moved), jax.tree.leaves(AXLE))]
    assert sum(changed) == 2
    np.testing.assert_allclose(moved.right.spring.rate, 1.1 * AXLE.left.spring.rate, rtol=1e-12)
    back = numbers.replaced(moved, x)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(AXLE)))


@pytest.mark.parametrize(
    ("vary", "keep", "message"),
    [
        ({"links.tie_rods": 0.01}, {}, r"`vary`: 'links.tie_rods' matches no number .* mean 'links.tie_rod"),
        ({"spring.stiffness": -0.3}, {}, r"`vary`, 'spring.stiffness': must be a positive number or a pair"),
        ({"spring.stiffness": 1.5}, {}, "rates stay positive"),
        ({"links.tie_rod": 10.0}, {}, "'links.tie_rod': is in metres, .* no point moves 10 m either way"),
        ({"spring.stiffness": 0.3}, {"tow": 0.1}, "`keep`: .*'tow'"),
        ({"spring.stiffness": 0.3}, {"ackermann": 0.1}, r"`keep`: \['ackermann'\] need a rack that steers"),
    ],
)
def test_bad_input(vary, keep, message):
    with pytest.raises(ValueError, match=message):
        AxleDesign.of(AXLE, vary, keep)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--keep", "toe=0.1"], "--keep is of an axle, with --vary"),
        (["--vary", "spring.stiffness=0.3", "--keep-toe", "0.1"], "--keep-toe is of a corner; of an axle"),
        (["--vary", "spring.stiffness=0.3", "--parameters", "hardpoints"], "--parameters is of a corner; of an axle"),
        (["--vary", "spring.stiffness=0.3", "--traction-share", "1.5"], "must be between 0 and 1, got 1.5"),
        (["--vary", "spring.stiffnes=0.3"], "'spring.stiffnes' matches no number of the axle"),
        (["--vary", "spring.stiffness=0.3", "--keep", "tow=0.1"], "'tow'"),
        (["--vary", "spring.stiffness"], "must be NAME=NUMBER or NAME=LOWER:UPPER, got 'spring.stiffness'"),
        (["--vary", "spring.stiffness=1:2:3"], "must be NAME=NUMBER or NAME=LOWER:UPPER"),
        (["--vary", "spring.stiffness=nan"], "must be NAME=NUMBER or NAME=LOWER:UPPER"),
    ],
)
def test_bad_arguments_of_the_command(arguments, message, tmp_path, capsys):
    try:
        status = main(["optimize", "multi_link", "--out", str(tmp_path / "new"), *arguments])
    except SystemExit as stop:  # argparse's way out
        status = stop.code
    assert status == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_units_of_the_command():
    """As `lgsens kc` shows them: degrees, °/kN, %."""
    assert _si("toe", 0.1) == pytest.approx(np.radians(0.1), rel=1e-14)
    assert _si("lateral_steer", (-0.02, 0.01)) == pytest.approx(tuple(np.radians([-2e-5, 1e-5])), rel=1e-14)
    assert _si("roll_camber", (80.0, 90.0)) == pytest.approx((0.8, 0.9), rel=1e-14)
    with pytest.raises(ValueError, match="must have its lower bound first"):
        _si("wheel_rate", (2.0, 1.0))


@pytest.mark.slow  # the programs of a whole axle
def test_the_command_designs_an_axle(tmp_path, capsys):
    """Within its band, better than at the start, and the same numbers as the search in Python."""
    out, asked = tmp_path / "new", ["--t1", "0.2", "--dt", "2e-3", "--steps", "30", "--quiet"]
    vary = {"spring.stiffness": 0.3, "damper.damping": 0.3}
    free = [word for name, width in vary.items() for word in ("--vary", f"{name}={width}")]
    status = main(["optimize", "multi_link", "--out", str(out), *asked, *free, "--keep", "wheel_rate=1.0"])
    found = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert status == 0 and found["feasible"] and found["objective"]["reduction"] > 0
    (kept,) = found["constraints"]
    low, high = kept["limit"]
    slack = 1e-3 * (high - low) / 2  # the tolerance of the search
    assert kept["unit"] == "N/mm" and high - low == pytest.approx(2.0, rel=1e-12)
    assert low - slack <= kept["after"]["worst_value"] <= high + slack
    assert kept["before"]["worst_value"] == pytest.approx((low + high) / 2, rel=1e-9)
    design = AxleDesign.of(AXLE, vary, {"wheel_rate": 1e3}, t1=0.2, num_steps=100)
    assert found["design"]["rates"]["before"]["spring.stiffness"] == pytest.approx(float(AXLE.left.spring.rate))
    x = {"rates": jnp.asarray([found["design"]["rates"]["after"][name] for name in design.numbers.names["rates"]])}
    objective, _ = jax.jit(lambda x: design(x))(x)
    assert float(objective) == pytest.approx(found["objective"]["after"], rel=1e-9)  # round-off of accelerations
    assert {path.name for path in out.iterdir()} == {
        *("convergence.png", "mechanism.png", "response.png", "result.json", "suspension.json")
    }


@pytest.mark.slow  # two large scenes
def test_half_an_axle_moves_as_all_of_it():
    """Over a bump that both wheels meet. Accelerations: round-off 1e-16 of positions over βh² = 1e-6, times ten."""
    whole = AXLE.model(chassis="guided", tyres=True, links="rods")
    road = lg.BumpRoad(height=AXLE.left.bump_height, duration=AXLE.left.bump_duration)
    meets = lambda name, force: dataclasses.replace(force, road=road) if name.endswith("_tyre") else force
    whole = lg.Model(whole.bodies, whole.joints, {name: meets(name, force) for name, force in whole.forces.items()})
    runs = [lg.simulate(model, t1=0.3, num_steps=150) for model in (AXLE.half(), whole)]
    for body in ("chassis", "subframe", "left_wheel"):
        half, expected = (run.body(body).acceleration[:, 2] for run in runs)
        np.testing.assert_allclose(half, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.slow  # K&C and the bump with derivatives
def test_problem_and_its_derivative():
    """At the start bands around the start are half used up, g = −1; derivatives are those of central differences."""
    vary = {"links.tie_rod.knuckle": 0.01, "bushings.lateral_link_subframe.stiffness": 0.5}
    design = AxleDesign.of(AXLE, vary, {"toe": 1e-3, "lateral_steer": 1e-6}, points=3, t1=0.2, num_steps=100)
    fun = jax.jit(lambda x: jnp.concatenate([jnp.stack([f[0]]), f[1]]) if (f := design(x)) else None)
    x = design.start
    found = fun(x)
    np.testing.assert_allclose(found[1:], -1.0, atol=1e-7)  # round-off of angles 1e-16 × 1e3, of forces 1e-10 × 1e3
    width = jax.tree.map(lambda a, b: (b - a) / 2, design.numbers.lower, design.numbers.upper)
    rng = np.random.default_rng(1)
    along = jax.tree.map(lambda w: w * jnp.asarray(rng.normal(size=w.shape)), width)
    _, slope = jax.jit(lambda x: jax.jvp(fun, (x,), (along,)))(x)
    at = lambda s: fun(jax.tree.map(lambda a, b: a + s * b, x, along))
    step = 1e-3
    first, second = ((at(s) - at(-s)) / (2 * s) for s in (step, 2 * step))
    expected = (4 * first - second) / 3  # of fourth order: step⁴, and round-off 1e-9 of accelerations over the step
    np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
