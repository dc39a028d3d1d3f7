# SPDX-License-Identifier: Apache-2.0
"""Figures of a recorded step response: t_r, t_p, t_s, M_p and the steady-state error."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aeropend_sim.errors import UserError
from aeropend_sim.model.step_features import step_features

Array = NDArray[np.float64]

SETTLED_SHARE = 0.2
"""Share of a step, at its end, whose mean is the final value (choice)."""

RESOLVED = 4.0
"""Least height of a step or of an overshoot, in standard deviations of the noise of the response (choice)."""


class StepError(UserError):
    """The recording has no step that can be described; the message is one line for the user."""


class StepResponse(NamedTuple):
    """A step and the response to it. Times count from the step; NaN if the response does not reach the event.

    Attributes:
        start: [s] time of the step.
        reference: value of the reference after the step.
        initial: value of the response at the step.
        final: value of the response at the end.
        rise_time: [s] t_r, from 10 % to 90 % of the height of the step.
        peak_time: [s] t_p, of the highest peak; NaN without overshoot.
        settling_time: [s] t_s, after which the response stays within 2 % of the height of the step.
        overshoot: M_p, as a share of the height of the step; 0 if it is not above the noise.
        steady_state_error: reference minus final value.
    """

    start: float
    reference: float
    initial: float
    final: float
    rise_time: float
    peak_time: float
    settling_time: float
    overshoot: float
    steady_state_error: float


def step_responses(time: ArrayLike, y: ArrayLike, reference: ArrayLike, smoothing: float = 0.06) -> list[StepResponse]:
    """Describe the response to every step of a reference that is constant between its steps.

    The response is smoothed by local parabolas without lag (Savitzky-Golay), so that noise and quantisation are not
    taken for an overshoot or an exit from the 2 % band. A step lasts until the next one. Before the first step the
    reference is assumed to be equal to the response.

    Args:
        time: [s] (N,) uniform and rising.
        y: (N,) response.
        reference: (N,) in the unit of `y`.
        smoothing: [s] width of the parabolas; 0: none.

    Returns:
        An entry for each step, in order of time.

    Raises:
        StepError: no step, arrays of different lengths, NaN, or a response that does not move.
    """
    time, y, reference = (np.asarray(x, dtype=float) for x in (time, y, reference))
    if not time.shape == y.shape == reference.shape or time.ndim != 1:
        raise StepError(f"time, response and reference are of different lengths: {time.shape}, {y.shape}, "
                        f"{reference.shape}; give one of each for every sample")
    if not (np.isfinite(time).all() and np.isfinite(y).all() and np.isfinite(reference).all()):
        raise StepError("time, response or reference holds NaN or inf; leave such samples out, or fill them in")
    if len(y) < 2 or (np.diff(time) <= 0.0).any():
        raise StepError("time does not rise from sample to sample; sort the samples by their stamps")
    smooth, noise = _smoothed(time, y, smoothing)
    edges = [0, *(np.flatnonzero(np.diff(reference)) + 1).tolist(), len(y)]
    described, before = [], float(smooth[0])
    for a, b in pairwise(edges):
        if a > 0 or not math.isclose(reference[0], before, abs_tol=RESOLVED * noise):
            described.append(_describe(time[a:b], smooth[a:b], float(reference[a]), before, noise))
        before = _final(smooth[a:b])
    if not described:
        raise StepError(f"no step: the reference stays at {reference[0]:g}, where the response is from the start")
    return described


def _smoothed(time: Array, y: Array, width: float) -> tuple[Array, float]:
    """The smoothed response (N,), and the standard deviation of its remaining noise."""
    from scipy.signal import savgol_coeffs, savgol_filter  # takes long to import

    noise = math.sqrt(float(np.mean(np.diff(y, 2) ** 2)) / 6.0) if len(y) > 2 else 0.0
    window = 2 * round(0.5 * width * (len(time) - 1) / float(time[-1] - time[0])) + 1
    window = min(window, len(y) - 1 + len(y) % 2)
    if window < 5:
        return y, noise
    return savgol_filter(y, window, 2), noise * float(np.linalg.norm(savgol_coeffs(window, 2)))


def _final(y: Array) -> float:
    return float(np.mean(y[-max(1, round(SETTLED_SHARE * len(y))):]))


def _describe(time: Array, y: Array, reference: float, initial: float, noise: float) -> StepResponse:
    start, final = float(time[0]), _final(y)
    way = abs(final - initial)
    if way <= RESOLVED * noise or way == 0.0:
        raise StepError(f"the response does not move after the step to {reference:g} at {start:g} s; "
                        "is the controller on, and the reference within its range?")
    up = math.copysign(1.0, final - initial)
    f = step_features(time - start, up * (y - initial), way)
    peaks = f.overshoot * way > RESOLVED * noise
    return StepResponse(start, reference, initial, final, f.rise_time, f.peak_time if peaks else math.nan,
                        f.settling_time, f.overshoot if peaks else 0.0, reference - final)
