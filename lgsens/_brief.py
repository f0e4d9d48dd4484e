"""Short reprs: a name and a line for each field, one screen at most, whatever is in their arrays."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np

from lgsens._validate import is_concrete

_WIDTH, _LINES, _ENTRIES = 110, 30, 9


def brief(self: Any) -> str:
    """The repr of a result: `__repr__ = brief` in a named tuple or a dataclass."""
    known = getattr(self, "_fields", None) or [field.name for field in dataclasses.fields(self) if field.repr]
    return listed(type(self).__name__, {name: shown(getattr(self, name)) for name in known})


def as_called(self: Any) -> str:
    """The repr of an element: the call that makes it, with its numbers; `__repr__ = as_called` in a dataclass."""
    fields = {field.name: field.default for field in dataclasses.fields(self) if field.repr}
    values = {name: getattr(self, name) for name in fields}
    given = [
        f"{name}={shown(value)}" for name, value in values.items() if value is not None or fields[name] is not None
    ]
    line, head = ", ".join(given), f"{type(self).__name__}("
    if len(head + line) < _WIDTH:
        return f"{head}{line})"
    lines = [""]
    for text in (f"{text}," for text in given):
        if len(lines[-1]) + len(text) < _WIDTH - 3:
            lines[-1] += f" {text}"
        else:
            lines.append(f" {text}")
    return "\n".join([head, *(_cut(f" {text}") for text in lines), ")"])


def listed(head: str, fields: Mapping[str, str]) -> str:
    """Lines of names and texts under a head, cut to a screen."""
    width = max(map(len, fields), default=0)
    lines = [head, *(_cut(f"  {name:{width}}  {text}") for name, text in fields.items())]
    more = len(lines) - _LINES
    return "\n".join(lines if more <= 0 else [*lines[:_LINES], f"  … {more} more"])


def roster(of: Iterable[str]) -> str:
    """How many, and the first of them."""
    known = list(of)
    return f"{len(known)}: {', '.join(known)}" if known else "none"


def shown(value: Any) -> str:
    """A value in one line: numbers, few of an array, or its shape and range; of a tree its leaves."""
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _array(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return "{" + _joined(f"{key!r}: {shown(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list | tuple) and type(value).__repr__ in (list.__repr__, tuple.__repr__):
        return "(" + _joined(map(shown, value)) + ")"
    return " ".join(repr(value).split())


def _array(value: Any) -> str:
    kind = f"{value.dtype}{list(value.shape)}"
    if not is_concrete(value) or not hasattr(value, "__array__"):
        return f"traced {kind}"
    array = np.asarray(value)
    if array.size <= _ENTRIES:
        tidy = array + 0.0 if array.dtype.kind == "f" else array  # no −0
        return " ".join(np.array2string(tidy, precision=6, separator=", ").split())
    if array.dtype.kind == "b":
        return f"{kind}, {int(array.sum())} true"
    if array.dtype.kind not in "fiu":
        return kind
    finite = array[np.isfinite(array)]
    extent = f", {finite.min():.4g} to {finite.max():.4g}" if finite.size else ""
    return kind + extent + (f", {array.size - finite.size} not finite" if finite.size < array.size else "")


def _joined(texts: Iterable[str]) -> str:
    """As many as a line has place for."""
    found = ""
    for text in texts:
        if len(found) > _WIDTH:
            return found + ", …"
        found += (", " if found else "") + text
    return found


def _cut(line: str) -> str:
    return line if len(line) <= _WIDTH else line[: _WIDTH - 1] + "…"
