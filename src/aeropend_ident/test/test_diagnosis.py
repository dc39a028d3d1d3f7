# SPDX-License-Identifier: Apache-2.0
"""Known truth in, the same truth out: every effect at its default size, in rigs whose numbers are off."""

import json
import math
import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.diagnosis import diagnosis
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.free_run_gap import Gap
from aeropend_ident.diagnosis.gap_share import Part
from aeropend_ident.diagnosis.left_open import design_command
from aeropend_ident.diagnosis.measured import Measured, Settings
from aeropend_ident.diagnosis.results import document, verdict_lines
from aeropend_ident.diagnosis.validation import validate
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig, recorded, steps
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.untrusted import printable

RANDOM = {"gust", "speed_spikes"}


def candidate(body, effect):
    return next(c for c in body["which"]["candidates"] if c["effect"] == effect)


@pytest.mark.promise("Verdict", "Every effect of the catalogue is named, with its place")
@pytest.mark.parametrize("effect", CATALOGUE)
def test_each_effect_is_named_placed_and_measured(effect):
    body = diagnose(BENCH, [recorded(list(CATALOGUE).index(effect) + 50, {effect: {}})]).body
    assert body["which"]["verdict"] == effect
    assert body["where"]["place"] == CATALOGUE[effect].place
    size = candidate(body, effect)["parameters"][CATALOGUE[effect].size]
    true = CATALOGUE[effect].parameters[CATALOGUE[effect].size].default
    assert abs(size["value"] - true) < 2.0 * (size["high"] - size["low"]) + 0.02 * abs(true)
    if effect not in RANDOM:
        assert body["shrink"]["closed"] > 0.9
        for channel in body["channels"].values():
            assert channel["gap_after"] < 2.0 * channel["floor"]
    json.dumps(body, allow_nan=False)


@pytest.mark.promise("Verdict", "Parameters within 5 % are refitted and count as no effect")
@pytest.mark.parametrize("seed", range(4))
def test_a_rig_whose_numbers_are_merely_a_little_off_has_no_effect(seed):
    body = diagnose(BENCH, [recorded(seed)]).body
    assert (body["which"]["verdict"], body["which"]["effects"]) == ("none", [])
    assert body["shrink"]["gap_after"] < 1.2 * body["shrink"]["floor"]


@pytest.mark.promise("Verdict", "Several effects are found; the one with the largest share comes first")
def test_two_effects_in_different_places_are_both_found():
    body = diagnose(BENCH, [recorded(71, {"coulomb_friction": {}, "brush_drop": {}})]).body
    assert set(body["which"]["effects"]) == {"coulomb_friction", "brush_drop"}


@pytest.mark.promise("Augmented model", "Friction and a thrust exponent are found to a part in a thousand")
def test_friction_and_a_curve_of_thrust_are_found_to_a_part_in_a_thousand():
    effects = {"coulomb_friction": {"accel": 1.0}, "thrust_exponent": {"n": 2.15}}
    duty = Excitation(duration=60.0).series()
    columns, _ = rig.record(drawn_rig(0, effects, off=0.0), duty, 1)
    body = diagnose(BENCH, [from_arrays(columns | {"duty": duty}, SAMPLE_PERIOD, BENCH.sensing)]).body
    assert set(body["which"]["effects"]) == set(effects)
    assert candidate(body, "coulomb_friction")["parameters"]["accel"]["value"] == pytest.approx(1.0, abs=2e-3)
    assert candidate(body, "thrust_exponent")["parameters"]["n"]["value"] == pytest.approx(2.15, abs=2e-3)


@cache
def beside_each_other(friction, drop):
    """A recording of a rig with friction and a voltage drop at the brushes, and its diagnosis."""
    signals = recorded(71, {"coulomb_friction": {"accel": friction}, "brush_drop": {"v_brush": drop}})
    return signals, diagnose(BENCH, [signals])


@pytest.mark.promise("Verdict", "Several effects are found; the one with the largest share comes first")
@pytest.mark.parametrize(("friction", "drop", "first"), [(4.0, 0.05, "coulomb_friction"), (0.2, 0.8, "brush_drop")])
def test_the_effect_that_opens_more_of_the_gap_comes_first(friction, drop, first):
    effects, body = ("coulomb_friction", "brush_drop"), beside_each_other(friction, drop)[1].body
    assert {*body["which"]["effects"], *body["which"].get("small", [])} == set(effects)
    assert body["which"]["verdict"] == body["which"]["effects"][0] == first
    shares = [candidate(body, effect)["share"]["value"] for effect in effects]
    assert shares[effects.index(first)] == max(shares)
    assert sum(shares) == pytest.approx(1.0, abs=0.1)


@pytest.mark.promise("Verdict", "An effect is claimed if its share is material; smaller ones are listed")
def test_an_effect_that_makes_little_of_the_gap_is_small_unless_a_person_asks_for_it():
    signals, found = beside_each_other(0.2, 0.8)
    usual, strict = found.conclusions.which, diagnose(BENCH, [signals], material=0.0).conclusions.which
    assert (usual.effects, usual.small) == (("brush_drop",), ("coulomb_friction",))
    assert (strict.effects, strict.small) == (("brush_drop", "coulomb_friction"), ())
    assert [c.effect for c in usual.candidates if c.found] == ["brush_drop"]


def test_the_verdict_in_a_terminal_tells_the_shares_in_plain_characters():
    lines = verdict_lines(document(beside_each_other(0.2, 0.8)[1], ["bag"], "bench", 0.0))
    (claimed,) = (line for line in lines if line.startswith("  brush_drop: "))
    (small,) = (line for line in lines if line.startswith("  not claimed: coulomb_friction, "))
    assert all(re.search(r"\d+ % \(-?\d+ to \d+ %\) of the squared gap$", line) for line in (claimed, small))
    assert lines == [printable(line) for line in lines]


def with_false_speeds(seed, count):
    """A recording of a rig that is a little off, with some false speeds, each held until the next pulse."""
    rng = np.random.default_rng(seed)
    duty = steps(28.0, seed)
    columns, _ = rig.record(drawn_rig(seed, {}), duty, seed)
    omega = columns["omega"].copy()
    pulses = np.flatnonzero(np.diff(omega)) + 1
    pulses = pulses[omega[pulses] > 50.0]
    for k in rng.choice(len(pulses) - 1, count, replace=False):
        omega[pulses[k]:pulses[k + 1]] *= rng.uniform(1.5, 3.0)
    return from_arrays({**columns, "omega": omega, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)


@pytest.mark.promise("Verdict", "A few false speeds are left out and said; more are the effect `speed_spikes`")
def test_a_few_false_speeds_leave_no_gap_open():
    made = diagnose(BENCH, [with_false_speeds(11, 3)])
    assert made.conclusions.which.verdict == "none"
    assert made.conclusions.closure.gap_after < 1.2 * made.conclusions.closure.floor
    assert any("3 false speeds left out" in note for s in made.signals for note in s.notes)


@pytest.mark.promise("Verdict", "A few false speeds are left out and said; more are the effect `speed_spikes`")
def test_some_more_false_speeds_are_the_effect():
    made = diagnose(BENCH, [with_false_speeds(12, 8)])
    assert made.conclusions.which.verdict == "speed_spikes"
    assert not any("false speeds" in note for s in made.signals for note in s.notes)


@pytest.mark.parametrize("channel", ["omega", "i_a", "v_a"])
def test_a_channel_that_was_read_on_held_out_data_only_is_no_reason_to_fail(channel):
    duty = steps(20.0, 97)
    columns, _ = rig.record(drawn_rig(97, {"coulomb_friction": {}}), duty, 97)
    columns[channel] = np.where(np.arange(len(duty)) < 0.7 * len(duty), np.nan, columns[channel])
    signals = from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)
    assert diagnose(BENCH, [signals]).conclusions.which.verdict == "coulomb_friction"


@pytest.mark.promise("Verdict", "The numbers of the measurement chain have tolerances")
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_filter_within_its_tolerance_is_no_effect(factor):
    signals = filtered(factor)
    body = diagnose(BENCH, [signals]).body
    assert body["which"]["verdict"] == "none"
    row = body["which"]["numbers"]["sensing.angle_filter_tau"]
    assert row["low"] < factor * BENCH.sensing["angle_filter_tau"] < row["high"]


@pytest.mark.promise("Verdict", "The numbers of the measurement chain have tolerances")
@pytest.mark.parametrize(("name", "factor"), [("angle_filter_tau", 0.8), ("angle_filter_tau", 1.2),
                                              ("speed_tick", 4.0), ("current_lsb", 2.0)])
def test_a_measurement_chain_that_is_off_is_no_effect_of_the_rig(name, factor):
    sensing = {**BENCH.sensing, name: factor * BENCH.sensing[name]}
    duty = steps(20.0, 96)
    columns, _ = rig.record(Model("rig", drawn_rig(96, {}).model, sensing), duty, 96)
    which = diagnose(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)]).body["which"]
    assert set(which["effects"]) <= {"encoder_lag"}
    assert which["verdict"] in {"none", "encoder_lag"}


@pytest.mark.promise("Verdict", "The numbers of the measurement chain have tolerances")
def test_a_filter_that_is_much_faster_is_a_negative_lag():
    body = diagnose(BENCH, [filtered(0.2)]).body
    assert body["which"]["verdict"] == "encoder_lag"
    tau = candidate(body, "encoder_lag")["parameters"]["tau"]
    assert tau["low"] < -0.8 * BENCH.sensing["angle_filter_tau"] < tau["high"] < 0.0


def filtered(factor):
    """A recording of a rig whose filter has another time constant than the model file states; fine resolution."""
    sensing = {**BENCH.sensing, "angle_filter_tau": factor * BENCH.sensing["angle_filter_tau"], "angle_lsb": 1e-4,
               "angle_noise": 2e-4}
    duty = steps(20.0, 74)
    columns, _ = rig.record(Model("rig", BENCH.model, sensing), duty, 74)
    return from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, {**BENCH.sensing, "angle_lsb": 1e-4})


@pytest.mark.promise("Verdict", "Several effects are found; the one with the largest share comes first")
def test_two_effects_in_one_place_are_both_found():
    body = diagnose(BENCH, [recorded(72, {"coulomb_friction": {}, "thrust_lag": {}})]).body
    assert set(body["which"]["effects"]) == {"coulomb_friction", "thrust_lag"}


def test_the_most_harmful_effect_is_taken_out_alone_unless_the_gap_is_then_larger(monkeypatch):
    amounts = {frozenset("abc"): {"a": -3.0, "b": -1.0, "c": 2.0}, frozenset("bc"): {"b": 4.0, "c": -0.5}}
    totals = {frozenset("abc"): 5.0, frozenset("bc"): 4.0, frozenset("b"): 6.0}

    def measured(_fitted, found, _progress):
        return found, None, SimpleNamespace(after=SimpleNamespace(total=totals[found], diverges=False),
                                            before=SimpleNamespace(total=7.0, diverges=False))

    monkeypatch.setattr(diagnosis, "parts_of", lambda found, *_: [
        Part(name, "arm", amount, np.zeros(1)) for name, amount in amounts[found].items()])
    monkeypatch.setattr(diagnosis, "_without", lambda found, name: found - {name})
    monkeypatch.setattr(diagnosis, "fit_and_measure", measured)
    start = frozenset("abc")
    found, _, _, parts = diagnosis._without_harmful(None, start, None, measured(None, start, None)[2], Settings(), None)
    assert found == {"b", "c"}
    assert [p.amount for p in parts] == [4.0, -0.5]


@pytest.mark.parametrize(("before", "left"), [(4.0, set()), (4.95, {"a"}), (6.0, {"a"})])
def test_an_effect_that_closes_a_part_of_the_fitted_data_but_opens_the_held_out_gap_is_taken_out(
        monkeypatch, before, left):
    """The arm rests in the held-out part: parts are of the whole recording."""
    totals = {frozenset("a"): 5.0, frozenset(): before}

    def measured(_fitted, found, _progress):
        after, nominal = (SimpleNamespace(total=x, diverges=False) for x in (totals[found], before))
        return found, None, SimpleNamespace(after=after, before=nominal)

    monkeypatch.setattr(diagnosis, "parts_of", lambda found, *_: [Part(n, "arm", 50.0, np.zeros(1)) for n in found])
    monkeypatch.setattr(diagnosis, "_without", lambda found, name: found - {name})
    monkeypatch.setattr(diagnosis, "fit_and_measure", measured)
    start = frozenset("a")
    assert diagnosis._without_harmful(None, start, None, measured(None, start, None)[2], Settings(), None).found == left


def test_what_stays_open_is_unknown_though_the_joint_fit_closes_a_larger_misfit_elsewhere(monkeypatch):
    monkeypatch.setattr(diagnosis, "learn", lambda *arguments: [])
    found = diagnose(BENCH, [recorded(71, {"voltage_offset": {"bias": 0.1}})], left_out=["voltage_offset"])
    assert found.conclusions.closure.closed < 0.6
    assert found.body["which"]["verdict"] == "unknown"


def test_a_learned_term_closes_the_gap_of_an_effect_that_is_not_in_the_catalogue():
    found = diagnose(BENCH, [recorded(71, {"voltage_offset": {"bias": 0.1}})], left_out=["voltage_offset"])
    assert found.body["which"]["verdict"] == "unknown"
    assert found.conclusions.closure.closed > 0.95


def left_gaps(rms, floor=0.0):
    """A gap of the angle above this floor."""
    return SimpleNamespace(after=Gap({"theta": rms}, {"theta": 1.0}, np.full((1, 1), rms**2)), floors={"theta": floor})


def left(rms, floor, parts=()):
    """Findings that leave this gap above this floor."""
    return Measured(None, None, left_gaps(rms, floor), [Part(name, "arm", x, np.zeros(1)) for name, x in parts])


@pytest.mark.parametrize(("rms", "closes_more"), [(0.19, True), (0.199, False), (0.21, False)])
def test_a_learned_term_is_kept_only_if_it_closes_materially_more(rms, closes_more):
    known = left(0.2, 0.0, [("cable_torque", 0.06), ("gust", -1.0)])
    assert left(rms, 0.0).closes_more(known, material=0.03) == closes_more


def test_a_learned_term_with_which_the_run_diverges_is_not_kept():
    known, diverging = left(6.0, 0.0), left(1e5, 0.0)
    assert left(0.1, 0.0).closes_more(known, material=0.03)
    diverging = diverging._replace(gaps=SimpleNamespace(after=replace(diverging.gaps.after, diverges=True)))
    assert not diverging.closes_more(known, material=0.03)


def test_effects_with_which_the_run_diverges_are_taken_out(monkeypatch):
    def measured(_, found, __):
        after = Gap({"theta": 1e5 if "b" in found else 3.0}, {"theta": 1.0}, np.full((1, 1), 9.0), "b" in found)
        return found, None, SimpleNamespace(after=after, before=replace(after, rms={"theta": 4.0}, diverges=False))

    monkeypatch.setattr(diagnosis, "_without", lambda found, name: found - {name})
    monkeypatch.setattr(diagnosis, "parts_of", lambda found, *_: [
        Part(name, "arm", 8.0, np.zeros(1)) for name in (*found, "")])
    monkeypatch.setattr(diagnosis, "fit_and_measure", measured)
    start = frozenset("ab")
    found = diagnosis._without_harmful(None, start, None, measured(None, start, None)[2], Settings(), None).found
    assert found == {"a"}


@pytest.mark.promise("Verdict", "Small imperfections beside an effect do not make it one with more parameters")
@pytest.mark.parametrize(("small", "rms", "name"), [
    ("ab", 0.2, "simple"), ("a", 0.2, "complex"), ("ab", 0.3, "complex")])
def test_of_effects_that_close_as_much_the_simplest_is_taken_if_there_are_small_ones_beside_it(
        monkeypatch, small, rms, name):
    def found(name, rms):
        stages = {"arm": SimpleNamespace(name=name)}
        return Measured(SimpleNamespace(chains=None, stages=stages), None, left_gaps(rms),
                        [Part(n, "arm", x, np.full(1, x)) for n, x in [(name, 1.0), *((n, 0.01) for n in small)]])

    monkeypatch.setattr(diagnosis, "replace", lambda found, stages: stages["arm"].name)
    monkeypatch.setattr(diagnosis, "with_simpler",
                        lambda chains, f, large: SimpleNamespace(name="simple") if f.name in large else f)
    monkeypatch.setattr(diagnosis, "measured", lambda fitted, name, *_: found(name, rms))
    taken = diagnosis._among_imperfections(None, found("complex", 0.19), Settings(), None)
    assert taken.found.stages["arm"].name == name


@pytest.mark.promise("Verdict", "A model whose free run runs away is refused in one line")
def test_a_model_that_runs_away_is_refused():
    absurd = replace(BENCH, model={**BENCH.model, "L_over_J": 3.0 * BENCH.model["L_over_J"], "c_over_J": 0.0})
    with pytest.raises(RecordingError, match="runs away"):
        diagnose(absurd, [recorded(3, {}, 70.0)])


@pytest.mark.promise("Verdict", "Small imperfections beside a known effect do not make it an unknown one")
@pytest.mark.parametrize(("rms", "approximates"), [(0.05, True), (0.09, True), (0.11, False), (0.19, False)])
def test_effects_approximate_an_unknown_one_only_if_one_term_leaves_half_as_much_above_the_floor(rms, approximates):
    floor = 0.1
    known, alone = left(math.hypot(0.2, floor), floor, [("thrust_lag", 0.06)]), left(math.hypot(rms, floor), floor)
    assert alone.shows_approximation(known, material=0.03) == approximates


def test_effects_all_over_the_chain_are_found_and_nothing_else():
    effects = {"speed_spikes": {}, "brush_drop": {}, "coulomb_friction": {}}
    body = diagnose(BENCH, [recorded(73, effects, duration=60.0)]).body
    assert set(body["which"]["effects"]) == set(effects)


def far_off(number, factor):
    """The document of a rig with one parameter off by a factor."""
    model = drawn_rig(80, {})
    model = Model("rig", {**model.model, number: factor * BENCH.model[number]}, model.sensing)
    duty = steps(20.0, 80)
    columns, _ = rig.record(model, duty, 80)
    found = diagnose(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    made = document(found, ["bag"], "bench", 0.0)
    assert made.which.verdict == "parameter_mismatch"
    return made


@pytest.mark.promise("Verdict", "A parameter that is far off is named as `parameter_mismatch`")
@pytest.mark.parametrize(("number", "factor"), [
    ("R_a", 1.4), ("mgd_over_J", 1.4), ("J_m", 1.4), ("R_a", 0.8), ("mgd_over_J", 0.845)])
def test_a_number_that_is_far_off_is_named(number, factor):
    candidates = far_off(number, factor).which.candidates
    found = next(c for c in candidates if c.effect == "parameter_mismatch").parameters
    assert list(found) == [number]
    assert found[number].value == pytest.approx(factor * BENCH.model[number], rel=0.06)


def test_two_numbers_of_which_the_product_counts_are_not_separable():
    made = far_off("L_over_J", 1.2)
    (pair,) = made.which.not_separable
    assert set(pair) == {"parameter_mismatch:L_over_J", "parameter_mismatch:k_thrust"}
    assert all(name in made.which.next_experiment.why for name in pair)
    assert any(line.startswith("  not separable") and pair[1] in line for line in verdict_lines(made))
    assert design_command(made) == ""  # no signal tells them apart


def test_what_the_catalogue_does_not_hold_is_unknown():
    """The angle reading jumps by 0.08 rad now and then: a slipping coupling."""
    duty = steps(28.0, 90)
    columns, _ = rig.record(drawn_rig(90, {}), duty, 90)
    jumps = np.cumsum(np.random.default_rng(1).choice([0.0, 0.08, -0.08], len(duty), p=[0.999, 0.0005, 0.0005]))
    columns["theta"] = columns["theta"] + jumps
    body = diagnose(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)]).body
    assert body["which"]["verdict"] == "unknown"
    assert body["which"]["effects"] == []  # no random torque moves the arm in jumps


@pytest.mark.promise("Verdict", "Channels that were not measured leave a verdict on the others")
@pytest.mark.parametrize("without", [("omega",), ("i_a", "v_a"), ("omega", "i_a", "v_a")])
def test_missing_channels_leave_a_verdict_on_the_arm(without):
    body = diagnose(BENCH, [recorded(95, {"coulomb_friction": {"accel": 1.5}}, off=0.005, without=without)]).body
    assert set(body["channels"]) == {"theta", "omega", "i_a", "v_a"} - set(without)
    assert "coulomb_friction" in body["which"]["effects"]


@pytest.mark.promise("Verdict", "Several recordings of one rig are fitted together")
def test_several_recordings_of_one_rig_are_fitted_together():
    effects = {"coulomb_friction": {}}
    model = drawn_rig(97, effects)
    signals = []
    for seed in (97, 98):
        duty = steps(25.0, seed)
        columns, _ = rig.record(model, duty, seed)
        signals.append(from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing))
    both = diagnose(BENCH, signals).body
    one = diagnose(BENCH, signals[:1]).body
    assert both["which"]["effects"] == ["coulomb_friction"]
    width = [candidate(b, "coulomb_friction")["parameters"]["accel"] for b in (both, one)]
    assert width[0]["high"] - width[0]["low"] < width[1]["high"] - width[1]["low"]


@cache
def with_friction():
    """The diagnosis of a rig with dry friction."""
    return diagnose(BENCH, [recorded(97, {"coulomb_friction": {}})])


@pytest.mark.parametrize("missing", [1000, 5000])
def test_a_test_recording_whose_angle_comes_late_is_judged_from_there_on(missing):
    found = with_friction()
    duty = steps(20.0, 99)
    columns, _ = rig.record(drawn_rig(97, {"coulomb_friction": {}}), duty, 99)
    columns["theta"] = columns["theta"].copy()
    columns["theta"][:missing] = np.nan
    signals = from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)
    assert validate(found.model, found.augmented, signals).closed > 0.8


@pytest.mark.promise("Verdict", "A person says how long the search may take, and is told if it was too short")
def test_a_search_ends_at_its_time_and_says_so():
    signals = recorded(71, {"coulomb_friction": {}, "brush_drop": {}}, duration=20.0)
    none, long = (diagnose(BENCH, [signals], seconds=s) for s in (0.0, 600.0))
    assert none.conclusions.which.effects == ()
    assert none.conclusions.which.verdict == "cannot_tell"
    assert "any effect of the motor and of the arm was tried" in none.conclusions.which.unexplained[0]
    assert any("--seconds" in note for s in none.signals for note in s.notes)
    assert set(long.conclusions.which.effects) == {"coulomb_friction", "brush_drop"}
    assert not any("--seconds" in note for s in long.signals for note in s.notes)


def test_the_verdict_does_not_depend_on_the_number_of_threads():
    signals = recorded(3, {"quadratic_drag": {}}, duration=20.0)
    assert diagnose(BENCH, [signals], 1).body == diagnose(BENCH, [signals], 2).body


def test_the_augmented_model_runs_the_rig():
    signals = recorded(4, {"thrust_lag": {}})
    result = diagnose(BENCH, [signals])
    columns, _ = rig.record(result.augmented, signals.duty, 1)
    assert np.sqrt(np.mean((columns["theta"] - signals.theta) ** 2)) < 2.0 * signals.sigma["theta"]


def test_a_motor_that_rests_all_along_is_no_reason_to_fail():
    t, rest = np.arange(3000) * SAMPLE_PERIOD, np.zeros(3000)
    noise = 2e-3 * np.random.default_rng(0).standard_normal(len(t))
    gravity, damping = (BENCH.model[k] for k in ("mgd_over_J", "c_over_J"))
    theta = 0.05 * np.exp(-0.5 * damping * t) * np.cos(np.sqrt(gravity - 0.25 * damping**2) * t) + noise
    signals = from_arrays({"theta": theta, **dict.fromkeys(("omega", "i_a", "v_a", "duty"), rest)}, SAMPLE_PERIOD,
                          BENCH.sensing)
    assert diagnose(BENCH, [signals]).body["which"]["verdict"] == "none"


@pytest.mark.promise("Verdict", "Gaps are measured in free runs on held-out data that no fit has used")
def test_what_is_held_out_moves_no_fit():
    duty = steps(30.0, 77)
    columns, _ = rig.record(drawn_rig(77, {"coulomb_friction": {}}), duty, 77)
    spoilt = {name: x.copy() for name, x in columns.items()}
    for x in spoilt.values():
        x[round(0.9 * len(duty)):] *= 2.0
    whole, other = (diagnose(BENCH, [from_arrays({**c, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)]).body
                    for c in (columns, spoilt))
    for one in (*whole["which"]["candidates"], *other["which"]["candidates"]):
        one.pop("gap_after")
        one.pop("share", None)  # measured on what is held out
    assert whole["which"]["effects"] == ["coulomb_friction"]
    assert other["which"] == whole["which"]
    assert other["shrink"]["gap_after"] > 2.0 * whole["shrink"]["gap_after"]


def test_a_channel_that_is_read_only_in_the_part_that_is_held_out_is_no_error():
    signals = recorded(3, duration=8.0)
    late = np.where(np.arange(len(signals)) < signals.train, np.nan, signals.i_a)
    found = diagnose(BENCH, [replace(signals, i_a=late)], 1, seconds=0.1)
    assert "i_a" not in found.body["channels"]
