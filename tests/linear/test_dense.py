"""Inverses of the size of a step's matrix, by our own elimination and by LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS

from lgsens.linear import Inverse, tuned

SIZES = (1, 5, tuned.ELIMINATED_ROWS, tuned.ELIMINATED_ROWS + 1)


def kept(matrix):
    """The inverse, from what is kept of it."""
    return jax.jit(lambda matrix: Inverse.of(matrix).transpose.T)(matrix)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_inverse(size, dtype):
    """The error of an inverse from a stable elimination is round-off times the condition of its matrix."""
    matrix = np.random.default_rng(size).normal(size=(size, size)).astype(dtype)
    expected = np.linalg.inv(matrix.astype(np.float64))
    found = kept(matrix)
    assert found.dtype == dtype
    bound = size * np.finfo(dtype).eps * np.linalg.cond(matrix.astype(np.float64))
    assert np.linalg.norm(np.asarray(found) - expected, 2) <= bound * np.linalg.norm(expected, 2)


@pytest.mark.parametrize("size", SIZES)
def test_rows_that_must_change_places(size):
    """A permutation has zeros where pivots would be, and its inverse is its transpose without any round-off."""
    matrix = np.eye(size)[np.random.default_rng(3).permutation(size)]
    np.testing.assert_array_equal(kept(matrix), matrix.T)


def test_a_pivot_that_is_small_is_not_taken():
    """With 1e-17 as the first pivot the rest of the matrix would be lost in it."""
    matrix = np.array([[1e-17, 1.0, 2.0], [1.0, 1.0, 0.0], [3.0, 0.0, 1.0]])
    np.testing.assert_allclose(kept(matrix) @ matrix, np.eye(3), rtol=0, atol=100 * EPS)


def test_a_batch_is_its_matrices():
    matrices = np.random.default_rng(4).normal(size=(3, 6, 6))
    for one, matrix in zip(jax.vmap(kept)(matrices), matrices, strict=True):
        bound = 6 * EPS * np.linalg.cond(matrix) * np.linalg.norm(one, 2)
        np.testing.assert_allclose(one, np.linalg.inv(matrix), rtol=0, atol=bound)


def test_a_singular_matrix_has_no_finite_inverse():
    assert not jnp.all(jnp.isfinite(kept(np.zeros((4, 4)))))
