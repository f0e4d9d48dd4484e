"""Solutions as one operation, against those of a matrix by LAPACK and JAX's derivatives of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgsens.linear import LinearEquations, linear_solve, programs_in

CALLS = []


def called(name, function):
    def noted(*args):
        CALLS.append(name)
        return function(*args)

    return noted


def matrix(c):
    return c["a"] * jnp.asarray(np.random.default_rng(0).normal(size=(4, 4))) + jnp.diag(c["b"])


def joined(x):
    return jnp.concatenate([x["head"][None], x["tail"]])


def parts(x):
    return {"head": x[0], "tail": x[1:]}


EQUATIONS = LinearEquations(
    called("product", lambda c, x: parts(matrix(c) @ joined(x))),
    called("solve", lambda c, b: parts(jnp.linalg.solve(matrix(c), joined(b)))),
    called("transposed", lambda c, b: parts(jnp.linalg.solve(matrix(c).T, joined(b)))),
)
C = {"a": jnp.asarray(0.3), "b": jnp.array([3.0, -4.0, 5.0, 6.0])}
B = jnp.array([1.0, 2.0, -1.0, 0.5])
TOLERANCE = {"rtol": 1e-12, "atol": 1e-14}  # round-off times the condition, 5, times a few products


def by_equations(c, b):
    return joined(linear_solve(EQUATIONS, c, parts(b)))


def by_lapack(c, b):
    return jnp.linalg.solve(matrix(c), b)


def alike(found, expected):
    jax.tree.map(lambda f, e: np.testing.assert_allclose(f, e, **TOLERANCE), found, expected)


@pytest.mark.parametrize(
    "of",
    [
        lambda f: f(C, B),
        lambda f: jax.jacfwd(f, (0, 1))(C, B),
        lambda f: jax.jacrev(f, (0, 1))(C, B),
        lambda f: jax.jacrev(f, 1)(C, B),
        lambda f: jax.hessian(lambda c, b: jnp.sum(f(c, b) ** 3), (0, 1))(C, B),
        lambda f: jax.vmap(f, (None, 0))(C, jnp.stack([B, 2.0 * B**2])),
        lambda f: jax.vmap(f, ({"a": 0, "b": None}, None))(C | {"a": jnp.array([0.3, 0.5])}, B),
        lambda f: jax.vmap(jax.grad(lambda c, b: jnp.sum(f(c, b) ** 2)), ({"a": 0, "b": None}, 1))(
            C | {"a": jnp.array([0.3, 0.5])}, jnp.stack([B, B**2], axis=1)
        ),
    ],
    ids=["value", "forward", "reverse", "reverse by b", "hessian", "many b", "many c", "many gradients"],
)
def test_it_is_the_solution_and_its_derivatives(of):
    alike(*jax.jit(lambda: (of(by_equations), of(by_lapack)))())


def test_outside_of_jit():
    alike(jax.vjp(by_equations, C, B)[1](B), jax.vjp(by_lapack, C, B)[1](B))


def test_part_of_the_right_hand_side_may_be_constant():
    def of(solve):
        return jax.grad(lambda tail: jnp.sum(solve(C, jnp.concatenate([jnp.ones(1), tail])) ** 2))(B[1:])

    alike(of(by_equations), of(by_lapack))


def test_a_symmetric_one_is_its_own_transpose():
    s = matrix(C) @ matrix(C).T
    equations = LinearEquations(lambda s, x: s @ x, lambda s, b: jnp.linalg.solve(s, b))
    # condition of S: 5²
    np.testing.assert_allclose(
        jax.jacrev(lambda b: linear_solve(equations, s, b))(B), jnp.linalg.inv(s), rtol=1e-11, atol=1e-13
    )


def test_only_what_a_program_contains_is_traced():
    def traced_in(f, *args):
        jax.clear_caches()
        CALLS.clear()
        jax.jit(f).lower(*args)
        return set(CALLS)

    assert traced_in(by_equations, C, B) == {"solve"}
    assert traced_in(jax.grad(lambda b: jnp.sum(by_equations(C, b))), B) == {"transposed"}
    assert traced_in(jax.grad(lambda c: jnp.sum(by_equations(c, B))), C) == {"solve", "product", "transposed"}


def test_one_can_look_into_it():
    program = jax.make_jaxpr(by_equations)(C, B)
    (equation,) = (e for e in program.eqns if e.primitive.name == "linear_solve")
    names = lambda jaxpr: {n for e in jaxpr.eqns for n in ({e.primitive.name}, *map(names, programs_in(e))) for n in n}
    assert "lu" not in {e.primitive.name for e in program.eqns}
    assert "lu" in {name for inner in programs_in(equation) for name in names(inner)}
