"""Steps that end at breaks move with them: derivatives by the times of breaks, by t0 and t1."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from jaxtyping import Array, Float

import lgsens as lg
from lgsens.integrate import moved

INERTIA, RATE, BEGIN, LENGTH, T1 = 0.3, 9.0, 0.153, 0.5, 1.3
P = {"rate": RATE, "begin": BEGIN, "length": LENGTH}


class Jump(lg.AbstractSignal):
    """s̈ is `rate` over a while, else 0."""

    rate: Float[Array, ""]
    begin: Float[Array, ""]
    length: Float[Array, ""]

    def __call__(self, t):
        x = t - self.begin
        after = 0.5 * self.rate * self.length**2 + self.rate * self.length * (x - self.length)
        return jnp.where(x <= 0.0, 0.0, jnp.where(x <= self.length, 0.5 * self.rate * x**2, after))

    @property
    def breaks(self):
        return jnp.stack([self.begin, self.begin + self.length])


def turned(signal) -> lg.Model:
    """A body that a driver turns."""
    driver = lg.RotationDriver(None, "body", axis=(0.0, 0.0, 1.0), value=signal)
    return lg.Model({"body": lg.RigidBody(1.0, (INERTIA,) * 3, free="rz")}, {"driver": driver})


def build(p):
    return turned(Jump(**{name: jnp.asarray(value) for name, value in p.items()}))


WORK = lg.Criterion(integrand=lambda s, p: s.joint("driver").axial_moment ** 2)  # (J a)² T
EXACT = {"rate": 2.0 * INERTIA**2 * RATE * LENGTH, "begin": 0.0, "length": (INERTIA * RATE) ** 2}


@functools.cache
def gradient(integrator, method, num_steps):
    return lg.differentiate(WORK, build, P, t1=T1, num_steps=num_steps, integrator=integrator, method=method).gradient


@pytest.mark.slow  # `test_steps_move_with_the_ends_of_their_pieces` is in the quick run
@pytest.mark.parametrize(
    "method",
    [lg.DirectDifferentiation(), pytest.param(lg.AdjointVariable(), marks=pytest.mark.slow)],
    ids=["direct", "adjoint"],
)
@pytest.mark.parametrize(
    "integrator",
    [
        lg.AlignedSteps(),
        pytest.param(lg.AlignedSteps(lg.GeneralizedAlpha(stabilized=True)), marks=pytest.mark.slow),
        pytest.param(lg.AlignedSteps(lg.RadauIIA()), marks=pytest.mark.slow),
    ],
    ids=["index 3", "stabilized", "radau"],
)
def test_by_the_times_of_jumps(integrator, method):
    """Where accelerations jump, Ψ' has [F] ė: on steps that stay, half of it is missing in any number of them.

    At a jump the trapezoidal rule has one of two values: of first order, h F/2 in Ψ of 41 and 82 steps.
    """
    of_radau = isinstance(integrator.integrator, lg.RadauIIA)  # whose stages see no jump, which its last one may
    coarse, fine = (gradient(integrator, method, n) for n in ((20, 40) if of_radau else (100, 200)))
    size = EXACT["length"]
    for name, exact in EXACT.items():
        errors = [abs(float(found[name]) - exact) / size for found in (coarse, fine)]
        assert errors[0] < (1e-8 if of_radau else 0.05)  # Radau: what is behind a break, 1.5e-8 h, times jerk
        if name != "rate" and not of_radau:
            assert errors[1] == pytest.approx(errors[0] / 2.0, rel=0.3, abs=1e-3)


def ramped(p):
    """A ramp that moves a trolley on which a pendulum hangs."""
    ramp = lg.Ramp(end=p["way"], t_start=p["begin"], duration=p["length"])
    trolley = lg.RigidBody(1.0, None, free="x")
    bob = lg.RigidBody(1.5, (0.02,) * 3, position=(0.3, 0.0, -0.4), free="x z ry")
    return lg.Model(
        {"trolley": trolley, "bob": bob},
        {
            "driver": lg.TranslationDriver(None, "trolley", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), value=ramp),
            "hinge": lg.RevoluteJoint("trolley", "bob", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),
        },
        {"gravity": lg.Gravity((0.0, 0.0, -9.81))},
    )


RAMP = {"way": 0.3, "begin": 0.113, "length": 0.237, "t1": 0.5}
FORCE = lg.Criterion(
    integrand=lambda s, p: 1e-2 * s.joint("driver").axial_force ** 2,
    terminal=lambda s, p: s.body("bob").position[0] * s.t,
)


TERMINAL = lg.Criterion(terminal=FORCE.terminal)


def of_ramp(p, integrator, num_steps=48, criterion=FORCE, **settings):
    run = lg.simulate(ramped(p), t1=p["t1"], num_steps=num_steps, integrator=integrator, **settings)
    return criterion(run, p)


@functools.cache
def reference():
    """The steps, and differences of runs in steps that move with the ramp."""
    p = jax.tree.map(jnp.asarray, RAMP)
    run = lg.simulate(ramped(p), t1=p["t1"], num_steps=48, integrator=lg.AlignedSteps())
    steps = lg.GivenSteps.of(run)
    value = jax.jit(lambda p: of_ramp(p, steps))
    along = lambda name: central(lambda s: value(p | {name: p[name] + s}), 1e-4)
    return steps, {name: float(along(name)) for name in p}


def check(found, *, but=()):
    differences = reference()[1]
    # (1e-4/0.237)² of derivatives that are 60 times the first
    size = max(map(abs, differences.values()))
    for name in set(differences) - set(but):
        assert float(found[name]) == pytest.approx(differences[name], abs=2e-5 * size)


def arrays():
    return jax.tree.map(jnp.asarray, RAMP)


def saved(p, **settings):
    """The integral of FORCE of what is saved, and not its terminal term."""
    save = lambda s: s.joint("driver").axial_force
    run = lg.simulate(ramped(p), t1=p["t1"], num_steps=48, integrator=lg.AlignedSteps(), save=save, **settings)
    return lg.time_integral(run.t, 1e-2 * run.values**2)


METHODS = {
    "direct": (jax.jacfwd, lg.DirectDifferentiation()),
    "adjoint": (jax.jacrev, lg.AdjointVariable()),
    "at once": (jax.jacrev, lg.AssociativeScan()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_by_all_methods_on_a_ramp(name):
    mode, method = METHODS[name]
    check(jax.jit(mode(functools.partial(of_ramp, integrator=lg.AlignedSteps(), sensitivity=method)))(arrays()))


@pytest.mark.slow
def test_of_steps_under_error_control_and_extrapolated():
    """Of what is found the sizes relative to their pieces are constants, of which differences know as well."""
    p = arrays()
    for integrator, most in ((lg.AdaptiveSteps(tolerance=1e-5), 400), (lg.Richardson(lg.AlignedSteps()), 96)):
        run = lg.simulate(ramped(p), t1=p["t1"], num_steps=most, integrator=integrator)
        steps = lg.GivenSteps.of(run)
        count = steps.num_steps
        steps = lg.Richardson(steps) if integrator.extrapolated else steps
        value = jax.jit(functools.partial(of_ramp, integrator=steps, num_steps=count))
        found = jax.jit(jax.grad(functools.partial(of_ramp, integrator=integrator, num_steps=most)))(p)
        size = max(abs(float(leaf)) for leaf in found.values())
        for name in p:
            along = central(lambda s, name=name, value=value: value(p | {name: p[name] + s}), 1e-4)
            assert float(found[name]) == pytest.approx(float(along), abs=2e-5 * size)  # as in `check`


@pytest.mark.slow
@pytest.mark.parametrize("method", [lg.DirectDifferentiation, lg.AdjointVariable])
def test_of_what_is_saved(method):
    kept = jax.jit(jax.jacrev(lambda p: saved(p, sensitivity=method())))(arrays())
    again = jax.jit(jax.jacrev(lambda p: saved(p, sensitivity=method(checkpoints=5))))(arrays())
    whole = lambda p: of_ramp(p, lg.AlignedSteps()) - of_ramp(p, lg.AlignedSteps(), criterion=TERMINAL)
    expected = jax.jit(jax.grad(whole))(arrays())
    for name, value in expected.items():
        for found in (kept, again):
            assert float(found[name]) == pytest.approx(float(value), rel=1e-9)  # round-off × condition of 48 steps


@pytest.mark.slow
def test_second_derivatives():
    p, of = arrays(), functools.partial(of_ramp, integrator=reference()[0])
    slope = jax.jit(jax.grad(of))
    second = jax.jit(jax.jacfwd(jax.grad(of)))(p)["begin"]
    for name in p:
        found = central(lambda s, name=name: slope(p | {name: p[name] + s})["begin"], 1e-4)
        assert float(second[name]) == pytest.approx(float(found), abs=2e-5 * float(second["length"]))  # as in `check`


@pytest.mark.slow
@pytest.mark.parametrize("method", [lg.DirectDifferentiation(), lg.AdjointVariable()], ids=["on the fly", "by parts"])
@pytest.mark.parametrize("given", [False, True], ids=["aligned", "given"])
def test_criteria_know_the_times(method, given):
    integrator = reference()[0] if given else lg.AlignedSteps()
    settings = {"t1": RAMP["t1"], "num_steps": 48, "integrator": integrator, "method": method}
    check(lg.differentiate(FORCE, ramped, RAMP, **settings).gradient, but=("t1",))


def test_steps_move_with_the_ends_of_their_pieces():
    sizes = jnp.asarray([0.1, 0.1, 0.2, 0.2, 0.4, 0.0])
    # two breaks at one end, one in a step, one at t0, one behind the last
    known = jnp.asarray([0.0, 0.2, 0.2, 0.5, 0.6, 1.0, 1.0])
    same, begins = moved(sizes, known, known)
    np.testing.assert_allclose(same, sizes, rtol=1e-15)
    np.testing.assert_array_equal(begins, [0.0, 0.0, 1.0, 0.0, 1.0, 0.0])
    found, _ = moved(sizes, known, jnp.asarray([0.0, 0.25, 0.35, 0.5, 0.8, 1.5, 2.0]))
    np.testing.assert_allclose(found, [0.15, 0.15, 0.25, 0.25, 1.2, 0.0], rtol=1e-14)
    slopes = jax.jacfwd(lambda ends: jnp.cumsum(moved(sizes, known, ends)[0]))(known)
    # the end of the second step moves by half of each of its breaks, that of the fourth by one, the last by t1
    np.testing.assert_allclose(slopes[1], [0.0, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(slopes[3], [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(slopes[5], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], atol=1e-15)
    found, begins = moved(sizes, known[-1:], 2.0 * known[-1:])
    assert begins is None
    np.testing.assert_allclose(found, 2.0 * sizes)


def pushed(signal) -> lg.Model:
    """A body under a force."""
    push = lg.AppliedForce("mass", at=(0.0, 0.0, 0.0), force=(0.0, 0.0, 1.0), signal=signal)
    return lg.Model({"mass": lg.RigidBody(2.0, None, free="z")}, {}, {"push": push})


@pytest.mark.slow  # steps that move are in the quick run
def test_none_move_where_there_are_too_few_for_all_pieces():
    """Equal steps end at breaks by chance only; derivatives are those of what is computed."""
    signal = lambda at: lg.Sampled(jnp.linspace(0.0, 0.9, 11) + at, jnp.zeros(11))
    run = lambda at: lg.simulate(pushed(signal(at)), t1=1.0, num_steps=10, integrator=lg.AlignedSteps())
    at = jnp.asarray(0.05)
    np.testing.assert_allclose(run(at).t, np.linspace(0.0, 1.0, 11), rtol=1e-14)
    np.testing.assert_array_equal(jax.jacfwd(lambda at: run(at).t)(at), 0.0)


def of_peak(at, integrator):
    push = lg.Sampled(jnp.stack([0.0 * at, at, 1.0 + 0.0 * at]), (0.0, 5.0, -1.0))
    run = lg.simulate(pushed(push), t1=1.0, num_steps=48, integrator=integrator)
    return lg.Criterion(integrand=lambda s, p: s.body("mass").acceleration[2] ** 2)(run)


@pytest.mark.slow  # three programs
def test_pieces_of_equal_steps_are_two_in_the_rule_of_fourth_order():
    """∫ a² dt of a force that rises to 5 N and falls to −1 N, linearly: of quadratic pieces, without an error."""
    exact = lambda at: (25.0 * at + (1.0 - at) * (25.0 - 5.0 + 1.0)) / 3.0 / 2.0**2
    extrapolated = jax.jit(jax.value_and_grad(lambda at: of_peak(at, lg.Richardson(lg.AlignedSteps()))))
    value, slope = extrapolated(jnp.asarray(0.5))
    np.testing.assert_allclose(value, exact(0.5), rtol=1e-12)  # taken as one piece: 1e-4
    np.testing.assert_allclose(slope, jax.grad(exact)(0.5), rtol=1e-11)


def test_steps_of_one_scene_in_another():
    """With as many breaks steps end at those; with others, they are of the given sizes."""
    first = lg.Ramp(end=1.0, t_start=0.2, duration=0.3)
    run = lg.simulate(pushed(first), t1=1.0, num_steps=50, integrator=lg.AlignedSteps())
    steps = lg.GivenSteps.of(run)
    of = lambda signal: np.asarray(lg.simulate(pushed(signal), t1=2.0, num_steps=50, integrator=steps).t)
    later = of(lg.Ramp(end=1.0, t_start=0.7, duration=0.9))
    for edge in (0.7, 1.6):
        assert np.abs(later - edge).min() < 1e-14 * 50  # of sums of 50 sizes
    np.testing.assert_allclose(of(lg.Harmonic(amplitude=0.1, frequency=1.0)), 2.0 * np.asarray(run.t), rtol=1e-12)


@pytest.mark.parametrize("ends", [[[1.0]], [], [0.5, 0.2, 1.0], [0.5, 0.9], [-0.1, 1.0]])
def test_bad_input(ends):
    with pytest.raises(ValueError, match="GivenSteps: `ends` must"):
        lg.GivenSteps([1.0, 2.0], ends=ends)


def test_bad_breaks():
    with pytest.raises(ValueError, match=r"`breaks` must have shape \(k,\), got \(\)"):
        lg.time_integral(jnp.linspace(0.0, 1.0, 5), jnp.ones(5), order=4, breaks=0.5)
