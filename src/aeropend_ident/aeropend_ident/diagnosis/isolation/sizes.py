# SPDX-License-Identifier: Apache-2.0
"""The smallest size of an effect that a planned recording would show, and that at which the effect would be named."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from aeropend_ident.diagnosis.isolation import chance
from aeropend_ident.diagnosis.isolation.judge import Judge, Truth

LARGEST = 10.0
"""Largest size that is tried, in usual sizes (choice: a rig that is so far from its model is no rig any more)."""

LEAST = 1e-3
"""Smallest size that is told from none, in usual sizes (choice: a delay of any size shows where a step is sampled)."""

FIRST = 0.05
"""First size that is tried, in usual sizes (choice: about where effects of `bench` begin to show)."""

ROUGHLY = 0.4
"""Margin below which all rigs are looked at (choice: they differ by less)."""

NEAR = 0.02
"""Relative change of a size below which a search for it ends (choice: far below the scatter of noise)."""

QUICKLY = 0.15
"""As `NEAR`, where all effects are only listed (choice: the noise of one recording changes a size by more)."""

FACTOR = 1.25
"""Factor between two sizes of a scan (choice: half of it is far below the scatter of noise)."""

MOST_STEPS = 20
"""Steps of a search at most (choice: it needs four to six)."""


class Margin(Protocol):
    """A margin of a size: about the log of the size over that wanted."""

    def __call__(self, size: float, *, roughly: bool = False) -> float:
        """The margin; `roughly`: a cheaper one."""


@dataclass(frozen=True)
class Smallest:
    """The smallest sizes of an effect with which a diagnosis would say something, with a probability of one half.

    Attributes:
        seen: size at which it would not say `none`, as a distance from the neutral one; None: not at all.
        named: size at which it would name the effect and no rival; None: not at all.
        rivals: family of each rival that it could not rule out at the size seen -> its probability.
    """

    seen: float | None
    named: float | None
    rivals: dict[str, float]


def smallest(judge: Judge, truth: Truth, *, name: bool = True, quickly: bool = False) -> Smallest:
    """The smallest sizes of an effect.

    Args:
        judge: of the planned recording.
        truth: the effect.
        name: whether the size at which it is named is looked for too.
        quickly: whether one rig and a rough size are enough: where all effects are only listed.
    """
    if truth.hypothesis.effect == "speed_spikes":
        rate = chance.spikes(judge)
        return Smallest(rate, rate if name else None, {})
    if truth.hypothesis.effect == "gust":
        size = _crossing(chance.gust_margin(judge, truth), truth.usual, LARGEST * truth.usual)
        return Smallest(size, size if name else None, {})
    if not truth.stages:
        return Smallest(None, None, {})
    largest = min(LARGEST * abs(truth.usual), truth.largest)
    shown = _crossing(partial(judge.margin, truth), FIRST * abs(truth.usual), largest, quickly=quickly)
    shown = None if shown is None else max(shown, LEAST * abs(truth.usual))
    seen = None if shown is None else _first(lambda size: judge.is_sure(truth, size), shown, largest)
    if seen is None or not name:
        return Smallest(seen, None, {})
    rivals = judge.rivals_of(truth, seen)
    named = _first(lambda size: judge.rivals_of(truth, size) == {}, seen, largest)
    return Smallest(seen, named, judge.probabilities(truth, seen) if rivals is None else rivals)


def _crossing(margin: Margin, first: float, largest: float, *, quickly: bool = False) -> float | None:
    """The size at which a margin becomes 0; None above the largest."""
    near = QUICKLY if quickly else NEAR
    size, low, high = min(first, largest), 0.0, math.inf
    for _ in range(MOST_STEPS):
        m = margin(size, roughly=True)
        if abs(m) < ROUGHLY and not quickly:
            m = margin(size)
        if abs(m) < near:
            return size
        low, high = (size, high) if m < 0.0 else (low, size)
        if low >= largest:
            return None
        size *= math.exp(min(max(-m, -2.0), 1.5))
        if not low < size < high or (low > 0.0 and high < (1.0 + near) * low):
            if low > 0.0 and high < (1.0 + near) * low:
                return high
            size = math.sqrt(low * high) if low > 0.0 else 0.5 * high
        size = min(size, largest)
    return high if math.isfinite(high) else None


def _first(holds: Callable[[float], bool], start: float, largest: float) -> float | None:
    """The first size of a scan from a start at which something holds, halfway to the one before; None: at none."""
    size = start
    if holds(size):
        return size
    while size < largest:
        size, before = min(2.0 * size, largest), size
        if holds(size):
            while size > FACTOR * before:
                middle = math.sqrt(size * before)
                size, before = (middle, before) if holds(middle) else (size, middle)
            return math.sqrt(size * before)
    return None
