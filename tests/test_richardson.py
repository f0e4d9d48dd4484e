"""Richardson extrapolation: its order, its gradients, its error estimate, its failures; and Gregory's rule."""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, says

import lgsens as lg
from lgsens.examples import four_bar, spinning_top
from lgsens.simulation._richardson import extrapolate_runs

SCHEME = lg.GeneralizedAlpha(rho_inf=0.9)
RICHARDSON = lg.Richardson(SCHEME)
ALPHA = np.pi / 4


def extrapolated(coarse, fine):
    return extrapolate_runs(coarse.system, coarse, fine)


def load(name):
    return json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text())


def motion(alpha0, num_steps, integrator=RICHARDSON, **settings):
    return lg.simulate(spinning_top(alpha0), t1=1.0, num_steps=num_steps, integrator=integrator, **settings)


SIDE = lg.Criterion(integrand=lambda s, p: s.body("top").position[0] ** 2)


def terminal(trajectory):
    """Position, velocity, acceleration and force on the pivot at the end: linear in what is extrapolated."""
    top = trajectory.body("top")
    rows = (top.position, top.velocity, top.acceleration, trajectory.multiplier("pivot"))
    return jnp.concatenate([row[-1] for row in rows])


@functools.cache
def top_run(num_steps, integrator=SCHEME):
    """(Ψ, terminal quantities), their derivatives with respect to α₀, and the trajectory."""

    def observe(alpha0):
        trajectory = motion(alpha0, num_steps, integrator)
        values = SIDE(trajectory), terminal(trajectory)
        return values, (values, trajectory)

    slopes, (values, trajectory) = jax.jit(jax.jacrev(observe, has_aux=True))(jnp.asarray(ALPHA))
    return values, slopes, trajectory


TOP = load("spinning_top_brulls")["value"]["l_1.0_reproduces_published_number"]
TOP_SLOPE = load("spinning_top_brulls")["gradient"]["l_1.0_reproduces_published_number"]["alpha0"]


@pytest.mark.slow
def test_order_of_a_function():
    """Criterion and gradient against the independent reference: 16 times better with half the step, and the estimate.

    At ρ∞ = 0.9 the third-order part is small: 12 is asked for. The estimate is the error of the finer run up to what is
    left.
    """
    wanted = np.array([TOP, TOP_SLOPE])
    of_both = lambda run: np.array([run[0][0], run[1][0]])
    errors = []
    for num_steps in (50, 100):
        found = lg.richardson(lambda n: of_both(top_run(n)), num_steps)
        errors.append(np.abs(found.value - wanted))
        actual = wanted - of_both(top_run(2 * num_steps))
        assert np.all(np.abs(found.error - actual) <= 1.001 * errors[-1])
        assert np.all(errors[-1] < 0.05 * np.abs(actual))
    assert np.all(errors[0] / errors[1] > 12.0), errors


@pytest.mark.slow
def test_three_runs():
    """50, 100 and 200 steps leave a tenth and less of what the extrapolation of the finer two leaves."""
    wanted = np.array([TOP, TOP_SLOPE])
    of_both = lambda n: np.array([top_run(n)[0][0], top_run(n)[1][0]])
    left = [np.abs(lg.richardson(of_both, n, runs).value - wanted) for n, runs in ((100, 2), (50, 3))]
    assert np.all(left[1] < 0.1 * left[0]), left


@pytest.mark.slow
def test_order_of_a_trajectory():
    """The criterion by Gregory's rule on the coarse times, likewise; and the trapezoidal rule would spoil it."""
    finer = extrapolated(top_run(100)[2], top_run(200)[2])
    errors = []
    for num_steps, trajectory in ((50, top_run(50, RICHARDSON)[2]), (100, finer)):
        assert trajectory.t.shape == (num_steps + 1,) and trajectory.order == 4
        assert trajectory.stats.converged.shape == (3 * num_steps,)  # of both runs
        errors.append(abs(float(SIDE(trajectory)) - TOP))
    assert errors[0] / errors[1] > 12.0, errors
    trapezoidal = lg.time_integral(finer.t, finer.body("top").position[:, 0] ** 2)
    assert abs(trapezoidal - TOP) > 10.0 * errors[1]


@pytest.mark.slow
def test_the_derivative_is_extrapolated_exactly():
    """What is linear in the extrapolated quantities: value and derivative are (4 ψ_{h/2} − ψ_h)/3, to round-off.

    Multipliers carry round-off of 150 N/(β h²) times 1 m, h = 0.01 s: 1e6 EPS of the size of the forces.
    """
    (_, value), (_, slope), trajectory = top_run(50, RICHARDSON)
    for actual, index in ((value, 0), (slope, 1)):
        coarse, fine = (top_run(n)[index][1] for n in (50, 100))
        wanted = (4.0 * fine - coarse) / 3.0
        np.testing.assert_allclose(actual, wanted, rtol=0, atol=1e6 * EPS * np.abs(wanted).max())
    np.testing.assert_array_equal(trajectory.states.a, trajectory.states.vdot)


@pytest.mark.slow
def test_forward_mode_and_vmap():
    """The same numbers forwards, in a batch; sums in another order, of terms with the round-off of λ."""
    alphas = jnp.array([ALPHA, 0.5])
    forwards = jax.jit(jax.vmap(jax.jacfwd(lambda alpha0: SIDE(motion(alpha0, 50)))))(alphas)
    np.testing.assert_allclose(forwards[0], top_run(50, RICHARDSON)[1][0], rtol=1e-9)
    assert abs(forwards[1] / forwards[0] - 1.0) > 0.01  # another design has another gradient


@pytest.mark.slow
def test_error_estimate():
    """`error` is the error of the finer run, in all quantities, and extrapolation leaves a small part of it.

    Against the extrapolation of 100 and 200 steps, whose own error is a sixteenth of what is left. Accelerations and
    multipliers have transients (−ρ)ⁿ h², which differ in both runs: from the 25th step, where 0.9²⁵ = 0.07, and of
    nutation at 20 rad/s (ω h)² = 0.16 is left.
    """
    rough, best = top_run(50, RICHARDSON)[2], extrapolated(top_run(100)[2], top_run(200)[2])
    states = jax.tree.map(lambda leaf: leaf[::2], best.states)
    group = rough.system.group
    w = jax.vmap(lambda q, exact: group.log(group.compose(group.inverse(q), exact)))(rough.states.q, states.q)
    left = {"w": w} | {name: getattr(states, name) - getattr(rough.states, name) for name in ("v", "vdot", "lam")}
    for name, remaining in left.items():
        start, part = (25, 0.3) if name in ("vdot", "lam") else (0, 0.1)
        assert np.abs(remaining[start:]).max() < part * np.abs(getattr(rough.error, name)[start:]).max(), name


@pytest.mark.slow
def test_configurations_stay_on_the_group_and_near_the_constraints():
    trajectory = top_run(50, RICHARDSON)[2]
    orientation = trajectory.body("top").orientation
    # products of four rotation matrices, after 100 steps of a few round-offs each
    np.testing.assert_allclose(
        orientation @ jnp.swapaxes(orientation, 1, 2), np.tile(np.eye(3), (51, 1, 1)), atol=1e3 * EPS
    )
    violation = np.abs(jax.vmap(trajectory.system.constraint)(trajectory.states.q, trajectory.t)).max()
    # a point 1 m away on the chord or the arc of w: less than 2 w² (4e-6 m² here) times 4/3
    assert violation < 3.0 * np.abs(trajectory.error.w).max() ** 2


@pytest.mark.slow  # two runs, two compilations
def test_closed_loop():
    """The four-bar's ∫ v̇² dt against the independent reference: a tenth and less of the error of 400 steps is left."""
    wanted = load("four_bar_spring")["value"]["Psi2"]

    @functools.cache
    def psi(num_steps):
        trajectory = lg.simulate(four_bar(), t1=2.0, num_steps=num_steps, integrator=SCHEME)
        return lg.time_integral(trajectory.t, jnp.sum(trajectory.body("coupler").acceleration ** 2, axis=1))

    extrapolated = lg.richardson(psi, 200)
    left, removed = (abs(float(value) / wanted - 1.0) for value in (extrapolated.value, psi(400)))
    assert left < 2e-5 < 1e-4 < removed
    np.testing.assert_allclose(extrapolated.error / wanted, -removed, rtol=0, atol=2e-5)  # psi(400) is too large


# Failures and bad input.


def pushed(at):
    """A body under a ball joint with a push of 30 N for 0.02 s around a time."""
    signal = lg.SampledRoad([0.0, at - 0.02, at, at + 0.02, 1.0], [0.0, 0.0, 1.0, 0.0, 0.0])
    bob = lg.RigidBody(2.0, (0.1, 0.2, 0.3), position=(0.0, 0.0, -1.0))
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -9.81)),
        "push": lg.AppliedForce("bob", force=(30.0, 0.0, 0.0), signal=signal),
    }
    return lg.Model({"bob": bob}, {"pivot": lg.SphericalJoint(None, "bob", at=(0.0, 0.0, 0.0))}, forces)


IMPATIENT = lg.Richardson(lg.GeneralizedAlpha(max_iterations=1, factor_every=0))


@pytest.mark.parametrize(
    ("at", "place"),
    [
        (0.6, "step 6 of 10 of the coarser of two runs, t = 0.6 s"),
        (0.55, "step 11 of 20 of the finer of two runs, t = 0.55 s"),  # between the times of the coarser run
    ],
)
def test_failure_says_which_run(at, place):
    with pytest.raises(lg.SimulationError, match=says("smaller step (more `num_steps`)", place)):
        lg.simulate(pushed(at), t1=1.0, num_steps=10, integrator=IMPATIENT)
    trajectory = lg.simulate(pushed(at), t1=1.0, num_steps=10, integrator=IMPATIENT, throw=False)
    assert trajectory.result == lg.RESULTS.newton_failed
    for leaf in jax.tree.leaves((trajectory.states, trajectory.error)):
        finite = np.isfinite(leaf).reshape(11, -1)
        assert np.all(finite[:6]) and not np.any(finite[6:])


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda: lg.Richardson(0.9), says("Richardson: `integrator` must be a scheme", "0.9")),
        (lambda: lg.Richardson(RICHARDSON), says("Richardson: `integrator` must be a scheme", "Richardson(")),
        (lambda: lg.richardson(lambda n: 1.0 / n, 0), says("`num_steps` must be at least 1", "0")),
        (lambda: lg.richardson(lambda n: 1.0 / n, 2.5), says("`num_steps` must be a Python int", "2.5")),
        (lambda: lg.richardson(lambda n: 1.0 / n, 2, runs=1), says("`runs` must be a Python int of at least 2", "1")),
        (lambda: lg.richardson(3.0, 2), says("`fn` must be a function", "3.0")),
        (lambda: lg.richardson(lambda n: {"x": n}, 2), says("`fn` must return floats", "int", "['x']", "return only")),
        (
            lambda: lg.differentiate(SIDE, spinning_top, 0.7, t1=1.0, num_steps=10, integrator="Richardson"),
            says("`integrator` must be a GeneralizedAlpha or another integrator", "'Richardson'"),
        ),
    ],
)
def test_bad_input(attempt, message):
    with pytest.raises(ValueError, match=message):
        attempt()


def test_richardson_is_a_hashable_value():
    assert hash(lg.Richardson(lg.GeneralizedAlpha(0.9))) == hash(RICHARDSON)
    assert lg.Richardson(lg.GeneralizedAlpha(0.9)) == RICHARDSON != lg.Richardson(lg.GeneralizedAlpha(0.8))


def test_richardson_removes_the_second_order():
    """1/n² + 1/n⁴ becomes −1/(4 n⁴); and so its derivative."""
    fn = lambda x, n: {"y": x * (2.0 + 1.0 / n**2 + 1.0 / n**4)}
    found = lg.richardson(lambda n: fn(3.0, n), 10)
    np.testing.assert_allclose(found.value["y"], 3.0 * (2.0 - 0.25e-4), rtol=4 * EPS)
    np.testing.assert_allclose(found.error["y"], found.value["y"] - fn(3.0, 20)["y"], rtol=1e-12)
    slope = jax.grad(lambda x: lg.richardson(lambda n: fn(x, n), 10).value["y"])(3.0)
    np.testing.assert_allclose(slope, 2.0 - 0.25e-4, rtol=4 * EPS)


def test_three_runs_remove_the_fourth_order():
    """1/n² + 1/n⁴ + 1/n⁶ with n, 2n, 4n becomes (1 − 20/2⁶ + 64/4⁶)/45 = 1/64 of 1/n⁶; the last correction is what two
    runs of 2n and 4n miss but for that."""
    fn = lambda n: 2.0 + 1.0 / n**2 + 1.0 / n**4 + 1.0 / n**6
    found = lg.richardson(fn, 5, runs=3)
    np.testing.assert_allclose(found.value - 2.0, 1.0 / 64.0 / 5.0**6, rtol=4 * EPS / 1e-6)  # of 2
    np.testing.assert_allclose(found.error, found.value - lg.richardson(fn, 10).value, rtol=1e-9)  # EPS over 2.4e-5


# Gregory's rule.


def test_gregory_is_exact_for_cubics():
    """Also on the fewest times, where it is Simpson's rule; columns are integrated one by one."""
    for n in (3, 4, 5, 6, 30):
        t = np.linspace(1.0, 3.0, n)
        f = np.stack([t**k for k in range(4)], axis=1)
        wanted = [(3.0 ** (k + 1) - 1.0) / (k + 1) for k in range(4)]
        np.testing.assert_allclose(lg.time_integral(t, f, order=4), wanted, rtol=16 * EPS)


def test_gregory_is_exact_for_cubics_in_pieces():
    """Two steps in a piece do; the slope may jump from one to the next."""
    for n, m in ((2, 2), (2, 5), (4, 3)):
        t = np.concatenate([np.linspace(1.0, 1.7, n + 1), np.linspace(1.7, 3.0, m + 1)[1:]])
        f = np.where(t < 1.7, t**3, 1.7**3 - 2.0 * (t - 1.7) ** 2)
        exact = (1.7**4 - 1.0) / 4.0 + 1.3 * 1.7**3 - 2.0 * 1.3**3 / 3.0
        np.testing.assert_allclose(lg.time_integral(t, f, order=4), exact, rtol=16 * EPS)
        np.testing.assert_allclose(jax.jit(lambda f, t=t: lg.time_integral(t, f, order=4))(f), exact, rtol=16 * EPS)


def test_order_of_gregory():
    """∫ exp on [0, 1] by slope, and a slope of the integrand that jumps at a time: a kink costs nothing there."""
    smooth, kinked = [], []
    for n in (20, 40):
        t = np.linspace(0.0, 1.0, n + 1)
        smooth.append(abs(float(lg.time_integral(t, np.exp(t), order=4)) - np.expm1(1.0)))
        bend = np.maximum(t - 0.5, 0.0) ** 2 * np.exp(t)  # the second derivative jumps
        exact = 2.0 * np.e - (2.0 * np.exp(0.5) + 0.75 * np.e)  # ∫ (t − ½)² eᵗ from ½ to 1, by parts
        kinked.append(abs(float(lg.time_integral(t, bend, order=4)) - exact))
    assert np.log2(smooth[0] / smooth[1]) == pytest.approx(4.0, abs=0.15)  # the next order adds 1/n
    assert np.log2(kinked[0] / kinked[1]) == pytest.approx(4.0, abs=0.3)


@pytest.mark.parametrize(
    ("t", "order", "message"),
    [
        (np.arange(5.0), 3, says("`order` must be 2 (trapezoidal) or 4 (Gregory)", "3")),
        (np.arange(2.0), 4, says("at least 3 times, got 2", "order=2")),
        (np.arange(5.0) ** 2, 4, says("equidistant", "order=2")),
    ],
)
def test_bad_input_of_time_integral(t, order, message):
    with pytest.raises(ValueError, match=message):
        lg.time_integral(t, t, order=order)
