"""The multibody system: an `AbstractSystem` on (R³ × SO(3))^N or a subgroup of it, assembled by element type."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import suggestion
from lgsens.dynamics import AbstractSystem, Tangents
from lgsens.liegroups import Pose, Poses, Power, R3xSO3, cross, skew
from lgsens.model._constraints import AbstractConstraint
from lgsens.model._frames import ROTATION, turn
from lgsens.model._loads import AbstractLoad
from lgsens.model._parts import Parts
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

    and what the loads and joints add, of which the rows and columns of the coordinates that bodies have (`free`) are
    assembled, and of joints the equations that these can violate. Built by `Model.system()`; the order of bodies is
    that of `body_names`, of multipliers that of the stacks. x_i is the origin of the body frame and J the
    inertia about it: where that is not the centre of mass (`centre`), the body does not translate.
    """

    mass: Float[Array, " N"]
    inertia: Float[Array, "N 3 3"]
    pose: Pose  # reference configuration, leading axis N
    velocity: Float[Array, " k"]  # reference velocity
    centre: Float[Array, "N 3"] | None  # centre of mass in the body frame; None: its origin, for all bodies
    constraints: tuple[Stack[AbstractConstraint], ...]
    loads: tuple[Stack[AbstractLoad], ...]
    parts: "Parts[MultibodySystem] | None"  # of merged bodies
    body_names: tuple[str, ...] = eqx.field(static=True)
    free: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # the coordinates, 0 to 5, of each body
    assembled: bool = eqx.field(static=True)

    @property
    def group(self) -> Power | Poses:
        all_free = all(len(own) == BODY_DIM for own in self.free)
        return Power(R3xSO3(), len(self.body_names)) if all_free else Poses(self.free)

    @property
    def index(self) -> np.ndarray:
        """The place of each body's coordinates among those of the system, shape (N, 6); −1 where it has none."""
        group = self.group
        if isinstance(group, Poses):
            return group.index
        return np.arange(len(self.body_names) * BODY_DIM).reshape(-1, BODY_DIM)

    def twists(self, v: Float[Array, "*batch k"]) -> Float[Array, "*batch N 6"]:
        """[ẋ, Ω] of each body, or their rates of change, from v or v̇: zero where a body is not free."""
        group = self.group
        if isinstance(group, Poses):
            return group.rows(v)
        return v.reshape(*v.shape[:-1], -1, BODY_DIM)

    def _placed(self, q: Pose) -> Pose:
        """q with what no body can change taken from the reference configuration.

        A state has tangents along the free coordinates only: what else the poses depend on (the place of a pivot, say)
        is a number of the system, and derivatives by it pass through here.
        """
        if isinstance(self.group, Power):
            return q
        moves = self.index[:, : ROTATION.start] >= 0
        turns = np.any(self.index[:, ROTATION] >= 0, axis=1)[:, None, None]
        pick = lambda own, new, old: jnp.where(np.broadcast_to(own, new.shape), new, jnp.broadcast_to(old, new.shape))
        return Pose(pick(moves, q.position, self.pose.position), pick(turns, q.orientation, self.pose.orientation))

    def motion(self, body: int, q, v, vdot):
        """Position, orientation, velocity, Ω, acceleration, Ω̇ of a body's centre of mass, along leading axes.

        With the origin of the body frame at rest and the centre of mass at c in it: x = x_o + R c, ẋ = R (Ω × c) and
        ẍ = R (Ω̇ × c + Ω × (Ω × c)).
        """
        q = self._placed(q)
        position, orientation = q.position[..., body, :], q.orientation[..., body, :, :]
        twist, rate = (self.twists(x)[..., body, :] for x in (v, vdot))
        velocity, spin = twist[..., : ROTATION.start], twist[..., ROTATION]
        acceleration, change = rate[..., : ROTATION.start], rate[..., ROTATION]
        if self.centre is not None:
            to_inertial = lambda local: jnp.einsum("...ij,...j->...i", orientation, local)
            arm = jnp.broadcast_to(self.centre[body], spin.shape)
            swing = jnp.cross(spin, arm)
            position, velocity = position + to_inertial(arm), velocity + to_inertial(swing)
            acceleration = acceleration + to_inertial(jnp.cross(change, arm) + jnp.cross(spin, swing))
        return position, orientation, velocity, spin, acceleration, change

    @property
    def _rows(self) -> list[np.ndarray]:
        """The multipliers of each stack, shape (elements, rows of one); −1 for an equation that is not kept."""
        rows, start = [], 0
        for stack in self.constraints:
            kept = np.asarray(stack.kept)
            rows.append(np.where(kept, start + np.cumsum(kept).reshape(kept.shape) - 1, -1))
            start += int(kept.sum())
        return rows

    @property
    def constraint_names(self) -> tuple[str, ...]:
        return tuple(
            owner
            for stack, rows in zip(self.constraints, self._rows)
            for owner, own in zip(stack.owners, rows)
            for _ in range((own >= 0).sum())
        )

    def multiplier_rows(self, joint: str) -> np.ndarray:
        """Where the multipliers of a joint are in λ, in the order of its basic constraints."""
        own = [
            (place, rows[rows >= 0])
            for stack, of_stack in zip(self.constraints, self._rows)
            for owner, place, rows in zip(stack.owners, stack.places, of_stack)
            if owner == joint
        ]
        return np.concatenate([np.zeros(0, int), *(rows for _, rows in sorted(own, key=lambda each: each[0]))])

    def of_parts(self, q, v, vdot):
        """The system of the bodies as they are named, and their q, v, v̇: those of this one unless some are merged."""
        if self.parts is None:
            return self, q, v, vdot
        return self.parts.system, *self.parts.motion(self._placed(q), self.twists(v), self.twists(vdot))

    def multiplier(self, joint: str, q, v, vdot, lam, t):
        """The multipliers of a joint, along leading axes; those of a merged one from the equations of its bodies."""
        whole, q, v, vdot = self.of_parts(q, v, vdot)
        if joint not in whole.constraint_names:
            raise ValueError(f"`multiplier`: {suggestion(joint, set(whole.constraint_names))}.")
        if self.parts is None or joint not in self.parts.joints:
            return lam[..., self.multiplier_rows(joint)]
        places, own_places = [np.zeros(0, int)], [np.zeros(0, int)]
        for name in sorted(set(whole.constraint_names) - set(self.parts.joints)):
            rows, own = whole.multiplier_rows(name), self.multiplier_rows(name)
            if len(rows) != len(own):
                raise ValueError(
                    f"`multiplier`: what {joint!r} carries is not determined: joint {name!r} has {len(rows)} "
                    f"equations between the bodies that it names, and {len(own)} between the merged ones. Leave "
                    "`merge_fixed` out and remove the equations that are redundant then."
                )
            places.append(rows)
            own_places.append(own)
        others = jnp.zeros((*lam.shape[:-1], len(whole.constraint_names)), lam.dtype)
        others = others.at[..., np.concatenate(places)].set(lam[..., np.concatenate(own_places)])
        complete = partial(self.parts.with_fixed, joint)
        for _ in lam.shape[:-1]:
            complete = jax.vmap(complete)
        return complete(q, v, vdot, others, t)[..., whole.multiplier_rows(joint)]

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
        if isinstance(self.group, Poses):
            return scale[np.concatenate([np.asarray(own, int) for own in self.free])]
        return jnp.tile(scale, len(self.body_names))

    def mass_matrix(self):
        blocks = jnp.zeros((len(self.body_names), BODY_DIM, BODY_DIM), self.mass.dtype)
        translation = self.mass[:, None, None] * jnp.eye(ROTATION.start, dtype=self.mass.dtype)[None]
        blocks = blocks.at[:, : ROTATION.start, : ROTATION.start].set(translation)
        blocks = blocks.at[:, ROTATION, ROTATION].set(self.inertia)
        return self._matrix([(blocks, self.index)])

    def _matrix(self, blocks) -> Float[Array, "k k"]:
        """The sum of square blocks at their coordinates, in one scatter."""
        k = self.group.dim
        if not blocks:
            return jnp.zeros((k, k), self.mass.dtype)
        entries = [_entries(block, _flat(c[:, :, None], c[:, None, :], k)) for block, c in blocks]
        values, places = _joined(entries)
        return jnp.zeros(k * k, self.mass.dtype).at[places].add(values).reshape(k, k)

    def _multipliers(self, lam, rows: np.ndarray):
        """The multipliers of a stack's equations, zero for those that are not kept."""
        if (rows >= 0).all():
            return lam[rows]
        return jnp.concatenate([lam, jnp.zeros(1, lam.dtype)])[np.where(rows < 0, len(lam), rows)]

    @property
    def _gyroscopic(self) -> bool:
        """Whether a body has three rotations: Ω × J Ω of one about a body axis has no component along it."""
        return bool((self.index[:, ROTATION] >= 0).all(axis=1).any())

    @_traced_once
    def residual(self, q, v, vdot, lam, t):
        q, twist = self._placed(q), self.twists(v)
        spin = twist[:, ROTATION]
        acceleration = self.twists(vdot)
        turned = jax.vmap(turn)
        force = self.mass[:, None] * acceleration[:, : ROTATION.start]
        moment = turned(self.inertia, acceleration[:, ROTATION])
        if self._gyroscopic:
            moment = moment + jax.vmap(cross)(spin, turned(self.inertia, spin))
        entries = [_entries(jnp.concatenate([force, moment], axis=1), self.index)]
        for stack in self.loads:
            force = stack.map(lambda e, a, b, va, vb, t: e.force(a, b, va, vb, t), q, twist, extra=(t,))
            values, places = _entries(force[:, stack.part], stack.coordinates(self.index))
            entries.append((-values, places))
        for stack, rows in zip(self.constraints, self._rows):
            force = stack.map(constraint_force, q, extra=(self._multipliers(lam, rows),))
            entries.append(_entries(force[:, stack.part], stack.coordinates(self.index)))
        zero = jnp.zeros_like(v)
        values, places = _joined(entries)
        return zero.at[places].add(values)

    @_traced_once
    def constraint(self, q):
        q = self._placed(q)
        entries = [
            _entries(stack.map(lambda e, a, b: e.value(a, b), q), rows)
            for stack, rows in zip(self.constraints, self._rows)
        ]
        return _joined(entries)[0] if entries else jnp.zeros(0, self.mass.dtype)

    @_traced_once
    def constraint_jacobian(self, q):
        k, m = self.group.dim, len(self.constraint_names)
        if m == 0:
            return jnp.zeros((0, k), self.mass.dtype)
        q = self._placed(q)
        entries = []
        for stack, rows in zip(self.constraints, self._rows):
            block = stack.map(constraint_jacobian, q)[:, :, stack.part]
            entries.append(_entries(block, _flat(rows[:, :, None], stack.coordinates(self.index)[:, None, :], k)))
        zero = jnp.zeros(m * k, self.mass.dtype)
        values, places = _joined(entries)
        return zero.at[places].add(values).reshape(m, k)

    @_traced_once
    def tangents(self, q, v, vdot, lam, t):
        q, twist = self._placed(q), self.twists(v)
        damping, stiffness = [], []
        if self._gyroscopic:
            spin = twist[:, ROTATION]
            momentum = jnp.einsum("nij,nj->ni", self.inertia, spin)
            gyroscopic = jax.vmap(skew)(spin) @ self.inertia - jax.vmap(skew)(momentum)
            damping.append((gyroscopic, self.index[:, ROTATION]))
        for stack in self.loads:
            part, coordinates = stack.part, stack.coordinates(self.index)
            position, velocity = stack.map(load_tangents, q, twist, extra=(t,))
            if position is not None:
                stiffness.append((-position[:, part, part], coordinates))
            if velocity is not None:
                damping.append((-velocity[:, part, part], coordinates))
        for stack, rows in zip(self.constraints, self._rows):
            part = stack.part
            block = stack.map(constraint_stiffness, q, extra=(self._multipliers(lam, rows),))
            stiffness.append((block[:, part, part], stack.coordinates(self.index)))
        return Tangents(self._matrix(stiffness), self._matrix(damping), self.constraint_jacobian(q))

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
            kept=((),),
            places=(0,),
        )

        def at_time(q, v, t):
            evaluate = lambda e, *args: getattr(e, "measure", e.force)(*args)
            return single.map(evaluate, self._placed(q), self.twists(v), extra=(t,))

        return jax.tree.map(lambda leaf: leaf[:, 0], jax.vmap(at_time)(q, v, t))


# Where entries of a system's arrays go: static arrays of integers, −1 for an entry that the system does not have.


def _flat(row: np.ndarray, column: np.ndarray, width: int) -> np.ndarray:
    """The places of the entries (row, column) of a matrix in its flattened array."""
    return np.where((row < 0) | (column < 0), -1, row * width + column)


def _entries(array, places: np.ndarray):
    """The entries of an array that have a place, and their places, both flat."""
    values, places = array.ravel(), places.ravel()
    chosen = np.flatnonzero(places >= 0)
    return (values, places) if len(chosen) == len(places) else (values[chosen], places[chosen])


def _joined(entries):
    """The entries of several arrays in one, and their places."""
    return jnp.concatenate([values for values, _ in entries]), np.concatenate([places for _, places in entries])
