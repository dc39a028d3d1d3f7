# SPDX-License-Identifier: Apache-2.0
"""How the benchmark measures, and what a figure is."""

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np


class NotMeasuredError(Exception):
    """A figure cannot be measured here; the message is one line that says why."""


@dataclass(frozen=True)
class Spread:
    """Repeated measurements of one number."""

    median: float
    q1: float
    q3: float
    low: float
    high: float
    repeats: int

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray | float) -> "Spread":
        """Sum up values; a single number is a measurement made once."""
        values = np.atleast_1d(np.asarray(values, dtype=float))
        with np.errstate(invalid="ignore"):  # between two infinite ones, or one and a number, is infinity
            found = np.percentile(values, (0, 25, 50, 75, 100))
        low, q1, median, q3, high = np.where(np.isnan(found) & ~np.isnan(values).any(), np.inf, found).tolist()
        return cls(median, q1, q3, low, high, len(values))


@dataclass(frozen=True)
class Target:
    """What a figure must reach: its own median, or that of its ratio to the peer."""

    limit: float
    of: str = "ours"
    at_least: bool = False

    def __str__(self) -> str:
        sign = "≥" if self.at_least else "≤"
        return f"{sign} {self.limit:,g}" + (" x peer" if self.of == "ratio" else "")


@dataclass
class Figure:
    """One line of the table.

    Attributes:
        name: what is measured.
        unit: of ours and peer; "" or "of ..." of what was counted.
        ours: our program.
        target: what it must reach, if that is agreed.
        peer_name: whom it is compared with.
        peer: the peer, in the same run.
        ratio: ours over peer, pair by pair; of medians where nothing else is given and nothing was counted.
        details: further numbers for the JSON file.
        note: one line below the table.
        load: processes that wanted a core when the measurement began (1-minute average).
        main: whether it is in the README's table.
    """

    name: str
    unit: str
    ours: Spread
    target: Target | None = None
    peer_name: str = ""
    peer: Spread | None = None
    ratio: Spread | None = None
    details: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    load: float = 0.0
    main: bool = False

    def __post_init__(self) -> None:
        counted = not self.unit or self.unit.startswith("of ")
        if self.ratio is None and self.peer is not None and self.peer.median > 0.0 and not counted:
            self.ratio = Spread.of(self.ours.median / self.peer.median)

    @property
    def met(self) -> bool | None:
        """Whether the target is reached; None without one."""
        if self.target is None:
            return None
        judged = self.ratio if self.target.of == "ratio" else self.ours
        assert judged is not None
        if self.target.at_least:
            return judged.median >= self.target.limit
        return judged.median <= self.target.limit


def interleaved(repeats: int, *functions: Callable[[], Any], clock: Callable[[], float] = time.thread_time
                ) -> list[np.ndarray]:
    """Time functions in turn, so that whatever disturbs the machine disturbs all: (repeats,) s for each.

    The default clock counts this thread's CPU time; give `time.perf_counter` for what runs in several threads.
    """
    for function in functions:
        function()
    seconds = np.empty((len(functions), repeats))
    for k in range(repeats):
        for j, function in enumerate(functions):
            start = clock()
            function()
            seconds[j, k] = clock() - start
    return list(seconds)


def number(value: float, unit: str) -> str:
    """A number and its unit, short."""
    text = f"{value:,.0f}" if 1000.0 <= abs(value) < math.inf or value == 0.0 else f"{value:.3g}"
    return f"{text} {unit}".rstrip(" -")


def load() -> float:
    """Return the 1-minute load average."""
    return os.getloadavg()[0]
