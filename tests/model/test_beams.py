"""Beams: the element against its energy, statics against the equations of the rod, motion, derivatives."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
from helpers import central_difference, close, moved

import lgsens as lg
from lgsens.model import load_tangents
from lgsens.testing import check_force

STEEL = {"young": 2.1e11, "poisson": 0.3, "density": 7850.0}
UNIT = lg.BeamSection([3.0, 2.0, 2.5, 1.0, 1.5, 0.7], 1.0, [0.2, 0.1, 0.1], damping=0.05)
LOADS = {"P": jnp.linspace(0.0, 1.0, 4)}


def homogeneous(R, x):
    H = jnp.zeros((4, 4)).at[3, 3].set(1.0)
    return H.at[:3, :3].set(R).at[:3, 3].set(x)


def potential(load, a, b, t):
    """L (σ₀ᵀε + ½ εᵀK ε), with the logarithm of the 4×4 matrix of the motion by its power series in H − I near I:
    log H = 2ᵏ log H^(1/2ᵏ), the root by Newton (Denman & Beavers)."""
    ends = [
        homogeneous(frame.orientation @ triad, frame.position + frame.orientation @ point)
        for frame, point, triad in ((a, load.point_a, load.triad_a), (b, load.point_b, load.triad_b))
    ]
    H, eye = jnp.linalg.inv(ends[0]) @ ends[1], jnp.eye(4)
    nearer = lambda _, pair: ((pair[0] + jnp.linalg.inv(pair[1])) / 2, (pair[1] + jnp.linalg.inv(pair[0])) / 2)
    H = jax.lax.fori_loop(0, 6, lambda _, H: jax.lax.fori_loop(0, 12, nearer, (H, eye))[0], H)
    X, power, D = H - eye, H - eye, jnp.zeros((4, 4))
    for n in range(1, 13):  # |X| is at most π/64 and the translation's: X¹³ is round-off
        D, power = D - (-1.0) ** n / n * power, power @ X
    D = 64.0 * D
    d = jnp.stack([D[0, 3], D[1, 3], D[2, 3], D[2, 1], D[0, 2], D[1, 0]])
    strain = (d - load.reference) / load.length
    return load.length * (load.preload @ strain + 0.5 * strain @ load.stiffness @ strain)


def element():
    """With axes that are not those of its bodies, and a preload."""
    rotation = lambda w: lg.liegroups.SO3().exp(jnp.asarray(w))
    bodies = {
        "a": lg.RigidBody(1.0, (1.0, 1.0, 1.0), (0.1, 0.0, 0.2), rotation([0.3, -0.2, 0.1])),
        "b": lg.RigidBody(1.0, (1.0, 1.0, 1.0), (0.9, 0.1, -0.1), rotation([-0.1, 0.4, 0.2])),
    }
    axes = {"axes_a": rotation([0.1, 0.2, 0.0]), "axes_b": rotation([0.2, 0.1, 0.3])}
    beam = lg.BeamElement(
        "a",
        "b",
        at_a=[0.2, 0.1, 0.0],
        at_b=[1.1, 0.2, 0.1],
        **axes,
        section=UNIT,
        preload=[0.3, -0.1, 0.2, 0.1, -0.2, 0.1],
    )
    return bodies, beam


@pytest.mark.slow  # small version: test_tangents_of_an_element
def test_element_is_the_gradient_of_its_energy():
    """Also tangents, action and reaction, damping that takes energy, and derivatives by every number."""
    bodies, beam = element()
    report = check_force(beam, potential=potential, bodies=bodies, length=0.3)
    assert report.passed, report


def test_tangents_of_an_element():
    """Those of its force by autodiff, which at rest is the gradient of its energy."""
    bodies, beam = element()
    ((load, *_),) = beam.loads(bodies)
    rng, t, zero = np.random.default_rng(0), jnp.zeros(()), jnp.zeros(12)
    frames = [moved(body.frame, 0.2 * rng.normal(size=6)) for body in bodies.values()]

    @jax.jit
    def given_and_expected(load, a, b, v):
        displaced = lambda x: (moved(a, x[:6]), moved(b, x[6:]))
        force = lambda x, v: load.force(*displaced(x), v[:6], v[6:], t)
        given = load_tangents(load, a, b, v[:6], v[6:], t)
        return given, (jax.jacfwd(force)(zero, v), jax.jacfwd(force, 1)(zero, v)), force(zero, zero)

    given, expected, at_rest = given_and_expected(load, *frames, jnp.asarray(rng.normal(size=12)))
    for found, wanted in zip(given, expected):
        close(found, wanted, 200)  # some ten products
    energy = jax.jit(lambda x: potential(load, *(moved(f, p) for f, p in zip(frames, jnp.split(x, 2))), t))
    # of third derivatives of up to 10 4e-11; round-off of the root of H is 64 ε, and over a step of 6e-6
    np.testing.assert_allclose(at_rest, -central_difference(energy, 12), rtol=0, atol=4e-9)


def tip(model, node):
    return lg.statics(model, loads=LOADS, throw=False).body(node).position[-1]


def cantilever(beam, force=(0.0, 0.0, 0.0), moment=(0.0, 0.0, 0.0)):
    end = beam.nodes[-1]
    load = lg.AppliedForce(end, at=beam.points[-1], force=force, moment=moment)
    clamp = lg.FixedJoint(None, beam.nodes[0], at=beam.points[0])
    return lg.Model(beam.bodies, {"clamp": clamp}, beam.forces | {"P": load}, merge_fixed=True)


@pytest.mark.slow  # `test_a_beam_that_is_bent_by_three_radians_at_once` is in the quick run
def test_bent_to_a_circle():
    """M = 2π EI/L closes a straight beam: tip at the clamp, with two elements as with many, no shear that locks."""
    bending, length = 86900.0, 10.0
    section = lg.BeamSection([1e6, 1e6, 1e6, bending, bending, bending], 1.0, [1.0, 0.5, 0.5])
    beam = lg.Beam("b", section, [[0, 0, 0], [length, 0, 0]], elements=4)
    moment = 2 * np.pi * bending / length
    # Half of it bends it to a half circle of diameter 2L/π. Newton ends below 1e-10 of a meter.
    for factor, end in ((0.5, (0.0, 2 * length / np.pi, 0.0)), (1.0, (0.0, 0.0, 0.0))):
        found = tip(cantilever(beam, moment=(0.0, 0.0, factor * moment)), "b.4")
        np.testing.assert_allclose(found, end, rtol=0, atol=1e-9)


def rod(section, force, length, bend=0.0):
    """The tip by shooting on the equations of the rod: r′ = R (e₁ + K⁻¹ Rᵀn), R′ = R κ~, m′ = −r′ × n, with n = P all
    along, κ = κ₀ + K⁻¹ Rᵀm, and m = 0 at the tip."""
    K, initial = np.asarray(section.stiffness), np.array([0.0, 0.0, bend])

    def slope(_, y):
        R, m = y[3:12].reshape(3, 3), y[12:]
        along = R @ (np.array([1.0, 0.0, 0.0]) + R.T @ force / K[:3])
        k = initial + R.T @ m / K[3:]
        turning = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
        return np.concatenate([along, (R @ turning).ravel(), -np.cross(along, force)])

    def end(moment):
        y = np.concatenate([np.zeros(3), np.eye(3).ravel(), moment])
        return scipy.integrate.solve_ivp(slope, (0.0, length), y, rtol=1e-10, atol=1e-12).y[:, -1]

    guess = np.cross([length, 0.0, 0.0], force) / 2
    found = scipy.optimize.root(lambda m: end(m)[12:], guess, tol=1e-11)
    assert found.success
    return end(found.x)[:3]


PRINCETON = {"width": 3.2024e-3, "height": 12.3777e-3, "young": 71.7e9, "poisson": 0.31, "density": 2800.0}


def princeton(elements, angle, force=8.896):
    section = lg.BeamSection.rectangle(**PRINCETON)
    beam = lg.Beam("b", section, [[0, 0, 0], [0.508, 0, 0]], elements=elements)
    load = force * np.array([0.0, np.sin(angle), np.cos(angle)])
    return beam, load


@pytest.mark.slow  # programs of two statics
def test_princeton_beam():
    """Bent about both axes and twisted: order two against the rod's equations, and the published deflection."""
    angle = np.radians(45.0)
    found = {}
    for elements in (4, 8):
        beam, load = princeton(elements, angle)
        found[elements] = np.asarray(tip(cantilever(beam, load), beam.nodes[-1]))
    exact = rod(beam.section, load, 0.508)
    errors = {elements: np.abs(end - exact).max() for elements, end in found.items()}
    assert errors[4] / errors[8] == pytest.approx(4.0, abs=0.4)  # order 2, with the next term
    extrapolated = (4 * found[8] - found[4]) / 3
    assert np.abs(extrapolated - exact).max() < errors[8] / 20  # the next term, of order 4, at 8 elements
    assert abs(extrapolated[1]) == pytest.approx(0.1089879, rel=5e-3)  # Ansys, of another torsion constant


@pytest.mark.slow  # programs of two statics
def test_curved_cantilever():
    """An eighth of a circle, clamped, loaded across its plane: 8 elements are ten times as good as of order one."""
    section = lg.BeamSection([1e7, 5e6, 5e6, 7e5, 8.3e5, 8.3e5], 1.0, [0.2, 0.1, 0.1])
    radius, angle, load = 100.0, np.pi / 4, np.array([0.0, 0.0, 300.0])
    errors = []
    for elements in (4, 8):
        along = np.linspace(0.0, angle, elements + 1)
        points = radius * np.stack([np.sin(along), 1 - np.cos(along), 0 * along], axis=1)
        beam = lg.Beam("b", section, points)
        exact = rod(section, load, radius * angle, bend=1 / radius)
        errors.append(np.abs(np.asarray(tip(cantilever(beam, load), beam.nodes[-1])) - exact).max())
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.4)


def frequencies(section, elements, length=1.0):
    """Of the modes, in rad/s."""
    beam = lg.Beam("b", section, [[0, 0, 0], [length, 0, 0]], elements=elements)
    clamp = lg.FixedJoint(None, "b.0", at=[0.0, 0.0, 0.0])
    model = lg.Model(beam.bodies, {"clamp": clamp}, beam.forces, merge_fixed=True)
    return 2 * np.pi * lg.linearize(model, lg.initial_state(model)).frequencies[::2]  # without their conjugates


@pytest.mark.slow  # programs of two linearizations
def test_frequencies_of_a_cantilever():
    """β₁² √(EI/ρA)/L² for bending (Euler–Bernoulli, for a section so slender), order two, and their derivatives."""
    of_bending = lambda second: lg.BeamSection(jnp.array([1e8, 1e8, 1e8, 1.0, 1.0, second]), 1.0, [1e-6, 1e-6, 1e-6])
    expected = 1.8751040687**2 * np.array([1.0, 2.0])
    errors = [np.abs(np.asarray(frequencies(of_bending(4.0), n)[:2]) / expected - 1) for n in (4, 8)]
    assert np.all(errors[1] < 0.01)
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, atol=0.4)  # order 2, with the next term
    value, slope = jax.jvp(lambda k: frequencies(of_bending(k), 4)[:2], (4.0,), (1.0,))
    # ω ∝ √k of the second, with the rotary inertia; the eigenvalues' round-off, 1e8 of stiffness over 1.
    np.testing.assert_allclose(slope, [0.0, value[1] / 8.0], rtol=0, atol=1e-6)


def swinging(p):
    section = lg.BeamSection.rectangle(
        p["width"], p["height"], young=p["young"], poisson=p["poisson"], density=p["density"], damping=p["damping"]
    )
    points = p["points"]
    beam = lg.Beam("b", section, points, up=p["up"])
    joints = {"hinge": lg.RevoluteJoint(None, "b.0", at=points[0], axis=p["up"])}
    return lg.Model(beam.bodies, joints, beam.forces | {"gravity": lg.Gravity((0.0, -9.81, -3.0))})


NUMBERS = {
    "width": jnp.asarray(0.02),
    "height": jnp.asarray(0.03),
    "young": jnp.asarray(5e6),
    "poisson": jnp.asarray(0.4),
    "density": jnp.asarray(1000.0),
    "damping": jnp.asarray(1e-3),
    "points": jnp.asarray([[0.0, 0.0, 0.0], [0.3, 0.05, 0.0], [0.6, 0.0, 0.02]]),
    "up": jnp.asarray([0.1, 0.0, 1.0]),
}


@pytest.mark.slow  # three programs of a motion; the element's own derivatives are in the quick run
def test_derivatives_of_a_swinging_beam():
    """DDM, AVM and differences by shape, material, points and direction of a soft curved beam on a hinge."""

    def end(p, sensitivity):
        run = lg.simulate(swinging(p), t1=0.02, num_steps=10, sensitivity=sensitivity)
        state = run.force("b.1")
        return jnp.sum(run.body("b.2").position[-1]) + 1e-2 * jnp.sum(state.fibre_strain(0.01, 0.015))

    adjoint = jax.jit(jax.grad(partial(end, sensitivity=lg.AdjointVariable())))(NUMBERS)
    direct = jax.jit(jax.grad(partial(end, sensitivity=lg.DirectDifferentiation())))(NUMBERS)
    value = jax.jit(partial(end, sensitivity=lg.DirectDifferentiation()))
    rng = np.random.default_rng(0)
    for name, number in NUMBERS.items():
        scale = np.abs(np.asarray(direct[name])).max()
        np.testing.assert_allclose(adjoint[name], direct[name], rtol=0, atol=1e-10 * scale)
        along = jnp.asarray(rng.normal(size=number.shape)) * jnp.abs(number).max()
        at = lambda s, name=name, moved=along: value(NUMBERS | {name: NUMBERS[name] + s * moved})
        step = 1e-4  # of fourth order; the round-off of Newton 1e-11 over the step
        difference = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
        size = scale * float(jnp.abs(along).max())
        np.testing.assert_allclose(jnp.sum(direct[name] * along), difference, rtol=0, atol=1e-5 * size + 1e-7)


@pytest.mark.slow  # programs of statics and of its gradients
def test_derivatives_of_a_loaded_beam():
    """Forwards, backwards and differences by the same numbers of an equilibrium: the soft curved beam clamped and bent
    by a load, tip and strain of a fibre."""

    def bent(p):
        model = swinging({**p, "damping": jnp.zeros(())})
        clamp = {"clamp": lg.FixedJoint(None, "b.0", at=p["points"][0])}
        push = {"push": lg.AppliedForce("b.2", at=p["points"][2], force=[0.1, 0.5, 0.3])}
        run = lg.statics(lg.Model(model.bodies, clamp, model.forces | push, merge_fixed=True), loads={"push": [1.0]})
        return run.body("b.2").position[-1], 10.0 * run.force("b.1").fibre_strain(0.01, 0.015)[-1]

    numbers = {name: number for name, number in NUMBERS.items() if name != "damping"}
    total = lambda p: (lambda tip, strain: jnp.sum(tip * jnp.array([1.0, 2.0, -1.0])) + strain)(*bent(p))
    forwards, backwards, value = (jax.jit(of(total)) for of in (jax.jacfwd, jax.grad, lambda f: f))
    direct, adjoint = forwards(numbers), backwards(numbers)
    assert np.linalg.norm(bent(numbers)[0] - numbers["points"][2]) > 0.05
    rng = np.random.default_rng(0)
    for name, number in numbers.items():
        scale = np.abs(np.asarray(direct[name])).max()
        np.testing.assert_allclose(adjoint[name], direct[name], rtol=0, atol=1e-10 * scale)
        along = jnp.asarray(rng.normal(size=number.shape)) * jnp.abs(number).max()
        at = lambda s, name=name, moved=along: value(numbers | {name: numbers[name] + s * moved})
        step = 1e-3  # of fourth order; what Newton leaves, 1e-11, over the step
        difference = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
        size = scale * float(jnp.abs(along).max())
        np.testing.assert_allclose(jnp.sum(direct[name] * along), difference, rtol=0, atol=1e-6 * size + 1e-8)


@pytest.mark.slow
def test_free_flight_keeps_momenta():
    """A soft beam thrown: a rigid motion leaves strains at round-off, forces between nodes move no centre of mass."""
    beam = lg.Beam("b", UNIT, [[0, 0, 0], [2.0, 0, 0]], elements=3)
    still = lg.Model(
        {name: dataclasses.replace(body, velocity=jnp.asarray([1.0, 2.0, 3.0])) for name, body in beam.bodies.items()},
        {},
        beam.forces,
    )
    run = lg.simulate(still, t1=1.0, num_steps=100)
    assert np.abs(run.force("b.1").strain).max() < 1e-13  # positions of 3 m to round-off
    kicked = with_velocity(still, "b.3", jnp.asarray([0.0, 5.0, 1.0]))
    run = lg.simulate(kicked, t1=1.0, num_steps=100)
    masses = np.array([float(body.mass) for body in beam.bodies.values()])
    momentum = sum(m * np.asarray(run.body(name).velocity) for m, name in zip(masses, beam.nodes))
    assert np.abs(run.force("b.1").curvature).max() > 0.1
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), rtol=0, atol=1e-9)  # of Newton


@pytest.mark.slow  # a long run
def test_beam_that_spins_is_stretched():
    """tan(αL)/α − L, α = Ω √(ρA/EA), at a constant speed (Simo & Vu-Quoc 1988); damped, so that it comes to rest."""
    section = lg.BeamSection([2.8e7, 1e7, 1e7, 4e6, 4e6, 4e6], 1.2, [1.2e-3, 6e-4, 6e-4], damping=0.02)
    beam = lg.Beam("b", section, [[0, 0, 0], [10.0, 0, 0]], elements=4)
    bodies = {
        name: dataclasses.replace(
            body, velocity=jnp.cross(jnp.array([0.0, 0.0, 6.0]), body.position), angular_velocity=[0.0, 0.0, 6.0]
        )
        for name, body in beam.bodies.items()
    }
    hinge = {"hinge": lg.RevoluteJoint(None, "b.0", at=[0, 0, 0], axis=[0, 0, 1.0])}
    driver = {"driver": lg.RotationDriver(None, "b.0", axis=[0, 0, 1.0], value=lg.Polynomial([0.0, 6.0]))}
    run = lg.simulate(lg.Model(bodies, hinge | driver, beam.forces), t1=0.6, num_steps=600)
    stretch = np.linalg.norm(run.body("b.4").position[-1]) - 10.0
    # Masses at n nodes: Σ l Ω² Σ m_j r_j = (1 + 1/2n²) of the integral, but for (αL)²/n² = 1e-5; of the steps
    # (Ω h)²/6 = 6e-6; stretch and bending decay at 50 and 41 per second, to e⁻²⁴.
    np.testing.assert_allclose(stretch / (1 + 1 / 32), 5.143175e-4, rtol=3e-5)


@pytest.mark.slow  # 3,000 steps
def test_elbow_cantilever():
    """Two legs at a right angle, pushed out of their plane at the elbow (Simo & Vu-Quoc 1988): peaks of the tip."""
    section = lg.BeamSection([1e6, 1e6, 1e6, 1e3, 1e3, 1e3], 1.0, [20.0, 10.0, 10.0])
    a = lg.Beam("a", section, [[0, 0, 0], [10.0, 0, 0]], elements=6)
    b = lg.Beam("b", section, [[10.0, 0, 0], [10.0, 10.0, 0]], elements=6)
    joints = {
        "clamp": lg.FixedJoint(None, "a.0", at=[0, 0, 0]),
        "elbow": lg.FixedJoint("a.6", "b.0", at=[10.0, 0, 0]),
    }
    pulse = lg.Sampled([0.0, 1.0, 2.0, 40.0], [0.0, 50.0, 0.0, 0.0], "linear")
    load = lg.AppliedForce("a.6", force=[0, 0, 1.0], signal=pulse)
    model = lg.Model(a.bodies | b.bodies, joints, a.forces | b.forces | {"push": load}, merge_fixed=True)
    run = lg.simulate(model, t1=30.0, num_steps=3000)
    lifted, t = np.asarray(run.body("b.6").position[:, 2]), np.asarray(run.t)
    for peak, when in ((8.29, 7.67), (-9.67, 15.99), (6.98, 26.1)):
        near = np.abs(t - when) < 2.0
        place = np.argmax(np.sign(peak) * lifted * near)
        # Digits read from a figure: 2 % of the largest deflection, 1 % of the time.
        assert lifted[place] == pytest.approx(peak, abs=0.2)
        assert t[place] == pytest.approx(when, abs=0.3)


def with_velocity(model, name, velocity):
    bodies = model.bodies | {name: dataclasses.replace(model.bodies[name], velocity=velocity)}
    return lg.Model(bodies, model.joints, model.forces)


SAME_PLACE = {"at_a": [0, 0, 0], "at_b": [0, 0, 0], "axes_a": np.eye(3), "axes_b": np.eye(3)}


def test_sections():
    """A round bar is a tube of all its radius; the torsion of a square 0.1406 a⁴, of a strip a b³/3 (1 − 0.630 b/a)."""
    bar = lg.BeamSection.round(0.02, **STEEL)
    solid = lg.BeamSection.tube(0.02, 0.01, **STEEL)
    np.testing.assert_allclose(bar.stiffness, solid.stiffness, rtol=1e-14)
    shear = 2.1e11 / 2.6
    np.testing.assert_allclose(bar.stiffness[3], shear * np.pi * 0.01**4 / 2, rtol=1e-14)
    thin = lg.BeamSection.tube(0.5, 1e-4, **STEEL).stiffness  # k = 1/2 but for ν: 2 (1 + ν)/(4 + 3ν), Cowper
    np.testing.assert_allclose(thin[1] / (thin[0] / 2.6), 2 * 1.3 / 4.9, rtol=1e-3)  # the wall over the radius
    square = lg.BeamSection.rectangle(0.02, 0.02, **STEEL)
    np.testing.assert_allclose(square.stiffness[3] / shear / 0.02**4, 0.1406, atol=5e-5)  # the digits of the table
    strip = [lg.BeamSection.rectangle(*sides, **STEEL).stiffness[3] for sides in ((0.001, 0.1), (0.1, 0.001))]
    np.testing.assert_allclose(strip[0], strip[1], rtol=1e-13)
    np.testing.assert_allclose(strip[0] / shear, 0.1 * 0.001**3 / 3 * (1 - 0.630249 * 0.01), rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lg.BeamSection([1.0] * 5, 1.0, [1.0] * 3), r"`stiffness` must have shape \(6,\) or \(6, 6\)"),
        (lambda: lg.BeamSection([-1.0] + [1.0] * 5, 1.0, [1.0] * 3), "must be positive; what does not bend"),
        (lambda: lg.BeamSection([1.0] * 6, 0.0, [1.0] * 3), "`mass` must be positive"),
        (lambda: lg.BeamSection.round(0.02, **STEEL).stacked(0), "`count` must be positive"),
        (lambda: lg.BeamSection([1.0] * 6, 1.0, [1.0] * 3, damping=-1.0), "`damping` must not be negative"),
        (lambda: lg.BeamSection.tube(0.02, 0.02, **STEEL), "`thickness` is more than the radius"),
        (lambda: lg.BeamSection.round(0.02, **(STEEL | {"poisson": 0.7})), "`poisson` must be above -1"),
        (lambda: lg.Beam("b", UNIT, [[0, 0, 0]]), r"`points` must have shape \(m, 3\)"),
        (lambda: lg.Beam("b", UNIT, [[0, 0, 0], [0, 0, 0]]), "coincide"),
        (lambda: lg.Beam("b", UNIT, [[0, 0, 0], [0, 0, 1]]), "`up` .* lies along the beam"),
        (
            lambda: lg.BeamSection(np.eye(6) + 0.1 * np.eye(6, k=1), 1.0, [1.0] * 3),
            "must be symmetric: it is the second derivative",
        ),
        (
            lambda: lg.Beam("b", UNIT, np.eye(3), up=np.eye(2, 3)),
            r"`up` must have shape \(3,\), or of each node \(3, 3\)",
        ),
        (lambda: lg.Beam("b", UNIT, np.eye(3), elements=2), "`elements` is for a straight beam"),
        (lambda: lg.Beam("b", None, [[0, 0, 0], [1, 0, 0]]), "`section` must be a BeamSection"),
        (lambda: lg.BeamElement("a", "b", **SAME_PLACE, section=UNIT), "are the same point"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_what_is_known_is_no_operation_of_the_program():
    """A beam whose stiffness alone is traced: no operation for each of its nodes but the turn of its axes."""

    def operations(elements):
        def reference(stiffness):
            section = lg.BeamSection(stiffness, 1.0, [0.02, 0.01, 0.01])
            beam = lg.Beam("b", section, [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]], elements=elements)
            return lg.Model(beam.bodies, {}, beam.forces).system()

        return len(jax.make_jaxpr(reference)(jnp.ones(6)).eqns)

    assert operations(24) - operations(8) <= 2 * 16


@pytest.mark.parametrize("bends", [True, False])
def test_lumped_masses_and_what_consistent_ones_would_do(bends):
    """Frequencies of a beam on supports, and along it from a clamp, over those of the continuous one: the closed forms
    of `_beams`, whose consistent mass is three times as far off in bending."""
    count, length, bending, along, mass = 8, 1.0, 4.0, 1e4, 2.0
    section = lg.BeamSection([along, 1e7, 1e7, bending, bending, bending], mass, [1e-7, 1e-7, 1e-7])
    beam = lg.Beam("beam", section, [[0.0, 0.0, 0.0], [length, 0.0, 0.0]], elements=count)
    system = lg.Model(beam.bodies, {}, beam.forces).system()
    q, none = system.reference()[0], jnp.zeros(system.group.dim)
    stiffness = np.asarray(system.tangents(q, none, none, jnp.zeros(0), 0.0).stiffness)
    lumped, index = np.asarray(system.mass_matrix()), np.asarray(system.index)
    moved, turned = (index[:, 2], index[:, 4]) if bends else (index[:, 0], index[:0, 0])
    consistent, chain = lumped.copy(), np.zeros((count + 1, count + 1))
    for i in range(count):
        chain[i : i + 2, i : i + 2] += mass * length / count / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
    consistent[np.ix_(moved, moved)] = chain
    modes = np.arange(1, 5) if bends else np.arange(1, 5) - 0.5
    exact = modes * np.pi / length * np.sqrt((bending if bends else along) / mass)
    exact = exact * modes * np.pi / length if bends else exact
    free = np.ix_(*2 * [np.concatenate([moved[1:-1] if bends else moved[1:], turned])])
    over = lambda M: np.sqrt(scipy.linalg.eigh(stiffness[free], M[free], eigvals_only=True))[:4] / exact
    x = modes * np.pi / count / 2.0
    expected = np.sin(x) / x * (np.tan(x) / x if bends else 1.0)
    # shear, (jπ)² EI/(2 GA L²), 2e-6 j², is not in them, nor is that sections turn, (jπ)² J/(2 m L²); round-off
    tolerance = 1e-4 if bends else 1e-9
    np.testing.assert_allclose(over(lumped), expected, rtol=tolerance)
    np.testing.assert_allclose(over(consistent) * np.sqrt((2 + np.cos(2 * x)) / 3), expected, rtol=tolerance)
    off = (over(consistent)[1] - 1.0) / (over(lumped)[1] - 1.0)
    assert off == pytest.approx(3.0 if bends else -1.0, abs=0.1)  # x² is 0.15 at most
