"""Figures and animations: time histories, convergence, errors, sensitivities, suspension curves, mechanisms in space.

Figures are made without pyplot, so they need no display and leave no global state; in a notebook they show themselves,
and `save` writes them. matplotlib is imported when the first figure is made.
"""

from lgsens.plotting._animate import animate as animate
from lgsens.plotting._errors import (
    ErrorPanel as ErrorPanel,
    WorkPrecision as WorkPrecision,
    errors as errors,
    work_precision as work_precision,
    work_precision_panels as work_precision_panels,
)
from lgsens.plotting._kc import kc_curves as kc_curves
from lgsens.plotting._mechanism import mechanism as mechanism
from lgsens.plotting._panels import (
    Panel as Panel,
    convergence as convergence,
    suspension_curves as suspension_curves,
    time_histories as time_histories,
)
from lgsens.plotting._root_locus import root_locus as root_locus
from lgsens.plotting._sensitivities import sensitivities as sensitivities
from lgsens.plotting._style import (
    COLOURS as COLOURS,
    CURVES as CURVES,
    ROLES as ROLES,
    figure as figure,
    save as save,
)
