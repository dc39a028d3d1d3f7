# SPDX-License-Identifier: Apache-2.0
"""The section on the gap: how far it closes, channel by channel."""

from __future__ import annotations

from dataclasses import dataclass

from aeropend_ident.diagnosis.document import Closure, DiagnosisDocument
from aeropend_ident.diagnosis.report.number_format import quantity
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
class GapTable:
    """The content of the section; `missing`: names of channels that were not measured."""

    rows: list[ChannelRow]
    total: Closure
    missing: list[str]


def missing(document: DiagnosisDocument) -> list[str]:
    """Names of the channels that were not measured."""
    return [VARIABLES[c].name for c in CHANNELS if c not in document.channels]


def section(document: DiagnosisDocument) -> GapTable:
    """The content of the section."""
    rows = []
    for name, c in document.channels.items():
        v = VARIABLES[name]
        top = max(c.gap, c.gap_after, c.floor, 1e-300)
        label = (f"{v.name}: gap {quantity(c.gap, v.unit)}, after {quantity(c.gap_after, v.unit)}, "
                 f"floor {quantity(c.floor, v.unit)}")
        bars = (100.0 * c.gap / top, 100.0 * c.gap_after / top, 100.0 * c.floor / top)
        rows.append(ChannelRow(v, c.gap, c.gap_after, c.floor, bars, label))
    return GapTable(rows, document.closure, missing(document))
