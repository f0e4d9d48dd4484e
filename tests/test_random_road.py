"""Random roads: samples of them, the five-link car that runs over them, and its design for them."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, random_like, says
from random_roads import INTENSITY, SPEED, compared

import lgsens as lg
from lgsens.analysis._random_road import lyapunov
from lgsens.cli import main
from lgsens.examples import DesignLimits, QuarterCar, RoadLimits, SuspensionDesign

ROAD = {"roughness": "C", "speed": SPEED}


def test_samples_of_a_random_road():
    """Normal steps of the variance S Δt, also of unequal times, from 0; a class is its number."""
    times = np.cumsum(np.concatenate([[0.3], np.tile([0.01, 0.03], 5000)]))
    road = lg.SampledRoad.random(jax.random.key(3), times, roughness="B", speed=SPEED)
    steps = np.diff(road.heights) / np.sqrt(INTENSITY * np.diff(times))
    # the mean of 10⁴ squares of deviation √2 is 1 ± 0.014, that of products 0 ± 0.01: four of each
    assert road.heights[0] == 0.0 and abs(np.mean(steps**2) - 1.0) < 0.057
    assert abs(np.mean(steps[1:] * steps[:-1])) < 0.04 and abs(np.mean(steps)) < 0.04
    of = lambda g: lg.SampledRoad.random(jax.random.key(3), times, roughness=g, speed=SPEED).heights
    np.testing.assert_allclose(jax.jacfwd(of)(64e-6), road.heights / (2 * 64e-6), rtol=1e-10)  # z goes by the root


@pytest.mark.parametrize("fastest", [1.0, 1e4])
def test_lyapunov_equation_of_a_known_covariance(fastest):
    """A = −(Q/2 + K) P⁻¹ with a skew K has the covariance P under a load Q, and settles: P is chosen first.

    Deviations are of two sizes, as those of displacements and velocities are.
    """
    rng = np.random.default_rng(5)
    size = np.array([1.0, 1.0, 1.0, fastest, fastest, fastest])
    root, skew = rng.normal(size=(2, 6, 6))
    load = rng.normal(size=6)
    p = np.outer(size, size) * (root @ root.T + np.eye(6))
    q = np.outer(size * load, size * load)
    a = -(q / 2.0 + np.outer(size, size) * (skew - skew.T)) @ np.linalg.inv(p)
    found = lyapunov(jnp.asarray(a), jnp.asarray(q)) / np.outer(size, size)
    # how far round-off in A moves P: by as much as the equation's inverse is large, in the units of `size`
    scaled = a * size / size[:, None]
    equation = np.kron(scaled, np.eye(6)) + np.kron(np.eye(6), scaled)
    condition = np.linalg.norm(np.linalg.inv(equation), 2) * np.linalg.norm(scaled, 2)
    close(found, p / np.outer(size, size), ulps=10.0 * condition)


def test_a_random_road_is_lowered_for_a_gpu():
    """What only LAPACK has is not lowered for one, Schur's form for example."""
    of = jax.jit(jax.vmap(jax.grad(lambda a: lyapunov(a, jnp.eye(3))[0, 0])))
    of.trace(jnp.zeros((2, 3, 3))).lower(lowering_platforms=("cuda",))


@pytest.fixture(scope="module")
def car():
    return QuarterCar.load()


@pytest.mark.slow  # `test_two_masses_over_random_roads` of `test_linearize.py` is a small version
def test_the_five_link_car_over_random_roads(car):
    """The slowest pole, e^(−1.78 t) of the weighting, leaves 8e-4 of a variance after 2 s, 8e-5 on the mean from there.

    And how linear the car is on such a road: a hundred times lower it moves alike to some 1e-4.
    """
    outputs = {
        "acceleration": lambda s: s.body("chassis").acceleration[2],
        "tyre": lambda s: s.force("tyre"),
        "travel": lambda s: s.body("wheel").position[2] - s.body("chassis").position[2],
    }
    model = car.model(wheel="locked", chassis="heave")
    linear = lg.linearize(model, inputs=("tyre",), outputs=outputs)
    for high, low in compared(model, linear, outputs, runs=96, t1=5.0, settled=2.0, h=0.01, low=8).values():
        assert np.sqrt(np.mean(high) / np.mean(low)) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow  # linear equations of eight bodies with derivatives
def test_a_design_and_its_derivatives(car):
    """Against central differences, and in closed form: of a car on two masses travel goes by c^(−1/2), and not by k.

    Differences of fourth order at 1e-3 of the scales: the remainder is 1e-12 of higher derivatives, and round-off of
    accelerations over the bump, 1e-12 of them, becomes 1e-9.
    """
    limits = RoadLimits.around(car, **ROAD, tyre=1.2, travel=1.05)
    design = SuspensionDesign(car, DesignLimits.load(), "k,c,hardpoints", t1=0.02, num_steps=4, road=limits)
    x, box = design.start, design.limits.hardpoint_box

    @jax.jit
    def fun(x):
        f, g = design(x)
        return jnp.concatenate([f[None], g])

    found, own = fun(x), car.random_road(**ROAD)
    assert found.shape == (1 + 5 * 3 + 2,)
    np.testing.assert_allclose(found[0], own.acceleration, rtol=1e-9)  # round-off of matrices of numbers up to 1e5
    np.testing.assert_allclose(found[-2:], [1 / 1.2 - 1, 1 / 1.05 - 1], rtol=1e-8)
    assert limits.tyre == pytest.approx(1.2 * float(own.tyre), rel=1e-9)

    scale = {name: jnp.full_like(value, box) if name == "hardpoints" else value for name, value in x.items()}
    along = jax.tree.map(lambda s, d: s * d, scale, random_like(x, np.random.default_rng(1)))
    slope = jax.jit(lambda x: jax.jvp(fun, (x,), (along,))[1])(x)
    at = lambda s: fun(jax.tree.map(lambda a, b: a + s * b, x, along))
    first, second = ((at(s) - at(-s)) / (2 * s) for s in (1e-3, 2e-3))
    expected = (4 * first - second) / 3
    some = np.r_[0, -2, -1]
    np.testing.assert_allclose(slope[some], expected[some], rtol=1e-6)
    np.testing.assert_allclose(slope, expected, atol=1e-6 * np.abs(expected).max())

    back = jax.jit(jax.jacrev(lambda x: limits.response(design.with_design(x))))(x)
    products = [sum(jax.tree.leaves(jax.tree.map(jnp.vdot, of, along))) for of in back]
    sizes = np.array([1.0, limits.tyre, limits.travel])
    np.testing.assert_allclose(products / sizes, slope[some], rtol=1e-8)  # round-off as above, in another order
    of = {name: float(x[name] * back.travel[name] / own.travel) for name in ("damping", "stiffness")}
    assert of["damping"] == pytest.approx(-0.5, rel=1e-8) and abs(of["stiffness"]) < 1e-8


@pytest.mark.parametrize("name", ["tyre", "travel"])
def test_bad_limits(car, name):
    with pytest.raises(ValueError, match=says(f"`{name}` must be positive, got 0.0")):
        RoadLimits.around(car, **ROAD, **{name: 0.0})
    with pytest.raises(ValueError, match=says(f"RoadLimits: `{name}` must be positive, got -1.0")):
        RoadLimits(**{"roughness": 256e-6, "speed": SPEED, "tyre": 700.0, "travel": 0.01} | {name: -1.0})


@pytest.mark.slow  # the programs of a search
def test_the_command_designs_for_a_road(tmp_path, capsys):
    """Limits of the bump stay; what holds the optimum back is travel, so c = 4900/1.1², and the softest spring."""
    out = tmp_path / "new"
    status = main(["optimize", "quarter-car", "--out", str(out), "--dt", "5e-3", "--road", "C"])
    printed = capsys.readouterr().out
    found = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert status == 0 and found["feasible"]
    assert found["design"]["damping"]["after"] == pytest.approx(4900.0 / 1.21, rel=1e-3)  # the tolerance of limits
    assert found["design"]["stiffness"]["after"] == pytest.approx(50000.0, rel=1e-6)
    objective, bump = found["objective"], found["road"]["bump"]
    assert objective["name"].startswith("sigma_w, RMS") and objective["unit"] == "m/s^2"
    assert bump["before"] == pytest.approx(7.697902, rel=1e-3)  # as in `test_cli.py`
    assert (found["road"]["roughness"], found["road"]["speed"]) == (256e-6, 20.0)
    rows = {row["name"]: row for row in found["constraints"]}
    assert len(rows) == 5
    assert [name for name, row in rows.items() if row["active"]] == ["RMS wheel travel on the road"]
    assert rows["RMS tyre load on the road"]["before"]["violation_over_scale"] == pytest.approx(1 / 1.1 - 1)
    for text in ("sigma_w [m/s^2]", "Psi_0 [m^2/s^3]", "over the bump", "RMS tyre load on the road [N]"):
        assert text in printed
    for check in found["gradient_check"].values():
        assert max(check["relative_error"]) < 1e-6  # as in `test_cli.py`
    car = QuarterCar.load()
    for label, k, c in (("before", 109000.0, 4900.0), ("after", 50000.0, found["design"]["damping"]["after"])):
        own = car.with_values(stiffness=k, damping=c).random_road(roughness="C", speed=20.0)
        assert objective[label] == pytest.approx(float(own.acceleration), rel=1e-6)
        assert rows["RMS tyre load on the road"][label]["worst_value"] == pytest.approx(float(own.tyre), rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--speed", "20"], "--speed is of a random road; give its class as well, --road C"),
        (["--limit", "tyre=1.2"], "--limit is of a random road; give its class as well"),
        (["--road", "Z"], "argument --road: invalid choice: 'Z'"),
        (["--road", "C", "--speed", "0"], "argument --speed: must be positive, got 0"),
        (
            ["--road", "C", "--limit", "grip=1.2"],
            "--limit must be tyre=FACTOR or travel=FACTOR, positive, got grip=1.2",
        ),
        (["--road", "C", "--limit", "tyre=0"], "positive, got tyre=0.0"),
        (["--road", "C", "--limit", "tyre=1:2"], "positive, got tyre=(1.0, 2.0)"),
        (["--road", "C", "--vary", "spring.stiffness=0.3"], "--road is of a corner; an axle, with --vary, is designed"),
    ],
)
def test_bad_arguments_of_the_command(arguments, message, tmp_path, capsys):
    try:
        status = main(["optimize", "quarter-car", "--out", str(tmp_path / "new"), *arguments])
    except SystemExit as stop:  # argparse's way out
        status = stop.code
    said = capsys.readouterr().err
    assert status == 2 and message in said and said.count("\n") == 1
    assert not (tmp_path / "new").exists()
