"""The abstract constrained mechanical system on a Lie group, eqs. (15)–(17), and its state."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from lgsens.dynamics._breaks import Breaking
from lgsens.liegroups import AbstractLieGroup
from lgsens.linear import AbstractLinearSolver, Elimination, Graph, Matrix, SparseMatrix


class State(eqx.Module):
    """Position, velocity, acceleration, multipliers and auxiliary acceleration at one instant.

    Arrays carry a leading time axis when the state is that of a whole trajectory.

    Attributes:
        q: element of the Lie group (its own pytree of arrays).
        v: velocity v = (q⁻¹ q̇)^∨ of eq. (10), shape (k,).
        vdot: its time derivative v̇, shape (k,).
        lam: Lagrange multipliers λ of the constraints, shape (m,).
        a: the algorithmic acceleration of the generalized-α scheme, eq. (29), shape (k,).
        inner: what a scheme has found within the step that ends here (stages), a pytree of arrays; None: nothing.

    Source: Sonneville & Brüls (2014), §3–4.
    """

    q: Any
    v: Float[Array, " k"]
    vdot: Float[Array, " k"]
    lam: Float[Array, " m"]
    a: Float[Array, " k"]
    inner: Any = None


class Tangents(NamedTuple):
    """The matrices of the linearized equations of motion, §3.1.

    δr = K_t δq + C_t δv + M δv̇ + Bᵀ δλ  and  δΦ = B δq, at one state; ∂r/∂λ of `multiplier_jacobian` in place of Bᵀ
    where forces depend on λ.
    """

    stiffness: Matrix  # K_t, (k, k)
    damping: Matrix  # C_t, (k, k)
    constraint_jacobian: Matrix  # B, (m, k); with rows of velocity level [B; A]


class AbstractSystem(eqx.Module):
    """A constrained mechanical system on a matrix Lie group G.

        q̇ = q ṽ
        r(q, v, v̇, λ, t) = M v̇ − ad(v)ᵀ M v + f(q, v, t) + Bᵀλ = 0
        Φ(q, t) = 0,     A(q, t) v + b(q, t) = 0

    with B(q, t) the gradient of Φ, λ = [λ_p; λ_v] and Bᵀλ_p + Aᵀλ_v for Bᵀλ where rows of velocity level are given
    (`num_velocity_rows`). The integrator, the sensitivities and the initial state know this interface only, so a
    subclass on any group has all of them. Every number that the motion depends on is a float
    leaf of the module; everything else is static.

    Attributes:
        assembled: whether the reference configuration satisfies Φ = 0 by construction (static).

    Source: Sonneville & Brüls (2014), eqs. (15)–(17).
    """

    assembled: eqx.AbstractVar[bool]

    @property
    @abc.abstractmethod
    def group(self) -> AbstractLieGroup:
        """The configuration space G, of dimension k."""

    @property
    @abc.abstractmethod
    def constraint_names(self) -> tuple[str, ...]:
        """A name for each of the m constraint equations, used in messages; position level first."""

    @abc.abstractmethod
    def reference(self) -> tuple[Any, Float[Array, " k"]]:
        """Reference configuration q and velocity v, from which the initial state is computed."""

    @abc.abstractmethod
    def coordinate_scale(self) -> Float[Array, " k"]:
        """The size of a large change of each coordinate: 1 rad, or the length of the scene [m]."""

    @property
    def breaking(self) -> Breaking | None:
        """The constraints of position level that follow what breaks, as far as it says so; None: there are none."""
        return None

    def constraint_round_off(self) -> Float[Array, ""]:
        """What round-off may leave of Φ: a thousand of those of the largest number in q, or of a large change of it;
        far from the origin those are of the distance."""
        scale = self.coordinate_scale()
        numbers = [jnp.max(jnp.abs(leaf), initial=1.0) for leaf in (scale, *jax.tree.leaves(self.reference()[0]))]
        return lax.stop_gradient(1e3 * jnp.finfo(scale.dtype).eps * jnp.max(jnp.stack(numbers)))

    @abc.abstractmethod
    def mass_matrix(self) -> Float[Array, "k k"]:
        """The constant mass matrix M."""

    @abc.abstractmethod
    def residual(self, q, v, vdot, lam, t) -> Float[Array, " k"]:
        """The residual r of the dynamic equilibrium, eq. (16)."""

    @abc.abstractmethod
    def constraint(self, q, t) -> Float[Array, " m_p"]:
        """The constraint Φ(q, t), eq. (17)."""

    @abc.abstractmethod
    def constraint_jacobian(self, q, t) -> Float[Array, "m_p k"]:
        """The constraint gradient B with DΦ·(q w̃) = B w."""

    @abc.abstractmethod
    def tangents(self, q, v, vdot, lam, t) -> Tangents:
        """The exact tangents K_t, C_t and J = [B; A]. `autodiff_tangents` is a ready implementation."""

    def is_valid(self) -> Bool[Array, ""]:
        """Whether all numbers are finite, and such as a system has; without derivative."""
        return finite(self)

    def is_configuration(self, q) -> Bool[Array, ""]:
        """Whether q is an element of the group, but for what is lost in four digits."""
        return jnp.ones((), bool)

    @property
    def num_velocity_rows(self) -> int:
        """m_v: how many rows A v + b = 0 have velocity level only (nonholonomic constraints)."""
        return 0

    def velocity_constraint(self, q, v, t) -> Float[Array, " m_v"]:
        """A(q, t) v + b(q, t)."""
        return jnp.zeros_like(v, shape=0)

    def velocity_jacobian(self, q, t) -> Float[Array, "m_v k"]:
        """A(q, t)."""
        return jnp.zeros_like(self.reference()[1], shape=(0, self.group.dim))

    def angular_velocities(self, v) -> Float[Array, "*n N 3"]:
        """Ω of each body, body frame, from v along leading axes, or Ω̇ from v̇; zero about axes that it does not have.
        Of equations that do not know their bodies, of none."""
        return jnp.zeros((*v.shape[:-1], 0, 3), v.dtype)

    def branches(self, q) -> Float[Array, " w"]:
        """Angles that q tells within half a turn and that forces depend on, which jump there [rad]; of none."""
        return jnp.zeros_like(self.reference()[1], shape=0)

    @property
    def compliance(self) -> Float[Array, " m"] | None:
        """d > 0: how much each constraint gives way to its multiplier, of the size of B M⁻¹ Bᵀ, where constraints may
        be redundant; the multipliers that minimize Σ d_i λ_i² are those of the system. None: they may not be."""
        return None

    @property
    def repeated_names(self) -> tuple[str, ...]:
        """A name for each equation that was left out because the m constraints imply it."""
        return ()

    def repeated_constraint(self, q, t) -> Float[Array, " r"]:
        """Φ of these equations, zero as long as that is so."""
        return jnp.zeros_like(self.reference()[1], shape=0)

    # Forces that depend on the multipliers, as friction of joints does: f(q, v, λ, t).

    @property
    def reads_multipliers(self) -> bool:
        """Whether f depends on λ: ∂r/∂λ is not Jᵀ, and (v̇, λ) not the solution of linear equations."""
        return False

    def multiplier_jacobian(self, q, v, lam, t) -> Matrix:
        """∂r/∂λ, shape (k, m); asked for where f depends on λ."""
        return jax.jacfwd(lambda lam: self.residual(q, v, jnp.zeros_like(v), lam, t))(lam)

    # States that obey ż = g(q, v, z, t): z is the velocity of a coordinate with unit mass, on which nothing depends.

    @property
    def num_states(self) -> int:
        """How many of the coordinates, the last ones, have a state as their velocity."""
        return 0

    def distance(self, q) -> Float[Array, ""]:
        """How far q is from the origin in lengths of the scene, at least 1: what multiplies round-off of a place."""
        return jnp.ones(())

    def settled(self, q, v, t) -> Float[Array, " k"]:
        """v with the initial values of the states."""
        return v


class AbstractSparseSystem(AbstractSystem):
    """A system whose matrices are sums of small blocks, one for each element between two bodies.

    Where `elimination` is a plan, the time of a step follows the number of bodies; None: all is dense, as it is for
    every other system.

    Attributes:
        linear_solver: what was asked for (static); None: the solver that is estimated to take less time.
    """

    linear_solver: eqx.AbstractVar[AbstractLinearSolver | None]

    def mass_matrix(self):
        return self.sparse_mass_matrix().dense()

    def tangents(self, q, v, vdot, lam, t):
        return Tangents(*(matrix.dense() for matrix in self.sparse_tangents(q, v, vdot, lam, t)))

    @property
    @abc.abstractmethod
    def elimination(self) -> Elimination | None:
        """The order in which coordinates and multipliers are eliminated."""

    @abc.abstractmethod
    def sparse_mass_matrix(self) -> SparseMatrix:
        """M, shape (k, k)."""

    @abc.abstractmethod
    def sparse_constraint_jacobian(self, q, t) -> SparseMatrix:
        """J = [B; A], shape (m, k), columns by bodies."""

    @abc.abstractmethod
    def sparse_tangents(self, q, v, vdot, lam, t) -> Tangents:
        """K_t, C_t and J; the columns of K_t and J by bodies."""

    @abc.abstractmethod
    def sparse_rate_stiffness(self, q, v, t) -> SparseMatrix:
        """V, shape (m, k): the derivative of c(q, v, t) by q is V u along q ũ. For systems without rows of velocity
        level, as plans are."""

    @abc.abstractmethod
    def arranged(self, arrangement: Callable[[Graph], tuple[Graph, float]]) -> Elimination | None:
        """The order of elimination of other unknowns on the same graph, made once for each `arrangement`, or None.

        `arrangement` (static): which unknowns, and what to eliminate them otherwise takes [µs].
        """

    @abc.abstractmethod
    def body_blocks(self, matrix: Float[Array, "k k"]) -> Float[Array, "N 6 6"]:
        """The rows and columns of each body in a matrix; zero where the body does not have the coordinate."""

    @abc.abstractmethod
    def rotation_operators(self, function: Callable[[Any], Any]) -> Float[Array, "N 3 3"]:
        """The matrices of a linear function of v that takes the rotations of each body to those of the same, as T(x)
        does; zero in the rows and columns of rotations that a body does not have."""


def finite(*trees: Any) -> Bool[Array, ""]:
    """Whether all floats of some pytrees are finite; without derivative."""
    numbers = ravel_pytree(lax.stop_gradient(eqx.filter(trees, eqx.is_inexact_array)))[0]
    return jnp.all(jnp.isfinite(numbers))


def autodiff_tangents(system: AbstractSystem, q, v, vdot, lam, t) -> Tangents:
    """K_t, C_t and J of a system by forward-mode autodiff of its residual and constraint.

    K_t w = D_q r · (q w̃), the derivative of r(q exp(w̃ s)) at s = 0; C_t = ∂r/∂v.
    For systems without hand-derived tangents, and the reference for those that have them.
    """
    zero = jnp.zeros_like(v)
    k = jax.jacfwd(lambda w: system.residual(system.group.retract(q, w), v, vdot, lam, t))(zero)
    c = jax.jacfwd(lambda v: system.residual(q, v, vdot, lam, t))(v)
    jacobian = autodiff_constraint_jacobian(system, q, t)
    if system.num_velocity_rows:
        jacobian = jnp.concatenate([jacobian, system.velocity_jacobian(q, t)])
    return Tangents(k, c, jacobian)


def autodiff_constraint_jacobian(system: AbstractSystem, q, t) -> Float[Array, "m_p k"]:
    """B of a system by forward-mode autodiff of its constraint, B w = DΦ·(q w̃)."""
    _, v = system.reference()
    return jax.jacfwd(lambda w: system.constraint(system.group.retract(q, w), t))(jnp.zeros_like(v))
