# SPDX-License-Identifier: Apache-2.0
"""How well an input excites a rig: how well each coefficient could be identified from a recording.

    excitation_quality --model bench --duration 20 --duty-max 0.3       a planned signal
    excitation_quality my_bag --model bench                             a recording

The rig is simulated by its model. The Fisher information of the readings gives the standard deviation of each
coefficient, and the other terms of the library that would explain the same readings (collinearity).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aeropend_ident.bags import recording
from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.identification import dataset
from aeropend_ident.identification.dataset import Dataset
from aeropend_ident.identification.discrepancy import in_library
from aeropend_ident.identification.output_error import Entries, Fitter
from aeropend_ident.identification.output_error_selection import alternatives, linearise
from aeropend_ident.identification.problem import Problem
from aeropend_ident.identification.terms import Array, thesis_terms
from aeropend_sim.cli.command import EXIT_CODES, Parser, entry_point
from aeropend_sim.cli.progress import Show, nothing, progress
from aeropend_sim.model.excitation import KINDS, Excitation
from aeropend_sim.model.parameters import PRESETS, SAMPLE_PERIOD, Model, load
from aeropend_sim.model.rig import record

EXAMPLES = f"""examples:
  excitation_quality --duration 20 --duty-max 0.3        a signal of `excite`, before it is recorded
  excitation_quality --kind steps --model my_rig.yaml
  excitation_quality my_bag                              a recording

{EXIT_CODES}"""

SIGNAL = {"duration": "length, s", "duty_min": "least duty", "duty_max": "greatest duty",
          "hold_min": "shortest hold, s", "hold_max": "longest hold, s", "rest": "duty 0 between the holds, s"}

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


def planned(model: Model, duty: Array, seed: int = 0) -> Dataset:
    """Simulated readings of a planned input.

    Args:
        model: of the rig.
        duty: (N,) duty of each sample period.
        seed: of the noise.

    Raises:
        RecordingError: the readings would be constant.
    """
    read, _ = record(model, duty, seed)
    return dataset.from_readings({**read, "duty": duty}, SAMPLE_PERIOD, model.sensing, held_out=0.0,
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
        raise RecordingError(f"{data.name}: the model diverges on it, so there is no result; check the model file")
    show(0.1, "fitting the readings")
    fitter.fit(rounds=5)
    show(0.5, "testing every term")
    misfit, now, _ = linearise(fitter, every, start.shape)
    sigma = np.sqrt(np.diag(fitter.covariance()))
    rivals = list(alternatives(misfit, every, now))
    found = []
    for k, (e, t) in enumerate(zip(fitter.model.equation.tolist(), fitter.model.term.tolist())):
        other = tuple(names[b] for f, a, b, _ in rivals if (f, a) == (e, t))
        found.append(Excited(data.states[e], names[t], float(start[e, t]), float(sigma[k]), other))
    return found


@entry_point("excitation_quality")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = Parser(prog="excitation_quality", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="How well a planned or recorded input excites each term.")
    parser.add_argument("bag", nargs="?", metavar="BAG",
                        help="a recording; without it, a planned signal of `excite` is tested")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help=f"{' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if the bag has several")
    plan = Excitation()
    parser.add_argument("--kind", choices=KINDS, default=plan.kind,
                        help="kind of the signal, as in `excite`; default %(default)s")
    for name, meaning in SIGNAL.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, default=getattr(plan, name), metavar="X",
                            help=f"{meaning}; default %(default)s")
    parser.add_argument("--seed", type=int, default=plan.seed,
                        help="seed of the signal and of the noise; default %(default)s")
    options = parser.parse_args(arguments)
    model = load(options.model)
    with progress("reading") as show:
        if options.bag:
            data = dataset.from_bag(recording.read(options.bag, options.namespace), model.sensing, held_out=0.0)
        else:
            signal = Excitation(options.kind, options.duration, options.seed, options.duty_min, options.duty_max,
                                options.hold_min, options.hold_max, rest=options.rest)
            data = planned(model, signal.series())
        found = quality(model, data, show)
    for one in found:
        remark = "poorly excited" if one.poor else ""
        if one.rivals:
            remark = f"cannot be distinguished from {', '.join(one.rivals)}"
        known = f"known to {100.0 * one.sigma / abs(one.value):8.3g} %"
        print(f"d({one.equation})/dt  {one.term:18} {one.value:12.6g}  {known}  {remark}".rstrip())
    poor = sum(one.poor for one in found)
    print(f"{poor} of {len(found)} terms would stay undetermined" if poor else "every term is excited")
    return 0


if __name__ == "__main__":
    sys.exit(main())
