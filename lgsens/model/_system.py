"""The multibody system: an `AbstractSystem` on (R³ × SO(3))^N, assembled by element type."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import suggestion
from lgsens.dynamics import AbstractSystem, Tangents
from lgsens.liegroups import Pose, Power, R3xSO3, cross, skew
from lgsens.model._constraints import AbstractConstraint
from lgsens.model._frames import ROTATION, turn
from lgsens.model._loads import AbstractLoad
from lgsens.model._stack import (
    BODY_DIM,
    Stack,
    constraint_force,
    constraint_jacobian,
    constraint_stiffness,
    load_tangents,
)

# A gradient evaluates these five times in its program. `inline` leaves no call behind; what it saves is tracing,
# a third of it on the quarter-car.
_traced_once = partial(jax.jit, inline=True)


class MultibodySystem(AbstractSystem):
    """Rigid bodies, joints and forces as stacked numbers.

    For body i with coordinates [x_i, θ_i] (paper §3.2, signs as in ERRATA):

        r_i = [m ẍ; J Ω̇ + Ω × J Ω] − Q_i + (Bᵀλ)_i
        M_i = diag(m I, J),     C_t,i = diag(0, Ω̃ J − (J Ω)~)

    and what the loads and joints add. Built by `Model.system()`; the order of bodies is that of
    `body_names`, of multipliers that of the stacks.
    """

    mass: Float[Array, " N"]
    inertia: Float[Array, "N 3 3"]
    pose: Pose  # reference configuration, leading axis N
    velocity: Float[Array, " k"]  # reference velocity
    constraints: tuple[Stack[AbstractConstraint], ...]
    loads: tuple[Stack[AbstractLoad], ...]
    body_names: tuple[str, ...] = eqx.field(static=True)
    assembled: bool = eqx.field(static=True)

    @property
    def group(self) -> Power:
        return Power(R3xSO3(), len(self.body_names))

    @property
    def _rows(self) -> list[np.ndarray]:
        """The multipliers of each stack, shape (elements, rows of one)."""
        rows, start = [], 0
        for stack in self.constraints:
            shape = (len(stack.owners), stack.elements.num_rows)
            rows.append(start + np.arange(shape[0] * shape[1]).reshape(shape))
            start += shape[0] * shape[1]
        return rows

    @property
    def constraint_names(self) -> tuple[str, ...]:
        return tuple(
            owner
            for stack, rows in zip(self.constraints, self._rows)
            for owner in stack.owners
            for _ in range(rows.shape[1])
        )

    def multiplier_rows(self, joint: str) -> np.ndarray:
        """Where the multipliers of a joint are in λ, in the order of its basic constraints."""
        return np.flatnonzero(np.asarray(self.constraint_names) == joint)

    def reference(self):
        return self.pose, self.velocity

    def coordinate_scale(self):
        # The scene's length: the extent of the centres of mass, or the largest arm of an attachment.
        extents = [jnp.ptp(self.pose.position, axis=0)]
        for stack in (*self.constraints, *self.loads):
            arms = (getattr(stack.elements, name, None) for name in ("point_a", "point_b"))
            extents += [jnp.abs(arm).max(axis=0) for arm in arms if arm is not None]
        length = jnp.max(jnp.stack(extents))
        body = jnp.ones(BODY_DIM, length.dtype)
        scale = body.at[: ROTATION.start].set(jnp.where(length > 0, length, 1.0))
        return jnp.tile(scale, len(self.body_names))

    def mass_matrix(self):
        blocks = jnp.zeros((len(self.body_names), BODY_DIM, BODY_DIM), self.mass.dtype)
        translation = self.mass[:, None, None] * jnp.eye(ROTATION.start, dtype=self.mass.dtype)[None]
        blocks = blocks.at[:, : ROTATION.start, : ROTATION.start].set(translation)
        blocks = blocks.at[:, ROTATION, ROTATION].set(self.inertia)
        return self._matrix([(blocks, self._body_coordinates)])

    @property
    def _body_coordinates(self) -> np.ndarray:
        return np.arange(len(self.body_names) * BODY_DIM).reshape(-1, BODY_DIM)

    def _matrix(self, blocks) -> Float[Array, "k k"]:
        """The sum of square blocks at their coordinates, in one scatter."""
        k = self.group.dim
        where = [c[:, :, None] * k + c[:, None, :] for _, c in blocks]
        index = np.concatenate([w.ravel() for w in where])
        values = jnp.concatenate([block.ravel() for block, _ in blocks])
        return jnp.zeros(k * k, self.mass.dtype).at[index].add(values).reshape(k, k)

    @_traced_once
    def residual(self, q, v, vdot, lam, t):
        twist = v.reshape(-1, BODY_DIM)
        spin = twist[:, ROTATION]
        acceleration = vdot.reshape(-1, BODY_DIM)
        turned = jax.vmap(turn)
        gyroscopic = jax.vmap(cross)(spin, turned(self.inertia, spin))
        inertial = jnp.concatenate(
            [
                self.mass[:, None] * acceleration[:, : ROTATION.start],
                turned(self.inertia, acceleration[:, ROTATION]) + gyroscopic,
            ],
            axis=1,
        )
        index, values = [self._body_coordinates.ravel()], [inertial.ravel()]
        for stack in self.loads:
            force = stack.map(lambda e, a, b, va, vb, t: e.force(a, b, va, vb, t), q, twist, extra=(t,))
            index.append(stack.coordinates.ravel())
            values.append(-force[:, stack.part].ravel())
        for stack, rows in zip(self.constraints, self._rows):
            force = stack.map(constraint_force, q, extra=(lam[rows],))
            index.append(stack.coordinates.ravel())
            values.append(force[:, stack.part].ravel())
        return jnp.zeros_like(v).at[np.concatenate(index)].add(jnp.concatenate(values))

    @_traced_once
    def constraint(self, q):
        values = [stack.map(lambda e, a, b: e.value(a, b), q).ravel() for stack in self.constraints]
        return jnp.concatenate(values) if values else jnp.zeros(0, self.mass.dtype)

    @_traced_once
    def constraint_jacobian(self, q):
        k, m = self.group.dim, len(self.constraint_names)
        if m == 0:
            return jnp.zeros((0, k), self.mass.dtype)
        index, values = [], []
        for stack, rows in zip(self.constraints, self._rows):
            block = stack.map(constraint_jacobian, q)[:, :, stack.part]
            index.append((rows[:, :, None] * k + stack.coordinates[:, None, :]).ravel())
            values.append(block.ravel())
        flat = jnp.zeros(m * k, self.mass.dtype).at[np.concatenate(index)].add(jnp.concatenate(values))
        return flat.reshape(m, k)

    @_traced_once
    def tangents(self, q, v, vdot, lam, t):
        twist = v.reshape(-1, BODY_DIM)
        spin = twist[:, ROTATION]
        momentum = jnp.einsum("nij,nj->ni", self.inertia, spin)
        gyroscopic = jax.vmap(skew)(spin) @ self.inertia - jax.vmap(skew)(momentum)
        damping = [(gyroscopic, self._body_coordinates[:, ROTATION])]
        stiffness = []
        for stack in self.loads:
            part, coordinates = stack.part, stack.coordinates
            position, velocity = stack.map(load_tangents, q, twist, extra=(t,))
            if position is not None:
                stiffness.append((-position[:, part, part], coordinates))
            if velocity is not None:
                damping.append((-velocity[:, part, part], coordinates))
        for stack, rows in zip(self.constraints, self._rows):
            part = stack.part
            block = stack.map(constraint_stiffness, q, extra=(lam[rows],))
            stiffness.append((block[:, part, part], stack.coordinates))
        k = self.group.dim
        stiffness_matrix = self._matrix(stiffness) if stiffness else jnp.zeros((k, k), self.mass.dtype)
        return Tangents(stiffness_matrix, self._matrix(damping), self.constraint_jacobian(q))

    def measure(self, force: str, q, v, t):
        """What the force element `force` measures at each of the stacked poses, velocities and times.

        The `measure` of its load if it has one, else its generalized force.
        """
        found = [(stack, i) for stack in self.loads for i, owner in enumerate(stack.owners) if owner == force]
        if not found:
            known = {owner for stack in self.loads for owner in stack.owners}
            raise ValueError(f"`force`: {suggestion(force, known)}.")
        if len(found) > 1:
            raise ValueError(f"`force`: {force!r} acts on {len(found)} bodies and has no single value.")
        stack, i = found[0]
        load = jax.tree.map(lambda leaf: leaf[i], stack.elements)
        single = Stack(
            elements=jax.tree.map(lambda leaf: leaf[None], load),
            a=None if stack.a is None else (stack.a[i],),
            b=None if stack.b is None else (stack.b[i],),
            owners=(force,),
        )

        def at_time(q, v, t):
            evaluate = lambda e, *args: getattr(e, "measure", e.force)(*args)
            return single.map(evaluate, q, v.reshape(-1, BODY_DIM), extra=(t,))

        return jax.tree.map(lambda leaf: leaf[:, 0], jax.vmap(at_time)(q, v, t))
