# SPDX-License-Identifier: Apache-2.0
"""The recording that a planned experiment would give, of a rig like the model."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.values import own_sensing
from aeropend_ident.signals.signals import CHANNELS, Signals, from_arrays
from aeropend_sim.errors import UserError
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

Array = NDArray[np.float64]

SEED = 0
"""Seed of the noise of a planned recording (convention)."""


class PlanError(UserError):
    """An experiment that cannot be planned. The message is one line."""


def planned(model: Model, duty: Array, channels: Collection[str] = tuple(CHANNELS), period: float = SAMPLE_PERIOD
            ) -> Signals:
    """The recording of a rig that is like the model, with the noise that the model file states.

    It is read as a recording is: noise, resolution and pulses are those that a diagnosis would find.

    Args:
        model: the nominal model.
        duty: (N,) 0..1, held for one period each.
        channels: that are measured; `theta` must be among them.
        period: [s] between samples.

    Raises:
        PlanError: an unknown channel, or no angle.
        RecordingError: the recording would be too short, or nothing would happen in it.
    """
    if wrong := [c for c in channels if c not in CHANNELS]:
        raise PlanError(f"'{wrong[0]}' is no channel: give some of {', '.join(CHANNELS)}")
    if "theta" not in channels:
        raise PlanError("no diagnosis without the angle of the arm: add theta to the channels")
    columns, _ = rig.record(model, duty, SEED, period)
    nothing = np.full(len(duty), np.nan)
    read = {c: columns[c] if c in channels else nothing for c in CHANNELS}
    return from_arrays({**read, "duty": duty}, period, model.sensing, name="the planned recording")


def like(model: Model, s: Signals, channels: Collection[str] | None = None) -> Signals:
    """The recording of a rig that is like the model, with the duty, the channels and the noise of a recording.

    Args:
        model: the nominal model.
        s: the recording.
        channels: that are measured; None: those of the recording.
    """
    there = [c for c in CHANNELS if s.has(c)]
    if channels is not None and (missing := [c for c in channels if c not in there]):
        raise PlanError(f"the recording has no {missing[0]}: it has {', '.join(there)}")
    same = replace(model, sensing=own_sensing(model, [s]))
    return planned(same, s.duty, there if channels is None else channels, s.period)
