# SPDX-License-Identifier: Apache-2.0
"""How well an input excites a rig: how well each coefficient could be identified from a recording.

The rig is simulated by its model. The Fisher information of the readings gives the standard deviation of each
coefficient, and the other terms of the library that would explain the same readings (collinearity).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.identification import dataset
from aeropend_ident.identification.dataset import Dataset
from aeropend_ident.identification.discrepancy import in_library
from aeropend_ident.identification.output_error import Entries, Fitter
from aeropend_ident.identification.output_error_selection import alternatives, linearise
from aeropend_ident.identification.problem import Problem
from aeropend_ident.identification.terms import Array, thesis_terms
from aeropend_sim.cli.progress import Show, nothing
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.rig import record

POOR = 0.1
"""Relative standard deviation of a coefficient at or above which its input excites it poorly. Choice."""


@dataclass(frozen=True)
class Excited:
    """How well the coefficient of one term could be identified.

    Attributes:
        equation: state whose derivative the equation gives.
        term: of the equation.
        value: the coefficient.
        sigma: its standard deviation after a fit to the readings.
        rivals: terms that would explain the readings as well.
    """

    equation: str
    term: str
    value: float
    sigma: float
    rivals: tuple[str, ...]

    @property
    def poor(self) -> bool:
        """Whether the input excites it poorly."""
        return bool(self.rivals) or not self.sigma < POOR * abs(self.value)


def planned(model: Model, duty: Array, period: float = SAMPLE_PERIOD, seed: int = 0) -> Dataset:
    """Simulated readings of a planned input.

    Args:
        model: of the rig.
        duty: (N,) duty of each sample period.
        period: [s] time between samples.
        seed: of the noise.

    Raises:
        RecordingError: the readings would be constant.
    """
    read, _ = record(model, duty, seed, period)
    return dataset.from_readings({**read, "duty": duty}, period, model.sensing, held_out=0.0,
                                 name="the planned input")


def quality(model: Model, data: Dataset, show: Show = nothing) -> list[Excited]:
    """How well the coefficients of a model's equations are excited in a dataset.

    Args:
        model: without effects.
        data: the readings.
        show: progress display, from 0 to 1.

    Raises:
        RecordingError: the model diverges on the data.
        ModelError: the model has effects.
    """
    true = in_library(model)
    names = thesis_terms(data.variables)
    problem = Problem(data, names)
    matrix = np.zeros((len(data.states), len(names)))
    for k, s in enumerate(data.states):
        if k not in problem.exact:
            matrix[k] = [true[s].get(t, 0.0) for t in names]
    start = problem.widened(matrix)
    fitter = Fitter(problem.experiment(len(data)), Entries.of(start), 0, floor=1.0)
    every = Entries.candidates(problem.candidates)
    if fitter.run(*fitter.point) is None:
        raise RecordingError(f"{data.name}: the model diverges on it, so there is no result: check the model file, or "
                             f"record faster (its samples are {1e3 * data.period:.3g} ms apart)")
    show(0.1, "fitting the readings")
    fitter.fit(rounds=5)
    show(0.5, "testing every term")
    misfit, now, _ = linearise(fitter, every, start.shape)
    sigma = fitter.deviations()
    rivals = list(alternatives(misfit, every, now))
    found = []
    for k, (e, t) in enumerate(zip(fitter.model.equation.tolist(), fitter.model.term.tolist())):
        other = tuple(names[b] for f, a, b, _ in rivals if (f, a) == (e, t))
        found.append(Excited(data.states[e], names[t], float(start[e, t]), float(sigma[k]), other))
    return found
