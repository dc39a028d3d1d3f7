# SPDX-License-Identifier: Apache-2.0
"""Lines as SVG paths."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.report.number_format import Tick

Array = NDArray[np.float64]

WIDTH, HEIGHT = 1600, 400
"""Size of a drawing in units of its own; the page stretches it (layout)."""

MARGIN = 0.06
"""Space above and below a line, as a share of its height (layout)."""

GAP = 5.0
"""Distance between two readings, in their usual distance, from which they are not connected (choice)."""


def position(share: float) -> float:
    """[%] Place of a share on a bar: within the bar, at its start if it is not known."""
    return 100.0 * min(max(share, 0.0), 1.0) if not math.isnan(share) else 0.0


def limits(lines: Iterable[Array], *, around_zero: bool = False) -> tuple[float, float]:
    """Lower and upper end of an axis.

    Args:
        lines: what is drawn.
        around_zero: whether zero is in the middle.
    """
    values = np.concatenate(list(lines))
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if around_zero:
        high = max(abs(low), abs(high))
        low = -high
    margin = MARGIN * (high - low) or 0.5 * abs(high) or 0.5
    return low - margin, high + margin


def least_and_greatest(x: Array, most: int) -> Array:
    """Fewer values that look the same: minimum and maximum of each stretch, in the order of its ends.

    Args:
        x: (N,) values.
        most: number of values to return at most.
    """
    if len(x) <= most:
        return x
    edges = np.linspace(0, len(x), most // 2 + 1).astype(int)
    low, high = np.fmin.reduceat(x, edges[:-1]), np.fmax.reduceat(x, edges[:-1])
    falling = x[edges[:-1]] > x[edges[1:] - 1]
    return np.column_stack([np.where(falling, high, low), np.where(falling, low, high)]).ravel()


def connected(x: Array) -> Array:
    """The values with straight lines between readings that are some samples apart, as of a slow sensor.

    Args:
        x: (N,) values, NaN between the readings. Longer gaps stay.
    """
    known = np.flatnonzero(np.isfinite(x))
    apart = np.diff(known)
    if len(known) < 2 or np.median(apart) == 1.0:
        return x
    filled = np.interp(np.arange(len(x)), known, x[known], left=np.nan, right=np.nan)
    for k in np.flatnonzero(apart > GAP * np.median(apart)):
        filled[known[k] + 1:known[k + 1]] = np.nan
    return filled


def path(x: Array, low: float, high: float) -> str:
    """An SVG path over the whole width, in whole units relative to the point before; missing values leave gaps.

    Args:
        x: (N,) values at equal distances.
        low: value at the lower edge.
        high: value at the upper edge.
    """
    at = np.rint(np.linspace(0, WIDTH, len(x)) if len(x) > 1 else np.zeros(len(x))).astype(int)
    with np.errstate(invalid="ignore"):
        y = np.rint((high - x) / (high - low) * HEIGHT)
    out: list[str] = []
    last: tuple[int, int] | None = None
    for a, b in zip(at.tolist(), y.tolist(), strict=True):
        if not math.isfinite(b):
            last = None
            continue
        point = (a, int(b))
        out.append(f"M{point[0]} {point[1]}l0 0" if last is None else f" {point[0] - last[0]} {point[1] - last[1]}")
        last = point
    return "".join(out).replace(" -", "-")


def from_top(ticks: Iterable[Tick]) -> list[Tick]:
    """Ticks of a vertical axis: their positions count from the top."""
    return [Tick(100.0 - tick.at, tick.text) for tick in ticks]


def grid(ticks: Iterable[Tick]) -> str:
    """Horizontal lines at the ticks of a vertical axis, as an SVG path."""
    return "".join(f"M0 {HEIGHT * tick.at / 100.0:.0f}h{WIDTH}" for tick in ticks)
