"""Sweeps of the rig: which pads, rack and loads move, how far, and the path that a set of them makes."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_count, as_float, is_concrete
from lgsens.rigs._pads import KINDS, SIDES

PADS = tuple(f"{side}_pad" for side in SIDES)
LOADS = tuple(f"{side}_{kind}" for side in SIDES for kind in KINDS)
RACK = "steering"


class Sweep(NamedTuple):
    """One sweep of the rig: each driven value is its share of one number that goes from −amplitude to +amplitude.

    Attributes:
        amplitude: [m] of pads and rack, [N] of forces, [N m] of aligning moments, shape (), > 0.
        shares: by name the share of each pad ("left_pad", "right_pad"), of the rack ("steering") or load
            ("left_lateral", "left_braking", "left_traction", "left_aligning", …).
    """

    amplitude: float
    shares: Mapping[str, float]

    @property
    def unit(self) -> str:
        """Of its number: "m", "N" or "N m"."""
        name = next(iter(self.shares))
        return "m" if name in (*PADS, RACK) else "N m" if name.endswith("aligning") else "N"


def standard_sweeps(
    *, travel=0.08, roll=0.05, rack=0.06, lateral=3000.0, braking=3000.0, traction=2000.0, aligning=150.0
) -> dict[str, Sweep]:
    """The sweeps of a K&C test by name: "parallel", "opposite", "single", "steering", "lateral", "lateral_opposed", ….

    Arguments:
        travel: of both pads, and of the left one alone in "single" [m].
        roll: of the pads against each other in "opposite" [m], positive with the right one up.
        rack: way of the rack in "steering" [m].
        lateral, braking, traction: forces on each wheel [N]: lateral ones in phase to the left on both, opposed to the
            left on the left wheel; braking ones rearward, traction forward, opposed so on the left wheel only.
        aligning: moments on each wheel [N m], positive to the left, opposed so on the left wheel only.
    """
    left, right = PADS
    sweeps = {
        "parallel": Sweep(travel, {left: 1.0, right: 1.0}),
        "opposite": Sweep(roll, {left: -1.0, right: 1.0}),
        "single": Sweep(travel, {left: 1.0}),
        "steering": Sweep(rack, {RACK: 1.0}),
    }
    for kind, most in {"lateral": lateral, "braking": braking, "traction": traction, "aligning": aligning}.items():
        sweeps[kind] = Sweep(most, {f"left_{kind}": 1.0, f"right_{kind}": 1.0})
        sweeps[f"{kind}_opposed"] = Sweep(most, {f"left_{kind}": 1.0, f"right_{kind}": -1.0})
    return sweeps


class Path(NamedTuple):
    """The points of several sweeps in the order in which they are found: from the middle up, then from there down."""

    values: dict[str, Float[Array, " n"]]
    rates: dict[str, Float[Array, " n"]]  # along the sweep
    starts: tuple[int, ...]
    order: np.ndarray  # where the points of each sweep are, from −amplitude to +amplitude, shape (sweeps, points)


def path(sweeps: Mapping[str, Sweep], points: int, names: tuple[str, ...]) -> Path:
    """The path of `points` for each sweep, with values of all `names`.

    Raises `ValueError` for an even number of points, an amplitude that is not positive, and unknown names.
    """
    count = as_count(points, "points")
    if count < 3 or not count % 2:
        raise ValueError(f"`points` must be odd and at least 3, with the design position in the middle, got {points}.")
    if not sweeps:
        raise ValueError("`sweeps` is empty; give one of `standard_sweeps()` at least.")
    half, columns = count // 2, {name: [] for name in names}
    rates = {name: [] for name in names}
    up = np.arange(half + 1) / half
    way = np.concatenate([up, -up[1:]])
    for title, sweep in sweeps.items():
        most = as_float(sweep.amplitude, (), f"`sweeps[{title!r}].amplitude`")
        if is_concrete(most) and not (float(most) > 0 and np.isfinite(float(most))):
            raise ValueError(f"`sweeps[{title!r}].amplitude` must be positive, got {float(most)}.")
        if unknown := sorted({*sweep.shares} - {*names}):
            more = "; the axle has no rack" if RACK in unknown else ""
            raise ValueError(f"`sweeps[{title!r}].shares`: {unknown} are not among {sorted(names)}{more}.")
        for name in names:
            share = jnp.asarray(sweep.shares.get(name, 0.0), most.dtype)
            columns[name].append(share * most * way)
            rates[name].append(jnp.broadcast_to(share, (count,)))
    first = count * np.arange(len(sweeps))
    starts = tuple(np.stack([first, first + half + 1], axis=1).ravel().tolist())
    within = np.concatenate([np.arange(count - 1, half, -1), np.arange(half + 1)])
    join = lambda table: {name: jnp.concatenate(parts) for name, parts in table.items()}
    return Path(join(columns), join(rates), starts, first[:, None] + within[None, :])
