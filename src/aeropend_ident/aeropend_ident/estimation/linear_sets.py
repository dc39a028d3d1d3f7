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

from aeropend_ident.estimation.map_fit import band_log_likelihood, bands

Array = NDArray[np.float64]

STEPS = 8
"""Steps in which the noise of the bands is renewed at most (choice: more count only for sets that explain little)."""

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

    def solve(self, columns: Sequence[int], unit: Array, fixed: Sequence[int], mean: Array, prior: Array) -> Solution:
        """The MAP estimate of a subset; the noise of a band is what it leaves there, but at least a reading's.

        Args:
            columns: (P,) indices of the columns whose factors are estimated.
            unit: (P,) factor of each column per unit of its parameter.
            fixed: indices of columns that are added as they are.
            mean: (P,) means of the prior of the parameters.
            prior: (P, P) its information matrix.
        """
        at, of = np.array(columns, np.intp), np.array([*fixed, -1], np.intp)
        inner = self.products[:, at[:, None], at] * np.outer(unit, unit)
        cross = self.products[:, at[:, None], of].sum(axis=2) * unit
        rest = self.products[:, of[:, None], of].sum(axis=(1, 2))

        def noise(step: Array) -> Array:
            """Mean square of what a step leaves in each band."""
            power = rest + 2.0 * cross @ step + np.einsum("bij,i,j->b", inner, step, step)
            return np.maximum(power, 0.0) / self.count

        step = np.zeros(len(at))
        power = noise(step)
        likelihood = band_log_likelihood(power, self.count)
        for _ in range(STEPS):
            weight = 1.0 / np.maximum(power, 1.0)
            step = np.linalg.solve(np.tensordot(weight, inner, 1) + prior, prior @ mean - weight @ cross)
            power, before = noise(step), likelihood
            likelihood = band_log_likelihood(power, self.count)
            if abs(likelihood - before) < SETTLED:
                break
        information, off = np.tensordot(self.weight, inner, 1) + prior, step - mean
        occam = 0.5 * float(np.linalg.slogdet(prior)[1] - off @ prior @ off - np.linalg.slogdet(information)[1])
        return Solution(step, likelihood + occam)
