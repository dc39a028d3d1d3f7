# SPDX-License-Identifier: Apache-2.0
"""SINDy with control: regression of derivatives on candidate terms (thesis 5.2).

Brunton, Proctor & Kutz, PNAS 113, 2016; with control: IFAC-PapersOnLine 49, 2016.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.identification.subset_selection import NormalEquations, ebic_search
from aeropend_ident.identification.terms import Array, Library
from aeropend_ident.identification.weak import BLOCKS
from aeropend_ident.signals.derivatives import smoothed, smoothness, tv_derivative
from aeropend_ident.signals.statistics import effective_sample_size

DERIVATIVES = ("smoothed", "tv")

MOST_DISTURBED = 0.7
"""Share of samples near steps of an input above which these are used as well. Choice: otherwise few remain."""


class BlockRegression(Protocol):
    """A regression of the derivatives of states on terms."""

    def blocks(self, equation: int, coefficients: Array | None = None, known: Array | None = None
               ) -> list[NormalEquations]:
        """The regression of one equation, in blocks of time.

        Args:
            equation: index of the state.
            coefficients: (terms,) present estimate, for the weights of the rows.
            known: (N,) known part of the derivative (discrepancy).
        """


class Regression:
    """The regression of each state's derivative on the terms, sample by sample.

    Attributes:
        left: (N, S) the derivatives.
        terms: (N, terms).
    """

    def __init__(self, library: Library, states: Array, inputs: Array, period: float,
                 derivatives: Array | None = None, way: str = "smoothed") -> None:
        """Take the derivatives, and evaluate the terms.

        Args:
            library: terms over states and inputs.
            states: (N, S).
            inputs: (N, U), held from sample to sample.
            period: [s] sample period.
            derivatives: (N, S) exact derivatives; None: they are taken, and the terms are those of smoothed states.
            way: how derivatives are taken, one of `DERIVATIVES`.
        """
        if derivatives is None:
            take = tv_derivative if way == "tv" else smoothed
            pairs = [take(x, period) for x in states.T]
            given = states
            states = np.column_stack([p[0] for p in pairs])
            derivatives = np.column_stack([p[1] for p in pairs])
            use = _undisturbed(inputs, max(smoothness(x) for x in given.T))
        else:
            use = np.ones(len(states), dtype=bool)
        self._use = np.flatnonzero(use)
        self.left, self.terms = derivatives, library(np.column_stack([states, inputs]))

    def blocks(self, equation: int, coefficients: Array | None = None, known: Array | None = None
               ) -> list[NormalEquations]:
        """The regression of one equation, in blocks of time; correlated rows have less weight.

        Args:
            equation: index of the state.
            coefficients: (terms,) present estimate; the autocorrelation of its residual gives the weight.
            known: (N,) known part of the derivative (discrepancy).
        """
        known = np.zeros(len(self.left)) if known is None else known
        y = self.left[:, equation] - known
        share = 1.0
        if coefficients is not None:
            share = effective_sample_size((y - self.terms @ coefficients)[self._use]) / len(self._use)
        parts = np.array_split(self._use, BLOCKS)
        return [NormalEquations.of(self.terms[p], y[p], known[p]).times(share) for p in parts]


def _undisturbed(inputs: Array, reach: float) -> NDArray[np.bool_]:
    """Whether the smoothed derivative at a sample (N,) is free of steps of the inputs; all true if few are.

    Args:
        inputs: (N, U), held from sample to sample.
        reach: number of samples over which a derivative is smoothed.
    """
    n = len(inputs)
    near = np.zeros(n)
    for step in np.flatnonzero(np.any(np.diff(inputs, axis=0) != 0.0, axis=1)) + 1:
        near[max(step - 3 - int(reach), 0) : step + 3 + int(reach)] = 1.0
    return near == 0.0 if near.mean() < MOST_DISTURBED else np.ones(n, dtype=bool)


def regress(regression: BlockRegression, equation: int, known: Array | None = None, rounds: int = 3,
            most: int = 12) -> Array:
    """Choose the terms of one equation.

    Args:
        regression: a `Regression` or a `weak.Weak`.
        equation: index of the state.
        known: (N,) known part of the derivative (discrepancy).
        rounds: number of fits; each renews the weights of the rows with the coefficients of the last.
        most: greatest number of terms.

    Returns:
        The coefficients (terms,), 0 for terms that are not chosen.
    """
    c: Array | None = None
    for _ in range(rounds):
        equations = NormalEquations.total(regression.blocks(equation, c, known))
        c = equations.solve(ebic_search(equations, most))
    assert c is not None
    return c
