"""What combines with what: seventeen features with nine integrators, each against forward mode on the same steps.

DESIGN: scheme, grid, output, sensitivity and linear solver are separate values. What is refused is refused by the
mathematics, and the message says so. All of them run with `pytest -m slow`, the first one and what is refused always.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg
from lgsens.examples import spinning_top

STEPS, T1 = 24, 0.12
FRACTIONS = 1.0 + 0.3 * np.sin(np.arange(STEPS) / 4.0)
ALPHA = lg.GeneralizedAlpha(0.9, tolerance=1e-12)
STABILIZED = lg.GeneralizedAlpha(0.9, stabilized=True, tolerance=1e-12)
INTEGRATORS = {
    "plain": ALPHA,
    "fixed iterations": lg.GeneralizedAlpha(0.9, iterations=5, factor_every=0),
    "full Newton": lg.GeneralizedAlpha(0.9, factor_every=0, tolerance=1e-12),
    "stabilized": STABILIZED,
    "Richardson": lg.Richardson(ALPHA),
    "adaptive": lg.AdaptiveSteps(ALPHA, tolerance=1e-5, longest=0.1),
    "given": lg.GivenSteps(FRACTIONS, ALPHA),
    "given, stabilized": lg.GivenSteps(FRACTIONS, STABILIZED),
    "index-reduced": lg.IndexReducedODE(),
}
P = jnp.array([0.7, 1.0])  # angle, length


def top(p):
    return spinning_top(p[0], length=p[1])


def height(s, p=None):
    return 10.0 * s.body("top").position[2]


CRITERION = lg.Criterion(integrand=height)


def psi(p, integrator, build=top, **settings):
    """∫ z dt by the rule of the trajectory."""
    run = lg.simulate(build(p), t1=T1, num_steps=STEPS, integrator=integrator, throw=False, **settings)
    return CRITERION(run) if "save" not in settings else lg.time_integral(run.t, run.values)


@functools.cache
def reference(name, build=top):
    """Ψ and its gradient in forward mode."""
    f = lambda p: psi(p, INTEGRATORS[name], build)
    return jax.jit(f)(P), jax.jit(jax.jacfwd(f))(P)


def agrees(name, value, gradient, tolerance=1e-8, build=top):
    expected = reference(name, build)
    np.testing.assert_allclose(value, expected[0], rtol=tolerance)
    np.testing.assert_allclose(gradient, expected[1], rtol=0, atol=tolerance * np.abs(expected[1]).max())


def direct(name):
    """Forward mode against central differences of the run on its own grid: δ² = 1e-8, and round-off."""
    integrator = INTEGRATORS[name]
    if isinstance(integrator, lg.AdaptiveSteps):  # whose sizes are constants of the derivative
        run = lg.simulate(top(P), t1=T1, num_steps=STEPS, integrator=integrator)
        integrator = lg.GivenSteps.of(run, ALPHA)
        f = lambda p: CRITERION(
            lg.simulate(top(p), t1=T1, num_steps=integrator.num_steps, integrator=integrator, throw=False)
        )
    else:
        f = lambda p: psi(p, integrator)
    f = jax.jit(f)
    slopes = [(f(P + 1e-4 * e) - f(P - 1e-4 * e)) / 2e-4 for e in jnp.eye(2)]
    np.testing.assert_allclose(reference(name)[1], slopes, rtol=0, atol=1e-6 * np.abs(slopes).max())


def adjoint(name):
    f = lambda p: psi(p, INTEGRATORS[name], sensitivity=lg.AdjointVariable())
    agrees(name, *jax.jit(jax.value_and_grad(f))(P))


def at_once(name):
    f = lambda p: psi(p, INTEGRATORS[name], sensitivity=lg.AssociativeScan())
    agrees(name, *jax.jit(jax.value_and_grad(f))(P))


def saved(name):
    """Samples only, so by the trapezoidal rule: in both modes alike, and near the criterion."""
    f = lambda p: psi(p, INTEGRATORS[name], save=height)
    (value, slope), forward = jax.jit(lambda p: (jax.value_and_grad(f)(p), jax.jacfwd(f)(p)))(P)
    np.testing.assert_allclose(slope, forward, rtol=0, atol=1e-8 * np.abs(forward).max())
    agrees(name, value, slope, 1e-2)  # the rules differ by h²


def checkpoints(name):
    f = lambda p, method: psi(p, INTEGRATORS[name], save=height, sensitivity=method)
    kept, all_states = (
        jax.jit(jax.value_and_grad(lambda p, m=m: f(p, m)))(P)
        for m in (lg.AdjointVariable(checkpoints="sqrt"), lg.AdjointVariable())
    )
    np.testing.assert_allclose(kept[0], all_states[0], rtol=1e-10)
    np.testing.assert_allclose(kept[1], all_states[1], rtol=0, atol=1e-8 * np.abs(all_states[1]).max())


def differentiated(name, method, tolerance):
    found = lg.differentiate(CRITERION, top, P, t1=T1, num_steps=STEPS, integrator=INTEGRATORS[name], method=method)
    agrees(name, found.value, found.gradient, tolerance)


def door(p):
    """Two hinges on one axis: five equations too many, for any angle and length."""
    body = lg.RigidBody(mass=2.0, inertia=(0.3, 0.2, 0.4), position=p[1] * jnp.array([jnp.sin(p[0]), 0.0, -0.7]))
    y = jnp.array([0.0, 1.0, 0.0])
    hinges = {n: lg.RevoluteJoint(None, "top", at=at * y, axis=y) for n, at in (("left", -0.3), ("right", 0.3))}
    gravity = {"gravity": lg.Gravity(jnp.array([0.0, 0.0, -9.81]))}
    return lg.Model({"top": body}, hinges, gravity, redundant="minimum_norm")


def minimum_norm(name):
    f = lambda p: psi(p, INTEGRATORS[name], door)
    agrees(name, *jax.jit(jax.value_and_grad(f))(P), build=door)
    hinge = lambda p: _one_hinge(door(p))
    value, _ = reference(name, door)
    np.testing.assert_allclose(value, jax.jit(lambda p: psi(p, INTEGRATORS[name], hinge))(P), rtol=1e-6)  # ε of 1e-7


def _one_hinge(model):
    return lg.Model(model.bodies, {"left": model.joints["left"]}, model.forces)


def chain(p, solver=None):
    """Two links on ball joints."""
    z = jnp.array([0.0, 0.0, 1.0])
    link = lambda at: lg.RigidBody(mass=2.0, inertia=(0.3, 0.2, 0.4), position=at, angular_velocity=(0.0, p[0], 0.0))
    bodies = {"top": link(-p[1] * z), "tip": link(-3.0 * p[1] * z)}
    joints = {
        "pivot": lg.SphericalJoint(None, "top", at=jnp.zeros(3)),
        "middle": lg.SphericalJoint("top", "tip", at=-2.0 * p[1] * z),
    }
    return lg.Model(bodies, joints, {"gravity": lg.Gravity(-9.81 * z)}, linear_solver=solver)


def blocks(name):
    f = lambda p: psi(p, INTEGRATORS[name], functools.partial(chain, solver=lg.BlockSparse()))
    agrees(name, *jax.jit(jax.value_and_grad(f))(P), build=chain)


def growth(name):
    """Of a top over a tenth of a second: that of a regular motion, about one."""
    found = lg.sensitivity_growth(top(P), t1=T1, num_steps=STEPS, integrator=INTEGRATORS[name])
    assert found.factor.shape == found.t.shape and not bool(found.exponential)
    assert 1.0 <= float(found.factor[-1]) < 20.0


@functools.cache
def exact():
    """The position at the end, by explicit steps of order 8."""
    order_8 = lg.IndexReducedODE(diffrax.Dopri8())
    return lg.simulate(top(P), t1=T1, num_steps=STEPS, integrator=order_8).body("top").position[-1]


def estimate(name):
    """It is the error, but for a part that falls with the step."""
    integrator = INTEGRATORS[name]
    run = lg.simulate(top(P), t1=T1, num_steps=STEPS, integrator=integrator)
    error = lg.accuracy.error_estimate(run, integrator)
    left = np.abs(exact() - run.body("top").position[-1]).max()
    if isinstance(integrator, lg.Richardson):
        assert left < np.abs(error.w).max()
    else:
        corrected = lg.accuracy.corrected(run, error).body("top").position[-1]
        assert np.abs(exact() - corrected).max() < 0.2 * left


FEATURES = {
    "direct": direct,
    "adjoint": adjoint,
    "all steps at once": at_once,
    "save": saved,
    "checkpoints": checkpoints,
    # the continuous methods differ from the derivative of the run by h²
    **{
        f"differentiate by {type(method).__name__}": functools.partial(differentiated, method=method, tolerance=bound)
        for method, bound in (
            (lg.DirectDifferentiation(), 1e-8),
            (lg.AdjointVariable(), 1e-8),
            (lg.AssociativeScan(), 1e-8),
            (lg.ContinuousDirect(), 5e-3),
            (lg.ContinuousAdjoint(), 5e-3),
            (lg.Autodiff(), 1e-6),
            (lg.FiniteDifferences(), 1e-6),
            (lg.IndexReduced(rtol=1e-9, atol=1e-9), 5e-3),
        )
    },
    "minimum norm": minimum_norm,
    "blocks": blocks,
    "growth": growth,
    "error estimate": estimate,
}
REFUSED = {
    ("minimum norm", "stabilized"): says("independent constraints", "redundant='minimum_norm'"),
    ("minimum norm", "given, stabilized"): says("independent constraints", "redundant='minimum_norm'"),
    ("differentiate by ContinuousAdjoint", "adaptive"): says("backwards from t1", "GivenSteps.of(trajectory)"),
}
ALL = [(feature, name) for feature in FEATURES for name in INTEGRATORS]
assert len(ALL) == 153


@pytest.mark.parametrize(
    ("feature", "name"),
    [pytest.param(*pair, marks=[] if pair in (ALL[0], *REFUSED) else pytest.mark.slow) for pair in ALL],
)
def test_combination(feature, name):
    refusal = REFUSED.get((feature, name))
    if refusal is None:
        FEATURES[feature](name)
    else:
        with pytest.raises(ValueError, match=refusal):
            FEATURES[feature](name)
