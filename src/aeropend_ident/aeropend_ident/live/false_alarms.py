# SPDX-License-Identifier: Apache-2.0
"""The limit of the detector from the mean time between false alarms that a person asks for.

The evidence of a change is the logarithm of a Bayes factor times its prior odds. Without a change a Bayes factor has
the mean 1. So the sum over all instants and hypotheses, a statistic of Shiryaev and Roberts, grows on average by the
sum of the prior odds with each instant that is tried, and the mean time until the largest of its terms passes
exp(limit) is at least exp(limit) over that growth (M. Pollak: Optimal detection of a change in distribution. Annals of
Statistics 13, 1985; the same bound as in G. Lorden 1971). This holds for residuals whose noise is as the detector takes
it; how far it holds for simulated rigs is measured (docs/results/live.md).
"""

from __future__ import annotations

import math

from aeropend_ident.diagnosis.search.hypotheses import EFFECT_ODDS
from aeropend_sim.model.effects import CATALOGUE

TICK = 0.1
"""[s] Time between two instants that are tried (choice: a fifth of what an instant must be told within)."""

ODDS = EFFECT_ODDS * (len(CATALOGUE) + 1)
"""Sum of the prior odds of all hypotheses (derived; the parameters of the model share those of one effect)."""


def limit(mean_hours: float) -> float:
    """Limit of the evidence.

    Args:
        mean_hours: [h] mean time between two false alarms.
    """
    return math.log(mean_hours * 3600.0 / TICK * ODDS)


def mean_hours(level: float) -> float:
    """[h] Mean time between false alarms of a limit: the inverse of `limit`."""
    return math.exp(level) * TICK / 3600.0 / ODDS
