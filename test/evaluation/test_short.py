# SPDX-License-Identifier: Apache-2.0
"""Short recordings: free curves can follow a random torque too, so it must be separated from a torque of the state."""

import pytest
from evaluation.blind import cases

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH
from aeropend_sim.model.parameters import SAMPLE_PERIOD


@pytest.mark.promise("Verdict", "A random torque is found by its statistics as `gust`")
@pytest.mark.parametrize(("effect", "form", "seed", "verdict"), [
    ("gust", "table", 201, "gust"), ("gust", "other", 202, "gust"), ("gust", "table", 203, "gust"),
    ("own_wake", "table", 201, "unknown"), ("own_wake", "table", 202, "unknown")])
def test_half_a_minute_is_enough_to_tell_chance_from_what_nobody_knows(effect, form, seed, verdict):
    _, columns = cases.draw("short", "single", [effect], form, BENCH.model, BENCH.sensing, seed, 30.0)
    body = diagnose(BENCH, [from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)]).body
    assert body["which"]["verdict"] == verdict
