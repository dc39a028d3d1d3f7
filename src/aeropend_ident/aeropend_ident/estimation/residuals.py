# SPDX-License-Identifier: Apache-2.0
"""Residuals of several channels: their weights in a fit, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.signals.statistics import effective_sample_size

Array = NDArray[np.float64]

Residuals = Mapping[str, Array]
"""Channel -> residual (N,) in units of a reading's noise, missing samples left out."""

LARGEST = 1e9
"""Largest residual (choice: one beyond it is of a simulation that diverges, and products of it are still numbers)."""


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives of one channel's residual (N,).

    Attributes:
        by: (P,) indices of the parameters that change it.
        rows: (P, N) derivatives.
    """

    by: NDArray[np.intp]
    rows: Array

    def corrected(self, step: Array, change: Array) -> Sensitivities:
        """The derivatives corrected by what a step (all parameters,) changed, (N,), with Broyden's formula."""
        own = step[self.by]
        size = max(float(own @ own), 1e-300)
        return Sensitivities(self.by, self.rows + np.outer(own / size, change - own @ self.rows))

    def of(self, kept: Sequence[int]) -> Sensitivities:
        """The derivatives for some of the parameters, which are numbered anew."""
        place = {j: k for k, j in enumerate(kept)}
        at = [k for k, j in enumerate(self.by) if int(j) in place]
        return Sensitivities(np.array([place[int(self.by[k])] for k in at], np.intp), self.rows[at])


def weights(residuals: Residuals, least_ess: float = 0.0
            ) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """Weight of each channel in the cost, its noise inflation, and its effective sample size.

    Args:
        residuals: channel -> (N,) in units of a reading's noise.
        least_ess: effective sample size that a channel counts for at least.
    """
    scale = {k: max(1.0, float(np.sqrt(np.mean(r * r)))) for k, r in residuals.items()}
    ess = {k: effective_sample_size(r) for k, r in residuals.items()}
    return {k: np.sqrt(min(max(ess[k], least_ess) / len(r), 1.0)) / scale[k] for k, r in residuals.items()}, scale, ess


def finite(r: Array, largest: float = LARGEST) -> Array:
    """Residuals of any shape, or their slopes, of which each is at most so large, also where a simulation diverges."""
    with np.errstate(over="ignore"):
        if np.vdot(r, r) <= largest**2:  # in one pass
            return r
    return r if np.abs(r).max() <= largest else np.clip(np.nan_to_num(r, nan=largest), -largest, largest)
