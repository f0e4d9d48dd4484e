"""The dial between speed and accuracy, measured on a user's own scene and criterion.

    table = lg.accuracy.work_precision(criterion, build, p, t1=1.0)
    print(table, lg.accuracy.recommend(table, 1e-4))
    lg.accuracy.plot(table, targets=(1e-4,))

`error_estimate` says of a single run how far off it is, `certify` how far its value and gradient are, `fidelity` what
of a scene need not be modelled, `doctor` which extremes it comes near to.
"""

from lgsens.accuracy._doctor import Diagnosis as Diagnosis, Finding as Finding, doctor as doctor
from lgsens.accuracy._fidelity import Fidelity as Fidelity, Reduced as Reduced, fidelity as fidelity
from lgsens.accuracy._measure import work_precision as work_precision
from lgsens.accuracy._recommend import Recommendation as Recommendation, plot as plot, recommend as recommend
from lgsens.accuracy._reference import Reference as Reference
from lgsens.accuracy._setting import Setting as Setting, grid as grid, ladder as ladder
from lgsens.accuracy._table import Row as Row, Table as Table
from lgsens.criteria import (
    Certificate as Certificate,
    certify as certify,
    corrected as corrected,
    error_estimate as error_estimate,
)
