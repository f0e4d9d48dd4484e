"""Fields of elements that hold a signal, or a number or a signal, and what is asked of those."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.errors import ConcretizationTypeError, TracerArrayConversionError

from lgsens._validate import as_float, require_nonzero
from lgsens.model._signals import AbstractSignal, Prescribed


def _no_signal(name: str, what: str, value: Any) -> ValueError:
    return ValueError(
        f"`{name}` must be {what} (Harmonic, Polynomial, Ramp, Sampled, or a subclass of AbstractSignal, whose numbers "
        f"are leaves), got {value!r}."
    )


def require_ratio(what: str, name: str, value: Prescribed | None, advice: str) -> None:
    """Raise `ValueError` for the ratio of a transmission that is missing, or a number and zero."""
    if value is None:
        raise ValueError(f"{what}: `{name}` is missing; give a number, or a signal.")
    if not isinstance(value, AbstractSignal):
        require_nonzero(what, name, value, advice)


def _a_number(name: str, signal: AbstractSignal) -> AbstractSignal:
    """The signal. Raises `ValueError` if it is one's own and returns no number, or asks for that of its argument."""
    own = type(signal)
    if own.__module__.startswith("lgsens."):
        return signal
    try:
        shape = jnp.shape(eqx.filter_eval_shape(signal, jnp.zeros(())))
    except (ConcretizationTypeError, TracerArrayConversionError) as error:
        raise ValueError(
            f"`{name}`: {own.__name__}.__call__ asks for the number that its argument is (an `if`, `float`, a function "
            "of NumPy or `math`), which is not known when a program is compiled; use jnp.where, jnp.clip and other "
            "functions of jax.numpy."
        ) from error
    if shape != ():
        raise ValueError(f"`{name}`: {own.__name__}.__call__ must return a number, shape (), got shape {shape}.")
    return signal


def _followed(name: str, signal: AbstractSignal, driven: bool) -> AbstractSignal:
    """The signal. Raises `ValueError` if positions follow it along straight lines, and as `_a_number`."""
    if driven and signal.straight:
        raise ValueError(
            f"`{name}` follows straight lines between samples: at each the velocity would jump, and no force "
            'is large enough for that. Give Sampled(…, kind="cubic"), or "monotone".'
        )
    return _a_number(name, signal)


def signal_field(name: str, *, optional: bool = False, driven: bool = False, over: str = "time", **default: Any) -> Any:
    """A keyword-only signal of an element, None by default if `optional`; the others as in `prescribed_field`."""

    def convert(value: Any) -> AbstractSignal | None:
        if optional and value is None:
            return None
        if not isinstance(value, AbstractSignal):
            raise _no_signal(name, "a signal", value)
        return _followed(name, value, driven)

    default = {"default": None} if optional else default
    return eqx.field(converter=convert, kw_only=True, metadata={"over": over}, **default)


def prescribed_field(name: str, *, positional: bool = False, driven: bool = False, over: str = "time") -> Any:
    """A scalar leaf or signal of an element, None by default, keyword-only unless `positional`; `driven`: of which
    positions follow, and so velocities and accelerations its derivatives; `over`: what a signal is a function of."""

    def convert(value: Any) -> Prescribed | None:
        if isinstance(value, AbstractSignal):
            return _followed(name, value, driven)
        if callable(value):
            raise _no_signal(name, "a number or a signal", value)
        return None if value is None else as_float(value, (), f"`{name}`")

    return eqx.field(
        converter=convert, kw_only=not positional, default=None, metadata={"prescribed": True, "over": over}
    )
