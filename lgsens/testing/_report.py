"""What a check found: rows of an error and its tolerance."""

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple


class Check(NamedTuple):
    """One comparison.

    Attributes:
        name: what was compared, a leaf of the model by its path or a quantity of the element.
        compared: the two ways to it.
        error: their difference.
        tolerance: the largest error that round-off and step explain.
        note: where it is largest, or what else to say.
    """

    name: str
    compared: str
    error: float
    tolerance: float
    note: str = ""

    @property
    def passed(self) -> bool:
        return self.error <= self.tolerance  # false for NaN


class CheckError(AssertionError):
    """A check that failed; `report` has the whole of it."""

    def __init__(self, report: "Report"):
        super().__init__(f"{report.title}: {len(report.failures)} of {len(report.checks)} checks failed.\n{report}")
        self.report = report


@dataclasses.dataclass(frozen=True, repr=False)
class Report:
    """The comparisons of one object; printed, a table. It is true if all of them passed.

    Attributes:
        title: what was checked.
        checks: the comparisons.
    """

    title: str
    checks: tuple[Check, ...]

    @property
    def failures(self) -> tuple[Check, ...]:
        """The comparisons that failed."""
        return tuple(check for check in self.checks if not check.passed)

    @property
    def passed(self) -> bool:
        """Whether every comparison passed."""
        return not self.failures

    def __bool__(self) -> bool:
        return self.passed

    def raise_if_failed(self) -> "Report":
        """The report itself; raises `CheckError`, an `AssertionError` with the table, if a comparison failed."""
        if self.failures:
            raise CheckError(self)
        return self

    def __str__(self) -> str:
        names = max([len(check.name) for check in self.checks], default=0)
        ways = max([len(check.compared) for check in self.checks], default=0)
        lines = [self.title, f"{'':{names}}  {'':{ways}}  {'error':>9}  {'tolerance':>9}"]
        previous = None
        for check in self.checks:
            name = "" if check.name == previous else check.name
            verdict = "ok" if check.passed else "FAILED"
            note = f"  {check.note}" if check.note and not check.passed else ""
            lines.append(
                f"{name:{names}}  {check.compared:{ways}}  {check.error:9.1e}  {check.tolerance:9.1e}  {verdict}{note}"
            )
            previous = check.name
        return "\n".join(lines)

    __repr__ = __str__


def worst(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Of comparisons of the same things, at several poses say, the one that is closest to failing, or beyond."""
    found: dict[tuple[str, str], Check] = {}
    for check in checks:
        key = (check.name, check.compared)
        if key not in found or _excess(check) > _excess(found[key]):
            found[key] = check
    return tuple(found.values())


def _excess(check: Check) -> float:
    if check.tolerance > 0 and check.error == check.error:
        return check.error / check.tolerance
    return 0.0 if check.passed else float("inf")
