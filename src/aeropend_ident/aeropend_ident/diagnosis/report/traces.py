# SPDX-License-Identifier: Apache-2.0
"""The section with the traces: readings of rig and models over the whole recordings, and the errors below them."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.document import DiagnosisDocument
from aeropend_ident.diagnosis.report.drawing import connected, from_top, grid, least_and_greatest, limits, path
from aeropend_ident.diagnosis.report.number_format import Tick, fit_text, quantity, ticks
from aeropend_ident.diagnosis.report.variables import VARIABLES, Variable
from aeropend_ident.signals.signals import Signals
from aeropend_ident.signals.statistics import rms

Array = NDArray[np.float64]

MOST_TRACES = 4
"""Recordings that are drawn in full; of the others, those with a smaller gap, only the angle (choice: a short page)."""

COLUMNS = 800
"""Columns of a trace that is drawn without JavaScript; each shows minimum and maximum (layout)."""

FEWEST_COLUMNS = 300
"""The same at least, where several recordings share the page (layout)."""

ZOOM_VALUES = 250_000
"""Values kept for zooming, over all traces (memory): 2.7 bytes each keep the page below a megabyte."""

FEWEST_HELD_OUT = 10
"""Held-out samples up to which errors are taken from the whole recording instead (choice)."""

REACH = 1.0
"""How far a model may leave the range of the readings to stay in the picture, in ranges (choice)."""


class Packed(TypedDict):
    """Values for the script of the page: `low` + (step + 32767) `scale`, 16 bits a step; -32768 for a missing one."""

    low: float
    scale: float
    data: str


class TraceData(TypedDict):
    """What the script of the page draws: start, end of the fitted part, and end [s], and the lines."""

    start: float
    unseen: float
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
        within: limits of the vertical axis, whatever is drawn.
        ticks: of the vertical axis.
        grid: path of its grid.
    """

    variable: Variable
    kind: str
    label: str
    lines: list[Line]
    within: tuple[float, float]
    ticks: list[Tick]
    grid: str


@dataclass(frozen=True)
class Figure:
    """The traces of one recording.

    Attributes:
        bag: the recording.
        strips: the pictures, from top to bottom.
        ticks: of the time axis.
        unseen: [%] of the way from start to end where the fitted part ends.
        fits: how well the free run of the augmented model fits both parts, in words; "" if nothing is known.
        data: for the script; None if the picture cannot be zoomed.
    """

    bag: str
    strips: list[Strip]
    ticks: list[Tick]
    unseen: float
    fits: str
    data: TraceData | None


@dataclass(frozen=True)
class Traces:
    """The content of the section; `full`: the recordings with the widest gap, `others`: only their angle."""

    full: list[Figure]
    others: list[Figure]


@dataclass(frozen=True)
class _Drawing:
    """A strip before it is drawn: `lines`: name -> (N,) values of the whole recording; the rest as in `Strip`."""

    variable: str
    kind: str
    label: str
    lines: dict[str, Array]
    within: tuple[float, float]


def section(diagnosis: Diagnosis, document: DiagnosisDocument) -> Traces:
    """All recordings, those with the widest gap in full.

    Args:
        diagnosis: the diagnosis.
        document: its document.
    """
    order = sorted(range(len(diagnosis.signals)), key=lambda k: -_width(diagnosis, k, document))
    full, others = sorted(order[:MOST_TRACES]), sorted(order[MOST_TRACES:])
    return Traces([_figure(diagnosis, k, document, len(full)) for k in full],
                  [_angle(diagnosis, k, document) for k in others])


def held_out(s: Signals) -> slice:
    """The samples that nothing was fitted to; all if there are none."""
    return slice(s.train if len(s) - s.train > FEWEST_HELD_OUT else 0, len(s))


def _figure(diagnosis: Diagnosis, k: int, document: DiagnosisDocument, figures: int) -> Figure:
    s = diagnosis.signals[k]
    reach = (-1.0 if s.both_ways else 0.0, 1.0)
    drawings = [_Drawing("duty", "duty", "the duty applied", {"duty": s.duty}, reach)] if s.driven else []
    for channel in document.channels:
        if s.has(channel):
            drawings += _channel(diagnosis, k, channel)
    series: list[Array] = []
    strips = [_strip(drawing, max(COLUMNS // figures, FEWEST_COLUMNS), series) for drawing in drawings]
    most = ZOOM_VALUES // figures // max(len(series), 1)
    return replace(_frame(diagnosis, k, document), strips=strips, data=TraceData(
        start=0.0, unseen=s.train * s.period, stop=len(s) * s.period,
        series=[_packed(least_and_greatest(x, most)) for x in series]))


def _angle(diagnosis: Diagnosis, k: int, document: DiagnosisDocument) -> Figure:
    """The angle of a recording alone."""
    reading, _ = _channel(diagnosis, k, "theta")
    return replace(_frame(diagnosis, k, document), strips=[_strip(reading, FEWEST_COLUMNS, [])])


def _frame(diagnosis: Diagnosis, k: int, document: DiagnosisDocument) -> Figure:
    """A figure without its pictures."""
    s = diagnosis.signals[k]
    return Figure(document.bags[k], [], ticks(0.0, len(s) * s.period, 8), 100.0 * min(s.train / len(s), 1.0),
                  _fits(s, diagnosis.after[k]["theta"]), None)


def _fits(s: Signals, angle: Array) -> str:
    """How well a free run of the angle (N,) fits both parts of a recording, in words."""
    texts = []
    for part, name in ((slice(s.train), "the fitted part"), (slice(s.train, None), "the held-out one")):
        known = np.isfinite(s.theta[part]) & np.isfinite(angle[part])
        if known.sum() > FEWEST_HELD_OUT and (spread := float(np.std(s.theta[part][known]))) > 0.0:
            off = rms(angle[part][known] - s.theta[part][known])
            texts.append(f"{fit_text(1.0 - off / spread)} on {name}")
    return ", ".join(texts)


def _channel(diagnosis: Diagnosis, k: int, channel: str) -> list[_Drawing]:
    """The readings of a channel, and the errors of both models."""
    before, after = diagnosis.before[k][channel], diagnosis.after[k][channel]
    measured, v = diagnosis.signals[k].channel(channel), VARIABLES[channel]
    errors = {"nominal": before - measured, "augmented": after - measured}
    pulses = diagnosis.signals[k].pulses
    if channel == "omega" and pulses is not None and len(pulses.index):  # before, the rig reads no speed
        errors = {name: np.where(np.arange(len(e)) < pulses.index[0], np.nan, e) for name, e in errors.items()}
    part = held_out(diagnosis.signals[k])
    known = [e[part][np.isfinite(e[part])] for e in errors.values()]
    sizes = [quantity(rms(e) if len(e) else math.nan, v.unit) for e in known]
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    room = REACH * (high - low)
    return [_Drawing(channel, "reading", f"{v.name} measured, of the nominal model and of the augmented model",
                     {"measured": measured, "nominal": before, "augmented": after}, (low - room, high + room)),
            _Drawing(channel, "error", f"error of the {v.name}, RMS on held-out data {sizes[0]} of the nominal model "
                                       f"and {sizes[1]} of the augmented model", errors, (-room, room))]


def _strip(drawing: _Drawing, columns: int, series: list[Array]) -> Strip:
    """A strip as it is drawn without JavaScript; its lines are added to `series`."""
    lines = {name: connected(x) for name, x in drawing.lines.items()}
    # a model that runs away does not hide the readings
    low, high = limits([np.clip(x, *drawing.within) for x in lines.values()], around_zero=drawing.kind == "error")
    drawn = [Line(name, len(series) + j, path(np.clip(least_and_greatest(x, 2 * columns), low, high), low, high))
             for j, (name, x) in enumerate(lines.items())]
    series += lines.values()
    marks = from_top(ticks(low, high, 5 if drawing.kind == "error" else 4))
    return Strip(VARIABLES[drawing.variable], drawing.kind, drawing.label, drawn, drawing.within, marks, grid(marks))


def _width(diagnosis: Diagnosis, k: int, document: DiagnosisDocument) -> float:
    """How wide the gap of recording k is: mean square over the channels, each over its gap in all recordings."""
    s, before = diagnosis.signals[k], diagnosis.before[k]
    errors = [((before[c] - s.channel(c)) / max(document.channels[c].gap, 1e-12)) ** 2
              for c in document.channels if s.has(c)]
    known = [float(e[np.isfinite(e)].mean()) if np.isfinite(e).any() else math.inf for e in errors]
    return float(np.mean(known)) if known else 0.0


def _packed(x: Array) -> Packed:
    known = x[np.isfinite(x)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    scale = (high - low) / 65534.0 or 1.0
    steps = np.where(np.isfinite(x), np.rint((np.nan_to_num(x) - low) / scale) - 32767.0, -32768.0)
    return Packed(low=low, scale=scale, data=base64.b64encode(steps.astype("<i2").tobytes()).decode("ascii"))
