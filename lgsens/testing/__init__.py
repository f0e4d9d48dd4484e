"""Checks for joints, forces and criteria of one's own: their derivatives against independent ones, with a report.

    lg.testing.check_joint(MyJoint(None, "b", at=at)).raise_if_failed()

Tolerances are measured, not guessed: the round-off of a function from its own scatter, the error of a difference
quotient from that and from two orders (`lgsens.testing._differences`).
"""

from lgsens.testing._forces import check_force as check_force
from lgsens.testing._joints import check_joint as check_joint
from lgsens.testing._report import Check as Check, CheckError as CheckError, Report as Report
from lgsens.testing._sensitivities import check_sensitivities as check_sensitivities
