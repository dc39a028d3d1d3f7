# SPDX-License-Identifier: Apache-2.0
"""The optimiser of the MAP fit beside `scipy.optimize.least_squares` on the same problems."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.search.findings import adopted
from aeropend_ident.diagnosis.search.hypotheses import hypotheses
from aeropend_ident.estimation.levenberg_marquardt import Search
from aeropend_ident.estimation.map_fit import MAY_CHANGE, WEIGHT_CHANGE, fit
from aeropend_ident.estimation.parameter import Parameter, started
from aeropend_ident.estimation.residuals import Residuals
from aeropend_ident.testing.rigs import BENCH, recorded
from evaluation.benchmarks import measure
from evaluation.benchmarks.measure import Figure, Spread, interleaved

Array = NDArray[np.float64]
Problem = tuple[Callable[[dict[str, float]], Residuals], Sequence[Parameter]]
"""A residual function and the parameters to be fitted."""

ROUNDS, STEPS = 10, 4
"""Rounds of a fit, and steps in each, for both."""

EFFECTS = ("coulomb_friction", "thrust_lag", "quadratic_drag", "angle_offset")


def problems() -> list[Problem]:
    """Fits as a diagnosis makes them: the arm with one of some effects on top, of a rig with friction."""
    chains = CutChains(BENCH, [recorded(6, {"coulomb_friction": {}}, duration=40.0)])
    known = nominal_parameters(chains, "arm")
    some = [h for h in hypotheses(BENCH) if h.effect in EFFECTS]
    return [(chains.residuals("arm"), parameters) for parameters in (known, *(adopted(known, h) for h in some))]


def by_scipy(problem: Problem) -> float:
    """Fit with `least_squares` in place of our steps, weights renewed as `fit` does; returns the cost."""
    search = Search(*problem)

    def residuals(z: Array) -> Array:
        return np.concatenate([search.stack(search.at(z)), z])

    def jacobian(z: Array) -> Array:
        search.z, search.current = z, search.at(z)
        return np.vstack([search.stacked(search.jacobian()).T, np.eye(len(z))])

    for _ in range(ROUNDS):
        solution = least_squares(residuals, search.z, jac=jacobian, bounds=(search.low, search.high), x_scale="jac",
                                 max_nfev=STEPS + 1)
        search.z, search.current = solution.x, search.at(solution.x)
        before = search.weight
        search.renew_weights()
        changed = sum(abs(search.weight[k] - before[k]) >= WEIGHT_CHANGE * before[k] for k in before)
        if changed <= MAY_CHANGE * len(before):
            break
    return cost(search)


def by_fit(problem: Problem) -> float:
    """Fit with `map_fit.fit`; returns the cost."""
    residuals, parameters = problem
    found = fit(residuals, parameters, ROUNDS, STEPS)
    return cost(Search(residuals, started(parameters, found.values)))


def cost(search: Search) -> float:
    """Cost at the end of a fit."""
    r = search.stack(search.current)
    return float(r @ r + search.z @ search.z)


def optimiser(quick: bool) -> list[Figure]:
    """CPU time of both over all problems, and how close their costs are."""
    load, every = measure.load(), problems()
    ours, peer = interleaved(3 if quick else 9, lambda: [fit(*p, ROUNDS, STEPS) for p in every],
                             lambda: [by_scipy(p) for p in every])
    worse = max(by_fit(p) / by_scipy(p) for p in every)
    return [Figure("MAP fits of the arm, 40 s, with and without an effect", "s CPU", Spread.of(ours), None,
                   "scipy least_squares (trf), same residuals, Jacobian and weights", Spread.of(peer),
                   Spread.of(ours / peer), load=load,
                   note=f"cost at the end over scipy's, worst of {len(every)}: {worse:.4f}")]
