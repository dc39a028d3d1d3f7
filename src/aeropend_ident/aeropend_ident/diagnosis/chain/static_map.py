# SPDX-License-Identifier: Apache-2.0
"""The least that a nominal model must beat: a constant, and a static map of the duty behind a lag."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.policy import GOOD_ENOUGH
from aeropend_ident.estimation.parameter import key
from aeropend_ident.signals.signals import Signals
from aeropend_ident.signals.smoothing import lag
from aeropend_sim.wording import times

Array = NDArray[np.float64]

LAGS = np.geomspace(0.02, 10.0, 25)
"""[s] Lags that are tried (choice: from faster to slower than an arm follows its rotor)."""

ORDER = 3
"""Order of the polynomial of the duty (choice: it holds a curvature and a dead zone roughly)."""

WORSE = 1.1
"""RMS of the nominal model over that of something simpler above which it is worse (choice)."""


def mean_squares(signals: Signals) -> tuple[float, float]:
    """What a constant and a static map leave of the angle of the fitted part, in units of a reading's noise.

    Args:
        signals: a recording with duty and angle.

    Returns:
        Mean square left by a constant, and by the best static map behind a lag.
    """
    n = signals.train
    known = np.isfinite(signals.theta[:n])
    y = signals.theta[:n][known]
    scale = signals.sigma["theta"] ** 2
    least = constant = float(np.var(y))
    for tau in LAGS:
        u = lag(signals.duty[:n], tau, signals.period)[known]
        columns = np.vander(u / max(float(np.max(np.abs(u))), 1e-12), ORDER + 1)
        solution, *_ = np.linalg.lstsq(columns, y, rcond=1e-10)
        least = min(least, float(np.mean((y - columns @ solution) ** 2)))
    return constant / scale, least / scale


def why_not_identified(recordings: Sequence[Signals], residuals: Mapping[str, Array]) -> str:
    """Why the nominal model of a driven, uncalibrated rig counts as not identified; "" if it is identified.

    Args:
        recordings: of one rig.
        residuals: of the nominal model over the fitted parts, in units of a reading's noise.
    """
    simple = [(len(r), *mean_squares(recordings[key(name).recording])) for name, r in residuals.items()
              if key(name).name == "theta"]
    left = [float(np.mean(r * r)) for name, r in residuals.items() if key(name).name == "theta"]
    if not left:
        return ""
    counts, constants, maps = zip(*simple)
    constant, static, nominal = (math.sqrt(float(np.average(x, weights=counts))) for x in (constants, maps, left))
    if nominal <= GOOD_ENOUGH or nominal <= WORSE * static:
        return ""
    rival, size = ("a constant angle", constant) if nominal > WORSE * constant else (
        "a static map of the duty with a lag", static)
    return (f"the nominal model could not be identified: on the part that was fitted it is off by {times(nominal)} "
            f"a reading's noise, {rival} only by {times(size)}; check the unit, sign and zero of the angle and that "
            "the duty column is what drove the motor; steps of the duty from rest and back to 0 help most")
