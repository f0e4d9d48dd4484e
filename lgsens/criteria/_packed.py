"""What one program leaves for another, in a few arrays: each of hundreds of small ones costs a microsecond or two at
either end, for the quarter-car as much as its gradient."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from lgsens.linear import tuned


class Packed(eqx.Module):
    """A pytree of arrays whose small ones stand in one vector for each dtype; `unpacked` is the tree again."""

    vectors: dict[str, jax.Array]
    large: list[jax.Array]
    structure: Any = eqx.field(static=True)
    shapes: tuple[tuple[int, ...] | None, ...] = eqx.field(static=True)  # None: of a large array
    dtypes: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tree: Any) -> "Packed":
        leaves, structure = jax.tree.flatten(tree)
        small = [leaf.size < tuned.PASSED_ALONE for leaf in leaves]
        dtypes = tuple(leaf.dtype.name for leaf in leaves)
        parts: dict[str, list[jax.Array]] = {}
        for leaf, name, one in zip(leaves, dtypes, small):
            if one:
                parts.setdefault(name, []).append(leaf.ravel())
        return cls(
            {name: jnp.concatenate(own) for name, own in parts.items()},
            [leaf for leaf, one in zip(leaves, small) if not one],
            structure,
            tuple(leaf.shape if one else None for leaf, one in zip(leaves, small)),
            dtypes,
        )

    @property
    def unpacked(self) -> Any:
        large, at = iter(self.large), dict.fromkeys(self.vectors, 0)
        leaves = []
        for shape, name in zip(self.shapes, self.dtypes):
            if shape is None:
                leaves.append(next(large))
                continue
            begin = at[name]
            at[name] = begin + math.prod(shape)
            leaves.append(self.vectors[name][begin : at[name]].reshape(shape))
        return jax.tree.unflatten(self.structure, leaves)
