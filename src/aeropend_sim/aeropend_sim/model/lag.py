# SPDX-License-Identifier: Apache-2.0
"""A first-order lag over one step, exact for an input that is quadratic (Cox & Matthews 2002)."""

import math
from functools import lru_cache
from typing import NamedTuple

from aeropend_sim.compiled import equation

NO_LAG = 1e-6
"""Share of a step below which the time constant of a lag counts as zero. A choice."""


class Lag(NamedTuple):
    """Weights of a first-order lag ẋ = -a x + g over a step h, for g quadratic through its values at 0, h/2, h.

    x(h) = decay x + w0 g0 + w1 g(h/2) + w2 g(h), and x(h/2) likewise with half_decay, u0, u1, u2.
    """

    decay: float
    w0: float
    w1: float
    w2: float
    half_decay: float
    u0: float
    u1: float
    u2: float


@equation
def lag(a: float, h: float) -> Lag:
    """The weights of a lag.

    Args:
        a: [1/s] rate, >= 0.
        h: [s] length of the step.
    """
    half = math.exp(-0.5 * a * h)
    full = half * half
    p1, p2, p3 = _phi(full, -a * h)
    q1, q2, q3 = _phi(half, -0.5 * a * h)
    s = 0.5 * h
    return Lag(full, h * (p1 - 3.0 * p2 + 4.0 * p3), h * (4.0 * p2 - 8.0 * p3), h * (4.0 * p3 - p2),
               half, s * (q1 - 1.5 * q2 + q3), s * (2.0 * q2 - 2.0 * q3), s * (q3 - 0.5 * q2))


cached_lag = lru_cache(maxsize=256)(lag)
"""`lag` for code that is not compiled: most of the lags of a model stay when one parameter changes."""


@equation
def _phi(exp_z: float, z: float) -> tuple[float, float, float]:
    """The functions of exponential integrators, φ_k(z) = Σ z^j / (j + k)!, for k = 1, 2, 3."""
    if abs(z) > 0.3:  # a choice: nearer to 0 the differences lose digits, and the series below is exact to rounding
        per_z = 1.0 / z
        p1 = (exp_z - 1.0) * per_z
        p2 = (p1 - 1.0) * per_z
        return p1, p2, (p2 - 0.5) * per_z
    p3 = term = 1.0 / 6.0
    for j in range(4, 16):
        term *= z / j
        p3 += term
    p2 = 0.5 + z * p3
    return 1.0 + z * p2, p2, p3
