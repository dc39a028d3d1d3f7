# SPDX-License-Identifier: Apache-2.0
"""Validation on a further recording: the gap on data that no parameter and no choice of an effect has used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis import free_run_gap
from aeropend_ident.diagnosis.chain.chain import difference
from aeropend_ident.diagnosis.chain.free_run import free_run
from aeropend_ident.diagnosis.chain.priors import state_of_arm
from aeropend_ident.diagnosis.chain.values import Values
from aeropend_ident.diagnosis.document import ClosedGap
from aeropend_ident.estimation.map_fit import fit
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

FORGOTTEN = 5.0
"""[s] Time after which the arm has forgotten its initial state (choice: some of its time constants)."""


def validate(model: Model, augmented: Model, signals: Signals) -> ClosedGap:
    """The gap of a further recording before and after, in free runs from its duty.

    The first `FORGOTTEN` seconds, at most half of the recording, only give the initial state; the rest is judged.

    Args:
        model: the nominal model.
        augmented: with what other recordings of the rig showed.
        signals: the recording.
    """
    first = int(np.argmax(np.isfinite(signals.theta)))
    start = min(first + round(FORGOTTEN / signals.period), len(signals) // 2)
    false = signals.false_speed
    of_nominal = None if "speed_spikes" in augmented.effects else false  # that effect is part of the gap before
    runs = [free_run(m, signals, _initial_state(m, signals.head(start))) for m in (model, augmented)]
    before, after = (free_run_gap.gap(run, signals, start, len(signals), leave)
                     for run, leave in zip(runs, (of_nominal, false), strict=True))
    floors = free_run_gap.floor(signals, start, len(signals))
    share, low, high = free_run_gap.closure(before, after, floors)
    return ClosedGap(before.total, after.total, before.total_floor(floors), share, low, high)


def _initial_state(model: Model, signals: Signals) -> Values:
    """The initial state with which the model follows the angle best."""
    speeds = signals.omega[np.isfinite(signals.omega)][:1]
    read = {"initial.omega": float(speeds[0])} if len(speeds) else {}

    def residuals(values: Values) -> dict[str, Array]:
        angle = free_run(model, signals, {**read, **values})["theta"]
        return {"theta": difference(signals.theta, angle) / signals.sigma["theta"]}

    return {**read, **fit(residuals, state_of_arm(model, signals)).values}
