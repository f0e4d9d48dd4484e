"""Steps of given sizes."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._validate import as_float, is_concrete, require, require_setting
from lgsens.dynamics import RESULTS, breaks_of
from lgsens.integrate._generalized_alpha import GeneralizedAlpha
from lgsens.integrate._integrator import AbstractIntegrator, Laid
from lgsens.integrate._pieces import moved, piece_ends
from lgsens.integrate._scheme import AbstractScheme, scheme_of
from lgsens.integrate._uneven_grid import UnevenGrid


class AbstractUnevenSteps(AbstractIntegrator):
    """A scheme in steps that are not all equal."""

    integrator: eqx.AbstractVar[AbstractScheme]

    @property
    def scheme(self):
        return self.integrator

    @property
    def equal_steps(self):
        return False

    def moves(self, system):
        return breaks_of(system).size > 0


class GivenSteps(AbstractUnevenSteps):
    """Steps of given sizes: an integrator of `simulate`.

        t_{n+1} = t_n + (t1 − t0) f_n,   f = fractions/Σ fractions

    Arguments:
        fractions: the sizes of the steps, relative to each other, shape (num_steps,), not negative, the first positive.
            A step of size 0 repeats the state.
        integrator: the scheme, `GeneralizedAlpha` or another one.
        fixed: whether `fractions` are constants, of zero derivative. Gradients are then cheaper, next to those in equal
            steps where most sizes stay (`benchmarks/variable_steps.py`); else the derivative by the ratio of sizes is
            formed in every step.
        ends: the ends of the pieces between breaks for which the steps were laid, as parts of the interval, ascending
            and 1 at last, shape (k,): in a scene of k − 1 breaks the steps move with them. None: breaks move nothing.

    `GivenSteps.of(trajectory)` has those of a trajectory, fixed, with its `ends`: the grid that error control found for
    one design serves those nearby, whose steps end at their own breaks, and what is computed on it is as smooth in the
    parameters as on equal steps. The trajectory is of second order, multipliers too, where sizes jump as well.
    Derivatives are exact, those by `fractions` (unless fixed), t0, t1 and times of breaks too.

    Raises `ValueError` for fractions or ends of another shape or sign.
    """

    any_number: ClassVar[bool] = False
    fractions: Float[Array, " n"]
    integrator: AbstractScheme = eqx.field(static=True, default=GeneralizedAlpha())
    fixed: bool = eqx.field(static=True, default=False)
    ends: Float[Array, " k"] | None = None

    def __init__(self, fractions, integrator: AbstractScheme = GeneralizedAlpha(), *, fixed: bool = False, ends=None):
        self.fractions = as_float(fractions, None, "GivenSteps: `fractions`")
        self.integrator = scheme_of("GivenSteps", integrator)
        self.fixed = fixed
        self.ends = None if ends is None else as_float(ends, None, "GivenSteps: `ends`")
        require_setting(self, "fixed", isinstance(fixed, bool), "True or False")
        if self.fractions.ndim != 1 or not self.fractions.size:
            raise ValueError(f"GivenSteps: `fractions` must have shape (num_steps,), got {self.fractions.shape}.")
        require(
            lambda sizes: np.all(np.isfinite(sizes)) and np.all(sizes >= 0.0) and sizes[0] > 0.0,
            "GivenSteps: `fractions` must be finite, not negative, and the first one positive.",
            self.fractions,
        )
        if self.ends is not None:
            if self.ends.ndim != 1 or not self.ends.size:
                raise ValueError(f"GivenSteps: `ends` must have shape (k,), got {self.ends.shape}.")
            require(
                lambda ends: np.all(np.diff(ends, prepend=0.0) >= 0.0) and abs(ends[-1] - 1.0) < 1e-6,
                "GivenSteps: `ends` must be ascending parts of the interval, the last one 1.",
                self.ends,
            )

    @classmethod
    def of(cls, trajectory: Any, integrator: AbstractScheme = GeneralizedAlpha()) -> "GivenSteps":
        """The steps of a trajectory; those of size 0 are left out, unless it is traced.

        Raises `ValueError` for a trajectory that has failed, and for a batch, each of which has its own: `jax.vmap`
        this.
        """
        if jnp.ndim(trajectory.t) != 1:
            raise ValueError(
                f"GivenSteps.of: this is a batch of trajectories, of shape {jnp.shape(trajectory.t)[:-1]}; each has "
                "steps of its own: jax.vmap(GivenSteps.of)(trajectories), for simulations under `vmap`."
            )
        result = getattr(trajectory, "result", None)
        if result is not None and is_concrete(result) and int(result) != RESULTS.successful:
            raise ValueError(
                "GivenSteps.of: the trajectory has failed, and its steps are not those of the whole interval. "
                f"{RESULTS(int(result)).message}"
            )
        sizes = lax.stop_gradient(jnp.diff(trajectory.t))
        if is_concrete(sizes):
            sizes = np.asarray(sizes)[np.asarray(sizes) > 0.0]
        t, system = lax.stop_gradient((trajectory.t, getattr(trajectory, "system", None)))
        ends = piece_ends(system, t[0], t[-1])
        return cls(sizes, integrator, fixed=True, ends=ends / ends[-1] if ends.size > 1 else None)

    @property
    def num_steps(self) -> int:
        return self.fractions.shape[0]

    def check(self, num_steps):
        if self.num_steps != num_steps:
            raise ValueError(
                f"`num_steps` = {num_steps}, but GivenSteps has {self.num_steps}; give `integrator.num_steps`."
            )

    def lay(self, system, start, t0, t1, num_steps):
        fractions = lax.stop_gradient(self.fractions) if self.fixed else self.fractions
        total, moves = lax.stop_gradient(t1 - t0), self.moves(system)
        known, ends = (self.ends, piece_ends(system, t0, t1)) if moves else (jnp.ones(1, t0.dtype), (t1 - t0)[None])
        sizes, begins = moved(total * (fractions / jnp.sum(fractions)), total * lax.stop_gradient(known), ends)
        restarts = self.integrator.restarts(system)
        return Laid(UnevenGrid.first(t0, sizes, fixed=self.fixed, restarts=restarts, moving=begins))

    def moves(self, system):
        return self.ends is not None and self.ends.size == breaks_of(system).size + 1
