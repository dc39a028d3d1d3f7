# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from aeropend_control.analysis import closed_loop
from aeropend_control.analysis.margins import MarginError, from_response, margins
from aeropend_control.laws.registry import LAWS
from aeropend_sim.model.parameters import load

BENCH = load("bench")


def test_margins_of_a_loop_that_is_known():
    """2/(s (s + 1)²): the phase passes -180° at 1 rad/s, where the gain is 1; half of it has a gain margin of 2."""
    s = 1j * np.geomspace(0.05, 20.0, 200)
    m = from_response(s.imag, 1.0 / (s * (s + 1.0) ** 2))
    assert m.gain == pytest.approx(2.0, rel=0.01)
    assert m.crossover == pytest.approx(0.6823, rel=0.01)
    assert m.phase == pytest.approx(math.pi / 2.0 - 2.0 * math.atan(0.6823), rel=0.01)
    assert m.delay == pytest.approx(m.phase / m.crossover, rel=0.01)


@pytest.mark.promise("Control", "`tune` meets its requirements, and prints margins")
def test_the_delay_margin_is_where_the_loop_becomes_unstable():
    found = margins(BENCH, "feedback_linearization")
    assert found.gain > 2.0
    assert math.degrees(found.phase) > 40.0
    swing = []
    for share in (0.8, 1.2):
        rig = BENCH.with_effects({"command_delay": {"delay": share * found.delay}})
        run = closed_loop.predict(LAWS["feedback_linearization"].make(BENCH), rig, closed_loop.staircase([0.4], 8.0))
        swing.append(np.ptp(run.truth["theta"][-1000:]))
    assert swing[0] < 0.05
    assert swing[1] > 0.2


@pytest.mark.parametrize(("law", "at"), [("feedback_linearization_cascade", 0.4), ("cascade", 100.0)])
def test_tuned_loops_keep_their_distance(law, at):
    found = margins(BENCH, law, at=at)
    assert found.gain > 2.0
    assert math.degrees(found.phase) > 40.0
    assert found.delay > 0.05


def test_a_loop_that_does_not_rest_has_none():
    with pytest.raises(MarginError, match="does not come to rest") as error:
        margins(BENCH, "feedback_linearization", {"kp": 400.0, "ki": 4000.0, "kd": 0.0})
    assert len(str(error.value).splitlines()) == 1
