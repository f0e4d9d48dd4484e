"""A batch as it would run on a GPU, from its program alone: JAX lowers for processors that are not there.

What a GPU cannot do at once for all designs would be a loop over rows or designs, a factorization that only LAPACK has,
or a callback to Python: none of them may be in the loops over steps.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import on_a_cpu, some_quick

import lgsens as lg
from lgsens.examples import QuarterCar
from lgsens.linear import many_runs
from lgsens.simulation import failures_by_callback

# The vendor's batched factorizations and exchanges of rows.
OF_A_GPU = {"cusolver_getrf_ffi", "cu_lu_pivots_to_permutation", "cusolver_geqrf_ffi", "cusolver_orgqr_ffi"}
LANES = 64


class Program:
    """A lowered program, in MLIR."""

    def __init__(self, function, platform: str):
        with failures_by_callback(False), many_runs():
            traced = jax.jit(jax.vmap(function)).trace(jax.ShapeDtypeStruct((LANES,), jnp.float64))
        module = traced.lower(lowering_platforms=(platform,)).compiler_ir("stablehlo")
        self._functions = {op.attributes["sym_name"].value: op for op in module.body.operations}
        self.calls = set()
        self.loops = self._inside(self._functions["main"])

    def _inside(self, operation) -> list:
        """The loops inside of an operation, each as the list of those inside of it."""
        found = []
        for region in operation.regions:
            for block in region.blocks:
                for op in block.operations:
                    inner = self._inside(op.operation)
                    if op.operation.name == "func.call":
                        inner = self._inside(self._functions[op.operation.attributes["callee"].value])
                    if op.operation.name == "stablehlo.custom_call":
                        self.calls.add(op.operation.attributes["call_target_name"].value)
                    found += [inner] if op.operation.name == "stablehlo.while" else inner
        return found

    @property
    def nested(self) -> list:
        """The loops that contain others: those over steps."""
        return [loop for loop in self.loops if loop]


def car(damping):
    return eqx.tree_at(lambda car: car.damper.rate, QuarterCar.load(), damping).model(), "chassis"


def swing(damping):
    """A bar on a hinge, on a damper."""
    bar = lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    hinge = lg.RevoluteJoint(None, "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    ends = {"at_a": (1.0, 0.0, 1.0), "at_b": (1.0, 0.0, 0.0)}
    damper = lg.SpringDamper(None, "bar", **ends, stiffness=10.0, damping=damping)
    return lg.Model({"bar": bar}, {"hinge": hinge}, {"damper": damper}), "bar"


def criterion(damping, scene, integrator):
    model, body = scene(damping)
    trajectory = lg.simulate(model, t1=0.02, num_steps=8, integrator=integrator)
    return lg.time_integral(trajectory.t, trajectory.body(body).acceleration[:, 2] ** 2)


NEWTON = [[[], []]]  # rounds: a new matrix where one is due; iterations
FIXED = [[], []]  # one round
SWEEP = [[]]  # blocks of steps: steps


@pytest.mark.parametrize(
    "scene, integrator, step",
    some_quick(
        [
            (swing, lg.GeneralizedAlpha(), NEWTON),
            (car, lg.GeneralizedAlpha(), NEWTON),
            (car, lg.GeneralizedAlpha(iterations=4), FIXED),
        ]
    ),
    ids=["small", "until converged", "fixed iterations"],
)
def test_loops_over_steps_are_those_of_newton_and_of_the_sweep(scene, integrator, step):
    program = Program(jax.value_and_grad(lambda damping: criterion(damping, scene, integrator)), "cuda")
    assert program.nested == [step, SWEEP]
    assert program.calls <= OF_A_GPU


def test_loops_over_rows_are_seen():
    """On a CPU there are some: it takes them at once, and LAPACK."""
    program = Program(lambda damping: criterion(damping, swing, lg.GeneralizedAlpha()), "cpu")
    (step,) = program.nested
    assert step != NEWTON
    assert any("lapack" in call for call in program.calls)


@on_a_cpu
def test_a_callback_is_not_lowered_without_the_processor():
    def shown(x):
        jax.debug.callback(lambda x: None, x)
        return x

    with pytest.raises(ValueError, match="lowering platform cuda"):
        Program(shown, "cuda")
