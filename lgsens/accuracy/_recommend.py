"""The cheapest setting that is good enough, and why; the figure of all."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lgsens import plotting
from lgsens.accuracy._table import Row, Table, check_by

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


def plot(table: Table, targets: Sequence[float] = (), *, by: str = "seconds", title: str = "") -> "Figure":
    """Error against time, of Ψ and of dΨ/dp side by side, a curve for each family of settings.

    Arguments:
        table: what `work_precision` returned.
        targets: errors for which the recommended settings are marked.
        by: "seconds" or "cpu_seconds".
        title: over the figure.

    A curve connects what is not beaten in both by another setting of its family; the others are pale. Errors below that
    of the reference are drawn there. Raises `ImportError` without matplotlib.
    """
    check_by(by)
    found = {target: recommend(table, target, by=by).row for target in targets}
    panels, marked = {}, {target: {} for target, row in found.items() if row is not None}
    for quantity, member in (("Ψ", "value_error"), ("dΨ/dp", "gradient_error")):
        own, series = getattr(table.reference, member), {}
        places = {id(row): (1e3 * getattr(row, by), max(getattr(row, member), own)) for row in table if not row.failure}
        for row in table:
            if not row.failure:
                series.setdefault(row.setting.curve, []).append(places[id(row)])
        panels[quantity] = {name: plotting.WorkPrecision(*zip(*points)) for name, points in series.items()}
        for target in marked:
            marked[target][quantity] = places[id(found[target])]
    cost = "time [ms]" if by == "seconds" else "processor time [ms]"
    return plotting.work_precision_panels(panels, marked, cost=cost, title=title)
