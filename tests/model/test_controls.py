"""Force elements with states against their equations in minimal coordinates, solved by scipy."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from scipy.integrate import solve_ivp

import lgsens as lg
from lgsens.model import AbstractDynamicLoad, AbstractForce
from lgsens.model._forces import Attached
from lgsens.testing import check_force

ORIGIN, X, G = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 9.81
MASS, ARM, INERTIA = 2.0, 0.5, 0.1  # of the pendulum about its centre
GAINS = jnp.array([60.0, 4.0, 80.0, 0.05, 0.02, 0.4])  # K, D, I, lag, initial integral, amplitude of the target
FREQUENCY, OFFSET = 0.7, 0.3


def arm(p, linear_solver=None, merge_fixed=False, **options):
    """A pendulum that follows an angle; in two parts where these are merged."""
    proportional, derivative, integral, time_constant, initial, amplitude = p
    target = lg.Harmonic(amplitude=amplitude, frequency=FREQUENCY, offset=OFFSET)
    follow = lg.RotationDriver(None, "arm", axis=X, value=target)
    gains = {"proportional": proportional, "derivative": derivative, "integral": integral}
    controller = lg.PIDController(follow, **gains, time_constant=time_constant, initial_integral=initial, **options)
    mass, inertia, joints = MASS, (INERTIA, 0.2, 0.3), {"hinge": lg.RevoluteJoint(None, "arm", at=ORIGIN, axis=X)}
    if merge_fixed:
        mass, inertia = MASS / 2, (INERTIA / 2, 0.1, 0.15)
    bodies = {"arm": lg.RigidBody(mass, inertia, position=(0.0, 0.0, -ARM))}
    if merge_fixed:
        bodies["other"] = bodies["arm"]
        joints["weld"] = lg.FixedJoint("arm", "other", at=ORIGIN)
    forces = {"weight": lg.Gravity((0.0, 0.0, -G)), "pid": controller}
    return lg.Model(bodies, joints, forces, linear_solver=linear_solver, merge_fixed=merge_fixed)


def asked(trajectory):
    """Angular velocity, integral, output and error at the end."""
    states, spin = trajectory.states_of("pid"), trajectory.body("arm").angular_velocity[-1, 0]
    return jnp.stack([spin, states["integral"][-1], states["output"][-1], trajectory.force("pid").error[-1]])


def controlled(p, num_steps, integrator=None, **options):
    return asked(
        lg.simulate(arm(p, **options), t1=0.5, num_steps=num_steps, integrator=integrator or lg.GeneralizedAlpha())
    )


@cache
def exact():
    proportional, derivative, integral, time_constant, initial, amplitude = map(float, GAINS)
    w = 2 * np.pi * FREQUENCY
    target = lambda t: (OFFSET + amplitude * np.sin(w * t), amplitude * w * np.cos(w * t))

    def rates(t, y):
        angle, spin, z, u = y
        e, rate = (wanted - is_ for wanted, is_ in zip(target(t), (angle, spin)))
        command = proportional * e + derivative * rate + integral * z
        weight = MASS * G * ARM * np.sin(angle)
        return [spin, (u - weight) / (INERTIA + MASS * ARM**2), e, (command - u) / time_constant]

    e, rate = target(0.0)
    start = [0.0, 0.0, initial, proportional * e + derivative * rate + integral * initial]
    angle, spin, z, u = solve_ivp(rates, (0.0, 0.5), start, rtol=1e-11, atol=1e-12).y[:, -1]
    return np.array([spin, z, u, target(0.5)[0] - angle])


@pytest.mark.slow  # a lag, a relaxation and states of one's own are in the quick run
def test_controlled_pendulum_is_that_of_its_ode():
    run = jax.jit(controlled, static_argnums=1)
    coarse, fine = (np.abs(run(GAINS, n) - exact()) for n in (50, 100))
    np.testing.assert_allclose(np.log2(coarse / fine), 2.0, atol=0.15)  # of what comes after h²: h = 10 ms on τ = 50 ms
    assert np.all(fine <= 2e-2 * np.abs(exact()) + 1e-3)


@pytest.mark.slow  # `test_any_number_of_states_of_ones_own` has both modes, too
def test_gradients_by_gains_and_initial_states():
    """Both modes agree; differences of step 1e-5 have 1e-10 of third derivatives, and round-off over the step 1e-9."""
    run = lambda p: controlled(p, 20)
    both = jax.jit(lambda p: (run(p), jax.jacfwd(run)(p), jax.jacrev(run)(p)))
    _, forward, reverse = both(GAINS)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-10)
    steps = 1e-5 * np.diag(np.maximum(1.0, np.abs(GAINS)))
    differences = [(both(GAINS + step)[0] - both(GAINS - step)[0]) / (2 * step.max()) for step in steps]
    np.testing.assert_allclose(forward, np.stack(differences, axis=1), rtol=1e-6, atol=1e-6 * np.abs(forward).max())


@pytest.mark.parametrize(
    "how", [pytest.param(how, marks=pytest.mark.slow) for how in ("stabilized", "merged", "index reduced", "sparse")]
)
def test_every_way_to_solve_has_the_same_states(how):
    """Other integrators to their own order, another solver and merged parts to round-off of Newton."""
    integrators = {"stabilized": lg.GeneralizedAlpha(stabilized=True), "index reduced": lg.IndexReducedODE()}
    options = {"sparse": {"linear_solver": lg.BlockSparse()}, "merged": {"merge_fixed": True}}.get(how, {})
    found = jax.jit(lambda p: controlled(p, 100, integrators.get(how), **options))(GAINS)
    if how in integrators:
        np.testing.assert_allclose(found, exact(), rtol=2e-2, atol=1e-3)
    else:
        np.testing.assert_allclose(found, jax.jit(lambda p: controlled(p, 100))(GAINS), rtol=1e-8)


@pytest.mark.slow  # three programs; the pendulum's is in the quick run
def test_integral_holds_what_rests():
    """At rest there is no error, the integral carries the weight, and the motion from there stays."""
    hold = 0.3

    scene = lambda integral: arm(GAINS.at[5].set(0.0).at[2].set(integral))  # the target is the offset
    moment = MASS * G * ARM * np.sin(hold)

    places = scene(80.0).system().places_of_states()["pid"]
    rest = lambda integral: lg.equilibrium(scene(integral)).v[np.array([places["integral"], places["output"]])]
    states, slope = jax.jit(lambda integral: (rest(integral), jax.jacfwd(rest)(integral)))(80.0)
    np.testing.assert_allclose(states, [moment / 80.0, moment], rtol=1e-8)
    np.testing.assert_allclose(slope, [-moment / 80.0**2, 0.0], rtol=1e-8, atol=1e-8)


@pytest.mark.slow  # a program more
def test_motion_goes_on_at_rest():
    scene = arm(GAINS.at[5].set(0.0).at[2].set(80.0))
    trajectory = lg.simulate(scene, t1=0.1, num_steps=5, state0=lg.equilibrium(scene))
    np.testing.assert_allclose(trajectory.force("pid").error, 0.0, atol=1e-9)  # Newton's tolerance


def slider(command, time_constant, **options):
    """A mass on rails along x, pushed."""
    along = lg.TranslationDriver(None, "mass", at=ORIGIN, axis=X)
    push = lg.Actuator(along, command=command, time_constant=time_constant, **options)
    mass = lg.RigidBody(MASS, None, free=("x",))
    return lg.Model({"mass": mass}, {}, {"push": push})


def test_lag_is_that_of_the_closed_form():
    """u = u_c + (u_0 − u_c) exp(−t/τ) and its double integral over the mass, whatever the size of the force."""

    def motion(command, initial):
        trajectory = lg.simulate(slider(command, 0.2, initial=initial), t1=1.0, num_steps=100)
        return trajectory.body("mass").position[-1, 0], trajectory.states_of("push")["output"][-1]

    t, tau, begun = 1.0, 0.2, -0.5
    decay = np.exp(-t / tau)
    for size in (1.0, 1e6):
        position, output = jax.jit(motion)(size, begun * size)
        np.testing.assert_allclose(output, size * (1.0 + (begun - 1.0) * decay), rtol=2e-4)  # (h/τ)²/12 t/τ of decay
        expected = t**2 / 2 + (begun - 1.0) * (tau * t - tau**2 * (1.0 - decay))
        np.testing.assert_allclose(position, size * expected / MASS, rtol=2e-3)  # (h/τ)²
    np.testing.assert_allclose(lg.initial_state(slider(3.0, 0.2)).v[-1], 3.0)  # in equilibrium with its command


def test_outputs_are_measured_by_their_commands():
    """What steps under error control take for a large change of the output, [N]."""
    ramp = lg.Ramp(end=-7e3, start=0.0, duration=2.0, t_start=5.0)
    size = lambda command, **more: float(slider(command, 0.2, **more).system().coordinate_scale()[-1])
    assert size(-3.0) == 3.0
    assert size(0.0) == 1.0  # nothing is known
    assert size(3.0, initial=-40.0) == 40.0
    assert size(ramp) == 7e3
    for amplitude in (1e-3, 2e4):
        np.testing.assert_allclose(size(lg.Harmonic(amplitude=amplitude, frequency=0.8)), amplitude, rtol=0.02)


@pytest.mark.slow
def test_relaxation_under_a_held_length_is_exponential():
    """Of a spring whose damper creeps, stretched and held: F = F_0 exp(−k t/c)."""
    k, c, stretch = 100.0, 20.0, 0.1
    spring = lg.MaxwellElement(None, "mass", at_a=(-1.0, 0.0, 0.0), at_b=ORIGIN, stiffness=k, damping=c, initial=0.9)
    hold = lg.TranslationDriver(None, "mass", at=ORIGIN, axis=X, value=lg.Constant(value=0.0))
    model = lg.Model({"mass": lg.RigidBody(MASS, None, free=("x", "y"))}, {"hold": hold}, {"spring": spring})
    trajectory = lg.simulate(model, t1=0.4, num_steps=80)
    line = trajectory.force("spring")
    exact = k * stretch * np.exp(-k / c * trajectory.t)
    np.testing.assert_allclose(line.tension, exact, atol=5e-4 * k * stretch)  # (h k/c)²
    np.testing.assert_allclose(trajectory.states_of("spring")["free_length"], 1.0 - exact / k, atol=5e-5)
    np.testing.assert_allclose(trajectory.multiplier("hold")[:, 0], -line.tension, rtol=1e-8)


class Ladder(AbstractDynamicLoad):
    """Four lags one after the other, the first of a constant, and the last one pushes along x."""

    rates: jax.Array
    states = ("first", "second", "third", "last")

    def force(self, a, b, va, vb, t, z):
        return jnp.zeros(12, z.dtype).at[6].set(z[3])

    def rate(self, a, b, va, vb, t, z):
        return self.rates * (jnp.concatenate([jnp.ones(1, z.dtype), z[:3]]) - z)

    def initial(self, a, b, va, vb, t):
        return jnp.zeros(4, self.rates.dtype)


class Push(AbstractForce):
    rates: jax.Array
    bodies = (None, "mass")

    def loads(self, bodies):
        return (Attached(Ladder(self.rates), None, "mass"),)


@pytest.mark.slow
def test_any_number_of_states_of_ones_own():
    """Four lags of rate 1/τ: z_n = 1 − e^{−x} Σ_{i<n} x^i/i! with x = t/τ; and both modes agree."""

    def states(rate):
        model = lg.Model({"mass": lg.RigidBody(MASS, None, free="x")}, {}, {"push": Push(jnp.full(4, rate))})
        trajectory = lg.simulate(model, t1=1.0, num_steps=50)
        found = jnp.stack([z[-1] for z in trajectory.states_of("push").values()])
        return found, found

    x = 3.0
    series = np.cumsum([1.0, x, x**2 / 2, x**3 / 6])
    modes = [mode(states, has_aux=True) for mode in (jax.jacfwd, jax.jacrev)]
    (forward, value), (reverse, _) = jax.jit(lambda x: [derivative(x) for derivative in modes])(x)
    np.testing.assert_allclose(value, 1.0 - np.exp(-x) * series, atol=2e-3)  # (x h)² t/τ
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    np.testing.assert_allclose(forward, np.exp(-x) * np.array([1.0, x, x**2 / 2, x**3 / 6]), atol=5e-3)


@pytest.mark.parametrize(
    "force",
    [
        lg.PIDController(
            lg.TranslationDriver(
                "a", "b", at=(0.1, 0.2, 0.3), axis=(1.0, 2.0, 0.5), value=lg.Harmonic(amplitude=0.1, frequency=1.0)
            ),
            proportional=3.0,
            derivative=2.0,
            integral=1.5,
            time_constant=0.3,
        ),
        pytest.param(
            lg.PIDController(lg.RotationDriver("a", "b", axis=X), proportional=3.0, derivative=2.0),
            marks=pytest.mark.slow,
        ),
        lg.MaxwellElement("a", "b", at_a=ORIGIN, at_b=(0.5, 0.2, 0.9), stiffness=3.0, damping=0.5),
    ],
)
def test_forces_are_what_they_say(force):
    report = check_force(force)
    assert report, report


def test_summary_and_bad_input():
    model = arm(GAINS)
    assert model.summary().degrees_of_freedom == 1
    assert "States of forces" in str(model.summary())
    assert lg.constraint_rank(model).degrees_of_freedom == 1
    driver = lg.RotationDriver(None, "arm", axis=X)
    with pytest.raises(ValueError, match=says("Actuator: `time_constant` must be positive, got 0.0")):
        lg.Actuator(driver, command=1.0, time_constant=0.0)
    with pytest.raises(ValueError, match=says("Actuator: `command` is missing")):
        lg.Actuator(driver, time_constant=0.1)
    with pytest.raises(ValueError, match=says("`along` must be a RotationDriver, TranslationDriver or DistanceJoint")):
        lg.PIDController("arm", proportional=1.0)
    joint = lg.RevoluteJoint(None, "arm", at=ORIGIN, axis=X)
    body = {"arm": lg.RigidBody(1.0, (1.0, 1.0, 1.0))}
    with pytest.raises(ValueError, match=says("`along` must be a joint of one equation of position")):
        lg.Model(body, {}, {"pid": lg.PIDController(joint, proportional=1.0, integral=1.0)}).system()
    with pytest.raises(ValueError, match=says("MaxwellElement: `damping` must be positive")):
        lg.MaxwellElement(None, "arm", at_a=ORIGIN, at_b=X, stiffness=1.0, damping=-1.0)
    trajectory = lg.simulate(lg.Model({"arm": lg.RigidBody(1.0, None, free="z")}), t1=0.1, num_steps=1)
    with pytest.raises(ValueError, match=says("`states_of`: 'pid' is not one of []")):
        trajectory.states_of("pid")
    driven = lg.Model(model.bodies, {**model.joints, "turn": lg.RotationDriver(None, "arm", axis=X)}, model.forces)
    with pytest.raises(ValueError, match=says("the force elements ['pid'] have states")):
        lg.kinematics(driven, {"turn": [0.0]})


@pytest.mark.slow  # others of controls are in the quick run
def test_along_a_rod_forces_and_errors_are_those_of_its_length():
    """A mass of 1 kg a metre from the foot of a rod, pushed by 2 N for a second to a distance of 2 m; and what holds it
    half a metre farther: the force is K e, e the difference of lengths, wherever it is."""
    mass = lambda force: lg.Model({"mass": lg.RigidBody(1.0, None, free="x")}, {}, {"force": force})
    rod = lambda length: lg.DistanceJoint(None, "mass", at_a=(-1.0, 0.0, 0.0), at_b=(0.0, 0.0, 0.0), length=length)
    push = lg.Actuator(along=rod(None), command=2.0, time_constant=0.01)
    pushed = lg.simulate(mass(push), t1=1.0, num_steps=20)
    np.testing.assert_allclose(pushed.body("mass").position[:, 0], np.asarray(pushed.t) ** 2, atol=1e-12)  # round-off
    held = lg.PIDController(along=rod(1.5), proportional=4.0, derivative=0.0)
    run = lg.simulate(mass(held), t1=3.0, num_steps=600)
    expected = 0.5 * (1.0 - np.cos(2.0 * np.asarray(run.t)))
    np.testing.assert_allclose(run.body("mass").position[:, 0], expected, atol=2e-4)  # (ω h)²/12 of ω t
    np.testing.assert_allclose(run.force("force").output, run.body("mass").acceleration[:, 0], atol=1e-9)
