# SPDX-License-Identifier: Apache-2.0
"""Stamps on a uniform grid: whether they keep one, which one, and the longest piece without a pause."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags import recording
from aeropend_ident.bags.recording import OFF_GRID, Recording, RecordingError
from aeropend_ident.signals.signals import MINIMUM_DURATION
from aeropend_sim.wording import counted

PAUSE = 10.0
"""[s] Gap between samples after which the state before it no longer matters.

Choice: several times what the arm remembers.

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

IRREGULAR = 0.05
"""Share of the steps between stamps that may fit no sample period (choice)."""

FINEST = 1e-3
"""[s] Finest grid that is laid under stamps that keep no period (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

JITTER = 0.1
"""Part of a sample period by which a stamp may miss the grid (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

PARTS = (1, 2, 4, 5, 8, 10, 12, 16, 20, 50)
"""Parts of the usual period that are tried as the period of the grid."""


def check_period(read: Recording) -> None:
    """Make sure that the stamps keep one sample period.

    Args:
        read: the recording.

    Raises:
        RecordingError: too few samples, or too many steps that fit no period.
    """
    if len(read) < 3:
        raise RecordingError(f"{read.path}: {counted(len(read), 'sample')} {'is' if len(read) == 1 else 'are'} too few "
                             f"for a verdict: record {MINIMUM_DURATION:g} s or more")
    steps = np.diff(read.stamp_ns)
    periods = steps / np.median(steps)
    share = float(np.mean(np.abs(periods - np.maximum(np.rint(periods), 1.0)) > OFF_GRID))
    if share > IRREGULAR:
        raise RecordingError(f"{read.path}: {100.0 * share:.0f} % of the steps between its stamps fit no sample period "
                             "(a clock that was set while recording, or two programs on one topic), so no verdict is "
                             "possible; record again")


def longest_piece(read: Recording) -> Recording:
    """Cut a recording at its pauses and keep the longest piece.

    Args:
        read: the recording.

    Returns:
        The piece, with a note; the recording itself if it has no pause.
    """
    pauses = np.flatnonzero(np.diff(read.stamp_ns) > PAUSE * 1e9)
    if not len(pauses):
        return read
    first, last = np.append(0, pauses + 1), np.append(pauses, len(read) - 1)
    longest = int(np.argmax(read.stamp_ns[last] - read.stamp_ns[first]))
    piece = slice(int(first[longest]), int(last[longest]) + 1)
    cut = {f.name: getattr(read, f.name)[piece] for f in fields(read)
           if f.name in {"stamp_ns", "received_ns", "t", *recording.CHANNELS}}
    pause = float(read.t[pauses[0] + 1] - read.t[pauses[0]])
    note = (f"the recording pauses {'once' if len(pauses) == 1 else f'{len(pauses)} times'}, first for {pause:.0f} s: "
            f"only its longest piece is used, {cut['t'][-1] - cut['t'][0]:.1f} s from {cut['t'][0]:.1f} s on")
    inside = (read.gaps[:, 0] >= piece.start) & (read.gaps[:, 0] < piece.stop - 1)
    gaps = read.gaps[inside] - np.array([piece.start, 0])
    return replace(read, **{**cut, "t": cut["t"] - cut["t"][0]}, gaps=gaps, truth=None, notes=(*read.notes, note))


def regular_grid(read: Recording) -> tuple[NDArray[np.int64], float]:
    """Index of each stamp on the grid of a recording that keeps its sample period.

    Args:
        read: the recording; see `check_period`.

    Returns:
        Index (N,) of each stamp, and the period in s.
    """
    index = np.rint((read.stamp_ns - read.stamp_ns[0]) / (read.period * 1e9)).astype(np.int64)
    return index, float(read.stamp_ns[-1] - read.stamp_ns[0]) * 1e-9 / max(int(index[-1]), 1)


def irregular_grid(stamps: NDArray[np.int64], longest: float = math.inf) -> tuple[NDArray[np.int64], float]:
    """Index of each stamp on a uniform grid that need not be the stamps' own.

    Stamps that keep one period make that the grid, or parts of it. Others get a grid that is fine enough for all.

    Args:
        stamps: [ns] (N,) instants.
        longest: [s] upper limit of the period.

    Returns:
        Index (N,) of each stamp, and the period in s.
    """
    since = (stamps - stamps[0]) * 1e-9
    usual = float(np.median(np.diff(since)))
    near = np.diff(since)[np.abs(np.diff(since) / usual - 1.0) < OFF_GRID]
    usual = float(np.mean(near)) if len(near) else usual
    index = np.rint(since / usual).astype(np.int64)
    if index[-1] > 0:  # a period that is slightly wrong would drift away over many stamps
        refined = float(since @ index) / float(index @ index)
        steady = np.percentile(np.abs(since - refined * np.rint(since / refined)), 95.0) < JITTER * usual
        usual = refined if steady else usual
    period = usual
    for parts in PARTS:
        period = usual / parts
        index = np.rint(since / period).astype(np.int64)
        missed = np.abs(since - index * period)
        if period > longest and period > FINEST:
            continue
        if np.percentile(missed, 95.0) < JITTER * usual or period <= FINEST:
            return index, period
    return index, period
