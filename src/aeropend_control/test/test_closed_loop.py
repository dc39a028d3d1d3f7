# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_control.analysis import closed_loop
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load
from aeropend_sim.model.rig import Rig, record

BENCH = load("bench")


class Ramp:
    """Its duty grows by a thousandth from sample to sample."""

    def reset(self):
        self.k = 0

    def step(self, sample, reference):
        self.k += 1
        return self.k / 1000


def test_what_the_law_asks_for_acts_one_sample_later():
    run = closed_loop.run(Ramp(), Rig(BENCH), np.zeros(5))
    assert run.duty.tolist() == [0.0, 0.001, 0.002, 0.003, 0.004]
    assert run.time == pytest.approx(SAMPLE_PERIOD * np.arange(5))


def test_the_arrays_are_what_the_rig_gives_for_these_duties():
    run = closed_loop.predict(Ramp(), BENCH, np.zeros(500), seed=4)
    measured, truth = record(BENCH, run.duty, seed=4)
    assert all(np.array_equal(run.measured[name], measured[name]) for name in run.measured)
    assert all(np.array_equal(run.truth[name], truth[name]) for name in run.truth)


def test_law_and_rig_are_reset_first():
    law, rig = Ramp(), Rig(BENCH)
    first, second = (closed_loop.run(law, rig, np.full(300, 0.2)) for _ in range(2))
    assert np.array_equal(first.measured["theta"], second.measured["theta"])
    assert np.array_equal(first.duty, second.duty)


def test_a_law_sees_the_reference_of_its_sample():
    class Follow(Ramp):
        def step(self, sample, reference):
            return reference

    reference = closed_loop.staircase([0.1, 0.3], 3 * SAMPLE_PERIOD)
    assert reference.tolist() == [0.1, 0.1, 0.1, 0.3, 0.3, 0.3]
    assert closed_loop.run(Follow(), Rig(BENCH), reference).duty.tolist() == [0.0, 0.1, 0.1, 0.1, 0.3, 0.3]
