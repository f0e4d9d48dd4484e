"""The work-precision figure of a table."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from lgsens import plotting
from lgsens.accuracy._recommend import recommend
from lgsens.accuracy._table import Table, check_by

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    panels, chosen = {}, {target: {} for target, row in found.items() if row is not None}
    for quantity, member in (("Ψ", "value_error"), ("dΨ/dp", "gradient_error")):
        own, series = getattr(table.reference, member), {}
        places = {id(row): (1e3 * getattr(row, by), max(getattr(row, member), own)) for row in table if not row.failure}
        for row in table:
            if not row.failure:
                series.setdefault(row.setting.curve, []).append(places[id(row)])
        panels[quantity] = {name: plotting.WorkPrecision(*zip(*points)) for name, points in series.items()}
        for target in chosen:
            chosen[target][quantity] = places[id(found[target])]
    cost = "time [ms]" if by == "seconds" else "processor time [ms]"
    return plotting.work_precision_panels(panels, chosen, cost=cost, title=title)
