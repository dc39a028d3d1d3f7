# SPDX-License-Identifier: Apache-2.0
"""What the numbers of a column say about its meaning, whatever its name and unit.

A clock is an even ramp. An arm is a low-pass of second order: its angle moves smoothly, and follows the command. A
command jumps and holds, or comes from a controller; in both cases the angle is predicted much better with it, in an ARX
model (Ljung, System Identification, 4.2), than from its own past alone. Columns that are computed from others (error,
filtered copy, derivative) are recognised by linear regression.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from aeropend_ident.tables.table import Floats

ROWS = 40_000
"""Number of rows that are looked at (choice: minutes at any rate)."""

BLOCKS = 60
"""Least number of blocks of rows for a regression (choice)."""

CYCLE = 10
"""Number of blocks in a cycle of the highest frequency of a column (choice)."""

POWER = 0.95
"""Share of the power below that frequency (choice)."""

LAGS = 4
"""Number of past blocks in the regressions (choice: two more than the order of the arm)."""

HELD, JUMP = 0.8, 0.05
"""Least share of rows that equal the row before, and least size of the other steps as a share of the range, of a column
that jumps and holds (choices)."""

ONE_WAY = 0.8
"""Least ratio of the way from the first to the last number to the sum of all steps of a column that goes one way, as a
temperature or a switch does (choice: it may step back once)."""

ROUGH = 0.9
"""Least ratio of second to first differences of the blocks of a rough column (measured: `make habits ARGS=--weights`;
a sine of `CYCLE` blocks has 0.6, white noise 1.7)."""

NOISY = 0.2
"""Least ratio of second differences of the rows to the standard deviation of a noisy column (measured, likewise)."""

EVEN = 0.02
"""Greatest deviation of a clock from a straight line, as a share of its range (choice)."""

SAME, COPIED, DERIVED = 1.0 - 1e-4, 0.98, 0.9
"""Least coefficient of determination for the same column in another unit, a copy of a column (filtered, or noisy), and
the derivative of a column (choices)."""

NEAR = 0.35
"""Greatest median distance of an angle from its reference, as a share of its standard deviation (choice)."""

STATIC = 0.15
"""Greatest distance of the static gain of a loop from 1 (measured on drawn tables: no command in 650 is that near, and
two references in three are)."""

SLOWEST = 0.98
"""Greatest pole of a low-pass that smooths a column: what is slower integrates (choice: 50 rows)."""

LATE = 1.0
"""[rows] Least delay of a filtered copy (choice: a shorter one may be noise)."""

ADDED = 0.02
"""Greatest deviation of an error from the difference of two columns, as a share of its standard deviation (choice)."""


@dataclass(frozen=True, eq=False)
class Traits:
    """What is seen in one column.

    Attributes:
        x: (N,) its numbers without gaps, at mean 0 and size 1.
        block: number of rows in a block.
        constant, ramp: it never changes; it rises evenly, as a clock.
        holds, rough, noisy: see `HELD`, `ROUGH`, `NOISY`.
        one_way: it holds, and never falls, or never rises.
    """

    x: Floats
    block: int = 1
    constant: bool = False
    ramp: bool = False
    holds: bool = False
    rough: bool = False
    noisy: bool = False
    one_way: bool = False


def traits(values: Floats) -> Traits:
    """What is seen in a column of numbers (N,); NaN if missing."""
    values = values[:ROWS]
    known = np.isfinite(values)
    if known.sum() < 3 or np.ptp(values[known]) == 0.0:
        return Traits(np.zeros(len(values)), constant=True)
    rows = np.arange(len(values))
    filled = values[np.maximum.accumulate(np.where(known, rows, np.flatnonzero(known)[0]))]  # held
    x = (filled - filled.mean()) / filled.std()
    block = _block(x)
    b = blocks(x, block)
    steps = np.abs(np.diff(filled))
    moved = steps[steps > 0.0]
    holds = bool((steps == 0.0).mean() >= HELD and np.median(moved) >= JUMP * np.ptp(filled))
    return Traits(
        x, block, ramp=is_ramp(values[known]), holds=holds,
        one_way=holds and abs(float(filled[-1] - filled[0])) >= ONE_WAY * float(steps.sum()),
        rough=bool(np.std(np.diff(b, 2)) >= ROUGH * np.std(np.diff(b))),
        noisy=bool(np.std(np.diff(x, 2)) >= NOISY))


def is_ramp(x: Floats) -> bool:
    """Whether numbers (N,) rise evenly, as a clock or a counter of rows; it may wrap."""
    if len(x) < 20:
        return False
    steps = np.diff(x)
    if np.median(steps) < 0.0:
        return False
    back = steps < 0.0
    wraps = back & (steps < -0.5 * np.ptp(x))
    if (back & ~wraps).mean() > 0.01 or wraps.mean() > 0.02 or len(np.unique(x)) < 0.1 * len(x):
        return False
    size = float(np.ptp(x)) if wraps.any() else 0.0
    level = x + np.concatenate(([0.0], np.cumsum(wraps))) * (size + float(np.median(steps[~back])))
    rows = np.arange(len(x))
    line = np.polynomial.Polynomial.fit(rows, level, 1)(rows)
    return bool(np.sqrt(np.mean((level - line) ** 2)) <= EVEN * np.ptp(level))


def _block(x: Floats) -> int:
    """Number of rows in a block, by the frequency below which `POWER` of the power is."""
    power = np.abs(np.fft.rfft(x * np.hanning(len(x)))) ** 2
    total = np.cumsum(power)
    highest = (int(np.searchsorted(total, POWER * total[-1])) + 1) / len(x)
    return max(min(int(1.0 / (CYCLE * highest)), len(x) // BLOCKS), 1)


def blocks(x: Floats, block: int) -> Floats:
    """Means of blocks of rows."""
    n = len(x) // block
    return x[: n * block].reshape(n, block).mean(axis=1)


def _lagged(x: Floats, lags: range) -> Floats:
    last = max(lags)
    return np.stack([x[last - k : len(x) - k] for k in lags], axis=1)


def _left(columns: list[Floats], b: Floats) -> float:
    """Mean square of b (N,) that columns (N, K) leave in a linear regression, plus what rounding leaves."""
    a = np.concatenate([*columns, np.ones((len(b), 1))], axis=1)
    rest = b - a @ np.linalg.lstsq(a, b, rcond=None)[0]
    return float(rest @ rest) / len(b) + 1e-9


def gain(y: Traits, u: Traits) -> float:
    """Log of the ratio by which the past of u reduces the mean square error of prediction of y; 0 if by nothing."""
    a, b = blocks(y.x, y.block), blocks(u.x, y.block)
    if len(a) < 4 * LAGS:
        return 0.0
    lags = range(1, LAGS + 1)
    own, other = _lagged(a, lags), [_lagged(b, lags), _lagged(b * b, lags)]
    return max(math.log(_left([own], a[LAGS:]) / _left([own, *other], a[LAGS:])), 0.0)


@dataclass(frozen=True)
class Origin:
    """How a column follows from another.

    Attributes:
        of: the number of the other column.
        how: "same", "mirrored", "filtered", "late" (filtered too, or an angle that follows its reference), "noisy",
            "derivative".
    """

    of: int
    how: str


def origins(seen: list[Traits], candidates: list[int]) -> dict[int, Origin]:
    """The columns that follow from one other.

    Args:
        seen: traits of all columns.
        candidates: numbers of the columns to compare.
    """
    pairs = []
    for place, j in enumerate(candidates):
        for k in candidates[place + 1 :]:
            forth, back = _origin(seen[k], seen[j]), _origin(seen[j], seen[k])
            if max(forth, back)[0] > 0.0:  # of an oscillation, each is a derivative of the other, but one is exact
                pairs.append((forth[0], k, Origin(j, forth[1])) if forth >= back else (back[0], j, Origin(k, back[1])))
    found: dict[int, Origin] = {}
    for _, k, origin in sorted(pairs, key=lambda pair: -pair[0]):
        if k not in found and not (origin.of in found and found[origin.of].of == k):
            found[k] = origin
    return found


def _origin(x: Traits, y: Traits) -> tuple[float, str]:
    """How x follows from y, and the coefficient of determination; 0 and "" if it does not."""
    r = float(np.mean(x.x * y.x))
    if r * r >= SAME:
        return r * r, "same" if r > 0.0 else "mirrored"
    smoothed = _smoothed(x.x, y.x)
    if smoothed >= COPIED:
        return smoothed, "filtered"
    block = max(y.block // 2, 1)
    a, b = blocks(x.x, block), blocks(y.x, block)
    if x.holds or y.holds or len(b) < BLOCKS:
        return 0.0, ""
    middle, rate = b[1:-1], 0.5 * (b[2:] - b[:-2])
    turn = b[2:] - 2.0 * middle + b[:-2]
    inner = a[1:-1]
    total = float(np.var(inner)) or 1.0
    copied = 1.0 - _left([np.stack((middle, rate), 1)], inner) / total
    if r >= 0.7 and copied >= COPIED:
        copy, change, _ = np.linalg.lstsq(np.stack((middle, rate, np.ones_like(rate)), 1), inner, rcond=None)[0]
        late = -block * change / copy  # in rows, by the first terms of Taylor's series
        if abs(late) >= LATE:
            return (copied, "late") if late > 0.0 else (0.0, "")
        noisier = np.std(np.diff(x.x, 2)) > np.std(np.diff(y.x, 2))
        return (copied, "noisy") if noisier else (0.0, "")
    derived = max(1.0 - _left([column[:, None]], inner) / total if float(inner @ column) > 0.0 else 0.0
                  for column in (rate, turn))  # minus the second derivative of a sine is a copy of it
    return (derived, "derivative") if derived >= DERIVED else (0.0, "")


def _smoothed(x: Floats, y: Floats) -> float:
    """Share of the turns of x (N,) that a low-pass of first order of y explains; 0 if it needs another pole.

    A turn is a second difference: first ones are explained by anything that is smooth.
    """
    terms = np.stack((x[:-1], y[1:], np.ones(len(x) - 1)), 1)
    pole, of_y, _ = np.linalg.lstsq(terms, x[1:], rcond=None)[0]
    if not 0.0 < pole <= SLOWEST or of_y <= 0.0:
        return 0.0
    return 1.0 - _left([terms[:, :2]], x[1:]) / (float(np.var(np.diff(x, 2))) or 1.0)


def tracks(y: Floats, r: Floats, block: int) -> bool:
    """Whether y (N,) is led to r: it has its level and size, at the ends of the holds if r jumps and holds.

    A loop with an integral term may be far behind its reference, but its static gain is 1.

    Args:
        y: (N,) numbers, NaN if missing.
        r: likewise.
        block: of the traits of y.
    """
    if _is_led(y, r, block):
        return True
    ends = np.flatnonzero(np.diff(r) != 0.0)
    if 3 <= len(ends) <= (1.0 - HELD) * len(r):
        y, r = y[ends], r[ends]
    known = np.isfinite(y) & np.isfinite(r)
    y, r = y[known], r[known]
    size = float(np.std(y)) if len(y) > 2 else 0.0
    if size == 0.0 or np.std(r) == 0.0:
        return False
    return bool(np.median(np.abs(y - r)) <= NEAR * size and 0.6 <= np.std(r) / size <= 1.6
                and np.corrcoef(y, r)[0, 1] >= 0.6)


def _is_led(y: Floats, r: Floats, block: int) -> bool:
    """Whether the static gain from r to y is 1 and the offset 0, by a linear model of order `LAGS`."""
    a, b = blocks(np.nan_to_num(y), block), blocks(np.nan_to_num(r), block)
    size = float(np.std(b))
    if len(a) < 6 * LAGS or size == 0.0:
        return False
    own, other = _lagged(a, range(1, LAGS + 1)), _lagged(b, range(LAGS + 1))
    terms = np.concatenate([own, other, np.ones((len(own), 1))], axis=1)
    found = np.linalg.lstsq(terms, a[LAGS:], rcond=None)[0]
    rest = 1.0 - float(found[:LAGS].sum())
    gain_, offset = float(found[LAGS:-1].sum()), float(found[-1])
    mean = float(np.mean(b))
    return bool(rest > 0.0 and abs(gain_ / rest - 1.0) <= STATIC
                and abs((gain_ * mean + offset) / rest - mean) <= 2.0 * STATIC * size)


def is_error(x: Floats, y: Floats) -> bool:
    """Whether x (N,) is the distance of y from a reference that jumps and holds, and is not in the table."""
    both, alone = np.abs(np.diff(x + y)), np.abs(np.diff(y))
    moved = alone > 0.0
    return bool(moved.any() and (both[moved] <= 0.1 * alone[moved]).mean() >= HELD
                and np.percentile(both, 100.0 * HELD) <= 0.1 * np.median(alone[moved]))


def differences(columns: dict[int, Floats]) -> list[tuple[int, int, int]]:
    """Triples of columns of which one is the difference of the others, as reference, angle and error.

    Args:
        columns: number of a column -> (N,) its numbers, as in the file, without gaps.
    """
    found = []
    for a, b, c in combinations(columns, 3):
        x, y, z = columns[a], columns[b], columns[c]
        least = min(float(np.std(one)) for one in (x, y, z))
        for rest in (x - y - z, y - x - z, x + y - z):
            if np.abs(rest).max() <= ADDED * least:
                found.append((a, b, c))
                break
    return found
