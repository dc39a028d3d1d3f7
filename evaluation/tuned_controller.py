# SPDX-License-Identifier: Apache-2.0
"""A controller tuned on the nominal and on the augmented model: what was predicted of it, and what the rig did.

`python -m evaluation.tuned_controller [EFFECT ...]` prints the table, by default for every effect that can be foreseen.
"""

from __future__ import annotations

import math
import sys
from functools import cache
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from aeropend_control.analysis import closed_loop
from aeropend_control.analysis.step_response import step_responses
from aeropend_control.laws.feedback_linearization import FeedbackLinearization, tune
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.testing.rigs import BENCH, drawn_rig, recorded
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import Model
from aeropend_sim.model.rig import Rig

T_S, M_P = 1.5, 0.1
"""What the controllers are tuned for."""

LEVELS, HOLD = (0.4, 0.7), 4.0
"""rad and s of the steps, the first from rest."""

DURATION = 30.0
"""s of the recording."""

NOT_FORESEEN = ("gust",)


class Figures(NamedTuple):
    """The mean over the steps: t_r and t_s in s, M_p as a share, the true angle's steady-state error in rad."""

    t_r: float
    t_s: float
    M_p: float
    e_ss: float


class Case(NamedTuple):
    """One rig, with the controller tuned on the nominal model (before) and on the augmented one (after)."""

    effect: str
    found: list[str]
    augmented: Model
    predicted_before: Figures
    measured_before: Figures
    predicted_after: Figures
    measured_after: Figures

    def errors(self) -> tuple[float, float]:
        """Prediction error before and after."""
        return (error(self.predicted_before, self.measured_before), error(self.predicted_after, self.measured_after))


def error(predicted: Figures, measured: Figures) -> float:
    """Relative errors of t_r, t_s and M_p, summed, and the error of the steady state as a share of a mean step."""
    relative = sum(abs(m / p - 1.0) for p, m in zip(predicted[:3], measured[:3], strict=True))
    return relative + abs(measured.e_ss - predicted.e_ss) / (LEVELS[-1] / len(LEVELS))


def figures(tuned_on: Model, rig: Rig) -> Figures:
    """What a controller tuned on a model does on a rig, from its readings; only e_ss needs a better gauge."""
    law = FeedbackLinearization(tuned_on, tune(tuned_on, T_S, M_P))
    run = closed_loop.run(law, rig, closed_loop.staircase(LEVELS, HOLD))
    read = step_responses(run.time, run.measured["theta"], run.reference)
    true = step_responses(run.time, run.truth["theta"], run.reference)
    t_s = [HOLD if math.isnan(s.settling_time) else s.settling_time for s in read]
    return Figures(float(np.mean([s.rise_time for s in read])), float(np.mean(t_s)),
                   float(np.mean([s.overshoot for s in read])), float(np.mean([s.steady_state_error for s in true])))


def case(effect: str, seed: int = 0) -> Case:
    """Record a rig with an effect of default size and its numbers off by 2 %, diagnose it, tune before and after."""
    effects: dict[str, dict[str, float]] = {effect: {}}
    result = diagnose(BENCH, [recorded(seed, effects, DURATION)], 2)
    rig = Rig(drawn_rig(seed, effects), 1000 + seed)
    return Case(effect, list(result.body["which"]["effects"]), result.augmented, nominal(),
                figures(BENCH, rig), figures(result.augmented, Rig(result.augmented)), figures(result.augmented, rig))


@cache
def nominal() -> Figures:
    """What the nominal model predicts of the controller tuned on it."""
    return figures(BENCH, Rig(BENCH))


def table(cases: list[Case]) -> Table:
    """One row a rig and model."""
    out = Table(title=f"Feedback linearization tuned for t_s {T_S:g} s, M_p {M_P:.0%}; steps to "
                f"{', '.join(f'{level:g}' for level in LEVELS)} rad; predicted -> measured")
    for name in ("effect", "tuned on", "t_r / s", "t_s / s", "M_p / %", "e_ss / mrad", "error"):
        out.add_column(name, justify="left" if name in ("effect", "tuned on") else "right", no_wrap=True)
    for c in cases:
        rows = (("nominal", c.predicted_before, c.measured_before), ("augmented", c.predicted_after, c.measured_after))
        for (model, p, m), e in zip(rows, c.errors(), strict=True):
            out.add_row(c.effect if model == "nominal" else f"  found: {', '.join(c.found) or 'none'}", model,
                        f"{p.t_r:.2f} -> {m.t_r:.2f}", f"{p.t_s:.2f} -> {m.t_s:.2f}",
                        f"{100 * p.M_p:.1f} -> {100 * m.M_p:.1f}", f"{1e3 * p.e_ss:.1f} -> {1e3 * m.e_ss:.1f}",
                        f"{e:.2f}")
    before, after = (float(np.median(e)) for e in zip(*(c.errors() for c in cases), strict=True))
    out.caption = f"median error {before:.2f} before, {after:.2f} after"
    return out


if __name__ == "__main__":
    chosen = sys.argv[1:] or [effect for effect in CATALOGUE if effect not in NOT_FORESEEN]
    if unknown := [effect for effect in chosen if effect not in CATALOGUE]:
        print(f"tuned_controller: no effect {unknown[0]}; known: {', '.join(CATALOGUE)}", file=sys.stderr)
        sys.exit(2)
    Console(width=120).print(table([case(effect, list(CATALOGUE).index(effect)) for effect in chosen]))
