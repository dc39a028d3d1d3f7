# SPDX-License-Identifier: Apache-2.0
"""The effect `speed_spikes`: false captures of the speed's pulses are counted; no fit follows them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.search.findings import RankedHypothesis
from aeropend_ident.diagnosis.search.hypotheses import EFFECT_ODDS, Hypothesis
from aeropend_ident.estimation.map_fit import estimate
from aeropend_ident.signals.signals import Signals
from aeropend_sim.wording import counted

ANY_RIG = 0.02
"""[1/s] Rate of false captures that any rig may show (choice: one in 50 s).

Measured: at ±30 % no verdict of 1 recording changes (docs/results/thresholds.md)."""

FEWEST = 3
"""False captures below which the effect is not claimed (choice).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""


def detect(recordings: Sequence[Signals]) -> RankedHypothesis | None:
    """The effect, if false captures come more often than on any rig (likelihood ratio of two Poisson rates).

    Args:
        recordings: of one rig.
    """
    count, time = 0, 0.0
    for s in recordings:
        count += _count(s.false_speed[:s.train])
        time += searched_time(s)
    gain = log_odds(count, time)
    if count < FEWEST or gain < 0.0:
        return None
    name = "speed_spikes.rate"
    rate, sd = count / time, math.sqrt(count) / time
    return RankedHypothesis(Hypothesis("speed_spikes"), estimate({name: rate}, {name: sd}), gain, float(expit(gain)))


def log_odds(count: int, time: float) -> float:
    """Log odds that false captures come more often than on any rig.

    Args:
        count: of them; at least 1.
        time: [s] in which they came.
    """
    expected = ANY_RIG * time
    if count < 1 or expected <= 0.0:
        return -math.inf
    return count * math.log(count / expected) - (count - expected) + math.log(EFFECT_ODDS)


def searched_time(s: Signals) -> float:
    """[s] Time of the fitted part in which a false capture could come: it needs a pulse, and a rotor that turns."""
    return float(s.pulses.period[s.pulses.index < s.train].sum()) if s.pulses else s.train * s.period


def left_out(s: Signals) -> tuple[str, ...]:
    """A note on the false captures of a recording that are too few for the effect; empty if there are none."""
    count = _count(s.false_speed)
    return (f"omega: {counted(count, 'false speed')} left out, too few to be an effect",) if count else ()


def _count(false: NDArray[np.bool_]) -> int:
    """Runs of false samples (N,)."""
    return int(np.sum(np.diff(false.astype(int), prepend=0) == 1))


def squared_gap(chains: CutChains) -> float:
    """Squared gap of the speed from false captures, in units of its spread squared."""
    gaps = [float(np.nanmean((c.signals.omega - c.speed) ** 2)) / max(float(np.nanvar(c.speed)), 1e-12)
            for c in chains.each if c.signals.has("omega")]
    return float(np.mean(gaps))
