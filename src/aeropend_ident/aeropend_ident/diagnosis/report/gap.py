# SPDX-License-Identifier: Apache-2.0
"""The sections on the gap: how far it closes, channel by channel, and on test recordings."""

from __future__ import annotations

from dataclasses import dataclass

from aeropend_ident.diagnosis.document import Across, Closure, DiagnosisDocument, GapBudget
from aeropend_ident.diagnosis.policy import MATERIAL_SHARE
from aeropend_ident.diagnosis.report.drawing import position
from aeropend_ident.diagnosis.report.number_format import percent, quantity, sane
from aeropend_ident.diagnosis.report.sentence import between, closing
from aeropend_ident.diagnosis.report.variables import VARIABLES, Variable
from aeropend_ident.signals.signals import CHANNELS


@dataclass(frozen=True)
class ChannelRow:
    """The gap of a channel.

    Attributes:
        variable: the channel.
        gap: of the nominal model.
        gap_after: of the augmented model.
        floor: of the measurement chain.
        bars: [% of the largest] the three of them as they are drawn.
        label: the same in words.
    """

    variable: Variable
    gap: float
    gap_after: float
    floor: float
    bars: tuple[float, float, float]
    label: str


@dataclass(frozen=True)
class BudgetPart:
    """A part of the bar that shows what could be closed; `start` and `width` [% of the bar], `label` in words."""

    start: float
    width: float
    colour: str
    label: str


@dataclass(frozen=True)
class TestRow:
    """The gap on a test recording; `closed` and its interval as texts."""

    bag: str
    gap: float
    gap_after: float
    floor: float
    closed: str
    between: str


@dataclass(frozen=True)
class GapTable:
    """The content of the section.

    Attributes:
        rows: one a channel.
        total: over all channels.
        budget: what could be closed, part by part; empty if nothing is open.
        missing: names of channels that were not measured.
        tests: recordings that no fit has used.
    """

    rows: list[ChannelRow]
    total: Closure
    budget: list[BudgetPart]
    missing: list[str]
    tests: list[TestRow]


def missing(document: DiagnosisDocument) -> list[str]:
    """Names of the channels that were not measured."""
    return [VARIABLES[c].name for c in CHANNELS if c not in document.channels]


def section(document: DiagnosisDocument) -> GapTable:
    """The content of the section."""
    rows = []
    for name, c in document.channels.items():
        v = VARIABLES[name]
        top = max(sane(x) for x in (1e-12, c.gap, c.gap_after, c.floor))
        label = (f"{v.name}: gap {quantity(c.gap, v.unit)}, after {quantity(c.gap_after, v.unit)}, "
                 f"floor {quantity(c.floor, v.unit)}")
        bars = (position(c.gap / top), position(c.gap_after / top), position(c.floor / top))
        rows.append(ChannelRow(v, c.gap, c.gap_after, c.floor, bars, label))
    return GapTable(rows, document.closure, _budget(document.closure.budget), missing(document),
                    [_test(t) for t in document.closure.across])


def _test(t: Across) -> TestRow:
    reached = closing(t)
    closed = {"nothing open": "nothing to close", "none": "none"}.get(reached, percent(t.closed))
    return TestRow(t.bag, t.gap, t.gap_after, t.floor, closed, "" if reached == "none" else between(t))


def _budget(budget: GapBudget | None) -> list[BudgetPart]:
    if budget is None:
        return []
    at = f" ({budget.place})" if budget.place and budget.repeatable >= MATERIAL_SHARE else ""
    parts, start = [], 0.0
    for share, colour, words in ((budget.found, "augmented", "closed"),
                                 (budget.repeatable, "nominal", f"would be closed by a function of duty and state{at}"),
                                 (budget.not_repeatable, "measured", "does not repeat")):
        width = min(position(share), 100.0 - start)
        parts.append(BudgetPart(start, width, colour, f"{percent(share)} {words}"))
        start += width
    return parts
