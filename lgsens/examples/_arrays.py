"""Arrays of a scene from its parameters, which may be Python floats, arrays or traced."""

from jaxtyping import Array, Float

from lgsens._validate import as_float


def number(value) -> Float[Array, ""]:
    """A number as a leaf."""
    return as_float(value, (), "parameter")


def vector(x, y, z) -> Float[Array, "3"]:
    """A point, a vector or a direction."""
    return as_float((x, y, z), (3,), "parameters")
