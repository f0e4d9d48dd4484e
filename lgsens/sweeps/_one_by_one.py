"""A program whose factorizations take one matrix after the other.

On a CPU, jaxlib before 0.12 hands the matrices of a batched LAPACK call to the threads of the process and waits for
them on one of these. Where every device is at such a call at once, all threads wait, for ever. A call with one matrix
is done where it is made; with a thread for each device it takes as long (measured: 128 matrices of 37 rows, LU 11.3 µs
each instead of 11.5).
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal
from jaxlib.version import __version_info__ as _VERSION

from lgsens.linear import programs_in

WAITS = _VERSION < (0, 12)
_LAPACK = frozenset(
    (
        *("cholesky", "eig", "eigh", "geqp3", "geqrf", "hessenberg", "householder_product", "lu", "ormqr", "schur"),
        *("svd", "triangular_solve", "tridiagonal"),
    )
)
# With or without a rule of its own, for what is over when a program is there.
_CALLS = frozenset(
    (
        *("closed_call", "custom_jvp_call", "custom_vjp_call", "custom_vmap_call", "jit", "linear_solve", "pjit"),
        "remat",
    )
)
Values = Sequence[Any]


def one_by_one(program: ClosedJaxpr) -> Callable[..., Values]:
    """The program as a function of arrays."""
    return lambda *arrays: _evaluated(program, arrays)


def _evaluated(program: Any, operands: Values) -> Values:
    jaxpr, consts = (program.jaxpr, program.consts) if isinstance(program, ClosedJaxpr) else (program, ())
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *operands]))
    read = lambda place: place.val if isinstance(place, Literal) else known[place]
    for equation in jaxpr.eqns:
        known.update(zip(equation.outvars, _found(equation, [read(place) for place in equation.invars])))
    return [read(place) for place in jaxpr.outvars]


def _found(equation: Any, operands: Values) -> Values:
    primitive, params = equation.primitive, equation.params
    if primitive.name in _LAPACK:
        return _alone(primitive, params, operands)
    if primitive.name == "custom_linear_solve":
        lengths, first = params["const_lengths"], params["const_lengths"].matvec + params["const_lengths"].vecmat
        own = operands[first : first + lengths.solve]
        return _evaluated(params["jaxprs"].solve, [*own, *operands[sum(lengths) :]])
    if primitive.name in _CALLS:
        return _evaluated(next(programs_in(equation)), operands)
    inside = {name: of(params[name]) for name, of in _PROGRAMS.get(primitive.name, {}).items()}
    found = primitive.bind(*operands, **{**params, **inside})
    return found if primitive.multiple_results else [found]


def _alone(primitive: Any, params: Any, operands: Values) -> Values:
    """A factorization: the last axes of each operand are its matrix, or the numbers that belong to it."""

    def bound(operands):
        found = primitive.bind(*operands, **params)
        return found if primitive.multiple_results else [found]

    batch = operands[0].shape[:-2]
    function = bound
    for _ in batch:
        function = lambda operands, of=function: lax.map(of, operands)
    return function(list(operands))


def _rewritten(program: ClosedJaxpr) -> ClosedJaxpr:
    return jax.make_jaxpr(one_by_one(program))(*program.in_avals)


# What loops and branches hold; the rest of their parameters is as before.
_PROGRAMS: dict[str, dict[str, Callable[[Any], Any]]] = {
    "scan": {"jaxpr": _rewritten},
    "while": {"cond_jaxpr": _rewritten, "body_jaxpr": _rewritten},
    "cond": {"branches": lambda branches: tuple(map(_rewritten, branches))},
}
