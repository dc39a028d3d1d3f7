# SPDX-License-Identifier: Apache-2.0
"""The section on the residuals: for each channel the errors on held-out data against each variable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.document import Channel, DiagnosisDocument
from aeropend_ident.diagnosis.report.binned import AGAINST, Array, Cell, binned, cell, variable, varies
from aeropend_ident.diagnosis.report.drawing import HEIGHT
from aeropend_ident.diagnosis.report.number_format import LEAST, MOST, quantity
from aeropend_ident.diagnosis.report.traces import held_out
from aeropend_ident.diagnosis.report.variables import VARIABLES, Variable


@dataclass(frozen=True)
class ResidualRow:
    """The pictures of a channel.

    Attributes:
        variable: the channel.
        reach: error at the edges of the pictures, as text.
        cells: one picture a variable.
        noise_top: upper edge of the band of the noise.
        noise_height: its height.
    """

    variable: Variable
    reach: str
    cells: list[Cell]
    noise_top: float
    noise_height: float


def section(diagnosis: Diagnosis, document: DiagnosisDocument) -> list[ResidualRow]:
    """The content of the section.

    Args:
        diagnosis: the diagnosis.
        document: its document.
    """
    parts = [held_out(s) for s in diagnosis.signals]
    against = {name: np.concatenate([variable(s, name)[p] for s, p in zip(diagnosis.signals, parts, strict=True)])
               for name in AGAINST}
    rows = []
    for name, channel in document.channels.items():
        before, after = (np.concatenate([r[name][p] - s.channel(name)[p]
                                         for r, s, p in zip(readings, diagnosis.signals, parts, strict=True)])
                         for readings in (diagnosis.before, diagnosis.after))
        rows.append(_row(VARIABLES[name], channel, against, before, after))
    return rows


def _row(shown: Variable, channel: Channel, against: dict[str, Array], before: Array, after: Array) -> ResidualRow:
    known = np.isfinite(before) & np.isfinite(after)
    each = {name: binned(x, before, after) for name, x in against.items() if varies(x[known])}
    largest = [x for errors in each.values() if (x := errors.largest()) is not None]
    noise = channel.floor if 0.0 < channel.floor < MOST else 0.0
    reach = 1.15 * max([LEAST, 2.0 * noise, *(x for x in largest if x < MOST)])
    return ResidualRow(shown, quantity(reach, shown.unit, 2), [cell(name, e, reach, shown) for name, e in each.items()],
                       HEIGHT * (0.5 - noise / reach), HEIGHT * 2.0 * noise / reach)
