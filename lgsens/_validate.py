"""Checks of arguments: conversion to float leaves once, at construction, and clear errors."""

import dataclasses
import importlib
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

_OF_PYTHON = (np.ndarray, float, int)
_NUMBERS = (jax.Array, *_OF_PYTHON)

# What to do where a number is asked for and a function comes: `eqx.nn.MLP` holds its activation as a leaf.
_OF_FUNCTIONS = (
    " Functions are no leaves: split what holds them (an eqx.nn.MLP) by params, static = eqx.partition(net, "
    "eqx.is_inexact_array), keep `static: Any = eqx.field(static=True)` beside the leaves `params`, and call "
    "eqx.combine(params, static)."
)
_OF_CLASSES = (
    " JAX does not look into a dataclass: register it (jax.tree_util.register_dataclass), make it an eqx.Module, or "
    "give a dict."
)


def as_float(value: Any, shape: tuple[int, ...] | None, what: str) -> Array:
    """`value` as a strongly typed float array of `shape` (None: any shape).

    Conversion happens here, once, with an explicit dtype: a weakly typed leaf would recompile
    after the first update of an optimizer.
    """
    if is_float_array(value):
        array = value
    else:
        try:
            if _says_something_else(value):
                raise TypeError("text, truth values or complex numbers, of which JAX would make others")
            known = all(isinstance(leaf, _OF_PYTHON) for leaf in jax.tree.leaves(value))
            array = array_of(np.asarray(value, _float_type())) if known else jnp.asarray(value, dtype=_float_type())
        except (TypeError, ValueError) as error:
            remedy = _OF_FUNCTIONS if callable(value) else _OF_CLASSES if dataclasses.is_dataclass(value) else ""
            raise ValueError(f"{what} must be a number or an array of numbers, got {value!r}.{remedy}") from error
    if shape is not None and array.shape != shape:
        raise ValueError(f"{what} must have shape {shape}, got shape {array.shape}.")
    return array


def as_parameters(p: Any) -> Any:
    """`p` with `as_float` of each leaf, of which one at least has a number."""
    found = jax.tree_util.tree_map_with_path(
        lambda path, leaf: as_float(leaf, None, f"`p`{jax.tree_util.keystr(path)}"), p
    )
    if not sum(leaf.size for leaf in jax.tree.leaves(found)):
        raise ValueError(f"`p` must hold at least one number, got {found!r}.")
    return found


def _says_something_else(value: Any) -> bool:
    """Whether there are texts, truth values or complex numbers in it."""
    kind = lambda leaf: getattr(getattr(leaf, "dtype", None), "kind", "")
    return any(isinstance(leaf, str | bytes | bool) or kind(leaf) in {*"bcSU"} for leaf in jax.tree.leaves(value))


def is_float_array(value: Any) -> bool:
    """Whether `as_float` takes it as it is."""
    return isinstance(value, jax.Array) and value.dtype == _float_type() and not value.weak_type


def _float_type() -> np.dtype:
    """What `jnp.result_type(float)` is, in a tenth of its 6 µs."""
    return jax.dtypes.canonicalize_dtype(float)


def as_count(value: Any, name: str, why: str = "") -> int:
    """`value` as a Python int of at least 1."""
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError("a truth value, which counts as 0 or 1")
        count = operator.index(value)
    except TypeError as error:
        raise ValueError(f"`{name}` must be a Python int{why}, got {value!r}.") from error
    if count < 1:
        raise ValueError(f"`{name}` must be at least 1, got {count}.")
    return count


def is_concrete(*values: Any) -> bool:
    """Whether every array in `values` has values that Python can look at now."""
    leaves = jax.tree.leaves(values)
    return not any(isinstance(leaf, Tracer) for leaf in leaves) and all(isinstance(leaf, _NUMBERS) for leaf in leaves)


def array_of(values: np.ndarray | Array) -> Array:
    """NumPy's numbers as an array of JAX. Unless it is told their type `jnp.asarray` compiles a program to copy them,
    10 to 20 ms for each shape."""
    return jnp.asarray(values, jax.dtypes.canonicalize_dtype(values.dtype))


def all_finite(tree: Any) -> bool:
    """Whether all numbers of a pytree, which are known, are finite."""
    return all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(tree))


def require(condition: Callable[..., Any], message: str | Callable[[], str], *values: Any) -> None:
    """Raise `ValueError` with the message unless `condition(*values)` holds; skipped while `values` are traced.

    The condition sees NumPy arrays: inside `jit` JAX operations are traced even on concrete values. A function says
    the message where there are many: an array in it takes 75 µs to be printed.
    """
    if is_concrete(*values) and not bool(condition(*map(np.asarray, values))):
        raise ValueError(message if isinstance(message, str) else message())


def require_setting(owner: Any, name: str, valid: bool, must: str, advice: str = "") -> None:
    """Raise `ValueError` unless a static setting of `owner` is valid."""
    if not valid:
        value = getattr(owner, name)
        if isinstance(value, jax.Array):
            advice = "; settings are static, no data: give a Python number, `float(x)`, which is never traced" + advice
        raise ValueError(f"{type(owner).__name__}: `{name}` must be {must}, got {value!r}{advice}.")


def optional(module: str, what: str, extra: str = "data") -> Any:
    """A module that an extra of lgsens installs; raises `ImportError` that says how."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f'`{what}` needs {module}: pip install "lgsens[{extra}]".') from error


def suggestion(name: str, known: Any) -> str:
    """The known names, for a message about an unknown one."""
    return f"{name!r} is not one of {sorted(known)}"


def leaf_name(path: tuple[Any, ...], root: str) -> str:
    """The name of a leaf of a pytree from its path, bodies.top.mass; `root` where the pytree is the leaf."""
    return jax.tree_util.keystr(path, simple=True, separator=".") or root


def shaped(*shape: int) -> dict[str, tuple[int, ...]]:
    """The metadata of a field whose array, unless it is None, has that shape: what comes in after construction too."""
    return {"shape": shape}


def number_field(name: str, **kwargs: Any) -> Any:
    """A keyword-only scalar leaf of an element; with `default=None` it may be left out."""
    return eqx.field(
        converter=lambda value: None if value is None else as_float(value, (), f"`{name}`"),
        kw_only=True,
        metadata=shaped(),
        **kwargs,
    )


def point_field(name: str, **kwargs: Any) -> Any:
    """A keyword-only leaf of shape (3,): a point, a vector or a direction."""
    return eqx.field(
        converter=lambda value: None if value is None else as_float(value, (3,), f"`{name}`"),
        kw_only=True,
        metadata=shaped(3),
        **kwargs,
    )


def axis_field(name: str) -> Any:
    """A keyword-only direction of shape (3,): any length but zero, kept as given so that it stays a leaf."""

    def convert(value: Any) -> Array:
        axis = as_float(value, (3,), f"`{name}`")
        require(lambda axis: np.isfinite(axis).all(), lambda: f"`{name}` must be finite, got {axis}.", axis)
        require(
            lambda axis: np.linalg.norm(axis) > 0,
            f"`{name}` has zero length; give a direction, e.g. (0, 0, 1).",
            axis,
        )
        return axis

    return eqx.field(converter=convert, kw_only=True, metadata=shaped(3))


def require_positive(owner: Any, *names: str) -> None:
    """Raise `ValueError` for numbers of an element that are given and not positive."""
    for name in names:
        if (value := getattr(owner, name)) is not None:
            message = lambda name=name, value=value: f"{type(owner).__name__}: `{name}` must be positive, got {value}."
            require(lambda value: np.all(value > 0), message, value)


def require_not_negative(owner: Any, *names: str) -> None:
    """Raise `ValueError` for numbers of an element that are given and negative."""
    for name in names:
        if (value := getattr(owner, name)) is not None:
            message = lambda name=name, value=value: f"{type(owner).__name__}: `{name}` must be ≥ 0, got {value}."
            require(lambda value: np.all(value >= 0), message, value)


def require_nonzero(what: str, name: str, value, advice: str) -> None:
    """Raise `ValueError` for a number of `what` that is zero; `advice` follows it: its unit, or what to do."""
    require(lambda value: value != 0, lambda: f"{what}: `{name}` must not be zero, got {value}{advice}.", value)
