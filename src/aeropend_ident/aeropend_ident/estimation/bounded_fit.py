# SPDX-License-Identifier: Apache-2.0
"""A fit by least squares within bounds, whatever the priors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.optimize import lsq_linear

from aeropend_ident.estimation.levenberg_marquardt import Search
from aeropend_ident.estimation.parameter import Parameter
from aeropend_ident.estimation.residuals import Residuals, Sensitivities

DAMPINGS = (0.0, 1e-2, 1e-1, 1.0, 10.0)
"""Dampings that are tried until a step of `within_bounds` succeeds (choice: the derivatives are approximate)."""

RIDGE = 1e-12
"""Relative ridge that keeps a matrix regular, and least room for a step (choice: far below any step that counts)."""

NEGLIGIBLE = 3e-3
"""Relative decrease of the sum of squares at which `within_bounds` ends (choice: a gap then changes by 0.2 %)."""


def sensitivities(residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter]
                  ) -> dict[str, Sensitivities]:
    """Channel -> derivatives of the residuals with respect to the parameters in standard units, where these start."""
    return Search(residuals, parameters, math.inf).differences()


def within_bounds(residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter],
                  slopes: Mapping[str, Sensitivities], steps: int) -> dict[str, float]:
    """The values with the smallest sum of squares within the bounds, whatever the priors.

    Gauss-Newton steps, each solved exactly for the bounds (P. Stark, R. Parker: Bounded-variable least squares. 1995),
    with derivatives that are corrected by Broyden's formula.

    Args:
        residuals: values by name -> residuals; all count alike.
        parameters: to be fitted, from their starts.
        slopes: of `sensitivities`, at a point nearby.
        steps: at most.
    """
    search = Search(residuals, parameters, math.inf)
    search.slopes = dict(slopes)
    for _ in range(steps):
        r = search.stack(search.current)
        cost = float(r @ r)
        rows = search.stacked(search.weighted(search.slopes))
        information, gradient = rows @ rows.T, rows @ r
        ridge = RIDGE * np.trace(information) / len(information) * np.eye(len(information))
        new = cost
        for damping in DAMPINGS:
            root = np.linalg.cholesky(information + damping * np.diag(np.diag(information)) + ridge)
            room = (np.minimum(search.low - search.z, -RIDGE), np.maximum(search.high - search.z, RIDGE))
            step = lsq_linear(root.T, -np.linalg.solve(root, gradient), room, method="bvls").x
            z = np.clip(search.z + step, search.low, search.high)
            trial = search.at(z)
            r = search.stack(trial)
            new = float(r @ r)
            if new < cost:
                search.slopes = {k: s.corrected(z - search.z, trial[k] - search.current[k])
                                 for k, s in search.slopes.items()}
                search.z, search.current = z, trial
                break
        if not new < (1.0 - NEGLIGIBLE) * cost:
            break
    return {p.name: p.value(x) for p, x in zip(parameters, search.z, strict=True)}
