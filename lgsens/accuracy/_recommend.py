"""The cheapest setting that is good enough, and why."""

import dataclasses
from typing import Any

import numpy as np

from lgsens.accuracy._table import Row, Table, check_by


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Recommendation:
    """What `recommend` found; printed, a few lines, and true if a setting meets the target.

    Attributes:
        rtol: the target for the errors of Ψ and dΨ/dp.
        row: the cheapest setting that meets it; None if none does.
        cheaper: the most expensive of the settings that cost less; all of them miss the target. None: nothing does.
        margin: the target over the error of the setting, its uncertainty included; 0 if none meets the target.
        reason: the answer in words.
    """

    rtol: float
    row: Row | None
    cheaper: Row | None
    margin: float
    reason: str

    @property
    def setting(self) -> Any:
        """The setting. Raises `ValueError` if none meets the target."""
        if self.row is None:
            raise ValueError(self.reason)
        return self.row.setting

    def __bool__(self) -> bool:
        return self.row is not None

    def __str__(self) -> str:
        return self.reason

    __repr__ = __str__


def recommend(table: Table, rtol: float, *, by: str = "seconds") -> Recommendation:
    """The cheapest setting of a table whose errors of Ψ and of dΨ/dp are at most `rtol`.

        min time over the settings with  error + error of the reference ≤ rtol

    Arguments:
        table: what `work_precision` returned.
        rtol: the target, relative.
        by: the cost: "seconds" of the clock, or "cpu_seconds", which other load on the machine changes less.

    Raises `ValueError` for a target that is not positive.
    """
    check_by(by)
    if not (np.isfinite(rtol) and rtol > 0):
        raise ValueError(f"`rtol` must be positive, got {rtol!r}; 1e-4 for example.")
    own = table.reference.error
    cost = lambda row: getattr(row, by)
    usable = sorted((row for row in table if not row.failure), key=cost)
    meets = [row for row in usable if _error(table, row) <= rtol]
    if not meets:
        return Recommendation(rtol, None, None, 0.0, _why_none(table, usable, rtol, own))
    row = meets[0]
    before = usable[: usable.index(row)]
    cheaper = before[-1] if before else None
    margin = rtol / _error(table, row)
    reason = (
        f"{rtol:.0e}: {row.name}, {1e3 * cost(row):.3g} ms: errors of Ψ and dΨ/dp {row.value_error:.1e} and "
        f"{row.gradient_error:.1e}, {margin:.1f} times better than asked for"
    )
    if cheaper is None:
        reason += "; nothing measured is cheaper."
    else:
        reason += (
            f". Cheaper, but not good enough: {cheaper.name}, {1e3 * cost(cheaper):.3g} ms, with "
            f"{cheaper.value_error:.1e} and {cheaper.gradient_error:.1e}."
        )
    return Recommendation(rtol, row, cheaper, margin, reason)


def _error(table: Table, row: Row) -> float:
    """The larger of the two errors, each with what the reference does not know."""
    own = table.reference
    return max(row.value_error + own.value_error, row.gradient_error + own.gradient_error)


def _why_none(table: Table, usable: list[Row], rtol: float, own: float) -> str:
    start = f"{rtol:.0e}: no setting meets it"
    if own >= rtol:
        return f"{start}, because the reference itself is known to {own:.0e} only; give a better `reference`."
    if not usable:
        return f"{start}: all {len(table)} failed; see the table."
    best = min(usable, key=lambda row: _error(table, row))
    return (
        f"{start}; the best, {best.name}, has errors of Ψ and dΨ/dp {best.value_error:.1e} and "
        f"{best.gradient_error:.1e}. Try more steps, or a route of higher order."
    )
