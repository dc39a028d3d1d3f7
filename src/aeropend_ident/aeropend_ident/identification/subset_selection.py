# SPDX-License-Identifier: Apache-2.0
"""Which of many candidate terms a regression needs: one automatic rule, on its normal equations.

A term stays when the misfit would grow by more than the extended Bayesian criterion asks (Chen & Chen, Biometrika 95,
2008): ln n for every number, and 2 ln p for having been chosen among p. Everything works on sums over the data.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDING = 1e-11
"""Share of the sum of squares below which a misfit is rounding."""

EXHAUSTIVE, MOST_SUPPORTS = 3, 50_000
"""Supports of up to so many terms are all tried, if they are no more than that."""

SINGULAR = 1e-9
"""What keeps two terms that are the same from looking like a good support."""

RIDGE = 1e-13
"""Added to sums scaled to 1, so that terms that are the same do no harm."""


@dataclass(frozen=True)
class Sums:
    """A linear regression, summed over its rows.

    Attributes:
        H: (P, P) Θ'Θ. g: (P,) Θ'y. y2: y'y. n: independent rows.
        whole: y'y of what y is a part of, where something known was taken off; its rounding is in y.
    """

    H: Array
    g: Array
    y2: float
    n: float
    whole: float

    @classmethod
    def of(cls, rows: Array, y: Array, known: Array | None = None) -> Sums:
        """The sums of rows (N, P) and y (N,), from which `known` (N,) was taken off."""
        whole = y if known is None else y + known
        return cls(rows.T @ rows, rows.T @ y, float(y @ y), float(len(y)), float(whole @ whole))

    @classmethod
    def total(cls, blocks: Sequence[Sums]) -> Sums:
        """Several added up."""
        return cls(np.sum([b.H for b in blocks], axis=0), np.sum([b.g for b in blocks], axis=0),
                   *(sum(getattr(b, k) for b in blocks) for k in ("y2", "n", "whole")))

    def times(self, share: float) -> Sums:
        """The same with every row counted as `share` of one."""
        return Sums(share * self.H, share * self.g, share * self.y2, share * self.n, share * self.whole)

    def solve(self, support: Sequence[int]) -> Array:
        """The coefficients (P,) of least squares over a support, 0 elsewhere."""
        c = np.zeros(len(self.g))
        s = list(support)
        if s:
            d = 1.0 / np.sqrt(np.maximum(np.diag(self.H)[s], 1e-300))
            c[s] = d * np.linalg.lstsq(d[:, None] * self.H[np.ix_(s, s)] * d, d * self.g[s], rcond=1e-13)[0]
        return c

    def misfit(self, c: Array) -> float:
        """Sum of squares that coefficients (P,) leave."""
        return max(float(self.y2 - 2.0 * c @ self.g + c @ self.H @ c), 0.0)


def price(n: float, candidates: int) -> float:
    """What a term must take off the misfit, in units of the noise's variance."""
    return float(np.log(max(n, 2.0)) + 2.0 * np.log(max(candidates, 1)))


def select(sums: Sums, most: int = 12) -> list[int]:
    """The support that the criterion prefers.

    Found by steps of adding, dropping and exchanging a term, from nothing, from what is left when terms are dropped
    from all of them, and from the best of all small supports: the steps alone do not leave a group of terms that
    together stand in for one.

    Args:
        sums: the regression. most: terms at most.
    """
    search = _Search(sums, most)
    left = list(search.usable)
    while len(left) > most:
        left = search.drop(left)[0]
    starts = [[], left, *([search.usable[j] for j in s] for s in smallest(
        search.H[np.ix_(search.usable, search.usable)], search.g[search.usable]))]
    found = [search.descend(s) for s in starts]
    rated = [(search.rate(len(s), search.misfit(s)), s) for s in found]
    return sorted(min(rated)[1])


def smallest(H: Array, g: Array) -> list[list[int]]:
    """For every small number of terms the support that takes most off, of all there are.

    Args:
        H: (P, P) sums, scaled to a diagonal of 1 or less. g: (P,).
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


class _Search:
    """Steps between supports, every neighbour of a support rated from one inverse."""

    def __init__(self, sums: Sums, most: int) -> None:
        size = np.diag(sums.H)
        self.usable = [int(j) for j in np.flatnonzero(size > 0.0)]
        d = np.where(size > 0.0, 1.0 / np.sqrt(np.maximum(size, 1e-300)), 0.0)
        self.H, self.g, self.sums, self.most = d[:, None] * sums.H * d, d * sums.g, sums, most

    def rate(self, terms: int, misfit: float) -> float:
        """The criterion of so many terms that leave so much."""
        s = self.sums
        left = max(misfit, ROUNDING * s.whole, 1e-300)
        return s.n * float(np.log(left / s.n)) + terms * price(s.n, len(self.g))

    def inverse(self, support: list[int]) -> Array:
        """Of the sums over a support."""
        return np.asarray(np.linalg.inv(self.H[np.ix_(support, support)] + RIDGE * np.eye(len(support))))

    def misfit(self, support: list[int]) -> float:
        """What a support leaves."""
        return self.left(support, self.inverse(support) @ self.g[support])

    def left(self, support: list[int], c: Array) -> float:
        """What coefficients leave; an error in them counts in the second order only."""
        return float(self.sums.y2 - 2.0 * c @ self.g[support] + c @ self.H[np.ix_(support, support)] @ c)

    def drop(self, support: list[int]) -> tuple[list[int], float]:
        """The support without the term that it misses least, and what that leaves."""
        inverse = self.inverse(support)
        c = inverse @ self.g[support]
        loss = c**2 / np.diag(inverse)
        j = int(np.argmin(loss))
        return support[:j] + support[j + 1:], self.left(support, c) + float(loss[j])

    def add(self, support: list[int], barred: int = -1) -> tuple[list[int], float]:
        """The support and the term that takes most off, and what that leaves."""
        inverse = self.inverse(support)
        cross = self.H[:, support]
        c = inverse @ self.g[support]
        size = np.diag(self.H) - np.einsum("ij,jk,ik->i", cross, inverse, cross)
        gain = np.where(size > 1e-9, (self.g - cross @ c) ** 2 / np.maximum(size, 1e-9), -1.0)
        gain[support] = -1.0
        if barred >= 0:
            gain[barred] = -1.0
        j = int(np.argmax(gain))
        return [*support, j], self.left(support, c) - max(float(gain[j]), 0.0)

    def descend(self, support: list[int]) -> list[int]:
        """Step while it pays."""
        value = self.rate(len(support), self.misfit(support))
        while True:
            moves = [self.drop(support)] if support else []
            if len(support) < min(self.most, len(self.usable)):
                moves.append(self.add(support))
            rated = [(self.rate(len(s), left), s) for s, left in moves]
            if not rated or min(rated)[0] > value - 1e-6:
                rated = [(self.rate(len(support), left), s) for s, left in (
                    self.add(support[:j] + support[j + 1:], support[j]) for j in range(len(support)))]
            if not rated or min(rated)[0] > value - 1e-6:
                return support
            value, support = min(rated)
