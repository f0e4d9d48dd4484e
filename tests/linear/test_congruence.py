"""A diag(blocks) Aᵀ by bodies, against arrays."""

import jax.numpy as jnp
import numpy as np
from helpers import EPS

from lgsens.linear._sparse import Blocks, Pattern, SparseMatrix

BODIES = 5


def some_left_out(rng, index):
    return np.where(rng.random(index.shape) < 0.25, -1, index)


def test_congruence():
    """Elements of four types between random bodies, with rows and coordinates left out."""
    rng = np.random.default_rng(4)
    index = some_left_out(rng, np.arange(6 * BODIES).reshape(BODIES, 6))
    parts, height = [], 0
    for elements, rows, sides in ((9, 3, 2), (4, 1, 2), (3, 2, 1), (1, 3, 1)):
        slots = np.stack([rng.permutation(BODIES)[:sides] for _ in range(elements)])
        places = some_left_out(rng, height + np.arange(elements * rows).reshape(elements, rows))
        values = jnp.asarray(rng.standard_normal((elements, rows, 6 * sides)))
        parts.append(Blocks(values, Pattern(places, index[slots].reshape(elements, -1), slots)))
        height += elements * rows
    blocks = rng.standard_normal((BODIES, 6, 6))
    blocks = blocks + np.swapaxes(blocks, 1, 2)
    # a coordinate that a body does not have is nothing in its block
    blocks = np.where((index[:, :, None] >= 0) & (index[:, None, :] >= 0), blocks, 0.0)
    whole = np.zeros((6 * BODIES + 1, 6 * BODIES + 1))
    for own, block in zip(index, blocks):
        whole[np.ix_(own, own)] += block

    sparse = SparseMatrix(tuple(parts), (height, 6 * BODIES), jnp.float64)
    dense = sparse.to_numpy()
    wanted = dense @ whole[:-1, :-1] @ dense.T
    # 72 products for an entry
    np.testing.assert_allclose(sparse.congruence(jnp.asarray(blocks)), wanted, atol=100 * EPS * np.abs(wanted).max())
    assert np.count_nonzero(wanted) > height


def test_no_rows_at_all():
    nothing = SparseMatrix((), (0, 6), jnp.float64)
    assert nothing.congruence(jnp.ones((1, 6, 6))).shape == (0, 0)
