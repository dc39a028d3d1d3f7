# SPDX-License-Identifier: Apache-2.0
"""Closed loop of a control law and a simulated rig, without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aeropend_control.laws.law import Law
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.rig import Rig, Sample, Truth

Array = NDArray[np.float64]


class ClosedLoop(NamedTuple):
    """A recorded closed loop.

    Attributes:
        time: [s] (N,).
        reference: (N,) in the unit of the law's reference.
        duty: [0..1] (N,) applied from each sample on.
        measured: (N,) each; the readings, by the fields of `Sample`.
        truth: (N,) each; the true states, by the fields of `Truth`.
    """

    time: Array
    reference: Array
    duty: Array
    measured: dict[str, Array]
    truth: dict[str, Array]


def run(law: Law, rig: Rig, reference: ArrayLike) -> ClosedLoop:
    """Run a law and a rig in closed loop; both are reset first.

    The duty for a sample acts from the next sample on, as in the ROS graph.

    Args:
        law: the control law.
        rig: the simulated rig.
        reference: (N,) a reference for each sample.
    """
    law.reset()
    rig.reset()
    reference = np.asarray(reference, dtype=float)
    n = len(reference)
    applied, read, true = np.zeros(n), np.empty((n, len(Sample._fields))), np.empty((n, len(Truth._fields)))
    duty = 0.0
    for k, r in enumerate(reference.tolist()):
        applied[k] = duty
        read[k], true[k] = sample, _ = rig.sample(duty)
        duty = law.step(sample, r)
    return ClosedLoop(rig.period * np.arange(n, dtype=float), reference, applied, dict(zip(Sample._fields, read.T)),
                      dict(zip(Truth._fields, true.T)))


def predict(law: Law, model: Model, reference: ArrayLike, seed: int = 0) -> ClosedLoop:
    """Run a law in closed loop with a model and its measurement chain.

    Args:
        law: the control law.
        model: the model of the rig.
        reference: (N,) a reference for each sample.
        seed: of all random numbers.
    """
    return run(law, Rig(model, seed), reference)


def staircase(levels: Sequence[float], hold: float, period: float = SAMPLE_PERIOD) -> Array:
    """A reference (N,) that is constant at each level.

    Args:
        levels: values of the reference.
        hold: [s] time at each level.
        period: [s] between samples.
    """
    return np.repeat(np.asarray(levels, dtype=float), round(hold / period))
