"""The linearized trajectory, L δ = b: the one operator behind both sensitivity methods.

Let δ_n = (w, v', v̇', λ', a')_n be the sensitivities of the state at t_n, with q' = q w̃ (eq. 32), and p the parameters:
the numbers of the system, t0 and h. Differentiating the step (eqs. 24–29, §6.2) gives, for n → n+1,

    x'  = h v'_n + h² ((½ − β) a'_n + β a'_{n+1}) + x_h h'            x_h = v_n + 2h ((½ − β) a_n + β a_{n+1})
    (24)  w_{n+1}  − D(exp x̃) w_n − T(x) x'                                                  = b.w
    (28)  v'_{n+1} − v'_n − h ((1 − γ) a'_n + γ a'_{n+1}) − v_h h'                              = b.v
                                                                       v_h = (1 − γ) a_n + γ a_{n+1}
    (29)  v̇'_{n+1} − ((1 − α_m) a'_{n+1} + α_m a'_n − α_f v̇'_n)/(1 − α_f)                      = b.vdot
    (26)  (B w_{n+1} + Φ_p p')/(βh²)  [− c λ'_{n+1} − 2Φ h'/(βh³), redundant constraints]      = b.lam
    (25)  M v̇'_{n+1} + C_t v'_{n+1} + K_t w_{n+1} + Bᵀλ'_{n+1} + r_p p' + r_t (t0' + (n+1) h')   = b.a

Row 0 is δ_0 = b_0 and the last row p' = b.p. L is block lower bidiagonal with a border for p. A derivative has b_0 and
b.p only (all other rows zero); derivatives of derivatives fill the other rows too.
With steps of different sizes h_n, each step is a run of one step from t_n, and begins with the algorithmic acceleration
a_n* = v̇_n + r_n (a_n − v̇_n), r_n = h_n/h_{n−1} (`moved`), in place of a_n:

    a*'_n = v̇'_n + r_n (a'_n − v̇'_n) + r'_n (a_n − v̇_n)

while a step of size 0 has the equations δ_{n+1} − δ_n = b.

Forward substitution with L is the direct differentiation method (`_direct.py`), back substitution with Lᵀ the
discrete adjoint variable method (`_adjoint.py`). Both solve with the exact iteration matrix of eq. (30).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lgsens.dynamics import AbstractSystem, State, Tangents, mass_matrix, softness, tangents
from lgsens.integrate import GeneralizedAlpha, factorize_iteration_matrix, increment, moved
from lgsens.linear import Factors


class Parameters(NamedTuple):
    """What a trajectory depends on besides its initial state, or a tangent or cotangent of it."""

    system: AbstractSystem
    t0: Float[Array, ""]
    h: Float[Array, "*n"]  # shape (), or (n,): steps of different sizes


class Variation(NamedTuple):
    """δ of one state (or, stacked, of a trajectory) in Lie-algebra coordinates; also one row of the equations."""

    w: Float[Array, " k"]
    v: Float[Array, " k"]
    vdot: Float[Array, " k"]
    lam: Float[Array, " m"]
    a: Float[Array, " k"]


class Rates(NamedTuple):
    """x_h and v_h: how the increments depend on the step size."""

    x: Float[Array, " k"]
    v: Float[Array, " k"]


class Step(NamedTuple):
    """One converged step, from `previous` to `state` at `t`."""

    previous: State
    state: State
    t: Float[Array, ""]


def steps(states: State, parameters: Parameters) -> Step:
    """All steps of a trajectory, stacked."""
    previous = jax.tree.map(lambda leaf: leaf[:-1], states)
    return Step(
        previous=previous if parameters.h.ndim == 0 else jax.vmap(moved)(previous, _grid(*parameters[1:]).ratio),
        state=jax.tree.map(lambda leaf: leaf[1:], states),
        t=times(states.v.shape[0] - 1, parameters)[1:],
    )


def times(num_steps: int, parameters: Parameters) -> Float[Array, " n+1"]:
    """t0 + n h, or t0 + Σ h."""
    if parameters.h.ndim:
        return parameters.t0 + jnp.concatenate([jnp.zeros_like(parameters.h[:1]), jnp.cumsum(parameters.h)])
    return parameters.t0 + jnp.arange(num_steps + 1, dtype=parameters.h.dtype) * parameters.h


class Grid(NamedTuple):
    """Where each step begins, its size and the ratio to the one before; or tangents or cotangents of these."""

    t: Float[Array, "*n"]
    h: Float[Array, "*n"]
    ratio: Float[Array, "*n"]


def _grid(t0, h) -> Grid:
    """Of the steps of sizes h, shape (n,). Empty ones get the size before them, which can be divided by."""
    size = h[jax.lax.cummax(jnp.where(h != 0.0, jnp.arange(h.shape[0]), 0))]
    t = t0 + jnp.cumsum(h) - h
    return Grid(t, size, size / jnp.concatenate([size[:1], size[:-1]]))


class SingleStep(NamedTuple):
    """One step of a grid as a run of its own; stacked, all of them."""

    grid: Grid
    empty: Bool[Array, "*n"]
    offset: Float[Array, "*n k"]  # a_n − v̇_n

    @classmethod
    def of(cls, states: State, parameters: Parameters) -> "SingleStep | None":
        """All steps, stacked; None where they are equal."""
        if parameters.h.ndim == 0:
            return None
        offset = (states.a - states.vdot)[:-1]
        return cls(_grid(*parameters[1:]), parameters.h == 0.0, offset)

    def begun(self, previous: Variation, d: Grid) -> Variation:
        """The variation with that of a_n*."""
        offset = previous.a - previous.vdot
        return previous._replace(a=previous.vdot + self.grid.ratio * offset + d.ratio * self.offset)

    def begun_transposed(self, begun: Variation, earlier: Variation) -> tuple[Variation, Float[Array, ""]]:
        """The cotangents of δ_n and of r_n, from `begun`, that with a_n* in place of a_n, added to `earlier`."""
        of_a = begun.a - earlier.a
        ratio = self.grid.ratio
        back = begun._replace(vdot=begun.vdot + (1.0 - ratio) * of_a, a=earlier.a + ratio * of_a)
        return back, jnp.where(self.empty, 0.0, jnp.dot(of_a, self.offset))

    def unless_empty(self, rows: Any, otherwise: Any) -> Any:
        """`rows`, or, of an empty step, `otherwise`."""
        return jax.tree.map(lambda row, other: jnp.where(self.empty, other, row), rows, otherwise)


def grid_tangent(parameters: Parameters, d: Parameters) -> Grid | None:
    """The tangent of the grid; None where steps are equal."""
    return None if parameters.h.ndim == 0 else jax.jvp(_grid, parameters[1:], d[1:])[1]


def grid_cotangent(parameters: Parameters, bar: Grid) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """The cotangents of t0 and h from that of the grid."""
    return jax.vjp(_grid, *parameters[1:])[1](bar)


def own(parameters: Parameters, grid: Grid | None) -> Parameters:
    """The parameters (or their tangent) of one step as a run of its own."""
    return parameters if grid is None else Parameters(parameters.system, grid.t, grid.h)


def step_increment(scheme: GeneralizedAlpha, step: Step, h) -> tuple[Float[Array, " k"], Rates]:
    """x of eq. (27) at the converged step, and the rates with the step size."""
    previous, u = step.previous, step.state.a
    x = increment(scheme, previous, u, h)
    x_h = previous.v + 2.0 * h * ((0.5 - scheme.beta) * previous.a + scheme.beta * u)
    v_h = (1.0 - scheme.gamma) * previous.a + scheme.gamma * u
    return x, Rates(x_h, v_h)


def step_tangents(system: AbstractSystem, step: Step) -> Tangents:
    """K_t, C_t and B at the converged state."""
    state = step.state
    return tangents(system, state.q, state.v, state.vdot, state.lam, step.t)


class Linearized(NamedTuple):
    """What the equations of one step need of its converged state, whatever their right-hand side."""

    x: Float[Array, " k"]
    rates: Rates
    tangents: Tangents
    factors: Factors


def linearized(scheme: GeneralizedAlpha, parameters: Parameters, mass, step: Step) -> Linearized:
    """The tangents and the factors of the exact iteration matrix at the converged state."""
    system, h = parameters.system, parameters.h
    x, rates = step_increment(scheme, step, h)
    at_state = step_tangents(system, step)
    return Linearized(x, rates, at_state, factorize_iteration_matrix(scheme, system, at_state, mass, x, h))


def kinematics(scheme: GeneralizedAlpha, group, x, rates: Rates, h, previous: Variation, u, dh):
    """w, v', v̇' at n+1 from eqs. (24), (28), (29), given δ_n, u' = a'_{n+1} and h'."""
    dx = h * previous.v + h**2 * ((0.5 - scheme.beta) * previous.a + scheme.beta * u) + rates.x * dh
    w = group.Ad_inv_mv(group.exp(x), previous.w) + group.tangent_mv(x, dx)
    v = previous.v + h * ((1.0 - scheme.gamma) * previous.a + scheme.gamma * u) + rates.v * dh
    vdot = ((1.0 - scheme.alpha_m) * u + scheme.alpha_m * previous.a - scheme.alpha_f * previous.vdot) / (
        1.0 - scheme.alpha_f
    )
    return w, v, vdot


def pseudo_load_function(state: State):
    """p ↦ (r, Φ) at the fixed converged state: its JVP is (r_p p', Φ_p p'), its VJP their transposes."""

    def loads(system: AbstractSystem, t):
        return system.residual(state.q, state.v, state.vdot, state.lam, t), system.constraint(state.q, t)

    return loads


def pseudo_loads(step: Step, parameters: Parameters, d: Parameters):
    """r_p p' + r_t t' and Φ_p p' (with − 2Φ h'/h where constraints may be redundant); with t' = t0' + (n+1) h'."""
    n = (step.t - parameters.t0) / parameters.h
    loads = pseudo_load_function(step.state)
    r_p, phi_p = jax.jvp(loads, (parameters.system, step.t), (d.system, d.t0 + n * d.h))[1]
    if softness(parameters.system) is not None:
        phi_p = phi_p - (2.0 * d.h / parameters.h) * parameters.system.constraint(step.state.q, step.t)
    return r_p, phi_p


def matvec(scheme: GeneralizedAlpha, states: State, parameters: Parameters, delta: Variation, d: Parameters):
    """L (δ, p'), all steps at once: the equations above, written out. What JAX differentiates a second time."""
    mass, soft = mass_matrix(parameters.system), softness(parameters.system)
    group = parameters.system.group

    def rows(step: Step, previous: Variation, current: Variation, single: SingleStep | None, d_grid) -> Variation:
        if single is None:
            return equations(step, previous, current, parameters, d)
        own_equations = equations(
            step, single.begun(previous, d_grid), current, own(parameters, single.grid), own(d, d_grid)
        )
        return single.unless_empty(own_equations, jax.tree.map(jnp.subtract, current, previous))

    def equations(step: Step, previous: Variation, current: Variation, parameters: Parameters, d) -> Variation:
        h = parameters.h
        x, rates = step_increment(scheme, step, h)
        w, v, vdot = kinematics(scheme, group, x, rates, h, previous, current.a, d.h)
        k_t, c_t, b = step_tangents(parameters.system, step)
        r_p, phi_p = pseudo_loads(step, parameters, d)
        return Variation(
            w=current.w - w,
            v=current.v - v,
            vdot=current.vdot - vdot,
            lam=(b @ current.w + phi_p) / (scheme.beta * h**2) - (0.0 if soft is None else soft * current.lam),
            a=mass @ current.vdot + c_t @ current.v + k_t @ current.w + current.lam @ b + r_p,
        )

    previous = jax.tree.map(lambda leaf: leaf[:-1], delta)
    current = jax.tree.map(lambda leaf: leaf[1:], delta)
    later = jax.vmap(rows)(
        steps(states, parameters), previous, current, SingleStep.of(states, parameters), grid_tangent(parameters, d)
    )
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[:1], rest]), delta, later), d


# Conversion between Lie-algebra coordinates and the arrays of q: the only place where it happens.


def to_algebra(group, state: State, tangent: State) -> Variation:
    """The Lie-algebra coordinates of a tangent of a state's arrays."""
    return Variation(group.from_ambient(state.q, tangent.q), tangent.v, tangent.vdot, tangent.lam, tangent.a)


def to_ambient(group, state: State, delta: Variation) -> State:
    """The tangent of a state's arrays with the given Lie-algebra coordinates."""
    return State(group.to_ambient(state.q, delta.w), delta.v, delta.vdot, delta.lam, delta.a)


def cotangent_to_algebra(group, state: State, cotangent: State) -> Variation:
    """The transpose of `to_ambient`: what a cotangent of the arrays says of the coordinates."""
    (w,) = jax.linear_transpose(lambda w: group.to_ambient(state.q, w), state.v)(cotangent.q)
    return Variation(w, cotangent.v, cotangent.vdot, cotangent.lam, cotangent.a)


def cotangent_to_ambient(group, state: State, delta: Variation) -> State:
    """The transpose of `to_algebra`."""
    q = configuration_cotangent(group, state.q, delta.w)
    return State(q, delta.v, delta.vdot, delta.lam, delta.a)


def configuration_cotangent(group, q, w):
    """The cotangent of the arrays of q that acts as w acts on Lie-algebra coordinates."""
    return jax.linear_transpose(lambda dq: group.from_ambient(q, dq), q)(w)[0]


def zeros_like_trajectory(states: State) -> Any:
    """The rows of b that a first derivative leaves zero."""
    zero = jnp.zeros_like(states.v)
    return Variation(zero, zero, zero, jnp.zeros_like(states.lam), zero)
