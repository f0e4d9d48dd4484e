"""The equations of motion of a scene on SE(3): those on R³ × SO(3), in velocities that refer to the frames of bodies.

Of a body with all six coordinates u = Rᵀẋ takes the place of ẋ. With A(q) = diag(R, I) for each of these, and I for all
other coordinates (of bodies that are partly free, states of elements), what both formulations mean by one motion is

    v_m = A v,     v̇_m = A (v̇ + [Ω × u, 0]),     δq_m = A w,     δq = q w̃ on SE(3),

and virtual work gives r = Aᵀ r_m, B = B_m A: all joints and forces pass through A, as they are. For the tangents, with
[x]_u the block at (u, Ω) of a body, δ(A v) = A (δv + w_Ω × u), and f = r_u of a body δ(Aᵀ) r_m = f × w_Ω:

    K = Aᵀ K_m A + Aᵀ C_m A [−ũ]_u + m [−ã]_u + [f̃]_u,     a = u̇ + Ω × u,
    C = Aᵀ C_m A + m ([−ũ]_u + Ω̃ at (u, u)),
    M = Aᵀ M_m A = M_m = diag(m I, J).

Time steps differ: q_{n+1} = q_n exp(x̃) moves a body along a screw, and multipliers, in the frames of joints, are the
same. Source: Sonneville & Brüls (2014), "A formulation on the special Euclidean group for dynamic analysis of multibody
systems", J. Comput. Nonlinear Dyn. 9, 041002 (the paper's ref. 22).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, Tangents
from lgsens.liegroups import SE3, Power, RigidMotions, skew
from lgsens.linear import SparseMatrix
from lgsens.model._frames import ROTATION
from lgsens.model._system import MultibodySystem


def _of_bodies(name: str) -> Any:
    return property(lambda self: getattr(self.bodies, name))


class SE3System(AbstractSystem):
    """A `MultibodySystem` in coordinates of SE(3); built by `Model(formulation="SE3")`, dense.

    Attributes:
        bodies: the same scene on R³ × SO(3); `assembled` is that of it.
    """

    bodies: MultibodySystem
    assembled: bool = eqx.field(static=True)

    # What positions, numbers and Ω alone tell is the same.
    angular_velocities = _of_bodies("angular_velocities")
    branches = _of_bodies("branches")
    breaking = _of_bodies("breaking")
    compliance = _of_bodies("compliance")
    constraint = _of_bodies("constraint")
    constraint_names = _of_bodies("constraint_names")
    coordinate_scale = _of_bodies("coordinate_scale")
    distance = _of_bodies("distance")
    is_configuration = _of_bodies("is_configuration")
    is_valid = _of_bodies("is_valid")
    mass_matrix = _of_bodies("mass_matrix")
    num_states = _of_bodies("num_states")
    num_velocity_rows = _of_bodies("num_velocity_rows")
    reads_multipliers = _of_bodies("reads_multipliers")
    repeated_constraint = _of_bodies("repeated_constraint")
    repeated_names = _of_bodies("repeated_names")

    @property
    def group(self) -> Power | RigidMotions:
        free = self.bodies.free
        return Power(SE3(), len(free)) if all(len(own) == SE3().dim for own in free) else RigidMotions(free)

    @property
    def _places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The whole bodies, shape (W,), and their coordinates of translation and of rotation, shape (W, 3)."""
        whole = RigidMotions(self.bodies.free).whole
        index = self.bodies.index[whole]
        return whole, index[:, : ROTATION.start], index[:, ROTATION]

    def _turned(self, q, x: Float[Array, "*n k"], axis: int) -> Float[Array, "*n k"]:
        whole, at, _ = self._places
        own = x[..., at]
        rotations = jnp.broadcast_to(q.orientation[..., whole, :, :], (*own.shape, 3))
        return x.at[..., at].set(jnp.sum(rotations * (own[..., None, :] if axis == -1 else own[..., None]), axis=axis))

    def to_bodies(self, q, v: Float[Array, "*n k"]) -> Float[Array, "*n k"]:
        """A v: [ẋ, Ω] of the bodies."""
        return self._turned(q, v, axis=-1)

    def _from_bodies(self, q, x: Float[Array, "*n k"]) -> Float[Array, "*n k"]:
        """Aᵀ x, which is A⁻¹ x too; of the rows of a matrix X, X A."""
        return self._turned(q, x, axis=-2)

    def _acceleration(self, v, vdot):
        """v̇ + [Ω × u, 0] = A⁻¹ v̇_m."""
        _, at, spin = self._places
        return vdot.at[..., at].add(jnp.cross(v[..., spin], v[..., at]))

    def state_of_bodies(self, state: State) -> State:
        """States, along leading axes, as those of `bodies`; the auxiliary acceleration is taken for an acceleration."""
        q, v = state.q, state.v
        rate = lambda vdot: self.to_bodies(q, self._acceleration(v, vdot))
        return State(q=q, v=self.to_bodies(q, v), vdot=rate(state.vdot), lam=state.lam, a=rate(state.a))

    def reference(self):
        pose, velocity = self.bodies.reference()
        return pose, self._from_bodies(pose, velocity)

    def settled(self, q, v, t):
        return self._from_bodies(q, self.bodies.settled(q, self.to_bodies(q, v), t))

    def residual(self, q, v, vdot, lam, t):
        vdot = self.to_bodies(q, self._acceleration(v, vdot))
        return self._from_bodies(q, self.bodies.residual(q, self.to_bodies(q, v), vdot, lam, t))

    def constraint_jacobian(self, q, t):
        return self._from_bodies(q, self.bodies.constraint_jacobian(q, t))

    def velocity_constraint(self, q, v, t):
        return self.bodies.velocity_constraint(q, self.to_bodies(q, v), t)

    def velocity_jacobian(self, q, t):
        return self._from_bodies(q, self.bodies.velocity_jacobian(q, t))

    def _both(self, q, matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
        """Aᵀ X A."""
        return self._from_bodies(q, self._from_bodies(q, matrix).T).T

    def tangents(self, q, v, vdot, lam, t):
        whole, at, spin = self._places
        u, omega, mass = v[at], v[spin], self.bodies.mass[whole]
        rate = self._acceleration(v, vdot)
        of_bodies = self.to_bodies(q, v), self.to_bodies(q, rate)
        stiffness, damping, jacobian = self.bodies.tangents(q, *of_bodies, lam, t)
        stiffness, damping = self._both(q, stiffness), self._both(q, damping)
        force = self._from_bodies(q, self.bodies.residual(q, *of_bodies, lam, t))[at]

        skews = jax.vmap(skew)
        corner = at[:, :, None], spin[:, None, :]
        by_turning = skews(force) - mass[:, None, None] * skews(rate[at])
        # C_m A [−ũ]_u: the columns of u of each body, times −ũ, are columns of its Ω
        carried = jnp.einsum("kwi,wij->kwj", damping[:, at], skews(u))
        stiffness = stiffness.at[corner].add(by_turning).at[:, spin].add(-carried)
        damping = damping.at[corner].add(-mass[:, None, None] * skews(u))
        damping = damping.at[at[:, :, None], at[:, None, :]].add(mass[:, None, None] * skews(omega))
        return Tangents(stiffness, damping, self._from_bodies(q, jacobian))

    def multiplier_jacobian(self, q, v, lam, t):
        every = self.bodies.multiplier_jacobian(q, self.to_bodies(q, v), lam, t)
        every = every.dense() if isinstance(every, SparseMatrix) else every
        return self._from_bodies(q, every.T).T


def scene_of(system: Any) -> MultibodySystem | None:
    """The scene on R³ × SO(3) whose equations these are, in either formulation; None: of no `Model`."""
    if isinstance(system, SE3System):
        return system.bodies
    return system if isinstance(system, MultibodySystem) else None
