# SPDX-License-Identifier: Apache-2.0
"""The picture beside identified equations, as SVG: held-out derivatives and the free run."""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import escape

import numpy as np

from aeropend_ident.identification.terms import Array

WIDTH, HEIGHT, LEFT, GAP = 1000, 120, 60, 34
POINTS = 1500
"""Greatest number of points of a line. Choice: more than the picture has columns."""

READ, MODELLED = "#888888", "#d62728"


def draw(method: str, states: Sequence[str], first: int, period: float, values: Array, measured: Array,
         modelled: Array, free_run: Array | None) -> str:
    """The picture as text: for every state its derivative, then the state in the free run.

    Args:
        method: name of the method, for the headline.
        states: names of the states.
        first: index of the first sample that is shown.
        period: [s] sample period.
        values: (N, states) the states from the readings.
        measured: (N, states) derivatives from the readings.
        modelled: (N, states) derivatives from the equations.
        free_run: (N, states) the states in the free run; None: there is none.
    """
    last = first + len(values) - 1
    strips = [(f"d({s})/dt", measured[:, k], modelled[:, k]) for k, s in enumerate(states)]
    if free_run is not None:
        strips += [(s, values[:, k], free_run[:, k]) for k, s in enumerate(states)]
    rows = [_strip(title, read, model, LEFT, 40 + j * (HEIGHT + GAP)) for j, (title, read, model) in enumerate(strips)]
    height = 60 + len(strips) * (HEIGHT + GAP)
    head = (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH + LEFT + 20} {height}" '
            f'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="white"/>'
            f'<text x="{LEFT}" y="20">held-out data, '
            f'{first * period:.1f} to {last * period:.1f} s: <tspan fill="{READ}">from the readings</tspan>, '
            f'<tspan fill="{MODELLED}">from the equations ({method})</tspan></text>')
    return "\n".join([head, *rows, "</svg>", ""])


def _strip(title: str, read: Array, model: Array, x: int, y: int) -> str:
    low, high = np.nanpercentile(read, (0.2, 99.8))
    margin = 0.1 * (high - low) or 1.0
    low, high = low - margin, high + margin
    lines = "".join(_line(values, low, high, x, y, colour) for values, colour in ((read, READ), (model, MODELLED)))
    return (f'<g><text x="{x}" y="{y - 4}">{escape(title)}</text>'
            f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" '
            f'fill="none" stroke="#cccccc"/><text x="{x - 6}" y="{y + 10}" text-anchor="end">{high:.3g}</text>'
            f'<text x="{x - 6}" y="{y + HEIGHT}" text-anchor="end">{low:.3g}</text>{lines}</g>')


def _line(values: Array, low: float, high: float, x: int, y: int, colour: str) -> str:
    at = np.unique(np.linspace(0, len(values) - 1, POINTS).astype(int))
    span = high - low
    level = (np.clip(values[at], low - 0.05 * span, high + 0.05 * span) - low) / span  # no overflow
    known = np.isfinite(level)
    across = x + at[known] / max(len(values) - 1, 1) * WIDTH
    points = " ".join(f"{a:.1f},{y + HEIGHT * (1.0 - b):.1f}" for a, b in zip(across, level[known]))
    return f'<polyline fill="none" stroke="{colour}" stroke-width="1" points="{points}"/>'
