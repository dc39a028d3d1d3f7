# SPDX-License-Identifier: Apache-2.0
"""The one door for the values of a recording: what cannot be a reading or a stamp is left out, counted and said."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags.mending import mend
from aeropend_ident.bags.reading import RecordingError
from aeropend_sim.readings import MOST, ROUNDING
from aeropend_sim.wording import counted

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]

LEAST = 1e-30
"""Amount below which a reading is 0 (choice: no sensor resolves it, and its inverse is no number)."""

MANY = 0.05
"""Share of the duties beyond -1..1 from which on the duty has another unit, and is no fraction (choice)."""

PERCENT = 101.0
"""Largest duty that may be in percent (choice: 100, and a rounding)."""

SECOND = 1_000_000_000
"""[ns]"""

SET_BACK, SET_FORWARD = SECOND, 3600 * SECOND
"""[ns] Step of the stamps, back or forward, from which on a clock was set, if the receive times do not make it too.

Choice: one rig's messages arrive in order, and a recorder that hangs does not hang for an hour."""

LATEST = 2**31 * SECOND
"""[ns] What no stamp reaches: its seconds have 32 bits with sign."""

NEIGHBOURS = 3
"""Stamps on either side with which a single one is compared (choice)."""

MOSTLY = 0.9
"""Share of the samples between the settings of a clock below which the receive times are not believed (choice)."""

SHORTEST_PIECE = 0.5
"""[s] A piece between two settings of the clock that is shorter is a few wrong stamps (choice)."""


def numbers(raw: NDArray[np.floating[Any]]) -> Floats:
    """Numbers of messages, of any shape, as float64; a signalling NaN, at which numpy warns, is a plain one.

    Args:
        raw: as decoded.
    """
    with np.errstate(invalid="ignore"):
        return np.where(np.isnan(raw), np.nan, raw.astype(np.float64))


def of(name: str) -> str:
    """The words by which a note names the readings of a channel that are left out."""
    return f" of {name} "


def channel(name: str, values: Floats, notes: list[str], others: Mapping[str, Floats] | None = None) -> Floats:
    """The readings of a channel (N,); NaN where a number can be none, with a note of their number.

    Args:
        name: one of theta, omega, i_a, v_a, duty, reference.
        values: (N,) as recorded; NaN where nothing was measured.
        notes: gets the note.
        others: all channels as recorded, of which one may be the duty.

    Raises:
        RecordingError: the duties are no fractions.
    """
    if name == "duty":
        values = np.where(np.abs(values) <= 1.0 + ROUNDING, np.clip(values, -1.0, 1.0), values)
    values = np.where(np.abs(values) < LEAST, 0.0, values)
    wrong = ~np.isnan(values) & ~(np.abs(values) <= MOST[name])
    number = int(wrong.sum())
    if not number:
        return values
    known = values[np.isfinite(values)]
    if name == "duty" and int((np.abs(known) > 1.0).sum()) > MANY * len(known):
        low, high = float(known.min()), float(known.max())
        raise RecordingError(f"the duty goes from {low:.3g} to {high:.3g}, but is a fraction, -1 to 1: "
                             f"{'; '.join(_other_duties(low, high, others or {}))}")
    first = float(values[np.argmax(wrong)])
    notes.append(f"{counted(number, 'reading')}{of(name)}{'is' if number == 1 else 'are'} no possible number (first "
                 f"{first:g}, possible are {-MOST[name]:g} to {MOST[name]:g}): left out")
    return np.where(wrong, np.nan, values)


def _other_duties(low: float, high: float, others: Mapping[str, Floats]) -> list[str]:
    """What duties from `low` to `high` may be, the likeliest first: in another unit, or exchanged with a channel."""
    unit, option = ("percent", "%") if max(-low, high) <= PERCENT else ("counts of 255", "counts:255")
    out = [f"if it is in {unit}, {mend(f'--duty duty:{option}')}"]
    for name, what, option in (("i_a", "current", "--current duty:A"), ("v_a", "voltage", "--voltage duty:V")):
        x = others.get(name, np.empty(0))
        x = x[np.isfinite(x)]
        if len(x) and np.ptp(x) > 0.0 and np.abs(x).max() <= 1.0 + ROUNDING:
            out.append(f"if it is exchanged with the {what}, {mend(f'--duty {name}:1', option)}")
    return out


def clamped(commands: Floats, notes: list[str]) -> Floats:
    """Duties commanded (K,), as a rig clamps them.

    Args:
        commands: (K,) as sent; numbers.
        notes: gets a note of the number that was beyond -1..1.
    """
    beyond = int((np.abs(commands) > 1.0 + ROUNDING).sum())
    if beyond:
        notes.append(f"{beyond} of {counted(len(commands), 'duty_command')} {'is' if beyond == 1 else 'are'} beyond -1 "
                     f"to 1: taken as -1 or 1, as a rig does; if they are in percent, {mend('--duty duty:%')}")
    return np.clip(commands, -1.0, 1.0)


def times(seconds: NDArray[np.int64], rest: NDArray[np.int64]) -> tuple[Stamps, Mask]:
    """Stamps [ns] (N,) of messages, and which of them are times: not before 1970, with less than 1e9 ns.

    Args:
        seconds: (N,) `sec` of the stamps.
        rest: (N,) `nanosec` of the stamps.
    """
    return seconds * SECOND + rest, (seconds >= 0) & (rest < SECOND)


def one_clock(stamps: Stamps, received: Stamps, notes: list[str]) -> tuple[Stamps, Mask]:
    """Stamps as if the clock of the rig had not been set while it was recorded.

    A clock was set where the stamps jump from one sample to the next one that was received, and the receive times do
    not. What follows moves by as much, in whole sample periods. A few samples with stamps of their own are left out.

    Args:
        stamps: [ns] (N,) rising.
        received: [ns] (N,) receive time of each.
        notes: gets a note if the clock was set.

    Returns:
        The stamps (N,), and a mask (N,) of the samples that are kept.
    """
    kept = np.ones(len(stamps), dtype=bool)
    if (np.diff(received) >= 0).all() and (np.diff(stamps) <= SET_FORWARD).all():
        return stamps, kept
    from scipy.ndimage import median_filter  # its import is slow

    order = np.argsort(received, kind="stable")
    usual = median_filter(stamps[order], 2 * NEIGHBOURS + 1, mode="nearest")
    order = order[np.abs(stamps[order] - usual) <= SET_BACK]
    s, r = stamps[order], received[order]
    steps = np.diff(s)
    jumps = (steps < -SET_BACK) | ((steps > SET_FORWARD) & (np.diff(r) < SET_BACK))
    first = np.append(0, np.flatnonzero(jumps) + 1)
    last = np.append(first[1:], len(s)) - 1
    whole = s[last] - s[first] >= SHORTEST_PIECE * SECOND
    if len(order) == len(stamps) and len(first) == 1:
        return stamps, kept
    if int((last - first + 1)[whole].sum()) < MOSTLY * len(stamps):
        return stamps, kept
    period = max(float(np.median(steps[~jumps])), 1.0)
    moved, end, set_by = s.copy(), -1, []
    kept[:] = False
    for start, stop in zip(first[whole].tolist(), (last[whole] + 1).tolist(), strict=True):
        kept[order[start:stop]] = True
        if end >= 0:
            pause = max(round(int(r[start] - r[end]) / period), 1)
            shift = int(moved[end]) + round(pause * period) - int(s[start])
            if abs(shift) > SET_BACK or s[start] <= moved[end]:
                if not 0 <= int(s[start]) + shift <= int(s[stop - 1]) + shift < LATEST:  # receive times of another age
                    return stamps, np.ones(len(stamps), dtype=bool)
                moved[start:stop] += shift
                set_by.append(int(s[start] - s[end]) / SECOND)
        end = stop - 1
    if alone := int((~kept).sum()):
        notes.append(f"{counted(alone, 'sample')} {'has' if alone == 1 else 'have'} a stamp far from those around: "
                     "left out")
    if set_by:
        notes.append(f"the clock of the stamps was set {counted(len(set_by), 'time')} during the recording (first by "
                     f"{set_by[0]:.0f} s): its stamps are moved so that they go on as the receive times do")
    out = stamps.copy()
    out[order] = moved
    return out, kept
