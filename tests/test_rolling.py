"""Motions with nonholonomic rows: a rolling disc and a Chaplygin sleigh against their equations without multipliers."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rolling_disc
from helpers import says, some_quick
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import lgsens as lg
from lgsens.dynamics import constraint_velocity
from lgsens.model import AbstractJoint, AbstractVelocityConstraint

END = 0.4
INTEGRATORS = {
    "index 3": lg.GeneralizedAlpha(),
    "stabilized": lg.GeneralizedAlpha(stabilized=True),
    "index reduced": lg.IndexReducedODE(),
}
P = jnp.array([0.35, 6.0, 0.3, 0.5, rolling_disc.MASS])  # tilt, spin, radius, rate of yaw, mass of the disc


def scene(p):
    return rolling_disc.scene(p[0], jnp.stack([jnp.full((), 0.4), p[1], p[3]]), p[2], p[4])


def disc(p, num_steps, integrator, t1=END):
    return lg.simulate(scene(p), t1=t1, num_steps=num_steps, integrator=integrator)


def energy(trajectory):
    body = trajectory.body("disc")
    turning = body.angular_velocity**2 @ jnp.asarray(rolling_disc.MOMENTS)
    moving = rolling_disc.MASS * (jnp.sum(body.velocity**2, axis=1) - 2 * body.position @ jnp.asarray(rolling_disc.G))
    return (turning + moving) / 2.0


def of_disc(trajectory):
    """At all times: place, axle and spin, multipliers, energy, and how the rows have changed."""
    body, states, system = trajectory.body("disc"), trajectory.states, trajectory.system
    slip = jax.vmap(lambda q, v, t: constraint_velocity(system, q, v, t))(states.q, states.v, trajectory.t)
    spin = jnp.einsum("nij,nj->ni", body.orientation, body.angular_velocity)
    motion = jnp.concatenate([body.position, body.orientation[:, :, 1], spin], axis=1)
    return motion, trajectory.multiplier("rolling"), energy(trajectory), jnp.abs(slip)


def in_steps(found, n):
    """After n of the steps: the motion at the end, multipliers in the middle, how the energy has changed, the rows."""
    motion, loads, kept, slip = (np.asarray(each)[: n + 1] for each in found)
    return motion[-1], loads[n // 2], np.ptp(kept), slip


@cache
def exact():
    """The same of the equations without multipliers; the force of the ground in the directions of the multipliers."""
    begun = jax.jit(lambda p: lg.initial_state(scene(p)))(P)
    orientation = np.asarray(begun.q.orientation[0])
    omega = orientation @ np.asarray(begun.v[3:])
    place, turn, omega = rolling_disc.motion(orientation, omega, np.linspace(0.0, END, 3))
    _, _, force = rolling_disc.accelerations(turn[1], omega[1])
    axle, upward = turn[1][:, 1], rolling_disc.N
    forward = np.cross(axle, upward) / np.linalg.norm(np.cross(axle, upward))
    directions = np.stack([upward, forward, np.cross(upward, forward)])
    end = np.concatenate([np.asarray(begun.q.position[0]) + place[-1], turn[-1][:, 1], omega[-1]])
    return end, -directions @ force


@pytest.mark.parametrize("name", some_quick(INTEGRATORS))
def test_rolling_disc_is_that_of_its_ode(name):
    """Motion and force of the ground to the order of the scheme, energy too, and the contact does not slip."""
    # one program: in twice the time the first half is at twice the step
    run = jax.jit(lambda p, t1: of_disc(disc(p, 80, INTEGRATORS[name], t1)))
    (end, loads, drift, slip), (finer, finer_loads, less, _) = in_steps(run(P, 2 * END), 40), in_steps(run(P, END), 80)
    motion, force = exact()
    errors = [np.abs(of - motion).max() for of in (end, finer)]
    scale = np.abs(force).max()
    if name == "index reduced":
        assert np.log2(errors[0] / errors[1]) > 4.5 and errors[1] < 1e-6  # order 5
        assert np.abs(finer_loads - force).max() < 1e-9 * scale and less < 1e-6
        assert float(slip[1:].max()) < 1e-10  # projected, to round-off
        return
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 2.0, atol=0.3)
    assert errors[1] < 5e-3 * np.abs(motion).max()
    load_errors = [np.abs(of - force).max() / scale for of in (loads, finer_loads)]
    assert load_errors[1] < 1e-4 and load_errors[0] > 3.0 * load_errors[1]
    assert less < drift / 3.0  # order 2
    # rows of velocity level to Newton's tolerance, and at the start; the rate of the height, first, where stabilized
    assert float(slip[:, 0 if name == "stabilized" else 1 :].max()) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("name", INTEGRATORS)
def test_gradients_of_a_rolling_disc_in_both_modes(name):
    def psi(p):
        found = disc(p, 10, INTEGRATORS[name])
        load = found.multiplier("rolling")[:, 0]
        return lg.time_integral(found.t, found.body("disc").position[:, 0] ** 2) + 1e-3 * load[-1]

    reverse, forward, value = jax.jit(lambda p: (jax.grad(psi)(p), jax.jacfwd(psi)(p), psi(p)))(P)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-12)
    h, run = 1e-4, jax.jit(psi)
    at = lambda i, e: run(P + i * h * e)
    difference = [(at(-2, e) - 8 * at(-1, e) + 8 * at(1, e) - at(2, e)) / (12 * h) for e in np.eye(P.size)]
    # Newton's tolerance on the load, 1e-10, over h; h⁴ of fifth derivatives
    np.testing.assert_allclose(forward, difference, rtol=0, atol=1e-6 * np.abs(difference).max())
    assert np.isfinite(value)


class KnifeEdge(AbstractVelocityConstraint):
    """The point of b does not move along an axis of b: A v = e·(ẋ + R (Ω × X))."""

    point: jax.Array
    axis: jax.Array
    num_rows = 1

    def rate(self, a, b, va, vb, t):
        velocity = vb[:3] + b.axis(jnp.cross(vb[3:], self.point))
        return jnp.sum(b.axis(self.axis) * velocity)[None]


class Blade(AbstractJoint):
    """A knife edge at `at` that lets its body slide along x only."""

    a: None = eqx.field(static=True)
    b: str = eqx.field(static=True)
    at: jax.Array
    assembled = True

    def constraints(self, a, b):
        return (KnifeEdge(b.local_point(self.at), b.local_axis(jnp.array([0.0, 1.0, 0.0]))),)


@pytest.mark.slow  # a rolling disc is above
def test_chaplygin_sleigh():
    """With the centre of mass at d ahead of the blade: u̇ = d ω², (J + m d²) ω̇ = −m d u ω, and energy is kept.

    Source: Neimark & Fufaev (1972), ch. 2; a joint of one's own, in a few lines.
    """
    mass, inertia, d, speed, spin, end = 2.0, 0.3, 0.4, 1.5, 2.0, 1.0

    def sleigh(p, num_steps):
        body = lg.RigidBody(
            mass,
            (1.0, 1.0, inertia),
            position=jnp.stack([p[0], 0.0 * p[0], 0.0 * p[0]]),
            velocity=jnp.stack([p[1], p[0] * spin, 0.0 * p[0]]),
            angular_velocity=(0.0, 0.0, spin),
            free=("x", "y", "rz"),
        )
        model = lg.Model({"sleigh": body}, {"blade": Blade(None, "sleigh", jnp.zeros(3))})
        return lg.simulate(model, t1=end, num_steps=num_steps)

    def quantities(p, num_steps):
        body = sleigh(p, num_steps).body("sleigh")
        kinetic = mass * jnp.sum(body.velocity**2, axis=1) + inertia * body.angular_velocity[:, 2] ** 2
        along = jnp.sum(body.orientation[-1, :, 0] * body.velocity[-1])
        return jnp.stack([*body.position[-1, :2], along, body.angular_velocity[-1, 2]]), jnp.ptp(kinetic)

    def rates(t, y):
        u, w, turn, *_ = y
        moved = u * np.cos(turn), u * np.sin(turn)
        return [d * w**2, -mass * d * u * w / (inertia + mass * d**2), w, *moved]

    u, w, turn, x, y = solve_ivp(rates, (0.0, end), [speed, spin, 0.0, 0.0, 0.0], rtol=1e-11, atol=1e-12).y[:, -1]
    exact = np.array([x + d * np.cos(turn), y + d * np.sin(turn), u, w])
    p, run = jnp.array([d, speed]), jax.jit(quantities, static_argnums=1)
    (coarse, drift), (fine, less) = run(p, 50), run(p, 100)
    errors = [np.abs(found - exact).max() for found in (coarse, fine)]
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 2.0, atol=0.1)
    assert errors[1] < 1e-3 and less < drift / 3.0
    end_of = lambda p: run(p, 50)[0][0]
    reverse, forward = jax.jit(lambda p: (jax.grad(end_of)(p), jax.jacfwd(end_of)(p)))(p)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    difference = [(end_of(p + e) - end_of(p - e)) / 2e-4 for e in 1e-4 * np.eye(2)]
    np.testing.assert_allclose(forward, difference, rtol=1e-5)  # 1e-8 of third derivatives


@pytest.mark.slow  # a driven length of a rod: `model/test_drivers.py`
def test_two_bodies_on_a_link_of_given_length():
    """Two points that turn about their centre of mass: r = ℓ(t), r² θ̇ constant, tension −μ (ℓ̈ − ℓ θ̇²)."""
    mass, spin, end = (1.0, 3.0), 2.0, 0.5
    reduced = mass[0] * mass[1] / sum(mass)

    def run(p, num_steps):
        length = lg.Harmonic(amplitude=p[0], frequency=p[1], offset=p[2])
        place = [-p[2] * mass[1] / sum(mass), p[2] * mass[0] / sum(mass)]
        zero = 0.0 * p[0]
        bodies = {
            name: lg.RigidBody(m, None, position=jnp.stack([x, zero, zero]), velocity=jnp.stack([zero, spin * x, zero]))
            for name, m, x in zip("ab", mass, place)
        }
        rod = lg.DistanceJoint("a", "b", at_a=bodies["a"].position, at_b=bodies["b"].position, length=length)
        found = lg.simulate(lg.Model(bodies, {"rod": rod}), t1=end, num_steps=num_steps)
        apart = found.body("b").position[-1] - found.body("a").position[-1]
        return jnp.append(apart[:2], found.multiplier("rod")[-1])

    p = jnp.array([0.1, 1.3, 0.8])
    amplitude, w, offset = float(p[0]), 2 * np.pi * float(p[1]), float(p[2])
    length = lambda t: offset + amplitude * np.sin(w * t)
    rate = lambda t, y: [spin * offset**2 / length(t) ** 2]
    turn = solve_ivp(rate, (0.0, end), [0.0], rtol=1e-12, atol=1e-12).y[0, -1]
    r = length(end)
    tension = -reduced * (-amplitude * w**2 * np.sin(w * end) - r * rate(end, None)[0] ** 2)
    exact = np.array([r * np.cos(turn), r * np.sin(turn), tension])
    compiled = jax.jit(run, static_argnums=1)
    coarse, fine = (np.abs(compiled(p, n) - exact) for n in (50, 100))
    np.testing.assert_allclose(np.log2(coarse[1:] / fine[1:]), 2.0, atol=0.2)
    assert np.all(fine < 5e-3 * np.abs(exact).max())
    both = jax.jit(lambda p: (jax.jacfwd(run)(p, 10), jax.jacrev(run)(p, 10)), static_argnums=())
    forward, reverse = both(p)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-11)
    h = 1e-4
    difference = [(compiled(p + h * e, 10) - compiled(p - h * e, 10)) / (2 * h) for e in np.eye(3)]
    # h² of third derivatives, w³ times the tension
    np.testing.assert_allclose(forward, np.stack(difference, axis=1), rtol=1e-4, atol=1e-5 * np.abs(forward).max())


# Small motions.

A, C = rolling_disc.MOMENTS[:2]
WEIGHT = rolling_disc.MASS * 9.81 * rolling_disc.RADIUS
WITH_CONTACT = rolling_disc.MASS * rolling_disc.RADIUS**2  # of moments about the contact


def others(values, expected):
    """The eigenvalues without `expected`, which are among them to 1e-9: 1e-16 × condition, √ε of those of zeros."""
    left = list(np.asarray(values))
    for value in expected:
        left.remove(min(left, key=lambda other: abs(other - value)))
    found = np.setdiff1d(np.asarray(values), left)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(expected), atol=1e-9 * np.abs(values).max())
    return np.array(left)


@pytest.mark.slow  # `test_rolling_disc_is_that_of_its_ode` is in the quick run
def test_small_motions_of_a_disc_that_rolls_straight():
    """(A + m ρ²) λ² = m g ρ − C (C + m ρ²) Ω²/A: it falls where it is slow (Neimark & Fufaev, ch. 2). Else λ = 0, of
    places, of headings with their rates, and of the speed."""

    @jax.jit
    @jax.vmap
    def found(spin):
        model = rolling_disc.scene(0.0 * spin, spin * jnp.array([0.0, 1.0, 0.0]))
        start = lg.initial_state(model)
        return start.v[4], lg.linearize(model, start, throw=False).eigenvalues

    spins, values = found(jnp.array([6.0, 30.0]))
    squares = (WEIGHT - C * (C + WITH_CONTACT) * np.asarray(spins) ** 2 / A) / (A + WITH_CONTACT)
    assert squares[0] > 0.0 > squares[1]
    for square, own in zip(squares, values):
        root = np.sqrt(complex(square))
        left = others(own, [root, -root])
        assert left.shape == (6,) and np.abs(left).max() < 1e-6  # √ε of a pair that shares a vector


@pytest.mark.slow  # that of a disc that rolls straight is in the quick run
def test_small_motions_about_an_equilibrium_of_a_disc():
    """On a spring to the axle that rolls with m + C/ρ², and upright as on a pin."""
    spring = lg.SpringDamper(
        *(None, "disc"), at_a=(-1.0, 0, 0.3), at_b=(0, 0, 0.3), stiffness=200.0, damping=3.0, free_length=1.0
    )
    model = rolling_disc.scene(jnp.asarray(0.0), jnp.zeros(3))
    model = lg.Model(model.bodies, model.joints, model.forces | {"spring": spring})
    rolls = np.roots([rolling_disc.MASS + C / rolling_disc.RADIUS**2, 3.0, 200.0])
    falls = np.sqrt(WEIGHT / (A + WITH_CONTACT))
    assert not others(lg.linearize(model).eigenvalues, [*rolls, falls, -falls]).any()


@pytest.mark.slow
def test_small_motions_of_a_disc_that_rolls_in_a_circle():
    """Beside its equations without multipliers in four coordinates, of which a steady motion has two parameters."""
    tilt, rate = 0.3, 1.5

    def steady(spin):  # both turn about the vertical
        omega = rate * rolling_disc.N + spin * rolling_disc.turned(tilt)[:, 1]
        return rolling_disc.flow(np.array([tilt, *omega]))

    spin = brentq(lambda spin: steady(spin)[1], -40.0, -1.0, xtol=1e-14)
    at = np.array([tilt, *(rate * rolling_disc.N + spin * rolling_disc.turned(tilt)[:, 1])])
    assert np.abs(rolling_disc.flow(at)).max() < 1e-12
    step = 1e-4  # differences of fourth order: 1e-16 of derivatives, EPS/step = 2e-12
    columns = []
    for unit in np.eye(4):
        some = [rolling_disc.flow(at + k * step * unit) for k in (-2, -1, 1, 2)]
        columns.append((np.array([1.0, -8.0, 8.0, -1.0]) / 12.0 / step) @ some)
    by_hand = np.linalg.eigvals(np.stack(columns, axis=1))
    pair = by_hand[np.abs(by_hand) > 1e-3]
    assert pair.shape == (2,)
    model = rolling_disc.scene(jnp.asarray(tilt), rolling_disc.turned(tilt).T @ at[1:])
    start = lg.initial_state(model)
    velocity = -np.cross(at[1:], rolling_disc.contact(rolling_disc.turned(tilt), at[1:])[0])
    start = eqx.tree_at(lambda state: state.v, start, jnp.concatenate([velocity, rolling_disc.turned(tilt).T @ at[1:]]))
    found = lg.linearize(model, start, rotation=(0.0, 0.0, rate))
    left = others(found.eigenvalues, [*pair, 1j * rate, -1j * rate])  # a place in axes that turn
    assert np.abs(left).max() < 1e-6
    with pytest.raises(ValueError, match="not steady"):
        lg.linearize(model, start)


def straight():
    model = rolling_disc.scene(jnp.asarray(0.0), jnp.array([0.0, 30.0, 0.0]))
    start = lg.initial_state(model)
    return model, start, eqx.tree_at(lambda state: state.v, start, start.v.at[0].mul(1.005))


def test_a_state_that_slips_is_refused():
    """By half a percent of its speed. Two equations are of velocities alone: of five freedoms three are left."""
    model, _, slips = straight()
    summary = model.summary()
    assert summary.degrees_of_freedom == 3 and "\nof velocities alone         2\n" in str(summary)
    with pytest.raises(ValueError, match=says("`state` does not satisfy the joints at t0 = 0 s", "'rolling'")):
        lg.linearize(model, slips)


@pytest.mark.slow  # two programs
def test_what_is_not_steady_of_a_disc_is_said():
    """The roll rate in axes of the disc, which turn; and inside `jit` the state that slips."""
    model, start, slips = straight()
    outputs = {
        "height": lambda s: s.body("disc").position[2],
        "rate": lambda s: s.body("disc").angular_velocity[0],
    }
    with pytest.raises(ValueError, match=says("The motion is steady, but outputs", "['rate']")):
        lg.linearize(model, start, outputs=outputs)
    assert jax.jit(lambda state: lg.linearize(model, state, throw=False).result)(slips) == lg.RESULTS.off_joints


@pytest.mark.slow  # five joints
def test_a_trailer_whose_hitch_is_driven_follows_it():
    """λ = −V/a of its heading, which no velocity is left for, and 0 of its wheel."""
    speed, length, radius = 3.0, 0.8, 0.25
    moves = {"velocity": (speed, 0.0, 0.0)}
    bodies = {
        "hitch": lg.RigidBody(2.0, (1.0, 1.0, 1.0), position=(0.0, 0.0, 0.5), free="x y z", **moves),
        "trailer": lg.RigidBody(4.0, (0.3, 0.5, 0.6), position=(-0.5, 0.0, 0.5), **moves),
        "wheel": lg.RigidBody(
            1.0, (0.02, 0.035, 0.02), (-length, 0.0, radius), angular_velocity=(0.0, speed / radius, 0.0), **moves
        ),
    }
    driver = lambda axis, value: lg.TranslationDriver(None, "hitch", at=(0.0, 0.0, 0.5), axis=axis, value=value)
    axle = {"at": (-length, 0.0, radius), "axis": (0.0, 1.0, 0.0)}
    joints = {
        "pivot": lg.RevoluteJoint("hitch", "trailer", at=(0.0, 0.0, 0.5), axis=(0.0, 0.0, 1.0)),
        "hub": lg.RevoluteJoint("trailer", "wheel", **axle),
        "tyre": lg.Rolling("wheel", **axle, radius=radius),
        "along": driver((1.0, 0.0, 0.0), lg.Polynomial((0.0, speed))),
        "across": driver((0.0, 1.0, 0.0), 0.0),
    }
    model = lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
    found = lg.linearize(model, lg.initial_state(model), inputs=["across"])
    np.testing.assert_allclose(found.eigenvalues, [0.0, -speed / length], atol=1e-12)
    # a ψ̇ = ẏ − V ψ; and what rolls has no velocities of its own
    assert found.A.shape == (2, 2) and found.vectors.shape == (2, 2)
