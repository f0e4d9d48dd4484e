"""What is compiled can be kept for the next process, and exported: it calls nothing of this one."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from driven_pendulum import P as PENDULUM, make as driven_pendulum
from helpers import says, some_quick
from jax import export

import lgsens as lg
from lgsens._xla import fori_loop, scan, while_loop
from lgsens.examples import spinning_top
from lgsens.linear import LinearEquations, linear_solve

P = jnp.array([0.7, 1.0])  # angle, length


def psi(p):
    run = lg.simulate(spinning_top(p[0], length=p[1]), t1=0.1, num_steps=5)
    return lg.time_integral(run.t, run.body("top").position[:, 0] ** 2)


def test_a_gradient_calls_nothing_of_this_process():
    assert "callback" not in jax.jit(jax.value_and_grad(psi)).lower(P).as_text()


@pytest.mark.slow  # two programs
def test_a_gradient_is_exported():
    program = jax.jit(jax.value_and_grad(psi))
    exported = export.export(program)(P)
    for found, expected in zip(exported.call(P), program(P)):
        np.testing.assert_allclose(found, expected, rtol=1e-12)  # compiled anew


SECOND = """
import sys, jax, jax.numpy as jnp
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("cache_hits") else None)
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, "tests")
import lgsens as lg
jnp.ones(2) + 1.0  # something is compiled before
print(lg.compilation_cache(sys.argv[1]))
from test_programs import P, psi
print(jax.jit(jax.grad(psi))(P), len(hits))
"""


@pytest.mark.slow  # a gradient is compiled in another process
def test_the_next_process_finds_what_was_compiled(tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", SECOND, str(tmp_path / "programs")]
    first, second = (
        subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.split("\n")
        for _ in range(2)
    )
    assert first[0] == second[0] == str(tmp_path / "programs")
    (before, hits), (after, more) = (run[1].rsplit(" ", 1) for run in (first, second))
    assert before == after and int(hits) == 0 and int(more) > 0


def test_a_folder_that_cannot_be_written(tmp_path):
    taken = tmp_path / "file"
    taken.write_text("")
    with pytest.raises(ValueError, match=says("`folder`", "cannot be written", "name another one")):
        lg.compilation_cache(taken)


def at_rest(p):
    """A chain of links with blocks, from its equilibrium, and what is saved of it."""
    names = [f"link {i}" for i in range(3)]
    bodies = {name: lg.RigidBody(p[1], (0.1, 0.1, 0.1), position=(0.0, 0.0, -i - p[0])) for i, name in enumerate(names)}
    joints = {b: lg.SphericalJoint(a, b, at=(0.0, 0.0, -i)) for i, (a, b) in enumerate(zip([None, *names], names))}
    spring = lg.SpringDamper(None, names[-1], at_a=(1.0, 0.0, 0.0), at_b=(0.0, 0.0, -3.0), stiffness=20.0, damping=1.0)
    forces = {"gravity": lg.Gravity((0.0, 0.0, -9.81)), "spring": spring}
    model = lg.Model(bodies, joints, forces, linear_solver=lg.BlockSparse())
    start = lg.initial_state(model)
    save = lambda s: s.body(names[-1]).position[0] ** 2
    run = lg.simulate(model, t1=0.1, num_steps=4, state0=start, save=save)
    return jnp.sum(run.values)


def controlled(p):
    """Steps under error control, with room that is not needed."""
    integrator = lg.AdaptiveSteps(tolerance=1e-4)
    run = lg.simulate(driven_pendulum(jnp.array(PENDULUM) * p[1]), t1=0.5, num_steps=100, integrator=integrator)
    return jnp.sum(run.states.v[-1])


MESH, SPEC = jax.sharding.Mesh(jax.devices()[:1], ("designs",)), jax.sharding.PartitionSpec("designs")


def over_mesh(function):
    """With the check of what varies, which is that of one device as well."""
    return jax.jit(jax.shard_map(jax.vmap(function), mesh=MESH, in_specs=SPEC, out_specs=SPEC))


@pytest.mark.slow  # gradients are compiled twice
@pytest.mark.parametrize(
    "derivative, f",
    [
        (jax.value_and_grad, psi),
        (lambda f: jax.jacfwd(lambda p: (f(p), f(p)), has_aux=True), psi),
        (jax.value_and_grad, at_rest),
        (jax.value_and_grad, controlled),
    ],
    ids=["top", "top, forward", "chain, saved", "controlled steps"],
)
def test_designs_over_a_mesh(derivative, f):
    designs = P[None] + jnp.array([[0.0, 0.0], [0.1, -0.1]])
    both = over_mesh(derivative(f))(designs), jax.jit(jax.vmap(derivative(f)))(designs)
    for found, expected in zip(*map(jax.tree.leaves, both)):
        np.testing.assert_allclose(found, expected, rtol=1e-9)  # two programs


@pytest.mark.slow
@pytest.mark.parametrize("derivative", some_quick([jax.grad, jax.jacfwd]))
def test_controlled_steps_over_a_mesh_are_lowered(derivative):
    """What varies is checked there; compiled above."""
    assert over_mesh(derivative(controlled)).lower(jnp.ones((2, 2))).out_info.shape == (2, 2)


def test_constants_in_loops_and_solves_over_a_mesh():
    """What JAX alone refuses: carries that begin or end as constants, constants in the functions of a solve, and b of
    several parts of which not all are used; values by hand, derivatives in both modes."""

    def f(x):
        total, _ = scan(lambda carry, i: (carry + i * x, None), jnp.zeros(()), jnp.arange(4.0))  # 6x
        going = lambda carry: carry[0]
        _, doubled = while_loop(going, lambda carry: (jnp.zeros((), bool), carry[1] + 2 * x), (x > 0, jnp.zeros(())))
        powered = fori_loop(0, 3, lambda i, carry: carry * x, jnp.ones(()))
        return total + 10.0 * doubled + 100.0 * powered

    designs = jnp.array([0.5, 3.0])
    with pytest.raises(Exception, match="carry"):  # else there is nothing to do any more
        jax.eval_shape(over_mesh(lambda x: jax.lax.fori_loop(0, 3, lambda i, carry: carry * x, jnp.ones(()))), designs)
    np.testing.assert_allclose(over_mesh(f)(designs), 26.0 * designs + 100.0 * designs**3, rtol=1e-14)
    np.testing.assert_allclose(over_mesh(jax.jacfwd(f))(designs), 26.0 + 300.0 * designs**2, rtol=1e-14)

    order = np.array([2, 0, 1])

    def of_solve(x):  # which can be transposed, as `while_loop` cannot
        turned = LinearEquations(
            lambda x, parts: (x * parts[0][order], parts[1]),
            lambda x, parts: (parts[0][np.argsort(order)] / x, parts[1]),
            lambda x, parts: (parts[0][order] / x, parts[1]),
        )
        y, _ = linear_solve(turned, x, (jnp.stack([x, x**2, x**3]), x))  # [x, x², 1]
        return jnp.sum(y * jnp.array([1.0, 10.0, 100.0]))

    np.testing.assert_allclose(over_mesh(jax.grad(of_solve))(designs), 1.0 + 20.0 * designs, rtol=1e-12)
