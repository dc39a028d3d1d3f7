# SPDX-License-Identifier: Apache-2.0
"""The peer: the model that a careful person fits to angle and command first.

    ds/dt = (max(u(t - T) - u0, 0)^p - s) / τ,  τ = τ_up or τ_down
    θ'' = K s - c θ' - f θ' / sqrt(θ'² + v²) - G sin(θ - θ0)

All is fitted to the free run by `scipy.optimize.least_squares`, from several starts. Nothing of it is shared with
`diagnose`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

STEP = 0.005
"""[s] Longest step of the integration; a denser recording is thinned to it (choice: far below the arm's period)."""

STICK = 0.02
"""[rad/s] Speed at which the dry friction has 71 % of its size (choice: well below the speeds of a swing)."""

PERIODS = (0.5, 1.0, 2.0, 4.0)
"""[s] Periods of the arm that fits start from (choice: rods of 6 cm to 4 m)."""

LAGS = (0.1, 0.6)
"""[s] Lags of the thrust that fits start from (choice)."""

FRICTIONS = (0.0, 0.02)
"""Dry friction over gravity that fits start from (choice: an arm that sticks at once shows no gradient)."""

SCREENED, EVALUATIONS, FOLLOWED = 12, 150, 3
"""Evaluations for each start, then for the best of them, and how many these are (choice)."""

NAMES = ("G", "c", "K", "u0", "p", "lag", "slower", "delay", "friction", "theta0", "start", "speed")
LOWEST = np.array([-5.0, -9.0, -12.0, 0.0, 0.3, -6.0, -2.0, 0.0, 0.0, -1.0, -4.0, -30.0])
HIGHEST = np.array([7.0, 5.0, 12.0, 0.9, 4.0, 2.0, 2.0, 0.5, 5.0, 1.0, 4.0, 30.0])


@dataclass(frozen=True)
class GreyBox:
    """A fitted grey box.

    Attributes:
        values: name -> value; G, c, K and lag as logarithms, dry friction over gravity.
        theta: [rad] (N,) free run over the whole recording.
    """

    values: dict[str, float]
    theta: Array


@njit(cache=True)
def _run(x: Array, duty: Array, period: float) -> Array:
    gravity, damping, gain = math.exp(x[0]), math.exp(x[1]), math.exp(x[2])
    dead, power, up, delay = x[3], x[4], math.exp(x[5]), x[7] / period
    down, friction, zero = up * math.exp(x[6]), x[8] * gravity, x[9]
    theta, speed = x[10], x[11]
    steps = max(math.ceil(period / STEP - 1e-9), 1)
    h = period / steps
    out = np.empty(len(duty))
    lift = max(duty[0] - dead, 0.0) ** power if abs(theta) > 0.1 else 0.0
    whole = int(delay)
    part = delay - whole
    for k in range(len(duty)):
        out[k] = theta
        new, old = duty[max(k - whole, 0)], duty[max(k - whole - 1, 0)]
        u = new if part == 0.0 else (1.0 - part) * new + part * old
        target = max(u - dead, 0.0) ** power
        keep = math.exp(-h / (up if target > lift else down))
        for _ in range(steps):
            lift = target + keep * (lift - target)
            torque = gain * lift - gravity * math.sin(theta - zero)
            # friction and damping implicitly: stable for any size
            drag = damping + friction / math.sqrt(speed * speed + STICK * STICK)
            speed = (speed + h * torque) / (1.0 + h * drag)
            theta = theta + h * speed
        if not abs(theta) < 1e3:
            out[k:] = 1e3
            return out
    return out


def fit(time: Array, theta: Array, duty: Array, train: int) -> GreyBox:
    """Fit the grey box to the beginning of a recording.

    Args:
        time: [s] (N,) instants, evenly spaced.
        theta: [rad] (N,) angle; NaN where it is missing.
        duty: (N,) applied command, 0 to 1.
        train: samples that are fitted.
    """
    dense = bool(np.isfinite(theta).mean() > 0.5)
    every = max(int(STEP / float(time[1] - time[0])), 1) if dense else 1
    t, y, u = time[::every], theta[::every], duty[::every]
    n, period = max(train // every, 2), float(t[1] - t[0])
    known = np.isfinite(y[:n])
    scale = float(np.std(y[:n][known])) or 1.0

    def residuals(x: Array) -> Array:
        return np.clip((_run(x, u[:n], period)[known] - y[:n][known]) / scale, -30.0, 30.0)

    def search(x: Array, evaluations: int) -> tuple[float, Array]:
        found = least_squares(residuals, np.clip(x, LOWEST + 1e-9, HIGHEST - 1e-9), bounds=(LOWEST, HIGHEST),
                              x_scale=np.maximum(0.1 * np.abs(x), 0.05), max_nfev=evaluations)
        return float(found.cost), found.x

    first = float(y[:n][known][0])
    reached = float(np.quantile(np.abs(y[:n][known]), 0.95))
    starts = []
    for swing, lag, friction, power in product(PERIODS, LAGS, FRICTIONS, (1.0, 1.7)):
        gravity = (2.0 * math.pi / swing) ** 2
        top = max(float(u[:n].max()), 1e-3) ** power
        gain = gravity * math.sin(min(max(reached, 0.05), 1.4)) / top
        starts.append(np.array([math.log(gravity), math.log(0.1 * math.sqrt(gravity)), math.log(gain), 0.0, power,
                                math.log(lag), 0.0, 0.01, friction, 0.0, first, 0.0]))
    screened = sorted((search(x, SCREENED) for x in starts), key=lambda found: found[0])
    _, best = min((search(x, EVALUATIONS) for _, x in screened[:FOLLOWED]), key=lambda found: found[0])
    run = _run(best, u, period)
    return GreyBox(dict(zip(NAMES, map(float, best), strict=True)), np.interp(time, t, run))


def fit_percent(run: Array, theta: Array) -> float:
    """[%] 100 (1 - |y - ŷ| / |y - mean y|), as `compare` of MATLAB's toolbox has it."""
    known = np.isfinite(theta)
    y = theta[known]
    return float(100.0 * (1.0 - np.linalg.norm(run[known] - y) / max(float(np.linalg.norm(y - y.mean())), 1e-12)))
