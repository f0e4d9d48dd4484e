"""What settings cost and lose: a table, as text, as JSON, as a figure."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from lgsens._brief import brief
from lgsens.accuracy._reference import Reference
from lgsens.accuracy._setting import Setting

SORTS = ("seconds", "cpu_seconds")


@dataclasses.dataclass(frozen=True, eq=False)
class Row:
    """One setting, measured.

    Attributes:
        setting: the setting.
        failure: why there are no numbers; "" where there are.
        seconds, cpu_seconds: time of Ψ and dΨ/dp, of the clock and of the processor, medians [s].
        compile_seconds: time to trace and compile them [s].
        temporary_bytes: what the compiled program takes besides its arguments and results; None if it does not say.
        value: Ψ.
        gradient: dΨ/dp times the scale of p, flat.
        value_error, gradient_error: relative to the reference; the gradient's in the norm max |dΨ/dp_i s_i|.
        violation: max |Φ| over all times [m, –].
        energy_drift: what is missing from the balance of energy at worst, relative; None where nothing moves.
        iterations: Newton's iterations per step, or steps per output interval; None where it is not said.
        unfinished: steps that did not converge or were not reached.
    """

    setting: Setting
    failure: str = ""
    seconds: float = np.nan
    cpu_seconds: float = np.nan
    compile_seconds: float = np.nan
    temporary_bytes: int | None = None
    value: float = np.nan
    gradient: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    value_error: float = np.nan
    gradient_error: float = np.nan
    violation: float = np.nan
    energy_drift: float | None = None
    iterations: float | None = None
    unfinished: int = 0

    __repr__ = brief

    @property
    def error(self) -> float:
        """The larger of the two errors; infinite after a failure."""
        return np.inf if self.failure else max(self.value_error, self.gradient_error)

    @property
    def name(self) -> str:
        """The setting with its number of steps."""
        return f"{self.setting.label}, {self.setting.num_steps} steps"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Table:
    """The settings in the order in which they were given; printed, a table.

    Attributes:
        rows: the settings.
        reference: what errors refer to.
        rounds: over how many rounds the times are medians.
    """

    rows: tuple[Row, ...]
    reference: Reference
    rounds: int

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "Table":
        """The table of a `document`, to be printed, drawn and asked again; settings keep their names only."""
        rows = []
        for entry in document["rows"]:
            names = [field.name for field in dataclasses.fields(Row) if field.name != "setting"]
            optional = ("temporary_bytes", "energy_drift", "iterations")
            given = {name: _number(entry[name], name in optional) for name in names}
            setting = Setting(entry["num_steps"], name=entry["setting"], family=entry["family"])
            rows.append(Row(setting, **given))
        names = [field.name for field in dataclasses.fields(Reference)]
        reference = {name: _number(document["reference"][name]) for name in names}
        reference["evidence"] = tuple(document["reference"]["evidence"])
        return cls(tuple(rows), Reference(**reference), document["rounds"])

    def __iter__(self):
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def is_below_reference(self, row: Row) -> bool:
        """Whether a row is better than the reference can tell."""
        return row.error <= self.reference.error

    def __str__(self) -> str:
        width = max([len(row.setting.label) for row in self.rows], default=0)
        quality = "error of Ψ", "of dΨ/dp", "|Φ|", "energy", "iter."
        heads = "steps", "time [ms]", "CPU [ms]", *quality, "memory", "compile"
        lines = [f"{'':{width}}" + "".join(f"{head:>11}" for head in heads)]
        for row in self.rows:
            start = f"{row.setting.label:{width}}{row.setting.num_steps:>11}"
            if row.failure:
                lines.append(f"{start}  failed: {_short(row.failure)}")
                continue
            errors = (
                f"{'<' * (error <= own)}{max(error, own):.1e}"
                for error, own in (
                    (row.value_error, self.reference.value_error),
                    (row.gradient_error, self.reference.gradient_error),
                )
            )
            cells = (
                *(f"{1e3 * seconds:.4g}" for seconds in (row.seconds, row.cpu_seconds)),
                *errors,
                f"{row.violation:.0e}",
                "–" if row.energy_drift is None else f"{row.energy_drift:.0e}",
                "–" if row.iterations is None else f"{row.iterations:.1f}",
                "–" if row.temporary_bytes is None else f"{row.temporary_bytes / 1e6:.3g} MB",
                f"{row.compile_seconds:.1f} s",
            )
            lines.append(start + "".join(f"{cell:>11}" for cell in cells))
        lines.append(
            f"reference: Ψ = {self.reference.value:.12g}, errors of Ψ and dΨ/dp "
            f"{self.reference.value_error:.0e} and {self.reference.gradient_error:.0e}; errors below are marked <"
        )
        return "\n".join([*lines, *(f"  {sentence}" for sentence in self.reference.evidence)])

    __repr__ = __str__

    def document(self) -> dict[str, Any]:
        """Everything, as JSON takes it; numbers that are not finite are None."""
        reference = {name: _plain(value) for name, value in vars(self.reference).items()}
        return {
            "rounds": self.rounds,
            "norm": "errors of the gradient: max |Δ dΨ/dp_i s_i| over max |dΨ/dp_i s_i|, s the scale of p",
            "reference": reference,
            "rows": [self._entry(row) for row in self.rows],
        }

    def _entry(self, row: Row) -> dict[str, Any]:
        setting = {"setting": row.setting.label, "family": row.setting.curve, "num_steps": row.setting.num_steps}
        numbers = {name: _plain(value) for name, value in vars(row).items() if name != "setting"}
        return setting | numbers | {"below_reference": self.is_below_reference(row)}


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 90 else line[:89] + "…"


def _number(value: Any, optional: bool = False) -> Any:
    """The inverse of `_plain`, where None stands for a number that is not finite unless it is `optional`."""
    if isinstance(value, list):
        return np.array([_number(number) for number in value])
    return np.nan if value is None and not optional else value


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [_plain(number) for number in value.tolist()]
    if isinstance(value, tuple):
        return list(value)
    if isinstance(value, float):
        return float(value) if np.isfinite(value) else None
    return value


def check_by(by: str) -> None:
    if by not in SORTS:
        raise ValueError(f"`by` must be one of {SORTS}, got {by!r}.")
