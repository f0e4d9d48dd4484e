"""Behind a break of a driver steps begin anew: forces there, their order, and derivatives through it."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from helpers import says, some_quick
from jaxtyping import Array, Float

import lgsens as lg
from lgsens.dynamics import Breaking, autodiff_tangents
from lgsens.liegroups import Rn

MASS, T1 = 5.0, 2.0
SAMPLES = np.linspace(0.0, T1, 21)
SIGNALS = {
    "ramp": lg.Ramp(end=1.0, t_start=0.2137, duration=1.1),
    "ramp from t0": lg.Ramp(end=1.0, duration=1.1),
    "cubic": lg.Sampled(SAMPLES, 0.3 * np.sin(3.0 * SAMPLES) ** 2, kind="cubic"),
    "monotone": lg.Sampled(SAMPLES, 0.3 * np.sin(3.0 * SAMPLES) ** 2, kind="monotone"),
}
SCHEMES = {
    "equal": lg.GeneralizedAlpha(),
    "aligned": lg.AlignedSteps(),
    "stabilized": lg.AlignedSteps(lg.GeneralizedAlpha(stabilized=True)),
    "adaptive": lg.AdaptiveSteps(tolerance=1e-6),
}


def driven(signal, formulation="R3xSO3"):
    """A body on a rail, moved by a driver; it may move across, too."""
    driver = lg.TranslationDriver(None, "body", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), value=signal)
    body = lg.RigidBody(MASS, None, free="x y")
    return lg.Model({"body": body}, {"driver": driver}, formulation=formulation)


@functools.cache
def errors(signal, integrator, num_steps, formulation="R3xSO3"):
    """Of the driver's force against m s̈, relative to the largest, and which steps end behind a break in them."""
    signal = SIGNALS[signal]
    run = lg.simulate(driven(signal, formulation), t1=T1, num_steps=num_steps, integrator=SCHEMES[integrator])
    t, force = np.asarray(run.t), np.asarray(run.joint("driver").axial_force)
    exact = MASS * np.asarray(jax.vmap(jax.grad(jax.grad(signal)))(run.t))
    within = np.zeros(t.size, bool)
    for at in np.asarray(signal.breaks):
        within[1:] |= (t[:-1] < at + 1e-9) & (at - 1e-9 < t[1:])
    taken = np.append(True, np.diff(t) > 0.0)
    off = np.minimum(np.abs(force - exact), np.abs(force + exact)) / np.abs(exact).max()
    return off[taken], within[taken]


@pytest.mark.slow  # samples, below, are in the quick run
@pytest.mark.parametrize("integrator", ["aligned", "equal", "stabilized"])
def test_forces_on_a_ramp_are_of_second_order(integrator):
    (coarse, within), (fine, also_within) = errors("ramp", integrator, 75), errors("ramp", integrator, 150)
    assert coarse[~within].max() < 1.5e-2  # (h/T)² of a polynomial whose fourth derivative is 60 times the second
    np.testing.assert_allclose(coarse[~within].max() / fine[~also_within].max(), 4.0, rtol=0.2)  # the order, and h³
    if integrator != "equal":  # no step has a break in it
        assert coarse.max() < 1.5e-2


@pytest.mark.slow  # `test_behind_samples_forces_are_exact` is in the quick run
def test_a_ramp_may_begin_at_t0():
    off, within = errors("ramp from t0", "equal", 75)
    assert off[~within].max() < 1.5e-2  # first order: 0.2


@pytest.mark.slow  # samples, below, are in the quick run
def test_error_control_sees_it():
    off, _ = errors("ramp", "adaptive", 400)
    assert off.max() < 3e-3  # tolerance^(2/3) = 1e-4, times what s⁗ T² is of s̈, 30; first order: 0.1


@pytest.mark.parametrize(
    ("signal", "integrator", "formulation"),
    some_quick(
        [
            ("cubic", "equal", "R3xSO3"),
            ("cubic", "equal", "SE3"),
            ("monotone", "equal", "R3xSO3"),
            ("cubic", "aligned", "R3xSO3"),
        ]
    ),
)
def test_behind_samples_forces_are_exact(signal, integrator, formulation):
    """Between samples of a cubic the third derivative is constant, and the scheme has no error of v̇."""
    off, within = errors(signal, integrator, 130, formulation)
    # what behind is behind a break, 1.5e-8 h, times v̈/v̇ = 1/h at most; no aligned step has a break in it
    assert (off if integrator == "aligned" else off[~within]).max() < 1e-8


class Towed(lg.AbstractSystem):
    """A mass on a rail that follows a ramp, and another one on a spring behind it: programs that compile fast."""

    ramp: lg.Ramp
    load: Float[Array, ""]
    assembled: bool = eqx.field(static=True, default=True)

    @property
    def group(self):
        return Rn(2)

    @property
    def constraint_names(self):
        return ("ramp",)

    @property
    def breaking(self):
        return Breaking(self.ramp.breaks, self.constraint)

    def reference(self):
        return jnp.zeros(2), jnp.zeros(2)

    def coordinate_scale(self):
        return jnp.ones(2)

    def mass_matrix(self):
        return jnp.diag(jnp.stack([jnp.full_like(self.load, MASS), self.load]))

    def residual(self, q, v, vdot, lam, t):
        pull = 200.0 * (q[1] - q[0]) + 300.0 * (q[1] - q[0]) ** 3
        return self.mass_matrix() @ vdot + jnp.stack([lam[0] - pull, pull])

    def constraint(self, q, t):
        return (q[0] - self.ramp(t))[None]

    def constraint_jacobian(self, q, t):
        return jnp.array([[1.0, 0.0]])

    def tangents(self, q, v, vdot, lam, t):
        return autodiff_tangents(self, q, v, vdot, lam, t)


def towed(p):
    return Towed(lg.Ramp(end=p[0], t_start=p[1], duration=p[2]), p[3])


def psi(p, integrator, sensitivity, num_steps=24):
    settings = {"t0": p[4], "t1": p[5], "num_steps": num_steps, "integrator": integrator, "sensitivity": sensitivity}
    run = lg.simulate(towed(p), save=lambda instant: instant.state.lam[0], **settings)
    return lg.time_integral(run.t, run.values**2)


P = jnp.array(
    [1.0, 0.2137, 0.51, 2.0, 0.0, 0.9]
)  # of the scene, t0 and t1: steps of 37.5 ms: breaks at 5.70 and 19.30 of them
EXTRAPOLATED = lg.Richardson(SCHEMES["aligned"])
GIVEN = lg.GivenSteps(1.0 + 0.3 * np.sin(np.arange(24.0)))
GRIDS = SCHEMES | {"given": GIVEN, "extrapolated": EXTRAPOLATED}


@pytest.mark.slow  # `test_moving_steps` has derivatives by such times in the quick run
@pytest.mark.parametrize("name", GRIDS)
def test_derivatives_through_it_are_exact(name):
    """Where breaks lie inside of steps by times of ramp and run, too; where steps end at them, by what moves none."""
    integrator, n = GRIDS[name], 400 if name == "adaptive" else 24
    reverse = jax.jit(jax.value_and_grad(lambda p: psi(p, integrator, lg.AdjointVariable(), n)))
    gradient = reverse(P)[1]
    forward = jax.jit(jax.jacfwd(lambda p: psi(p, integrator, lg.DirectDifferentiation(), n)))(P)
    # other order of round-off; those by times cancel, as nothing happens when all of them move
    np.testing.assert_allclose(gradient, forward, rtol=1e-9, atol=1e-10 * np.abs(forward).max())
    grid = integrator.frozen(lg.simulate(towed(P), t1=0.9, num_steps=n, integrator=integrator))
    if grid is not integrator:
        n = grid.num_steps
        reverse = jax.jit(jax.value_and_grad(lambda p: psi(p, grid, lg.AdjointVariable(), n)))
    moved = range(6) if name in ("equal", "given") else (0, 3)
    slopes = [central(lambda s, e=e: reverse(P + s * e)[0], 1e-3) for e in np.eye(6)[list(moved)]]
    # differences: δ⁶ = 1e-18 × seventh derivative, round-off of forces of 1e-12 over 1e-3
    np.testing.assert_allclose(gradient[jnp.array(moved)], slopes, rtol=1e-7)


@pytest.mark.slow  # the step of parts is that of the whole, by one grid
def test_parts_of_a_run_begin_anew_as_the_whole_does():
    of = lambda sensitivity: jax.jit(jax.grad(lambda p: psi(p, SCHEMES["equal"], sensitivity)))(P)
    whole, parts = of(lg.AdjointVariable()), of(lg.AdjointVariable(checkpoints=5))
    np.testing.assert_allclose(parts, whole, rtol=1e-10)  # other order of round-off


def test_the_error_of_such_a_run_can_be_estimated():
    """Its a and v̇ do not belong together where a step begins anew, and it is a run of the scheme even so."""
    run = lg.simulate(towed(P), t1=0.9, num_steps=24)
    assert np.isfinite(lg.accuracy.error_estimate(run).w).all()


SQUARE = lg.Criterion(integrand=lambda s, p: s.joint("driver").axial_force ** 2)


def on_a_ramp(p):
    return driven(lg.Ramp(end=p["end"], t_start=0.2, duration=p["duration"]))


@pytest.mark.slow
def test_certificates_tell_the_errors_of_such_a_run():
    """∫ s̈² dt = 120/7 d²/T³ with both ends of the ramp at those of steps."""
    found = lg.certify(SQUARE, on_a_ramp, {"end": 1.0, "duration": 1.0}, t1=1.5, num_steps=75)
    exact = MASS**2 * 120.0 / 7.0
    np.testing.assert_allclose(found.value_error, exact - found.value, rtol=0.05)  # of errors of order h², h³
    wrong = {"end": 2.0 * exact - found.gradient["end"], "duration": -3.0 * exact - found.gradient["duration"]}
    for name, error in wrong.items():
        # the second end of the ramp moves with its duration, of which the derivative is of first order
        np.testing.assert_allclose(found.gradient_error[name], error, rtol=0.05 if name == "end" else 1.0, err_msg=name)


def test_steps_for_such_a_criterion_are_refused():
    with pytest.raises(ValueError, match=says("no driver breaks", "AlignedSteps")):
        lg.steps_for(SQUARE, on_a_ramp, {"end": 1.0, "duration": 1.0}, t1=1.5, pilot=75, num_steps=60)


def test_pieces_of_steps_of_other_sizes_keep_the_order():
    """A driven pendulum, whose hinge has an offset of velocities, too: what does not break has the new size at once."""
    swung = lg.Sampled(SAMPLES, 0.3 * np.sin(3.0 * SAMPLES) ** 2, kind="cubic")
    arm, inertia, axis = 0.5, 0.6, (0.0, 1.0, 0.0)  # the latter about the hinge
    body = lg.RigidBody(MASS, (inertia - MASS * arm**2 / 4,) * 3, position=(0.0, 0.0, -arm / 2), free="x z ry")
    joints = {
        "hinge": lg.SphericalJoint(None, "body", at=(0.0, 0.0, 0.0)),
        "motor": lg.RotationDriver(None, "body", axis=axis, value=swung),
    }
    model = lg.Model({"body": body}, joints, {"weight": lg.Gravity((0.0, 0.0, -9.81))})

    def error(counts):
        sizes = np.concatenate([np.full(count, 0.1 / count) for count in np.tile(counts, SAMPLES.size // 2)])
        run = lg.simulate(model, t1=T1, num_steps=sizes.size, integrator=lg.GivenSteps(sizes))
        angle, rates = jax.vmap(swung)(run.t), jax.vmap(jax.grad(jax.grad(swung)))(run.t)
        exact = inertia * rates + MASS * 9.81 * arm / 2 * jnp.sin(angle)
        return float(jnp.abs(run.joint("motor").axial_moment - exact).max())

    # (3/2)² of what equal steps leave, whose sizes are between; first order: 17 times
    assert error([4, 6]) < 2.25 * error([5, 5])


def test_joints_follow_accelerations_that_jump():
    """An arm whose driver's acceleration jumps: its hinge carries m r θ̇² along it, of second order too."""
    at, turned, arm = np.linspace(0.0, 1.0, 5), np.array([0.0, 0.3, 1.2, 1.6, 3.0]), 0.4
    signal, axis = lg.Sampled(at, turned, kind="monotone"), (0.0, 0.0, 1.0)
    joints = {
        "hinge": lg.SphericalJoint(None, "body", at=(0.0, 0.0, 0.0)),
        "motor": lg.RotationDriver(None, "body", axis=axis, value=signal),
    }
    body = lg.RigidBody(MASS, (0.07,) * 3, position=(arm, 0.0, 0.0), free="x y rz")
    model = lg.Model({"body": body}, joints)

    def error(num_steps):
        run = lg.simulate(model, t1=1.0, num_steps=num_steps, integrator=lg.AlignedSteps())
        along = run.body("body").orientation[:, :, 0]
        radial = jnp.sum(run.body("body").acceleration * along, axis=1)
        rates = jax.vmap(jax.grad(signal))(run.t)
        return float(jnp.abs(radial + arm * rates**2).max())

    coarse, fine = error(64), error(128)
    assert 3.5 < coarse / fine < 6.0  # 4 of the order, and h³; first order: 2
    assert coarse < 0.01 * arm * 7.6**2  # of the largest; first order: 0.14
