# SPDX-License-Identifier: Apache-2.0
"""SINDy with control: derivatives regressed on candidate terms (Brunton, Proctor & Kutz, 2016; thesis 5.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.identification.subset_selection import Sums, select
from aeropend_ident.identification.terms import Array, Library
from aeropend_ident.identification.weak import BLOCKS
from aeropend_ident.signals.derivatives import smoothed, smoothness, tv_derivative
from aeropend_ident.signals.statistics import effective_sample_size

DERIVATIVES = ("smoothed", "tv")

MOST_DISTURBED = 0.7
"""Share of samples near steps of an input from which on these are used as well."""


class Regression:
    """The regression of every state's derivative on the terms, sample by sample.

    Args:
        library: terms over states and inputs. states: (N, S). inputs: (N, U). period: s.
        derivatives: (N, S) where they are known; None: by smoothed differences or, with `way` "tv", by
            `tv_derivative`; the terms are then those of the smoothed states.
    """

    def __init__(self, library: Library, states: Array, inputs: Array, period: float,
                 derivatives: Array | None = None, way: str = "smoothed") -> None:
        if derivatives is None:
            take = tv_derivative if way == "tv" else smoothed
            pairs = [take(x, period) for x in states.T]
            given = states
            states = np.column_stack([p[0] for p in pairs])
            derivatives = np.column_stack([p[1] for p in pairs])
            use = _undisturbed(inputs, max(smoothness(x) for x in given.T))
        else:
            use = np.ones(len(states), dtype=bool)
        self.use = np.flatnonzero(use)
        self.left, self.terms = derivatives, library(np.column_stack([states, inputs]))

    def blocks(self, equation: int, coefficients: Array | None = None, known: Array | None = None) -> list[Sums]:
        """The regression of one equation in blocks of time, each row counted by what it says that others do not.

        Args:
            equation: index of the state. coefficients: (terms,) present estimate; its residual tells how much rows
                repeat each other. known: (N,) part of the derivative that is known (discrepancy).
        """
        known = np.zeros(len(self.left)) if known is None else known
        y = self.left[:, equation] - known
        share = 1.0
        if coefficients is not None:
            share = effective_sample_size((y - self.terms @ coefficients)[self.use]) / len(self.use)
        parts = np.array_split(self.use, BLOCKS)
        return [Sums.of(self.terms[p], y[p], known[p]).times(share) for p in parts]


def _undisturbed(inputs: Array, reach: float) -> NDArray[np.bool_]:
    """Samples (N,) whose smoothed derivative knows nothing of a step of the held inputs (N, U); all, if that is few."""
    n = len(inputs)
    near = np.zeros(n)
    for step in np.flatnonzero(np.any(np.diff(inputs, axis=0) != 0.0, axis=1)) + 1:
        near[max(step - 3 - int(reach), 0) : step + 3 + int(reach)] = 1.0
    return near == 0.0 if near.mean() < MOST_DISTURBED else np.ones(n, dtype=bool)


def regress(problem: object, equation: int, known: Array | None = None, rounds: int = 3,
            most: int = 12) -> Array:
    """Choose terms of one equation, and their coefficients (terms,), 0 for what is not in it.

    Args:
        problem: a `Regression` or a `weak.Weak`. equation: index of the state. known: see `blocks`.
        rounds: times that the weights are renewed with the coefficients found. most: terms at most.
    """
    c: Array | None = None
    for _ in range(rounds):
        sums = Sums.total(problem.blocks(equation, c, known))  # type: ignore[attr-defined]
        c = sums.solve(select(sums, most))
    assert c is not None
    return c
