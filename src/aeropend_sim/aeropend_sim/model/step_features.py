# SPDX-License-Identifier: Apache-2.0
"""The features of a step response: rise time, peak time, settling time, overshoot."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BAND = 0.02
"""Half width of the band of the settling time, as a share of the final value. Convention: the 2 % criterion."""


class StepFeatures(NamedTuple):
    """The features of a step response.

    Attributes:
        final: final value, in the unit of the response.
        rise_time: [s] time from 10 % to 90 % of the final value.
        peak_time: [s] time of the highest peak.
        settling_time: [s] time after which the response stays within `BAND` of the final value.
        overshoot: height of the peak above the final value, as a share of the final value.
    """

    final: float
    rise_time: float
    peak_time: float
    settling_time: float
    overshoot: float


def step_features(time: Array, y: Array, final: float) -> StepFeatures:
    """Features of a step response that starts at 0.

    Args:
        time: (N,) [s] time since the step, uniform.
        y: (N,) response.
        final: final value of the response, > 0.

    Returns:
        The features. A time is NaN if the response does not reach it within `time`.
    """
    def first_above(level: float) -> float:
        k = int(np.argmax(y >= level))
        if not y[k] >= level:
            return math.nan
        return float(np.interp(level, y[k - 1:k + 1], time[k - 1:k + 1])) if k else float(time[0])

    outside = np.flatnonzero(np.abs(y - final) > BAND * final)
    last = int(outside[-1]) if outside.size else -1
    settled = math.nan
    if last < 0:
        settled = float(time[0])
    elif last + 1 < len(y):
        error = np.abs(y[last:last + 2] - final)
        settled = float(np.interp(-BAND * final, -error, time[last:last + 2]))
    peak = int(np.argmax(y))
    peak_time = float(time[peak])
    if 0 < peak < len(y) - 1:  # between the samples, by a parabola
        a, b, c = y[peak - 1:peak + 2]
        peak_time += 0.5 * float((a - c) / (a - 2.0 * b + c)) * float(time[1] - time[0])
    return StepFeatures(final, first_above(0.9 * final) - first_above(0.1 * final), peak_time, settled,
                        float(y[peak]) / final - 1.0)
