# SPDX-License-Identifier: Apache-2.0
"""Whether what a model leaves of the arm is a random torque, `gust`, which no fit of the cut chain can follow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import Chains, with_values
from aeropend_ident.diagnosis.chain.priors import nominal_unknowns
from aeropend_ident.diagnosis.search.free_curves import hats, shapes
from aeropend_ident.diagnosis.search.gauss_markov import Gust, fit_gust, follows_state, gauss_markov
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis
from aeropend_ident.diagnosis.search.search import Findings, drop_unneeded, refit
from aeropend_ident.diagnosis.search.selection import GOOD_ENOUGH, Weighed, counts_of
from aeropend_ident.estimation.map_fit import Fit, Unknown
from aeropend_ident.signals.signals import Signals

Array = NDArray[np.float64]

RANDOM = 0.35
"""A torque on the arm passes as random while the state predicts less than this share of it where it was not fitted."""

LIKE_CHANCE = 0.4, 5.0
"""And while what free curves leave of it, over what they would leave of such a torque (of a short recording they follow
most of what chance does, too), lies between these. Of 43 true gusts 42 had 0.65 to 3.3; what a misled model of a rig
leaves has 7 and more."""

JUMPS = 5.0
"""Innovations of the torque's filter that are heavier than this are of an angle that jumps. A random torque has 1; a
coupling that slips by 0.08 rad every two seconds 20 and more."""

DRAWS = 20
"""Random torques from which that share is known."""


def found(chains: Chains, arm: Findings) -> Weighed | None:
    """`gust`, if that is what the arm leaves; of an unknown rig, `arm` loses what is not needed beside it."""
    torque = _weighed(chains, arm.final)
    if torque is not None and arm.found and chains.fit_nominal:
        _drop_what_chance_explains(chains, arm)
        torque = _weighed(chains, arm.final)
    return torque


def tracked(chains: Chains, arm: Fit, follow: Fit | None = None) -> Gust:
    """The random torque that would do what a fit of the arm leaves; `follow`: what another one leaves."""
    chain = chains.each[0]
    s = chain.signals
    n = with_values(chains.model, chains.own(arm.values, 0)).numbers()
    left = (s.theta - chain.arm(chains.own((follow or arm).values, 0)))[: s.train]
    return fit_gust(left, s.theta[: s.train], n["mgd_over_J"], n["c_over_J"], s.sigma["theta"], s.period)


def angle(chains: Chains, s: Signals) -> Array:
    """The angle (N,) without gaps: of an unknown rig, which may be read seldom, with lines across them."""
    if not chains.fit_nominal:
        return np.nan_to_num(s.theta)
    known = np.flatnonzero(np.isfinite(s.theta))
    return np.interp(np.arange(len(s)), known, s.theta[known])


def calm(x: Array) -> Array:
    """A moving mean (N,) long enough to take a derivative of quantised angles."""
    kernel = np.hanning(27)[1:-1]
    return np.convolve(np.pad(x, 12, mode="edge"), kernel / kernel.sum(), mode="valid")


def _weighed(chains: Chains, final: Fit) -> Weighed | None:
    """`gust`, if what a fit of the arm leaves is a random torque: no state predicts it, and no free curve takes it."""
    if final.scale.get("theta", 1.0) <= GOOD_ENOUGH:
        return None
    chain = chains.each[0]
    s = chain.signals
    g = tracked(chains, final)
    theta, speed = angle(chains, s)[g.index], chain.speed[g.index]
    rate = np.gradient(calm(theta), g.index * s.period)
    slope = np.gradient(speed, g.index * s.period)
    columns = np.hstack([*(hats(x)[0] for x in (theta, rate, speed, slope)), (speed * rate)[:, None]])
    known = [Unknown(u.name, u.mean, u.sd, u.low, u.high, None, u.log) for u in nominal_unknowns(chains, "arm")
             if u.name in final.values]
    if g.gain <= 0.0 or g.heavy > JUMPS or follows_state(g.torque, columns) >= RANDOM:
        return None
    rng = np.random.default_rng(0)
    curves = shapes(chains, "arm", final, known, torques=lambda n: gauss_markov((DRAWS, n), g.tau, s.period, rng))[0]
    low, high = (x * curves.left_of_chance * (curves.before - 1.0) for x in LIKE_CHANCE)
    if not low < curves.left - 1.0 < high:
        return None
    values = {"gust.sigma": g.sigma, "gust.tau": g.tau}
    sd = {"gust.sigma": g.sigma * g.sigma_sd, "gust.tau": g.tau * g.tau_sd}
    return Weighed(Hypothesis("gust"), Fit(values, sd, {}, {}, {}, 0.0, {}), g.gain, 1.0)


def _drop_what_chance_explains(chains: Chains, arm: Findings) -> None:
    """Take out what is not needed beside a random torque: chance looks like many an effect."""
    def without(h: Hypothesis) -> Fit:
        return refit(chains, "arm", [e for e in arm.effects if e is not h], arm.final.values)

    def lost(f: Fit) -> float:
        counts = counts_of([arm.final, f])
        simpler = f.simplicity(counts) - arm.final.simplicity(counts)
        return tracked(chains, arm.final).likelihood - tracked(chains, f).likelihood - simpler

    drop_unneeded(arm, without, lost)
