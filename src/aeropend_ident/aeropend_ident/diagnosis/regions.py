# SPDX-License-Identifier: Apache-2.0
"""Where the gap arises: the share of each place of the chain, and the ranges of operation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.values import STAGES
from aeropend_ident.diagnosis.document import Region
from aeropend_ident.diagnosis.search import gust
from aeropend_ident.diagnosis.search.findings import Findings
from aeropend_ident.estimation.map_fit import Fit
from aeropend_sim.model.effects import PLACES

Array = NDArray[np.float64]

BINS = 12
"""Ranges into which a variable is divided, by quantiles (choice)."""

NOTEWORTHY = 0.15
"""Excess of a region's share of the misfit over its share of the time above which it is reported (choice)."""

MOST = 3
"""Regions that are reported at most (choice)."""


@dataclass(frozen=True)
class Misfit:
    """The misfit of the nominal structure where it is largest.

    Attributes:
        signal: (M,) the misfit of a voltage, a current, or the torque on the arm that would cause that of the angle.
        variables: name -> (M,) the variables beside it.
    """

    signal: Array
    variables: Mapping[str, Array]


def shares(amounts: Iterable[tuple[str, float]]) -> dict[str, float]:
    """Share of each place in the gap.

    Args:
        amounts: place and squared gap, which comes back when a finding is taken out again.
    """
    total = dict.fromkeys(PLACES, 0.0)
    for place, amount in amounts:
        total[place] += amount
    everything = sum(total.values())
    return {place: (x / everything if everything > 0.0 else 0.0) for place, x in total.items()}


def largest_misfit(chains: CutChains, findings: Mapping[str, Findings]) -> Misfit:
    """The misfit of the stage that the nominal structure fits worst, in the first recording."""
    stage = max(STAGES, key=lambda b: _worst(findings[b].base))
    chain, arm = chains.each[0], findings["arm"]
    s = chain.signals
    if stage == "actuator":
        misfit, index = s.v_a - chain.actuator(chains.values_of(arm.final.values, 0)), np.arange(len(s))
    elif stage == "motor":
        misfit = s.i_a - chain.motor(chains.values_of(findings["motor"].base.values, 0))[0]
        index = np.arange(len(s))
    else:
        g = gust.track(chains, arm.final, arm.base)
        misfit, index = g.torque, g.index
    theta = gust.filled_angle(chains, s)
    rate = np.gradient(gust.smoothed_angle(theta), s.period)
    seen = s.theta if chains.policy.calibrated else theta
    variables: dict[str, Array] = {"theta": seen[index], "theta_dot": rate[index], "omega": chain.speed[index],
                 "i_a": s.i_a[index], "duty": s.duty[index], "t": np.asarray(index * s.period, dtype=float)}
    return Misfit(misfit[: len(index)], variables)


def regions(misfit: Misfit, most: int = MOST) -> list[Region]:
    """The ranges of each variable in which the misfit concentrates, the most concentrated first.

    Args:
        misfit: its square is divided among the ranges.
        most: number of regions at most.
    """
    energy = np.nan_to_num(misfit.signal) ** 2
    if energy.sum() <= 0.0:
        return []
    found: list[Region] = []
    for name, x in misfit.variables.items():
        known = np.isfinite(x)
        if known.sum() <= BINS:
            continue
        edges = np.unique(np.quantile(x[known], np.linspace(0.0, 1.0, BINS + 1)))
        if len(edges) < 4:
            continue
        which = np.clip(np.searchsorted(edges, x[known], side="right") - 1, 0, len(edges) - 2)
        share = np.bincount(which, energy[known], len(edges) - 1)
        share = share / max(share.sum(), 1e-300)
        time = np.bincount(which, minlength=len(edges) - 1) / known.sum()
        a, b = _best_run(share - time)
        found.append(Region(name, float(edges[a]), float(edges[b + 1]), float(share[a:b + 1].sum()),
                            float(time[a:b + 1].sum())))
    found.sort(key=lambda r: r.time - r.share)
    return [r for r in found if r.share - r.time > NOTEWORTHY][:most]


def _best_run(x: Array) -> tuple[int, int]:
    """First and last index of the contiguous run of x (N,) with the largest sum (Kadane's algorithm)."""
    best, at, total, start = -np.inf, (0, 0), 0.0, 0
    for j, value in enumerate(x):
        if total <= 0.0:
            total, start = 0.0, j
        total += value
        if total > best:
            best, at = total, (start, j)
    return at


def _worst(f: Fit) -> float:
    return max((float(np.mean(r * r)) for r in f.residuals.values()), default=0.0)
