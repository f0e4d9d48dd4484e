"""Whether a corner moves and stands as that of a car."""

from typing import Any

import jax

from lgsens._validate import is_concrete
from lgsens.examples._leverage import motion_ratios

GRAVITY = 9.81  # m/s²
# How far weight presses springs and tyres of cars [m]: rides of 0.35 Hz, on leaves 0.64 Hz; a tyre is nearly flat.
MOST_COMPRESSION = {"spring": 2.0, "leaf": 0.6, "tyre": 0.2}


def check_corner(car: Any, name: str, bar: Any = None) -> None:
    """Raise `ValueError` for a suspension, called `name`, that does not move as one, springs that cannot bear it, or an
    anti-roll `bar` that does nothing.

    What leaf springs guide moves as they bend; of it, springs are looked at.
    """
    if car.leaf_spring is not None:
        return check_springs(car, name, 1.0)
    struts = {"spring": car.spring, "damper": car.damper}
    with jax.ensure_compile_time_eval():  # of numbers that are known, inside `jit` too
        ratios = motion_ratios(name, car.wheel.centre, car.links, car.joints, struts, bar)
    if ratios:
        check_springs(car, name, ratios["spring"])


def check_springs(car: Any, name: str, ratio: float) -> None:
    """Raise `ValueError` for spring and tyre that cannot bear the car, with this motion ratio of the spring."""
    with jax.ensure_compile_time_eval():
        masses = car.chassis.mass, car.mass
    leaf = car.leaf_spring
    if not is_concrete(masses, car.spring, leaf, car.tyre_stiffness):
        return
    sprung, whole = (GRAVITY * float(mass) for mass in masses)
    needed = sprung / ratio
    bearing = {"tyre": (whole, float(car.tyre_stiffness))}
    if leaf is not None:
        check_leaf_spring(leaf, name, needed)
    elif car.spring.curve is None:
        bearing["spring"] = needed, float(car.spring.rate)
    for key, (load, rate) in bearing.items():
        if not load / rate <= MOST_COMPRESSION[key]:
            raise ValueError(
                f"{name}, key '{key}.stiffness': {rate:g} N/m would be pressed by {load / rate:.3g} m under the "
                f"{load:.0f} N that it bears, and no {key} of a car is by more than {MOST_COMPRESSION[key]:g} m. Rates "
                f"are in SI units whatever 'units' says; did you mean {1e3 * rate:g}?"
            )
    push = None if leaf is not None else car.spring.push()
    if push is None:
        return
    if not needed / 2 <= push <= 2 * needed:
        raise ValueError(
            f"{name}, key 'spring.curve': with this `free_length` it pushes with {push:.0f} N at the design "
            f"position, and must bear about {needed:.0f} N; a preload can make up for half to double of it. Change "
            "`free_length` or the curve, or leave `free_length` out: it is then counted from the design position."
        )


def check_leaf_spring(leaf: Any, name: str, load: float) -> None:
    """Raise `ValueError` for a leaf spring that is pressed further than any is."""
    with jax.ensure_compile_time_eval():
        rate = float(leaf.rate)
    if not load / rate <= MOST_COMPRESSION["leaf"]:
        raise ValueError(
            f"{name}, key 'leaf_spring.thickness': {leaf.leaves} leaves of {float(leaf.section['thickness']):g} m have "
            f"{rate:.3g} N/m and would be pressed by {load / rate:.3g} m under the {load:.0f} N that they bear, and no "
            f"leaf spring of a car is by more than {MOST_COMPRESSION['leaf']:g} m; take more or thicker leaves."
        )
