"""Methods of `differentiate` that share nothing with the hand-derived ones: for comparison."""

import equinox as eqx

# f' = Σ w f(k δ)/δ + O(δ⁶)
STENCIL = tuple((float(k), w / 60.0) for k, w in ((1, 45), (-1, -45), (2, -9), (-2, 9), (3, 1), (-3, -1)))


class FiniteDifferences(eqx.Module):
    """Central differences of sixth order of the numerical solution, a method of `differentiate`.

        f' = (45 (f₁ − f₋₁) − 9 (f₂ − f₋₂) + (f₃ − f₋₃))/(60 δ) + O(δ⁶)

    Arguments:
        step: δ relative to the magnitude of each parameter (absolute where that is 0).

    Six simulations for each parameter. Raises `ValueError` for a step that is not positive.
    """

    step: float = eqx.field(static=True, default=1e-3)

    def __check_init__(self):
        if not isinstance(self.step, int | float) or not 0.0 < self.step < 0.3:
            raise ValueError(
                f"FiniteDifferences: `step` must be between 0 and 0.3, relative to each parameter, got {self.step!r}."
            )


class IndexReduced(eqx.Module):
    """The index-reduced equations (41) and their derivatives, integrated by diffrax: a method of `differentiate`.

    A Runge–Kutta method of order 8 with error control over motion and sensitivities together. It knows nothing of
    generalized-α, its linearization, or adjoint equations: the reference for all of these. `num_steps` and `integrator`
    are not used. To simulate with these equations: `IndexReducedODE`.

    Arguments:
        rtol, atol: tolerances, relative and absolute.
        breaks: times [s] at which a force is not smooth, beside those that signals tell (where a bump begins or ends).

    Raises `ValueError` for tolerances that are not positive.
    """

    rtol: float = eqx.field(static=True, default=1e-12)
    atol: float = eqx.field(static=True, default=1e-12)
    breaks: tuple[float, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not 0.0 < value < 1.0:
                raise ValueError(
                    f"IndexReduced: `{name}` must be between 0 and 1, got {value!r}; 1e-12 is the default."
                )
