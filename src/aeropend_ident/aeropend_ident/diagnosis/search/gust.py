# SPDX-License-Identifier: Apache-2.0
"""The effect `gust`: whether the rest of the arm is a random torque, which no fit of the cut chain can follow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.chain.values import with_values
from aeropend_ident.diagnosis.policy import GOOD_ENOUGH
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis, drop_unneeded
from aeropend_ident.diagnosis.search.free_curves import hats, knots_of, missing_terms
from aeropend_ident.diagnosis.search.gauss_markov import Gust, fit_gust, follows_state, gauss_markov
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis
from aeropend_ident.diagnosis.search.search import taken_out
from aeropend_ident.estimation.map_fit import Fit, estimate, largest_ess
from aeropend_ident.signals.signals import Signals

Array = NDArray[np.float64]

RANDOM = 0.35
"""Share of a torque that the state may predict in cross-validation for the torque to be random (choice).

Measured: at ±30 % no verdict of 1 recording changes (docs/results/thresholds.md)."""

LIKE_RANDOM = 0.4, 5.0
"""Range of what free curves leave of the rest, over what they would leave of a random torque of the same tau.

Measured: of 43 true gusts 42 had 0.65 to 3.3; what a wrong model of a rig leaves has 7 and more. In a short recording
curves follow most of a random torque too, hence the ratio."""

JUMPS = 5.0
"""Kurtosis of the innovations, over that of a normal distribution, above which the angle jumps.

Measured: a random torque has 1; a coupling that slips by 0.08 rad every two seconds has 20 and more."""

DRAWS = 20
"""Random torques from which the share that free curves leave of them is computed (choice).

Measured: at ±30 % no verdict of 1 recording changes (docs/results/thresholds.md)."""


@dataclass(frozen=True)
class GustDetection:
    """The effect `gust`, if it was detected, and what remains found of the arm beside it."""

    gust: RankedHypothesis | None
    arm: Findings


def detect(chains: CutChains, arm: Findings) -> GustDetection:
    """Test the rest of the arm for a random torque.

    Args:
        chains: cut; their arms have their inputs.
        arm: what was found in the arm.

    Returns:
        The effect; for an uncalibrated rig, the findings without the effects that a random torque explains.
    """
    gust = _judged(chains, arm.final)
    if gust is not None and arm.found and not chains.policy.calibrated:
        arm = _without_random(chains, arm)
        gust = _judged(chains, arm.final)
    return GustDetection(gust, arm)


def track(chains: CutChains, arm: Fit, follow: Fit | None = None) -> Gust:
    """The random torque that would cause the residual of the angle in the first recording.

    Args:
        chains: cut.
        arm: a fit of the arm, whose parameters the filter takes.
        follow: the fit whose residual is tracked; by default the same.
    """
    chain = chains.each[0]
    s = chain.signals
    n = with_values(chains.model, chains.values_of(arm.values, 0)).numbers()
    left = (s.theta - chain.arm(chains.values_of((follow or arm).values, 0)))[: s.train]
    return fit_gust(left, s.theta[: s.train], n["mgd_over_J"], n["c_over_J"], s.sigma["theta"], s.period)


def filled_angle(chains: CutChains, s: Signals) -> Array:
    """[rad] The angle (N,) without gaps; interpolated for an uncalibrated rig, which may be sampled at a low rate."""
    if chains.policy.calibrated:
        return np.nan_to_num(s.theta)
    known = np.flatnonzero(np.isfinite(s.theta))
    return np.interp(np.arange(len(s)), known, s.theta[known])


def smoothed_angle(x: Array) -> Array:
    """An angle (N,) smoothed by a Hann window of 25 samples, for the derivative of quantised readings."""
    kernel = np.hanning(27)[1:-1]
    return np.convolve(np.pad(x, 12, mode="edge"), kernel / kernel.sum(), mode="valid")


def _judged(chains: CutChains, final: Fit) -> RankedHypothesis | None:
    """`gust` if the rest of a fit of the arm is a random torque: no state predicts it, and no free curve fits it."""
    if final.scale.get("theta", 1.0) <= GOOD_ENOUGH:
        return None
    chain = chains.each[0]
    s = chain.signals
    g = track(chains, final)
    theta, speed = filled_angle(chains, s)[g.index], chain.speed[g.index]
    rate = np.gradient(smoothed_angle(theta), g.index * s.period)
    slope = np.gradient(speed, g.index * s.period)
    columns = np.vstack([*(hats(x, knots_of(x)) for x in (theta, rate, speed, slope)), speed * rate]).T
    known = [p for p in nominal_parameters(chains, "arm") if p.name in final.values]
    if g.gain <= 0.0 or not g.resolved or g.kurtosis > JUMPS or follows_state(g.torque, columns) >= RANDOM:
        return None
    rng = np.random.default_rng(0)
    term = missing_terms(chains, "arm", final, known,
                         torques=lambda n: gauss_markov((DRAWS, n), g.tau, s.period, rng))[0]
    low, high = (x * term.left_of_random * (term.before - 1.0) for x in LIKE_RANDOM)
    if not low < term.left - 1.0 < high:
        return None
    values = {"gust.sigma": g.sigma, "gust.tau": g.tau}
    sd = {"gust.sigma": g.sigma * g.sigma_sd, "gust.tau": g.tau * g.tau_sd}
    return RankedHypothesis(Hypothesis("gust"), estimate(values, sd), g.gain, 1.0)


def _without_random(chains: CutChains, arm: Findings) -> Findings:
    """The findings without effects that are not needed beside a random torque, which resembles many an effect."""
    def lost(now: Findings, fewer: Findings) -> float:
        ess = largest_ess([now.final, fewer.final])
        simpler = fewer.final.log_occam(ess) - now.final.log_occam(ess)
        return track(chains, now.final).log_likelihood - track(chains, fewer.final).log_likelihood - simpler

    return drop_unneeded(arm, partial(taken_out, chains), lost)
