# SPDX-License-Identifier: Apache-2.0
"""Report of a step test: samples on a uniform grid, figures and their limits, a table, a CSV file, a drawing."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich import box
from rich.table import Table

from aeropend_control.analysis.step_response import StepError, StepResponse
from aeropend_control.laws.cascade import REQUIREMENTS
from aeropend_control.laws.tuning import TABLE_6_1
from aeropend_sim.cli.axis import multiples, tick_step
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.untrusted import printable

Array = NDArray[np.float64]

COLUMNS = ("time", "reference", "theta", "omega", "i_a", "v_a", "duty")
UNITS = {"time": "s", "theta": "rad", "omega": "rad/s", "i_a": "A", "v_a": "V", "duty": "-"}


class Limits(NamedTuple):
    """Limits of a step response: times [s], overshoot [share], steady-state error [unit of the response]."""

    rise_time: float
    peak_time: float
    settling_time: float
    overshoot: float
    steady_state_error: float


ANGLE = Limits(*TABLE_6_1, math.radians(0.5))
"""Limits of the laws of the angle: Table 6.1 of the thesis, and a steady-state error of half a degree (choice)."""

LIMITS = {
    "feedback_linearization_cascade": ANGLE._replace(settling_time=1.2, overshoot=0.05),
    "cascade": Limits(*REQUIREMENTS, math.inf)._replace(peak_time=math.inf),  # the thesis has none for it
}
"""Limits of the laws that must do better, or control the rotor's speed."""

MOST_MISSING = 100
"""Greatest ratio of missing samples to samples (choice; it bounds the memory for a wrong stamp)."""

_SHOWN = {  # name: heading, factor, unit, digits
    "rise_time": ("t_r", 1.0, "s", 3),
    "peak_time": ("t_p", 1.0, "s", 3),
    "settling_time": ("t_s", 1.0, "s", 2),
    "overshoot": ("M_p", 100.0, "%", 1),
    "steady_state_error": ("e_ss", 1.0, "", 4),
}


def limits(law: str) -> Limits:
    """Limits of the step responses of a law (its name in `LAWS`)."""
    return LIMITS.get(law, ANGLE)


def on_grid(time: ArrayLike, columns: Mapping[str, ArrayLike], period: float = SAMPLE_PERIOD
            ) -> tuple[Array, dict[str, Array], int]:
    """Put samples on a uniform grid; missing ones are interpolated linearly.

    Args:
        time: [s] (N,) rising.
        columns: (N,) each; NaN where a reading is missing.
        period: [s] of the grid.

    Returns:
        Time [s] (M,), the columns (M,), and the number of missing samples.

    Raises:
        StepError: nearly all samples are missing, or there is one only.
    """
    t = np.asarray(time, dtype=float)
    if len(t) < 2:
        raise StepError("a single sample shows no step response")
    count = round((t[-1] - t[0]) / period) + 1
    if count > MOST_MISSING * len(t):
        raise StepError(f"{count - len(t)} samples are missing beside {len(t)}: a stamp must be wrong")
    grid = t[0] + period * np.arange(count)
    filled = {}
    for name, values in columns.items():
        y = np.asarray(values, dtype=float)
        read = np.isfinite(y)
        filled[name] = np.interp(grid, t[read], y[read]) if read.any() else np.full(count, np.nan)
    return grid, filled, count - len(t)


def missed(step: StepResponse, limit: Limits) -> list[str]:
    """Names of the limits that a response exceeds.

    Args:
        step: the response; a time that it does not reach exceeds the limit.
        limit: the limits.
    """
    out = []
    for name, most in limit._asdict().items():
        value = abs(getattr(step, name))
        no_peak = name == "peak_time" and math.isnan(value)  # no overshoot, so no peak time
        if not (value <= most or no_peak or most == math.inf):
            out.append(name)
    return out


def table(laws: Mapping[str, Sequence[StepResponse]], unit: Mapping[str, str] | None = None) -> Table:
    """Table with a row for each step, and the limits of each law below its steps; ✗ marks a missed limit.

    Args:
        laws: responses by the name of the law.
        unit: unit of each law's reference; rad if missing.
    """
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    shown.add_column("law", overflow="fold")
    for heading in ("to", *(f"{head} / {unit_}" if unit_ else head for head, _, unit_, _ in _SHOWN.values()), ""):
        shown.add_column(heading, justify="right", no_wrap=True)
    for law, steps in laws.items():
        limit, rad = limits(law), (unit or {}).get(law, "rad")
        for number, step in enumerate(steps):
            off = missed(step, limit)
            shown.add_row(law if number == 0 else "", f"{step.reference:g} {rad}",
                          *(_cell(name, getattr(step, name), off) for name in _SHOWN), "✗" if off else "✓")
        shown.add_row("", "at most", *(_cell(name, getattr(limit, name), []) for name in _SHOWN), style="dim",
                      end_section=True)
    return shown


def _cell(name: str, value: float, off: Sequence[str]) -> str:
    _, factor, _, digits = _SHOWN[name]
    text = f"{factor * value:.{digits}f}" if math.isfinite(value) else "-"
    return f"{text} ✗" if name in off else text


def write_csv(path: Path, columns: Mapping[str, Array]) -> None:
    """Write a CSV file with names and units in the first line.

    Args:
        path: of the file.
        columns: (N,) each.
    """
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(f"{name} ({UNITS[name]})" if name in UNITS else name for name in columns)
        writer.writerows([f"{value:.9g}" for value in row] for row in zip(*columns.values(), strict=True))


def draw(time: Array, reference: Array, y: Array, duty: Array, title: str, unit: str) -> str:
    """SVG image of the response with its reference, and the duty below.

    Args:
        time: [s] (N,).
        reference: (N,) in `unit`.
        y: (N,) response, in `unit`.
        duty: [0..1] (N,).
        title: above the image.
        unit: name of the axis of reference and response.
    """
    left, width, panels = 70.0, 800.0, ((40.0, 300.0), (390.0, 120.0))
    thin = slice(None, None, max(1, len(time) // 1000))
    t = time[thin]
    both = np.concatenate([reference, y])
    top = float(np.nanmax(both, initial=0.0))
    bottom = min(0.0, float(np.nanmin(both, initial=0.0)))
    scales = ((bottom, top + 0.05 * (top - bottom or 1.0)), (0.0, 1.0))
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 900 560" font-family="sans-serif" font-size="13">',
        '<rect width="900" height="560" fill="white"/>',
        f'<text x="{left}" y="24" font-size="16">{escape(printable(title))}</text>',
    ]

    def x_at(value: Array | float) -> Array:
        return np.asarray(left + width * (np.asarray(value) - t[0]) / max(t[-1] - t[0], 1e-9))

    def line(values: Array, panel: int, style: str) -> str:
        (at, height), (low, high) = panels[panel], scales[panel]
        y_at = at + height * (1.0 - (values[thin] - low) / (high - low))
        there = np.isfinite(y_at)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x_at(t)[there], y_at[there], strict=True))
        return f'<polyline points="{points}" fill="none" {style}/>'

    for (at, height), (low, high), name in zip(panels, scales, (unit, "duty"), strict=True):
        parts.append(f'<rect x="{left}" y="{at}" width="{width}" height="{height}" fill="none" stroke="#999"/>')
        parts.append(f'<text x="{left + width}" y="{at - 8}" text-anchor="end">{escape(name)}</text>')
        for value in _ticks(low, high):
            y_tick = at + height * (1.0 - (value - low) / (high - low))
            parts.append(f'<path d="M{left} {y_tick:.1f}h{width}" stroke="#ddd"/>'
                         f'<text x="{left - 6}" y="{y_tick + 4:.1f}" text-anchor="end">{value:g}</text>')
    at, height = panels[1]
    parts += [f'<text x="{float(x_at(t[0] + s)):.1f}" y="{at + height + 18}" text-anchor="middle">{s:g}</text>'
              for s in _ticks(0.0, float(t[-1] - t[0]))]
    parts.append(f'<text x="{left + width}" y="{at + height + 36}" text-anchor="end">s</text>')
    parts += [line(reference, 0, 'stroke="#c33" stroke-dasharray="6 4"'), line(y, 0, 'stroke="#136"'),
              line(duty, 1, 'stroke="#136"'), "</svg>"]
    return "\n".join(parts) + "\n"


def _ticks(low: float, high: float) -> list[float]:
    """Three to nine round numbers along an axis."""
    step = tick_step(low, high, 8.0)
    return [round(k * step, 12) for k in multiples(low, high, step)]
