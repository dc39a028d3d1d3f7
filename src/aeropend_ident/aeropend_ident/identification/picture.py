# SPDX-License-Identifier: Apache-2.0
"""Pictures beside results, as SVG: held-out derivatives and the free run, and bench tests with their curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

import numpy as np

from aeropend_ident.identification.terms import Array

if TYPE_CHECKING:
    from aeropend_ident.bench_tests.estimates import Panel
    from aeropend_ident.identification.identify import Identified

WIDTH, HEIGHT, LEFT, GAP = 1000, 120, 60, 34
POINTS = 1500
"""Points of a line at most."""

SEEN, TOLD = "#888888", "#d62728"


def draw(found: Identified) -> str:
    """The picture as text: for every state its derivative on held-out data, then the state in the free run."""
    d = found.data
    late = slice(d.train, None) if d.train < len(d) else slice(None)
    time = np.arange(len(d))[late] * d.period
    strips = [(f"d({s})/dt", found.derivatives[0][late, k], found.derivatives[1][late, k])
              for k, s in enumerate(d.states)]
    if found.run is not None:
        strips += [(s, d.values[late, k], found.run[late, k]) for k, s in enumerate(d.states)]
    rows = [_strip(title, seen, told, LEFT, 40 + j * (HEIGHT + GAP)) for j, (title, seen, told) in enumerate(strips)]
    height = 60 + len(strips) * (HEIGHT + GAP)
    head = (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH + LEFT + 20} {height}" '
            f'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="white"/>'
            f'<text x="{LEFT}" y="20">held-out data, '
            f'{time[0]:.1f} to {time[-1]:.1f} s: <tspan fill="{SEEN}">from the readings</tspan>, <tspan fill="{TOLD}">'
            f"from the equations ({found.method})</tspan></text>")
    return "\n".join([head, *rows, "</svg>", ""])


def _strip(title: str, seen: Array, told: Array, x: int, y: int) -> str:
    low, high = np.nanpercentile(seen, (0.2, 99.8))
    margin = 0.1 * (high - low) or 1.0
    low, high = low - margin, high + margin
    lines = "".join(_line(values, low, high, x, y, colour) for values, colour in ((seen, SEEN), (told, TOLD)))
    return (f'<g><text x="{x}" y="{y - 4}">{escape(title)}</text>'
            f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" '
            f'fill="none" stroke="#cccccc"/><text x="{x - 6}" y="{y + 10}" text-anchor="end">{high:.3g}</text>'
            f'<text x="{x - 6}" y="{y + HEIGHT}" text-anchor="end">{low:.3g}</text>{lines}</g>')


def _line(values: Array, low: float, high: float, x: int, y: int, colour: str) -> str:
    at = np.unique(np.linspace(0, len(values) - 1, POINTS).astype(int))
    level = np.clip((values[at] - low) / (high - low), -0.05, 1.05)
    known = np.isfinite(level)
    across = x + at[known] / max(len(values) - 1, 1) * WIDTH
    points = " ".join(f"{a:.1f},{y + HEIGHT * (1.0 - b):.1f}" for a, b in zip(across, level[known]))
    return f'<polyline fill="none" stroke="{colour}" stroke-width="1" points="{points}"/>'


def scatter(panels: Sequence[Panel]) -> str:
    """Points with the curves through them as SVG, two panels in a row."""
    width, height, left, top = 420, 260, 80, 40
    rows = -(-len(panels) // 2)
    size = f"{2 * (width + left) + 20} {rows * (height + 90) + 10}"
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" font-family="sans-serif" font-size="12">',
           '<rect width="100%" height="100%" fill="white"/>']
    for k, panel in enumerate(panels):
        x0, y0 = left + (k % 2) * (width + left), top + (k // 2) * (height + 90)
        points = np.linspace(min(0.0, float(panel.x.min())), float(panel.x.max()), 400)
        drawn = panel.curve(points)
        (xl, xh), (yl, yh) = _range(points), _range(np.concatenate([panel.y, drawn[np.isfinite(drawn)]]))

        def at(x: Array, y: Array, x0: int = x0, y0: int = y0, xl: float = xl, xh: float = xh, yl: float = yl,
               yh: float = yh) -> list[tuple[float, float]]:
            across, up = x0 + (x - xl) / (xh - xl) * width, y0 + (yh - y) / (yh - yl) * height
            return [(a, b) for a, b in zip(across.tolist(), up.tolist()) if np.isfinite(a + b)]

        some = np.unique(np.linspace(0, len(panel.x) - 1, POINTS).astype(int))
        dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{3 if len(panel.x) < 100 else 1}" fill="{SEEN}"/>'
                       for a, b in at(panel.x[some], panel.y[some]))
        line = " ".join(f"{a:.1f},{b:.1f}" for a, b in at(points, drawn))
        bottom = y0 + height
        out.append(
            f'<g><text x="{x0}" y="{y0 - 8}"><tspan font-weight="bold">{panel.title}</tspan>: {panel.y_label}</text>'
            f'<rect x="{x0}" y="{y0}" width="{width}" height="{height}" fill="none" stroke="#cccccc"/>{dots}'
            f'<polyline fill="none" stroke="{TOLD}" stroke-width="1.5" points="{line}"/>'
            f'<text x="{x0}" y="{bottom + 16}">{xl:.3g}</text>'
            f'<text x="{x0 + width}" y="{bottom + 16}" text-anchor="end">{xh:.3g}</text>'
            f'<text x="{x0 + width / 2}" y="{bottom + 32}" text-anchor="middle">{panel.x_label}</text>'
            f'<text x="{x0 - 6}" y="{y0 + 10}" text-anchor="end">{yh:.3g}</text>'
            f'<text x="{x0 - 6}" y="{bottom}" text-anchor="end">{yl:.3g}</text></g>')
    return "\n".join([*out, "</svg>", ""])


def _range(values: Array) -> tuple[float, float]:
    low, high = min(float(values.min()), 0.0), float(values.max())
    return (low, high) if high > low else (low, low + 1.0)
