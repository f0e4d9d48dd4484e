"""The sweeps in O(log n) depth: all steps linearized at once, and composed by an associative scan.

Linearized, a step is an affine map of what comes before it, and so are many steps one after the other,

    δ_{n+1} = A_n δ_n + f_n,     (A', f') ∘ (A, f) = (A' A, A' f + f'),

whose composition is associative: all prefixes of n maps take O(log n) levels of compositions (Blelloch 1990), each of
which is one batch of products of matrices. The steps themselves wait for nothing, as the states are known.

What is composed. A step reads parts of the state before it (`AbstractScheme.carries`), and where the ends of steps
satisfy their constraints (`AbstractScheme.satisfies`) so does what a step makes of them: A_n δ is in the range of
E_{n+1}, y ↦ δ on independent coordinates y about state n + 1 (`_carried`), with a left inverse R_{n+1}. f_n need not
be, as parameters move the joints and a derivative of a derivative has rows b ≠ 0. So with f_{−1} = δ_0 and y_0 = 0

    δ_n = E_n y_n + f_{n−1},     y_{n+1} = R_{n+1} A_n δ_n = Ã_n y_n + R_{n+1} A_n f_{n−1},     Ã_n = R_{n+1} A_n E_n,

and what is composed is Ã_n, of which each column is one solution of a step. No matrix depends on the right-hand side,
so many of these (`vmap`) share the products. Of the same kind is the transpose, c_n = own_n + A_nᵀ c_{n+1} with the
cotangents own_n of the δ_n as given. Let g_n = c_n − own_n, g_N = 0. It acts on A_{n−1} δ = E_n R_n A_{n−1} δ alone, so

    z_n = E_nᵀ g_n = Ã_nᵀ z_{n+1} + E_nᵀ A_nᵀ own_{n+1},     g_n = A_nᵀ (own_{n+1} + R_{n+1}ᵀ z_{n+1}).

With all c known, all steps give their multipliers, and what they add to p̄, at once.

Twice. f_n, the end of a step that begins with δ = 0, is of size 1/h² in u' where the joints have moved, and Ã_n y_n
takes nearly all of it away again: some 1e-10 of the top's derivative by its length, at h = 4 ms. So what the solution
leaves of its equations, A_n δ_n + f_n − δ_{n+1}, is solved for again, by the same products, which the compiler finds to
be the same; then the error is that of the sweeps. Backwards the multipliers of both solutions are added, and not found
from the sum of both: their own round-off, of size 1/h² again, is in what is left after the first solution, and is
corrected by the second.

An empty step hands on what it has got, A = 1, which is in no range: where a grid may have such, y is what is carried.

Sources: Blelloch, Prefix sums and their applications, CMU-CS-90-190 (1990); Särkkä & García-Fernández, Temporal
parallelization of Bayesian smoothers, IEEE Trans. Autom. Control 66 (2021) 299.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme, Variation, earlier, later, with_first, with_last
from lgsens.sensitivity._carried import Carried
from lgsens.sensitivity._linearization import Parameters, place_tangents, steps, with_places
from lgsens.sensitivity._linearized_steps import Backward, Before, LinearizedSteps, LinearStep, Loads


class _Composed(NamedTuple):
    """All steps of a run, stacked: equations, coordinates before and after each, and Ã."""

    equations: LinearizedSteps
    steps: LinearStep
    before: Carried
    after: Carried
    transitions: Float[Array, "n s s"]

    @classmethod
    def of(cls, scheme: AbstractScheme, states: State, parameters: Parameters) -> "_Composed":
        system, grid = parameters
        equations, every = LinearizedSteps.of(scheme, parameters), steps(states, grid)
        linear = jax.vmap(equations.linearized)(every)
        reduced = grid.empty(every.place) is None
        carried = jax.vmap(partial(Carried.of, scheme, system, reduced=reduced))(states, grid.times())
        before, after = earlier(carried), later(carried)
        d, d_places = jax.tree.map(jnp.zeros_like, (parameters, every.place))

        def transition(linear, place, before, after):
            none = Variation.none(linear.begun)
            loads = jax.tree.map(jnp.zeros_like, jax.eval_shape(equations.loads, linear, d, place))

            def column(y):
                return after.back(equations.forward(linear, before.into(y, none), loads, none, None))

            return jax.vmap(column, out_axes=1)(jnp.eye(before.back(none).shape[0], dtype=none.v.dtype))

        found = jax.vmap(transition)(linear, d_places, before, after)
        return cls(equations, linear, before, after, found)

    def forward(self, previous: Variation, loads: Loads, rows: Variation, d: Parameters | None = None) -> Variation:
        """A_n δ_n + f_n; d None: f_n is that of `rows` and `loads` alone."""
        return jax.vmap(partial(self.equations.forward, d=d))(self.steps, previous, loads, rows)

    def backward(self, c: Variation, loads: Any) -> tuple[Backward, Before]:
        """Of all c_{n+1}; `loads`: of one, in shape."""
        none = jnp.zeros_like(ravel_pytree(self.equations.parameters)[0])

        def of_one(linear, c):
            found = self.equations.backward(linear, c, loads)
            return found, self.equations.before(linear, c, found, none)

        return jax.vmap(of_one)(self.steps, c)


def _after(first, second):
    """The composition of stacked maps (A, f), the second after the first."""
    (a, f), (b, g) = first, second
    return b @ a, (b @ f[..., None])[..., 0] + g


def direct_at_once(scheme: AbstractScheme, states: State, parameters: Parameters, b: Variation, d: Parameters):
    """Solve L (δ, p') = (b, d) as `direct_sweep` does."""
    grid = parameters.grid
    every, d_places = _Composed.of(scheme, states, parameters), place_tangents(grid, d.grid)
    loads = jax.vmap(lambda step, d_place: every.equations.loads(step, d, d_place))(every.steps, d_places)
    given = loads, later(b)
    nothing = jax.tree.map(jnp.zeros_like, given)

    def solved(f: Variation) -> Variation:
        """δ of δ_{n+1} = A_n δ_n + f_n, δ_0 = f_{−1}."""
        handed = jax.vmap(Carried.back)(every.after, every.forward(earlier(f), *nothing))
        _, y = lax.associative_scan(_after, (every.transitions, handed))
        y = with_first(jnp.zeros_like(y[0]), earlier(y))
        before = _sum(earlier(f), jax.vmap(Carried.into)(every.before, y, earlier(f)))
        return with_first(_row(f, 0), _sum(every.forward(before, *nothing), later(f)))

    delta = solved(with_first(_row(b, 0), every.forward(nothing[1], *given, d)))
    left = jax.tree.map(jnp.subtract, every.forward(earlier(delta), *given, d), later(delta))
    return _sum(delta, solved(with_first(_row(nothing[1], 0), left))), d


def adjoint_at_once(scheme: AbstractScheme, states: State, parameters: Parameters, c: Variation, c_p: Parameters):
    """Solve Lᵀ (μ, p̄) = (c, c_p) as `adjoint_sweep` does."""
    every = _Composed.of(scheme, states, parameters)
    loads, pull_back = every.equations.pull_back(every.steps)
    transposed, none = jnp.swapaxes(every.transitions, 1, 2), jax.tree.map(jnp.zeros_like, _row(c, 0))
    of_before = lambda c: every.backward(c, loads)[1].previous

    def solved(own: Variation) -> Variation:
        """c of c_n = own_n + A_nᵀ c_{n+1}."""
        handed = jax.vmap(_into_transposed)(every.before, of_before(later(own)))
        _, z = lax.associative_scan(_after, (transposed, handed), reverse=True)
        z = with_last(later(z), jnp.zeros_like(z[0]))
        after = _sum(later(own), jax.vmap(_back_transposed)(every.after, z, later(own)))
        return _sum(own, with_last(of_before(after), none))

    first = solved(c)
    found = every.backward(later(first), loads)
    left = jax.tree.map(lambda own, more, c: own + more - c, c, with_last(found[1].previous, none), first)
    second = solved(left)
    at_ends, at_begins = _sum(found, every.backward(later(second), loads))
    of_parameters, of_places = pull_back(at_ends.loads)
    begun = ravel_pytree(parameters)[1](jnp.sum(at_begins.parameters, axis=0))
    mu = with_first(_sum(_row(first, 0), _row(second, 0)), at_ends.mu)
    bar = _sum(_sum(c_p, of_parameters), begun)
    return mu, with_places(parameters.grid, bar, _sum(of_places, at_begins.place))


def _sum(tree: Any, other: Any) -> Any:
    return jax.tree.map(jnp.add, tree, other)


def _row(rows: Variation, n: int) -> Variation:
    return jax.tree.map(lambda leaf: leaf[n], rows)


def _into_transposed(carried: Carried, c: Variation) -> Float[Array, " s"]:
    """Eᵀ c."""
    y = jax.eval_shape(carried.back, c)
    return jax.linear_transpose(lambda y: carried.into(y, c), y)(c)[0]


def _back_transposed(carried: Carried, z: Float[Array, " s"], like: Variation) -> Variation:
    """Rᵀ z."""
    return jax.linear_transpose(carried.back, like)(z)[0]
