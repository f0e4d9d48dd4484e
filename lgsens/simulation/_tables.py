"""A motion as tables: named quantities with units, for xarray, pandas and CSV files."""

import csv
import os
from collections.abc import Iterator
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from lgsens._validate import is_concrete, optional
from lgsens.dynamics import RESULTS

_AXES: tuple[str, ...] = ("x", "y", "z")
_UNITS = {  # of a body, of the coordinates of a joint and of what it does
    "position": "m",
    "orientation": "1",
    "velocity": "m/s",
    "angular_velocity": "rad/s",
    "acceleration": "m/s²",
    "angular_acceleration": "rad/s²",
    "force": "N",
    "moment": "N m",
}


Axes = dict[str, tuple[str, ...]]


class Quantity(NamedTuple):
    """What a motion has of an element: values (n, …), the labels of each further axis with its name, and the unit."""

    values: np.ndarray
    axes: Axes
    unit: str | None

    @property
    def columns(self) -> Iterator[tuple[str, np.ndarray]]:
        """Each entry with its labels, ".x.y"."""
        for index in product(*(range(len(labels)) for labels in self.axes.values())):
            labels = (of[i] for of, i in zip(self.axes.values(), index))
            yield "".join(f".{label}" for label in labels), self.values[(slice(None), *index)]


def require_one_motion(run: Any, what: str) -> None:
    """Raise `ValueError` for a motion that is traced or a batch, where one is written or drawn; `what` asks."""
    states, t = run._kinematics()
    if not is_concrete(t, states):
        raise ValueError(f"`{what}`: the motion is traced; return it from `jit`, `grad` or `vmap`, and ask there.")
    if t.ndim != 1:
        raise ValueError(
            f"`{what}`: this is a batch of motions, of shape {t.shape[:-1]}; ask each of them: "
            "jax.tree.map(lambda leaf: leaf[i], trajectories)."
        )


def quantities(run: Any, what: str) -> dict[str, Quantity]:
    """Everything of a motion by name, "top.position"; `what` asks, for messages."""
    require_one_motion(run, what)
    system = run.of_bodies()[0]
    whole = system.whole
    found: dict[str, Quantity] = {}
    vector: Axes = {"axis": _AXES}

    def add(name: str, values, unit: str | None, axes: Axes):
        found[name] = Quantity(np.asarray(values), axes, unit)

    for name, values in run._besides().items():
        add(name, values, None, {})
    for name in whole.body_names:
        for field, values in run.body(name)._asdict().items():
            add(f"{name}.{field}", values, _UNITS[field], vector | {"body_axis": _AXES} if values.ndim == 3 else vector)
    for name, joint in run._joint_motions(system.joints).items():
        for s in system.joints[name].coordinates:
            add(f"{name}.{s.name}", joint.coordinates[s.name], s.unit, {})
            add(f"{name}.{s.name}_rate", joint.rates[s.name], f"{s.unit}/s", {})
            add(f"{name}.{s.name}_acceleration", joint.accelerations[s.name], f"{s.unit}/s²", {})
        for field in ("force", "moment"):
            add(f"{name}.{field}", getattr(joint, field), _UNITS[field], vector)
    for name in dict.fromkeys(whole.constraint_names):
        rows = np.asarray(run.multiplier(name))
        add(f"{name}.multiplier", rows, None, {f"{name}_equation": tuple(str(i + 1) for i in range(rows.shape[1]))})
    for name in system.places_of_states():
        for state, values in run.states_of(name).items():
            add(f"{name}.{state}", values, None, {})
    return found


def to_xarray(run: Any) -> Any:
    """See `AbstractRun.to_xarray`."""
    xarray = optional("xarray", "to_xarray")
    found = quantities(run, "to_xarray")
    attributes = lambda unit: {} if unit is None else {"units": unit}
    axes = {name: labels for quantity in found.values() for name, labels in quantity.axes.items()}
    return xarray.Dataset(
        {name: (("time", *of.axes), of.values, attributes(of.unit)) for name, of in found.items()},
        {"time": ("time", np.asarray(run.t), attributes("s"))} | {name: list(labels) for name, labels in axes.items()},
        {"result": RESULTS(int(run.result)).name},
    )


def to_pandas(run: Any) -> Any:
    """See `AbstractRun.to_pandas`."""
    pandas = optional("pandas", "to_pandas")
    columns, units = {}, {}
    for name, of in quantities(run, "to_pandas").items():
        for labels, values in of.columns:
            columns[name + labels], units[name + labels] = values, of.unit
    table = pandas.DataFrame(columns, index=pandas.Index(np.asarray(run.t), name="time"))
    table.attrs |= {"units": units | {"time": "s"}, "result": RESULTS(int(run.result)).name}
    return table


def to_csv(run: Any, path: str | os.PathLike) -> None:
    """See `AbstractRun.to_csv`."""
    found = quantities(run, "to_csv")
    heads, columns = ["time [s]"], [np.asarray(run.t)]
    for name, of in found.items():
        for labels, values in of.columns:
            heads.append(name + labels + ("" if of.unit is None else f" [{of.unit}]"))
            columns.append(values)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(heads)
        writer.writerows(np.stack(columns, axis=1).tolist())
