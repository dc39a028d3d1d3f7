# SPDX-License-Identifier: Apache-2.0
"""Of two effects that are alike, each within a window of its own, free curves at their places find the right one."""

import numpy as np
import pytest
from evaluation.blind import cases, changes, plant

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.model.parameters import load

BENCH = load("bench")


@pytest.mark.promise("Verdict", "An effect that begins or ends during the recording is found with its instant")
def test_a_lag_of_the_thrust_that_ends_is_no_lag_of_the_encoder():
    """The encoder's lag has the higher log evidence here, as the lag of the rig has another form."""
    rng = np.random.default_rng([5, 19, 55])
    numbers = {n: v * (1.0 + rng.uniform(-0.05, 0.05)) for n, v in BENCH.model.items()}
    duty = cases.duty_signal(rng, 70.0)
    entry, columns = changes.onset("thrust_lag", numbers, BENCH.model, BENCH.sensing, duty, rng)
    made = diagnose(BENCH, [from_arrays({**columns, "duty": duty}, plant.PERIOD, BENCH.sensing)])
    assert made.conclusions.which.verdict == "thrust_lag"
    (until,) = (c.until for c in made.conclusions.which.candidates if c.found)
    assert until is not None
    assert until.low <= entry["until"] <= until.high
