# SPDX-License-Identifier: Apache-2.0
"""Screening: what additions to a model would do if it were linear."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from aeropend_ident.estimation.levenberg_marquardt import Search
from aeropend_ident.estimation.map_fit import Fit
from aeropend_ident.estimation.parameter import Parameter, started
from aeropend_ident.estimation.residuals import Residuals, finite


class Screened(NamedTuple):
    """What an addition would do if the model were linear.

    Attributes:
        left: share of the weighted sum of squares that it would leave; 1 where it changes nothing.
        values: name -> value of all parameters there.
    """

    left: float
    values: dict[str, float]


def screen(residuals: Callable[[dict[str, float]], Residuals], base: Fit, known: Sequence[Parameter],
           additions: Sequence[Sequence[Parameter]], least_ess: float = 0.0) -> list[Screened]:
    """What each addition would do if the model were linear: one least-squares solve each.

    Args:
        residuals: as for `fit`.
        base: the fit without additions.
        known: its parameters.
        additions: groups of parameters, each tried at its starts; the first is a size, 0 effect at its mean.
        least_ess: as for `fit`.
    """
    search = Search(residuals, started(known, base.values), least_ess)
    r = search.stack(search.current)
    slopes = search.jacobian()
    information, gradient, _ = search.normal_equations(slopes)
    cost = float(r @ r + search.z @ search.prior @ search.z)
    left = []
    for group in additions:
        values = {**base.values, **{p.name: p.begin for p in group}}
        changed = {k: finite(np.asarray(x)) for k, x in residuals(values).items() if len(x)}
        column = search.stack({k: changed[k] for k in search.weight}) - r
        power = float(column @ column)
        if not np.isfinite(power) or power == 0.0:
            left.append(Screened(1.0, values))
            continue
        cross, at = np.zeros(len(search.z)), 0
        for s in slopes.values():
            cross[s.by] += s.rows @ column[at:at + s.rows.shape[1]]
            at += s.rows.shape[1]
        # a little ridge keeps the matrix regular where a known parameter does the same
        bordered = np.block([[information, cross[:, None]], [cross, (1.0 + 1e-9) * power]])
        right = np.append(gradient, column @ r)
        solved = np.linalg.solve(bordered, right)
        moved = np.clip(search.z - solved[:-1], search.low, search.high)
        size, *_ = group
        there = min(max(size.mean - float(solved[-1]) * (size.begin - size.mean), size.low), size.high)
        left.append(Screened(max(cost - float(right @ solved), 0.0) / max(cost, 1e-300),
                             {**values, **{p.name: p.value(x) for p, x in zip(known, moved, strict=True)},
                              size.name: there}))
    return left
