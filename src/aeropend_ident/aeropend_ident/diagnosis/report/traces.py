# SPDX-License-Identifier: Apache-2.0
"""The section with the traces: readings of rig and models on held-out data, and the errors below them."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.document import DiagnosisDocument
from aeropend_ident.diagnosis.report.drawing import connected, from_top, grid, least_and_greatest, limits, path
from aeropend_ident.diagnosis.report.number_format import Tick, quantity, ticks
from aeropend_ident.diagnosis.report.variables import VARIABLES, Variable
from aeropend_ident.signals.signals import Signals

Array = NDArray[np.float64]

MOST_TRACES = 4
"""Recordings whose traces are drawn at most (choice: more make the page long)."""

COLUMNS = 800
"""Columns of a trace that is drawn without JavaScript; each shows minimum and maximum (layout)."""

FEWEST_COLUMNS = 300
"""The same at least, where several recordings share the page (layout)."""

ZOOM_VALUES = 250_000
"""Values kept for zooming, over all traces (memory): 2.7 bytes each keep the page below a megabyte."""

FEWEST_HELD_OUT = 10
"""Held-out samples up to which the whole recording is drawn instead (choice)."""


class Packed(TypedDict):
    """Values for the script of the page: `low` + (step + 32767) `scale`, 16 bits a step; -32768 for a missing one."""

    low: float
    scale: float
    data: str


class TraceData(TypedDict):
    """What the script of the page draws: start and end [s], and the lines."""

    start: float
    stop: float
    series: list[Packed]


@dataclass(frozen=True)
class Line:
    """A line of a strip: its name, its index among the lines of the figure, and its path."""

    name: str
    index: int
    path: str


@dataclass(frozen=True)
class Strip:
    """One picture of a figure.

    Attributes:
        variable: the variable.
        kind: "duty", "reading" or "error".
        label: what it shows, in words.
        lines: what is drawn.
        ticks: of the vertical axis.
        grid: path of its grid.
    """

    variable: Variable
    kind: str
    label: str
    lines: list[Line]
    ticks: list[Tick]
    grid: str


@dataclass(frozen=True)
class Figure:
    """The traces of one recording.

    Attributes:
        bag: the recording.
        strips: the pictures, from top to bottom.
        ticks: of the time axis.
        data: for the script.
    """

    bag: str
    strips: list[Strip]
    ticks: list[Tick]
    data: TraceData


@dataclass(frozen=True)
class _Drawing:
    """A strip before it is drawn: `lines`: name -> (N,) values of the whole recording."""

    variable: str
    kind: str
    label: str
    lines: dict[str, Array]


def section(diagnosis: Diagnosis, document: DiagnosisDocument) -> list[Figure]:
    """The recordings with the widest gap.

    Args:
        diagnosis: the diagnosis.
        document: its document.
    """
    order = sorted(range(len(diagnosis.signals)), key=lambda k: -_width(diagnosis, k, document))[:MOST_TRACES]
    return [_figure(diagnosis, k, document, len(order)) for k in sorted(order)]


def held_out(s: Signals) -> slice:
    """The samples that nothing was fitted to; all if there are none."""
    return slice(s.train if len(s) - s.train > FEWEST_HELD_OUT else 0, len(s))


def _figure(diagnosis: Diagnosis, k: int, document: DiagnosisDocument, figures: int) -> Figure:
    s = diagnosis.signals[k]
    part = held_out(s)
    start, stop = part.start * s.period, part.stop * s.period
    drawings = [_Drawing("duty", "duty", "the duty applied", {"duty": s.duty})] if s.driven else []
    for channel in document.channels:
        if np.isfinite(s.channel(channel)[part]).any():
            drawings += _channel(diagnosis, k, channel, part)
    series: list[Array] = []
    strips = [_strip(drawing, part, max(COLUMNS // figures, FEWEST_COLUMNS), series) for drawing in drawings]
    most = ZOOM_VALUES // figures // max(len(series), 1)
    data = TraceData(start=start, stop=stop, series=[_packed(least_and_greatest(x, most)) for x in series])
    return Figure(document.bags[k], strips, ticks(start, stop, 8), data)


def _channel(diagnosis: Diagnosis, k: int, channel: str, part: slice) -> list[_Drawing]:
    """The readings of a channel, and the errors of both models."""
    before, after = diagnosis.before[k][channel], diagnosis.after[k][channel]
    measured, v = diagnosis.signals[k].channel(channel), VARIABLES[channel]
    errors = {"nominal": before - measured, "augmented": after - measured}
    rms = [quantity(float(np.sqrt(np.nanmean(e[part] ** 2))), v.unit) for e in errors.values()]
    return [_Drawing(channel, "reading", f"{v.name} measured, of the nominal model and of the augmented model",
                     {"measured": measured, "nominal": before, "augmented": after}),
            _Drawing(channel, "error", f"error of the {v.name}, RMS {rms[0]} of the nominal model and {rms[1]} of the "
                                       "augmented model", errors)]


def _strip(drawing: _Drawing, part: slice, columns: int, series: list[Array]) -> Strip:
    """A strip as it is drawn without JavaScript; its lines are added to `series`."""
    cut = {name: connected(x[part]) for name, x in drawing.lines.items()}
    low, high = limits(cut.values(), around_zero=drawing.kind == "error")
    lines = [Line(name, len(series) + j, path(least_and_greatest(x, 2 * columns), low, high))
             for j, (name, x) in enumerate(cut.items())]
    series += cut.values()
    marks = from_top(ticks(low, high, 5 if drawing.kind == "error" else 4))
    return Strip(VARIABLES[drawing.variable], drawing.kind, drawing.label, lines, marks, grid(marks))


def _width(diagnosis: Diagnosis, k: int, document: DiagnosisDocument) -> float:
    """How wide the gap of recording k is: mean square over the channels, each over its gap in all recordings."""
    s, before = diagnosis.signals[k], diagnosis.before[k]
    errors = [np.nanmean(((before[c] - s.channel(c)) / max(document.channels[c].gap, 1e-12)) ** 2)
              for c in document.channels if s.has(c)]
    return float(np.mean(errors)) if errors else 0.0


def _packed(x: Array) -> Packed:
    known = x[np.isfinite(x)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    scale = (high - low) / 65534.0 or 1.0
    steps = np.where(np.isfinite(x), np.rint((np.nan_to_num(x) - low) / scale) - 32767.0, -32768.0)
    return Packed(low=low, scale=scale, data=base64.b64encode(steps.astype("<i2").tobytes()).decode("ascii"))
