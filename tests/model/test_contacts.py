"""What pushes and does not pull: a tyre that lifts off, a point on a plane; and a moment that keeps its direction."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, says
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.model import Frame
from lgsens.model._contacts import ramp
from lgsens.testing import check_force

ORIGIN, Z = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
AT, AXIS = (0.3, -0.7, 1.1), (1.0, 2.0, -0.5)
K, W, G = 900.0, 0.01, 9.81


def contact_energy(load, a, b, t):
    """k ∫ ramp dx of a point without damping, with ∫ (x + w)³ (3w − x)/(16 w³) dx = (x + w)⁴ (4w − x)/(80 w³) − …."""
    x = -(a.orientation @ load.normal_a) @ (b.point(load.point_b) - a.point(load.point_a))
    w = load.rounding
    s = jnp.clip(x, -w, w) + w
    within = s**4 / (16 * w**2) - s**5 / (80 * w**3)  # of s³ (4w − s)/(16 w³)
    beyond = jnp.maximum(x, w)
    return load.stiffness * (within + (beyond**2 - w**2) / 2)


SPRING = {"stiffness": 3.0, "rounding": 0.8}
FORCES = {
    "tyre in the rounding": (lg.TyreSpring("a", at=AT, preload=0.4, **SPRING), {"balanced": False}),
    "tyre in the air": (lg.TyreSpring("a", at=AT, preload=-50.0, **SPRING), {"balanced": False}),
    "point": (lg.PlaneContact("a", "b", at=AT, axis=AXIS, **SPRING), {"potential": contact_energy}),
    "point that rubs": (
        lg.PlaneContact("a", "b", at=AT, axis=AXIS, gap=-1.0, damping=0.1, coefficient=0.3, slip_speed=0.2, **SPRING),
        {},
    ),
    "moments": (lg.AppliedForce("a", force=AT, fixed_moment=AXIS), {"balanced": False}),
}


QUICK = "tyre in the rounding", "point that rubs"


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in FORCES])
def test_forces_are_what_they_say(name):
    force, options = FORCES[name]
    check_force(force, length=0.3, **options).raise_if_failed()


def test_ramp_has_two_derivatives():
    """Nothing before −w, x after w, in between half of w/… at 0; three derivatives tend to those of both sides."""
    w, value = 0.3, lambda x: ramp(x, 0.3)[0]
    first = jax.grad(value)
    second = jax.grad(first)
    x = jnp.linspace(-2 * w, 2 * w, 41)[1::2]  # none of them at ±w
    close(jax.vmap(lambda x: ramp(x, w)[1])(x), jax.vmap(first)(x), 10)
    for end, expected in ((-w, [0.0, 0.0, 0.0]), (w, [w, 1.0, 0.0])):
        for side in (-1e-7, 1e-7):
            found = [float(f(end + side)) for f in (value, first, second)]
            np.testing.assert_allclose(found, expected, atol=1e-5)  # the second one by its slope 3/(2 w²) · 1e-7
    np.testing.assert_allclose([value(-w), value(2 * w), value(0.0)], [0.0, 2 * w, 3 * w / 16], rtol=1e-14, atol=1e-16)


def test_tyre_is_the_spring_until_it_lifts_off():
    body = lg.RigidBody(1.0, None)
    ground, still = Frame(np.zeros(3), np.eye(3)), jnp.zeros(6)
    load = lambda **more: lg.TyreSpring("b", at=ORIGIN, stiffness=K, preload=20.0, **more).loads({"b": body})[0].load
    measure = lambda load, z: load.measure(ground, Frame(jnp.array([0.0, 0.0, z]), jnp.eye(3)), still, still, 0.0)
    free = 20.0 / K
    for z in (-0.03, 0.0, free - W):
        close(measure(load(rounding=W), z), measure(load(), z), 10, scale=50.0)
    assert measure(load(rounding=W), free + W) == 0.0 and measure(load(), free + W) < 0.0
    close(measure(load(rounding=W), free), K * 3 * W / 16, 50)


@pytest.mark.slow
def test_impact_is_that_of_hunt_and_crossley():
    """m v dv = −k x (1 + c v) dx leaves g(v) = v/c − ln(1 + c v)/c² the same before and after; no pull, no step."""
    mass, speed, c = 2.0, 0.8, 0.4
    contact = lg.PlaneContact(None, "b", at=ORIGIN, axis=Z, gap=2e-3, stiffness=5e4, rounding=1e-4, damping=c)
    body = lg.RigidBody(mass, None, velocity=(0.0, 0.0, -speed))
    scene = lg.Model({"b": body}, {}, {"contact": contact})
    integrator = lg.GeneralizedAlpha(rho_inf=0.9)
    trajectory = eqx.filter_jit(lambda scene: lg.simulate(scene, t1=0.03, num_steps=3000, integrator=integrator))(scene)
    left = float(trajectory.body("b").velocity[-1, 2])
    g = lambda v: v / c - np.log1p(c * v) / c**2
    after = lambda speed: -brentq(lambda v: g(v) - g(speed), -speed, -1e-3 * speed)
    exact = after(speed)
    np.testing.assert_allclose(left, exact, rtol=1e-3)  # (w/x)² with the depth x = v √(m/k) = 5 mm, (ω h)²
    slow = 0.1  # as the docstring says
    assert abs(after(slow) / slow - (1 - 2 * c * slow / 3)) < (c * slow) ** 2
    push = np.asarray(trajectory.force("contact"))
    assert push.min() == 0.0 and push.max() > 100.0 and push[-1] == 0.0


@pytest.mark.slow
def test_fixed_moment_turns_a_body_about_its_direction():
    """Whatever the orientation: J of a ball, ω̇ = m/J in the inertial frame, 2 rad/s² about an axis of its own."""
    turned = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    body = lg.RigidBody(1.0, (0.5, 0.5, 0.5), orientation=turned)
    moment = np.array([0.0, 0.6, 0.8])
    scene = lg.Model({"b": body}, {}, {"m": lg.AppliedForce("b", fixed_moment=moment)})
    trajectory = eqx.filter_jit(lambda scene: lg.simulate(scene, t1=0.4, num_steps=4))(scene)
    expected = Rotation.from_rotvec(2.0 * 0.4**2 / 2 * moment).as_matrix() @ turned
    close(trajectory.body("b").orientation[-1], expected, 1e6)  # Newton's tolerance; constant accelerations are exact


def test_bad_input():
    for more, message in (
        ({"rounding": 0.0}, "PlaneContact: `rounding` must be positive, got 0.0"),
        ({"rounding": W, "coefficient": 0.3}, "PlaneContact: give both `coefficient` and `slip_speed`"),
    ):
        with pytest.raises(ValueError, match=says(message)):
            lg.PlaneContact(None, "b", at=ORIGIN, axis=Z, stiffness=K, **more)
    with pytest.raises(ValueError, match=says("TyreSpring: `rounding` must be positive, got -1.0")):
        lg.TyreSpring("b", at=ORIGIN, stiffness=K, rounding=-1.0)
