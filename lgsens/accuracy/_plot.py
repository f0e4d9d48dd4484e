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
    panels = {}
    for quantity, member in (("Ψ", "value_error"), ("dΨ/dp", "gradient_error")):
        own, series = getattr(table.reference, member), {}
        for row in table:
            if not row.failure:
                cost, error = series.setdefault(row.setting.curve, ([], []))
                cost.append(1e3 * getattr(row, by))
                error.append(max(getattr(row, member), own))
        panels[quantity] = {name: plotting.WorkPrecision(*points) for name, points in series.items()}
    rows = {target: recommend(table, target, by=by).row for target in targets}
    chosen = {target: 1e3 * getattr(row, by) for target, row in rows.items() if row is not None}
    return plotting.work_precision_panels(panels, chosen, title=title)
