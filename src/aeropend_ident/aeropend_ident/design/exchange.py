# SPDX-License-Identifier: Apache-2.0
"""The search for a signal: duties and hold times, changed one at a time.

Coordinate exchange (R. Meyer, C. Nachtsheim: The coordinate-exchange algorithm for constructing exact optimal
experimental designs. Technometrics 37, 1995): one hold is changed at a time, and a change is kept if the goal gains.
The coordinate and its new value are drawn, since each evaluation simulates all rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.design.goals import Answer, Goal, score
from aeropend_ident.design.limits import Limits
from aeropend_ident.design.responses import Rows
from aeropend_ident.estimation.parallel import parallel
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD

Array = NDArray[np.float64]
Progress = Callable[[float], None]
"""Called with the share of the work that is done."""

SHORTEST = 0.1
"""[s] Shortest hold (choice: a few time constants of the current; the arm sees a shorter one as its mean)."""

GRID = 0.01
"""Step of duties (choice: a signal that a person can read)."""

TICK = 0.02
"""[s] Step of hold times (choice, as `GRID`)."""

TOGETHER = 4
"""Changes that are tried at a time, of which the best is kept.

Choice: enough for the cores; fixed, so that the result does not depend on their number."""

STARTS = 2
"""Starts that are improved (choice)."""

NEAR = 0.15
"""Standard deviation of a small change: of a duty in its range, of a time as a ratio (choice)."""

REST = 0.3
"""Share of new holds with duty 0, in which the arm swings freely (choice)."""

FACTORS = np.linspace(1.0, 0.05, 20)
"""Factors on the duties with which a start is tried until it keeps the limits (choice)."""


@dataclass(frozen=True)
class Holds:
    """A signal of holds.

    Attributes:
        duties: of each.
        times: [s] of each.
        rate: [1/s] greatest rate of the duty; 0: it jumps.
    """

    duties: tuple[float, ...]
    times: tuple[float, ...]
    rate: float = 0.0

    @property
    def seconds(self) -> float:
        """Length."""
        return sum(self.times)

    @property
    def excitation(self) -> Excitation:
        """As `excite` plays it."""
        return Excitation("holds", round(self.seconds, 6), sequence=self.duties, holds=self.times, duty_rate=self.rate)

    def scaled(self, factor: float, limits: Limits) -> Holds:
        """With its duties times a factor, and within their limits."""
        return replace(self, duties=tuple(on_grid(factor * x, limits) for x in self.duties))


def on_grid(duty: float, limits: Limits) -> float:
    """A duty within its limits, on the grid."""
    return round(GRID * round(min(max(duty, limits.duty[0]), limits.duty[1]) / GRID), 6)


def of_series(series: Array, limits: Limits) -> Holds:
    """A series of duties (N,) as holds, the short ones joined."""
    duties: list[float] = []
    times: list[float] = []
    for duty, same in groupby(series.tolist()):
        seconds = SAMPLE_PERIOD * len(list(same))
        if times and (times[-1] < SHORTEST or seconds < SHORTEST):
            times[-1] += seconds
        else:
            duties.append(on_grid(duty, limits))
            times.append(seconds)
    return Holds(tuple(duties), _ticks(times), limits.duty_rate)


def _ticks(times: Sequence[float]) -> tuple[float, ...]:
    """Times on the grid, with the same sum."""
    ends = np.rint(np.cumsum([0.0, *times]) / TICK)
    steps = np.maximum(np.diff(ends), round(SHORTEST / TICK))
    steps[np.argmax(steps)] += ends[-1] - steps.sum()
    return tuple(round(float(x), 6) for x in TICK * steps)


def changed(at: Holds, limits: Limits, rng: np.random.Generator) -> Holds:
    """A signal with one hold changed: its duty, its end, its place, or whether it is there.

    Args:
        at: the signal.
        limits: of the duty.
        rng: draws the change.
    """
    duties, times = list(at.duties), list(at.times)
    k = int(rng.integers(len(duties)))
    j = k + 1 if k + 1 < len(duties) else k - 1
    low, high = limits.duty
    what = int(rng.integers(6))
    if what == 0:
        duties[k] = rng.uniform(low, high)
    elif what == 1:
        duties[k] += NEAR * (high - low) * rng.standard_normal()
    elif what == 2 and len(duties) > 1:
        both = times[k] + times[j]
        share = 1.0 / (1.0 + (times[j] / times[k]) * float(np.exp(2.0 * NEAR * rng.standard_normal())))
        times[k] = share * both
        times[j] = both - times[k]
    elif what == 3 and len(duties) > 1:
        duties[k], duties[j], times[k], times[j] = duties[j], duties[k], times[j], times[k]
    elif what == 4 and len(duties) > 2:
        times[j] += times[k]
        del duties[k], times[k]
    elif times[k] >= 2.0 * SHORTEST + TICK:
        share = rng.uniform(SHORTEST / times[k], 1.0 - SHORTEST / times[k])
        duties.insert(k + 1, 0.0 if rng.random() < REST else rng.uniform(low, high))
        times[k:k + 1] = [share * times[k], (1.0 - share) * times[k]]
    return Holds(tuple(on_grid(x, limits) for x in duties), _ticks(times), at.rate)


@dataclass(frozen=True)
class Tried:
    """A signal and how good it is.

    Attributes:
        holds: the signal.
        score: of its goal; of a signal beyond a limit minus infinity.
        answers: to what is asked; of a signal beyond a limit none.
        reach: what the channels reach at most.
        excess: by what share of its limit the worst channel is beyond it.
    """

    holds: Holds
    score: float
    answers: tuple[Answer, ...]
    reach: dict[str, tuple[float, float]]
    excess: float

    @property
    def enough(self) -> bool:
        """Whether all that is asked is reached."""
        return all(a.reached >= 1.0 for a in self.answers)


class Exchange:
    """Searches signals.

    Args:
        rows: of the rig.
        goal: of the experiment.
        limits: that hold for every rig within the uncertainty.
        jobs: processes.
    """

    def __init__(self, rows: Rows, goal: Goal, limits: Limits, jobs: int = 1) -> None:
        self.rows, self.goal, self.limits, self.jobs = rows, goal, limits, jobs

    def tried(self, holds: Holds) -> Tried:
        """Simulate a signal."""
        under = self.rows.under(holds.excitation.series())
        excess = self.limits.excess(under.reach)
        if not excess <= 0.0:
            return Tried(holds, -math.inf, (), under.reach, excess)
        answers = self.goal.answers(under.products)
        return Tried(holds, score(answers), answers, under.reach, excess)

    def within(self, holds: Holds) -> Tried | None:
        """A signal with the largest duties that keep the limits; None: with none."""
        for factor in FACTORS:
            tried = self.tried(holds.scaled(float(factor), self.limits))
            if tried.excess <= 0.0:
                return tried
        return None

    def begin(self, starts: Mapping[str, Holds]) -> dict[str, Tried]:
        """The starts that keep the limits, with the largest duties that do.

        Args:
            starts: name -> signal, of the same length.
        """
        found = parallel(self.jobs, self.within, [*starts.values()])
        return {name: t for name, t in zip(starts, found, strict=True) if t is not None}

    def improve(self, begun: Sequence[Tried], evaluations: int, seed: int, *, enough: bool = False,
                progress: Progress = lambda _: None) -> Tried:
        """The best signal found.

        Args:
            begun: at least one signal that keeps the limits.
            evaluations: signals that are tried.
            seed: of the changes.
            enough: whether to end when all that is asked is reached.
            progress: of the search.
        """
        first = sorted(begun, key=lambda t: -t.score)[:STARTS]
        rounds = max(evaluations // (TOGETHER * len(first)), 1)
        found = []
        for n, at in enumerate(first):
            rng = np.random.default_rng([seed, n])
            for k in range(rounds):
                if enough and at.enough:
                    return at
                tried = parallel(self.jobs, self.tried,
                                 [changed(at.holds, self.limits, rng) for _ in range(TOGETHER)])
                at = max([at, *(t for t in tried if t.excess <= 0.0)], key=lambda t: t.score)
                progress((n * rounds + k + 1) / (len(first) * rounds))
            found.append(at)
        return max(found, key=lambda t: t.score)
