# SPDX-License-Identifier: Apache-2.0
"""Whatever readings a controller gets, its duty is a number from 0 to 1. `FUZZ=100` tries a hundred times as much."""

import math
import os
import warnings

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeropend_control.laws.registry import LAWS
from aeropend_control.nodes.supervisor import Supervisor
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load
from aeropend_sim.model.rig import Rig, Sample

FUZZ = int(os.environ.get("FUZZ", "1"))
BENCH = load("bench")
PERIOD_NS = round(SAMPLE_PERIOD * 1e9)
VALUES = st.one_of(st.floats(), st.sampled_from([math.nan, math.inf, -math.inf, 5e-324, 1e300, 1e6, -1e6, 1e4, 1.3]))
FIELDS = (*Sample._fields, "applied")
BAD = st.lists(st.tuples(st.integers(0, 79), st.sampled_from(FIELDS), VALUES), min_size=1, max_size=8)
STEPS = st.lists(st.tuples(st.integers(0, 79), st.sampled_from([0, -1, 2, 30, -10**6, 10**12])), max_size=2)


@pytest.mark.promise("Control", "Whatever readings a controller gets, its duty is a number from 0 to 1")
@pytest.mark.parametrize("name", LAWS)
def test_any_readings_give_a_duty_from_0_to_1(name):
    kind = LAWS[name]
    law = kind.make(BENCH, kind.tune(BENCH))
    low, high = kind.reference_limits

    @settings(max_examples=20 * FUZZ, deadline=None, derandomize=FUZZ == 1, database=None)
    @given(BAD, STEPS)
    def try_it(bad, steps):
        supervisor = Supervisor(law, measures=(kind.measures,), low=low, high=high, angle_limit=1.4)
        reference = low + 0.3 * (high - low)
        supervisor.set_reference(reference)
        rig, duty, stamp = Rig(BENCH, 1), 0.0, 10**18
        for k in range(160):
            reading, applied = rig.sample(duty)[0]._asdict(), duty
            for field, value in ((field, value) for row, field, value in bad if row == k):
                reading, applied = ({**reading, field: value}, applied) if field != "applied" else (reading, value)
            stamp += PERIOD_NS * (1 + sum(by for row, by in steps if row == k))
            supervisor.note_applied(applied)
            given_ = supervisor.step(stamp, Sample(**reading))
            duty = duty if given_ is None else given_
            assert 0.0 <= duty <= 1.0  # false for NaN too
        supervisor.set_reference(reference)  # after the angle limit
        restored = [supervisor.step(stamp := stamp + PERIOD_NS, rig.sample(0.1)[0]) for _ in range(400)]
        assert max(one or 0.0 for one in restored) > 0.0

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try_it()
