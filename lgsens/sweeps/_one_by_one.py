"""A program whose factorizations take one matrix after the other.

On a CPU, jaxlib before 0.12 hands the matrices of a batched LAPACK call to the threads of the process and waits for
them on one of these. Where every device is at such a call at once, all threads wait, for ever. A call with one matrix
is done where it is made; with a thread for each device it takes as long (measured: 128 matrices of 37 rows, LU 11.3 µs
each instead of 11.5).
"""

from collections.abc import Callable, Sequence
from functools import partial
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
        "remat2",
    )
)
Values = Sequence[Any]


def one_by_one(program: ClosedJaxpr) -> Callable[..., Values]:
    """The program as a function of arrays."""
    return lambda *arrays: evaluated(program, arrays, _found)


def evaluated(program: Any, operands: Values, found: Callable[[Any, Values], Values]) -> Values:
    """The outputs of a program of which each operation is `found(equation, operands)`, and calls are entered."""
    jaxpr, consts = (program.jaxpr, program.consts) if isinstance(program, ClosedJaxpr) else (program, ())
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *operands]))
    read = lambda place: place.val if isinstance(place, Literal) else known[place]
    for equation in jaxpr.eqns:
        given = [read(place) for place in equation.invars]
        called = equation.primitive.name in _CALLS
        outputs = evaluated(next(programs_in(equation)), given, found) if called else found(equation, given)
        known.update(zip(equation.outvars, outputs))
    return [read(place) for place in jaxpr.outvars]


def _found(equation: Any, operands: Values) -> Values:
    primitive, params = equation.primitive, equation.params
    if primitive.name in _LAPACK:
        return _alone(primitive, params, operands)
    if primitive.name == "custom_linear_solve":
        lengths, first = params["const_lengths"], params["const_lengths"].matvec + params["const_lengths"].vecmat
        own = operands[first : first + lengths.solve]
        return evaluated(params["jaxprs"].solve, [*own, *operands[sum(lengths) :]], _found)
    inside = {name: of(params[name]) for name, of in _PROGRAMS.get(primitive.name, {}).items()}
    return bound(primitive, {**params, **inside}, operands)


def bound(primitive: Any, params: Any, operands: Values) -> Values:
    """The outputs of an operation as it is, as a list."""
    found = primitive.bind(*operands, **params)
    return found if primitive.multiple_results else [found]


def _alone(primitive: Any, params: Any, operands: Values) -> Values:
    """A factorization: the last axes of each operand are its matrix, or the numbers that belong to it."""
    function = partial(bound, primitive, params)
    for _ in operands[0].shape[:-2]:
        function = partial(lax.map, function)
    return function(list(operands))


def _rewritten(program: ClosedJaxpr) -> ClosedJaxpr:
    return jax.make_jaxpr(one_by_one(program))(*program.in_avals)


# What loops and branches hold; the rest of their parameters is as before.
_PROGRAMS: dict[str, dict[str, Callable[[Any], Any]]] = {
    "scan": {"jaxpr": _rewritten},
    "while": {"cond_jaxpr": _rewritten, "body_jaxpr": _rewritten},
    "cond": {"branches": lambda branches: tuple(map(_rewritten, branches))},
}
