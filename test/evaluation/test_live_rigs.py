# SPDX-License-Identifier: Apache-2.0
"""The rigs on which `watch` is measured are what they say."""

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
