# SPDX-License-Identifier: Apache-2.0
import pytest

from aeropend_sim.cli.axis import multiples, tick_step


@pytest.mark.parametrize(("low", "high", "step"), [
    (0.0, 8.0, 1.0), (0.0, 8.1, 2.0), (0.0, 0.45, 0.1), (-0.2, 0.8, 0.2), (0.0, 3e4, 5e3), (1.0, 1.0041, 1e-3)])
def test_the_step_is_the_smallest_round_one_that_gives_few_enough_intervals(low, high, step):
    assert tick_step(low, high, 8.0) == pytest.approx(step)


def test_a_tolerance_takes_a_step_that_is_a_little_too_small():
    assert tick_step(0.0, 8.004, 8.0) == 2.0
    assert tick_step(0.0, 8.004, 8.0, tolerance=0.001) == 1.0


def test_the_ticks_lie_on_the_axis():
    assert [k * 0.5 for k in multiples(-0.6, 1.0, 0.5)] == [-0.5, 0.0, 0.5, 1.0]
