# SPDX-License-Identifier: Apache-2.0
"""How far the gap closes across recordings: on one that no number and no choice of an effect has seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis import free_run_gap
from aeropend_ident.diagnosis.chain.chain import Values, difference
from aeropend_ident.diagnosis.chain.priors import state_of_arm
from aeropend_ident.estimation.map_fit import fit
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

FORGOTTEN = 5.0
"""s after which the arm no longer remembers the state that it started in."""


def across(model: Model, augmented: Model, signals: Signals) -> dict[str, float | None]:
    """The gap of a recording before and after, free run from its duty alone.

    Args:
        model: the nominal model. augmented: with what other recordings of the rig showed.
        signals: the recording. It is judged from `FORGOTTEN` on, or from its middle if that comes first; what comes
            before tells the state that it starts in, and nothing else.

    Returns:
        `gap`, `gap_after`, `floor`, `closed`, `low`, `high`, as `shrink` in `diagnosis.json` (contract section 5).
    """
    start = min(round(FORGOTTEN / signals.period), len(signals) // 2)
    left_out = signals.false_speed if "speed_spikes" in augmented.effects else None
    runs = [free_run_gap.free_run(m, signals, _started(m, signals.head(start))) for m in (model, augmented)]
    before, after = (free_run_gap.gap(run, signals, start, len(signals), leave)
                     for run, leave in zip(runs, (None, left_out), strict=True))
    floors = free_run_gap.floor(signals, start, len(signals))
    bottom = float(np.sqrt(np.mean([(floors[c] / before.spread[c]) ** 2 for c in before.rms])))
    share, low, high = free_run_gap.closed(before, after, floors)
    return {"gap": before.total, "gap_after": after.total, "floor": bottom, "closed": share, "low": low, "high": high}


def _started(model: Model, signals: Signals) -> Values:
    """The state at the first sample with which the model follows the angle best."""
    speeds = signals.omega[np.isfinite(signals.omega)][:1]
    read = {"initial.omega": float(speeds[0])} if len(speeds) else {}

    def residuals(values: Values) -> dict[str, Array]:
        angle = free_run_gap.free_run(model, signals, {**read, **values})["theta"]
        return {"theta": difference(signals.theta, angle) / signals.sigma["theta"]}

    return {**read, **fit(residuals, state_of_arm(model, signals, "")).values}
