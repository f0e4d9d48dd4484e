"""The course of a search: its evaluations, each of them kept, shown and counted."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from lgsens.optimize._checkpoint import Checkpoint


class Found(NamedTuple):
    """The best evaluation, its constraints, and the multipliers."""

    step: int
    constraints: np.ndarray
    multipliers: np.ndarray


class Course:
    """What a search has evaluated, and the carry to its next evaluation."""

    def __init__(self, start: tuple[Any, Any], num_steps: int, store: Checkpoint | None):
        """From carry and evaluation at x₀, or from what is stored already."""
        # One value: an interrupt sees all of an evaluation or nothing.
        self.state: tuple[Any, list[Any]] = store.load(*start) if store is not None else (start[0], [])
        self.num_steps, self.store = num_steps, store
        self.shown: Callable[[int, float, float], None] = lambda step, objective, worst: None

    @property
    def carry(self) -> Any:
        return self.state[0]

    @property
    def rows(self) -> list[Any]:
        return self.state[1]

    @property
    def full(self) -> bool:
        """Whether there may be no more evaluations."""
        return len(self.rows) >= self.num_steps

    def add(self, carry: Any, row: Any) -> None:
        """One evaluation more."""
        row = jax.tree.map(np.asarray, row)
        self.state = carry, [*self.rows, row]
        self.keep()
        self.shown(len(self.rows) - 1, float(row.objective), float(row.worst))

    def keep(self) -> None:
        """Write the checkpoint."""
        if self.store is not None:
            self.store.save(*self.state)
