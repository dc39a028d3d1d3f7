# SPDX-License-Identifier: Apache-2.0
"""A bag as signals for the diagnosis, or one line that says why nothing can be told from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from aeropend_ident.bags import recording
from aeropend_ident.bags.recording import OFF_GRID, Recording, RecordingError
from aeropend_ident.signals import uncalibrated
from aeropend_ident.signals.signals import Signals, from_recording

PAUSE = 10.0
"""s without a sample after which what came before says nothing about what comes next."""

MINIMUM = 30
"""Samples of an unknown rig below which nothing is said."""

IRREGULAR = 0.05
"""Share of steps between stamps that may fit no sample period."""


def signals_of(bag: str | Path, namespace: str | None, sensing: Mapping[str, float], held_out: float = 0.3, *,
               fit_nominal: bool = False) -> Signals:
    """Read a bag.

    Args:
        bag, namespace: as for `recording.read`.
        sensing: the model's measurement chain.
        held_out: share of the recording at its end that models are not fitted to.
        fit_nominal: nobody knows the rig's numbers, nor its measurement chain; the command may be missing.

    Raises:
        RecordingError: nothing can be told from it; one line that says why.
    """
    read = recording.read(bag, namespace)
    if fit_nominal:
        if len(read) < MINIMUM:
            raise RecordingError(f"{read.path}: {len(read)} samples are too few for a verdict")
        return uncalibrated.signals_from(_longest_piece(read), sensing, held_out)
    _check_grid(read)
    return from_recording(_longest_piece(read), sensing, held_out)


def _check_grid(read: Recording) -> None:
    if len(read) < 3:
        raise RecordingError(f"{read.path}: {len(read)} samples are too few for a verdict")
    steps = np.diff(read.stamp_ns)
    periods = steps / np.median(steps)
    share = float(np.mean(np.abs(periods - np.maximum(np.rint(periods), 1.0)) > OFF_GRID))
    if share > IRREGULAR:
        raise RecordingError(f"{read.path}: {100.0 * share:.0f} % of the steps between its stamps fit no sample period "
                             "(a clock that was set while recording, or two rigs on one topic), so no verdict is "
                             "possible; record again")


def _longest_piece(read: Recording) -> Recording:
    """The longest part without a pause, with a note; the recording itself where it never pauses."""
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
