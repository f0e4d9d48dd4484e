"""Steps of given sizes."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, is_concrete, require
from lgsens.integrate._generalized_alpha import GeneralizedAlpha
from lgsens.integrate._grid import UnevenGrid
from lgsens.integrate._scheme import AbstractIntegrator, AbstractScheme, Laid, scheme_of


class GivenSteps(AbstractIntegrator):
    """Steps of given sizes: an integrator of `simulate`.

        t_{n+1} = t_n + (t1 − t0) f_n,   f = fractions/Σ fractions

    Arguments:
        fractions: the sizes of the steps, relative to each other, shape (num_steps,), not negative, the first positive.
            A step of size 0 repeats the state.
        integrator: the scheme, `GeneralizedAlpha` or another one.

    `GivenSteps.of(trajectory)` has those of a trajectory: the grid that error control found for one design serves
    those nearby, and what is computed on it is as smooth in the parameters as on equal steps. The trajectory is of
    second order where sizes change smoothly; where they jump by a factor r, multipliers are off by O(r² − 1) h for some
    steps. Derivatives are exact, those by `fractions`, t0 and t1 too.

    Raises `ValueError` for fractions of another shape or sign.
    """

    fractions: Float[Array, " n"]
    integrator: AbstractScheme = eqx.field(static=True, default=GeneralizedAlpha())

    def __init__(self, fractions, integrator: AbstractScheme = GeneralizedAlpha()):
        self.fractions = as_float(fractions, None, "GivenSteps: `fractions`")
        self.integrator = scheme_of("GivenSteps", integrator)
        if self.fractions.ndim != 1 or not self.fractions.size:
            raise ValueError(f"GivenSteps: `fractions` must have shape (num_steps,), got {self.fractions.shape}.")
        require(
            lambda sizes: np.all(np.isfinite(sizes)) and np.all(sizes >= 0.0) and sizes[0] > 0.0,
            "GivenSteps: `fractions` must be finite, not negative, and the first one positive.",
            self.fractions,
        )

    @classmethod
    def of(cls, trajectory: Any, integrator: AbstractScheme = GeneralizedAlpha()) -> "GivenSteps":
        """The steps of a trajectory; those of size 0 are left out, unless it is traced."""
        sizes = jax.lax.stop_gradient(jnp.diff(trajectory.t))
        if is_concrete(sizes):
            sizes = np.asarray(sizes)[np.asarray(sizes) > 0.0]
        return cls(sizes, integrator)

    @property
    def num_steps(self) -> int:
        return self.fractions.shape[0]

    @property
    def scheme(self):
        return self.integrator

    @property
    def equal_steps(self):
        return False

    def check(self, num_steps):
        if self.num_steps != num_steps:
            raise ValueError(
                f"`num_steps` = {num_steps}, but GivenSteps has {self.num_steps}; give `integrator.num_steps`."
            )

    def lay(self, system, start, jerk, t0, t1, num_steps):
        return Laid(UnevenGrid.first(t0, (t1 - t0) * (self.fractions / jnp.sum(self.fractions))))
