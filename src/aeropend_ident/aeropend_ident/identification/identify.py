# SPDX-License-Identifier: Apache-2.0
"""Sparse identification: equations of motion from a dataset.

A regression (weak form, or derivatives) chooses terms and first coefficients. Free runs of the model then decide: they
choose the terms again and fit the coefficients to the readings.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.identification.dataset import Dataset
from aeropend_ident.identification.discrepancy import Equations
from aeropend_ident.identification.problem import FreeRun, Problem
from aeropend_ident.identification.terms import Array, TermError, thesis_terms
from aeropend_sim.cli.progress import Show, nothing

METHODS = ("sindy", "weak", "discrepancy-sindy", "discrepancy-weak")


@dataclass(frozen=True)
class Alternative:
    """Another term that explains the data as well as a chosen one.

    Attributes:
        equation: state whose derivative the equation gives.
        term: the chosen term.
        instead: the other term.
        worse: increase of the selection criterion when `instead` replaces `term`.
    """

    equation: str
    term: str
    instead: str
    worse: float


@dataclass(frozen=True)
class Identified:
    """The identified equations.

    Attributes:
        method: one of `METHODS`.
        terms: the candidate terms.
        equations: state -> term -> coefficient.
        sigma: state -> term -> standard deviation of the coefficient; 0 where the definition of the state fixes it.
        stability: state -> term -> share of resamples in which the term is chosen; empty without free runs.
        unstable: (equation, term, share) of terms that are left out because few resamples choose them.
        alternatives: terms that the data cannot distinguish from the chosen ones.
        held_out_mse: state -> mean squared error of the derivative on held-out data (SI units).
        free_run: channel -> free run compared with held-out data; empty where the recording was cut into shots.
        shots: number of shots that the recording was cut into.
        seconds: [s] computing time.
        notes: remarks for the user.
    """

    method: str
    terms: tuple[str, ...]
    equations: dict[str, dict[str, float]]
    sigma: dict[str, dict[str, float]]
    stability: dict[str, dict[str, float]]
    unstable: tuple[tuple[str, str, float], ...]
    alternatives: tuple[Alternative, ...]
    held_out_mse: dict[str, float]
    free_run: dict[str, FreeRun]
    shots: int
    seconds: float
    notes: tuple[str, ...]


class Traces(NamedTuple):
    """Curves over the whole recording, for a picture.

    Attributes:
        measured: (N, states) derivatives from the readings.
        modelled: (N, states) derivatives from the equations.
        free_run: (N, states) states in the free run; None where there is none.
    """

    measured: Array
    modelled: Array
    free_run: Array | None


def identify(data: Dataset, method: str = "weak", terms: Sequence[str] | None = None, known: Equations | None = None,
             derivative: str = "smoothed", show: Show = nothing) -> Identified:
    """Find sparse equations of a dataset.

    Args:
        data: the recording.
        method: one of `METHODS`.
        terms: candidate terms; None: the library of the thesis.
        known: equations to which the discrepancy methods add terms.
        derivative: how the SINDy methods take derivatives (`sindy.DERIVATIVES`).
        show: progress display, from 0 to 1.

    Raises:
        TermError: a term cannot be read.
        RecordingError: no model can be run on the data.
    """
    return identify_with_traces(data, method, terms, known, derivative, show)[0]


@threadpool_limits.wrap(limits=1)  # with several threads such small matrices take three times as long
def identify_with_traces(data: Dataset, method: str = "weak", terms: Sequence[str] | None = None,
                         known: Equations | None = None, derivative: str = "smoothed", show: Show = nothing
                         ) -> tuple[Identified, Traces]:
    """Find sparse equations of a dataset, and the curves for their picture.

    Args:
        data: the recording.
        method: one of `METHODS`.
        terms: candidate terms; None: the library of the thesis.
        known: equations to which the discrepancy methods add terms.
        derivative: how the SINDy methods take derivatives (`sindy.DERIVATIVES`).
        show: progress display, from 0 to 1.

    Raises:
        TermError: a term cannot be read.
        RecordingError: no model can be run on the data.
    """
    started = time.perf_counter()
    if method.startswith("discrepancy"):
        if known is None:
            raise ValueError(f"{method} needs the equations of a model")
    else:
        known = None
    library = list(terms if terms is not None else thesis_terms(data.variables))
    if not library:
        raise TermError("no terms are given: name at least one, as in sin(theta),theta_dot,omega*omega")
    problem = Problem(data, library, known, weak=method.endswith("weak"), derivative=derivative)
    show(0.05, "choosing terms by regression")
    regression = problem.regression()
    first = problem.regress(regression)
    selected = None
    if data.derivatives is None:
        selected = problem.select_terms(first, show)
        if selected is None:
            raise RecordingError(f"{data.name}: the equations of the regression diverge when they are run, so there is "
                                 "no result; record longer, with more motion, or give fewer terms")
        matrix, sigma = problem.narrowed(selected.matrix), problem.narrowed(selected.sigma)
    else:
        matrix, sigma = first, problem.regression_sigma(regression, first)
    held_out = problem.held_out_run(selected)
    often = np.zeros(matrix.shape) if selected is None else problem.narrowed(selected.stability)
    equations, spread, stability = (
        {s: {library[j]: float(values[k, j]) for j in np.flatnonzero(matrix[k])} for k, s in enumerate(data.states)}
        for values in (matrix, sigma, often))
    for k, equation in problem.exact.items():
        equations[data.states[k]] = dict(equation)
        spread[data.states[k]] = dict.fromkeys(equation, 0.0)
        stability[data.states[k]] = dict.fromkeys(equation, 1.0)
    alternatives = () if selected is None else tuple(
        Alternative(data.states[e], library[a], library[b], w) for e, a, b, w in selected.alternatives)
    unstable = () if selected is None else tuple((data.states[e], library[t], o) for e, t, o in selected.unstable)
    shots = 1 if selected is None else len(selected.fitter.shots)
    measured, modelled = problem.derivative_traces(matrix)
    late = slice(data.train, None)
    mse = {s: float(np.mean((modelled - measured)[late, k] ** 2)) for k, s in enumerate(data.states)}
    found = Identified(method, tuple(library), equations, spread, {} if selected is None else stability, unstable,
                       alternatives, mse, held_out.channels, shots, time.perf_counter() - started,
                       (*data.notes, *held_out.notes))
    return found, Traces(measured, modelled, held_out.states)
