"""The multibody system: an `AbstractSystem` on (R³ × SO(3))^N or a subgroup of it, assembled by element type."""

import dataclasses
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import suggestion
from lgsens._xla import one_program
from lgsens.dynamics import AbstractSparseSystem, Tangents, finite, least_norm
from lgsens.liegroups import Pose, Poses, Power, R3xSO3, cross, skew, turn
from lgsens.linear import AbstractLinearSolver, Blocks, SparseMatrix, added, chosen
from lgsens.model._blocks_of_bodies import body_blocks, rotation_operators
from lgsens.model._breaking import breaking_of
from lgsens.model._checks import are_bodies, far_from_rotation
from lgsens.model._constraints import AbstractRows
from lgsens.model._frames import BODY_DIM, ROTATION, Frame, motion_at
from lgsens.model._given_joints import GivenJoints, JointsOf
from lgsens.model._left_out import names_left_out, values_left_out
from lgsens.model._loads import AbstractDynamicLoad, AbstractLoad, generalized_force, of_states
from lgsens.model._merged_parts import Parts
from lgsens.model._rate_stiffness import rate_stiffness
from lgsens.model._sizes import compliance, coordinate_scale, distance
from lgsens.model._stack import (
    Stack,
    at_ends,
    constraint_force,
    constraint_jacobian,
    constraint_stiffness,
    load_by_multipliers,
    load_tangents,
    position_values,
    rate_of,
    square_blocks,
    state_coordinates,
)
from lgsens.model._topology import Topology, topology


class MultibodySystem(AbstractSparseSystem):
    """Rigid bodies, joints and forces as stacked numbers.

    For body i with coordinates [x_i, θ_i] (paper §3.2, signs as in ERRATA):

        r_i = [m ẍ; J Ω̇ + Ω × J Ω] − Q_i + (Bᵀλ)_i
        M_i = diag(m I, J),     C_t,i = diag(0, Ω̃ J − (J Ω)~)

    and what the loads and joints add, of which the rows and columns of the coordinates that bodies have (`free`) are
    assembled, and of joints the equations that these can violate. Built by `Model.system()`; the order of bodies is
    that of `body_names`, of multipliers that of the stacks. x_i is the origin of the body frame and J the
    inertia about it: where that is not the centre of mass (`centre`), the body does not translate. After the bodies
    come the carriers of the states of loads, without names: points of unit mass, whose velocities the states are.
    """

    mass: Float[Array, " N"]
    inertia: Float[Array, "N 3 3"]
    pose: Pose  # reference configuration, leading axis N
    velocity: Float[Array, " k"]  # reference velocity
    centre: Float[Array, "N 3"] | None  # centre of mass in the body frame; None: its origin, for all bodies
    constraints: tuple[Stack[AbstractRows], ...]  # those of velocity level last
    loads: tuple[Stack[AbstractLoad | AbstractDynamicLoad], ...]
    given: tuple[GivenJoints, ...]  # the joints; of merged bodies their parts have them
    parts: "Parts[MultibodySystem] | None"  # of merged bodies
    body_names: tuple[str, ...] = eqx.field(static=True)
    free: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # the coordinates, 0 to 5, of each body
    assembled: bool = eqx.field(static=True)
    linear_solver: AbstractLinearSolver | None = eqx.field(static=True)  # None: the cheaper one
    minimum_norm: bool = eqx.field(static=True)  # whether constraints may be redundant
    repeated: tuple[Stack[AbstractRows], ...] = ()  # those of position level that are left out

    @property
    def topology(self) -> Topology:
        return topology(self.free, *(tuple(stack.ends for stack in some) for some in (self.constraints, self.loads)))

    @property
    def elimination(self):
        return self.topology.elimination(self.linear_solver)

    def arranged(self, arrangement):
        return self.topology.elimination(self.linear_solver, arrangement)

    @property
    def group(self) -> Power | Poses:
        all_free = all(len(own) == BODY_DIM for own in self.free)
        return Power(R3xSO3(), len(self.body_names)) if all_free else Poses(self.free)

    @property
    def index(self) -> np.ndarray:
        """The place of each body's coordinates among those of the system, shape (N, 6); −1 where it has none."""
        return self.topology.index

    def twists(self, v: Float[Array, "*batch k"]) -> Float[Array, "*batch N 6"]:
        """[ẋ, Ω] of each body, or their rates of change, from v or v̇: zero where a body is not free."""
        return group.rows(v) if isinstance(group := self.group, Poses) else v.reshape(*v.shape[:-1], -1, BODY_DIM)

    def angular_velocities(self, v):
        return self.twists(v)[..., ROTATION]

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

    @partial(one_program, static_argnums=1)
    def motion(self, body: int, q, v, vdot):
        """Position, orientation, velocity, Ω, acceleration, Ω̇ of a body's centre of mass, along leading axes."""
        q = self._placed(q)
        position, orientation = q.position[..., body, :], q.orientation[..., body, :, :]
        twist, rate = (self.twists(x)[..., body, :] for x in (v, vdot))
        if self.centre is None:
            velocity, acceleration = twist[..., : ROTATION.start], rate[..., : ROTATION.start]
        else:
            position, velocity, acceleration = motion_at(self.centre[body], position, orientation, twist, rate)
        return position, orientation, velocity, twist[..., ROTATION], acceleration, rate[..., ROTATION]

    @property
    def constraint_names(self) -> tuple[str, ...]:
        return tuple(
            owner
            for stack, rows in zip(self.constraints, self.topology.rows)
            for owner, own in zip(stack.owners, rows)
            for _ in range((own >= 0).sum())
        )

    @property
    def compliance(self):
        return compliance(self) if self.minimum_norm else None

    def multiplier_rows(self, joint: str) -> np.ndarray:
        """Where the multipliers of a joint are in λ, in the order of its basic constraints."""
        every = zip(self.constraints, self.topology.rows)
        own = {i: of for stack, rows in every for name, i, of in zip(stack.owners, stack.places, rows) if name == joint}
        return np.concatenate([np.zeros(0, int), *(own[i][own[i] >= 0] for i in sorted(own))])

    breaking: ClassVar[Any] = property(breaking_of)
    repeated_names: ClassVar[Any] = property(names_left_out)
    sparse_rate_stiffness: ClassVar[Any] = rate_stiffness
    body_blocks: ClassVar[Any] = body_blocks
    rotation_operators: ClassVar[Any] = rotation_operators

    def repeated_constraint(self, q, t):
        return values_left_out(self, q, t)

    def of_parts(self, q, v, vdot):
        """The system of the bodies as they are named, and their q, v, v̇: those of this one unless some are merged."""
        if self.parts is None:
            return self, q, v, vdot
        return self.parts.system, *self.parts.motion(self._placed(q), self.twists(v), self.twists(vdot))

    def multiplier(self, joint: str, q, v, vdot, lam, t):
        """The multipliers of a joint, along leading axes; those of a merged one from the equations of its bodies.

        Where constraints may be redundant they are those of least norm.
        """
        least = partial(least_norm, self)
        for _ in lam.shape[:-1]:
            least = jax.vmap(least)
        lam = least(q, lam, t)
        whole, q, v, vdot = self.of_parts(q, v, vdot)
        if joint not in whole.constraint_names:
            raise ValueError(f"`multiplier`: {suggestion(joint, set(whole.constraint_names))}.")
        if self.parts is None or joint not in self.parts.joints:
            return jnp.take(lam, self.multiplier_rows(joint), -1, mode="clip")
        return self.parts.multiplier(joint, self.multiplier_rows, q, v, vdot, lam, t)

    @property
    def whole(self) -> "MultibodySystem":
        """The system of the bodies as they are named."""
        return self if self.parts is None else self.parts.system

    def reference_frame(self, body: str) -> Frame:
        """The frame at the centre of mass of a body as it is named, in the reference configuration."""
        of, still = self.whole, jnp.zeros_like(self.whole.velocity)
        return Frame(*of.motion(of.body_names.index(body), of.pose, still, still)[:2])

    @property
    def joints(self) -> JointsOf:
        """The joints of the bodies as they are named, as they were given."""
        return JointsOf(self.whole.given)

    def is_valid(self):
        known = finite(self.pose, self.velocity, self.constraints, self.loads)
        return known & are_bodies(self.mass, self.inertia, self.pose.orientation)

    def is_configuration(self, q):
        return ~jnp.any(far_from_rotation(q.orientation, 1e-3))

    def reference(self):
        return self.pose, self.velocity

    def coordinate_scale(self):
        return coordinate_scale(self)

    def distance(self, q):
        return distance(self, q)

    def branches(self, q):
        stacks = (*self.constraints, *self.loads)
        ends = at_ends(stacks, self._placed(q))
        found = [stack.map(lambda element, *frames: element.branch(*frames), at) for stack, at in zip(stacks, ends)]
        return jnp.concatenate([super().branches(q), *(angles.ravel() for angles in found if angles is not None)])

    @property
    def num_states(self):
        return sum(map(len, self.free[len(self.body_names) :]))

    @property
    def dynamic(self) -> list[Stack[Any]]:
        """The stacks of loads with states."""
        return [stack for stack in self.loads if stack.carriers]

    def settled(self, q, v, t):
        for stack, ends in zip(self.dynamic, at_ends(self.dynamic, self._placed(q), self.twists(v))):
            begun = stack.map(lambda load, *args: of_states(load, "initial", load.initial(*args)), ends, (t,))
            v = v.at[state_coordinates(stack, self.index)].set(begun)
        return v

    def places_of_states(self) -> dict[str, dict[str, int]]:
        """By the name of each force element with states, and their names, where they are in v."""
        return {
            owner: dict(zip(stack.elements.states, places.tolist()))
            for stack in self.dynamic
            for owner, places in zip(stack.owners, state_coordinates(stack, self.index))
        }

    def sparse_mass_matrix(self):
        translation = self.mass[:, None, None] * jnp.eye(ROTATION.start, dtype=self.mass.dtype)[None]
        none = jnp.zeros_like(translation)
        blocks = jnp.block([[translation, none], [none, self.inertia]])
        return self._square([Blocks(blocks, self.topology.mass)])

    def _square(self, parts) -> SparseMatrix:
        k = self.group.dim
        return SparseMatrix(tuple(parts), (k, k), self.mass.dtype)

    @property
    def _gyroscopic(self) -> bool:
        """Whether a body has three rotations: Ω × J Ω of one about a body axis has no component along it."""
        return bool((self.index[:, ROTATION] >= 0).all(axis=1).any())

    def _acting(self, q, twist, lam, t, patterns):
        """Each stack of loads, its ends, what its elements are given besides, and its pattern."""
        for stack, ends, read, pattern in zip(self.loads, at_ends(self.loads, q, twist), self.topology.read, patterns):
            yield stack, ends, (t, *stack.inputs(twist, lam, read.rows)), pattern

    @one_program
    def residual(self, q, v, vdot, lam, t):
        q, twist, acceleration = self._placed(q), self.twists(v), self.twists(vdot)
        spin = twist[:, ROTATION]
        turned = jax.vmap(turn)
        force = self.mass[:, None] * acceleration[:, : ROTATION.start]
        moment = turned(self.inertia, acceleration[:, ROTATION])
        if self._gyroscopic:
            moment = moment + jax.vmap(cross)(spin, turned(self.inertia, spin))
        topology = self.topology
        forces = [(jnp.concatenate([force, moment], axis=1), topology.mass.rows)]
        for stack, ends, inputs, coordinates in self._acting(q, twist, lam, t, topology.forces):
            force = stack.map(generalized_force, ends, inputs)
            forces.append((-stack.acting(force), coordinates))
        for stack, ends, pattern in zip(self.constraints, at_ends(self.constraints, q), topology.jacobian):
            force = stack.map(constraint_force, ends, (chosen(lam, pattern.rows), t))
            forces.append((stack.acting(force), pattern.columns))
        return added(forces, self.group.dim, v.dtype)

    @property
    def num_velocity_rows(self):
        return self.topology.num_velocity_rows

    @one_program
    def constraint(self, q, t):
        of = self.topology
        values = position_values(self.constraints[: of.num_positions], self._placed(q), t)
        return added(list(zip(values, of.rows)), of.num_constraints - self.num_velocity_rows, self.mass.dtype)

    @one_program
    def velocity_constraint(self, q, v, t):
        of, first = self.topology, self.topology.num_constraints - self.num_velocity_rows
        stacks, rows = self.constraints[of.num_positions :], of.rows[of.num_positions :]
        values = [
            (stack.map(rate_of, ends, (t,)), np.where(own < 0, own, own - first))
            for stack, ends, own in zip(stacks, at_ends(stacks, self._placed(q), self.twists(v)), rows)
        ]
        return added(values, self.num_velocity_rows, self.mass.dtype)

    def constraint_jacobian(self, q, t):
        every = self.sparse_constraint_jacobian(q, t).dense()
        return every[: -self.num_velocity_rows] if self.num_velocity_rows else every

    def velocity_jacobian(self, q, t):
        return self.sparse_constraint_jacobian(q, t).dense()[self.topology.num_constraints - self.num_velocity_rows :]

    @one_program
    def sparse_constraint_jacobian(self, q, t):
        q = self._placed(q)
        parts = [
            Blocks(stack.acting(stack.map(constraint_jacobian, ends, (t,))), pattern)
            for stack, ends, pattern in zip(self.constraints, at_ends(self.constraints, q), self.topology.jacobian)
        ]
        return SparseMatrix(tuple(parts), (self.topology.num_constraints, self.group.dim), self.mass.dtype)

    @one_program
    def sparse_tangents(self, q, v, vdot, lam, t):
        q, twist, topology = self._placed(q), self.twists(v), self.topology
        damping, stiffness = [], []
        if self._gyroscopic:
            spin = twist[:, ROTATION]
            momentum = jnp.einsum("nij,nj->ni", self.inertia, spin)
            gyroscopic = jax.vmap(skew)(spin) @ self.inertia - jax.vmap(skew)(momentum)
            damping.append(Blocks(gyroscopic, topology.gyroscopic))
        for stack, ends, inputs, pattern in self._acting(q, twist, lam, t, topology.loads):
            own = stack.ends.own
            position, velocity = stack.map(load_tangents, ends, inputs)
            if position is not None:
                stiffness.append(Blocks(-square_blocks(position, own), pattern))
            if velocity is not None:
                damping.append(Blocks(-square_blocks(velocity, own), pattern))
        placed = zip(self.constraints, at_ends(self.constraints, q), topology.rows, topology.stiffness)
        for stack, ends, rows, coupled in placed:
            block = square_blocks(stack.map(constraint_stiffness, ends, (chosen(lam, rows), t)), stack.ends.own)
            stiffness.extend(Blocks(square_blocks(block, places), pattern) for places, pattern in coupled)
        return Tangents(self._square(stiffness), self._square(damping), self.sparse_constraint_jacobian(q, t))

    @property
    def reads_multipliers(self):
        return any(read.rows.size for read in self.topology.read)

    @one_program
    def multiplier_jacobian(self, q, v, lam, t):
        transposed, twist, topology = self.sparse_constraint_jacobian(q, t), self.twists(v), self.topology
        for stack, ends, inputs, pattern in self._acting(self._placed(q), twist, lam, t, topology.read):
            if pattern.rows.size:
                columns = jnp.swapaxes(stack.map(load_by_multipliers, ends, inputs), 1, 2)
                part = Blocks(-stack.acting(columns), pattern)
                transposed = dataclasses.replace(transposed, parts=(*transposed.parts, part))
        return transposed.T
