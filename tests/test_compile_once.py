"""One program for a scene: what changes between two calls outside of `jit` is data of it, or in a small program.

Programs are counted, in JAX's own log, and the numbers of those with room for more steps compared with those of
programs made for one number of steps, inside of `jit`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg
from lgsens.criteria._packed import Packed
from lgsens.examples import spinning_top
from lgsens.integrate import Steps
from lgsens.linear import tuned

P = jnp.array([0.7, 1.0])  # angle, length
HIGH = lg.Criterion(integrand=lambda s, p: s.body("top").position[2] ** 2 * p[1])
PUSHED = lg.Criterion(integrand=lambda s, p: s.multiplier("pivot")[0] ** 2, terminal=lambda s, p: s.t)
FAST = lg.Criterion(terminal=lambda s, p: s.body("top").velocity[0])
FIRST = {"t1": 0.1, "num_steps": 12}
OTHERS = {
    "criterion": (PUSHED, {}, {}),
    "another": (FAST, {}, {}),
    "steps": (HIGH, {"num_steps": 30}, {}),
    "end": (HIGH, {"t1": 0.07}, {}),
    "tolerance": (HIGH, {}, {"tolerance": 1e-7}),
    "damping": (HIGH, {}, {"rho_inf": 0.6}),
    "iterations": (HIGH, {}, {"max_iterations": 7}),
}
# Forward and transposed sweeps of 30 steps: round-off of λ, 150 N/h², in another order
RTOL = 1e-9


def build(p):
    return spinning_top(p[0], length=p[1])


def psi_of_model(model):
    return lg.simulate(model, t1=0.1, num_steps=4).body("top").position[-1, 0]


def psi(p, criterion=HIGH, times=FIRST, numbers=None, **settings):
    run = lg.simulate(build(p), **(FIRST | times), integrator=lg.GeneralizedAlpha(**(numbers or {})), **settings)
    return criterion(run, p)


@pytest.mark.slow
def test_eager_gradients_share_their_programs(compiled):
    """Forward and pull-back are compiled once, whatever a criterion looks at, and cut to the steps that there are."""
    jax.clear_caches()
    names, (value, gradient) = compiled(jax.value_and_grad(psi), P)
    assert names.count("_simulate_jit") == 2
    expected = jax.jit(jax.value_and_grad(psi))(P)
    np.testing.assert_allclose(value, expected[0], rtol=RTOL)
    np.testing.assert_allclose(gradient, expected[1], rtol=RTOL)
    for name in ("criterion", "steps", "tolerance"):
        criterion, times, numbers = OTHERS[name]
        names, (value, gradient) = compiled(jax.value_and_grad(psi), P, criterion, times, numbers)
        assert "_simulate_jit" not in names, name
        assert np.isfinite(value) and np.all(np.isfinite(gradient))
    run = lg.simulate(build(P), t1=0.1, num_steps=30)
    assert run.t.shape == (31,) and run.states.v.shape[0] == 31 and run.stats.converged.shape == (30,)
    np.testing.assert_allclose(run.t, np.linspace(0.0, 0.1, 31), rtol=0, atol=1e-16)


def test_numbers_are_copied_and_gathered_without_programs_of_their_own(compiled):
    """Outside of `jit` each operation is a program, 10 to 20 ms: what a scene of numbers and a question of its motion
    cost is a few whole functions, of which a body that turns about one axis has as many as a free one."""

    def scene(free):
        body = lg.RigidBody(1.0, (1, 2, 2), position=[0.0, 0.0, -1.0], angular_velocity=(0, 1, 0), free=free)
        return lg.Model(
            bodies={"arm": body}, joints={"pin": lg.RevoluteJoint(None, "arm", at=[0, 0, 0], axis=[0, 1, 0])}
        )

    for free in ("x y z rx ry rz", "x z ry"):
        jax.clear_caches()
        names, _ = compiled(lambda free=free: scene(free).system())
        assert {"stage", "gather", "select_n", "convert_element_type"} & {*names} == set(), names
    system, states = scene(free).system(), lg.simulate(scene(free), t1=0.1, num_steps=4).states
    jax.clear_caches()
    names, motion = compiled(system.motion, 0, states.q, states.v, states.vdot)
    assert names == ["motion"], names
    assert motion[0].shape == (5, 3)


@pytest.mark.slow
def test_a_gradient_by_the_whole_model_compiles_once(compiled):
    """As in README, outside of `jit`: the projection of orientations on rotations is no loop to be transposed anew."""
    gradient = eqx.filter_grad(psi_of_model)
    gradient(spinning_top(0.7))
    names, _ = compiled(gradient, spinning_top(0.8))
    assert not names


@pytest.mark.slow  # as the gradients above
def test_the_same_derivative_by_parts(compiled):
    """`differentiate`, whose programs know the numbers of the call as data, against `jit`, where they are constants."""

    def differentiate(criterion, times, numbers):
        integrator = lg.GeneralizedAlpha(**numbers)
        settings = FIRST | times | {"integrator": integrator, "method": lg.AdjointVariable()}
        return lg.differentiate(criterion, build, P, **settings)[:2]

    differentiate(HIGH, {}, {})
    for name, changed in OTHERS.items():
        names, _ = compiled(differentiate, *changed)
        assert set(names) <= ({"_values"} if name in ("criterion", "another", "steps") else set()), name
    changed = PUSHED, {"num_steps": 30, "t1": 0.07}, {"rho_inf": 0.6, "tolerance": 1e-9}
    expected = jax.jit(jax.value_and_grad(lambda p: psi(p, *changed)))(P)
    for found, exact in zip(differentiate(*changed), expected):
        np.testing.assert_allclose(found, exact, rtol=RTOL)


class Spring(eqx.Module):
    """A design with numbers of its own, whose method is a scene."""

    rate: jax.Array

    def scene(self, p):
        spring = lg.SpringDamper(None, "mass", at_a=(0, 0, 0), at_b=(0, 0, 1), stiffness=self.rate, free_length=1.0 + p)
        return lg.Model({"mass": lg.RigidBody(2.0, (1.0, 1.0, 1.0), position=(0, 0, 1), free="z")}, {}, {"s": spring})


def test_a_method_of_a_design_is_a_scene(compiled):
    """z = 1 + p (1 − cos ωt): by p, and for another rate without another program of the motion."""
    height = lg.Criterion(terminal=lambda s, p: s.body("mass").position[2])
    settings = {"t1": 0.5, "num_steps": 100, "method": lg.AdjointVariable()}
    for rate in (40.0, 80.0):
        scene, p = Spring(jnp.asarray(rate)).scene, jnp.asarray(0.1)
        names, found = compiled(lambda s=scene, p=p: lg.differentiate(height, s, p, **settings)[:2])
        slope = 1.0 - np.cos(0.5 * np.sqrt(rate / 2.0))
        # second order: (ω h)² ω t / 12 and less
        np.testing.assert_allclose([float(n) for n in found], [1.0 + 0.1 * slope, slope], rtol=1e-3)
    assert not {"_scene", "_motion"} & set(names)


def test_what_is_packed_is_unpacked():
    """Small and large arrays of three dtypes, a scalar and an empty one, through a program."""
    tree = {
        "small": [jnp.arange(6.0).reshape(2, 3), jnp.asarray(7.0), jnp.zeros((0, 2)), jnp.arange(3, dtype=jnp.int32)],
        "large": jnp.arange(2.0 * tuned.PASSED_ALONE).reshape(2, -1),
        "flag": jnp.array([True, False]),
    }
    packed = jax.jit(Packed.of)(tree)
    assert len(jax.tree.leaves(packed)) == 4  # one for each dtype, and the large one
    found = jax.jit(lambda packed: packed.unpacked)(packed)
    assert jax.tree.structure(found) == jax.tree.structure(tree)
    for one, exact in zip(jax.tree.leaves(found), jax.tree.leaves(tree)):
        assert one.dtype == exact.dtype
        np.testing.assert_array_equal(one, exact)


@pytest.mark.slow  # two programs of second derivatives
def test_second_derivatives_with_room_for_more_steps():
    """Rows beyond the last step are no equations of L."""
    for transformed in (jax.jacfwd, jax.hessian):
        exact = jax.jit(transformed(psi))(P)
        np.testing.assert_allclose(transformed(psi)(P), exact, rtol=0, atol=1e-8 * float(jnp.abs(exact).max()))


@pytest.mark.parametrize(("num_steps", "room"), [(1, 256), (256, 256), (257, 1024), (4097, 6144), (6145, 8192)])
def test_room(num_steps, room):
    steps = Steps.of(num_steps, jnp.float64)
    assert (float(steps.count), steps.room) == (num_steps, room)


def test_a_failure_is_told_as_without_room():
    """A step that is much too long, the third of five."""
    with pytest.raises(lg.SimulationError, match=says("step 3 of 5, t = 0.6 s")):
        lg.simulate(build(P), t1=1.0, num_steps=5)
    run = lg.simulate(build(P), t1=1.0, num_steps=5, throw=False)
    assert np.all(np.isfinite(run.states.v[:3])) and np.all(np.isnan(run.states.v[3:]))
    assert np.asarray(run.stats.converged).tolist() == [True, True, False, False, False]
