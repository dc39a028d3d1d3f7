# SPDX-License-Identifier: Apache-2.0
"""What has changed since earlier verdicts, as texts: a section of the page, and lines for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from aeropend_ident.diagnosis.document import Change, DiagnosisDocument, Interval, Since
from aeropend_ident.diagnosis.report.number_format import interval, percent, quantity
from aeropend_ident.diagnosis.search.hypotheses import TOGETHER

APPEARED = "was not there"
UNSEEN = "perhaps as before: an effect that was not seen then, and a parameter in its place"


@dataclass(frozen=True)
class ChangeRow:
    """A change as texts: name, value before and after, change, its 95 % interval, and why it is not claimed, if so."""

    name: str
    before: str
    after: str
    change: str
    between: str
    remark: str


@dataclass(frozen=True)
class ChangesSection:
    """The section.

    Attributes:
        verdicts: the earlier verdicts, in words.
        several: whether there are several.
        rows: what has changed, what makes a material share of the gap first.
        unchanged: (name, largest change that the recording allows).
        not_shown: parameters of which the recording does not show it.
        cause: what a person may have done; "" if that is open.
    """

    verdicts: str
    several: bool
    rows: Sequence[ChangeRow]
    unchanged: Sequence[tuple[str, str]]
    not_shown: Sequence[str]
    cause: str


def section(document: DiagnosisDocument) -> ChangesSection | None:
    """The section; None where no earlier verdict was given."""
    since = document.since
    if since is None:
        return None
    rows = [_row(c, c.name in since.perhaps_before) for c in since.by_weight]
    unchanged = [(name, percent(farthest(x))) for name, x in since.unchanged.items()]
    return ChangesSection(since.named, len(since.verdicts) > 1, rows, unchanged, since.not_shown, cause(since))


def farthest(change: Interval) -> float:
    """The largest change within an interval."""
    return max(abs(change.low), abs(change.high))


def _row(c: Change, perhaps_before: bool) -> ChangeRow:
    remark = "" if c.claimed else UNSEEN if perhaps_before else "too small or too unsure to be claimed"
    before = APPEARED if c.before is None else quantity(c.before.value, c.unit, 4)
    after = quantity(c.after.value, c.unit, 4)
    if c.before is None or not c.before.value:
        _, between = interval(c.change.value, c.change.low, c.change.high)
        return ChangeRow(c.name, before, after, quantity(c.change.value, c.unit), between, remark)
    low, high = sorted((c.change.low / c.before.value, c.change.high / c.before.value))
    return ChangeRow(c.name, before, after, percent(c.change.value / c.before.value, sign=True),
                     f"{percent(low, sign=True)} to {percent(high, sign=True)}", remark)


def verdict_line(since: Since, place: str) -> str:
    """The verdict for the terminal."""
    if not since.claimed:
        return f"verdict: nothing has changed since {since.named} that the recording shows"
    return f"verdict: since {since.named}, this has changed: {', '.join(since.claimed)} ({place})"


def lines(since: Since) -> list[str]:
    """What has changed, in lines for the terminal."""
    out = [f"  {'changed' if c.claimed else 'small change'}: {described(c)}" for c in since.by_weight
           if c.name not in since.perhaps_before]
    if cause(since):
        out.append(f"  {cause(since)}")
    if hidden := [described(c) for c in since.changes if c.name in since.perhaps_before]:
        out.append(f"  seen now, but perhaps there before, with a parameter in its place: {'; '.join(hidden)}")
    same = [f"{name} (at most {100.0 * farthest(x):.2g} %)" for name, x in since.unchanged.items()]
    if same:
        out.append(f"  not changed: {', '.join(same)}")
    if since.not_shown:
        out.append(f"  the recording does not show whether these have changed: {', '.join(since.not_shown)}")
    return out


def cause(since: Since) -> str:
    """What a person may have done; "" if nothing is known to change these parameters."""
    return next((text for names, text in TOGETHER.items() if set(names) <= set(since.claimed)), "")


def described(c: Change) -> str:
    """A change in words: `coulomb_friction.accel 0.41 -> 0.83 rad/s²: +102 % (+95 to +109 %)`."""
    unit = "" if c.unit == "-" else f" {c.unit}"
    if c.before is None:
        return f"{c.name} appeared: {c.after.value:.4g} ({c.after.low:.4g} to {c.after.high:.4g}){unit}"
    size, of, digits = (abs(c.before.value) / 100.0, " %", ".1f") if c.before.value else (1.0, unit, ".3g")
    value, low, high = (format(x / size, f"+{digits}") for x in (c.change.value, c.change.low, c.change.high))
    return f"{c.name} {c.before.value:.4g} -> {c.after.value:.4g}{unit}: {value}{of} ({low} to {high}{of})"
