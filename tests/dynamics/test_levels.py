"""Rows of velocity level: a rolling disc against Newton and Euler, a knife edge on a moving table by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rolling_disc
from helpers import close, says, some_quick
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.dynamics import (
    Inertia,
    Tangents,
    accelerations,
    autodiff_tangents,
    constraint_acceleration,
    constraint_velocity,
    factorized_accelerations,
    full_jacobian,
    initial_state,
)
from lgsens.liegroups import Pose, Rn
from lgsens.testing import check_joint

ZERO = np.zeros(())


@pytest.mark.slow  # small version: test_multiplier_rows_and_tangents
@pytest.mark.parametrize("ground", ["a", None])
def test_every_derivative_of_the_joint(ground):
    point = {"point": (0.3, 0.0, 0.1)} if ground else {}
    joint = lg.Rolling(
        "b", ground, at=(0.1, 0.2, 0.3), axis=(1.0, 0.2, 0.3), radius=0.25, normal=(0.1, -0.2, 1.0), **point
    )
    assert check_joint(joint, poses=2)


@pytest.fixture(scope="module")
def disc():
    """The disc of the reference, and its consistent start."""
    system = rolling_disc.scene().system()
    return system, jax.jit(initial_state)(system, ZERO).state


def test_start_rolls(disc):
    """The joint's impulse leaves a motion that rolls: ẋ = −ω × r; it is the one nearest in kinetic energy."""
    system, state = disc
    assert (system.num_velocity_rows, len(system.constraint_names)) == (2, 3)
    orientation = np.asarray(state.q.orientation[0])
    omega = orientation @ np.asarray(state.v[3:])
    r, _ = rolling_disc.contact(orientation, omega)
    close(state.v[:3], -np.cross(omega, r), 16, scale=2.0)
    # M (v − v_ref) is a force at the contact: its moment about the centre is r × the force
    impulse = np.asarray(system.mass_matrix() @ (state.v - system.velocity))
    close(orientation @ impulse[3:], np.cross(r, impulse[:3]), 16, scale=2.0)


def test_accelerations_and_contact_force(disc):
    """Against Newton and Euler at random attitudes and spins, by both routes of `accelerations`."""
    system, _ = disc
    rng = np.random.default_rng(0)
    by_hand = jax.jit(lambda q, v: factorized_accelerations(Inertia.of(system), system, q, v, ZERO))
    plain = jax.jit(lambda q, v: accelerations(system, q, v, ZERO))
    levels = jax.jit(lambda q, v, vdot: jnp.concatenate([
        constraint_velocity(system, q, v, ZERO), constraint_acceleration(system, q, v, vdot, ZERO)
    ]))  # fmt: skip
    for _ in range(4):
        turn = Rotation.from_rotvec(rng.normal(scale=0.5, size=3)).as_matrix()
        omega = rng.normal(scale=4.0, size=3)
        r, _ = rolling_disc.contact(turn, omega)
        q = Pose(jnp.asarray([[0.3, -0.2, -r[2]]]), jnp.asarray(turn[None]))
        v = jnp.asarray(np.concatenate([-np.cross(omega, r), turn.T @ omega]))
        linear, turning, force = rolling_disc.accelerations(turn, omega)
        upward, axle = rolling_disc.N, turn[:, 1]
        forward = np.cross(axle, upward) / np.linalg.norm(np.cross(axle, upward))
        lam = -np.stack([upward, forward, np.cross(upward, forward)]) @ force
        vdot = np.concatenate([linear, turn.T @ turning])
        for found in (by_hand(q, v), plain(q, v)):
            close(found[0], vdot, 256, scale=np.abs(vdot).max())
            close(found[1], lam, 256, scale=np.abs(lam).max())
        close(levels(q, v, found[0]), np.zeros(6), 256, scale=np.abs(vdot).max())


def test_multiplier_rows_and_tangents(disc):
    """K_t, C_t, J against autodiff of the residual, which knows nothing of the elements."""
    system, state = disc
    np.testing.assert_array_equal(system.multiplier_rows("rolling"), [0, 1, 2])
    rng = np.random.default_rng(2)
    point = state.q, *(jnp.asarray(rng.normal(size=n)) for n in (6, 6, 3)), ZERO
    found = jax.jit(lambda *z: system.tangents(*z))(*point)
    expected: Tangents = jax.jit(lambda *z: autodiff_tangents(system, *z))(*point)
    for one, other in zip(found, expected):
        close(one, other, 256, scale=float(np.abs(other).max()))
    assert system.elimination is None


class Knife(lg.AbstractSystem):
    """A blade at the centre of mass on a table that moves with speed s(t) along y: −ẋ sin θ + (ẏ − s) cos θ = 0, and
    θ = ω t + α t²/2."""

    mass: Float[Array, ""]
    speed: lg.AbstractSignal
    turn: lg.AbstractSignal
    assembled: bool = eqx.field(static=True, default=False)

    @property
    def group(self):
        return Rn(3)

    @property
    def constraint_names(self):
        return ("motor", "blade")

    @property
    def num_velocity_rows(self):
        return 1

    def reference(self):
        return jnp.array([0.1, 0.2, 0.05]), jnp.array([1.0, 0.3, 0.0])

    def coordinate_scale(self):
        return jnp.ones(3)

    def mass_matrix(self):
        return self.mass * jnp.eye(3)

    def residual(self, q, v, vdot, lam, t):
        return self.mass * vdot + lam @ full_jacobian(self, q, t)

    def constraint(self, q, t):
        return (q[2] - self.turn(t))[None]

    def constraint_jacobian(self, q, t):
        return jnp.array([[0.0, 0.0, 1.0]])

    def velocity_constraint(self, q, v, t):
        return self.velocity_jacobian(q, t) @ v - (self.speed(t) * jnp.cos(q[2]))[None]

    def velocity_jacobian(self, q, t):
        return jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2]), jnp.zeros_like(t)])[None]

    def tangents(self, q, v, vdot, lam, t):
        return autodiff_tangents(self, q, v, vdot, lam, t)


def test_rows_that_depend_on_time_at_both_levels():
    """θ, θ̇ and θ̈ are the motor's; along the blade the start keeps its velocity, across it has the table's."""
    t, mass = 0.7, 2.0
    speed, turn = lg.Polynomial((0.2, 0.9)), lg.Polynomial((0.1, 1.1, 0.8))
    initial = jax.jit(initial_state)(Knife(jnp.asarray(mass), speed, turn), jnp.asarray(t))
    assert initial.result == lg.RESULTS.successful
    angle, rate, s, ds = 0.1 + 1.1 * t + 0.8 * t**2, 1.1 + 1.6 * t, 0.2 + 0.9 * t, 0.9
    state = initial.state
    close(state.q, np.array([0.1, 0.2, angle]), 8, scale=1.0)
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    v = (along @ [1.0, 0.3]) * along + s * np.cos(angle) * across
    close(state.v, np.array([*v, rate]), 16, scale=2.0)
    # across·v = s cos θ, once differentiated; no force along
    a = (ds * np.cos(angle) - s * rate * np.sin(angle) + rate * along @ v) * across
    close(state.vdot, np.array([*a, 1.6]), 64, scale=5.0)
    close(state.lam, -mass * np.array([1.6, across @ a]), 64, scale=5.0)


def planar_wheel(free, slope=0.2, **settings) -> lg.Model:
    """A wheel on a slope about y, with a spring along it that is free where it is."""
    radius, normal = 0.3, np.array([np.sin(slope), 0.0, np.cos(slope)])
    down, centre = np.array([np.cos(slope), 0.0, -np.sin(slope)]), radius * normal
    wheel = lg.RigidBody(2.0, (0.1, 0.2, 0.1), position=centre, free=free)
    rolling = lg.Rolling("wheel", at=centre, axis=(0.0, 1.0, 0.0), radius=radius, normal=normal, **settings)
    ends = {"at_a": centre - down, "at_b": centre}
    spring = lg.SpringDamper(None, "wheel", **ends, stiffness=400.0, damping=0.0, free_length=1.0)
    weight = lg.Gravity(tuple(rolling_disc.G))
    return lg.Model({"wheel": wheel}, {"rolling": rolling}, {"spring": spring, "weight": weight})


WHEELS = [("x y z ry", 0.2, 3), ("x ry", 0.0, 1), ("x y z rx ry rz", 0.2, 3), ("x z ry", 0.2, 2), ("x y ry", 0.0, 2)]


@pytest.mark.parametrize(("free", "slope", "rows"), WHEELS)
def test_rows_that_a_planar_wheel_can_violate(free, slope, rows):
    """No row of zeros is left."""
    model = planar_wheel(free, slope)
    assert model.summary().equations["rolling"] == rows
    system = model.system()
    jacobian = np.asarray(jax.jit(lambda q: full_jacobian(system, q, ZERO))(system.reference()[0]))
    assert np.abs(jacobian).max(axis=1).min() > 0.1  # of unit vectors, and of the radius


@pytest.mark.parametrize(("free", "slope"), some_quick([own[:2] for own in WHEELS], 2))
def test_acceleration_of_a_planar_wheel(free, slope):
    """By m g sin / (m + I/r²), whatever is free."""
    system = planar_wheel(free, slope).system()
    initial = jax.jit(initial_state)(system, ZERO)
    assert initial.result == lg.RESULTS.successful
    _, _, _, _, acceleration, _ = system.motion(0, initial.state.q, initial.state.v, initial.state.vdot)
    expected = 2.0 * 9.81 * np.sin(slope) / (2.0 + 0.2 / 0.3**2)
    close(acceleration, expected * np.array([np.cos(slope), 0.0, -np.sin(slope)]), 64, scale=10.0)


def test_what_a_planar_wheel_cannot_do():
    with pytest.raises(ValueError, match=says("'rolling': `axis`", "'rx', the only rotation")):
        planar_wheel("x z rx").system()
    with pytest.raises(ValueError, match=says("'wheel' moves along 'x' only", "`normal`")):
        planar_wheel("x ry").system()


@pytest.mark.slow  # programs of an equilibrium; its start and its accelerations are above
@pytest.mark.parametrize("free", ["x z ry", "x y z rx ry rz"])
def test_equilibrium_of_a_wheel_on_a_slope(free):
    """The spring holds the weight along the slope; the ground carries what is across it, and no friction."""
    model, slope = planar_wheel(free), 0.2
    state = lg.equilibrium(model)
    shift = 2.0 * 9.81 * np.sin(slope) / 400.0
    down, normal = np.array([np.cos(slope), 0.0, -np.sin(slope)]), np.array([np.sin(slope), 0.0, np.cos(slope)])
    # Newton ends at √ε of the forces or better
    np.testing.assert_allclose(state.q.position[0], 0.3 * normal + shift * down, rtol=0, atol=1e-8)
    found = lg.Instant(jnp.zeros(()), state, model.system()).multiplier("rolling")
    expected = np.array([-2.0 * 9.81 * np.cos(slope), 0.0, 0.0])[: found.size]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius": 0.0}, says("Rolling: `radius` must be positive", "0.0 m")),
        ({"axis": (0.0, 0.0, 2.0)}, says("Rolling: `axis`", "parallel or zero", "lies flat")),
        ({"at": (0.0, 1.0)}, says("Rolling: `at` must have shape (3,)")),
    ],
)
def test_bad_input(settings, message):
    with pytest.raises(ValueError, match=message):
        lg.Rolling("b", **({"at": (0.0, 0.0, 0.3), "axis": (0.0, 1.0, 0.0), "radius": 0.3} | settings))


def test_kinematics_refuses_what_rolls():
    with pytest.raises(ValueError, match=says("['rolling'] constrain velocities", "`simulate`")):
        lg.kinematics(rolling_disc.scene(), t=[0.0])
