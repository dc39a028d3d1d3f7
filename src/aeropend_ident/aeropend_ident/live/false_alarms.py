# SPDX-License-Identifier: Apache-2.0
"""The limit of the detector from the mean time between false alarms that a person asks for.

The residuals of a rig are coloured, and its model is linearised. So the tail of the largest log likelihood ratio is no
matter of a formula: it was measured on simulated rigs without a change (`python -m evaluation.live --calibrate`). The
number of excursions above a level falls exponentially with the level, as for all such sums (Basseville and Nikiforov
1993, section 5.2).
"""

from __future__ import annotations

import math

AT, RATE, SLOPE = 0.0, 3.0, 0.5
"""Level, excursions above it per hour, and how fast their logarithm falls with the level (measured)."""


def limit(mean_hours: float) -> float:
    """Limit of the log likelihood ratios.

    Args:
        mean_hours: [h] mean time between two false alarms.
    """
    return AT + math.log(RATE * mean_hours) / SLOPE


def mean_hours(level: float) -> float:
    """[h] Mean time between false alarms of a limit: the inverse of `limit`."""
    return math.exp(SLOPE * (level - AT)) / RATE
