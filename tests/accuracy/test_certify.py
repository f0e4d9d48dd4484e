"""Certificates against errors that are known otherwise, and what has to be named in them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from helpers import says
from jaxtyping import Array, Float
from oscillator import CRITERION, T1, P, build, exact
from scipy.linalg import expm

import lgsens as lg
from lgsens.accuracy import certify
from lgsens.criteria import jumps_of, kinks, roughness
from lgsens.examples import linear_quarter_car
from lgsens.linear import tuned

HEIGHT = lg.Criterion(terminal=lambda s, p: s.body("mass").position[2])
BOTH = {"squares": CRITERION, "end": HEIGHT}


@pytest.fixture(scope="module")
def oscillator():
    return certify(CRITERION, build, P, t1=T1, num_steps=100)


def test_errors_are_those_of_the_closed_form(oscillator):
    """To the next term of their expansion, O(ωh) of them; ωh = 0.045 here."""
    p = jax.tree.map(jnp.asarray, P)
    value, gradient = jax.value_and_grad(exact)(p)
    np.testing.assert_allclose(oscillator.value_error, value - oscillator.value, rtol=0.1)
    for name in p:
        error = gradient[name] - oscillator.gradient[name]
        np.testing.assert_allclose(oscillator.gradient_error[name], error, rtol=0.1)
    assert oscillator.duality < 1e-10  # round-off of a hundred steps
    assert abs(oscillator.newton) < 1e-10 * abs(value)
    assert not oscillator.warnings


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [lg.IndexReducedODE(), lg.RadauIIA(), lg.GeneralizedAlpha(stabilized=True)])
def test_of_other_schemes(integrator):
    """By a second run; to the next term again, O(ω²h²) with ωh = 0.45."""
    found = certify(CRITERION, build, P, t1=T1, num_steps=10, integrator=integrator)
    p = jax.tree.map(jnp.asarray, P)
    value, gradient = jax.value_and_grad(exact)(p)
    np.testing.assert_allclose(found.value_error, value - found.value, rtol=0.1)
    for name in p:
        np.testing.assert_allclose(found.gradient_error[name], gradient[name] - found.gradient[name], rtol=0.1)
    assert found.duality < 1e-10 and not found.kinks


def test_it_says_how_many_digits_and_what_to_do(oscillator):
    of_value, of_gradient = oscillator.relative
    assert f"{-np.log10(of_value):.1f} digits" in str(oscillator)
    assert oscillator.good == (max(of_value, of_gradient) <= 1e-3)
    strict = oscillator._replace(tolerance=max(of_value, of_gradient) / 4.0)
    assert "take 2 times as many steps" in str(strict)
    assert not strict.good
    assert strict._replace(tolerance=0.5).good
    coarse = strict._replace(value_error=0.2 * strict.value)  # the leading term says little of such
    assert "take at least" in str(coarse)


def test_round_off_of_single_precision_is_no_fault_of_elements(oscillator):
    """Nor of Newton's iteration; what is far below the tolerance is as good as any."""
    value = np.float32(oscillator.value)
    single = oscillator._replace(value=value, duality=1e-2, newton=0.1 * value, tolerance=1e-2)
    assert len(single.warnings) == 2
    assert all("round-off of single precision" in warning for warning in single.warnings)
    assert not single._replace(duality=1e-5, newton=1e-5 * value).warnings
    double = single._replace(value=oscillator.value)
    assert "a rule of an element" in double.warnings[0] and "a smaller `tolerance`" in double.warnings[1]


@pytest.mark.slow
def test_certificates_share_the_motion(compiled):
    """Another criterion compiles none."""
    certify(CRITERION, build, P, t1=T1, num_steps=100)  # now: JAX keeps 4096 programs, and forgets a fixture's
    names, _ = compiled(lambda: [certify(HEIGHT, build, P, t1=T1, num_steps=100)._asdict()])
    assert "_certified" in names and "known_motion" not in names


@pytest.mark.slow  # all programs anew; `test_known_run.py` compares the sweeps in the quick run
def test_certificates_need_no_memory(oscillator, monkeypatch):
    """Without room for the steps each sweep linearizes for itself."""
    monkeypatch.setattr(tuned, "KEPT_NUMBERS", 0)
    jax.clear_caches()  # the limit is no argument
    plain = certify(CRITERION, build, P, t1=T1, num_steps=100)
    for name in ("value", "gradient", "value_error", "gradient_error", "growth"):
        for kept, own in zip(*map(jax.tree.leaves, (getattr(oscillator, name), getattr(plain, name)))):
            np.testing.assert_allclose(kept, own, rtol=1e-9)  # round-off of a hundred steps in another order


@pytest.mark.slow  # programs of two runs; `certify` is in the quick run
def test_differentiate_has_a_certificate_of_each_criterion(oscillator):
    settings = {"t1": T1, "num_steps": 100, "certificate": True}
    found = lg.differentiate(BOTH, build, P, method=lg.DirectDifferentiation(), **settings)
    alone = lg.differentiate(BOTH, build, P, **settings)  # what the certificate has anyway
    assert alone.method == lg.AdjointVariable() and int(alone.result) == lg.RESULTS.successful
    for name, certificate in alone.certificate.items():
        assert certificate.value is alone.value[name] and certificate.gradient is alone.gradient[name]
        np.testing.assert_array_equal(certificate.value, found.certificate[name].value)
    for name, certificate in found.certificate.items():
        np.testing.assert_allclose(certificate.value, found.value[name], rtol=1e-12)  # round-off of a hundred steps
        for key in P:
            np.testing.assert_allclose(certificate.gradient[key], found.gradient[name][key], rtol=1e-10)
    # of two criteria at once and of one alone: other programs, the same formulas
    np.testing.assert_allclose(found.certificate["squares"].value_error, oscillator.value_error, rtol=1e-8)
    at_end = lambda p: 1.0 + 0.3 * jnp.sin(jnp.sqrt(p["k"] / p["m"])) * jnp.sqrt(p["m"] / p["k"])  # V = 0.3, T1 = 1
    own = found.certificate["end"]
    np.testing.assert_allclose(own.value_error, at_end(P) - own.value, rtol=0.1)


@pytest.mark.slow  # several programs; both are in the quick run
def test_a_certificate_at_an_accuracy_is_that_of_the_run_found():
    found = lg.differentiate(CRITERION, build, P, t1=T1, accuracy=1e-4, certificate=True)
    assert not found.reached.extrapolated
    assert found.certificate.tolerance == 1e-4
    assert found.certificate.good
    np.testing.assert_allclose(found.certificate.value, found.value, rtol=1e-12)  # one number of steps, round-off


def scene(p, signal):
    mass = lg.RigidBody(mass=p, inertia=None, free="z")
    forces = {
        "spring": lg.SpringDamper(None, "mass", at_a=(0, 0, 2), at_b=(0, 0, 0), stiffness=20.0, damping=1.0),
        "push": lg.AppliedForce("mass", at=(0.0, 0.0, 0.0), force=(0.0, 0.0, 1.0), signal=signal),
    }
    return lg.Model({"mass": mass}, {}, forces)


def pushed(p):
    return scene(p, lg.Sampled((0.0, 0.5037, 1.0), (0.0, 3.0, 0.0), "linear"))


def peaked(p):
    return scene(p["mass"], lg.Sampled(jnp.stack([0.0 * p["peak"], p["peak"], 1.0 + 0.0 * p["peak"]]), (0.0, 3.0, 0.0)))


def height_at_the_end(mass, peak):
    """z of `peaked`: m z̈ = −20 z − ż + F, with F along two straight lines."""
    end = np.array([0.0, 0.0, 0.0, 1.0])  # z, ż, F, 1
    for length, slope in ((peak, 3.0 / peak), (1.0 - peak, -3.0 / (1.0 - peak))):
        rates = np.array([[0, 1, 0, 0], [-20 / mass, -1 / mass, 1 / mass, 0], [0, 0, 0, slope], [0, 0, 0, 0]])
        end = expm(length * rates) @ end
    return end[0]


@pytest.mark.slow  # the certificate of equal steps is in the quick run
def test_of_steps_that_end_at_breaks():
    """To the next term, O(ωh) with ωh = 0.045 as above, by mass and by the time at which the force has its kink."""
    p = {"mass": jnp.asarray(1.0), "peak": jnp.asarray(0.5037)}
    found = certify(HEIGHT, peaked, p, num_steps=100, t1=1.0, integrator=lg.AlignedSteps())
    of = lambda **by: height_at_the_end(**{name: float(value) + by.get(name, 0.0) for name, value in p.items()})
    assert not found.warnings
    np.testing.assert_allclose(found.value_error, of() - found.value, rtol=0.1)
    for name in p:
        slope = central(lambda s, name=name: of(**{name: s}), 1e-3)
        np.testing.assert_allclose(found.gradient_error[name], slope - found.gradient[name], rtol=0.1)


@pytest.mark.slow
def test_a_certificate_at_an_accuracy_is_of_steps_that_end_at_breaks():
    p = {"mass": 1.0, "peak": 0.5037}
    accurate = lg.differentiate(HEIGHT, peaked, p, t1=1.0, accuracy=1e-3, certificate=True)
    assert accurate.certificate.good
    np.testing.assert_allclose(accurate.certificate.value, accurate.value, rtol=1e-12)  # of the same steps, round-off


class Pulse(lg.AbstractSignal):
    """1 for a while, else 0."""

    begin: Float[Array, ""]
    length: Float[Array, ""]

    def __call__(self, t):
        return jnp.where((t >= self.begin) & (t <= self.begin + self.length), 1.0, 0.0)

    @property
    def breaks(self):
        return jnp.stack([self.begin, self.begin + self.length])


def pushed_twice(p):
    """By 2 N from 0.1 s on, for a while, and by 5 N for 0.2 s."""
    push = lambda force, signal: lg.AppliedForce("mass", at=(0.0, 0.0, 0.0), force=(0.0, 0.0, force), signal=signal)
    forces = push(2.0, Pulse(jnp.asarray(0.1), p["length"])), push(5.0, Pulse(p["begin"], jnp.asarray(0.2)))
    return lg.Model({"mass": lg.RigidBody(1.0, None, free="z")}, {}, dict(zip("ab", forces)))


@pytest.mark.slow
def test_breaks_that_coincide_and_move_apart_are_named():
    """z(1) by the length is 2 (0.9 − length): by the begin −5 · 0.2; but a step ends at both."""
    settings = {"t1": 1.0, "num_steps": 200, "integrator": lg.AlignedSteps(), "tolerance": 0.05}
    exact = {"length": 2.0 * 0.7, "begin": -1.0}
    found = certify(HEIGHT, pushed_twice, {"length": 0.2, "begin": 0.3}, **settings)
    assert not found.good and "breaks coincide at t = 0.3 s" in str(found)
    assert all(abs(found.gradient[name] - value) > 1.0 for name, value in exact.items())
    np.testing.assert_allclose(sum(found.gradient.values()), sum(exact.values()), atol=0.03)  # h times the jump
    both = certify(HEIGHT, lambda p: pushed_twice({"length": p - 0.1, "begin": p}), jnp.asarray(0.3), **settings)
    assert both.good
    np.testing.assert_allclose(both.gradient, sum(exact.values()), atol=0.03)


def test_a_kink_inside_of_a_step_is_found():
    trajectory = lg.simulate(pushed(1.0), t1=1.0, num_steps=100)
    ((t, body, forces, jump),) = kinks(trajectory, eqx.filter_jit(roughness)(trajectory))
    assert body == "mass" and not jump
    assert forces == ("push",)  # not the spring
    assert t - 0.01 <= 0.5037 <= t


@pytest.mark.slow
def test_a_certificate_names_the_kink():
    found = certify(HEIGHT, pushed, 1.0, t1=1.0, num_steps=100)
    assert len(found.kinks) == 1
    assert not found.good
    assert "have a kink" in str(found)
    assert "'push'" in str(found)


class Switched(lg.model.AbstractLoad):
    """A force of 3 N on b along z that ends where b has come to 0.05 m."""

    drawn = None

    def force(self, a, b, va, vb, t):
        return jnp.zeros(12).at[8].set(jnp.where(b.position[2] < 0.05, 3.0, 0.0))


class Switch(lg.model.AbstractForce):
    bodies = ("mass",)

    def loads(self, bodies):
        return (lg.model.Attached(Switched(), None, "mass"),)


def switched(mass):
    """It is thrown to 0.05 m in √(0.1 m/3) s, and flies on with √(0.3/m)."""
    return lg.Model({"mass": lg.RigidBody(mass=mass, inertia=None, free="z")}, {}, {"switch": Switch()})


def test_a_jump_is_told_from_a_kink():
    trajectory = lg.simulate(switched(1.0), t1=0.5, num_steps=100)
    ((t, body, forces, jump),) = kinks(trajectory, eqx.filter_jit(roughness)(trajectory))
    assert (body, forces, jump) == ("mass", ("switch",), True)
    at = np.sqrt(0.1 / 3.0)
    assert t - 0.005 <= at <= t + 0.005  # the numerical motion is as late as a step


def turning(p):
    """A shaft that is driven by 8 t + p t²."""
    shaft = lg.RigidBody(1.0, (0.1, 0.1, 0.1))
    law = lg.Polynomial(jnp.stack([jnp.zeros_like(p), jnp.full_like(p, 8.0), p]))
    bearing = lg.RevoluteJoint(None, "shaft", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    drive = lg.RotationDriver(None, "shaft", axis=(0.0, 0.0, 1.0), value=law)
    counter = lg.TorsionSpringDamper(None, "shaft", axis=(0.0, 0.0, 1.0), stiffness=0.0, turns=True)
    return lg.Model({"shaft": shaft}, {"bearing": bearing, "drive": drive}, {"counter": counter})


@pytest.mark.slow
def test_an_angle_that_comes_round_is_no_integrand_and_a_counted_one_is():
    """θ = 8 t + t² passes π at √(16 + π) − 4; ∫θ dt = 4 + 1/3, by p: 1/3."""
    wrapped = lg.Criterion(integrand=lambda s, p: s.joint("bearing").angle)
    counted = lg.Criterion(integrand=lambda s, p: s.force("counter").angle)
    one, other = certify([wrapped, counted], turning, 1.0, t1=1.0, num_steps=400)
    (at,) = one.jumps
    assert at - 1 / 400 <= np.sqrt(16.0 + np.pi) - 4.0 <= at
    assert not one.good and "the integrand jumps" in str(one)
    assert other.good and not other.jumps
    # h² of the trapezoidal rule: h²/12 of θ′ at the ends
    np.testing.assert_allclose([other.value, other.gradient], [13.0 / 3.0, 1.0 / 3.0], rtol=1e-5)


def test_where_a_function_jumps():
    t = jnp.linspace(0.0, 1.0, 101)
    angle = (8.0 * t + t**2 + jnp.pi) % (2 * jnp.pi) - jnp.pi
    (at,) = np.flatnonzero(jumps_of(angle))
    assert t[at - 1] <= np.sqrt(16.0 + np.pi) - 4.0 <= t[at]
    assert not jumps_of(jnp.sin(20.0 * t)).any() and not jumps_of(jnp.abs(t - 0.503)).any()


@pytest.mark.slow
def test_a_gradient_across_a_jump_is_not_called_good():
    """Its sign is right here and its size is not: z(T) = 0.05 + √(0.3/m) (T − √(0.1 m/3))."""
    found = certify(HEIGHT, switched, 1.0, t1=0.5, num_steps=2000)
    exact = jax.grad(lambda m: 0.05 + jnp.sqrt(0.3 / m) * (0.5 - jnp.sqrt(0.1 * m / 3.0)))(1.0)
    assert abs(found.gradient / exact - 1.0) > 0.1
    assert max(found.relative) < 1e-2  # the estimates do not see it
    assert not found.good
    assert "accelerations jump" in str(found) and "'switch'" in str(found)


def smoothly(p):
    return scene(p, lg.Sampled((0.0, 0.3, 0.6, 1.0), (0.0, 3.0, 1.0, 0.0)))


@pytest.mark.slow
def test_a_smooth_force_is_not():
    assert not certify(HEIGHT, smoothly, 1.0, t1=1.0, num_steps=100).kinks


@pytest.mark.slow
def test_steps_that_do_not_resolve_the_motion_are_named():
    found = certify(CRITERION, build, P | {"k": 1e6 * P["k"]}, t1=T1, num_steps=100)  # ωh = 45
    assert not found.good
    assert "do not resolve" in str(found)


def inverted(p):
    """A pendulum on a hinge, upright but for an angle p: it falls like exp(t √(3g/2l))."""
    axis, at = (0.0, 1.0, 0.0), jnp.stack([jnp.sin(p), jnp.zeros_like(p), jnp.cos(p)])
    body = lg.RigidBody(mass=1.0, inertia=(1.0 / 3.0, 1.0 / 3.0, 0.1), position=at)
    hinge = lg.RevoluteJoint(None, "body", at=(0.0, 0.0, 0.0), axis=axis)
    return lg.Model({"body": body}, {"hinge": hinge}, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})


@pytest.mark.slow
def test_exponential_growth_is_named():
    top = lg.Criterion(terminal=lambda s, p: s.body("body").position[0])
    found = certify(top, inverted, 1e-6, t1=3.0, num_steps=300)
    assert found.exponential
    # p = 1e-6 grows as cosh: by p for a relative change of 1
    np.testing.assert_allclose(found.growth, 1e-6 * np.cosh(3.0 * np.sqrt(9.81 / (4.0 / 3.0))), rtol=0.02)
    assert "unstable or chaotic" in str(found)


def on_a_stop(p, rounding):
    """A mass falls on a stop from a height p above it."""
    mass = lg.RigidBody(mass=1.0, inertia=None, position=(0.0, 0.0, p), free="z")
    at = {"at_a": (0.0, 0.0, -1.0), "at_b": jnp.stack([0.0 * p, 0.0 * p, p])}
    stop = lg.BumpStop(None, "mass", **at, gap=p, stiffness=1e3, rounding=rounding)
    damper = lg.SpringDamper(None, "mass", **at, stiffness=0.0, damping=2.0)
    return lg.Model({"mass": mass}, {}, {"gravity": lg.Gravity((0.0, 0.0, -9.81)), "stop": stop, "damper": damper})


@pytest.mark.slow
def test_a_hard_stop_is_named_and_one_that_steps_resolve_is_not():
    settings = {"t1": 0.25, "num_steps": 500}
    hard = certify(HEIGHT, lambda p: on_a_stop(p, 1e-7), 0.1, **settings)
    (kink,) = hard.kinks
    assert kink.forces == ("stop",)
    fallen = lambda t: 9.81 / 4.0 * (2.0 * t - 1.0 + np.exp(-2.0 * t))  # against 2 N s/m
    assert fallen(kink.t - 0.25 / 500) <= 0.1 <= fallen(kink.t)
    soft = certify(HEIGHT, lambda p: on_a_stop(p, 0.02), 0.1, **settings)
    assert not soft.kinks
    finer = lg.differentiate(HEIGHT, lambda p: on_a_stop(p, 0.02), 0.1, t1=0.25, num_steps=4000)
    # the next order of the estimate, and 1/64 of the error itself
    np.testing.assert_allclose(soft.value + soft.value_error, finer.value, atol=0.2 * abs(soft.value_error))
    np.testing.assert_allclose(soft.gradient + soft.gradient_error, finer.gradient, atol=0.3 * abs(soft.gradient_error))


def on_a_ramp(p, end):
    """A wheel and a car on a road that rises from 0.1 s to `end`."""
    car = linear_quarter_car(ks=p)
    road = lg.SampledRoad((0.0, 0.1, end, 1.0), (0.0, 0.0, 0.05, 0.05))
    tyre = lg.TyreSpring("unsprung", at=(0.0, 0.0, 0.0), stiffness=2e5, road=road)
    return lg.Model(car.bodies, car.joints, car.forces | {"tyre": tyre})


@pytest.mark.slow
def test_the_edge_of_a_road_is_named_where_no_step_ends_there():
    lifted = lg.Criterion(terminal=lambda s, p: s.body("sprung").position[2])
    found = certify(lifted, lambda p: on_a_ramp(p, 0.2037), 2e4, t1=0.5, num_steps=500)
    assert {(round(kink.t, 3), kink.forces) for kink in found.kinks} == {(0.204, ("tyre",))}
    assert not found.good
    there = certify(lifted, lambda p: on_a_ramp(p, 0.2037), 2e4, t1=0.5, num_steps=500, integrator=lg.AlignedSteps())
    assert there.good and not there.kinks


def double_pendulum(p):
    """Two equal bars in a plane, released at rest, the first at p over the horizontal, high above rest."""
    bodies, joints, start = {}, {}, jnp.zeros(3)
    for i, angle in enumerate((p, jnp.full_like(p, 1.2))):
        along = jnp.stack([jnp.cos(angle), jnp.zeros_like(angle), jnp.sin(angle)])
        bodies[f"bar{i}"] = lg.RigidBody(1.0, (1 / 12, 1 / 12, 1 / 12), position=start + along / 2)
        hinge = {"at": start, "axis": (0.0, 1.0, 0.0)}
        joints[f"hinge{i}"] = lg.RevoluteJoint(f"bar{i - 1}" if i else None, f"bar{i}", **hinge)
        start = start + along
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})


@pytest.mark.slow
def test_the_chaotic_double_pendulum_is_named():
    tip = lg.Criterion(terminal=lambda s, p: s.body("bar1").position[0])
    found = certify(tip, double_pendulum, 1.0, t1=20.0, num_steps=5000)
    assert found.exponential
    assert not found.good
    assert "unstable or chaotic" in str(found)
    assert not certify(tip, double_pendulum, -1.5, t1=5.0, num_steps=1000, tolerance=0.3).exponential


def clutched(p, behind=0.0):
    """A disc that turns at 6 rad/s and one behind it, which a stiff damper takes along at once."""
    axis = (0.0, 0.0, 1.0)
    disc = lambda rate: lg.RigidBody(1.0, (0.02,) * 3, angular_velocity=rate * jnp.asarray(axis), free="rz")
    clutch = lg.TorsionSpringDamper("drum", "output", axis=axis, stiffness=0.0, damping=p["damping"])
    spring = lg.TorsionSpringDamper(None, "drum", axis=axis, stiffness=5.0, damping=0.0)
    return lg.Model({"drum": disc(6.0), "output": disc(behind)}, {}, {"clutch": clutch, "spring": spring})


STIFF = {"damping": jnp.asarray(200.0)}


def test_what_is_too_fast_for_the_first_step_is_seen():
    """e^(−2 k t/J): with h = 5 ms and k = 200 N m s nothing is left after a step, and the scheme has −0.99 of it."""
    begin = jax.jit(lambda behind: roughness(lg.simulate(clutched(STIFF, behind), t1=2.0, num_steps=400)).begin)
    assert begin(0.0) > 1.9
    assert begin(6.0) < 0.1  # together from the begin


@pytest.mark.slow
def test_a_stiff_clutch_that_begins_apart_is_named():
    """Estimates of errors do not see it, as the motion goes on smoothly from what one step made of it."""
    turned = lambda run, p: run.body("output").angular_velocity[-1, 2]
    found = certify(turned, clutched, STIFF, t1=2.0, num_steps=400)
    assert not found.good and "in the first step accelerations change by" in str(found)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"integrator": lg.AdaptiveSteps()}, says("`integrator`", "equal steps", "AdaptiveSteps")),
        ({"integrator": lg.GivenSteps(np.ones(100))}, says("`integrator`", "equal steps", "GivenSteps")),
        ({"num_steps": 4}, says("`num_steps`", "at least 8", "got 4")),
        ({"tolerance": 2.0}, says("`tolerance`", "between 0 and 1", "2.0")),
        ({"p": {}}, says("`p`", "at least one number")),
        ({"criterion": 3.0}, says("`criterion` and `build`", "functions", "3.0")),
        ({"criterion": {}}, says("`criterion` and `build`", "functions", "{}")),
    ],
)
def test_bad_input(changes, message):
    given = {"criterion": HEIGHT, "build": build, "p": P, "num_steps": 100} | changes
    with pytest.raises(ValueError, match=message):
        certify(given.pop("criterion"), given.pop("build"), given.pop("p"), t1=1.0, **given)


def test_differentiate_refuses_it_before_it_computes():
    with pytest.raises(ValueError, match=says("`integrator`", "equal steps", "AdaptiveSteps")):
        lg.differentiate(HEIGHT, build, P, t1=1.0, num_steps=100, integrator=lg.AdaptiveSteps(), certificate=True)
    with pytest.raises(ValueError, match=says("outside of `jit`")):
        jax.jit(lambda p: lg.differentiate(HEIGHT, build, p, t1=1.0, num_steps=100, certificate=True).value)(P)


@pytest.mark.slow
def test_round_off_of_a_uniform_motion_is_resolved():
    """A rotor that is driven at constant speed: its angular acceleration is round-off, and changes as much as that."""
    rotor = lg.RigidBody(1.0, (0.1, 0.1, 0.2))
    axis = {"axis": (0.0, 0.0, 1.0)}
    joints = {
        "hinge": lg.RevoluteJoint(None, "rotor", at=(0.0, 0.0, 0.0), **axis),
        "drive": lg.RotationDriver(None, "rotor", value=lg.Polynomial((0.0, 5.0)), **axis),
    }
    run = lg.simulate(lg.Model({"rotor": rotor}, joints), t1=0.2, num_steps=100)
    seen = eqx.filter_jit(lambda run: (run.body("rotor").angular_acceleration, roughness(run).unresolved))
    turning, unresolved = seen(run)
    assert 0.0 < float(jnp.abs(turning).max()) < 1e-6
    assert unresolved == 0.0
