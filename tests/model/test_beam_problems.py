"""Beams on published problems: twisted, slender, of a composite, thrown. Those of `test_beams.py` besides."""

import dataclasses
import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import lgsens as lg
from lgsens.examples import misaligned_four_bar

FOUR_BAR = json.loads((Path(__file__).parents[1] / "data" / "misaligned_four_bar.json").read_text(encoding="utf-8"))


def cantilever(section, length, elements, loads, up=(0.0, 0.0, 1.0)):
    """Along x, clamped at the origin, with forces by name at its tip."""
    beam = lg.Beam("b", section, [[0, 0, 0], [length, 0, 0]], elements=elements, up=up)
    forces = {name: lg.AppliedForce(beam.nodes[-1], force=force) for name, force in loads.items()}
    clamp = {"clamp": lg.FixedJoint(None, "b.0", at=[0, 0, 0])}
    return lg.Model(beam.bodies, clamp, beam.forces | forces, merge_fixed=True), beam


def tip(model, beam, load, sizes):
    return np.asarray(lg.statics(model, loads={load: sizes}).body(beam.nodes[-1]).position[-1] - beam.points[-1])


@pytest.mark.slow  # a program of statics; a beam bent to a circle is in the quick run
def test_a_slender_beam_does_not_lock():
    """P L³/3EI (1 − 1/4n²), the mean of the moment in each element being that at its middle, and P L/GA; L/h = 1e3."""
    section = lg.BeamSection.rectangle(1e-3, 1e-3, young=2e11, poisson=0.3, density=7850.0)
    shear, bending = section.stiffness[1], section.stiffness[4]
    model, beam = cantilever(section, 1.0, 2, {"P": [0.0, 0.0, 1e-6]})
    expected = 1e-6 * ((1 - 1 / 16) / (3 * bending) + 1 / shear)
    # 2e-5 of the length: (w/L)² = 4e-10, and round-off of the position over it
    np.testing.assert_allclose(tip(model, beam, "P", [1.0])[2], expected, rtol=1e-8)


TWISTED = lg.BeamSection.rectangle(0.32, 1.1, young=29e6, poisson=0.22, density=1.0)


def of_theory(axis):
    """∫ (L − s)² (cos²φ/EI + sin²φ/EI′) ds, and the same of shear: a load along y (1) or z (2), φ = π s/2L."""
    stiffness, length = np.asarray(TWISTED.stiffness), 12.0
    # at s = 0 a load along z bends about axis 2 and shears along 3
    first, second = ((1, 5), (2, 4)) if axis == 1 else ((2, 4), (1, 5))

    def density(s):
        c, d = np.cos(np.pi * s / (2 * length)) ** 2, np.sin(np.pi * s / (2 * length)) ** 2
        soft = lambda of: (length - s) ** 2 / stiffness[of[1]] + 1 / stiffness[of[0]]
        return c * soft(first) + d * soft(second)

    return quad(density, 0.0, length, epsabs=0, epsrel=1e-12)[0]


@pytest.mark.slow  # programs of statics
@pytest.mark.parametrize("elements", [8, 16])
def test_twisted_cantilever(elements):
    """Twisted by 90°, unit loads: 0.005424 and 0.001754 in (MacNeal & Harder, Finite Elem. Anal. Des. 1 (1985) 3)."""
    turn = np.pi / 2 * np.arange(elements + 1) / elements
    up = np.stack([0.0 * turn, -np.sin(turn), np.cos(turn)], axis=1)
    loads = {"y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}
    model, beam = cantilever(TWISTED, 12.0, elements, loads, up)
    published = {"y": 0.005424, "z": 0.001754}
    for axis, name in ((1, "y"), (2, "z")):
        at_rest = {other: [0.0] for other in loads if other != name}
        run = lg.statics(model, loads={name: [1.0]} | at_rest)
        found = float(run.body(beam.nodes[-1]).position[-1, axis])
        theory = of_theory(axis)
        assert abs(theory - published[name]) < 0.003 * published[name]  # the coefficient of shear, and that of torsion
        # of second order; the coefficients by refinement, of which the next order is 1/n² again
        coefficient = {"y": -0.371, "z": -0.718}[name]
        np.testing.assert_allclose((found / theory - 1) * elements**2, coefficient, rtol=0.015)


# Wang et al., Wind Energy 20 (2017) 1439: lb, in, s; the numbers as in Kynema's dynamic_composite_beam_bending.cpp
STIFFNESS = np.diag([1368.17e3, 88.56e3, 38.78e3, 16.96e3, 59.12e3, 141.47e3])
STIFFNESS[3:, 3:] += np.array([[0, 17.61, -0.351], [17.61, 0, -0.37], [-0.351, -0.37, 0]]) * 1e3
COMPOSITE = lg.BeamSection(STIFFNESS, 8.538e-2, [1.44332e-2, 0.40972e-2, 1.0336e-2])


@pytest.mark.slow  # programs of two statics
def test_composite_cantilever():
    """At rest under the same load: twelve digits of BeamDyn and Kynema (static_composite), all three displacements."""
    ends = {}
    for elements in (8, 16):
        model, beam = cantilever(COMPOSITE, 10.0, elements, {"P": [0.0, 0.0, 150.0]})
        ends[elements] = tip(model, beam, "P", [0.25, 0.5, 0.75, 1.0])
    published = np.array([-9.02726627566299e-2, -6.47488486259036e-2, 1.22973648292371])
    coarse, fine = (ends[n] - published for n in (8, 16))
    np.testing.assert_allclose(coarse / fine, 4.0, rtol=2e-3)  # 1/n² and 1/n⁴
    np.testing.assert_allclose((4 * fine - coarse) / 3, 0.0, atol=3e-7)  # 1/n⁴ of it


@pytest.mark.slow  # 600 steps of 16 elements
def test_composite_cantilever_under_a_sudden_load():
    """Bending and torsion coupled; the deflection by BeamDyn (one element of five nodes, h = 5 ms), a code's value."""
    deflections = [0.76836577, 2.05348501, 2.20529689, 1.10647129, 0.15758876, 0.55309539]  # at 0.05, 0.1, … 0.3 s
    ends = {}
    for elements in (8, 16):
        model, beam = cantilever(COMPOSITE, 10.0, elements, {"P": [0.0, 0.0, 150.0]})
        run = lg.simulate(model, t1=0.3, num_steps=600)
        ends[elements] = np.asarray(run.body(beam.nodes[-1]).position)[100::100]
    assert np.abs(ends[16] - ends[8]).max() < 0.03  # a quarter of it is left
    # Runs of ours with h = 5 ms and ρ∞ = 0 to 0.9 differ by 0.06 from each other.
    np.testing.assert_allclose(ends[16][:, 2], deflections, rtol=0, atol=0.06)
    assert np.ptp(ends[16][:, 1]) > 0.5  # which comes of the coupling alone


def spaghetti(num_steps):
    """Momentum, angular momentum less its impulse, and energy, of a beam thrown by a force and moments."""
    section = lg.BeamSection([1e4, 1e4, 1e4, 500.0, 500.0, 500.0], 1.0, [10.0, 10.0, 10.0])
    beam = lg.Beam("b", section, [[6.0, 0, 0], [0, 8.0, 0]], elements=8)
    pulse = lg.Sampled([0.0, 2.5, 5.0, 50.0], [0.0, 1.0, 0.0, 0.0], "linear")
    push = lg.AppliedForce("b.0", force=[20.0, 0, 0], fixed_moment=[0.0, 200.0, 100.0], signal=pulse)
    run = lg.simulate(lg.Model(beam.bodies, {}, beam.forces | {"push": push}), t1=10.0, num_steps=num_steps)
    as_arrays = lambda of: type(of)(*map(np.asarray, of))
    motions, states = [as_arrays(run.body(n)) for n in beam.nodes], [as_arrays(run.force(n)) for n in beam.forces]
    nodes = [(np.asarray(b.mass), np.asarray(b.inertia), of) for b, of in zip(beam.bodies.values(), motions)]
    momentum = sum(m * of.velocity for m, _, of in nodes)
    spin = sum(np.einsum("nij,nj->ni", of.orientation, of.angular_velocity * J) for _, J, of in nodes)
    angular = spin + sum(m * np.cross(of.position, of.velocity) for m, _, of in nodes)
    strains = [np.concatenate([state.strain, state.curvature], axis=1) for state in states]
    twice = sum(m * np.sum(of.velocity**2, axis=1) + np.sum(J * of.angular_velocity**2, axis=1) for m, J, of in nodes)
    twice = twice + sum(1.25 * np.sum(np.asarray(section.stiffness) * strain**2, axis=1) for strain in strains)

    t = np.asarray(run.t)
    factor = np.interp(t, [0.0, 2.5, 5.0], [0.0, 1.0, 0.0])[:, None]
    rates = factor * [0.0, 200.0, 100.0] + np.cross(motions[0].position, factor * [20.0, 0.0, 0.0])
    impulse = np.concatenate([np.zeros((1, 3)), np.cumsum((rates[1:] + rates[:-1]) / 2, axis=0)]) * (10.0 / num_steps)
    return momentum, angular - impulse, twice[t > 5.01] / 2


@pytest.mark.slow  # 3,000 steps
def test_flying_spaghetti():
    """Simo & Vu-Quoc (1988): momenta are the impulses, energy stays when nothing acts, both as the scheme says."""
    runs = [spaghetti(n) for n in (1000, 2000)]
    for momentum, _, energy in runs:
        np.testing.assert_allclose(momentum[-1], [50.0, 0.0, 0.0], rtol=0, atol=1e-8)  # of Newton; 20 N × 5 s / 2
        assert np.ptp(energy) < 2e-5 * energy[0]
    left = [np.abs(angular).max() for _, angular, _ in runs]
    assert left[0] < 2e-4 * 370.0  # of what it is in the end
    np.testing.assert_allclose(left[0] / left[1], 4.0, rtol=0.1)


@pytest.mark.slow  # 800 steps
def test_flexible_slider_crank():
    """Moments that bend a coupler far below its modes: those of the inertia of its nodes on the rigid mechanism, a beam
    on two supports, in closed form. Five turns a second, Ω/ω₁ = 1/60."""
    r, length, speed, n = 0.1, 0.3, 10.0 * np.pi, 8
    section = lg.BeamSection.rectangle(0.012, 0.012, young=2e11, poisson=0.3, density=7850.0, damping=2e-4)
    beam = lg.Beam("c", section, [[r, 0, 0], [r + length, 0, 0]], elements=n)
    bodies = {
        "crank": lg.RigidBody(1.0, (1e-3, 1e-3, 1e-3), angular_velocity=(0, 0, speed), free="rz"),
        "slider": lg.RigidBody(0.2, (1e-3, 1e-3, 1e-3), position=(r + length, 0, 0), free="x"),
    }
    turning = {"angular_velocity": jnp.asarray([0.0, 0.0, -r * speed / length])}  # about the piston, as a rigid one
    for name, node in beam.bodies.items():
        across = jnp.stack([0.0, speed * r * (r + length - node.position[0]) / length, 0.0])
        bodies[name] = dataclasses.replace(node, velocity=across, **turning)
    z = (0, 0, 1.0)
    joints = {
        "pin": lg.RevoluteJoint("crank", "c.0", at=(r, 0, 0), axis=z),
        "piston": lg.RevoluteJoint("slider", beam.nodes[-1], at=(r + length, 0, 0), axis=z),
        "motor": lg.RotationDriver(None, "crank", axis=z, value=lg.Polynomial([0.0, speed])),
    }
    run = lg.simulate(lg.Model(bodies, joints, beam.forces), t1=0.4, num_steps=800)

    t = np.asarray(run.t)[400:]
    c, d = np.cos(speed * t), np.sin(speed * t)
    root = np.sqrt(length**2 - (r * d) ** 2)
    first = -(r**2) * speed * d * c / root
    second = -((r * speed) ** 2 * (c**2 - d**2) + first**2) / root
    at_a = -(speed**2) * r * np.stack([c, d], axis=1)
    at_b = np.stack([-(speed**2) * r * c + second, 0.0 * t], axis=1)
    normal = np.stack([r * d, root], axis=1) / length
    along = np.arange(n + 1) / n
    a, b = (np.sum(of * normal, axis=1)[:, None] for of in (at_a, at_b))
    masses, inertias = zip(*((float(of.mass), float(of.inertia[2])) for of in beam.bodies.values()))
    push = -np.asarray(masses) * (a + along * (b - a))
    turn = -np.asarray(inertias) * (b - a) / length
    reaction = (np.sum((along - 1.0) * length * push, axis=1) + np.sum(turn, axis=1)) / length
    for i in range(n):
        s = (i + 0.5) * length / n
        left = along * length < s
        expected = reaction * s + np.sum((s - along * length) * push * left, axis=1) - np.sum(turn * left, axis=1)
        found = np.asarray(run.force(f"c.{i}").moment)[400:, 2]
        assert (
            np.abs(found - expected).max() < 1e-3 * 0.67
        )  # of the largest moment: (2 Ω/ω₁)², what its first mode adds


def linkage(t1, p=None, elements=(4, 8, 4), scheme=None):
    """Position of C, force and moment in the middle of the coupler, at Exudyn's steps of 5 ms and by its scheme."""
    model = misaligned_four_bar(**(p or {}), elements=elements)
    scheme = scheme or lg.GeneralizedAlpha(rho_inf=FOUR_BAR["rho_inf"], tolerance=1e-9)
    num_steps = round(t1 / FOUR_BAR["t1"] * FOUR_BAR["num_steps"])
    run = lg.simulate(model, t1=t1, num_steps=num_steps, integrator=scheme)
    section = run.force(f"coupler.{elements[1] // 2}")
    return {"C": run.body(f"coupler.{elements[1]}").position, "force": section.force, "moment": section.moment}


def test_a_linkage_has_three_bars():
    with pytest.raises(ValueError, match=r"`elements` must be three, .* got \(4, 8\)"):
        misaligned_four_bar(elements=(4, 8))
    with pytest.raises(ValueError, match="must be positive"):
        misaligned_four_bar(width=0.0)


def agrees(found, numbers, tolerances):
    for name, tolerance in tolerances.items():
        every = FOUR_BAR["num_steps"] // (len(numbers["t"]) - 1)
        values = np.asarray(found[name])[::every]
        np.testing.assert_allclose(values, numbers[name][: len(values)], rtol=0, atol=tolerance, err_msg=name)


@pytest.mark.slow  # 100 steps; a link of a four-bar that bends is in the quick run
def test_four_bar_with_a_hinge_out_of_line():
    """Bauchau et al. (2016) at its start: the same equations and steps in Exudyn, both to its Newton's 1e-8."""
    agrees(linkage(0.5), FOUR_BAR["lumped"], {"C": 1e-8, "force": 1e-3, "moment": 1e-5})  # 1e-8 of EA, 1e-8 of EI


@pytest.mark.slow  # 2,400 steps of 16 elements, and of 32
def test_four_bar_with_a_hinge_out_of_line_over_a_turn():
    """Twice through where its bars lie flat. Of the mesh an error O(1/elements²) is left."""
    found = linkage(12.0)
    agrees(found, FOUR_BAR["lumped"], {"C": 1e-8, "force": 5e-3, "moment": 1e-5})  # 0.005 of 6,022 N, where it snaps
    finer, fine = linkage(12.0, elements=(8, 16, 8)), np.asarray(FOUR_BAR["fine"]["moment"])
    # The inner moments are those of the middle of an element, which comes nearer to that of the coupler; the torsion
    # is the same along it. After the snaps bars ring, with frequencies of the mesh: 0 to 2.5 s.
    left = [np.abs(np.asarray(of["moment"])[:501:50, 0] - fine[:11, 0]).max() for of in (found, finer)]
    assert left[1] < 0.35 * left[0] < 0.35 * 0.02 * np.abs(fine[:11, 0]).max()


@pytest.mark.slow  # three programs of a motion
def test_derivatives_of_the_four_bar_with_a_hinge_out_of_line():
    """Of the moments in the coupler at 1 s by misalignment, rate, the rocker's width: both modes and differences."""

    def moments(p, sensitivity):
        model = misaligned_four_bar(**p, elements=(2, 2, 2))
        run = lg.simulate(model, t1=1.0, num_steps=100, sensitivity=sensitivity)
        return jnp.sum(run.force("coupler.1").moment[-1])

    p = {"misalignment": jnp.asarray(0.1), "rate": jnp.asarray(-0.6), "width": jnp.asarray(8e-3)}
    adjoint = jax.jit(jax.grad(partial(moments, sensitivity=lg.AdjointVariable())))(p)
    direct = jax.jit(jax.grad(partial(moments, sensitivity=lg.DirectDifferentiation())))(p)
    value = jax.jit(partial(moments, sensitivity=lg.DirectDifferentiation()))
    for name, number in p.items():
        np.testing.assert_allclose(adjoint[name], direct[name], rtol=1e-10)
        step = 1e-3 * number  # of fourth order: 1e-12 of the value, and of Newton 1e-10 over 1e-3
        at = lambda s, name=name: value(p | {name: p[name] + s})
        difference = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
        np.testing.assert_allclose(direct[name], difference, rtol=1e-7)
