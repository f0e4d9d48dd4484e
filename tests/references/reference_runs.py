"""Two runs of a reference problem, one step half the other, and what second order says about them."""

import functools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.examples import PROBLEMS, Evaluation

DATA = Path(__file__).parents[1] / "data"
ORDER = 0.1  # the h⁴ part bends an observed order by as much as it is of the h² part; `num_steps` keeps that below 0.1
ROUND_OFF = 1e-11  # of thousands of steps, each 2e-16 times a condition of 5e2, that do not add up in one direction


@functools.cache
def document(file: str) -> dict[str, Any]:
    return json.loads((DATA / file).read_text())


@functools.cache
def program(name: str, factor: int):
    """(parameters, t1) → Evaluation at `factor` times the steps of the problem; one compilation for a family.

    At the problem's own step by the transpose of the direct differentiation method, at half of it by the explicit
    adjoint variable method: the order is 2 only if both are right.
    """
    problem = PROBLEMS[name]
    num_steps = factor * max(each.num_steps for each in problem.family)
    sensitivity = lg.DirectDifferentiation() if factor == 1 else lg.AdjointVariable()
    settings = {"num_steps": num_steps, "sensitivity": sensitivity}
    return jax.jit(lambda parameters, t1: problem.differentiate(parameters, t1=t1, **settings))


@functools.cache
def runs(name: str) -> tuple[Evaluation, Evaluation]:
    """The problem at its own step (or the smallest of its family) and at half of it."""
    problem = PROBLEMS[name]
    first = problem.family[0].name
    parameters = {key: jnp.asarray(value) for key, value in problem.parameters.items()}
    coarse, fine = (program(first, factor)(parameters, jnp.asarray(problem.t1)) for factor in (1, 2))
    return coarse, fine


def first_quarter(name: str) -> list[lg.Trajectory]:
    """The motion alone, over a quarter of the time of the problem: at its own step and at half of it."""
    problem = PROBLEMS[name]
    simulate = lambda n: problem.simulate(problem.parameters, t1=problem.t1 / 4, num_steps=n)
    return [simulate(factor * problem.num_steps // 4) for factor in (1, 2)]


def extrapolated(coarse, fine):
    """Richardson: the h² parts cancel."""
    return (4 * np.asarray(fine) - np.asarray(coarse)) / 3


def check_criteria(name: str):
    """Every criterion and every derivative that the file has: second order, and extrapolation leaves fourth order.

    Errors are relative to the largest of Ψ and p dΨ/dp: a derivative far below Ψ/p is a difference of larger effects.
    With ε the largest of them, what is h⁴ is of the size of ε². The h² parts may cancel, to a quarter, say, in what a
    criterion looks at while their squares do not: (4 ε)² is allowed. A reference of 0 has no order: the value is 0.
    """
    problem = PROBLEMS[name]
    names, wanted, found = [], [], []
    for criterion, reference in problem.reference(document(problem.file)).items():
        sizes = {p: problem.parameters[p] for p in reference.gradient}
        entries = lambda value, gradient, s=sizes: np.array([value, *(gradient[p] * s[p] for p in s)], float)
        exact = entries(reference.value, reference.gradient)
        scale = np.abs(exact).max()
        names += [criterion, *(f"d {criterion}/d {p}" for p in sizes)]
        wanted.append(exact / scale)
        found.append([entries(run.values[criterion], run.gradients[criterion]) / scale for run in runs(name)])
    wanted, found = np.concatenate(wanted), np.concatenate(found, axis=1)
    errors, left = np.abs(found - wanted), np.abs(extrapolated(*found) - wanted)
    bound = (4 * errors[0].max()) ** 2 + ROUND_OFF
    for i, entry in enumerate(names):
        assert left[i] <= bound, f"{entry}: {left[i]:.2e} left by extrapolation, {bound:.2e} is of fourth order"
        if wanted[i] == 0.0:
            assert errors[1, i] <= ROUND_OFF, f"{entry}: {found[1, i]:.2e} is not 0"
        else:
            order = np.log2(errors[0, i] / errors[1, i])
            assert abs(order - 2.0) <= ORDER, f"{entry}: order {order:.3f}, errors {errors[:, i]}"


def check_states(name: str, states, observe, expect, trajectories=None):
    """The states of the file: `observe(trajectory)` and `expect(state)` give the same quantities by name; as far as the
    trajectories go, those of `runs` or two others.

    Each quantity by its largest error over its components and the times, which is of second order, and of which
    extrapolation leaves a tenth at most, wherever the largest error is.
    """
    observe = jax.jit(observe)  # one compilation instead of one for every operation
    coarse, fine = (
        (np.asarray(trajectory.t), {key: np.asarray(value) for key, value in observe(trajectory).items()})
        for trajectory in trajectories or [run.trajectory for run in runs(name)]
    )
    states = [state for state in states if 0 < state["t"] < fine[0][-1] * (1.0 + 1e-12)]
    assert states
    wanted = {key: np.stack([expect(state)[key] for state in states]) for key in expect(states[0])}
    assert wanted.keys() == coarse[1].keys()
    for key, values in wanted.items():
        found = []
        for t, observed in (coarse, fine):
            index = np.array([int(np.abs(t - state["t"]).argmin()) for state in states])
            np.testing.assert_allclose(t[index], [state["t"] for state in states], rtol=1e-12)
            found.append(observed[key][index])
        errors = [float(np.abs(f - values).max()) for f in found]
        order = np.log2(errors[0] / errors[1])
        assert abs(order - 2.0) <= ORDER, f"{key}: order {order:.3f}, errors {errors}"
        left = float(np.abs(extrapolated(*found) - values).max())
        assert left <= ORDER * errors[1], f"{key}: {left:.2e} left by extrapolation of {errors[1]:.2e}"


def check_invariants(name: str, observe, wanted, trajectories=None):
    """The largest departure of conserved quantities from their exact values, over all times, is of second order."""
    coarse, fine = map(jax.jit(observe), trajectories or [run.trajectory for run in runs(name)])
    assert coarse.keys() == wanted.keys()
    for key, value in wanted.items():
        errors = [float(np.abs(np.asarray(found[key]) - value).max()) for found in (coarse, fine)]
        order = np.log2(errors[0] / errors[1])
        assert abs(order - 2.0) <= ORDER, f"{key}: order {order:.3f}, errors {errors}"


def rotation(quaternion_wxyz) -> np.ndarray:
    w, x, y, z = quaternion_wxyz
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def turned(orientation):
    """The angle about z since the start, shape (n+1,), of rotation matrices that start at I."""
    return jnp.unwrap(jnp.arctan2(orientation[:, 1, 0], orientation[:, 0, 0]))
