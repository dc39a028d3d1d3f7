# SPDX-License-Identifier: Apache-2.0
"""Controllers of the blind check, written for it: the package has none of them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from evaluation.blind import cases
from evaluation.blind.plant import PERIOD


def relay(rng: np.random.Generator) -> Callable[[float, float], float]:
    """A controller with two levels and a hysteresis."""
    low, high, goal = rng.uniform(0.0, 0.15), rng.uniform(0.35, 0.5), rng.uniform(0.15, 0.5)
    memory = {"u": high}

    def law(t: float, theta: float) -> float:
        wanted = goal + 0.1 * math.sin(0.5 * t)
        if abs(theta - wanted) > 0.03:
            memory["u"] = high if theta < wanted else low
        return memory["u"]

    return law


def lead(rng: np.random.Generator) -> Callable[[float, float], float]:
    """A lead compensator around the duty that holds the arm, following a slow triangle."""
    gain, mean, period = rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.3), rng.uniform(6.0, 15.0)
    zero, pole = rng.uniform(2.0, 4.0), rng.uniform(20.0, 40.0)
    memory = {"error": 0.0, "u": 0.0}

    def law(t: float, theta: float) -> float:
        goal = 0.1 + 0.5 * abs(2.0 * (t / period % 1.0) - 1.0)
        error = goal - theta
        keep = math.exp(-pole * PERIOD)
        memory["u"] = keep * memory["u"] + gain * pole / zero * (error - memory["error"] * math.exp(-zero * PERIOD))
        memory["error"] = error
        return min(max(mean + memory["u"], 0.0), 0.7)

    return law


ALL = (cases.pid, relay, lead)
"""Each makes a law (t, angle shown) -> duty from a generator of random numbers."""
