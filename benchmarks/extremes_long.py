"""The extremes of length: a million steps of a free body, a hundred thousand in reverse, chaos."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from extremes_rows import EPS, Row, derivatives, largest

import lgsens as lg
from lgsens.examples import spinning_top

INERTIA = (1.0, 2.0, 2.8)
FREE_STEP = 2e-3  # s; the body turns by 5 rad/s × that in a step


def _invariants(s):
    """Energy, momentum in the inertial frame, and |RᵀR − I| of a free body."""
    body = s.body("body")
    inertia = jnp.asarray(INERTIA, body.angular_velocity.dtype)
    momentum = body.orientation @ (inertia * body.angular_velocity)
    energy = jnp.sum(inertia * body.angular_velocity**2) / 2
    skewness = body.orientation.T @ body.orientation - jnp.eye(3, dtype=momentum.dtype)
    return energy, momentum, jnp.max(jnp.abs(skewness))


def tumble(steps: int, h: float):
    """The largest drift of the invariants of a body that tumbles about its middle axis."""
    body = lg.RigidBody(3.0, INERTIA, angular_velocity=(0.1, 5.0, 0.2))
    saved = lg.simulate(lg.Model({"body": body}), t1=steps * h, num_steps=steps, save=_invariants)
    energy, momentum, skewness = (np.asarray(value, float) for value in saved.values)
    return (
        float(np.abs(energy / energy[0] - 1).max()),
        float(np.abs(momentum - momentum[0]).max() / np.abs(momentum[0]).max()),
        float(skewness.max()),
    )


def free_body(steps: int = 1_000_000) -> list[Row]:
    fine, coarse = tumble(steps, FREE_STEP), tumble(steps // 4, 4 * FREE_STEP)
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of single precision
        single = tumble(steps, FREE_STEP)
    eps32 = float(np.finfo(np.float32).eps)
    extreme = f"{steps} steps of a free body"
    round_off = "0.1 n ε: each product of rotations adds a round-off, as in a random walk or at worst to one side"
    second = (
        "1.5/16 of the drift at four times the step over the same time, for the scheme is of second order; + 0.1 n ε"
    )
    rows = [
        Row(extreme, name, fine[i], 1.5 * coarse[i] / 16 + 0.1 * steps * EPS, second)
        for i, name in enumerate(("energy, relative", "angular momentum, relative"))
    ]
    rows.append(Row(extreme, "RᵀR − I", fine[2], 0.1 * steps * EPS, round_off))
    rows.append(Row(extreme, "RᵀR − I in single precision", single[2], 0.1 * steps * eps32, round_off))
    return rows


def _sideways(s):
    return s.body("top").position[0] ** 2


def reverse(steps: int = 100_000) -> list[Row]:
    """The mean of x² of the top over 100 s, by its initial angle and its spin."""

    def mean(p, method):
        run = lg.simulate(
            spinning_top(p[0], spin=p[1]), t1=1e-3 * steps, num_steps=steps, save=_sideways, sensitivity=method
        )
        return jnp.mean(run.values)

    p = jnp.asarray([np.pi / 4, 10.0])
    backwards = jax.jit(jax.grad(partial(mean, method=lg.AdjointVariable(checkpoints="sqrt"))))
    # Forward mode keeps nothing: one tangent beside each state.
    forwards = jax.jit(jax.jacfwd(partial(mean, method=lg.DirectDifferentiation(checkpoints="sqrt"))))
    gradient, slopes = np.asarray(backwards(p)), np.asarray(forwards(p))
    growth = lg.sensitivity_growth(spinning_top(p[0]), t1=1e-3 * steps, num_steps=steps)
    grown = np.inf if bool(growth.exponential) else float(growth.factor[-1])
    extreme = f"{steps} steps in reverse"
    modes = "n ε g: each step of either mode adds a round-off, which grows by g as a change of the start does"
    error = largest(gradient - slopes, np.abs(slopes).max())
    return [
        Row(extreme, "reverse − forward, relative", error, EPS * steps * grown, modes),
        Row(extreme, "growth of a change of the start, regular", grown, 1.0 / EPS, "the motion has digits left"),
    ]


CHAOS_STEP = 2e-3


def double_pendulum(p):
    """Two equal bars on hinges in a plane, released at rest with the first at p₀ [rad] over the horizontal."""
    bodies, joints, start = {}, {}, jnp.zeros_like(p, shape=(3,))
    for i in range(2):
        angle = p[i]
        along = jnp.stack([jnp.cos(angle), jnp.zeros_like(angle), jnp.sin(angle)])
        bodies[f"bar{i}"] = lg.RigidBody(1.0, (1 / 12, 1 / 12, 1 / 12), position=start + along / 2, free="x z ry")
        joints[f"hinge{i}"] = lg.SphericalJoint(f"bar{i - 1}" if i else None, f"bar{i}", at=start)
        start = start + along
    return lg.Model(bodies, joints, {"g": lg.Gravity((0.0, 0.0, -9.81))})


REGULAR, CHAOTIC = (-1.45, -1.6), (1.0, 1.2)  # near rest, and high above it


def chaos(seconds: float = 20.0) -> list[Row]:
    steps = round(seconds / CHAOS_STEP)

    def tip(p):
        run = lg.simulate(double_pendulum(p), t1=seconds, num_steps=steps)
        return run.body("bar1").position[-1]

    rows, starts = [], {"regular": REGULAR, "chaotic": CHAOTIC}
    for name, start, forward, reverse in zip(starts, starts.values(), *derivatives(tip, list(starts.values()))[1:]):
        growth = lg.sensitivity_growth(double_pendulum(jnp.asarray(start)), t1=seconds, num_steps=steps)
        grown, size = float(growth.factor[-1]), largest(forward)
        said = bool(growth.exponential) == (name == "chaotic")
        extreme = f"double pendulum over {seconds:g} s, {name}"
        modes = "16 n ε: both modes multiply the same matrices, from one end or the other"
        compared = f"gradient, {size:.1e}, relative to the growth, {grown:.1e}, which is said to be {name}"
        reach = "the gradient of a place is at most the growth, times 2 m for each of the 2 angles"
        rows += [
            Row(extreme, "reverse − forward, relative", largest(forward - reverse, size), 16 * EPS * steps, modes),
            Row(extreme, compared, size / grown if said else np.inf, 4.0, reach),
        ]
    return rows
