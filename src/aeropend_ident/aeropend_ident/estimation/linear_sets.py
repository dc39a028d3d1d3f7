# SPDX-License-Identifier: Apache-2.0
"""The log evidence of any subset of the columns of a linear model whose noise has a spectrum.

The residual and the columns that may explain it are transformed (cosine transform), and their products are summed in
each band of frequency. All else is algebra of these small matrices: a subset costs a fraction of a millisecond, so that
thousands can be compared. The log evidence is that of `map_fit.Fit`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct

from aeropend_ident.estimation.whittle import band_log_likelihood, bands
from aeropend_sim.compiled import njit

Array = NDArray[np.float64]

STEPS = 8
"""Steps in which the noise of the bands is renewed at most (choice: more count only for sets that explain little)."""

HELD = 1e12
"""Information of a parameter that is held, in standard units (choice: far above that of any recording)."""

SETTLED = 0.02
"""[nats] Change of the log likelihood between steps at which they end (choice: far less than decides)."""


class Solution(NamedTuple):
    """The MAP estimate of a subset of columns.

    Attributes:
        step: (P,) factors of the columns.
        log_evidence: up to a constant that all subsets share.
    """

    step: Array
    log_evidence: float


class LinearSets:
    """Subsets of columns that may explain a residual.

    Args:
        rows: channel -> (K + 1, N) columns, one a row, and the residual last, in units of a reading's noise.
        weight: channel -> what a sample counts for in the Occam factor; see `map_fit.Fit.information`.
    """

    def __init__(self, rows: Mapping[str, Array], weight: Mapping[str, float]) -> None:
        counts, products, weights = [], [], []
        for channel, each in rows.items():
            edges = bands(each.shape[1])
            there = dct(each, norm="ortho", axis=1)
            for low, high in pairwise(edges):
                counts.append(high - low)
                products.append(there[:, low:high] @ there[:, low:high].T)
                weights.append(weight[channel])
        self.count, self.products, self.weight = np.array(counts, float), np.array(products), np.array(weights)

    def solve(self, columns: Sequence[int], unit: Array, fixed: Sequence[int], mean: Array, prior: Array,
              held: Mapping[int, float] | None = None) -> Solution:
        """The MAP estimate of a subset; the noise of a band is what it leaves there, but at least a reading's.

        Args:
            columns: (P,) indices of the columns whose factors are estimated.
            unit: (P,) factor of each column per unit of its parameter.
            fixed: indices of columns that are added as they are.
            mean: (P,) means of the prior of the parameters.
            prior: (P, P) its information matrix.
            held: index of a parameter -> value at which it is held, as at the bound of its range.
        """
        stiff, center = prior.copy(), mean.copy()
        for j, x in (held or {}).items():
            stiff[j], stiff[:, j], stiff[j, j], center[j] = 0.0, 0.0, HELD, x
        at, of = np.array(columns, np.intp), np.array([*fixed, -1], np.intp) % self.products.shape[1]
        step, inner, likelihood = _estimate(self.products, self.count, self.weight, at, unit, of, stiff, stiff @ center,
                                            STEPS, SETTLED)
        information, off = inner + prior, step - mean
        occam = 0.5 * float(np.linalg.slogdet(prior)[1] - off @ prior @ off - np.linalg.slogdet(information)[1])
        return Solution(step, likelihood + occam)


@njit(nogil=True)
def _estimate(products: Array, count: Array, weight: Array, at: NDArray[np.intp], unit: Array, of: NDArray[np.intp],
              prior: Array, pull: Array, steps: int, settled: float) -> tuple[Array, Array, float]:
    """The MAP estimate of a subset, by steps that renew the noise of the bands.

    Args:
        products: (B, K, K) products of the columns in each band.
        count: (B,) coefficients in each band.
        weight: (B,) what a sample counts for in the Occam factor.
        at: (P,) columns whose factors are estimated.
        unit: (P,) factor of each column per unit of its parameter.
        of: (R,) columns whose sum is explained.
        prior: (P, P) information matrix of the prior.
        pull: (P,) that matrix times the means.
        steps: at most.
        settled: [nats] change of the log likelihood at which they end.

    Returns:
        Factors (P,), weighted products (P, P) of the columns, and log likelihood.
    """
    bands_, size = len(count), len(at)
    inner, cross, rest = np.zeros((bands_, size, size)), np.zeros((bands_, size)), np.zeros(bands_)
    weighted = np.zeros((size, size))
    for b in range(bands_):
        for j in range(size):
            for k in range(size):
                inner[b, j, k] = products[b, at[j], at[k]] * unit[j] * unit[k]
                weighted[j, k] += weight[b] * inner[b, j, k]
            for column in of:
                cross[b, j] += products[b, at[j], column] * unit[j]
        for one in of:
            for other in of:
                rest[b] += products[b, one, other]
    step, power = np.zeros(size), np.maximum(rest, 0.0) / count
    likelihood = band_log_likelihood(power, count)
    for _ in range(steps):
        information, gradient = prior.copy(), pull.copy()
        for b in range(bands_):
            w = 1.0 / max(power[b], 1.0)
            for j in range(size):
                gradient[j] -= w * cross[b, j]
                for k in range(size):
                    information[j, k] += w * inner[b, j, k]
        step = np.linalg.solve(information, gradient)
        for b in range(bands_):
            left = rest[b]
            for j in range(size):
                left += 2.0 * cross[b, j] * step[j]
                for k in range(size):
                    left += step[j] * inner[b, j, k] * step[k]
            power[b] = max(left, 0.0) / count[b]
        before, likelihood = likelihood, band_log_likelihood(power, count)
        if abs(likelihood - before) < settled:
            break
    return step, weighted, likelihood
