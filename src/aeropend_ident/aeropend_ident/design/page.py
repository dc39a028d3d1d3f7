# SPDX-License-Identifier: Apache-2.0
"""A designed experiment as one self-contained HTML page with its picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.design.design import Designed
from aeropend_ident.design.responses import Rows, after
from aeropend_ident.diagnosis.report.drawing import HEIGHT, WIDTH, from_top, grid, least_and_greatest, path
from aeropend_ident.diagnosis.report.drawing import limits as axis
from aeropend_ident.diagnosis.report.environment import environment
from aeropend_ident.diagnosis.report.number_format import Tick, ticks

Array = NDArray[np.float64]

POINTS = 1600
"""Points of a line (layout)."""

NAMES = {"duty": ("Duty", ""), "theta": ("Angle of the arm", "rad"), "omega": ("Speed of the rotor", "rad/s"),
         "i_a": ("Current", "A")}


@dataclass(frozen=True)
class Strip:
    """One quantity over time.

    Attributes:
        name: of the quantity.
        unit: of it.
        line: SVG path of the nominal rig.
        band: SVG paths of the least and the greatest value within the uncertainty.
        limits: SVG path of its limits.
        grid: SVG path of its grid.
        ticks: of the vertical axis.
    """

    name: str
    unit: str
    line: str
    band: tuple[str, ...]
    limits: str
    grid: str
    ticks: list[Tick]


def strips(best: Designed, rows: Rows) -> list[Strip]:
    """The duty and the channels, on the nominal rig and within the uncertainty of its numbers.

    Args:
        best: the experiment.
        rows: of the rig.
    """
    signals = after(rows.signals, best.excitation.series())
    base, spread = rows.band(signals)
    found = [_strip("duty", signals.duty, None, best.limits.duty)]
    return found + [_strip(c, base[c], spread[c], best.limits.ranges[c]) for c in ("theta", "omega", "i_a")]


def _strip(name: str, line: Array, spread: Array | None, limit: tuple[float, float]) -> Strip:
    band = [] if spread is None else [line - spread, line + spread]
    shown = [np.array([x for x in limit if math.isfinite(x)])]
    low, high = axis([line, *band, *shown])
    marks = from_top(ticks(low, high, 4))
    at = "".join(f"M0 {HEIGHT * (high - x) / (high - low):.0f}h{WIDTH}" for x in shown[0])
    drawn = [path(least_and_greatest(x, POINTS), low, high) for x in (line, *band)]
    return Strip(*NAMES[name], drawn[0], tuple(drawn[1:]), at, grid(marks), marks)


def render(best: Designed, rows: Rows, command: str, file: str) -> str:
    """Write the page.

    Args:
        best: the experiment.
        rows: of the rig.
        command: the command line that led here.
        file: name of the file of the signal.

    Returns:
        One HTML file that needs nothing else.
    """
    seconds = len(after(rows.signals, best.excitation.series())) * rows.signals.period
    return environment().get_template("design.html.j2").render(
        best=best, strips=strips(best, rows), command=command, file=file, width=WIDTH, height=HEIGHT,
        marks=ticks(0.0, seconds, 8), before={a.of: a for a in best.answers_before})
