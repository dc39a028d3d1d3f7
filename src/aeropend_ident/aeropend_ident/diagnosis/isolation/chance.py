# SPDX-License-Identifier: Apache-2.0
"""The smallest sizes of effects of chance, which a diagnosis detects by their statistics."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import numpy as np
from scipy.special import gammaincinv

from aeropend_ident.diagnosis.isolation.judge import Judge, Truth
from aeropend_ident.diagnosis.isolation.planned import SEED
from aeropend_ident.diagnosis.policy import GOOD_ENOUGH
from aeropend_ident.diagnosis.search import speed_spikes
from aeropend_sim.model import rig

NONE = 1e-3
"""Margin of a gust that does not show, as a ratio (choice: far below any)."""


def spikes(judge: Judge) -> float | None:
    """[1/s] The rate of false captures whose number is enough with a probability of one half; None: no speed is read.

    Args:
        judge: of the planned recording.
    """
    (s,) = judge.chains.recordings
    if not s.has("omega"):
        return None
    time = speed_spikes.searched_time(s)
    if time <= 0.0:
        return None
    enough = next(n for n in count(speed_spikes.FEWEST) if speed_spikes.log_odds(n, time) >= 0.0)
    return float(gammaincinv(enough, 0.5)) / time  # a Poisson number reaches n with this probability


def gust_margin(judge: Judge, truth: Truth) -> Callable[..., float]:
    """Size -> log of what the arm leaves over that from which a random torque is looked for, by one random torque.

    Args:
        judge: of the planned recording.
        truth: the effect `gust`.
    """
    model, (s,) = judge.chains.model, judge.chains.recordings
    still, _ = rig.record(model, s.duty, SEED, s.period)

    def margin(size: float, *, roughly: bool = False) -> float:
        del roughly
        own = {n.partition(".")[2]: v for n, v in truth.values(size).items()}
        moved, _ = rig.record(model.with_effects({**model.effects, "gust": own}), s.duty, SEED, s.period)
        change = ((moved["theta"] - still["theta"])[:s.train] / s.sigma["theta"])[np.isfinite(s.theta[:s.train])]
        left = judge.linear.fit({"theta": judge.linear.noise["theta"] + change}).scale["theta"]
        noise = judge.linear.fit({"theta": judge.linear.noise["theta"]}).residuals["theta"]
        more = max(left**2 - float(np.mean(noise**2)), NONE**2) / max(GOOD_ENOUGH**2 - float(np.mean(noise**2)), NONE)
        return 0.5 * float(np.log(more))

    return margin
