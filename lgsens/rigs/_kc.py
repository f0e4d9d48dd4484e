"""`kc`: a kinematics and compliance test of an axle."""

from collections.abc import Mapping

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from lgsens._validate import as_float
from lgsens.analysis import Statics, statics
from lgsens.model import Model
from lgsens.rigs._curves import AxleCurves, Vehicle, axle_curves, of_sweep
from lgsens.rigs._pads import SIDES, on_rig, stances
from lgsens.rigs._sweeps import LOADS, PADS, RACK, Sweep, path, standard_sweeps


class KC(eqx.Module):
    """What an axle did on the rig.

    Attributes:
        sweeps: the outputs by the name of the sweep.
        statics: the equilibria of all sweeps, one after the other.
        result: a value of `RESULTS`, shape (), int32; 0 is success.
    """

    sweeps: dict[str, AxleCurves]
    statics: Statics
    result: Int[Array, ""]

    def __repr__(self) -> str:
        points = ", ".join(f"{name} {curves.value.shape[-1]}" for name, curves in self.sweeps.items())
        return f"KC(points of sweeps: {points})"


def kc(
    model: Model,
    centres: Mapping[str, Float[Array, "3"]],
    sweeps: Mapping[str, Sweep] | None = None,
    *,
    points: int = 41,
    vehicle: Vehicle | None = None,
    throw: bool = True,
) -> KC:
    """Kinematics and compliance of an axle: quasi-static equilibria while its wheels are moved, steered and loaded.

    The chassis is held; pads without friction under both wheels prescribe the heights of their contact centres, the
    rack its way, and loads act on the wheels as tyres do (`on_rig`). Springs, bushings, bars and weights balance them.

    Arguments:
        model: the axle, `Axle.model(chassis="held")` or any scene with the bodies `left_wheel` and `right_wheel`, each
            locked to its knuckle, its spin axis y of its frame; the forces `left_spring`, `left_damper`, … for motion
            ratios, the driver `steering` of its rack, if it has them.
        centres: the wheel centres in the reference configuration by side [m], inertial frame, shape (3,), the road at
            z = 0: `Axle.wheel_centres`.
        sweeps: by name; None: all of `standard_sweeps()`, "steering" if there is a rack.
        points: of each sweep, odd, from −amplitude to +amplitude.
        vehicle: the car, for anti-features, Ackermann and the steering ratio, of a file `vehicle_of(axle)`; None:
            `Vehicle()`, a rear axle.
        throw: as in `lgsens.statics`.

    Differentiable by every number of the model, of sweeps and vehicle, exactly, rates included. `AxleCurves` says what
    the outputs are and their signs. Raises `ValueError` for a scene without these wheels, unknown names or amplitudes
    in sweeps, an even number of points, and as `lgsens.statics`.
    """
    steered = RACK in model.joints
    if sweeps is None:
        sweeps = {name: sweep for name, sweep in standard_sweeps().items() if steered or name != RACK}
    if missing := sorted({*SIDES} - {*centres}):
        raise ValueError(f"`centres` must have the wheel centres of {list(SIDES)}, {missing} are missing.")
    places = {side: as_float(centres[side], (3,), f"`centres[{side!r}]`") for side in SIDES}
    moved = (*PADS, RACK) if steered else PADS
    way = path(sweeps, points, (*moved, *LOADS))
    found = statics(
        on_rig(model, places),
        {name: way.values[name] for name in moved},
        loads={name: way.values[name] for name in LOADS},
        rates=[way.rates, *({name: 1.0} for name in moved)],
        starts=way.starts[1:],
        throw=throw,
    )
    order = {name: tuple(rows) for name, rows in zip(sweeps, way.order.tolist())}
    vehicle = Vehicle() if vehicle is None else vehicle
    amplitudes = {name: as_float(sweep.amplitude, (), "`sweeps`") for name, sweep in sweeps.items()}
    shares = {name: tuple(sweep.shares.items()) for name, sweep in sweeps.items()}
    curves = _curves_jit(found, stances(model, places), vehicle, amplitudes, shares, order)
    return KC(curves, found, found.result)


@eqx.filter_jit
def _curves_jit(found: Statics, stances, vehicle: Vehicle, amplitudes, shares, order) -> dict[str, AxleCurves]:
    every = axle_curves(found, stances, vehicle)
    curves = {}
    for name, rows in order.items():
        index = np.asarray(rows)
        own = jax.tree.map(lambda leaf, index=index: leaf[index], every)
        value = amplitudes[name] * np.linspace(-1.0, 1.0, len(rows))
        curves[name] = of_sweep(own._replace(value=value), shares[name], stances, vehicle)
    return curves
