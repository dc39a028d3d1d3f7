# SPDX-License-Identifier: Apache-2.0
"""The blind check of rigs as they are draws what it says, and each of its figures can fail."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation.blind import cases, changes, circumstances, folder, other_rigs, plant
from evaluation.blind.circumstances import Judged
from evaluation.blind.score import Answer

from aeropend_sim.model.parameters import Model, load

BENCH = load("bench")


def test_a_messy_rig_has_many_imperfections_and_one_main_effect():
    rng = np.random.default_rng(3)
    rig = cases.Weighed(BENCH.model, BENCH.model, BENCH.sensing, cases.duty_signal(rng, 20.0))
    drawn, shares = circumstances.messy(rng, rig)
    assert 11 <= len(drawn) <= 13
    assert len({d.effect for d in drawn}) == len(drawn)
    main = drawn[0].effect
    assert main in plant.EFFECTS
    assert shares[main] == max(shares.values()) > circumstances.MAIN_SHARE[0]


def test_a_refit_absorbs_as_much_as_the_model_file_may_be_off():
    """The resistance is at the upper end of its tolerance: a refit may lower it, and not raise it."""
    numbers = {**BENCH.model, "R_a": (1.0 + cases.OFF) * BENCH.model["R_a"]}
    rig = cases.Weighed(numbers, BENCH.model, BENCH.sensing, cases.duty_signal(np.random.default_rng(3), 10.0))

    def left(factor):
        p = rig.packed({}, {}, other=False, numbers={**numbers, "R_a": factor * numbers["R_a"]})
        return rig.gap(rig.moved(p, np.zeros(0)))

    assert left(0.94) < 0.05 * left(1.06)


def test_three_effects_are_at_three_places():
    for row, effects in circumstances.plan(40, 1):
        if row == "three effects":
            assert len({cases.PLACES[e] for e in effects}) == 3


@pytest.mark.parametrize("row", [row for row in circumstances.ROWS if row != "other rigs"])
def test_a_recording_is_made_of_each_circumstance(row):
    effects = {"closed loop": ["gust"], "three effects": ["gust", "supply_sag", "thrust_lag"],
               "onset": ["thrust_lag"], "slow drift": ["sensing"]}.get(row, [])
    label, columns, lost = circumstances.make(row, effects, BENCH.model, BENCH.sensing, 5, 10.0)
    assert label["row"] == row
    assert all(np.isfinite(x).all() for x in columns.values())
    assert not lost[0]
    assert bool(label["effects"]) == (row != "nothing missing")


@pytest.mark.parametrize("effect", ["thrust_lag", "current_offset"])
def test_an_effect_begins_or_ends_at_its_instant(effect):
    duty = cases.duty_signal(np.random.default_rng(8), 10.0)
    without = plant.packed(BENCH.model, BENCH.sensing["angle_filter_tau"], {}, {}, other=False)
    y, v, _ = plant.states(without, duty, np.zeros(0))
    ideal, seen = plant.shown(without, y, v), set()
    for seed in range(6):
        entry, columns = changes.onset(effect, BENCH.model, BENCH.model, BENCH.sensing, duty,
                                       np.random.default_rng(seed))
        (which,) = {"since", "until"} & set(entry)
        seen.add(which)
        assert entry["hidden"][0] <= entry[which] <= entry["hidden"][1]
        k = round(entry[which] / plant.PERIOD)
        assert 0.15 * len(duty) <= k <= 0.85 * len(duty)
        off = max(np.sqrt(np.mean((columns[c] - ideal[c])[:k] ** 2)) / BENCH.sensing[noise]
                  for c, noise in (("theta", "angle_noise"), ("i_a", "current_noise")))
        assert (off < 3.0) == (which == "since")
    assert seen == {"since", "until"}


def test_other_rigs_are_slow_and_fast_and_have_model_files_of_their_own(tmp_path):
    made = [other_rigs.make("thrust_lag", BENCH.model, BENCH.sensing, 10.0, np.random.default_rng(k)) for k in range(4)]
    assert len({round(one.label["rate"]) for one in made}) > 1
    for one in made:
        assert 0.9 * other_rigs.GRAVITY[0] < one.model["mgd_over_J"] < 1.1 * other_rigs.GRAVITY[1]
        assert np.abs(one.columns["theta"]).max() < other_rigs.HIGHEST + 0.5
        assert all(len(x) == pytest.approx(10.0 / one.period, abs=1) for x in one.columns.values())
    folder.write_model(tmp_path, "c001", Model("rig", made[0].model, made[0].sensing))
    assert folder.model_of(tmp_path, "c001").model == made[0].model
    assert folder.model_of(tmp_path, "c002") == BENCH


def test_a_slow_drift_moves_the_reading_or_the_arm_by_as_much():
    rng = np.random.default_rng(2)
    duty = np.zeros(round(20.0 / plant.PERIOD))
    for place in changes.DRIFTING:
        entry, columns = changes.drift(place, BENCH.model, BENCH.sensing, duty, rng)
        assert entry["place"] == place
        assert np.ptp(columns["theta"]) == pytest.approx(abs(entry["parameters"]["size"]), abs=0.02)


def judged(row, effects, shares, first, found, stated=None, place="arm"):
    label = {"row": row, "shares": shares,
             "effects": [{"effect": e, "place": "arm", "parameters": {}} for e in effects]}
    return Judged(label, Answer(first, tuple(found), place=place, seconds=1.0), stated or {})


def values(*all_):
    return {f.name: f.value for f in circumstances.figures(all_)}


def test_each_figure_of_the_circumstances_can_fail():
    shares = {"gust": 0.8, "brush_drop": 0.01}
    right = judged("messy", ["gust", "brush_drop"], shares, "gust", ["gust"], {"gust": (0.8, 0.7, 0.9)})
    wrong = judged("messy", ["gust", "brush_drop"], shares, "brush_drop", ["brush_drop", "gust", "thrust_lag"],
                   {"gust": (0.5, 0.4, 0.6)}, "electrical")
    good, bad = values(right), values(wrong)
    for name, best, worst in (("messy, half of the gap or more: main effect first", 1.0, 0.0),
                              ("messy, half of the gap or more: place", 1.0, 0.0),
                              ("messy: ghosts a recording", 0.0, 2.0),
                              ("messy: 95 % interval of the share holds the true share", 1.0, 0.0)):
        assert (good[name], bad[name]) == (best, worst), name
    named = "messy, half of the gap or more: first, or said to be not separable from the first"
    said = replace(wrong, answer=replace(wrong.answer, named=("brush_drop", "gust")))
    assert (good[named], bad[named], values(said)[named]) == (1.0, 0.0, 1.0)
    nothing = "nothing missing: an effect or `unknown` claimed"
    assert values(judged("nothing missing", [], {}, "none", []))[nothing] == 0.0
    assert values(judged("nothing missing", [], {}, "unknown", []))[nothing] == 1.0
    three = "three effects: all named"
    assert values(judged("three effects", ["gust", "supply_sag"], {}, "gust", ["gust", "supply_sag"]))[three] == 1.0
    assert values(judged("three effects", ["gust", "supply_sag"], {}, "gust", ["gust"]))[three] == 0.0
    both = judged("three effects", ["gust", "supply_sag"], {}, "gust", ["gust"])
    listed = "three effects: all named, or listed as small"
    assert values(both)[listed] == 0.0
    assert values(replace(both, answer=replace(both.answer, small=("supply_sag",))))[listed] == 1.0
    material = "three effects: all named that make 3 % of the gap or more"
    one_small = {"gust": 0.9, "supply_sag": 0.02}
    for found, expected in (("gust", 1.0), ("supply_sag", 0.0)):
        assert values(judged("three effects", ["gust", "supply_sag"], one_small, found, [found]))[material] == expected
    loop = "closed loop: right effect first"
    assert values(judged("closed loop", ["gust"], {}, "gust", ["gust"]))[loop] == 1.0
    assert values(judged("closed loop", ["gust"], {}, "none", []))[loop] == 0.0
    begun = {"effect": "gust", "place": "arm", "parameters": {}, "since": 20.0, "hidden": [19.0, 21.0]}
    for instants, first, expected in (
            ([("since", 21.4)], "gust", (1.0, 1.0)), ([("since", 21.6)], "gust", (1.0, 0.0)),
            ([("since", 18.4)], "gust", (1.0, 0.0)), ([("until", 20.0)], "none", (0.0, 0.0)),
            ([("since", 18.6)], "x", (0.0, 1.0))):
        found = values(Judged({"row": "onset", "shares": {}, "effects": [begun]},
                              Answer(first, (first,), place="arm", seconds=1.0), {}, instants))
        assert tuple(found[f"onset: {n}"] for n in ("right effect first", "begins or ends within 0.5 s")) == expected
    drift = "slow drift of a reading or a force: right place"
    assert values(judged("slow drift", ["drift"], {}, "unknown", [], place="arm"))[drift] == 1.0
    assert values(judged("slow drift", ["drift"], {}, "unknown", [], place="sensing"))[drift] == 0.0
    other = "other rigs: right effect, or none, first"
    assert values(judged("other rigs", [], {}, "none", []))[other] == 1.0
    assert values(judged("other rigs", [], {}, "gust", ["gust"]))[other] == 0.0
