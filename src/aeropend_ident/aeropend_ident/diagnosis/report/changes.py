# SPDX-License-Identifier: Apache-2.0
"""What has changed since earlier verdicts: a table of before and after, and what is as it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from aeropend_ident.diagnosis.document import Change, DiagnosisDocument, Interval
from aeropend_ident.diagnosis.report.number_format import interval, percent, quantity

APPEARED = "was not there"


@dataclass(frozen=True)
class ChangeRow:
    """A change as texts: name, value before and after, change, and its 95 % interval."""

    name: str
    before: str
    after: str
    change: str
    between: str
    claimed: bool


@dataclass(frozen=True)
class ChangesSection:
    """The section.

    Attributes:
        verdicts: the earlier verdicts.
        rows: what has changed, what makes a material share of the gap first.
        unchanged: (name, largest change that the recording allows).
        not_shown: parameters of which the recording does not show it.
    """

    verdicts: Sequence[str]
    rows: Sequence[ChangeRow]
    unchanged: Sequence[tuple[str, str]]
    not_shown: Sequence[str]


def section(document: DiagnosisDocument) -> ChangesSection | None:
    """The section; None where no earlier verdict was given."""
    since = document.since
    if since is None:
        return None
    rows = [_row(c) for c in sorted(since.changes, key=lambda c: not c.claimed)]
    return ChangesSection(since.verdicts, rows, [(n, percent(farthest(x))) for n, x in since.unchanged.items()],
                          since.not_shown)


def farthest(change: Interval) -> float:
    """The largest change within an interval."""
    return max(abs(change.low), abs(change.high))


def _row(c: Change) -> ChangeRow:
    before = APPEARED if c.before is None else quantity(c.before.value, c.unit, 4)
    after = quantity(c.after.value, c.unit, 4)
    if c.before is None or not c.before.value:
        _, between = interval(c.change.value, c.change.low, c.change.high)
        return ChangeRow(c.name, before, after, quantity(c.change.value, c.unit), between, c.claimed)
    low, high = sorted((c.change.low / c.before.value, c.change.high / c.before.value))
    return ChangeRow(c.name, before, after, percent(c.change.value / c.before.value, sign=True),
                     f"{percent(low, sign=True)} to {percent(high, sign=True)}", c.claimed)
