"""The degrees of freedom that a body has, by name."""

from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np

from lgsens._validate import suggestion

Free = tuple[str, ...]
TRANSLATIONS: Free = ("x", "y", "z")
ROTATIONS: Free = ("rx", "ry", "rz")
ALL_FREE: Free = TRANSLATIONS + ROTATIONS  # in the order of the coordinates [x, θ]


def as_free(value: str | Iterable[str], what: str) -> Free:
    """The names of the degrees of freedom, in the order of the coordinates; a string is read word by word."""
    if not isinstance(value, Iterable):
        raise ValueError(f"{what} must be names of degrees of freedom, such as 'z rx', got {value!r}.")
    names = tuple(value.split()) if isinstance(value, str) else tuple(value)
    for name in names:
        if name not in ALL_FREE:
            raise ValueError(
                f"{what}: {suggestion(name, ALL_FREE)}: x, y, z are translations along the inertial axes, rx, ry, rz "
                "rotations about the body axes."
            )
    if sum(name in ROTATIONS for name in set(names)) == 2:
        raise ValueError(
            f"{what} = {names!r} has two rotations, which are no motion by themselves: turning about two axes in turn "
            "is turning about the third. Free one rotation or all three, and add a joint (UniversalJoint)."
        )
    return tuple(name for name in ALL_FREE if name in names)


def places(free: Free) -> tuple[int, ...]:
    """The coordinates of a body, 0 to 5, that are free."""
    return tuple(ALL_FREE.index(name) for name in free)


def single_rotation(free: Iterable[str]) -> int | None:
    """The axis (0, 1, 2) of the one rotation among `free`; None for none or three."""
    axes = sorted({ROTATIONS.index(name) for name in free if name in ROTATIONS})
    return axes[0] if len(axes) == 1 else None


def plane_of(free: Iterable[str]) -> int | None:
    """The axis (0, 1, 2) normal to the plane in which bodies with these degrees of freedom move; None: in none. Along
    a line only they move in no one plane."""
    free = {*free}
    across = [i for i, name in enumerate(TRANSLATIONS) if name not in free]
    if not free & {*ROTATIONS}:
        return across[0] if len(across) == 1 else None
    axis = single_rotation(free)
    return axis if axis in across else None


def vanish_but_for(vectors, kept: Sequence[Collection[int]]) -> Any:
    """Whether vectors, rows, have no other entries than those kept of each, to the accuracy of data given with eight
    digits. Of NumPy's arrays by NumPy: inside `jit` JAX would trace it."""
    size = abs(vectors)
    others = np.asarray([[float(i not in own) for i in range(size.shape[1])] for own in kept], size.dtype)
    return (size * others <= np.finfo(size.dtype).eps ** 0.5 * size.max(axis=1, keepdims=True)).all()


def is_along(direction, axis: int) -> Any:
    """Whether a direction is that of a coordinate axis."""
    return vanish_but_for(np.asarray(direction)[None], [(axis,)])
