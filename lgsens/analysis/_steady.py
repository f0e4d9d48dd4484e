"""Steady motions, and axes that turn with them, in which the equations of small motions have constant matrices.

Let the equations stay the same when the whole scene turns with the constant angular velocity W (gravity along W, joints
and forces on the ground symmetric about it), and each body i by s_i about an axis of its own frame (a body of
revolution, held where that does not matter). A motion that does no more than that,

    ẍ_i = W × ẋ_i,     Ω_i = R_iᵀ W + s_i,     Ω̇_i = −s_i × Ω_i,

is steady: every instant of it is the first one, turned. A displacement turned likewise has the coordinates

    w = exp(Γ t) w_c,     Γ = diag(W̃, −s̃_i) on translations (inertial axes) and rotations (body axes) of each body,

and matrices of the equations for w_c are constant. W = 0 is a rotor in axes that do not turn, on any bearings; W = Ω
a shaft of any section in axes that turn with it, on isotropic bearings; both together a top that precesses.

Whether a motion is steady is checked: v̇ = Γ v, and the state-space matrices a while later, with the turned basis
exp(Γ t) Z, are those of the beginning.
"""

from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Bool, Float

from lgsens.dynamics import AbstractSystem, State
from lgsens.liegroups import skew
from lgsens.model import MultibodySystem

_ANGLE = 0.7  # rad or lengths of the scene, to which no symmetry but the full one belongs


def _coordinates(system: MultibodySystem, translations, rotations) -> Float[Array, " k"]:
    """The coordinates of the system from those of its bodies, shape (N, 3) each; those of states are zero."""
    rows = jnp.concatenate([translations, rotations], axis=1)
    index = system.index[: rows.shape[0]]
    there = index >= 0
    return jnp.zeros(system.group.dim, rows.dtype).at[index[there]].set(rows[there])


def turning_axes(system: AbstractSystem, state: State, rotation: Float[Array, "3"]) -> Float[Array, "k k"]:
    """Γ; zero on a group of one's own, where coordinates of a motion with constant v are steady as they are."""
    k = system.group.dim
    if not isinstance(system, MultibodySystem):
        return jnp.zeros((k, k), state.v.dtype)
    count = len(system.body_names)
    own = _own_spin(system, state, rotation)
    blocks = jnp.zeros((count, 6, 6), own.dtype).at[:, :3, :3].set(skew(rotation)[None])
    blocks = blocks.at[:, 3:, 3:].set(-jax.vmap(skew)(own))
    index = system.index[:count]
    body, row, column = np.nonzero((index[:, :, None] >= 0) & (index[:, None, :] >= 0))
    return jnp.zeros((k, k), own.dtype).at[index[body, row], index[body, column]].set(blocks[body, row, column])


def _own_spin(system: MultibodySystem, state: State, rotation) -> Float[Array, "N 3"]:
    """s_i."""
    count = len(system.body_names)
    return system.angular_velocities(state.v)[:count] - _seen(system, state, rotation)


def _seen(system: MultibodySystem, state: State, rotation) -> Float[Array, "N 3"]:
    """R_iᵀ W."""
    return jnp.einsum("nji,j->ni", state.q.orientation[: len(system.body_names)], rotation)


def later(
    system: AbstractSystem, state: State, rotation: Float[Array, "3"], turning: Float[Array, "k k"]
) -> tuple[Any, Float[Array, " k"], Float[Array, "k k"]]:
    """q and v a while later in a motion that is steady, and exp(Γ t) until then."""
    k, speed = system.group.dim, jnp.max(jnp.abs(state.v) / system.coordinate_scale())
    time = _ANGLE / jnp.where(speed > 0.0, speed, 1.0)
    augmented = jnp.zeros((k + 1, k + 1), state.v.dtype).at[:k, :k].set(turning).at[:k, k].set(state.v)
    flow = jsl.expm(augmented * time)
    turn, way = flow[:k, :k], flow[:k, k]  # ∫ exp(Γ t) v dt
    q = state.q
    if isinstance(system, MultibodySystem):
        count, zero = len(system.body_names), jnp.zeros((len(system.body_names), 3), way.dtype)
        q = system.group.retract(q, time * _coordinates(system, zero, _seen(system, state, rotation)))
        moves = system.twists(way)[:count, :3]
        way = _coordinates(system, moves, time * _own_spin(system, state, rotation))
    return system.group.retract(q, way), turn @ state.v, turn


def accelerates_steadily(
    system: AbstractSystem, state: State, turning: Float[Array, "k k"] | None, matrix: Float[Array, "s s"]
) -> Bool[Array, ""]:
    """v̇ = Γ v; at rest v = 0 but for the states of elements, and v̇ = 0: to round-off of q times the stiffness over the
    inertia, which are in the `matrix` of the linearized motion."""
    scale, moving = system.coordinate_scale(), system.group.dim - system.num_states
    eps = jnp.finfo(scale.dtype).eps
    speed = jnp.max(jnp.abs(state.v / scale)[:moving])
    left = state.vdot if turning is None else state.vdot - turning @ state.v
    enough = eps**0.375  # 1e-6 in double precision: of 1/s² and of the square of the speed
    round_off = 1e2 * eps * jnp.max(jnp.abs(matrix), initial=0.0) * system.distance(state.q)
    steady = jnp.max(jnp.abs(left) / scale) <= enough * (1.0 + speed**2) + round_off
    return steady & (speed <= enough) if turning is None else steady
