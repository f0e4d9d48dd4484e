"""Linear equations whose solution is known by other means than their matrix, differentiable in both modes, again and
again.

    A(c) x = b     ⟹     x' = A⁻¹ (b' − A' x),     b̄ = A⁻ᵀ x̄

`lax.custom_linear_solve` says the same, and traces the solution, that of the transpose, the product and its transpose
wherever one of them is wanted; and all that it closes over must be told apart again. Here a solution is one operation,
whose functions are traced where a program contains them: in the derivative by reverse mode only the transposed one,
and products for second derivatives alone. That is 0.4 of the time to trace the quarter-car's gradient.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive
from jax.interpreters import ad, batching, mlir

Leaves = list[Any]
_PROGRAMS = (Jaxpr, ClosedJaxpr)


class LinearEquations(NamedTuple):
    """A(c) x = b by functions of the constants c and one more argument, pytrees; static, so functions of modules."""

    product: Callable[[Any, Any], Any]  # (c, x) ↦ A x
    solve: Callable[[Any, Any], Any]  # (c, b) ↦ A⁻¹ b
    transposed: Callable[[Any, Any], Any] | None = None  # (c, b) ↦ A⁻ᵀ b; None: A is symmetric


class _Flat(NamedTuple):
    """The same, of lists of arrays."""

    equations: LinearEquations
    constants: Any  # the structure of c
    unknowns: Any  # and that of x and b

    def product(self, turned: bool, constants: Leaves, x: Leaves) -> Leaves:
        of, x = partial(self.equations.product, self.constants.unflatten(constants)), self.unknowns.unflatten(x)
        turned = turned and self.equations.transposed is not None
        return self.unknowns.flatten_up_to(jax.linear_transpose(of, x)(x)[0] if turned else of(x))

    def solve(self, turned: bool, constants: Leaves, b: Leaves) -> Leaves:
        solve = self.equations.transposed if turned and self.equations.transposed else self.equations.solve
        return self.unknowns.flatten_up_to(solve(self.constants.unflatten(constants), self.unknowns.unflatten(b)))


class _Lanes(NamedTuple):
    """The same, of many x and b, and of many of those constants that have an axis."""

    one: Any
    axes: tuple[int | None, ...]

    def product(self, turned: bool, constants: Leaves, x: Leaves) -> Leaves:
        return jax.vmap(partial(self.one.product, turned), (list(self.axes), 0))(constants, x)

    def solve(self, turned: bool, constants: Leaves, b: Leaves) -> Leaves:
        return jax.vmap(partial(self.one.solve, turned), (list(self.axes), 0))(constants, b)


class _How(NamedTuple):
    """What is solved: the equations, for how many constants, whether transposed, and in which part of a mesh."""

    equations: Any
    constants: int
    turned: bool
    mesh: Any

    def split(self, leaves: Any) -> tuple[Leaves, Leaves]:
        return list(leaves[: self.constants]), list(leaves[self.constants :])


def linear_solve(equations: LinearEquations, constants: Any, b: Any) -> Any:
    """x of A(c) x = b, a pytree like b."""
    leaves, constants_tree = jax.tree.flatten(constants)
    rhs, tree = jax.tree.flatten(b)
    mesh = jax.sharding.get_abstract_mesh()
    how = _How(_Flat(equations, constants_tree, tree), len(leaves), False, mesh)
    return tree.unflatten(_solution.bind(*leaves, *rhs, how=how))


_solution = Primitive("linear_solve")
_solution.multiple_results = True


@partial(jax.jit, static_argnames="how", inline=True)  # traced once for a program and for who looks into it
def _run(*leaves, how: _How):
    with jax.sharding.use_abstract_mesh(how.mesh):
        return how.equations.solve(how.turned, *how.split(leaves))


def _derivative(primals, tangents, *, how: _How):
    constants, _ = how.split(primals)
    of_constants, of_b = how.split(tangents)
    x = _solution.bind(*primals, how=how)
    of_b = [ad.instantiate_zeros(tangent) for tangent in of_b]
    moving = [i for i, tangent in enumerate(of_constants) if not isinstance(tangent, ad.Zero)]
    if moving:

        def product(*values):
            changed = dict(zip(moving, values))
            return how.equations.product(how.turned, [changed.get(i, c) for i, c in enumerate(constants)], x)

        given = [constants[i] for i in moving], [of_constants[i] for i in moving]
        of_b = list(map(jnp.subtract, of_b, jax.jvp(product, *given)[1]))
    return x, _solution.bind(*constants, *of_b, how=how)


def _transpose(cotangents, *leaves, how: _How):
    constants, b = how.split(leaves)
    filled = [ad.instantiate_zeros(cotangent) for cotangent in cotangents]
    found = _solution.bind(*constants, *filled, how=how._replace(turned=not how.turned))
    of_b = [bar if ad.is_undefined_primal(rhs) else None for rhs, bar in zip(b, found)]
    return [None] * len(constants) + of_b


def _batched(leaves, axes, *, how: _How):
    (size,) = {leaf.shape[axis] for leaf, axis in zip(leaves, axes) if axis is not None}
    constants, b = how.split(leaves)
    of_constants, of_b = how.split(axes)
    b = [batching.bdim_at_front(rhs, axis, size) for rhs, axis in zip(b, of_b)]
    lanes = how._replace(equations=_Lanes(how.equations, tuple(of_constants)))
    return _solution.bind(*constants, *b, how=lanes), [0] * len(b)


_solution.def_impl(_run)
_solution.def_abstract_eval(lambda *shapes, how: how.split(shapes)[1])
ad.primitive_jvps[_solution] = _derivative
ad.primitive_transposes[_solution] = _transpose
batching.primitive_batchers[_solution] = _batched
mlir.register_lowering(_solution, mlir.lower_fun(_run, multiple_results=True))


def programs_in(equation: Any) -> Iterator[Any]:
    """The programs inside of an operation of a program: those of loops, branches and calls, and of a solution.

    Closed ones as they are, with their constants.
    """
    if equation.primitive is _solution:
        yield jax.make_jaxpr(partial(_run, **equation.params))(*(place.aval for place in equation.invars))
        return
    for found in equation.params.values():
        yield from (each for each in (found if isinstance(found, tuple) else (found,)) if isinstance(each, _PROGRAMS))
