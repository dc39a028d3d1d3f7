# SPDX-License-Identifier: Apache-2.0
"""The rigs on which `watch` is measured are what they say."""

import numpy as np
from evaluation.blind import circumstances, plant
from evaluation.blind.plant import EFFECTS
from evaluation.live import rigs


def test_a_messy_rig_has_small_imperfections_and_no_chance_in_them(monkeypatch):
    monkeypatch.setattr(rigs, "SIZED_ON", 8.0)
    drawn = rigs.imperfections(3)
    assert circumstances.BACKGROUND[0] <= len(drawn) <= circumstances.BACKGROUND[1]
    assert set(drawn) <= {*EFFECTS, *plant.OUTSIDE} - {"gust", *rigs.GROWING}
    assert drawn == rigs.imperfections(3)
    assert drawn != rigs.imperfections(4)


def test_a_loop_that_rests_keeps_each_reference_for_long():
    goal = rigs.references(np.random.default_rng(1), round(300.0 / plant.PERIOD), *rigs.ANGLES, rigs.RESTS)
    jumps = np.flatnonzero(np.diff(goal))
    assert len(jumps) > 5
    assert np.diff(jumps).min() * plant.PERIOD >= rigs.RESTS[0] - plant.PERIOD
    assert np.diff(jumps).max() * plant.PERIOD > 2.0 * rigs.HOLDS[1]
