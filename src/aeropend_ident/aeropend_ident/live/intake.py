# SPDX-License-Identifier: Apache-2.0
"""From messages to consecutive samples: pairs of one stamp on the grid, and what interrupts them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.live.companion_model import Samples
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.readings import MOST, ROUNDING

WAITING = 5000
"""Halves of samples that wait for the other half.

Derived: the node reads one topic after the other, and the middleware holds so many messages of a topic while it stood
still (`topic_recorder.DEPTH`)."""

BRIDGED = 0.25
"""[s] Longest run of lost samples that the model runs through (choice: a fifth of a swing of the arm)."""

FOLLOWED = 0.1
"""Share of its distance by which the grid of the samples follows a stamp.

Choice: stamps may jitter by almost half a period, and a clock may be some percent off."""

FROZEN = 0.5
"""[s] Time of equal readings in all channels that have noise after which a rig counts as frozen (choice)."""

_Row = tuple[int, float, float, float, float, float]
"""Stamp [ns] and readings of a sample, in the order of `Samples`."""


@dataclass
class Batch:
    """Consecutive samples.

    Attributes:
        stamps: (N,) [ns].
        samples: (N,) each.
        broken: why they do not follow the samples before; "" if they do.
    """

    stamps: NDArray[np.int64]
    samples: Samples
    broken: str = ""


@dataclass
class Intake:
    """Collects halves of samples; `take` gives the consecutive samples since the last time.

    Attributes:
        lost: number of samples that were bridged.
        doubled: number of samples that were dropped: their stamp is nearest to the sample before on the grid.
        odd: number of readings that are no numbers, or impossible.
        frozen: whether the readings do not change.
    """

    period: float = SAMPLE_PERIOD
    lost: int = 0
    doubled: int = 0
    odd: int = 0
    frozen: bool = False
    command: float = math.nan
    _halves: dict[int, tuple[float, ...]] = field(default_factory=dict)
    _ready: list[_Row] = field(default_factory=list)
    _last: int | None = None
    _grid: float = 0.0  # [ns] instant of the last sample by the stamps of many
    _same: int = 0
    _before: tuple[float, ...] = ()

    def joints(self, stamp: int, theta: float, omega: float) -> None:
        """Take a message of `joint_states`: stamp [ns], readings [rad], [rad/s]."""
        other = self._halves.pop(stamp, None)
        if other is None or len(other) != 3:
            self._wait(stamp, (theta, omega))
        else:
            self._ready.append((stamp, theta, omega, *other))

    def armature(self, stamp: int, i_a: float, v_a: float, duty: float) -> None:
        """Take a message of `armature`: stamp [ns], readings [A], [V], duty applied."""
        if math.isnan(duty):
            duty = self.command
        other = self._halves.pop(stamp, None)
        if other is None or len(other) != 2:
            self._wait(stamp, (i_a, v_a, duty))
        else:
            self._ready.append((stamp, *other, i_a, v_a, duty))

    def _wait(self, stamp: int, half: tuple[float, ...]) -> None:
        self._halves[stamp] = half
        if len(self._halves) > WAITING:
            del self._halves[next(iter(self._halves))]

    def forget(self) -> None:
        """Drop what waits: the next samples follow nothing."""
        self._halves.clear()
        self._ready.clear()
        self._last = None

    def take(self) -> list[Batch]:
        """The samples that are complete, cut where they are interrupted."""
        placed = self._placed()
        if not placed:
            return []
        table = np.array([row[1:] for row, *_ in placed], dtype=float)
        stamps = np.array([row[0] for row, *_ in placed], dtype=np.int64)
        for k, channel in enumerate(Samples._fields):
            most = MOST[channel] + (ROUNDING if channel == "duty" else 0.0)
            bad = ~(np.abs(table[:, k]) <= most)
            self.odd += int(bad.sum())
            table[bad, k] = math.nan
        self._look_frozen(table)
        batches: list[Batch] = []
        begin, broken = 0, ""
        filled: list[tuple[int, int]] = []  # where samples are missing, and how many
        for k, (_, missing, why) in enumerate(placed):
            if why:
                if k > begin:
                    batches.append(self._batch(stamps, table, begin, k, broken, filled))
                begin, broken, filled = k, why, []
            elif missing:
                filled.append((k, missing))
        batches.append(self._batch(stamps, table, begin, len(stamps), broken, filled))
        return batches

    def _placed(self) -> list[tuple[_Row, int, str]]:
        """What is complete, on the grid: the samples that are missing before each, and why it does not follow them."""
        placed, period = [], self.period * 1e9
        for row in self._ready:
            stamp, steps, why = row[0], 1, ""
            if self._last is None:
                why = "start"
            elif stamp < self._last:
                why = f"the stamps went back by {(self._last - stamp) * 1e-9:.3g} s"
            elif (stamp - self._last) * 1e-9 > BRIDGED:
                why = f"{(stamp - self._last) * 1e-9:.3g} s without a sample"
            else:
                steps = round((stamp - self._grid) / period)
            if steps < 1:
                self.doubled += 1
                continue
            on = self._grid + steps * period
            self._grid = stamp if why else on + FOLLOWED * (stamp - on)
            self._last = stamp
            self.lost += steps - 1
            placed.append((row, steps - 1, why))
        self._ready = []
        return placed

    def _batch(self, stamps: NDArray[np.int64], table: NDArray[np.float64], begin: int, end: int, broken: str,
               filled: list[tuple[int, int]]) -> Batch:
        at = [k - begin for k, count in filled for _ in range(count)]
        part, when = table[begin:end], stamps[begin:end]
        if at:
            steps = [round((j + 1 - count - 1) * self.period * 1e9) for _, count in filled for j in range(count)]
            when = np.insert(when, at, when[at] + np.array(steps))
            part = np.insert(part, at, math.nan, axis=0)
        return Batch(when, Samples(*np.ascontiguousarray(part.T)), broken)

    def _look_frozen(self, table: NDArray[np.float64]) -> None:
        same = (table[:, (0, 2, 3)] == np.vstack([self._before or table[:1, (0, 2, 3)], table[:-1, (0, 2, 3)]])).all(
            axis=1)
        moved = np.flatnonzero(~same)
        self._same = len(table) - int(moved[-1]) - 1 if len(moved) else self._same + len(table)
        self._before = tuple(table[-1, (0, 2, 3)].tolist())
        self.frozen = self._same * self.period > FROZEN
