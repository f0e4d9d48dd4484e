"""One scene on R³ × SO(3) and on SE(3): the same equations, another solution of second order, the same derivatives."""

import dataclasses
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_scenes import mixed
from helpers import close, everything, says

import lgsens as lg
from lgsens.dynamics import State, autodiff_constraint_jacobian, autodiff_tangents
from lgsens.examples import four_bar, heavy_top
from lgsens.liegroups import RigidMotions
from lgsens.model import MultibodySystem, SE3System


def on_se3(model):
    return dataclasses.replace(model, formulation="SE3")


def controlled():
    """A body, one on a rail, friction from the forces of a joint, and an actuator, whose lag is a state."""
    bodies = {
        "arm": lg.RigidBody(2.0, (0.1, 0.2, 0.3), position=(0.3, 0.1, 0.2), angular_velocity=(0.0, 0.0, 1.0)),
        "cart": lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=(0.5, 0.0, 0.2), free="x"),
    }
    joints = {"hinge": lg.RevoluteJoint("cart", "arm", at=(0.5, 0.0, 0.2), axis=(0, 0, 1))}
    along = lg.TranslationDriver(None, "cart", at=(0, 0, 0), axis=(1.0, 0, 0), value=0.0)
    command = lg.Harmonic(amplitude=1.0, frequency=2.0)
    forces = {
        "friction": lg.JointFriction("hinge", coefficient=0.3, slip_speed=0.1, radius=0.02),
        "motor": lg.Actuator(along, command=command, time_constant=0.1),
    }
    return lg.Model(bodies, joints, forces)


SCENES = {"every element": everything, "partly free bodies": lambda: mixed()[0], "small": controlled}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "small")) for n in SCENES])
def test_tangents_and_jacobians_equal_autodiff(name):
    system = on_se3(SCENES[name]()).equations()
    rng, k, m = np.random.default_rng(1), system.group.dim, len(system.constraint_names)
    draw = lambda size, scale=1.0: jnp.asarray(rng.normal(scale=scale, size=size))
    x, point = draw(k, 0.3), (draw(k), draw(k), draw(m), jnp.asarray(0.17))

    @eqx.filter_jit
    def both(system):
        q = system.group.retract(system.bodies.pose, x)
        given = system.tangents(q, *point), system.constraint_jacobian(q, point[-1])
        return given, (autodiff_tangents(system, q, *point), autodiff_constraint_jacobian(system, q, point[-1]))

    found, expected = both(system)
    assert isinstance(system.group, RigidMotions) == (name != "every element")
    # sums of some ten terms of some ten products, as on R³ × SO(3), turned twice
    jax.tree.map(lambda x, y: close(x, y, 1000), found, expected)


def test_mass_and_gyroscopic_forces_are_those_of_the_kinetic_energy():
    """Poincaré's equations of T = ½ vᵀM v on the group: M v̇ − ad(v)ᵀ M v, for a body without forces."""
    model = lg.Model({"b": lg.RigidBody(1.3, (0.2, 0.3, 0.4), position=(0.1, 0.2, 0.3))}, formulation="SE3")
    system = model.equations()
    rng = np.random.default_rng(0)
    q = system.group.retract(system.bodies.pose, jnp.asarray(rng.normal(size=6)))
    v, vdot = jnp.asarray(rng.normal(size=(2, 6)))
    mass = system.mass_matrix()
    close(mass, np.diag([1.3, 1.3, 1.3, 0.2, 0.3, 0.4]), 1)
    expected = mass @ vdot - system.group.ad(v).T @ (mass @ v)
    close(system.residual(q, v, vdot, jnp.zeros(0), jnp.asarray(0.0)), expected, 20)


def test_nothing_of_a_scene_is_left_out():
    """What a `MultibodySystem` says in place of `AbstractSystem`, its equations on SE(3) do, too."""
    interface = {name: said for name, said in vars(lg.AbstractSystem).items() if not name.startswith("_")}
    own = lambda kind: {name for name, said in interface.items() if inspect.getattr_static(kind, name) is not said}
    assert {"breaking", "compliance", "residual"} <= own(MultibodySystem)
    assert own(MultibodySystem) == own(SE3System)


@pytest.mark.slow  # two programs; the top about its fixed point is in the quick run
def test_a_screw_is_exact_in_any_step():
    """A body on a cylindrical joint, which turns and slides at constant rates: q exp(h v) is its motion."""
    rates = {"velocity": (-0.8, 0.0, 0.3), "angular_velocity": (0.0, 0.0, 2.0)}
    body = lg.RigidBody(1.0, (0.1, 0.2, 0.3), position=(0.0, 0.4, 0.0), **rates)
    joint = lg.CylindricalJoint(None, "b", at=(0, 0, 0), axis=(0, 0, 1.0))
    model = lg.Model({"b": body}, {"bearing": joint})
    run = lambda model: lg.simulate(model, t1=1.0, num_steps=8).body("b").position[-1]
    expected = [-0.4 * np.sin(2.0), 0.4 * np.cos(2.0), 0.3]
    np.testing.assert_allclose(run(on_se3(model)), expected, rtol=0, atol=1e-10)  # Newton's tolerance
    assert np.abs(run(model) - np.asarray(expected)).max() > 1e-3  # (Ω h)²/12 of the angle, on R³ × SO(3)


@pytest.mark.slow
def test_a_top_moves_on_se3_as_about_its_fixed_point():
    """u + Ω × X = 0 is linear there, so that each increment has it, and what is left is the scheme on SO(3) with the
    moment of inertia about the point: `RigidBody(pivot=…)`, step by step, the start's transient included."""
    model = heavy_top()
    body = model.bodies["top"]
    numbers = {name: getattr(body, name) for name in ("mass", "inertia", "position", "orientation", "angular_velocity")}
    about = lg.Model({"top": lg.RigidBody(**numbers, free="rx ry rz", pivot=(0, 0, 0))}, {}, model.forces)
    exact = lg.GeneralizedAlpha(tolerance=1e-13)
    runs = [lg.simulate(each, t1=0.05, num_steps=25, integrator=exact).body("top") for each in (on_se3(model), about)]
    for found, expected, rounded in zip(*runs, (1e-12, 1e-12, 1e-10, 1e-10, 1e-7, 1e-7)):  # over h²
        assert np.abs(found - expected).max() <= rounded * max(1.0, np.abs(expected).max())


DAMPED = lg.GeneralizedAlpha(rho_inf=0.2)  # the start's transient in accelerations is over after a few steps


@pytest.mark.slow  # two programs; the top about its fixed point is in the quick run
def test_both_are_solutions_of_second_order_of_the_same_scene():
    """All that a trajectory answers by name: positions to accelerations, forces of joints, multipliers."""
    model = four_bar()

    def ends(model, n):
        run = lg.simulate(model, t1=0.2, num_steps=n, integrator=DAMPED)
        moved = [np.concatenate([np.ravel(of[-1]) for of in run.body(name)]) for name in model.bodies]
        return [*moved, run.joint("B").force[-1], run.multiplier("C")[-1]]

    coarse, fine = ([np.abs(a - b).max() for a, b in zip(ends(on_se3(model), n), ends(model, n))] for n in (40, 80))
    assert min(coarse) > 1e-6  # they are not the same solution
    np.testing.assert_allclose(np.log2(np.divide(coarse, fine)), 2.0, atol=0.1)  # h³ beside h², in 40 steps


@pytest.mark.slow  # two programs
def test_partly_free_bodies_with_states_and_friction():
    """A trajectory of partly free bodies, a lag and friction by the forces of its joint answers as on R³ × SO(3)."""
    model = controlled()
    runs = [lg.simulate(each, t1=0.2, num_steps=40, integrator=DAMPED) for each in (model, on_se3(model))]
    assert isinstance(runs[1].system, SE3System)
    answers = lambda r: (r.body("arm").velocity, r.joint("hinge").force, *r.states_of("motor").values())
    for found, expected in zip(*(map(np.asarray, answers(r)) for r in reversed(runs))):
        size = np.abs(expected).max()
        # seen: 1.4e-4 of the force, a quarter of it with twice the steps
        assert np.abs(found - expected)[10:].max() < 1e-3 * size


@pytest.mark.slow  # the equations and their tangents, and a motion, are in the quick run
def test_derivatives():
    """DDM and AVM of a top by its numbers and its start, to round-off; differences."""
    exact = lg.GeneralizedAlpha(tolerance=1e-13)  # differences see what Newton leaves

    def value(p, sensitivity):
        model = on_se3(heavy_top(m=p[0], l=p[1], Om2=p[2]))
        run = lg.simulate(model, t1=0.02, num_steps=20, integrator=exact, sensitivity=sensitivity)
        last = jnp.concatenate([leaf[-1].ravel() for leaf in run.body("top")])
        return last @ jnp.linspace(1.0, 2.0, 24) + 1e-3 * jnp.sum(run.states.lam[-1])

    p = jnp.asarray([15.0, 1.0, 150.0])
    run = jax.jit(jax.value_and_grad(lambda p: value(p, lg.AdjointVariable())))
    direct = jax.jit(jax.jacfwd(lambda p: value(p, lg.DirectDifferentiation())))(p)
    _, adjoint = run(p)
    size = np.asarray(p * direct)
    np.testing.assert_allclose(p * adjoint, size, rtol=0, atol=1e-10 * np.abs(size).max())  # round-off over h²
    for i, along in enumerate(np.diag(1e-3 * np.asarray(p))):
        first, second = (float(run(p + s * along)[0] - run(p - s * along)[0]) for s in (1, 2))
        difference = (8 * first - second) / 12e-3
        # fourth order of 1e-3, spin × time = 3 rad: 1e-10; round-off of accelerations of 1e4, over h² and the step
        assert abs(difference - size[i]) < 1e-6 * np.abs(size).max()


@pytest.mark.slow  # programs of two gradients; small version: transposes in test_groups
def test_derivatives_of_partly_free_bodies_with_states():
    """DDM and AVM by mass, friction and lag, to round-off over h²."""
    whole = controlled()

    def value(p, sensitivity):
        leaves = lambda m: (m.bodies["arm"].mass, m.forces["friction"].coefficient, m.forces["motor"].time_constant)
        model = on_se3(eqx.tree_at(leaves, whole, tuple(p)))
        run = lg.simulate(model, t1=0.05, num_steps=10, integrator=DAMPED, sensitivity=sensitivity)
        return jnp.sum(run.states.v[-1]) + 1e-2 * jnp.sum(run.joint("hinge").force[-1])

    p = jnp.asarray([2.0, 0.3, 0.1])
    direct = jax.jit(jax.jacfwd(lambda p: value(p, lg.DirectDifferentiation())))(p)
    adjoint = jax.jit(jax.grad(lambda p: value(p, lg.AdjointVariable())))(p)
    np.testing.assert_allclose(adjoint, direct, rtol=0, atol=1e-10 * np.abs(direct).max())
    assert np.abs(direct).min() > 1e-6


@pytest.mark.slow
def test_states_of_both_say_the_same():
    """`Trajectory.of_bodies` of a motion, and of a start: consistent in velocities and accelerations."""
    model = four_bar()
    mixed_state, state = lg.initial_state(model), lg.initial_state(on_se3(model))
    found = on_se3(model).equations().state_of_bodies(state)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(mixed_state)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * max(1.0, np.abs(b).max()))  # two linear solves
    assert isinstance(found, State)


@pytest.mark.slow  # programs of two linearizations
def test_rest_and_small_motions_are_the_same():
    """Equilibrium, eigenvalues, and the response of an output to an input, of a pendulum on a torsion spring."""
    body = lg.RigidBody(2.0, (0.1, 0.2, 0.3), position=(0.4, 0.0, 0.1))
    joint = lg.RevoluteJoint(None, "b", at=(0, 0, 0), axis=(0, 1.0, 0))
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -9.81)),
        "spring": lg.TorsionSpringDamper(None, "b", axis=(0, 1.0, 0), stiffness=30.0, damping=0.5),
        "push": lg.AppliedForce("b", force=(0, 0, 1.0)),
    }
    model = lg.Model({"b": body}, {"hinge": joint}, forces)
    found = [
        lg.linearize(each, inputs=("push",), outputs={"z": lambda s: s.body("b").position[2]})
        for each in (model, on_se3(model))
    ]
    mixed_one, one = found
    for name in ("position", "orientation"):
        np.testing.assert_allclose(getattr(one.state.q, name), getattr(mixed_one.state.q, name), rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.eigenvalues, mixed_one.eigenvalues, rtol=1e-10)  # two bases of one matrix
    matrices = [tuple(map(np.asarray, (of.A, of.B, of.C))) for of in found]
    response = [(C @ np.linalg.solve(3.0j * np.eye(2) - A, B)).ravel() for A, B, C in matrices]
    np.testing.assert_allclose(response[1], response[0], rtol=1e-10)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"formulation": "SE(3)"}, says("`formulation`", "'R3xSO3', 'SE3'", "'SE(3)'")),
        ({"formulation": "SE3", "linear_solver": lg.BlockSparse()}, says("BlockSparse()", "R3xSO3", "leave it out")),
    ],
    ids=["unknown", "sparse"],
)
def test_bad_input(options, message):
    with pytest.raises(ValueError, match=message):
        lg.Model({"b": lg.RigidBody(1.0, (1.0, 1.0, 1.0))}, **options)
