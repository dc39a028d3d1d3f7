# SPDX-License-Identifier: Apache-2.0
"""Times of sampling of the rows of a table, from stamps that may be wrong.

Stamps are times of sampling or of arrival. They may be rounded, repeated, wrapped or set back. If the stamps are not on
a grid, there are two hypotheses:

- even clock: the rows were sampled at a constant rate, and the stamps are times of arrival, which give the rate only.
  If a serial line was the bottleneck, the time between rows depends on the length of the rows.
- stamps: the rows were sampled at their stamps, however irregular these are.

The arm decides: it moves smoothly, so on the true clock its angle is predicted better from the neighbouring samples. If
this is not significant, the stamps decide: times of arrival do not drift away from the even clock.

Irregular rows are put on a grid that is fine enough not to move them. Its other cells have no readings; nothing is
interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.signal import savgol_filter
from scipy.stats import theilslopes

from aeropend_ident.tables.table import Floats, Ints
from aeropend_sim.errors import UserError
from aeropend_sim.wording import counted

CLOCKS = ("auto", "even", "stamps")

WRAPS_OF_COUNTERS = tuple(float(2**bits) for bits in (16, 32))
"""[ticks] Values at which counters wrap."""

WRAPS_OF_CLOCKS = (86400.0, 43200.0, 3600.0, 60.0)
"""[s] Values at which times of day wrap."""

TICKS = (1e-6, 1e-3)
"""[s] Usual ticks of counters of time."""

BLOCKS = 300
"""Number of blocks whose earliest arrivals determine the even clock; all pairs are compared (choice)."""

FEWEST_TO_WRAP = 10
"""Least number of rows between two wraps of a clock (choice)."""

BACK = 1.0
"""[s] A greater step back in time is a restart or a setting of the clock, not a late stamp (choice)."""

WINDOW, BURSTS = 64, 4
"""Numbers of rows, and of bursts of rows, over which delays of arrival average out (choices)."""

CLOSER = 0.85
"""Greatest ratio of the deviations from the clock of a serial line to those from the even clock (choice)."""

SMOOTHED = 128
"""Number of rows to either side for the smoothing of stamps that fit no even clock (choice)."""

ON_GRID = 0.05
"""Share of a period by which a stamp on a grid may deviate from it (choice)."""

MANY = 0.02
"""Share of rows before a gap above which the gaps themselves are in doubt (choice)."""

LOOSE = 0.2
"""Share of a period by which a gap of lost rows may deviate from a whole number of periods (choice)."""

STEADY = 0.1
"""Share of a period by which steps may differ if they add up to at most `ADDED` (choice)."""

ADDED = 5e-3
"""[s] Greatest deviation from the grid that such steps add up to (choice)."""

SURE = 3.0
"""Least difference of the roughness on both clocks, in standard errors, for the angle to decide (choice: 3 sigma)."""

ROUGHER = 1.1
"""Least ratio of the roughness on both clocks for the angle to decide (choice)."""

FINEST = 10
"""Greatest number of cells in a short step (10th percentile) of a grid for irregular rows (choice)."""

SNAPPED = 0.03
"""RMS by which irregular rows may be moved onto such a grid, as a share of a short step (choice)."""

NEGLIGIBLE = 1e-4
"""[s] RMS by which they may be moved in any case (choice)."""

MOST_BACK = 3
"""Greatest number of times that the clock may be set back in a recording (choice)."""

UNFILLED = 1.0
"""[s] A longer time without a row is a gap in the grid, and not a part of it without readings (choice)."""

MOST_SAMPLES = 10_000_000
"""Greatest number of samples on the grid (choice)."""

REPEATED = 0.05
"""Greatest share of rows that are sorted, or left out because they have the stamp of the row before (choice)."""


class ClockError(UserError):
    """The times of the rows cannot be determined; the message is part of a line for the user."""


@dataclass(frozen=True, eq=False)
class Dated:
    """Samples with their times of sampling.

    Attributes:
        time: [s] (M,) rising.
        rows: (M,) row of the table for each sample; -1 without a row.
        period: [s] between the cells of the grid.
        notes: repairs of the stamps, one line each.
    """

    time: Floats
    rows: Ints
    period: float
    notes: tuple[str, ...]

    @property
    def measured(self) -> int:
        """Number of samples with readings."""
        return int((self.rows >= 0).sum())


def at_rate(count: int, rate: float) -> Dated:
    """Times for `count` rows at a rate [Hz] that the user gives."""
    return Dated(np.arange(count) / rate, np.arange(count), 1.0 / rate, ())


def date(time: Floats, angle: Floats, lines: Ints, *, is_clock: bool = False, tick: float = 1.0,
         repeats: NDArray[np.bool_] | None = None, lengths: Ints | None = None, clock: str = "auto") -> Dated:
    """Determine the times of sampling of the rows of a table.

    Args:
        time: [s] (N,) stamps; NaN if missing.
        angle: (N,) of the arm, in any unit; NaN if missing. It decides between the clocks.
        lines: (N,) positions of the rows in the file, for messages.
        is_clock: the stamps are times of day.
        tick: [s] the number 1 of the file.
        repeats: (N,) whether a row is equal to the row before.
        lengths: (N,) number of characters of the rows; None if the file is not text.
        clock: "auto", or "even" or "stamps" by the choice of the user.

    Raises:
        ClockError: the times cannot be determined.
    """
    rows = np.flatnonzero(np.isfinite(time))
    notes = []
    if len(rows) < len(time):
        notes.append(f"{counted(len(time) - len(rows), 'row')} without a time left out")
    if len(rows) < 3:
        raise ClockError(f"{counted(len(rows), 'row')} with a time: too few for a recording, which needs 3 or more")
    t, n = _unwrapped(time[rows], is_clock, tick)
    if n:
        notes.append(f"the clock restarts {n if n > 1 else 'once'}{' times' if n > 1 else ''}: counted on")
    if repeats is not None:
        t, rows = _without_repeats(t, rows, repeats, notes)
    t, rows = _sorted(t, rows, notes)
    back = np.flatnonzero(np.diff(t) < -BACK)
    if len(back):
        k = int(back[0])
        raise ClockError(f"line {lines[rows[k + 1]]}: time goes back from {t[k]:.10g} s to {t[k + 1]:.10g} s (a "
                         "restart, or a clock that was set): split the file there; of evenly spaced rows, leave out "
                         "--time and give --rate HZ")
    if np.ptp(t) == 0.0:
        raise ClockError("all rows have the same time: name another column, or give --rate")
    sent = None if lengths is None else lengths[rows]
    return _dated(t, rows, angle[rows], lines[rows], sent, clock, notes)


def _dated(t: Floats, rows: Ints, angle: Floats, lines: Ints, lengths: Ints | None, clock: str, notes: list[str]
           ) -> Dated:
    grid = None if clock == "stamps" else _grid(t)
    if grid is not None and len(grid.jumps) > MANY * len(t):  # rows lost, or stamps that are too coarse for them?
        even = _even(t, np.arange(len(t), dtype=float))
        if not even.wanders and smoother(angle, even.times, t)[0] < -SURE:
            grid = None
    if grid is not None:
        resolution = _resolution(t)
        if grid.amplitude > 2.0 * ON_GRID * grid.period and resolution:
            notes.append(f"stamps rounded to {_short(resolution)}: put on their grid of {_short(grid.period)}")
        elif grid.amplitude > 0.01 * grid.period:
            notes.append(f"stamps off their grid of {_short(grid.period)} by up to {_short(grid.largest)}: put on it")
        return _on(grid, t, rows, lines, notes)
    if clock == "stamps":
        near = _grid(t)
        if near is None or near.amplitude > ON_GRID * near.period:
            notes.append(f"stamps not evenly spaced ({_pattern(t)}): kept")
        return _on_fine(t, rows, lines, notes)
    even, how = _even(t, np.arange(len(t), dtype=float)), "an even clock"
    wanders = False
    if clock == "auto":
        even, how, wanders = _paced(t, lengths, even) or (even, how, False)
        if even.wanders:
            even, how, wanders = _smoothed(t), "their smooth mean", True
    if clock == "auto" and (np.diff(t) > 0.0).all():
        says, factor = smoother(angle, even.times, t)
        sure = abs(says) > SURE and abs(math.log(factor)) > math.log(ROUGHER)
        if (sure and says > 0.0) or (wanders and not sure):
            why = f"the angle is {factor:.2g} times rougher on {how}" if sure else "they leave every even clock"
            notes.append(f"stamps not evenly spaced ({_pattern(t)}): kept ({why})")
            return _on_fine(t, rows, lines, notes)
        why = (f"the angle is {1.0 / factor:.2g} times rougher on the stamps" if sure else
               "the stamps stay close to it, and the angle does not tell")
    else:
        why = "as you say" if clock == "even" else "stamps that repeat or go back are of arrival"
    if even.largest > 0.01 * even.period:
        notes.append(f"stamps off by up to {_short(even.largest)} ({_pattern(t)}): rows put on {how}, "
                     f"{_short(even.period)} a row ({why})")
    if wanders and clock == "auto":
        _tell_jumps(even, lines, notes)
        return _on_fine(even.times + float(t[0] - even.off[0]), rows, lines, notes)
    return _on(even, t, rows, lines, notes)


# Stamps that restart, repeat, or are out of order


def _unwrapped(t: Floats, is_clock: bool, tick: float) -> tuple[Floats, int]:
    """Unwrap a clock, which wraps at known values. Returns the times and the number of wraps."""
    steps = np.diff(t)
    ahead = steps[steps > 0.0]
    if not len(ahead) or not (steps < 0.0).any():
        return t, 0
    wraps = sorted(WRAPS_OF_CLOCKS if is_clock else {w * size for w in WRAPS_OF_COUNTERS for size in (*TICKS, tick)})
    longest = max(3.0 * float(np.percentile(ahead, 99)), 2.0 * float(np.median(ahead)))
    count = 0
    wraps = [wrap for wrap in wraps if wrap > FEWEST_TO_WRAP * float(np.median(ahead))]
    for k in np.flatnonzero(steps < 0.0):
        for wrap in wraps:
            if 0.0 <= steps[k] + wrap <= min(longest, 0.5 * wrap):
                steps[k] += wrap
                count += 1
                break
    return (np.concatenate(([t[0]], t[0] + np.cumsum(steps))), count) if count else (t, 0)


def _without_repeats(t: Floats, rows: Ints, repeats: NDArray[np.bool_], notes: list[str]) -> tuple[Floats, Ints]:
    """Leave out rows that are equal to the row before, if only such rows have repeated stamps."""
    same = np.concatenate(([False], np.diff(t) == 0.0))
    if not same.any() or not repeats[rows][same].all():
        return t, rows
    notes.append(f"{counted(int(same.sum()), 'row')} repeating the row before left out")
    return t[~same], rows[~same]


def _sorted(t: Floats, rows: Ints, notes: list[str]) -> tuple[Floats, Ints]:
    """Sort the rows by their stamps if the sorted stamps are on a grid."""
    if not (np.diff(t) < 0.0).any():
        return t, rows
    order = np.argsort(t, kind="stable")
    back = np.diff(t) < 0.0
    if not (back.all() or back.mean() <= REPEATED) or (grid := _grid(t[order])) is None:
        return t, rows
    if not back.all() and np.max(grid.steps, initial=0.0) > max(BACK, -0.5 * float(np.diff(t).min())):
        return t, rows  # the clock was set: what came first would be put behind what came later
    notes.append(f"{counted(int((np.diff(t) < 0.0).sum()), 'row')} out of order: rows sorted by their time")
    return t[order], rows[order]


# Rows on a grid


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cells of rows on an even clock.

    Attributes:
        cells: [periods] (N,) rising; whole numbers if the clock is even.
        period: [s] of the clock.
        off: [s] (N,) stamps minus times of their cells.
        jumps: (K,) rows before a gap or a step back of the clock.
        steps: [s] (K,) sizes of these gaps and steps.
        wanders: the stamps drift away from the even clock.
    """

    cells: Floats
    period: float
    off: Floats
    jumps: Ints
    steps: Floats
    wanders: bool = False

    @property
    def times(self) -> Floats:
        return self.period * self.cells

    @property
    def amplitude(self) -> float:
        return float(np.ptp(self.off))

    @property
    def largest(self) -> float:
        return float(np.abs(self.off - np.median(self.off)).max())


def _grid(t: Floats) -> _Grid | None:
    """The grid of stamps (N,) [s]; None if they are not on a grid."""
    steps = np.diff(t)
    if (steps <= 0.0).any():
        return None
    period = float(steps[steps < 1.75 * np.median(steps)].mean())
    for _ in range(4):
        cells = np.concatenate(([0], np.cumsum(np.maximum(np.rint(steps / period), 1.0)))).astype(np.int64)
        jumps = np.flatnonzero(np.diff(cells) > 1)
        part = np.searchsorted(jumps, np.arange(len(t)) - 1, side="right")
        period = _slope(cells, t, part) or period
    level = np.bincount(part, t - period * cells) / np.bincount(part)
    off = t - period * cells - level[part]
    shift = (level - level[0]) / period  # a pause need not be a whole number of periods
    resolution = _resolution(t)
    rounded = 0.6 * resolution if resolution <= 0.5 * period else 0.0
    loose = np.abs(np.diff(shift) - np.rint(np.diff(shift))) > min(LOOSE + rounded / period, 0.45)
    if loose.sum() > max(3, 0.01 * len(t)):
        return None
    if len(jumps) > MANY * len(t) and cells[-1] + shift[-1] > 2 * len(t):  # bursts
        return None
    cells = cells + np.rint(shift)[part].astype(np.int64)
    if not loose.any():
        period = _slope(cells, t, np.zeros_like(part))
        off = t - period * cells
        off -= off.mean()
    steady = bool((np.abs(steps / period - np.diff(cells)) <= STEADY + rounded / period).all())
    largest = float(np.abs(off).max())
    if largest > max(ON_GRID * period, rounded) and not (steady and largest <= max(0.5 * period, ADDED)):
        return None
    return _Grid(cells.astype(float), period, off, jumps, (np.diff(cells)[jumps] - 1) * period)


def _slope(x: Ints, y: Floats, part: Ints) -> float:
    """Least squares slope of y over x, with an offset for each part."""
    count = np.bincount(part)
    dx = x - (np.bincount(part, x) / count)[part]
    dy = y - (np.bincount(part, y) / count)[part]
    power = float(dx @ dx)
    return float(dx @ dy) / power if power > 0.0 else 0.0


def _even(t: Floats, index: Floats) -> _Grid:
    """The even clock that rows are taken by whose stamps are late, rounded or repeated.

    Args:
        t: (N,) stamps, s.
        index: (N,) how far the clock has come at each row, rising by 1 a row in the mean.
    """
    n = len(t)
    steps = np.diff(t)
    late = steps > 2.0 * (t[-1] - t[0]) / (n - 1)
    bursts = int(late.sum()) if steps[late].sum() > 0.5 * (t[-1] - t[0]) else n  # then time passes between them
    window = max(min(max(WINDOW, BURSTS * n // max(bursts, BURSTS)), n // 3), 2)
    period = float(np.median((t[window:] - t[:-window]) / (index[window:] - index[:-window])))
    if period <= 0.0:
        period = float(t[-1] - t[0]) / (n - 1)
    jumps, sizes = np.empty(0, dtype=np.int64), np.empty(0)
    for _ in range(3):
        late = t - period * index
        jumps, sizes = _jumps(late, period, window)
        part = np.searchsorted(jumps, np.arange(n) - 1, side="right")
        closed = t - np.concatenate(([0.0], np.cumsum(sizes)))[part]
        earliest = closed - period * index
        block = max(window, n // BLOCKS)
        blocks = [slice(k, k + block) for k in range(0, n - block + 1, block)]
        first = [b.start + int(np.argmin(earliest[b])) for b in blocks]
        if len(first) > 2:
            period = float(theilslopes(closed[first], index[first])[0])
    if period <= 0.0 or np.ptp(closed - period * index) > 0.5 * np.ptp(t):
        raise ClockError("the times go back and forth: the rows cannot be dated; name another column, or give --rate "
                         "if they are evenly spaced")
    missing = np.maximum(np.rint(sizes / period), 0.0)
    cells = index + np.concatenate(([0.0], np.cumsum(missing)))[part]
    rest = closed - period * index
    low = np.array([rest[b].min() for b in blocks]) if blocks else rest
    spread = np.median([np.ptp(rest[b]) for b in blocks]) if blocks else 0.0
    wanders = bool(np.ptp(low) > 1.5 * spread + period)
    return _Grid(cells, period, rest, jumps, np.where(sizes < 0.0, sizes, missing * period), wanders)


def _jumps(late: Floats, period: float, window: int) -> tuple[Ints, Floats]:
    """Permanent steps of the lateness [s] (N,): the rows before them, and their sizes [s].

    A delay of arrival is temporary. Rows are missing only if all rows after a step are later than all rows before it.
    """
    n = len(late)
    ahead, behind = _extremes(late, window)
    up, down = ahead[0][1:] - behind[1][:-1], behind[0][:-1] - ahead[1][1:]
    spread = float(np.median(behind[1] - behind[0]))
    near_end = np.minimum(np.arange(1, n), n - np.arange(1, n)) < window // 2
    least = 0.5 * period + spread * near_end
    at = np.flatnonzero((up > least) | (down > least))
    edges = np.concatenate(([0], at + 1, [n]))
    sizes = []
    for k in range(len(at)):
        before = late[max(edges[k], edges[k + 1] - window) : edges[k + 1]]
        after = late[edges[k + 1] : min(edges[k + 2], edges[k + 1] + window)]
        sizes.append(float(after.min() - before.min()))
    return at, np.array(sizes)


def _extremes(x: Floats, window: int) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Least and greatest of the `window` values from each value on, and up to each value."""
    half = window // 2
    ahead, behind = ((minimum_filter1d(x, window, mode="nearest", origin=origin),
                      maximum_filter1d(x, window, mode="nearest", origin=origin))
                     for origin in (-half, half - (window % 2 == 0)))
    return ahead, behind


def _on(grid: _Grid, t: Floats, rows: Ints, lines: Ints, notes: list[str]) -> Dated:
    """Put rows on the cells of a grid, with notes on its gaps."""
    _tell_jumps(grid, lines, notes)
    return Dated(float(t[0]) + grid.times, rows, grid.period, tuple(notes))


def _tell_jumps(grid: _Grid, lines: Ints, notes: list[str]) -> None:
    gaps = grid.steps > 0.0
    if gaps.any():
        missing = int(np.rint(grid.steps[gaps].sum() / grid.period))
        notes.append(f"{counted(int(gaps.sum()), 'gap')}, {counted(missing, 'row')} missing, first after line "
                     f"{lines[grid.jumps[gaps][0]]}: left open")
    back = grid.steps < 0.0
    if back.sum() > MOST_BACK:
        raise ClockError(f"time goes back for good {int(back.sum())} times, first after line "
                         f"{lines[grid.jumps[back][0]]}: the rows cannot be dated; give --rate if they are evenly "
                         "spaced")
    for row, size in zip(grid.jumps[back], grid.steps[back]):
        notes.append(f"the clock was set back by {_short(-size)} after line {lines[row]}: counted on")


# Which clock is true


def _paced(t: Floats, lengths: Ints | None, even: _Grid) -> tuple[_Grid, str, bool] | None:
    """The clock of a serial line, whose time for a row depends on the row's length; None if it does not fit better."""
    if lengths is None or np.ptp(lengths) == 0:
        return None
    n = np.arange(len(t), dtype=float)
    sent = np.cumsum(lengths - lengths.mean())  # what comes before a stamp has been sent
    (_, row, character), *_ = np.linalg.lstsq(np.stack((np.ones_like(n), n, sent), axis=1), t, rcond=None)
    index = n + character / row * sent if row > 0.0 else n
    if character <= 0.0 or (np.diff(index) <= 0.0).any():
        return None
    paced = _even(t, index)
    if paced.wanders or paced.off.std() > CLOSER * even.off.std():
        return None
    how = f"the clock of a serial line that takes {_short(character)} a character ({10.0 / character:.0f} baud)"
    return paced, how, True


def _smoothed(t: Floats) -> _Grid:
    """The clock of rows at a varying rate: the smoothed stamps.

    Raises:
        ClockError: the smoothed stamps do not rise.
    """
    width = min(2 * SMOOTHED + 1, (len(t) - 1) // 2 * 2 - 1)
    times = savgol_filter(t, width, 1)
    if (np.diff(times) <= 0.0).any():
        raise ClockError("the stamps fit no clock, even or smooth: the rows cannot be dated; give --rate if they are "
                         "evenly spaced")
    period, none = float(np.median(np.diff(times))), np.empty(0)
    return _Grid((times - times[0]) / period, period, t - times, none.astype(np.int64), none)


def smoother(angle: Floats, first: Floats, second: Floats) -> tuple[float, float]:
    """Whether readings are smoother over the second clock than over the first.

    Each reading is predicted by the cubic through two neighbours on either side. The error is divided by its standard
    deviation for white noise.

    Args:
        angle: (N,) readings.
        first: [s] (N,) times by the first clock.
        second: [s] (N,) times by the second clock.

    Returns:
        The difference of the log errors in standard errors (positive: the second clock is smoother), and the ratio of
        the RMS errors, first to second.
    """
    known = np.flatnonzero(np.isfinite(angle))
    if len(known) < 40 or np.ptp(angle[known]) == 0.0:
        return 0.0, 1.0
    y = angle[known]
    errors = [_prediction_errors(y, clock[known]) for clock in (first, second)]
    scale = float(np.median(np.minimum(*np.abs(errors)))) + 1e-6 * float(np.ptp(y))
    logs = np.log((errors[0] ** 2 + scale**2) / (errors[1] ** 2 + scale**2))
    blocks = logs[: len(logs) // 16 * 16].reshape(-1, 16).mean(axis=1) if len(logs) >= 160 else logs
    error = float(blocks.std(ddof=1)) / math.sqrt(len(blocks))
    factor = math.sqrt(float(np.mean(errors[0] ** 2)) / max(float(np.mean(errors[1] ** 2)), 1e-300))
    return (float(blocks.mean()) / error if error > 0.0 else 0.0), factor


def _prediction_errors(y: Floats, x: Floats) -> Floats:
    """Errors (N - 4,) of the cubic through two neighbours on either side, divided by those of white noise of SD 1."""
    at = np.stack([x[k : len(x) - 4 + k] for k in (0, 1, 3, 4)])
    values = np.stack([y[k : len(y) - 4 + k] for k in (0, 1, 3, 4)])
    centre = x[2:-2]
    weights = np.ones_like(at)
    for j in range(4):
        for m in range(4):
            if m != j:
                weights[j] *= (centre - at[m]) / (at[j] - at[m])
    return np.asarray((y[2:-2] - (weights * values).sum(axis=0)) / np.sqrt(1.0 + (weights**2).sum(axis=0)))


# Irregular rows


def _on_fine(t: Floats, rows: Ints, lines: Ints, notes: list[str]) -> Dated:
    """Put irregular rows on a grid that is fine enough not to move them."""
    back = np.diff(t) < 0.0
    if back.any():
        raise ClockError(f"{counted(int(back.sum()), 'row')} with a time before that of the row before: the stamps "
                         "cannot be right; leave --clock stamps away")
    again = np.concatenate(([False], np.diff(t) == 0.0))
    if again.any():
        if again.mean() > REPEATED:
            raise ClockError(f"{counted(int(again.sum()), 'row')} with the time of the row before: the stamps cannot "
                             "be right; leave --clock stamps away")
        notes.append(f"{counted(int(again.sum()), 'row')} with the time of the row before left out")
        t, rows, lines = t[~again], rows[~again], lines[~again]
    steps = np.diff(t)
    short = float(np.percentile(steps, 10))
    for k in range(1, FINEST + 1):
        period = short / k
        cells = np.rint((t - t[0]) / period).astype(np.int64)
        moved = float(np.sqrt(np.mean((t - t[0] - period * cells) ** 2)))
        if moved <= max(SNAPPED * short, NEGLIGIBLE):
            break
    start = float(t[0])
    double = np.concatenate(([False], np.diff(cells) == 0))
    if double.any():
        notes.append(f"{counted(int(double.sum()), 'row')} less than {_short(0.5 * period)} after another left out")
        rows, lines, cells = rows[~double], lines[~double], cells[~double]
    notes.append(f"rows that are not evenly spaced: on a grid of {_short(period)}, with nothing measured in between")
    wide = np.flatnonzero(np.diff(cells) * period > UNFILLED)
    if len(wide):
        notes.append(f"{counted(len(wide), 'gap')} of more than {UNFILLED:g} s, first after line {lines[wide[0]]}: "
                     "left open")
    if (int(cells[-1]) - int(np.diff(cells)[wide].sum())) > MOST_SAMPLES:
        raise ClockError(f"the stamps need a grid of {_short(period)}, more than {MOST_SAMPLES // 10**6} million "
                         "samples: split the file")
    starts, stops = np.concatenate(([0], wide + 1)), np.concatenate((wide, [len(cells) - 1]))
    filled = np.concatenate([np.arange(cells[a], cells[b] + 1) for a, b in zip(starts, stops)])
    of_row = np.full(len(filled), -1, dtype=np.int64)
    of_row[np.searchsorted(filled, cells)] = rows
    return Dated(start + period * filled, of_row, period, tuple(notes))


# Words


def _resolution(t: Floats) -> float:
    """[s] The decimal resolution of the stamps; 0 if none is found."""
    for digits in range(7):
        scaled = t * 10.0**digits
        if np.abs(scaled - np.rint(scaled)).max() < 0.02:
            return float(10.0**-digits)
    return 0.0


def _pattern(t: Floats) -> str:
    """Description of the steps of the stamps, in words."""
    steps = np.diff(t)
    usual = float(np.median(steps[steps > 0.0]))
    longer = np.flatnonzero(steps > 3.0 * usual)
    runs = np.diff(longer)
    if (steps <= 0.0).mean() > 0.2:
        return f"{1.0 / max(float((steps > 0.0).mean()), 1e-9):.2g} rows to a stamp"
    if len(longer) > 5 and len(longer) > 0.02 * len(steps) and np.median(np.abs(runs - np.median(runs))) <= 2:
        return (f"bursts of {np.median(runs):.0f} rows {_short(usual)} apart, then "
                f"{_short(float(np.median(steps[longer])))}")
    low, high = np.percentile(steps, (1, 99))
    return f"steps of {_short(float(low))} to {_short(float(high))}"


def _short(seconds: float) -> str:
    """A time as text with a unit."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if abs(seconds) >= 0.9999 * size or unit == "µs":
            return f"{seconds / size:.4g} {unit}"
    raise AssertionError
