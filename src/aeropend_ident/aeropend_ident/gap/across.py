# SPDX-License-Identifier: Apache-2.0
"""How far the gap closes across recordings: on one that no number and no choice of an effect has seen."""

from __future__ import annotations

import numpy as np

from aeropend_ident.gap import shrink
from aeropend_ident.gap.chain import Values
from aeropend_ident.gap.signals import Signals
from aeropend_sim.parameters import Model

FORGOTTEN = 5.0
"""s after which the arm no longer remembers the state that it started in."""


def across(model: Model, augmented: Model, signals: Signals) -> dict[str, float | None]:
    """The gap of a recording before and after, free run from its duty alone.

    Args:
        model: the nominal model. augmented: with what other recordings of the rig showed.
        signals: the recording. It is judged from `FORGOTTEN` on, or from its middle if that comes first: its state at
            the start is known only as well as it was read.

    Returns:
        `gap`, `gap_after`, `floor`, `closed`, `low`, `high`, as `shrink` in `diagnosis.json` (contract section 5).
    """
    start = min(round(FORGOTTEN / signals.period), len(signals) // 2)
    left_out = signals.false_speed if "speed_spikes" in augmented.effects else None
    state = _first_read(signals)
    before = shrink.gap(shrink.free_run(model, signals, state), signals, start, len(signals))
    after = shrink.gap(shrink.free_run(augmented, signals, state), signals, start, len(signals), left_out)
    floors = shrink.floor(signals, start, len(signals))
    bottom = float(np.sqrt(np.mean([(floors[c] / before.spread[c]) ** 2 for c in before.rms])))
    share, low, high = shrink.closed(before, after, floors)
    return {"gap": before.total, "gap_after": after.total, "floor": bottom, "closed": share, "low": low, "high": high}


def _first_read(signals: Signals) -> Values:
    """The state at the first sample as far as it is read."""
    angles = signals.theta[np.isfinite(signals.theta)][:10]
    speeds = signals.omega[np.isfinite(signals.omega)][:1]
    return {"initial.theta": float(np.mean(angles)), "initial.omega": float(speeds[0]) if len(speeds) else 0.0}
