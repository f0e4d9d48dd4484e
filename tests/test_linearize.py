"""`linearize`: against closed forms, hand-written matrices and the simulation's own response."""

import dataclasses
import json
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from differences import central
from helpers import says
from random_roads import compared
from scipy.integrate import quad

import lgsens as lg
from lgsens.analysis._eigen import eigen, near
from lgsens.dynamics import accelerations

DATA = Path(__file__).parent / "data"
UP = (0.0, 0.0, 1.0)
G = 9.81
ROUND_OFF = 1e-12  # of matrices of a few numbers and condition numbers up to 1e3


def same_values(found, expected, rtol=1e-10, atol=0.0):
    """Sets of complex numbers, sorted by their parts; `atol` in the unit of their size."""
    order = lambda values: sorted(np.asarray(values), key=lambda value: (round(value.imag, 6), value.real))
    scale = np.abs(expected).max()
    np.testing.assert_allclose(order(found), order(expected), rtol=rtol, atol=max(atol, rtol) * scale)


# The quarter-car, y = [zs, zu, zs', zu'].

STATEMENT = json.loads((DATA / "quarter_car_linear.json").read_text(encoding="utf-8"))
CAR = {name: STATEMENT["params"][name] for name in ("ms", "mu", "ks", "cs", "kt")}
SEEN = {
    "acceleration": lambda s: s.body("sprung").acceleration[2],
    "stroke": lambda s: s.body("sprung").position[2] - s.body("unsprung").position[2],
    "tyre": lambda s: s.force("tyre"),
    "height": lambda s: s.body("sprung").position[2],
}


def two_masses(ms, mu, ks, cs, kt):
    """A, B, C, D by hand, of the outputs above."""
    a = np.array(
        [
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            [-ks / ms, ks / ms, -cs / ms, cs / ms],
            [ks / mu, -(ks + kt) / mu, cs / mu, -cs / mu],
        ]
    )
    b = np.array([0, 0, 0, kt / mu])
    return a, b, np.array([a[2], [1, -1, 0, 0], [0, -kt, 0, 0], [1, 0, 0, 0]]), np.array([0, 0, kt, 0])


@jax.jit
def quarter_car(numbers):
    return lg.linearize(lg.examples.linear_quarter_car(**numbers), inputs=("tyre",), outputs=SEEN)


@pytest.fixture(scope="module")
def car():
    return quarter_car(jax.tree.map(jnp.asarray, CAR))


def test_quarter_car_in_closed_form(car):
    a, b, c, d = two_masses(**CAR)
    same_values(car.eigenvalues, np.linalg.eigvals(a))
    slow, fast = np.sort(np.abs(np.roots(np.poly(a)).imag))[[0, 2]] / (2 * np.pi)
    np.testing.assert_allclose(car.frequencies, [slow, slow, fast, fast], rtol=1e-10)
    np.testing.assert_allclose(car.damping_ratios, -np.real(car.eigenvalues) / np.abs(car.eigenvalues), rtol=1e-14)
    assert not np.any(car.repeated)
    frequency = np.array([0.3, 1.05, 4.0, 11.3, 60.0])
    by_hand = [c @ np.linalg.solve(2j * np.pi * f * np.eye(4) - a, b) + d for f in frequency]
    np.testing.assert_allclose(car.frequency_response(frequency)[..., 0], by_hand, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(car.D1, 0.0)
    np.testing.assert_array_equal(car.D2, 0.0)


def test_modes_of_the_quarter_car(car):
    """A φ = λ φ holds for the motions of the bodies, λ² M φ + λ C φ + K φ = 0 with the two-mass matrices."""
    ms, mu, ks, cs, kt = CAR.values()
    z = np.stack([car.mode_shape(name).translation[:, 2] for name in ("sprung", "unsprung")])
    lam, spring = np.asarray(car.eigenvalues), np.array([[1.0, -1.0], [-1.0, 1.0]])
    force = np.array([[ms], [mu]]) * z * lam**2 + cs * spring @ z * lam + (ks * spring + np.diag([0.0, kt])) @ z
    assert np.abs(force).max() < ROUND_OFF * kt * np.abs(z).max()
    np.testing.assert_allclose(ms * np.abs(z[0]) ** 2 + mu * np.abs(z[1]) ** 2, 1.0, rtol=ROUND_OFF)  # unit modal mass
    assert np.all(np.asarray(car.mode_shape("sprung").rotation) == 0.0)


def test_bump_by_the_linear_equations(car):
    """The published response to the bump, a state of the extended system z'' = ω²(h/2 − z), by SciPy's exponential."""
    height, time = STATEMENT["params"]["hb"], STATEMENT["params"]["Tb"]
    omega, n = 2 * np.pi / time, car.A.shape[0]
    big = np.zeros((n + 3, n + 3))  # y, z, z', 1
    big[:n, :n], big[:n, n] = car.A, car.B[:, 0]
    big[n, n + 1], big[n + 1, n], big[n + 1, n + 2] = 1.0, -(omega**2), omega**2 * height / 2
    start = np.zeros(n + 3)
    start[-1] = 1.0
    seen = np.hstack([car.C, car.D, np.zeros((len(SEEN), 2))])
    asked = 0
    for state in STATEMENT["states"]:
        if state["t"] <= time:
            expected = [state[name] for name in ("zs_acc", "stroke", "tire_dyn_force", "zs")]
            found = seen @ scipy.linalg.expm(big * state["t"]) @ start
            # at its end the bump is h(1 − cos 2π)/2 = 0 of numbers up to kt h
            np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
            asked += 1
    assert asked == 3


ROAD = {"roughness": 64e-6, "speed": 20.0}
INTENSITY = (2 * np.pi * 0.1) ** 2 * 64e-6 * 20.0 / 2  # S of ż


def on_a_road(ms, mu, ks, cs, kt):
    """σ of acceleration and stroke of two masses on it (Gobbi & Mastinu 2001)."""
    acceleration = np.sqrt(INTENSITY * (ks**2 * (ms + mu) / cs + cs * kt) / 2) / ms
    return acceleration, np.sqrt(INTENSITY * (ms + mu) / (2 * cs))


@pytest.mark.slow  # `test_driven_base_with_damping_and_a_state` has derivatives in the quick run
def test_derivatives_of_the_quarter_car():
    """In reverse mode by differences: eigenvalues and responses of the two-mass matrices, closed forms of a random road
    (the adjoint Lyapunov equation), A and modes of `linearize` itself.

    Central differences of sixth order at 1e-3 of a number: the remainder is 1e-18 × high derivatives, round-off
    1e-16/1e-3 = 1e-13, both times the condition of eigenvalues and vectors (2 to 30).
    """
    names, values = list(CAR), np.array(list(CAR.values()))
    parts_of = lambda *found: [f(part) for part in found for f in (jnp.real, jnp.imag)]

    def of(numbers):
        linear = quarter_car(dict(zip(names, numbers)))
        seen = parts_of(linear.eigenvalues, linear.frequency_response(3.0)[:, 0])
        own = parts_of(linear.mode_shape("unsprung").translation[:, 2])
        road = lg.random_road(linear, **ROAD)
        return jnp.concatenate([*seen, jnp.stack([road["acceleration"], road["stroke"]]), *own, linear.A.reshape(-1)])

    def by_hand(numbers):
        a, b, c, d = two_masses(*numbers)
        lam = np.linalg.eigvals(a)
        lam = lam[np.lexsort((-lam.imag, np.abs(lam).round(6)))]
        response = c @ np.linalg.solve(6j * np.pi * np.eye(4) - a, b) + d
        return np.concatenate([*parts_of(lam, response), on_a_road(*numbers)])

    differences = lambda f: np.stack([central(lambda s, e=e: f(values * (1 + s * e)), 1e-3) for e in np.eye(5)], axis=1)
    found = np.asarray(jax.jacrev(of)(jnp.asarray(values))) * values
    hand = differences(by_hand)
    expected = np.concatenate([hand, differences(lambda x: np.asarray(of(x)))[len(hand) :]])
    size = np.abs(expected).max(axis=1, keepdims=True)
    some = size[:, 0] > 1e-9
    assert np.sum(some) >= 16 + 2 + 6 + 4  # of entries that depend on nothing there are those of the upper half of A
    np.testing.assert_allclose(found[some] / size[some], expected[some] / size[some], atol=1e-9)
    np.testing.assert_allclose(found[~some], 0.0, atol=1e-9)


def oscillator(c):
    """λ = −c/2 ± i√(1 − c²/4) of 1 kg on a spring of 1 N/m with the damping c: Im λ'' by c."""
    root = np.sqrt(1 - c**2 / 4)
    return -1 / (4 * root) - c**2 / (16 * root**3)


def test_second_derivatives_of_eigenvalues():
    of = lambda c: jnp.imag(eigen(jnp.array([[0.0, 1.0], [-1.0, 0.0]]) - c * jnp.array([[0.0, 0.0], [0.0, 1.0]]))[0][0])
    np.testing.assert_allclose(jax.grad(jax.grad(of))(0.6), oscillator(0.6), rtol=1e-12)


@pytest.mark.slow
def test_second_derivatives_through_a_model():
    def of(c):
        spring = lg.SpringDamper(None, "b", at_a=(0, 0, -1.0), at_b=(0, 0, 0), stiffness=1.0, damping=c)
        body = lg.RigidBody(1.0, (1.0, 1.0, 1.0), free="z")
        linear = lg.linearize(lg.Model({"b": body}, {}, {"spring": spring}))
        return jnp.imag(linear.eigenvalues[0])

    np.testing.assert_allclose(jax.grad(jax.grad(of))(0.6), oscillator(0.6), rtol=1e-10)


# Steady motions.


def top(theta, spin, precession):
    """A Lagrange top in steady precession; its third axis is that of symmetry."""
    base = lg.examples.lagrange_top(theta0=theta, w3=spin)
    body = base.bodies["top"]
    turning = body.orientation.T @ jnp.array([0.0, 0.0, precession])
    angular = jnp.array([turning[0], turning[1], spin])
    velocity = jnp.cross(jnp.array([0.0, 0.0, precession]), body.position)
    moving = lg.RigidBody(body.mass, body.inertia, body.position, body.orientation, velocity, angular)
    return lg.Model({"top": moving}, base.joints, base.forces)


M, L, J1, J3 = 2.0, 0.25, 0.05, 0.02  # of the top, and the moment about its fixed point
ABOUT = J1 + M * L**2


@pytest.mark.slow  # small version: test_rotor_on_springs
def test_sleeping_top():
    """A ζ'' − i J₃ω ζ' − mgl ζ = 0 of the complex tilt: λ = i (J₃ω ± √(J₃²ω² − 4 A m g l))/2A, and two zeros."""

    def of(spin):
        model = top(0.0, spin, 0.0)
        linear = lg.linearize(model, lg.initial_state(model))
        return jnp.imag(linear.eigenvalues[jnp.array([2, 4])]), linear

    spin = 150.0
    derivative, linear = jax.jacfwd(of, has_aux=True)(spin)
    root = np.sqrt((J3 * spin) ** 2 - 4 * ABOUT * M * G * L)
    modes = np.array([J3 * spin - root, J3 * spin + root]) / (2 * ABOUT)
    same_values(linear.eigenvalues, np.concatenate([1j * modes, -1j * modes, [0.0, 0.0]]), atol=1e-10)
    assert list(linear.repeated) == [True, True, False, False, False, False]
    slope = (J3 - np.array([1.0, -1.0]) * J3**2 * spin / root) / (2 * ABOUT)
    np.testing.assert_allclose(derivative, slope, rtol=1e-10)


def test_precessing_top():
    """Nutation about steady precession W: ω² = W² − 2 m g l cos θ/A + (m g l/(A W))² (Routh); in turning axes only."""
    theta, spin = 0.6, 150.0
    weight = M * G * L
    root = np.sqrt((J3 * spin) ** 2 - 4 * ABOUT * np.cos(theta) * weight)
    rate = (J3 * spin - root) / (2 * ABOUT * np.cos(theta))
    model = top(theta, spin, rate)
    state = lg.initial_state(model)
    linear = lg.linearize(model, state, rotation=(0.0, 0.0, rate))
    nutation = np.sqrt(rate**2 - 2 * weight * np.cos(theta) / ABOUT + (weight / (ABOUT * rate)) ** 2)
    # two pairs of zeros share one vector each: round-off 1e-16 of the largest squared splits them to 1e-8 of it
    same_values(linear.eigenvalues, [1j * nutation, -1j * nutation, 0, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(np.abs(linear.eigenvalues[-1]), nutation, rtol=1e-10)
    with pytest.raises(ValueError, match=says("The motion is not steady")):
        lg.linearize(model, state)
    with pytest.raises(ValueError, match=says("The motion is not steady")):
        lg.linearize(model, state, rotation=(0.0, 0.0, 1.1 * rate))


def test_free_body_about_a_principal_axis():
    """Euler's λ² = ω² (J₃ − J₁)(J₂ − J₃)/(J₁J₂), in axes that turn with the body; in others the equations change."""
    spin, (j1, j2, j3) = 2.0, (0.4, 0.7, 0.9)
    model = lg.examples.free_rigid_body(j1, j2, j3, 0.0, 0.0, spin)
    state = lg.initial_state(model)
    linear = lg.linearize(model, state, rotation=(0.0, 0.0, spin))
    euler = np.sqrt(spin**2 * (j3 - j1) * (j3 - j2) / (j1 * j2))
    assert np.min(np.abs(linear.eigenvalues - 1j * euler)) < 1e-10
    with pytest.raises(ValueError, match=says("The motion is not steady")):
        lg.linearize(model, state)


def test_a_failure_inside_jit_is_nan(car):
    """And eigenvalues, which are complex, are NaN as matrices are."""
    run = jax.jit(lambda: lg.linearize(lg.examples.free_rigid_body(), lg.initial_state(lg.examples.free_rigid_body())))
    found = run()
    assert np.all(np.isnan(found.A)) and np.all(np.isnan(found.eigenvalues)) and np.all(np.isnan(found.vectors))
    assert found.result == lg.RESULTS.not_steady
    with pytest.raises(ValueError, match=says("The motion is not steady")):
        lg.raise_if_failed(found)
    assert lg.raise_if_failed(car) is car


def test_rotor_on_springs():
    """Whirl of a rotor of revolution, J_t φ'' − i J_p Ω φ' + k a² φ = 0, translation ω² = k/m apart from it.

    Eight springs hold two points of its axis, each in both directions across; the axis is free along itself.
    """
    mass, transverse, polar, arm, stiffness, spin = 3.0, 0.2, 0.3, 0.5, 700.0, 90.0
    body = lg.RigidBody(mass, (transverse, transverse, polar), angular_velocity=(0.0, 0.0, spin))
    springs = {}
    for end in (-arm, arm):
        for axis in np.eye(3)[:2]:
            for sign in (-1.0, 1.0):
                at = np.array([0.0, 0.0, end])
                ends = {"at_a": at + sign * axis, "at_b": at}
                springs[f"{end}{axis}{sign}"] = lg.SpringDamper(None, "rotor", stiffness=stiffness, **ends)
    model = lg.Model({"rotor": body}, {}, springs)
    linear = jax.jit(lambda: lg.linearize(model, lg.initial_state(model)))()
    across = 4 * stiffness
    gyro, root = polar * spin, np.sqrt((polar * spin) ** 2 + 4 * transverse * across * arm**2)
    whirl = np.array([gyro + root, gyro - root]) / (2 * transverse)
    bounce = np.full(2, np.sqrt(across / mass))
    rates = np.concatenate([whirl, bounce])
    expected = np.concatenate([1j * rates, -1j * rates, np.zeros(4)])  # along the axis and about it: none
    same_values(linear.eigenvalues, expected, atol=1e-9)


# Constraints, drivers, states.


@pytest.mark.slow  # `test_precessing_top` is in the quick run
def test_pendulum_on_a_driven_pivot():
    """A pivot driven to u: J φ'' + m g l φ = −m l u'', whose multipliers and accelerations see u''.

    Curvature of the constraint: the whole stiffness m g l is that of the joint forces.
    """
    mass, arm, inertia = 2.0, 0.8, 0.3
    about = inertia + mass * arm**2
    bodies = {
        "slide": lg.RigidBody(5.0, (1.0, 1.0, 1.0), free="x"),
        "bob": lg.RigidBody(mass, (inertia,) * 3, position=(0.0, 0.0, -arm), free="x z ry"),
    }
    joints = {
        "pivot": lg.RevoluteJoint("slide", "bob", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),
        "drive": lg.TranslationDriver(None, "slide", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0)),
    }
    model = lg.Model(bodies, joints, {"g": lg.Gravity((0.0, 0.0, -G))})
    outputs = {
        "turn": lambda s: s.body("bob").orientation[0, 2],
        "place": lambda s: s.body("bob").position[0],
        "acceleration": lambda s: s.body("bob").acceleration[0],
        "drive": lambda s: -s.multiplier("drive")[0],
    }
    linear = jax.jit(lambda: lg.linearize(model, inputs=("drive",), outputs=outputs))()
    same_values(linear.eigenvalues, np.array([1j, -1j]) * np.sqrt(mass * G * arm / about), rtol=ROUND_OFF)
    frequency = np.array([0.1, 0.4, 2.0])
    square = -((2 * np.pi * frequency) ** 2)  # s²
    # position of the bob u − l φ for φ about y, as it hangs below
    turn = mass * arm * square / (about * square + mass * G * arm)
    place = 1 - arm * turn
    by_hand = np.stack([turn, place, square * place, square * (5.0 + mass * place)], axis=1)
    found = linear.frequency_response(frequency)[..., 0]
    np.testing.assert_allclose(found, by_hand, rtol=1e-11, atol=1e-11 * np.abs(by_hand).max())


@pytest.mark.slow
def test_driven_base_with_damping_and_a_state():
    """m z'' + Z(s) (z − u) = F over a driven base, Z = k + c s + κ s/(s + κ/d) with a Maxwell element (κ, d) beside the
    spring: an input whose rate drives the motion, one that is a force, and the three zeros of a cubic.
    """
    mass, k, c, kappa, d = 1.5, 200.0, 3.0, 90.0, 4.0
    bodies = {
        name: lg.RigidBody(mass, (1.0,) * 3, position=(0, 0, z), free="z") for name, z in (("a", 0.0), ("b", 1.0))
    }
    drive = lg.TranslationDriver(None, "a", at=(0, 0, 0), axis=UP, value=lg.Harmonic(amplitude=0.0, frequency=1.0))
    ends = {"at_a": (0.0, 0.0, 0.0), "at_b": UP}
    forces = {
        "spring": lg.SpringDamper("a", "b", stiffness=k, damping=c, **ends),
        "maxwell": lg.MaxwellElement("a", "b", stiffness=kappa, damping=d, **ends),
        "push": lg.AppliedForce("b", force=UP, signal=lg.FlatRoad()),
    }
    outputs = {"place": lambda s: s.body("b").position[2], "speed": lambda s: s.body("b").velocity[2]}
    model = lg.Model(bodies, {"d": drive}, forces)
    linear = jax.jit(lambda: lg.linearize(model, inputs=("d", "push"), outputs=outputs))()
    cubic = np.polyadd(np.polymul([mass, c, k], [1.0, kappa / d]), [kappa, 0.0])
    same_values(linear.eigenvalues, np.roots(cubic))
    frequency = np.array([0.5, 1.9, 8.0])
    s = 2j * np.pi * frequency
    z = k + c * s + kappa * s / (s + kappa / d)
    place = np.stack([z, np.ones(3)], axis=1) / (mass * s**2 + z)[:, None]
    found = linear.frequency_response(frequency)
    np.testing.assert_allclose(found, np.stack([place, s[:, None] * place], axis=1), rtol=1e-11)


def test_derivatives_of_repeated_eigenvalues_are_those_of_their_mean():
    """diag(2 + 3 s, 2 − s, 5): 1 for both at s = 0, also where they share one vector; and finite of the vectors."""
    for coupling in (0.0, 1.0):
        matrix = lambda s, c=coupling: jnp.diag(jnp.stack([2.0 + 3.0 * s, 2.0 - s, 5.0 + 0.0 * s])).at[0, 1].set(c)
        (values, _), (by_s, turned) = jax.jvp(lambda s, m=matrix: eigen(m(s)), (0.0,), (1.0,))
        np.testing.assert_allclose(values, [2.0, 2.0, 5.0], rtol=1e-7)  # √ε where they share one
        np.testing.assert_allclose(by_s, [1.0, 1.0, 0.0], atol=1e-7)
        assert np.all(np.isfinite(turned)) and list(np.sum(near(values), axis=1)) == [2, 2, 1]


@pytest.mark.slow
def test_repeated_eigenvalues_are_said():
    """Two equal masses on springs k(1 ± a): by a the derivative of both is that of the mean, zero; by k λ/2k."""

    def of(k, a):
        bodies = {f"{i}": lg.RigidBody(1.0, (1.0,) * 3, free="z") for i in (0, 1)}
        ends = {"at_a": (0.0, 0.0, -1.0), "at_b": (0.0, 0.0, 0.0)}
        stiff = (k * (1 + a), k * (1 - a))
        springs = {f"{i}": lg.SpringDamper(None, f"{i}", stiffness=stiff[i], **ends) for i in (0, 1)}
        linear = lg.linearize(lg.Model(bodies, {}, springs))
        return jnp.imag(linear.eigenvalues), linear.repeated

    by, repeated = jax.jacrev(of, (0, 1), has_aux=True)(50.0, 0.0)
    assert np.all(repeated)
    value = np.sqrt(50.0)
    np.testing.assert_allclose(np.sort(by[0]), np.array([-1, -1, 1, 1]) * value / 100.0, rtol=1e-10)
    np.testing.assert_allclose(by[1], 0.0, atol=1e-10)


# The five-link car.

WHEEL, BODY = (lambda s: s.body("wheel").position[2]), (lambda s: s.body("chassis").position[2])


def five_link(moved):
    """The car on a flat road, its hardpoints moved."""
    car = lg.examples.QuarterCar.load()
    car = car.with_values(bump_height=0.0, hardpoints=car.hardpoints + moved)
    return car.model(wheel="locked", chassis="heave", links="rods")


@jax.jit
def five_link_modes(moved):
    return lg.linearize(five_link(moved), outputs={"wheel": WHEEL, "chassis": BODY})


@pytest.mark.slow
def test_five_link_car_beside_its_simulation():
    """From v = ± ε Z ν the difference of two runs is the exponential of A.

    Bodies move by up to 5e-5 m, 2e-4 of their arms: the cubic part is 4e-8 of the motion. The steps of Richardson's
    scheme are h = 0.5 ms, (ω h)⁴ = (60 · 5e-4)⁴ = 8e-7 in each 1/ω, six of these.
    """
    still = jnp.zeros((5, 3))
    linear, model = five_link_modes(still), five_link(still)
    rest = linear.state
    assert linear.A.shape == (4, 4)
    size, steps = 0.01, 200

    @jax.jit
    def run(direction):
        v = size * (linear.basis @ direction)
        vdot, lam = accelerations(linear.system, rest.q, v, jnp.zeros(()))
        start = lg.State(q=rest.q, v=v, vdot=vdot, lam=lam, a=vdot)
        motion = lg.simulate(model, t1=0.1, num_steps=steps, state0=start, integrator=lg.Richardson())
        return motion.t, jnp.stack([motion.body(name).position[:, 2] for name in linear.outputs], axis=1)

    for direction in np.eye(2):
        t, up = run(direction)
        _, down = run(-direction)
        found = (up - down)[::20] / (2 * size)
        start = np.concatenate([np.zeros(2), direction])
        expected = np.array([linear.C @ scipy.linalg.expm(np.asarray(linear.A) * time) @ start for time in t[::20]])
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.slow
def test_five_link_car_by_hardpoints():
    """Of eigenvalues along a random direction, by central differences of sixth order: 1e-3 m of arms of 0.3 m."""
    direction = np.random.default_rng(0).normal(size=(5, 3))
    of = lambda step: five_link_modes(jnp.asarray(direction * step)).eigenvalues
    _, derivative = jax.jvp(lambda step: five_link_modes(direction * step).eigenvalues, (0.0,), (1.0,))
    expected = central(lambda step: np.asarray(of(step)), 1e-3)
    np.testing.assert_allclose(derivative, expected, rtol=1e-8)


@pytest.mark.slow
def test_a_wheel_that_turns_freely_is_a_repeated_zero():
    model = lg.examples.QuarterCar.load().model(wheel="hinged", chassis="heave", links="rods")
    linear = lg.linearize(model)
    assert list(linear.repeated) == [True, True, False, False, False, False]
    assert np.abs(linear.eigenvalues[:2]).max() < 1e-7 * np.abs(linear.eigenvalues).max()  # √ε of the largest


def test_a_mode_as_a_motion(car):
    """One period, both masses in the ratio and phase of the shape, velocities the rates of positions."""
    run, masses = car.mode_motion(0, amplitude=0.02, num_steps=96), ("sprung", "unsprung")
    omega = 2.0 * np.pi * float(car.frequencies[0])
    np.testing.assert_allclose(run.t[-1], 2.0 * np.pi / omega, rtol=1e-12)
    turn = np.exp(1j * omega * np.asarray(run.t))
    heights = [np.asarray(run.body(name).position[:, 2]) for name in masses]
    found = np.array([2.0 / 96 * np.conj(turn[:-1]) @ height[:-1] for height in heights])
    shape = np.array([car.mode_shape(name).translation[0, 2] for name in masses])
    np.testing.assert_allclose(found[0] / found[1], shape[0] / shape[1], rtol=1e-10)
    np.testing.assert_allclose(np.abs(found).max(), 0.02 * np.max(run.system.coordinate_scale()), rtol=1e-10)
    for name, part in zip(masses, found):
        velocity = np.real(1j * omega * part * turn)
        np.testing.assert_allclose(run.body(name).velocity[:, 2], velocity, atol=1e-10 * np.abs(velocity).max())
    with pytest.raises(ValueError, match=says("`index` must be a Python int, the place of one of 4", "got 4")):
        car.mode_motion(4)


# Random road.


def test_random_road_in_closed_form(car):
    """Of the tyre's load the integral of its transfer function by quadrature; a height has no variance."""
    found = lg.random_road(car, **ROAD)
    np.testing.assert_allclose([found["acceleration"], found["stroke"]], on_a_road(**CAR), rtol=1e-10)
    a, b, c, d = two_masses(**CAR)

    def density(omega):  # of the load, by ż: H/iω
        response = c[2] @ np.linalg.solve(1j * omega * np.eye(4) - a, b) + d[2]
        return np.abs(response / omega) ** 2 * INTENSITY / np.pi

    parts = [
        quad(density, *ends, limit=200, epsabs=0, epsrel=1e-11)[0] for ends in ((1e-9, 20), (20, 200), (200, np.inf))
    ]
    np.testing.assert_allclose(found["tyre"] ** 2, sum(parts), rtol=1e-9)
    assert found["height"] == np.inf


def test_random_road_in_other_coordinates(car):
    """Also where the static response is one of them, and what an output sees of the others is round-off."""
    rest = -np.linalg.solve(car.A, car.B)[:2]
    turn = np.linalg.qr(np.hstack([rest, [[0.0], [1.0]]]))[0]
    t = scipy.linalg.block_diag(turn, turn)
    turned = dataclasses.replace(car, A=jnp.asarray(t.T @ car.A @ t), B=jnp.asarray(t.T @ car.B), C=car.C @ t)
    found, expected = lg.random_road(turned, **ROAD), lg.random_road(car, **ROAD)
    np.testing.assert_allclose([*found.values()], [*expected.values()], rtol=1e-10)


def test_two_masses_over_random_roads(car):
    """In time; the slower mode, e^(−1.58 t), leaves 4e-4 of a variance after 2.5 s, and 2e-5 of it on the mean."""
    outputs = {name: f for name, f in SEEN.items() if name != "height"}  # which has no variance
    compared(lg.examples.linear_quarter_car(**CAR), car, outputs, runs=64, t1=6.0, settled=2.5, h=0.01)


def test_random_road_weighted_by_frequency(car):
    """By quadrature of the closed transfer function and of the weighting; the gradient by differences of that."""
    weighting = lg.FrequencyWeighting("Wk")
    found = lg.random_road(car, **ROAD, weighting={"acceleration": weighting})
    a, b, c, d = two_masses(**CAR)
    matrices = [np.asarray(of) for of in weighting.matrices()]

    def density(omega):
        s = 1j * omega
        response = c[0] @ np.linalg.solve(s * np.eye(4) - a, b) + d[0]
        weight = matrices[2] @ np.linalg.solve(s * np.eye(8) - matrices[0], matrices[1])
        return np.abs(weight * response / omega) ** 2 * INTENSITY / np.pi

    ends = (1e-9, 3, 20, 60, 200, 2000, np.inf)
    square = sum(quad(density, *pair, limit=200, epsabs=0, epsrel=1e-11)[0] for pair in pairwise(ends))
    np.testing.assert_allclose(found["acceleration"] ** 2, square, rtol=1e-8)
    plain = lg.random_road(car, **ROAD)
    assert found["acceleration"] < plain["acceleration"]
    np.testing.assert_allclose(found["stroke"], plain["stroke"], rtol=1e-12)
    with pytest.raises(ValueError, match=says("`weighting` must give outputs of `linear`", "'noise'")):
        lg.random_road(car, **ROAD, weighting={"noise": weighting})


def test_what_is_refused(car):
    body = lg.RigidBody(1.0, (1.0,) * 3, position=UP, free="z")
    model = lg.Model({"b": body}, {}, {"g": lg.Gravity((0.0, 0.0, -G))})
    with pytest.raises(ValueError, match=says("`inputs`: 'g' is not one of []")):
        lg.linearize(model, inputs=("g",))
    with pytest.raises(ValueError, match=says("`outputs['z']` must be a function")):
        lg.linearize(model, outputs={"z": 1.0})
    with pytest.raises(ValueError, match=says("`rotation` is that of a motion")):
        lg.linearize(model, rotation=UP)
    with pytest.raises(ValueError, match=says("leave no freedom")):
        lg.linearize(lg.Model({"b": body}, {"d": lg.TranslationDriver(None, "b", at=UP, axis=UP)}))
    with pytest.raises(lg.SimulationError, match=says("No static equilibrium")):
        lg.linearize(model)
    with pytest.raises(ValueError, match=says("must have one input")):
        lg.random_road(dataclasses.replace(car, inputs=()), roughness=1e-6, speed=1.0)
    with pytest.raises(ValueError, match=says("`roughness`: 'Z' is not one of ['A', 'B'", "classes of ISO 8608")):
        lg.random_road(car, roughness="Z", speed=1.0)
    with pytest.raises(ValueError, match=says("`speed` must be positive, got -1.0")):
        lg.SampledRoad.random(jax.random.key(0), [0.0, 1.0], roughness="A", speed=-1.0)
    unstable = dataclasses.replace(car, eigenvalues=-car.eigenvalues)
    with pytest.raises(ValueError, match=says("`linear` must settle")):
        lg.random_road(unstable, roughness=1e-6, speed=1.0)

    def travel(sense):
        turned = dataclasses.replace(car, A=sense * car.A, eigenvalues=sense * car.eigenvalues)
        return lg.random_road(turned, roughness=1e-6, speed=1.0)[car.outputs[0]]

    of = jax.jit(jax.value_and_grad(travel))
    assert np.isfinite(of(1.0)).all() and np.isnan(of(-1.0)).all()  # neither a number nor a derivative


@pytest.mark.slow  # `test_kinematics` and `test_equilibrium` have such places in the quick run
def test_far_from_the_origin():
    """Two bolts of 1 g on 1e9 N/m: round-off of 1 km is 1e-13 m × 1e12 /s². Their frequencies as at the origin."""

    def frequencies(far):
        at = lambda x, y=0.0: jnp.array([far + x, y, 0.0])
        bodies = {name: lg.RigidBody(1e-3, (1e-9,) * 3, position=at(x)) for name, x in (("a", 0.0), ("b", 0.1))}
        rates = {"stiffness": [1e9] * 3, "rotational_stiffness": [1e3] * 3}
        forces = {
            "mount": lg.Bushing(None, "a", at=at(-0.1, 0.02), **rates),
            "rubber": lg.Bushing("a", "b", at=at(0.05, 0.02), **rates),
        }
        model = lg.Model(bodies, {}, forces | {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
        return lg.linearize(model, lg.equilibrium(model)).frequencies

    # 1e-16 × 1 km/0.1 m of the stiffness, × 1e2
    np.testing.assert_allclose(frequencies(1e3), frequencies(0.0), rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("elements", [1, 4])
def test_a_stiff_beam_is_steady_at_its_own_equilibrium(elements):
    """Its lumps turn at 1e5 rad/s and more: round-off of the configuration accelerates them by 1e-4 1/s²."""
    section = lg.BeamSection.rectangle(0.02, 0.004, young=2.1e11, poisson=0.3, density=7850.0)
    beam = lg.Beam("beam", section, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], elements=elements)
    clamp = {"clamp": lg.FixedJoint(None, "beam.0", at=(0.0, 0.0, 0.0))}
    model = lg.Model(beam.bodies, clamp, beam.forces | {"g": lg.Gravity((0.0, 0.0, -9.81))}, merge_fixed=True)
    here, there = (lg.linearize(model, *state).frequencies[0] for state in ((), (lg.equilibrium(model),)))
    np.testing.assert_allclose(there, here, rtol=1e-8)  # √ε of the configuration that either iteration leaves
