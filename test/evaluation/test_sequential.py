# SPDX-License-Identifier: Apache-2.0
"""The measurement of experiments by design: it can see a limit that is crossed, and a pair that is not told apart."""

import math
from dataclasses import replace

import numpy as np
import pytest
from evaluation.blind import sequential
from evaluation.blind.sequential import Investigated, Pair, drawn_rig, figures, of_size, template

from aeropend_ident.design.limits import Limits
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import load

BENCH = load("bench")


def test_a_rig_of_the_plant_that_goes_too_far_is_counted(monkeypatch):
    """The design is replaced by a signal that was not designed."""
    class Bold:
        excitation = Excitation("hold", 8.0, duty=0.9)
        reach = {"theta": (0.0, 0.0), "omega": (0.0, 0.0), "i_a": (0.0, 0.0)}  # noqa: RUF012

    monkeypatch.setattr(sequential, "design", lambda *_, **__: Bold)
    monkeypatch.setattr(sequential, "DRAWN", 3)
    assert sequential.crossed(0, 1)[0] == 3


def test_an_effect_of_the_plant_is_recorded():
    duty = Excitation(duration=8.0, seed=2).series()
    recordings = [drawn_rig(BENCH, effects, np.random.default_rng(4)).moved(BENCH, duty).recorded(
        BENCH, np.random.default_rng(5))
                  for effects in ({}, {"angle_offset": of_size("angle_offset", 1.0)})]
    assert np.nanmean(recordings[1].theta - recordings[0].theta) == pytest.approx(0.06, abs=0.01)


def test_the_closest_rivals_are_no_strangers():
    rivals = sequential.closest(BENCH)
    assert "encoder_lag" in rivals["thrust_lag"]
    assert all(len(found) == sequential.CLOSEST and effect not in found for effect, found in rivals.items())


def test_the_best_known_signal_keeps_the_limits():
    rows, goal = sequential.Rows(BENCH, template(BENCH), sequential.asked(BENCH)), None
    goal = sequential.between(rows, ["thrust_lag", "encoder_lag"])
    signal, distance = sequential.best_before(rows, goal, 10.0)
    assert distance > 0.0
    assert sequential.LIMITS.excess(rows.under(signal.series()).reach) <= 0.0


def test_the_figures_count_what_is_not_reached():
    one = Investigated("thrust_lag", sure=True, verdict="thrust_lag", moved=20.0, plain="none", plain_sure=True,
                       crossed=False)
    rigs = [one, replace(one, verdict="encoder_lag"), replace(one, sure=False, moved=120.0, crossed=True)]
    found = {f.name: f for f in figures([(2, 0.1)], [Pair("a", "b", math.inf, (False, False, True))], rigs)}
    assert found["limits: rigs of 500 that cross one"].value == 2.0
    assert found["pairs: in half the time or less, by prediction"].value == 0.0
    assert found["pairs: the best signal of diagnose, 40 s"].value == 1.0
    assert found["cold start: motion until the verdict is sure, s"].value == 20.0
    assert found["cold start: a sure verdict is right"].value == 0.5
    assert found["cold start: a limit was crossed"].value == pytest.approx(1.0 / 3.0)
    assert Limits().ranges.keys() == {"theta", "omega", "i_a"}
