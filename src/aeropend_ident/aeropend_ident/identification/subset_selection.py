# SPDX-License-Identifier: Apache-2.0
"""Selection of the terms of a linear regression: one automatic rule, on its normal equations.

A term stays if the misfit without it would grow by more than the penalty of the extended Bayesian information criterion
(EBIC; Chen & Chen, Biometrika 95, 2008): ln n for each coefficient, and 2 ln p for the choice among p candidates.

The search adds, drops and exchanges single terms. One inverse rates all neighbours of a support, by the Schur
complement of each further term. Free runs (`output_error_selection`) use the same search on their linearised misfit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDING = 1e-11
"""Share of the sum of squares below which a misfit is rounding. Choice: the precision of a double times 10^5 rows."""

EXHAUSTIVE, MOST_SUPPORTS = 3, 50_000
"""All supports of up to EXHAUSTIVE terms are tried, unless there are more than MOST_SUPPORTS of one size. Choice: this
takes less than a second."""

SINGULAR = 1e-9
"""Added to the diagonal of small scaled systems: two equal terms then do not look like a good support. Choice."""

RIDGE = 1e-13
"""Added to the diagonal of scaled systems, so that equal terms do not make them singular. Choice: near rounding."""

DEPENDENT = 1e-9
"""Schur complement of a scaled term below which it is a linear combination of the support's terms. Choice."""

LEAST_GAIN = 1e-6
"""Decrease of the criterion below which a change is rounding. Choice."""

MOST_CHANGES = 96
"""Greatest number of changes in one search. Choice: 8 for each of 12 terms; guards against cycles by rounding."""


@dataclass(frozen=True)
class NormalEquations:
    """A linear regression y = Θ c, as sums over its rows.

    Attributes:
        H: (P, P) Θ'Θ.
        g: (P,) Θ'y.
        y2: y'y.
        n: number of independent rows.
        total2: y'y before a known part was subtracted from y; rounding is relative to it.
    """

    H: Array
    g: Array
    y2: float
    n: float
    total2: float

    @classmethod
    def of(cls, rows: Array, y: Array, known: Array | None = None) -> NormalEquations:
        """Sum up rows (N, P) and y (N,), from which `known` (N,) was subtracted."""
        total = y if known is None else y + known
        return cls(rows.T @ rows, rows.T @ y, float(y @ y), float(len(y)), float(total @ total))

    @classmethod
    def total(cls, blocks: Sequence[NormalEquations]) -> NormalEquations:
        """The sum of several blocks of rows."""
        return cls(np.sum([b.H for b in blocks], axis=0), np.sum([b.g for b in blocks], axis=0),
                   *(sum(getattr(b, k) for b in blocks) for k in ("y2", "n", "total2")))

    def times(self, share: float) -> NormalEquations:
        """The same, where each row has the weight `share`."""
        return NormalEquations(share * self.H, share * self.g, share * self.y2, share * self.n, share * self.total2)

    def solve(self, support: Sequence[int]) -> Array:
        """The least-squares coefficients (P,) over a support, 0 elsewhere."""
        c = np.zeros(len(self.g))
        s = list(support)
        if s:
            d = 1.0 / np.sqrt(np.maximum(np.diag(self.H)[s], 1e-300))
            c[s] = d * np.linalg.lstsq(d[:, None] * self.H[np.ix_(s, s)] * d, d * self.g[s], rcond=1e-13)[0]
        return c

    def misfit(self, c: Array) -> float:
        """The sum of squares of the residuals with coefficients c (P,)."""
        return max(float(self.y2 - 2.0 * c @ self.g + c @ self.H @ c), 0.0)


def ebic_penalty(n: float, candidates: int) -> float:
    """Decrease of the misfit, in units of the noise's variance, that a term needs to be chosen.

    Args:
        n: number of independent rows.
        candidates: number of candidate terms.
    """
    return float(np.log(max(n, 2.0)) + 2.0 * np.log(max(candidates, 1)))


def ebic_search(equations: NormalEquations, most: int = 12) -> list[int]:
    """The support with the lowest criterion.

    The search starts from no terms, from all terms after the least needed were dropped, and from the best of all small
    supports: single changes do not leave a group of terms that together replace one.

    Args:
        equations: the regression.
        most: greatest number of terms.
    """
    search = _Regression(equations, most)
    left = list(search.usable)
    while len(left) > most:
        left = list(search.drop(left).support)
    starts = [[], left, *([search.usable[j] for j in s] for s in best_small_supports(
        search.H[np.ix_(search.usable, search.usable)], search.g[search.usable]))]
    found = [descend(s, search.rate(s), search.single_changes, search.exchanges) for s in starts]
    rated = [(search.rate(s), s) for s in found]
    return sorted(min(rated)[1])


def best_small_supports(H: Array, g: Array) -> list[list[int]]:
    """The best of all supports of one term, of two terms and so on, up to `EXHAUSTIVE`.

    Args:
        H: (P, P) normal matrix, scaled to a diagonal of at most 1.
        g: (P,) right-hand side.
    """
    found = []
    for size in range(1, EXHAUSTIVE + 1):
        if math.comb(len(g), size) > MOST_SUPPORTS or size > len(g):
            break
        every = np.array(list(combinations(range(len(g)), size)))
        part = H[every[:, :, None], every[:, None, :]] + SINGULAR * np.eye(size)
        right = g[every]
        gain = np.einsum("ks,ks->k", right, np.linalg.solve(part, right[..., None])[..., 0])
        found.append([int(j) for j in every[int(np.argmax(gain))]])
    return found


@dataclass(frozen=True, order=True)
class Change:
    """A changed support and its criterion; the lower criterion is less, then the support that comes first."""

    value: float
    support: tuple[int, ...]


def descend(support: list[int], value: float, single_changes: Callable[[list[int]], Iterable[Change]],
            exchanges: Callable[[list[int]], Iterable[Change]]) -> list[int]:
    """Add, drop and exchange terms while the criterion decreases.

    Args:
        support: where to start.
        value: its criterion.
        single_changes: gives the best addition and the best removal.
        exchanges: gives the best replacement of each term; asked where no single change helps.
    """
    for _ in range(MOST_CHANGES):
        found = min(single_changes(support), default=None)
        if found is None or found.value > value - LEAST_GAIN:
            found = min(exchanges(support), default=None)
        if found is None or found.value > value - LEAST_GAIN:
            break
        support, value = list(found.support), found.value
    return support


def addition_gains(H: Array, g: Array, support: list[int], inverse: Array, solution: Array) -> Array:
    """Decrease (P,) of the misfit by each further term.

    It is the square of the term's remaining right-hand side over its Schur complement.

    Args:
        H: (P, P) normal matrix, scaled to a diagonal of at most 1.
        g: (P,) right-hand side.
        support: terms that are in the model.
        inverse: of H over the support.
        solution: over the support.

    Returns:
        -1 for linear combinations of the support's terms; values at the support itself mean nothing.
    """
    cross = H[:, support]
    size = np.diag(H) - np.einsum("ij,jk,ik->i", cross, inverse, cross)
    return np.where(size > DEPENDENT, (g - cross @ solution) ** 2 / np.maximum(size, DEPENDENT), -1.0)


class _Regression:
    """Criterion and neighbours of the supports of a regression whose noise variance is unknown."""

    def __init__(self, equations: NormalEquations, most: int) -> None:
        size = np.diag(equations.H)
        self.usable = [int(j) for j in np.flatnonzero(size > 0.0)]
        d = np.where(size > 0.0, 1.0 / np.sqrt(np.maximum(size, 1e-300)), 0.0)
        self.H, self.g = d[:, None] * equations.H * d, d * equations.g
        self._equations, self._most = equations, most

    def rate(self, support: list[int]) -> float:
        """The criterion of a support."""
        return self._criterion(len(support), self._misfit(support, self._inverse(support) @ self.g[support]))

    def _criterion(self, terms: int, misfit: float) -> float:
        e = self._equations
        left = max(misfit, ROUNDING * e.total2, 1e-300)
        return e.n * float(np.log(left / e.n)) + terms * ebic_penalty(e.n, len(self.g))

    def _inverse(self, support: list[int]) -> Array:
        return np.asarray(np.linalg.inv(self.H[np.ix_(support, support)] + RIDGE * np.eye(len(support))))

    def _misfit(self, support: list[int], c: Array) -> float:
        """Misfit with coefficients c; an error of theirs counts in second order only."""
        return float(self._equations.y2 - 2.0 * c @ self.g[support] + c @ self.H[np.ix_(support, support)] @ c)

    def drop(self, support: list[int]) -> Change:
        """Drop the term that is needed least."""
        inverse = self._inverse(support)
        c = inverse @ self.g[support]
        loss = c**2 / np.diag(inverse)
        j = int(np.argmin(loss))
        misfit = self._misfit(support, c) + float(loss[j])
        return Change(self._criterion(len(support) - 1, misfit), (*support[:j], *support[j + 1:]))

    def _add(self, support: list[int], barred: int = -1) -> Change:
        """Add the term that lowers the misfit most, but not `barred`."""
        inverse = self._inverse(support)
        c = inverse @ self.g[support]
        gain = addition_gains(self.H, self.g, support, inverse, c)
        gain[support] = -1.0
        if barred >= 0:
            gain[barred] = -1.0
        j = int(np.argmax(gain))
        misfit = self._misfit(support, c) - max(float(gain[j]), 0.0)
        return Change(self._criterion(len(support) + 1, misfit), (*support, j))

    def single_changes(self, support: list[int]) -> Iterator[Change]:
        """The best removal and the best addition."""
        if support:
            yield self.drop(support)
        if len(support) < min(self._most, len(self.usable)):
            yield self._add(support)

    def exchanges(self, support: list[int]) -> Iterator[Change]:
        """For each term the best other term in its place."""
        for j in range(len(support)):
            yield self._add([*support[:j], *support[j + 1:]], support[j])
