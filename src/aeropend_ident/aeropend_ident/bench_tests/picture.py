# SPDX-License-Identifier: Apache-2.0
"""The picture beside the results of bench tests, as SVG: the readings and the fitted curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aeropend_ident.bench_tests.estimates import Panel
from aeropend_ident.identification.terms import Array

WIDTH, HEIGHT, LEFT, TOP, GAP = 420, 260, 80, 40, 90
POINTS = 1500
"""Greatest number of readings in a panel. Choice: more than it has columns of pixels."""

READ, FITTED = "#888888", "#d62728"


def scatter(panels: Sequence[Panel]) -> str:
    """The readings as points with the fitted curves, two panels in a row, as SVG text."""
    rows = -(-len(panels) // 2)
    size = f"{2 * (WIDTH + LEFT) + 20} {rows * (HEIGHT + GAP) + 10}"
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" font-family="sans-serif" font-size="12">',
           '<rect width="100%" height="100%" fill="white"/>']
    out += [_panel(panel, LEFT + (k % 2) * (WIDTH + LEFT), TOP + (k // 2) * (HEIGHT + GAP))
            for k, panel in enumerate(panels)]
    return "\n".join([*out, "</svg>", ""])


def _panel(panel: Panel, x0: int, y0: int) -> str:
    """One panel with its upper left corner at (x0, y0)."""
    points = np.linspace(min(0.0, float(panel.x.min())), float(panel.x.max()), 400)
    drawn = panel.curve(points)
    (xl, xh), (yl, yh) = _range(points), _range(np.concatenate([panel.y, drawn[np.isfinite(drawn)]]))

    def at(x: Array, y: Array) -> list[tuple[float, float]]:
        across, up = x0 + (x - xl) / (xh - xl) * WIDTH, y0 + (yh - y) / (yh - yl) * HEIGHT
        return [(a, b) for a, b in zip(across.tolist(), up.tolist()) if np.isfinite(a + b)]

    some = np.unique(np.linspace(0, len(panel.x) - 1, POINTS).astype(int))
    dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{3 if len(panel.x) < 100 else 1}" fill="{READ}"/>'
                   for a, b in at(panel.x[some], panel.y[some]))
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in at(points, drawn))
    bottom = y0 + HEIGHT
    return (f'<g><text x="{x0}" y="{y0 - 8}"><tspan font-weight="bold">{panel.title}</tspan>: {panel.y_label}</text>'
            f'<rect x="{x0}" y="{y0}" width="{WIDTH}" height="{HEIGHT}" fill="none" stroke="#cccccc"/>{dots}'
            f'<polyline fill="none" stroke="{FITTED}" stroke-width="1.5" points="{line}"/>'
            f'<text x="{x0}" y="{bottom + 16}">{xl:.3g}</text>'
            f'<text x="{x0 + WIDTH}" y="{bottom + 16}" text-anchor="end">{xh:.3g}</text>'
            f'<text x="{x0 + WIDTH / 2}" y="{bottom + 32}" text-anchor="middle">{panel.x_label}</text>'
            f'<text x="{x0 - 6}" y="{y0 + 10}" text-anchor="end">{yh:.3g}</text>'
            f'<text x="{x0 - 6}" y="{bottom}" text-anchor="end">{yl:.3g}</text></g>')


def _range(values: Array) -> tuple[float, float]:
    low, high = min(float(values.min()), 0.0), float(values.max())
    return (low, high) if high > low else (low, low + 1.0)
