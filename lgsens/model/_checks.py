"""Numbers that come in after construction: leaves that an optimizer or `tree_at` replaced, and traced values.

Where a system is assembled the same rules hold as in constructors. Known numbers are looked at there, and the message
names element and field; traced ones are looked at by the program (`MultibodySystem.is_valid`), whose result says so.

A body of positive mass density has J = ∫ ρ (|x|² I − x xᵀ) dV, so E = ½ tr(J) I − J = ∫ ρ x xᵀ dV is positive
semidefinite: that is the triangle inequality of its principal moments, and J has no negative ones then. E is where its
seven principal minors are not negative.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float

from lgsens._validate import all_finite, as_float, is_concrete, is_float_array, leaf_name
from lgsens.model._free import ALL_FREE, single_rotation, vanish_but_for

_ALIGNED = 1e-2  # rad: a turn about axes further apart is none about either


def check_axes(bodies: Mapping[str, Any], joints: Mapping[str, Any], forces: Mapping[str, Any]) -> None:
    """Raise `ValueError` for a driver or spring about another axis than that about which its bodies turn, as far as
    their hinge or the rotations that they have tell, and numbers are known."""
    ends_of = {name: (joint.a, joint.b) for name, joint in joints.items()}
    hinges = {frozenset(ends_of[name]): name for name, joint in joints.items() if joint.hinge is not None}
    for what, members in (("Joint", joints), ("Force", forces)):
        for name, member in members.items():
            if member.about is None:
                continue
            pair = ends_of[name] if what == "Joint" else member.bodies
            one_rotation = single_rotation(free for end in pair if end is not None for free in bodies[end].free)
            if (hinge := hinges.get(frozenset(pair))) is not None:
                axis, where = joints[hinge].hinge, f"as their joint {hinge!r} lets them"
            elif one_rotation is not None:
                axis, where = np.eye(3)[one_rotation], "as their `free` rotations let them"
            else:
                continue
            if not is_concrete(axis, member.about):
                continue
            one, other = (np.asarray(each) / np.linalg.norm(each) for each in (axis, member.about))
            if np.linalg.norm(np.cross(one, other)) > _ALIGNED:
                raise ValueError(
                    f"{what} {name!r}: {type(member).__name__} between {pair[0]!r} and {pair[1]!r} about "
                    f"{np.asarray(member.about)}, but these turn about {np.asarray(axis)} only, {where}; give it that "
                    "axis."
                )


def outside_of_freedom(bodies: Iterable[Any], joints: Iterable[tuple[Any, Sequence[Any]]]) -> Any:
    """Whether a traced number says what the degrees of freedom of bodies leave out: a velocity, a tilt, the axis of a
    joint, which is given with its bodies. Constructors and `violable_rows` say so of known ones. False: none is traced.
    """
    velocities = [(body.velocities, body.coordinates) for body in bodies if body.free != ALL_FREE]
    axes = [(body.orientation[:, axis], (axis,)) for body in bodies if (axis := single_rotation(body.free)) is not None]
    for joint, own in joints:
        axis = single_rotation(name for body in own for name in body.free)
        if axis is not None and joint.hinge is not None:
            axes.append((joint.hinge, (axis,)))
    traced = [[(vector, kept) for vector, kept in rules if not is_concrete(vector)] for rules in (velocities, axes)]
    rows = [(lax.stop_gradient(jnp.stack([vector for vector, _ in rules])), rules) for rules in traced if rules]
    agree = [vanish_but_for(vectors, [kept for _, kept in rules]) for vectors, rules in rows]
    return ~jnp.stack(agree).all() if agree else False


def strong(element: Any) -> Any:
    """An element of one's own with arrays of one type in place of Python's numbers and weakly typed arrays.

    An optimizer sees the former as no number of the model, and the latter are strongly typed after its first step: a
    loop would be traced again.
    """
    weak = lambda leaf: isinstance(leaf, float | int) or getattr(leaf, "weak_type", False)
    return jax.tree.map(lambda leaf: as_float(leaf, None, "a number") if weak(leaf) else leaf, element)


def checked(what: str, element: Any) -> Any:
    """A body, joint or force with strongly typed float arrays as numbers.

    Raises `ValueError`, with `what` ("Body 'top'") and the field, for one that is no number or known not to be finite,
    and for numbers that its constructor would refuse.
    """

    def number(path, leaf):
        field = lambda: f"{what}: `{leaf_name(path, type(element).__name__)}`"
        array = leaf if is_float_array(leaf) else as_float(leaf, None, field())
        if not isinstance(array, Tracer) and not np.isfinite(array).all():
            raise ValueError(f"{field()} must be finite, got {np.asarray(leaf)}; bound what an optimizer may change.")
        return array

    element = jax.tree_util.tree_map_with_path(number, element)
    try:
        _check_again(element)
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error
    return element


def _check_again(module: eqx.Module) -> None:
    """The checks of the constructors of a module and of those in it: shapes first."""
    for field in dataclasses.fields(module):
        shape, value = field.metadata.get("shape"), getattr(module, field.name)
        if shape is not None and value is None and type(None) not in get_args(field.type):
            raise ValueError(
                f"`{field.name}` is None where a number belongs; of a model that `eqx.partition` has divided "
                "`eqx.combine` makes one again."
            )
        if shape is not None and value is not None and value.shape != shape:
            raise ValueError(
                f"`{field.name}` must have shape {shape}, got shape {value.shape}; for many models at once jax.vmap "
                "what is done with one."
            )
    for kind in type(module).__mro__:
        if "__check_init__" in vars(kind):
            vars(kind)["__check_init__"](module)
    for part in vars(module).values():
        if isinstance(part, eqx.Module):
            _check_again(part)


def far_from_rotation(orientation, error: float = 0.1) -> Any:
    """Whether RᵀR is not the unit matrix but for an error (0.1 is what `nearest_rotation` mends), or R is a reflection.

    Of NumPy's arrays by NumPy: inside `jit` JAX would trace it.
    """
    xp: Any = np if isinstance(orientation, np.ndarray) else jnp
    x, y, z = (orientation[..., i] for i in range(3))
    dot = lambda a, b: xp.sum(a * b, axis=-1)
    errors = [abs(dot(a, a) - 1.0) for a in (x, y, z)] + [abs(dot(a, b)) for a, b in ((x, y), (y, z), (z, x))]
    handed = dot(xp.cross(x, y), z)
    return ~((xp.max(xp.stack(errors), axis=0) <= error) & (handed > 0.0))  # NaN is far


def is_inertia(inertia) -> Any:
    """Whether E of the formulas above is positive semidefinite but for a tenth of the size of J; along leading axes.

    A thin disc is on the edge: differences and optimizers go beyond it by what they change. Of NumPy's arrays by NumPy.
    """
    xp: Any = np if isinstance(inertia, np.ndarray) else jnp
    size = xp.maximum(xp.max(xp.abs(inertia), axis=(-1, -2)), xp.finfo(inertia.dtype).tiny)
    moments = [inertia[..., i, i] / size for i in range(3)]
    a, b, c = (sum(moments) / 2.0 - moment + 0.1 for moment in moments)
    d, e, f = (inertia[..., i, j] / size for i, j in ((1, 2), (0, 2), (0, 1)))
    determinant = a * (b * c - d * d) - b * e * e - c * f * f - 2.0 * d * e * f
    minors = xp.stack([a, b, c, b * c - d * d, a * c - e * e, a * b - f * f, determinant])
    return xp.min(minors, axis=0) >= 0.0


def are_bodies(mass: Float[Array, " n"], inertia: Float[Array, "n 3 3"], orientation: Float[Array, "n 3 3"]):
    """Whether bodies have such numbers; without derivative."""
    positive, of_bodies, rotations = _sound(*lax.stop_gradient((mass, inertia, orientation)))
    return jnp.all(positive & of_bodies & rotations)


def _sound(mass, inertia, orientation):
    tilted = far_from_rotation(orientation, float(jnp.finfo(orientation.dtype).eps ** 0.5))
    return mass > 0.0, is_inertia(inertia), ~tilted


def invalid_numbers(system: Any) -> list[str]:
    """What `are_bodies` and finiteness find wrong in a `MultibodySystem`, by the names of its elements."""
    found = []
    for i, name in enumerate(system.body_names):
        own = slice(i, i + 1)
        parts = {
            "mass": system.mass[own],
            "inertia": system.inertia[own],
            "pose": tuple(leaf[own] for leaf in system.pose),
        }
        wrong = [part for part, numbers in parts.items() if not all_finite(numbers)]
        if not wrong:
            sound = _sound(system.mass[own], system.inertia[own], system.pose.orientation[own])
            parts = (f"mass {float(system.mass[i]):.6g} kg", "inertia", "orientation, far from a rotation")
            wrong = [part for part, right in zip(parts, sound) if not right[0]]
        found += [f"body {name!r}: {part}" for part in wrong]
    if not all_finite(system.velocity):
        found.append("a velocity, or a velocity, tilt or axis of what `free` leaves out of a body")
    for stack in (*system.constraints, *system.loads):
        for path, leaf in jax.tree_util.tree_leaves_with_path(stack.elements):
            bad = sorted({owner for owner, row in zip(stack.owners, np.asarray(leaf)) if not np.all(np.isfinite(row))})
            found += [f"{owner!r}: {leaf_name(path, type(stack.elements).__name__)}" for owner in bad]
    return found
