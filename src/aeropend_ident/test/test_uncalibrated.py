# SPDX-License-Identifier: Apache-2.0
"""Uncalibrated rigs: noise, grid and nominal model come from the recordings, and effects are found on top."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from readings import recording

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.commands.diagnose import main
from aeropend_ident.diagnosis import joint_fit, policy
from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.counted_chains import CountedChains
from aeropend_ident.diagnosis.chain.nominal_fit import fit_nominal_model
from aeropend_ident.diagnosis.conclude import next_experiment
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.experiment_design import experiments_within
from aeropend_ident.diagnosis.search.findings import RankedHypothesis
from aeropend_ident.diagnosis.search.hypotheses import hypotheses
from aeropend_ident.diagnosis.validation import validate
from aeropend_ident.estimation.map_fit import estimate
from aeropend_ident.signals.free_decay import _middle, free_swings
from aeropend_ident.signals.from_bag import as_signals, from_uncalibrated
from aeropend_ident.signals.grid import irregular_grid
from aeropend_ident.signals.noise import reading_noise_at, resolution, white_noise_at
from aeropend_ident.signals.signals import Signals
from aeropend_ident.signals.statistics import effective_sample_size
from aeropend_ident.testing import bags
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import dynamics, rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from aeropend_sim.model.state import State

DEGREE = math.radians(1.0)


def let_go(seconds, effects=None, gravity=40.0, damping=0.4, first=1.0, rate=20.0, lsb=DEGREE, seed=0, held=0.5,
           zero=0.0):
    """Readings of an arm that is held, let go and left alone: t, theta."""
    model = Model("arm", {**BENCH.model, "mgd_over_J": gravity, "c_over_J": damping}, BENCH.sensing, effects or {})
    every = 5
    n = round((seconds - held) * rate) * every + 1
    swung = dynamics.swing(model, np.zeros(n), State(theta=first), 1.0 / rate / every)[0]
    theta = np.concatenate([np.full(round(held * rate), first), swung[::every]]) + zero
    theta = theta + 0.2 * lsb * np.random.default_rng(seed).standard_normal(len(theta))
    return np.arange(len(theta)) / rate, np.round(theta / lsb) * lsb if lsb else theta


def verdict(*signals: Signals):
    return diagnose(BENCH, list(signals), fit_nominal=True).body


def candidate(body, effect):
    return next(c for c in body["which"]["candidates"] if c["effect"] == effect)


@pytest.mark.promise("Uncalibrated rigs", "Resolution and noise are estimated from the recording")
def test_resolution_is_the_step_between_values():
    x = np.random.default_rng(0).standard_normal(500)
    assert resolution(np.round(x / 0.0175) * 0.0175) == pytest.approx(0.0175, rel=1e-6)
    assert resolution(x) == 0.0
    assert resolution(np.round(np.round(x / 0.05678) * 0.05678, 5)) == pytest.approx(0.05678, rel=1e-3)


@pytest.mark.promise("Uncalibrated rigs", "Resolution and noise are estimated from the recording")
@pytest.mark.parametrize("rate", [20.0, 490.0])
def test_noise_is_told_from_motion(rate):
    t = np.arange(0.0, 20.0, 1.0 / rate)
    x = np.sin(6.0 * t) + 0.003 * np.random.default_rng(1).standard_normal(len(t))
    assert white_noise_at(t, x) == pytest.approx(0.003, rel=0.25)
    assert reading_noise_at(t, np.round(x / 0.1) * 0.1) == pytest.approx(0.1 / math.sqrt(12.0), rel=0.3)


def test_the_grid_takes_steady_stamps_as_they_are_and_makes_a_finer_one_for_others():
    steady = np.rint(np.arange(400) * 2.0408e6).astype(np.int64)
    index, period = irregular_grid(steady)
    assert period == pytest.approx(2.0408e-3, rel=1e-5)
    assert np.array_equal(index, np.arange(400))
    bursts = np.cumsum(np.tile([5, 5, 5, 5, 5, 5, 5, 128], 30)) * 1_000_000
    index, period = irregular_grid(bursts)
    assert np.abs(index * period - (bursts - bursts[0]) * 1e-9).max() < 0.6e-3
    _, period = irregular_grid(np.arange(200) * 50_000_000, longest=5e-3)
    assert 0.05 / period == pytest.approx(round(0.05 / period))
    assert period <= 5e-3


def test_a_push_begins_a_new_swinging():
    _, a = let_go(6.0, first=1.0, lsb=0.0)
    _, b = let_go(8.0, first=0.8, lsb=0.0)
    swings = free_swings(np.concatenate([a, b]), 1e-3)
    assert len([s for s in swings if s.count >= 4]) == 2
    assert max(swings, key=lambda s: s.stop).size == pytest.approx(1.6, abs=0.2)


@pytest.mark.parametrize("turns", [2, 3, 4, 5, 8])
def test_the_angle_about_which_an_arm_swings_is_that_of_few_swings_too(turns):
    t = np.arange(0.0, 0.5 + turns / 2, 0.01)
    x = 0.3 + np.exp(-0.1 * t) * np.cos(2.0 * np.pi * t)
    assert _middle(x, 1e-3) == pytest.approx(0.3, abs=0.02 if turns > 2 else 0.2)


@pytest.mark.promise("Uncalibrated rigs", "A free decay gives gravity, damping, hanging angle and the kind of friction")
def test_a_viscous_swing_lacks_nothing_and_tells_its_numbers():
    body = verdict(from_uncalibrated(recording(*let_go(9.0, zero=0.1)), BENCH.sensing))
    assert (body["which"]["verdict"], body["which"]["effects"]) == ("none", [])
    numbers = body["which"]["numbers"]
    for name, true in (("mgd_over_J", 40.0), ("c_over_J", 0.4)):
        assert numbers[name]["determined"]
        assert numbers[name]["low"] - 0.01 * true < true < numbers[name]["high"] + 0.01 * true
    assert {"R_a", "K_e", "k_thrust", "L_over_J"} <= set(body["identified"]["not_determined"])
    assert body["identified"]["hangs_at"]["value"] == pytest.approx(0.1, abs=0.01)
    json.dumps(body, allow_nan=False)


@pytest.mark.promise("Uncalibrated rigs", "A free decay gives gravity, damping, hanging angle and the kind of friction")
@pytest.mark.parametrize(("effect", "parameters"), [("coulomb_friction", {"accel": 1.0}),
                                                    ("quadratic_drag", {"k": 0.15})])
@pytest.mark.parametrize("seed", [1, 2])
def test_what_brakes_a_swing_is_named_at_20_hz_and_one_degree(effect, parameters, seed):
    t, theta = let_go(6.0, {effect: parameters}, damping=0.05, seed=seed)
    body = verdict(from_uncalibrated(recording(t, theta), BENCH.sensing))
    assert body["which"]["verdict"] == effect
    (name, true), = parameters.items()
    found = candidate(body, effect)["parameters"][name]
    assert found["low"] < true < found["high"]
    assert body["shrink"]["closed"] > 0.8


def test_a_pooled_interval_holds_how_recordings_differ():
    alike, scattered = ([joint_fit.Estimate(x, sd) for x in values]
                        for values, sd in (((1.0, 1.001, 0.999), 0.3), ((1.0, 2.0, 3.0), 0.01)))
    assert joint_fit.run_to_run(alike) == 0.0
    assert joint_fit.pooled_sd(alike) == pytest.approx(0.3 / math.sqrt(3.0))
    assert joint_fit.run_to_run(scattered) == pytest.approx(1.0, rel=0.01)
    assert joint_fit.pooled_sd(scattered) == pytest.approx(1.0 / math.sqrt(3.0), rel=0.01)


@pytest.mark.promise("Uncalibrated rigs", "The interval of several recordings holds their run-to-run spread")
def test_friction_that_varies_from_decay_to_decay_has_the_interval_of_its_mean():
    true = (0.44, 0.33, 0.26, 0.49)
    swings = [from_uncalibrated(recording(*let_go(20.0, {"coulomb_friction": {"accel": friction}}, damping=0.15, seed=k,
                                                  rate=50.0, lsb=0.2 * DEGREE)), BENCH.sensing)
              for k, friction in enumerate(true)]
    body = diagnose(BENCH, swings, fit_nominal=True).body
    assert body["which"]["effects"] == ["coulomb_friction"]
    accel = candidate(body, "coulomb_friction")["parameters"]["accel"]
    assert accel["low"] < np.mean(true) < accel["high"]
    assert accel["high"] - accel["low"] > 2.0 * 1.96 * 0.7 * np.std(true, ddof=1) / math.sqrt(len(true))


@pytest.mark.promise("Uncalibrated rigs", "Irregular stamps and a clock that wanders are no effect")
def test_stamps_in_bursts_do():
    t, theta = let_go(8.0, {"coulomb_friction": {"accel": 1.0}}, rate=200.0, lsb=1e-3)
    kept = np.arange(len(t)) % 34 < 8
    shifted = t[kept] + 0.0023 * (np.arange(len(t)) // 34 % 2)[kept]
    body = verdict(from_uncalibrated(recording(shifted, theta[kept]), BENCH.sensing))
    assert body["which"]["verdict"] == "coulomb_friction"


@pytest.mark.promise("Uncalibrated rigs", "Irregular stamps and a clock that wanders are no effect")
@pytest.mark.parametrize("wander", [0.012, 0.02])
def test_a_clock_that_wanders_is_no_effect(wander):
    t, theta = let_go(14.0, {"coulomb_friction": {"accel": 0.9}}, gravity=56.0, damping=0.13, first=1.3, rate=50.0,
                      lsb=1e-3)
    late = np.interp(t + wander * np.sin(2.0 * math.pi * t / 9.0), t, theta)
    assert verdict(from_uncalibrated(recording(t, late), BENCH.sensing))["which"]["effects"] == ["coulomb_friction"]


def test_the_gap_on_another_recording_is_that_of_the_identified_model():
    first, other = (from_uncalibrated(recording(*let_go(8.0, first=a, seed=k)), BENCH.sensing)
                    for k, a in enumerate((1.0, 0.7)))
    found = diagnose(BENCH, [first], fit_nominal=True)
    identified, guessed = (validate(m, found.augmented, other) for m in (found.model, BENCH))
    assert identified.gap < 1.5 * identified.floor
    assert guessed.gap > 5.0 * identified.gap


def test_a_narrow_band_is_worth_few_samples():
    rng = np.random.default_rng(0)
    white = rng.standard_normal(4000)
    assert effective_sample_size(white, power=2) == pytest.approx(4000, rel=0.15)
    ring = np.zeros(4000)
    for k in range(2, 4000):  # poles at 0.98: correlation 0.98^n cos(0.3 n), the sum of whose squares is 25
        ring[k] = 2.0 * 0.98 * math.cos(0.3) * ring[k - 1] - 0.98**2 * ring[k - 2] + white[k]
    assert effective_sample_size(ring, power=2) == pytest.approx(4000 / 25, rel=0.4)


@pytest.mark.promise(
    "Uncalibrated rigs", "Gravity, damping, zero and lever are each recording's own, with their run-to-run spread")
def test_runs_that_differ_are_no_effect_and_their_spread_is_told():
    runs = [let_go(8.0, gravity=g, damping=c, first=a, seed=k)
            for k, (g, c, a) in enumerate([(40.0, 0.4, 1.0), (42.0, 0.5, 0.8), (39.0, 0.45, 1.2)])]
    body = verdict(*(from_uncalibrated(recording(*run), BENCH.sensing) for run in runs))
    assert body["which"]["effects"] == []
    gravity = body["which"]["numbers"]["mgd_over_J"]
    assert [r["value"] for r in gravity["runs"]] == pytest.approx([40.0, 42.0, 39.0], rel=0.01)
    assert gravity["run_to_run"] == pytest.approx(1.53, rel=0.1)


@pytest.mark.promise(
    "Uncalibrated rigs", "Gravity, damping, zero and lever are each recording's own, with their run-to-run spread")
def test_where_it_hangs_is_each_runs_own():
    runs = [let_go(8.0, first=1.0, zero=zero, seed=k) for k, zero in enumerate((0.0, 0.1, -0.05))]
    body = verdict(*(from_uncalibrated(recording(*run), BENCH.sensing) for run in runs))
    assert body["which"]["effects"] == []
    hangs = body["identified"]["hangs_at"]
    assert [r["value"] for r in hangs["runs"]] == pytest.approx([0.0, 0.1, -0.05], abs=0.005)
    assert hangs["run_to_run"] == pytest.approx(0.076, rel=0.1)


@pytest.mark.promise("Uncalibrated rigs", "An angle that thrust holds is refused without its command")
def test_an_arm_that_thrust_holds_cannot_be_diagnosed_without_the_command():
    parts = [let_go(4.0, first=a, held=0.2, damping=1.5)[1] for a in (0.6, 0.7, 0.5)]
    theta = np.concatenate(parts) + math.radians(100.0)
    with pytest.raises(RecordingError, match=r"pushed \d times and comes to rest at 100 degrees.*without the command"):
        from_uncalibrated(recording(np.arange(len(theta)) / 20.0, theta), BENCH.sensing)
    with pytest.raises(RecordingError, match="does not swing down freely"):
        from_uncalibrated(recording(np.arange(400) / 20.0, np.repeat([0.0, 0.4, 0.2, 0.5], 100)), BENCH.sensing)


def unknown(seed, effects=None, duration=30.0, factor=0.5, lever=1.0, **kept):
    """A recording of a rig with numbers off by a factor; of its channels those kept are there."""
    rng = np.random.default_rng(seed)
    model = drawn_rig(seed, effects or {}, 0.0)
    numbers = {k: v * math.exp(factor * rng.uniform(-1.0, 1.0)) for k, v in model.model.items()}
    model = replace(model, model={**numbers, "k1": model.model["k1"], "L_over_J": model.model["L_over_J"] *
                                  lever * numbers["mgd_over_J"] / model.model["mgd_over_J"]})
    duty = steps(duration, seed, 0.45)
    columns, _ = rig.record(model, duty, seed)
    t = np.arange(len(duty)) * SAMPLE_PERIOD
    return model, recording(t, columns["theta"], duty, **{c: columns[c] for c in kept})


@pytest.mark.promise(
    "Uncalibrated rigs", "Gravity, damping, zero and lever are each recording's own, with their run-to-run spread")
def test_the_lever_is_each_runs_own():
    read = [unknown(4, duration=10.0, lever=lever)[1] for lever in (1.0, 1.2, 0.9)]
    assert verdict(*(from_uncalibrated(r, BENCH.sensing) for r in read))["which"]["verdict"] == "none"


@pytest.mark.promise("Uncalibrated rigs", "Angle and command show an effect beside the identified nominal model")
def test_angle_and_command_alone_name_an_effect_in_an_uncalibrated_rig():
    model, read = unknown(3, {"coulomb_friction": {"accel": 0.8}})
    body = verdict(from_uncalibrated(read, BENCH.sensing))
    assert body["which"]["verdict"] == "coulomb_friction"
    accel = candidate(body, "coulomb_friction")["parameters"]["accel"]
    assert accel["value"] == pytest.approx(0.8, rel=0.15)
    for name in ("mgd_over_J", "c_over_J"):
        assert body["which"]["numbers"][name]["value"] == pytest.approx(model.model[name], rel=0.05)
    assert not body["which"]["numbers"]["R_a"]["determined"]


@pytest.mark.parametrize(("effect", "parameter", "size"), [
    ("thrust_exponent", "n", 1.3), ("thrust_lag", "tau", 0.25), ("command_delay", "delay", 0.12)])
def test_an_effect_of_the_drive_is_identified_together_with_the_numbers(effect, parameter, size):
    model, read = unknown(4, {effect: {parameter: size}}, duration=25.0)
    signals = from_uncalibrated(read, BENCH.sensing)
    found, _ = fit_nominal_model(BENCH, [signals])
    assert found.effect(effect, parameter) == pytest.approx(size, rel=0.25)
    assert found.model["mgd_over_J"] == pytest.approx(model.model["mgd_over_J"], rel=0.05)


def test_chance_is_not_taken_for_what_it_looks_like():
    _, read = unknown(8, {"gust": {"sigma": 0.05, "tau": 0.3}}, duration=60.0)
    assert verdict(from_uncalibrated(read, BENCH.sensing))["which"]["effects"] == ["gust"]


def test_what_a_misled_model_leaves_is_not_taken_for_chance():
    """An arm that turns over and over: the search for its numbers ends elsewhere, and no effect is to blame."""
    _, read = unknown(7, duration=18.0)
    assert np.ptp(read.theta) > 8.0 * math.pi
    assert verdict(from_uncalibrated(read, BENCH.sensing))["which"]["effects"] == []


def test_chains_that_keep_their_last_runs_give_what_new_ones_give_and_count():
    _, read = unknown(5, duration=6.0)
    signals = from_uncalibrated(read, BENCH.sensing)
    chains = CountedChains(BENCH, [signals])
    flex = {"mast_flex.coupling": 0.3, "mast_flex.omega": 90.0, "mast_flex.zeta": 0.05}
    tried = [{}, {"mgd_over_J": 50.0}, {"J_m": 5e-5}, {}, {"mgd_over_J": 50.0, "J_m": 5e-5}, {"initial.omega": 40.0},
             flex, {"command_delay.delay": 0.03}, {"brush_drop.v_brush": 0.2}, {"sensing.angle_filter_tau": 0.01},
             {"mgd_over_J": 1e4}, {}]
    for values in tried:
        expected = CutChains(BENCH, [signals], policy.UNCALIBRATED).residuals("arm")(values)["theta"]
        np.testing.assert_array_equal(chains.residuals("arm")(values)["theta"], expected)
    assert chains.runs == len(tried)


@pytest.mark.promise("Uncalibrated rigs", "A search that was cut short says so")
def test_a_search_that_is_cut_short_says_so(monkeypatch):
    _, read = unknown(3, {"coulomb_friction": {"accel": 0.8}}, duration=8.0)
    signals = from_uncalibrated(read, BENCH.sensing)
    monkeypatch.setattr(policy, "UNCALIBRATED", replace(policy.UNCALIBRATED, budget=1))
    result = diagnose(BENCH, [signals], fit_nominal=True)
    assert any("cut short" in note for note in result.signals[0].notes)
    json.dumps(result.body, allow_nan=False)


@pytest.mark.promise("Uncalibrated rigs", "A lag or curve that the nominal model can absorb is not claimed")
@pytest.mark.parametrize(("effect", "size"), [("thrust_lag", {"tau": 0.01}), ("thrust_exponent", {"n": 1.97}),
                                              ("command_delay", {"delay": 0.004})])
def test_what_the_nominal_model_can_take_is_not_claimed(effect, size):
    _, read = unknown(4, {effect: size}, duration=20.0)
    assert verdict(from_uncalibrated(read, BENCH.sensing))["which"]["effects"] == []


@pytest.mark.promise("Uncalibrated rigs", "The advised experiment does not exceed the duty that the rig has had")
def test_the_experiment_advised_asks_for_no_more_duty_than_there_was():
    _, read = unknown(6)
    signals, most = from_uncalibrated(read, BENCH.sensing), float(np.max(read.duty))
    rivals = [RankedHypothesis(h, estimate({h.own[0].name: size}, {}), 0.0, 0.5) for h in hypotheses(BENCH)
              for effect, size in (("coulomb_friction", 0.8), ("quadratic_drag", 0.6)) if h.effect == effect]
    advised = next_experiment(BENCH, signals, [(rivals[0], rivals[1])], {}, experiments_within(most))
    assert 0.0 < Excitation(**advised.excite).series().max() <= most


@pytest.mark.parametrize("top", [0.003, 0.264, 1.0])
def test_an_experiment_drives_an_unknown_rig_no_harder_than_it_was_driven(top):
    for experiment in experiments_within(top):
        assert 0.0 < experiment.series().max() <= max(top, 0.02)


@pytest.mark.promise(
    "Uncalibrated rigs", "All channels give every parameter that they determine; the others are marked")
def test_all_channels_give_the_numbers_of_an_uncalibrated_rig():
    model, read = unknown(4, omega=True, i_a=True, v_a=True)
    body = verdict(from_uncalibrated(read, BENCH.sensing))
    assert body["which"]["effects"] == []
    for name in ("R_a", "L_a", "K_e", "mgd_over_J", "c_over_J"):
        row = body["which"]["numbers"][name]
        assert row["determined"]
        assert row["value"] == pytest.approx(model.model[name], rel=0.03)
    assert not body["which"]["numbers"]["K_t"]["determined"]  # only K_t over J_m shows


@pytest.mark.promise("Uncalibrated rigs", "All channels show the effects of the catalogue")
@pytest.mark.parametrize("effect", ["brush_drop", "coulomb_friction"])
def test_all_channels_show_effects_on_top(effect):
    _, read = unknown(4, {effect: {}}, duration=20.0, omega=True, i_a=True, v_a=True)
    assert verdict(from_uncalibrated(read, BENCH.sensing))["which"]["effects"] == [effect]


def bag(path, t, theta):
    """A bag of an angle alone."""
    nothing = np.full(len(theta), np.nan)
    bags.write(path, {"theta": theta, "omega": nothing, "i_a": nothing, "v_a": nothing, "duty": nothing},
               round((t[1] - t[0]) * 1e9))
    return str(path)


def test_the_command_takes_bags_without_a_command(tmp_path, capsys):
    swing = bag(tmp_path / "swing", *let_go(8.0, {"coulomb_friction": {"accel": 1.0}}))
    assert main([swing, "--fit-nominal", "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "verdict: coulomb_friction (arm)" in said
    assert "not determined: k0" in said
    assert load(tmp_path / "out" / "augmented.yaml").effects["coulomb_friction"]["accel"] == pytest.approx(1.0, rel=0.2)
    assert "coulomb_friction" in (tmp_path / "out" / "report.html").read_text()


def test_the_command_says_in_one_line_why_it_cannot_tell(tmp_path, capsys):
    swing = let_go(4.0, damping=1.5, held=0.2)[1]
    theta = np.tile(swing, 3) + math.radians(100.0)
    held = bag(tmp_path / "held", np.arange(len(theta)) / 20.0, theta)
    assert main([held, "--fit-nominal", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "no verdict is possible without the command" in error
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def with_voltage():
    duty = steps(30.0, 4)
    columns, _ = rig.record(drawn_rig(4, {}), duty, 4)
    return np.arange(len(duty)) * SAMPLE_PERIOD, columns["theta"], columns["v_a"]


@pytest.mark.promise("Uncalibrated rigs", "Where no command was recorded, a measured voltage takes its place")
def test_a_measured_voltage_stands_for_the_command(with_voltage):
    t, theta, v_a = with_voltage
    s = as_signals(recording(t, theta, v_a=v_a), BENCH, fit_nominal=True)
    assert s.driven
    assert np.corrcoef(s.duty, v_a[:len(s)])[0, 1] > 0.999
    assert not s.has("v_a")
    assert any("the voltage over its largest value" in note for note in s.notes)


def test_a_voltage_in_both_directions_keeps_its_sign(with_voltage):
    t, theta, v_a = with_voltage
    s = as_signals(recording(t, theta, v_a=v_a - 1.0), BENCH, fit_nominal=True)
    largest = float(np.abs(v_a - 1.0).max())
    np.testing.assert_allclose(s.duty, (v_a[:len(s)] - 1.0) / largest, atol=1e-12)
