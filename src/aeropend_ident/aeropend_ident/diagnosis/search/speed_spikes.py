# SPDX-License-Identifier: Apache-2.0
"""Whether the rig times false speed periods, `speed_spikes`: they are counted, no fit follows them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import expit

from aeropend_ident.diagnosis.chain.chain import Chains
from aeropend_ident.diagnosis.search.hypotheses import EFFECT_ODDS, Hypothesis
from aeropend_ident.diagnosis.search.selection import Weighed
from aeropend_ident.estimation.map_fit import Fit
from aeropend_ident.signals.signals import Signals

FALSE_CAPTURES = 0.02
"""1/s of false speed periods that any rig may show."""


def found(recordings: Sequence[Signals]) -> Weighed | None:
    """Whether false speed periods come more often than any rig may show."""
    count, time = 0, 0.0
    for s in recordings:
        count += int(np.sum(np.diff(s.false_speed[: s.train].astype(int)) == 1))
        # a false period takes a pulse: while the rotor stands there is none
        time += float(s.pulses.period[s.pulses.index < s.train].sum()) if s.pulses else s.train * s.period
    if count < 3:
        return None
    expected = FALSE_CAPTURES * time
    gain = count * math.log(count / expected) - (count - expected) + math.log(EFFECT_ODDS)
    if gain < 0.0:
        return None
    name = "speed_spikes.rate"
    rate, sd = count / time, math.sqrt(count) / time
    fit = Fit({name: rate}, {name: sd}, {}, {}, {}, 0.0, {})
    return Weighed(Hypothesis("speed_spikes"), fit, gain, float(expit(gain)))


def gap(chains: Chains) -> float:
    """Squared gap that false captures make in the speed, in units of its spread squared."""
    gaps = [float(np.nanmean((c.signals.omega - c.speed) ** 2)) / max(float(np.nanvar(c.speed)), 1e-12)
            for c in chains.each if c.signals.has("omega")]
    return float(np.mean(gaps))
