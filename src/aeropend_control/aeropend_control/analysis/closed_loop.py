# SPDX-License-Identifier: Apache-2.0
"""A control law and a simulated rig in a loop, sample by sample."""

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
    """What happened; every array (N,).

    Attributes:
        time: s. reference: what the law was asked for. duty: applied from each sample on.
        measured: what the rig reports, by the names of `Sample`.
        truth: its true states, by the names of `Truth`.
    """

    time: Array
    reference: Array
    duty: Array
    measured: dict[str, Array]
    truth: dict[str, Array]


def run(law: Law, rig: Rig, reference: ArrayLike) -> ClosedLoop:
    """Let a law control a rig; both are reset first.

    What the law returns for a sample acts from the next one on, as over the graph.

    Args:
        law: the control law.
        rig: stands for the real one, or is a model of it.
        reference: (N,), one for each sample.
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
    """What a law does on a model, its measurement chain included; `seed` is of all chance."""
    return run(law, Rig(model, seed), reference)


def staircase(levels: Sequence[float], hold: float, period: float = SAMPLE_PERIOD) -> Array:
    """A reference (N,) that holds each level for `hold` s."""
    return np.repeat(np.asarray(levels, dtype=float), round(hold / period))
