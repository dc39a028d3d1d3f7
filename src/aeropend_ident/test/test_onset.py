# SPDX-License-Identifier: Apache-2.0
"""Effects that begin or end during a recording are found with their instant."""

from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.results import document, verdict_lines
from aeropend_ident.diagnosis.search import onset
from aeropend_ident.diagnosis.search.onset import SHORTEST, _located, with_window
from aeropend_ident.testing.rigs import BENCH, changing, recorded


@pytest.mark.promise("Verdict", "An effect that begins or ends during the recording is found with its instant")
@pytest.mark.parametrize(("effect", "since", "until"), [
    ("coulomb_friction", 14.3, np.inf), ("supply_sag", 0.0, 17.2), ("encoder_eccentricity", 20.1, np.inf),
    ("rotor_friction", 0.0, 11.7)])
def test_when_an_effect_begins_or_ends(effect, since, until):
    found = diagnose(BENCH, [changing(31, {effect: {}}, since, until)]).conclusions.which
    assert found.effects == (effect,)
    (one,) = (c for c in found.candidates if c.found)
    (at, true), none = ((one.since, since), one.until) if since else ((one.until, until), one.since)
    assert none is None
    assert at.low <= at.value <= at.high
    assert abs(at.value - true) < 0.5


@pytest.mark.parametrize(("seed", "since", "until"), [(63, 18.0, np.inf), (70, 18.0, np.inf), (62, 0.0, 18.0)])
def test_a_friction_begins_or_ends_that_is_far_from_linear_in_its_size(seed, since, until):
    found = diagnose(BENCH, [changing(seed, {"coulomb_friction": {"accel": 1.6}}, since, until)]).conclusions.which
    assert found.effects == ("coulomb_friction",)
    (at,) = (c.since or c.until for c in found.candidates if c.found)
    assert abs(at.value - 18.0) < 0.5


def test_a_delay_begins_between_two_steps_of_the_duty():
    found = diagnose(BENCH, [changing(31, {"command_delay": {}}, 9.4)]).conclusions.which
    assert found.effects == ("command_delay",)
    (at,) = (c.since for c in found.candidates if c.found)
    assert at.low <= 9.4 <= at.high < at.low + 2.0


@pytest.mark.parametrize("begins", [True, False])
def test_an_instant_stays_away_from_the_ends_of_what_is_fitted(begins):
    """Where each instant fits alike, the search goes to the end of its range."""
    signals = recorded(31, {})
    edge = round(SHORTEST / signals.period)
    window = (edge + 1, len(signals)) if begins else (0, edge + 1)
    found, _ = _located(with_window(CutChains(BENCH, [signals]), window).each[0], {})
    assert found[not begins] == edge


def test_an_effect_that_acts_all_the_time_has_no_instant():
    found = diagnose(BENCH, [recorded(31, {"coulomb_friction": {}})]).conclusions.which
    assert found.effects == ("coulomb_friction",)
    assert all(c.since is None and c.until is None for c in found.candidates)


@pytest.mark.promise("Verdict", "A change in the last part of a recording is judged too")
@pytest.mark.parametrize(("effect", "since"), [("coulomb_friction", 29.5), ("current_offset", 27.6)])
def test_a_change_in_the_part_that_is_held_out_at_first_or_just_before(effect, since):
    signals = changing(32, {effect: {}}, since)
    made = diagnose(BENCH, [signals])
    text = "\n".join(verdict_lines(document(made, ["bag"], "bench", 0.0)))
    assert made.conclusions.which.effects == (effect,)
    assert f"begins at {since:.1f}" in text
    assert any("only the rest is held out" in note for s in made.signals for note in s.notes)


def test_a_stage_whose_rest_has_no_instant_does_not_hide_one_further_on(monkeypatch):
    """The noise of the voltage is 5 % larger than stated; a friction begins."""
    monkeypatch.setattr(onset, "stages_of", lambda *_: defaultdict(tuple))
    monkeypatch.setattr(onset, "passes_as_noise", lambda f, _: f == "passes")
    windows = {"actuator": [], "arm": [(700, 1000)]}
    monkeypatch.setattr(onset, "_best_windows", lambda chains, stage, *_: windows[stage])
    findings = {stage: SimpleNamespace(base=SimpleNamespace(residuals={"": 0.0}), final=final)
                for stage, final in (("actuator", "open"), ("motor", "passes"), ("arm", "open"))}
    assert onset.suspected(CutChains(BENCH, [recorded(38, duration=5.0)]), findings) == windows["arm"]
