# SPDX-License-Identifier: Apache-2.0
"""The zero and the sign of the angle of a rig that nobody calibrated, from its motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.weak_start import (
    BENDS,
    DEAD_ZONES,
    LAGS,
    LOADS,
    Regression,
    WeakForm,
    curve,
    downsampled,
    regress,
    unit_lift,
)
from aeropend_ident.signals.signals import STILL as NO_DUTY
from aeropend_ident.signals.signals import Mounting, Signals
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

OFF = 0.25
"""[rad] Zero of the angle above which the readings are shifted; the fits find a smaller one.

Measured: of 40 drawn rigs with zeros all over the circle the largest error of a zero was 0.14 rad."""

REST, FEWEST = 0.2, 5
"""Least time [s] and number of readings of an arm at rest (choice)."""

STILL = 5.0
"""Greatest distance of a reading at rest from the first ones, in standard deviations of a reading (choice)."""

EXPLAINS = 1.1
"""Least ratio of what a regression leaves without the command to what it leaves with it, to turn the sign.

Measured: of 80 drawn rigs all have 1.1 or more, and the sign of each gain is right."""

CLEARLY = 2.0
"""Least ratio of what a regression leaves with the zero as read to what one with a free zero leaves, to move the zero
(choice: a free zero must halve it; the second rotor of a helicopter makes it 1.5, an offset of 80 degrees 8)."""

TIMES = 2
"""Times that the zero is looked for: an arm that is found to hang at first has a rotor that stands (choice)."""


def mounted(model: Model, recordings: Sequence[Signals]) -> list[Signals]:
    """Driven recordings with an angle that is 0 where the arm hangs, and positive where it is lifted.

    Args:
        model: gives what the recordings do not determine.
        recordings: of one rig; those that are mounted already stay as they are.
    """
    every = list(recordings)
    if any(s.mounting is not None for s in every) or not all(s.driven for s in every):
        return every
    rest = _at_rest(every[0])
    found = Mounting(rest if rest is not None and abs(rest) > OFF else 0.0)
    middle = float(np.nanmedian(np.concatenate([s.theta for s in every])))
    for _ in range(TIMES):
        before = found
        tried = [downsampled(found.of(s)) for s in every]
        tests = [WeakForm(s) for s in tried]
        lifts = _lifts(model, tried)
        r = _likeliest(tests, lifts)
        zero = found.zero
        if abs(r.hangs_at) > OFF and _likeliest(tests, lifts, zero=False).left > CLEARLY * r.left:
            zero += -r.hangs_at if found.flipped else r.hangs_at
            zero += math.tau * round((middle - zero) / math.tau)  # of all turns that of the readings
        turned = r.gain < 0.0 and regress(tests, [np.zeros(len(s)) for s in tried]).left > EXPLAINS * r.left
        found = Mounting(zero, found.flipped != turned)
        if found == before:
            break
    every = [found.of(s).noted(*found.notes()) for s in every]
    return [replace(s, hanging=_hanging(s)) for s in every]


def _hanging(s: Signals) -> float | None:
    """[rad] The reading of an arm that rests at first near the zero that was found: elsewhere it lies on something."""
    rest = _at_rest(s)
    return rest if rest is not None and abs(rest) <= OFF else None


def _at_rest(s: Signals) -> float | None:
    """[rad] The reading of an arm that rests at first and is not held: the duty is 0, or changes without moving it."""
    known = np.flatnonzero(np.isfinite(s.theta))
    x = s.theta[known]
    first = max(FEWEST, int(np.searchsorted(known * s.period, REST)))
    moved = np.abs(x - np.median(x[:first])) > STILL * s.sigma["theta"]
    stop = int(np.argmax(moved)) if moved.any() else len(x)
    held = s.duty[:int(known[min(stop, len(known) - 1)])]
    if stop < first or (np.abs(held).max() >= NO_DUTY and np.ptp(held) < NO_DUTY):
        return None
    return float(np.median(x[:stop]))


def _lifts(model: Model, recordings: Sequence[Signals]) -> list[list[Array]]:
    """The lift of each recording (N,), for each static curve and lag."""
    curves = product(DEAD_ZONES, BENDS, LOADS[:1], LAGS)
    models = [replace(model, model=curve(model.model, dead, bend, load, lag)) for dead, bend, load, lag in curves]
    return [[unit_lift(m, s) for s in recordings] for m in models]


def _likeliest(tests: Sequence[WeakForm], lifts: Sequence[Sequence[Array]], *, zero: bool = True) -> Regression:
    """The regression of the weak form that leaves least; `zero`: whether the zero of the angle is unknown."""
    return min((regress(tests, own, zero=zero) for own in lifts), key=lambda r: r.left)
