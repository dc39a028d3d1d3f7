# SPDX-License-Identifier: Apache-2.0
"""Where: the share of each part of the chain in the gap, and the region of operation in which it arises."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import BLOCKS, Chains
from aeropend_ident.diagnosis.search import gust
from aeropend_ident.diagnosis.search.search import Findings
from aeropend_ident.estimation.map_fit import Fit
from aeropend_sim.model.effects import PLACES

Array = NDArray[np.float64]

BINS = 12
NOTEWORTHY = 0.15
"""A region is named when its share of the misfit exceeds its share of the time by this much."""


def shares(amounts: Iterable[tuple[str, float]]) -> dict[str, float]:
    """Share of each place, from amounts of squared gap by place: what comes back when a finding is taken out again."""
    total = dict.fromkeys(PLACES, 0.0)
    for place, amount in amounts:
        total[place] += amount
    everything = sum(total.values())
    return {place: (x / everything if everything > 0.0 else 0.0) for place, x in total.items()}


def misfit_signal(chains: Chains, findings: Mapping[str, Findings]) -> tuple[Array, dict[str, Array]]:
    """What the part that explains least leaves of its signal, and what regions may be drawn in, each (M,)."""
    block = max(BLOCKS, key=lambda b: _worst(findings[b].base))
    chain, arm = chains.each[0], findings["arm"]
    s = chain.signals
    if block == "actuator":
        misfit, index = s.v_a - chain.actuator(chains.own(arm.final.values, 0)), np.arange(len(s))
    elif block == "motor":
        misfit = s.i_a - chain.motor(chains.own(findings["motor"].base.values, 0))[0]
        index = np.arange(len(s))
    else:
        g = gust.tracked(chains, arm.final, arm.base)
        misfit, index = g.torque, g.index
    theta = gust.angle(chains, s)
    rate = np.gradient(gust.calm(theta), s.period)
    seen = theta if chains.fit_nominal else s.theta
    variables: dict[str, Array] = {"theta": seen[index], "theta_dot": rate[index], "omega": chain.speed[index],
                 "i_a": s.i_a[index], "duty": s.duty[index], "t": np.asarray(index * s.period, dtype=float)}
    return misfit[: len(index)], variables


def regions(misfit: Array, variables: Mapping[str, Array], most: int = 3) -> list[dict[str, Any]]:
    """The ranges of each variable in which the misfit concentrates, most concentrated first.

    Args:
        misfit: (M,) any measure with sign; its square is what is shared out.
        variables: name -> (M,).
        most: how many at most.

    Returns:
        variable, low, high, share of the squared misfit, and share of the time.
    """
    energy = np.nan_to_num(misfit) ** 2
    if energy.sum() <= 0.0:
        return []
    found: list[dict[str, Any]] = []
    for name, x in variables.items():
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
        found.append({"variable": name, "low": float(edges[a]), "high": float(edges[b + 1]),
                      "share": float(share[a:b + 1].sum()), "time": float(time[a:b + 1].sum())})
    found.sort(key=lambda r: r["time"] - r["share"])
    return [r for r in found if r["share"] - r["time"] > NOTEWORTHY][:most]


def _best_run(x: Array) -> tuple[int, int]:
    """First and last index of the contiguous run with the largest sum (Kadane)."""
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
