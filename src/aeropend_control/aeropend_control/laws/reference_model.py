# SPDX-License-Identifier: Apache-2.0
"""Reference model: the smooth motion that a loop follows after a step of its reference."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import expm

from aeropend_sim.model.parameters import SAMPLE_PERIOD

DAMPING, THIRD_POLE = 0.75, 3.0
"""Damping ratio of the pole pair, and ratio of the third pole to the frequency of the pair (choices;
the pair has 3 % overshoot)."""


class ReferenceModel:
    """Third-order filter ω²p / ((s² + 2ζωs + ω²)(s + p)), discretised exactly. Its jerk is finite."""

    def __init__(self, time: float, period: float = SAMPLE_PERIOD) -> None:
        """Prepare the filter.

        Args:
            time: [s] 1/ω; 0: the output is the reference itself.
            period: [s] between samples.
        """
        self.time = time
        self._state = np.zeros(3)
        if time == 0.0:
            return
        omega = 1.0 / time
        p = THIRD_POLE * omega
        last = np.array([-omega**2 * p, -(omega**2 + 2.0 * DAMPING * omega * p), -(2.0 * DAMPING * omega + p)])
        a = np.zeros((4, 4))
        a[0, 1] = a[1, 2] = 1.0
        a[2, :3], a[2, 3] = last, omega**2 * p
        self._jerk = a[2]
        self._transition = expm(a * period)[:3]

    def reset(self, y: float, rate: float = 0.0, acceleration: float = 0.0) -> None:
        """Restart from an angle [rad], a rate [rad/s] and an acceleration [rad/s²]."""
        self._state = np.array([y, rate, acceleration])

    def step(self, reference: float) -> tuple[float, float, float, float]:
        """Process a sample of the reference [rad]; returns angle, rate, acceleration and jerk one sample later (SI)."""
        if self.time == 0.0:
            return reference, 0.0, 0.0, 0.0
        self._state = self._transition @ np.append(self._state, reference)
        y, rate, acceleration = self._state.tolist()
        jerk = self._jerk.tolist()
        return y, rate, acceleration, math.fsum((jerk[0] * y, jerk[1] * rate, jerk[2] * acceleration,
                                                 jerk[3] * reference))
