"""The stationary response to a random road, by the Lyapunov equation of the linearized car.

The rate ż of an ISO 8608 road is white noise, E[ż(t) ż(t + τ)] = S δ(τ) (`lgsens/model/_roads.py`), and z itself has no
variance. With the static response y_s, A y_s + B = 0, and y = ỹ + y_s z, of ẏ = A y + B z remains

    ỹ' = A ỹ − y_s ż,     A P + P Aᵀ + S y_s y_sᵀ = 0,     P = E[ỹ ỹᵀ],     E[f²] = C P Cᵀ

for outputs f = C y + D z that do not follow the road, C y_s + D = 0: accelerations, travel, the load of a tyre.

A weighted output is that of more equations, x' = A_w x + B_w f (`FrequencyWeighting`): with f = C ỹ the same equation
for [ỹ; x], whose matrix is [[A, 0], [B_w C, A_w]] and whose y_s is [y_s; 0].

The gradient. P depends on its right-hand side linearly, and with the adjoint Lyapunov equation Aᵀ Λ + Λ A + P̄ = 0 of
what a criterion asks, P̄ = ∂Ψ/∂P, it is Ψ' = Λ : (2 A' P + (S y_s y_sᵀ)'): one equation for all parameters, the
transpose of the solution of the first one, as which it is written.

The equation. With M = (γ I − A)⁻¹ and U = M (γ I + A), A P + P Aᵀ = R is P − U P Uᵀ = −2 γ M R Mᵀ, and the series
P = Σ Uⁿ (−2 γ M R Mᵀ) Uᵀⁿ is doubled with each P ← P + U P Uᵀ, U ← U². All eigenvalues of U are within the unit circle
where A settles, whatever γ > 0; the fewest turns take one between the slowest and the fastest of A, the square root of
‖A‖/‖A⁻¹‖. It is products alone, which a GPU has too (Schur's form it has not), and no sum of it cancels: against 50
digits and relative to the deviations, 1e-13 for three masses where Bartels & Stewart's method has 1e-10, and 4e-8
instead of 7e-7 with frequencies from 1 to 1e5 rad/s.

Sources: ISO 8608:2016; ISO 2631-1:1997; Gobbi & Mastinu, J. Sound Vib. 245 (2001) 457; R. A. Smith, SIAM J. Appl.
Math. 16 (1968) 198.
"""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import require
from lgsens._xla import while_loop
from lgsens.analysis._linearize import Linearization
from lgsens.analysis._weighting import FrequencyWeighting
from lgsens.linear import LinearEquations, linear_solve, lost
from lgsens.model import rate_intensity

_TURNS = 64  # 29 for frequencies from 0.3 to 1e7 rad/s


def _doubled(a: Float[Array, "n n"], rhs: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """P of A P + P Aᵀ = R, by the series of the module's docstring; of an A that does not settle, anything."""
    eye = jnp.eye(len(a), dtype=a.dtype)
    rate = jnp.sqrt(jnp.linalg.norm(a) / jnp.linalg.norm(jnp.linalg.inv(a)))  # γ
    inverse = jnp.linalg.inv(rate * eye - a)

    def unfinished(carry):
        turn, _, power = carry
        return (turn < _TURNS) & (jnp.linalg.norm(power) > jnp.finfo(a.dtype).eps)

    def double(carry):
        turn, found, power = carry
        return turn + 1, found + power @ found @ power.T, power @ power

    start = jnp.asarray(0), -2.0 * rate * inverse @ rhs @ inverse.T, inverse @ (rate * eye + a)
    return while_loop(unfinished, double, start)[1]


_LYAPUNOV = LinearEquations(lambda a, p: a @ p + p @ a.T, _doubled, lambda a, rhs: _doubled(a.T, rhs))


def lyapunov(a: Float[Array, "n n"], load: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """P of A P + P Aᵀ + Q = 0."""
    return linear_solve(_LYAPUNOV, a, -load)


def _weighted(a, rest, row, intensity, weighting: FrequencyWeighting) -> Float[Array, ""]:
    """The variance of the output C ỹ, C one row, as it is weighted."""
    own, entry, shown = weighting.matrices(a.dtype)
    a = jnp.block([[a, jnp.zeros((a.shape[0], own.shape[0]), a.dtype)], [jnp.outer(entry, row), own]])
    load = jnp.zeros(a.shape[0], a.dtype).at[: rest.shape[0]].set(rest)
    covariance = lyapunov(a, intensity * jnp.outer(load, load))[rest.shape[0] :, rest.shape[0] :]
    return shown @ covariance @ shown


@eqx.filter_jit
def _deviations(linear: Linearization, intensity, weightings: tuple[FrequencyWeighting | None, ...]):
    a, b, c = linear.A, linear.B, linear.C
    rest = -jnp.linalg.solve(a, b)[:, 0]  # y_s
    covariance = lyapunov(a, intensity * jnp.outer(rest, rest))
    square = jnp.sum((c @ covariance) * c, axis=1)
    for i, weighting in enumerate(weightings):
        if weighting is not None:
            square = square.at[i].set(_weighted(a, rest, c[i], intensity, weighting))
    follows = c @ rest + linear.D[:, 0]
    size = jnp.linalg.norm(c, axis=1) * jnp.linalg.norm(rest) + jnp.abs(linear.D[:, 0])
    eps = jnp.finfo(a.dtype).eps
    infinite = (jnp.abs(follows) > jnp.sqrt(eps) * size) | (linear.D1[:, 0] != 0.0) | (linear.D2[:, 0] != 0.0)
    none = square <= 0.0
    deviation = jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, square)))
    settles = jnp.max(jnp.real(linear.eigenvalues)) < 0.0
    return lost(jnp.broadcast_to(~settles, infinite.shape), jnp.where(infinite, jnp.inf, deviation))


def random_road(
    linear: Linearization,
    *,
    roughness,
    speed,
    wave_number=0.1,
    weighting: Mapping[str, FrequencyWeighting] | None = None,
) -> dict[str, Float[Array, ""]]:
    """The standard deviation of each output of a car on a random road, ISO 8608, at constant speed.

        A P + P Aᵀ + S y_s y_sᵀ = 0,     σ² = C P Cᵀ,     S = (2π n_0)² G_d(n_0) V/2,     y_s = −A⁻¹B

    Arguments:
        linear: the car, `linearize(model, inputs=("tyre",), outputs=…)`: its one input is the road's height.
        roughness: G_d(n_0) [m³], shape (), positive, or the class of the road, "A" to "H".
        speed: V [m/s], shape (), positive.
        wave_number: n_0 [cycles/m], shape (), positive.
        weighting: how outputs are weighted by frequency, by their names: `{"acceleration": FrequencyWeighting("Wk")}`.

    Returns by the name of the output its standard deviation (RMS about the equilibrium), shape (), in its unit; inf for
    one that follows the road, as a height does, or sees its rate. Differentiable, by the adjoint Lyapunov equation.
    Raises `ValueError` for another number of inputs, another class, numbers that are not positive, and a car that does
    not settle (a wheel that turns freely: lock it); inside `jit` that is NaN. `SampledRoad.random` is a road to run
    over. Source: `_random_road`.
    """
    if len(linear.inputs) != 1:
        raise ValueError(f"`linear` must have one input, the road, got {linear.inputs}.")
    weighting = weighting or {}
    for name, own in weighting.items():
        if name not in linear.outputs or not isinstance(own, FrequencyWeighting):
            raise ValueError(
                f"`weighting` must give outputs of `linear`, {', '.join(linear.outputs)}, a FrequencyWeighting each; "
                f"got {name!r}: {own!r}."
            )
    intensity = rate_intensity(roughness, speed, wave_number)
    require(
        lambda values: np.max(values.real) < 0.0,
        "`linear` must settle, all eigenvalues with Re λ < 0, and has one that does not. Lock what turns freely (a "
        "wheel on its hinge), hold what floats, give beams `damping`.",
        linear.eigenvalues,
    )
    weightings = tuple(weighting.get(name) for name in linear.outputs)
    return dict(zip(linear.outputs, _deviations(linear, intensity, weightings)))
