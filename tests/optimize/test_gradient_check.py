"""`check_gradient` on right and wrong gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgsens.optimize import check_gradient


def test_a_right_gradient_agrees_with_differences():
    def fun(x):
        return jnp.sin(x["k"] / 1e5) * jnp.sum(jnp.exp(x["p"]))

    x = {"k": 1.1e5, "p": jnp.asarray([0.1, 0.2])}
    check = check_gradient(fun, x)
    assert check.directions == ("k", "p[0]", "p[1]")
    assert np.max(check.error) < 1e-9  # ε^(2/3) = 4e-11 times the curvature and the condition of fun
    # Scaled by the size of each leaf: k ∂f/∂k.
    exact = 1.1 * np.cos(1.1) * (np.exp(0.1) + np.exp(0.2))
    assert check.exact[0] == pytest.approx(exact, rel=1e-12)


def test_many_entries_are_checked_along_random_directions():
    x = jnp.linspace(0.1, 1.0, 40)
    check = check_gradient(lambda x: jnp.sum(x**3), x, max_directions=5)
    assert check.directions == tuple(f"direction {i}" for i in range(1, 6))
    assert check.exact.shape == (5,) and np.min(np.abs(check.exact)) > 0
    assert np.max(check.error) < 1e-9  # as above


def test_a_wrong_gradient_is_seen():
    @jax.custom_jvp
    def wrong(x):
        return x**2

    wrong.defjvp(lambda primals, tangents: (wrong(*primals), 2.02 * primals[0] * tangents[0]))
    check = check_gradient(wrong, 1.5)
    assert check.error[0] == pytest.approx(0.02 / 2.02, rel=1e-6)  # 1 % too large, seen to round-off


@pytest.mark.parametrize(
    ("options", "message"),
    [({"step": 0.0}, "`step` must be positive, got 0.0"), ({"fun": lambda x: x[None]}, "scalar")],
)
def test_bad_gradient_checks(options, message):
    fun = options.pop("fun", lambda x: x**2)
    with pytest.raises((ValueError, TypeError), match=message):
        check_gradient(fun, 1.0, **options)
