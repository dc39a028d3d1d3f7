# SPDX-License-Identifier: Apache-2.0
"""A rig whose arm is braked while it rises only: an effect that the catalogue does not hold."""

import math

import numpy as np

from aeropend_ident.testing.rigs import drawn_rig, steps
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.model.rig import record

SUBSTEPS = 10


def recorded_columns(seed, duration, drag):
    """Channels and duty (N,) by name; the motor is that of the simulated rig, the arm is integrated here.

    Args:
        seed: of the rig, the duty and the noise.
        duration: [s] of the recording.
        drag: [1/s] damping of the rising arm, beside that of the model.
    """
    model, duty = drawn_rig(seed, {}), steps(duration, seed)
    columns, truth = record(model, duty, seed)
    p, sensing = model.model, model.sensing
    h, keep = SAMPLE_PERIOD / SUBSTEPS, math.exp(-SAMPLE_PERIOD / sensing["angle_filter_tau"])
    angle = rate = first = second = 0.0
    read = np.empty(len(duty))
    for k, omega in enumerate(truth["omega"]):
        read[k] = second
        thrust = p["L_over_J"] * p["k_thrust"] * omega**2
        for _ in range(SUBSTEPS):
            rate += h * (thrust - p["mgd_over_J"] * math.sin(angle) - p["c_over_J"] * rate - drag * max(rate, 0.0))
            angle += h * rate
        first += (1.0 - keep) * (angle - first)
        second += (1.0 - keep) * (first - second)
    read += sensing["angle_noise"] * np.random.default_rng(seed).standard_normal(len(read))
    return {**columns, "theta": np.round(read / sensing["angle_lsb"]) * sensing["angle_lsb"], "duty": duty}
