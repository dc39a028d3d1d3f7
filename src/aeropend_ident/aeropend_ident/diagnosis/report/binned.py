# SPDX-License-Identifier: Apache-2.0
"""Errors against a variable, in bins: the small pictures of the sections on place and residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.report.drawing import HEIGHT, WIDTH
from aeropend_ident.diagnosis.report.number_format import ends, quantity
from aeropend_ident.diagnosis.report.variables import VARIABLES, Variable
from aeropend_ident.signals.signals import Signals
from aeropend_ident.signals.smoothing import moving_mean

Array = NDArray[np.float64]

AGAINST = ("theta", "theta_dot", "omega", "i_a", "duty", "t")
"""The variables that errors are drawn against: those of the regions."""

BINS = 24
"""Bins of a picture at most (choice: about as many as the eye can separate in a picture of this width)."""

SAMPLES_PER_BIN = 40
"""Samples for one bin in a short recording: both outer 5 % quantiles then have two samples beyond them (choice)."""

FEWEST = 12
"""Samples in a bin below which it is left empty: percentiles of fewer mean little (choice)."""

SMOOTHED = 0.03
"""[s] Width of the two moving means that smooth the angle before its rate is taken (choice)."""


@dataclass(frozen=True)
class Binned:
    """Errors in bins of a variable.

    Attributes:
        edges: (B + 1,) edges of the bins.
        before: (B,) median of the errors of the nominal model; NaN in bins with too few samples.
        low: (B,) 5 % quantile of the errors of the augmented model.
        median: (B,) their median.
        high: (B,) their 95 % quantile.
    """

    edges: Array
    before: Array
    low: Array
    median: Array
    high: Array

    def largest(self) -> float | None:
        """Largest absolute value; None if all bins are empty."""
        lines = np.stack([self.before, self.low, self.median, self.high])
        return float(np.nanmax(np.abs(lines))) if np.isfinite(lines).any() else None


@dataclass(frozen=True)
class Cell:
    """A small picture: errors against one variable.

    Attributes:
        symbol: of the variable.
        unit: of the variable.
        ends: both ends of the horizontal axis, as texts.
        band: path around 90 % of the errors.
        before: path of the median of the nominal model.
        after: path of the median of the augmented model.
        label: what the picture shows, in words.
        ranges: position and width of ranges that are marked.
    """

    symbol: str
    unit: str
    ends: list[str]
    band: str
    before: str
    after: str
    label: str
    ranges: tuple[tuple[float, float], ...] = ()


def variable(s: Signals, name: str) -> Array:
    """A variable of a recording.

    Args:
        s: the recording.
        name: one of `AGAINST`.

    Returns:
        (N,) values.
    """
    if name == "t":
        return s.time
    if name == "duty":
        return s.duty
    if name == "theta_dot":
        width = round(SMOOTHED / s.period)
        return np.gradient(moving_mean(moving_mean(s.theta, width), width), s.period)
    return s.channel(name)


def varies(x: Array) -> bool:
    """Whether errors can be drawn against x (N,)."""
    return bool(np.isfinite(x).sum() > 6 * SAMPLES_PER_BIN and np.nanmax(x) > np.nanmin(x))


def binned(x: Array, before: Array, after: Array) -> Binned:
    """Sort errors into bins of a variable.

    Args:
        x: (N,) the variable.
        before: (N,) errors of the nominal model.
        after: (N,) errors of the augmented model.
    """
    known = np.isfinite(x) & np.isfinite(before) & np.isfinite(after)
    bins = min(max(int(known.sum()) // SAMPLES_PER_BIN, 1), BINS)
    out = np.full((4, bins), np.nan)
    if not known.any():
        return Binned(np.linspace(0.0, 1.0, bins + 1), *out)
    x, before, after = x[known], before[known], after[known]
    low, high = np.percentile(x, [0.5, 99.5])
    edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
    which = np.digitize(x, edges) - 1
    for b in range(bins):
        mine = which == b
        if mine.sum() >= FEWEST:
            out[0, b] = np.median(before[mine])
            out[1:, b] = np.percentile(after[mine], [5.0, 50.0, 95.0])
    return Binned(edges, *out)


def cell(name: str, errors: Binned, reach: float, channel: Variable) -> Cell:
    """Draw errors against a variable.

    Args:
        name: of the variable.
        errors: in bins.
        reach: error at the upper edge.
        channel: whose errors they are.
    """
    against = VARIABLES[name]
    known = np.isfinite(errors.low)
    before, low, median, high = (HEIGHT * (0.5 - 0.5 * line / reach)
                                 for line in (errors.before, errors.low, errors.median, errors.high))
    band = "".join("M" + "L".join(_points(high, a, b) + _points(low, a, b)[::-1]) + "z" for a, b in _runs(known))
    worst = [quantity(float(np.nanmax(np.abs(line))) if known.any() else math.nan, channel.unit)
             for line in (errors.before, errors.median)]
    return Cell(against.symbol, against.unit, ends(float(errors.edges[0]), float(errors.edges[-1])), band,
                _joined(before), _joined(median),
                f"Error of the {channel.name} against {against.name}: its median reaches {worst[0]} with the "
                f"nominal model and {worst[1]} with the augmented model")


def _runs(known: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Begin and end of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _joined(y: Array) -> str:
    """A path that has gaps where y (B,) has."""
    return "".join("M" + "L".join(_points(y, a, b)) for a, b in _runs(np.isfinite(y)))


def _points(y: Array, a: int, b: int) -> list[str]:
    """Points over the middles of bins a..b; a single bin has one at each end."""
    width = WIDTH / len(y)
    if b - a == 1:
        return [f"{width * (a + edge):.0f} {y[a]:.0f}" for edge in (0.0, 1.0)]
    return [f"{width * (k + 0.5):.0f} {y[k]:.0f}" for k in range(a, b)]
