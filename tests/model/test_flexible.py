"""Links that bend in place of rigid ones, rigid ones in place of beams, and beams that bear their load at the start."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.model import Joint, Rigid

TUBE = lg.BeamSection.tube(0.04, 0.004, young=2.1e11, poisson=0.3, density=7850.0)


def four_bar(at=(1.0, 1.0, 0.0)):
    """Crank, coupler and rocker; a spring holds on to the coupler at a point."""
    bodies = {
        "crank": lg.RigidBody(2.0, (0.1, 0.1, 0.1), position=(0.0, 0.5, 0.0)),
        "coupler": lg.RigidBody(
            3.0, (0.01, 1.0, 1.0), position=(1.0, 1.0, 0.0), velocity=(0.1, 0.0, 0.0), angular_velocity=(0.0, 0.0, 2.0)
        ),
        "rocker": lg.RigidBody(1.0, (0.2, 0.1, 0.2), position=(2.0, 0.5, 0.0)),
    }
    spin = (0.0, 0.0, 1.0)
    joints = {
        "a": lg.RevoluteJoint(None, "crank", at=(0, 0, 0), axis=spin),
        "b": lg.RevoluteJoint("crank", "coupler", at=(0, 1, 0), axis=spin),
        "c": lg.SphericalJoint("coupler", "rocker", at=(2, 1, 0)),
        "d": lg.UniversalJoint(None, "rocker", at=(2, 0, 0), axis_a=spin, axis_b=(1, 0, 0)),
    }
    forces = {
        "gravity": lg.Gravity((0.0, -9.81, 0.0)),
        "spring": lg.SpringDamper(None, "coupler", at_a=(1, 0, 0), at_b=at, stiffness=100.0),
    }
    return lg.Model(bodies, joints, forces)


def test_a_link_that_bends():
    model = four_bar().flexible({"coupler": TUBE}, elements=4)
    nodes = [f"coupler.{i}" for i in range(5)]
    assert sorted(model.bodies) == sorted(["crank", "rocker", *nodes])
    assert (model.joints["b"].b, model.joints["c"].a) == ("coupler.0", "coupler.4")
    assert model.forces["spring"].b == "coupler.2"  # the nearest to x = 1
    np.testing.assert_allclose(sum(model.bodies[name].mass for name in nodes), 2.0 * TUBE.mass, rtol=1e-14)
    # With the velocities of the rigid link: 2 rad/s about its centre at x = 1, which moves at 0.1 m/s.
    for name in nodes:
        body = model.bodies[name]
        np.testing.assert_allclose(body.velocity, [0.1, 2.0 * (body.position[0] - 1.0), 0.0], atol=1e-15)
        np.testing.assert_allclose(body.orientation @ body.angular_velocity, [0.0, 0.0, 2.0], atol=1e-15)


def test_by_points_that_are_traced():
    end = lambda x: four_bar((x, 1.0, 0.0)).flexible({"coupler": TUBE}, nodes={"spring": 3}).forces["spring"].at_b[0]
    np.testing.assert_allclose(jax.jit(jax.grad(end))(1.5), 1.0)
    with pytest.raises(
        ValueError, match="node of 'coupler' that carries 'spring' follows from points that are not known"
    ):
        jax.jit(lambda x: four_bar((x, 1.0, 0.0)).flexible({"coupler": TUBE}).forces["spring"].at_b)(1.5)


def test_a_beam_that_is_rigid():
    rich = four_bar().flexible({"coupler": TUBE}, elements=2)
    lean = rich.reduced(Rigid("coupler"))
    assert lean.merge_fixed and sorted(lean.forces) == ["gravity", "spring"]
    assert {name: (lean.joints[name].a, lean.joints[name].b) for name in ("coupler.0", "coupler.1")} == {
        "coupler.0": ("coupler.0", "coupler.1"),
        "coupler.1": ("coupler.1", "coupler.2"),
    }
    system = lean.system()
    assert len(system.body_names) == 3
    half_way = rich.toward([[Rigid("coupler")]], jnp.array([0.5]), 1.0)  # twice as stiff
    assert float(half_way.forces["coupler.0: stiffer"].factor) == 1.0


def cantilever(load, elements=3):
    beam = lg.Beam("b", TUBE, [[0, 0, 0], [1.5, 0, 0]], elements=elements)
    clamp = {"clamp": lg.FixedJoint(None, "b.0", at=(0, 0, 0))}
    push = lg.AppliedForce(beam.nodes[-1], force=load)
    return lg.Model(beam.bodies, clamp, beam.forces | {"push": push}), beam


@pytest.mark.slow
def test_a_beam_that_bears_its_load_in_the_reference_configuration():
    """N = P₁, shear and bending moment of the load about the middle of each element, where its strain is the mean."""
    model, beam = cantilever((50.0, -20.0, 30.0))
    held, left = lg.static_preload(model, list(beam.forces))
    assert float(left) < 1e-10  # round-off of 50 N, times the ratio of stiffnesses along and across
    for i, name in enumerate(beam.forces):
        arm = 1.5 - 0.5 * (i + 0.5)
        expected = [50.0, -20.0, 30.0, 0.0, -30.0 * arm, -20.0 * arm]
        np.testing.assert_allclose(held.forces[name].preload, expected, rtol=0, atol=1e-10)
    start = lg.initial_state(held)
    assert np.abs(start.vdot).max() < 1e-7  # 1e-11 N on nodes of 1 kg, and moments on their inertias of 1e-3 kg m²


def test_what_moves_freely_at_the_end_of_a_beam_does_not_hinder_its_preloads():
    """A wheel on a hinge, whose turning no load moves: N, Q and M of its weight; and their derivative by the weight."""

    def held(weight):
        model, beam = cantilever((0.0, 0.0, 0.0), elements=1)
        wheel = lg.RigidBody(weight / 10.0, (0.1, 0.2, 0.1), position=(1.5, 0.3, 0.0))
        hinge = lg.RevoluteJoint("b.1", "wheel", at=(1.5, 0.3, 0.0), axis=(0, 1.0, 0))
        gravity = {"gravity": lg.Gravity((0.0, 0.0, -10.0))}
        # Nodes of no weight: the wheel's is all that there is.
        light = {name: dataclasses.replace(body, mass=jnp.asarray(1e-9)) for name, body in model.bodies.items()}
        model = lg.Model(light | {"wheel": wheel}, model.joints | {"hinge": hinge}, {**model.forces, **gravity})
        return lg.static_preload(model, list(beam.forces))[0].forces["b.0"].preload

    expected = np.array([0.0, 0.0, -1.0, -0.3, 0.75, 0.0])  # of 1 N at 0.75 m and 0.3 m from the middle of the element
    preload, slope = jax.jvp(held, (20.0,), (1.0,))
    np.testing.assert_allclose(preload, 20.0 * expected, rtol=0, atol=1e-6)  # the nodes' 1e-8 N
    np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-7)


@pytest.mark.slow  # three programs
def test_fidelity_predicts_what_bending_does():
    """A beam on a torsion spring, with a mass at its end: rigid, in fact, and by the derivative by its stiffness."""

    def build(p):
        section = lg.BeamSection(p * TUBE.stiffness, TUBE.mass, TUBE.inertia, damping=1e-4)  # η E A h ≫ m
        beam = lg.Beam("b", section, [[0, 0, 0], [1.0, 0, 0]], elements=2)
        bodies = beam.bodies | {"end": lg.RigidBody(20.0, (0.1, 0.1, 0.1), position=(1.0, 0, 0))}
        joints = {
            "hinge": lg.RevoluteJoint(None, "b.0", at=(0, 0, 0), axis=(0, 0, 1.0)),
            "end": lg.FixedJoint("b.2", "end", at=(1.0, 0, 0)),
        }
        spring = lg.TorsionSpringDamper(None, "b.0", axis=(0, 0, 1.0), stiffness=2e3, damping=20.0)
        forces = beam.forces | {"gravity": lg.Gravity((0, -9.81, 0)), "spring": spring}
        return lg.Model(bodies, joints, forces, merge_fixed=True)

    criterion = lambda run: lg.time_integral(run.t, run.body("end").velocity[:, 1] ** 2)
    found = lg.accuracy.fidelity(criterion, build, jnp.asarray(4.0), [Rigid("b")], t1=0.3, num_steps=100)
    (row,) = found.rows
    verified = found.verified(row)
    # It yields 1/(3 EI) = 1 % of the spring's 1/k; what the midpoint rule leaves is of third order in that.
    assert 1e-3 < abs(verified.value) < 5e-2
    assert row.value == pytest.approx(verified.value, rel=0.02)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: four_bar().flexible({"couple": TUBE}), "`links`: .*'coupler'"),
        (lambda: four_bar().flexible({"coupler": 1.0}), "`section` must be a BeamSection, got 1.0"),
        (lambda: four_bar().flexible({"coupler": TUBE}, nodes={"sprin": 1}), "`nodes`: .*'spring'"),
        (lambda: four_bar().flexible({"coupler": TUBE}, nodes={"spring": 5}), "'spring' must be at 0 to 4, got 5"),
        (lambda: four_bar().flexible({"coupler": TUBE}, nodes={"b": 0}), r"two joints; 'coupler' has \['b', 'c'\]"),
        (lambda: four_bar().flexible({"rocker": TUBE}, up=(0, 1, 0)), "`up` .* lies along the beam"),
        (
            lambda: bent().reduced(Joint("coupler.0", "revolute")),
            "'fixed' or None for an element of a beam, got 'revolute'",
        ),
        (lambda: dataclasses.replace(bent().forces["coupler.0"], preload=[1.0]), "`preload` must have shape"),
        (lambda: four_bar().reduced(Rigid("coupler")), r"Rigid\(beam='coupler'\): `beam`"),
        (lambda: with_torsion().flexible({"coupler": TUBE}), "'twist', a TorsionSpringDamper, holds on to 'coupler'"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def bent():
    return four_bar().flexible({"coupler": TUBE})


def with_torsion():
    model = four_bar()
    twist = lg.TorsionSpringDamper("crank", "coupler", axis=(0, 0, 1.0), stiffness=1.0)
    return dataclasses.replace(model, forces={**model.forces, "twist": twist})
