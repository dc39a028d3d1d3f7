# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from readings import recording

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.signals.from_bag import as_signals, signals_of
from aeropend_ident.signals.outliers import joined_turns
from aeropend_ident.signals.pulses import find_pulses
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing import bags
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load


def columns(duration=6.0, **replaced):
    duty = steps(duration, 3)
    read, _ = rig.record(BENCH, duty, 3)
    return {**read, "duty": duty, **replaced}


def test_pulses_are_where_the_rotor_completed_a_turn():
    duty = steps(20.0, 1)
    read, truth = rig.record(BENCH, duty, 1)
    pulses = find_pulses(read["omega"], SAMPLE_PERIOD, BENCH.sensing)
    turns = np.floor(truth["rotor_angle"] / (2 * np.pi))
    completed = np.flatnonzero(np.diff(turns) > 0) + 1
    assert len(pulses.index) > 100
    assert np.isin(pulses.index, completed).all()
    assert not pulses.false.any()
    grid = np.arange(len(duty)) * SAMPLE_PERIOD
    mean = (np.interp(pulses.time, grid, truth["rotor_angle"])
            - np.interp(pulses.time - pulses.period, grid, truth["rotor_angle"])) / pulses.period
    assert np.sqrt(np.mean(((mean - pulses.omega) / pulses.sigma) ** 2)) < 1.5


def test_false_periods_are_told_from_true_ones():
    model = drawn_rig(5, {"speed_spikes": {"rate": 3.0}})
    duty = steps(40.0, 5)
    read, _ = rig.record(model, duty, 5)
    clean, _ = rig.record(model.with_effects({}), duty, 5)
    pulses = find_pulses(read["omega"], SAMPLE_PERIOD, BENCH.sensing)
    truly = np.abs(read["omega"] - clean["omega"])[pulses.index] > 0.0
    assert truly.sum() > 40
    assert (pulses.false & truly).sum() > 0.95 * truly.sum()
    assert (pulses.false & ~truly).sum() < 0.02 * len(truly)


@pytest.mark.parametrize("stop", [False, True])
def test_a_false_period_is_told_where_the_rotor_starts(stop):
    duty = np.repeat([0.3, 0.0, 0.35], [3000, 3500, 2000]) if stop else np.repeat([0.0, 0.3], [500, 3000])
    read, _ = rig.record(BENCH, duty, 4)
    true = find_pulses(read["omega"], SAMPLE_PERIOD, BENCH.sensing)
    assert not true.false.any()
    first = int(true.index[np.flatnonzero(true.index > (6500 if stop else 0))[0]])
    changes = np.flatnonzero(np.diff(read["omega"])) + 1
    second = int(changes[changes > first][0])
    assert read["omega"][first - 1] == 0.0
    read["omega"][first:second] *= 2.0
    found = find_pulses(read["omega"], SAMPLE_PERIOD, BENCH.sensing)
    assert found.index[found.false].tolist() == [first]


def test_steps_of_the_duty_between_slow_samples_leave_the_speed_unsure():
    read, truth = rig.record(BENCH, steps(40.0, 6), 6)
    slow = find_pulses(read["omega"][::2], 2.0 * SAMPLE_PERIOD, BENCH.sensing)
    fast = find_pulses(read["omega"], SAMPLE_PERIOD, BENCH.sensing)
    slope = np.abs(np.gradient(truth["omega"], SAMPLE_PERIOD))
    steep = slope[2 * slow.index] > 200.0
    assert steep.sum() > 20
    assert np.median(slow.sigma[steep] / (slope[2 * slow.index] * SAMPLE_PERIOD)[steep]) > 0.5
    assert np.median(fast.sigma[slope[fast.index] > 200.0]) < 0.5 * np.median(slow.sigma[steep])


def test_a_missing_sample_keeps_its_place():
    data = columns()
    for name in data:
        data[name][100:103] = np.nan
    signals = from_arrays(data, SAMPLE_PERIOD, BENCH.sensing)
    assert np.isnan(signals.theta[100:103]).all()
    np.testing.assert_array_equal(signals.duty[100:103], signals.duty[99])
    assert signals.train == round(0.7 * len(signals))


@pytest.mark.parametrize(("replaced", "word"), [
    ({"theta": np.full(2941, np.nan)}, "no arm angle"), ({"duty": np.full(2941, np.nan)}, "no duty")])
def test_what_cannot_be_compared_is_said(replaced, word):
    with pytest.raises(RecordingError, match=word) as raised:
        from_arrays(columns(**replaced), SAMPLE_PERIOD, BENCH.sensing, name="my_bag")
    assert str(raised.value).startswith("my_bag: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("how", ["missing", "at a stop", "stuck", "read a few times"])
def test_an_angle_that_is_not_read_on_held_out_data_is_said(how):
    data = columns(20.0)
    theta = data["theta"].copy()
    begin = round({"missing": 0.69, "at a stop": 0.69}.get(how, 0.7) * len(theta))
    theta[begin:] = {"at a stop": 1.0, "stuck": float(np.median(theta))}.get(how, np.nan)
    if how == "read a few times":
        theta[begin + 100:begin + 105] = data["theta"][begin + 100:begin + 105]
    with pytest.raises(RecordingError, match="not read in the part that is held out") as raised:
        from_arrays({**data, "theta": theta}, SAMPLE_PERIOD, BENCH.sensing, name="my_bag")
    assert "\n" not in str(raised.value)


def test_too_short_is_said():
    short = {name: x[:1000] for name, x in columns().items()}
    with pytest.raises(RecordingError, match=r"1000 samples in 2\.04 s"):
        from_arrays(short, SAMPLE_PERIOD, BENCH.sensing)


def test_nothing_happening_is_no_ground_for_a_verdict():
    still = columns()
    still["duty"] = np.zeros_like(still["duty"])
    still["theta"] = 0.006 * np.round(np.random.default_rng(0).standard_normal(len(still["theta"])) / 3.0)
    with pytest.raises(RecordingError, match="nothing happens"):
        from_arrays(still, SAMPLE_PERIOD, BENCH.sensing)


@pytest.mark.promise(
    "Recordings", "Lost samples, saturated or constant readings, and pauses are noted, and do not change the verdict")
def test_a_channel_that_never_changes_is_left_out_and_said():
    signals = from_arrays(columns(i_a=np.full(2941, 0.3)), SAMPLE_PERIOD, BENCH.sensing)
    assert not signals.has("i_a")
    assert any("i_a is 0.3 A all the time" in note for note in signals.notes)


@pytest.mark.parametrize("channel", ["omega", "i_a", "v_a"])
@pytest.mark.parametrize("part", ["fitted", "held out"])
def test_a_channel_that_is_stuck_in_one_part_is_left_out_there_and_said(channel, part):
    data = columns(20.0)
    train = round(0.7 * len(data["duty"]))
    data[channel] = data[channel].copy()
    data[channel][slice(train) if part == "fitted" else slice(train, None)] = 0.3
    signals = from_arrays(data, SAMPLE_PERIOD, BENCH.sensing)
    assert np.isnan(signals.channel(channel)[train:]).all()
    assert signals.has(channel) == (part == "held out")
    assert any(f"{channel} is 0.3" in note and f"in the part that is {part}" in note for note in signals.notes)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_channel_that_is_not_read_in_the_part_that_is_fitted_is_left_out_and_said(value):
    data = columns(20.0)
    data["i_a"] = data["i_a"].copy()
    data["i_a"][5:round(0.7 * len(data["duty"]))] = value
    signals = from_arrays(data, SAMPLE_PERIOD, BENCH.sensing)
    assert not signals.has("i_a")
    assert "i_a was not read in the part that is fitted: it is left out" in signals.notes


@pytest.mark.promise(
    "Recordings", "Lost samples, saturated or constant readings, and pauses are noted, and do not change the verdict")
@pytest.mark.parametrize(("channel", "limit"), [("theta", 0.3), ("i_a", 0.4), ("v_a", 1.0)])
def test_readings_at_the_end_of_a_range_are_left_out_and_said(channel, limit):
    data = columns(20.0)
    clipped = data[channel] >= limit
    assert clipped.mean() > 0.02
    signals = from_arrays({**data, channel: np.minimum(data[channel], limit)}, SAMPLE_PERIOD, BENCH.sensing)
    np.testing.assert_array_equal(np.isnan(signals.channel(channel)), clipped)
    assert [note for note in signals.notes if note.startswith(f"{channel} sits at {limit:g}")
            and f"{100.0 * clipped.mean():.1f} %" in note]
    for other in {"theta", "omega", "i_a", "v_a"} - {channel}:
        np.testing.assert_array_equal(signals.channel(other), data[other])


@pytest.mark.parametrize("channel", ["theta", "omega", "i_a", "v_a"])
def test_readings_that_jump_out_are_left_out_and_counted(channel):
    data = columns(20.0)
    hit = np.arange(500, len(data["duty"]), 700)
    data[channel] = data[channel].copy()
    data[channel][hit] += 3.0 * np.ptp(data[channel])
    signals = from_arrays(data, SAMPLE_PERIOD, BENCH.sensing)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(signals.channel(channel))), hit)
    assert f"{channel}: {len(hit)} single readings jump out and are left out" in signals.notes


def test_nothing_is_left_out_of_a_sound_recording():
    data = columns(20.0)
    signals = from_arrays(data, SAMPLE_PERIOD, BENCH.sensing)
    assert signals.notes == ()
    for channel in ("theta", "omega", "i_a", "v_a"):
        np.testing.assert_array_equal(signals.channel(channel), data[channel])


def test_an_angle_that_stays_is_no_ground_for_a_verdict():
    with pytest.raises(RecordingError, match="stuck"):
        from_arrays(columns(theta=np.full(2941, 0.3)), SAMPLE_PERIOD, BENCH.sensing)


def test_lost_samples_do_not_make_true_periods_false():
    duty = steps(30.0, 2)
    read, _ = rig.record(BENCH, duty, 2)
    read["omega"][np.random.default_rng(0).random(len(duty)) < 0.03] = np.nan
    assert not find_pulses(read["omega"], SAMPLE_PERIOD, BENCH.sensing).false.any()


def test_lost_samples_do_not_count():
    data = columns()
    for c in ("theta", "omega", "i_a", "v_a"):
        data[c] = np.where(np.arange(len(data["duty"])) % 100 == 50, np.nan, data[c])
    signals = from_arrays(data, SAMPLE_PERIOD, BENCH.sensing)
    assert signals.samples == len(signals) - len(range(50, len(signals), 100))


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("feedback", [False, True])
def test_noise_is_right_within_a_tenth_in_open_and_closed_loop(factor, feedback):
    duty, rng = steps(40.0, 3), np.random.default_rng(1)
    if feedback:  # a controller takes the noise of the angle into the duty at every sample
        duty = np.clip(duty + 0.01 * rng.standard_normal(len(duty)), 0.0, 1.0)
    noisy = BENCH.sensing | {name: factor * BENCH.sensing[name] for name in ("angle_noise", "current_noise",
                                                                            "voltage_noise")}
    read, truth = rig.record(Model("noisy", BENCH.model, noisy, {}), duty, 3)
    signals = from_arrays({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)
    for channel in ("i_a", "v_a"):
        true = np.std(read[channel] - truth[channel])
        assert signals.sigma[channel] == pytest.approx(true, rel=0.1), channel
    quantised = BENCH.sensing["angle_lsb"] / np.sqrt(12.0)
    assert signals.sigma["theta"] == pytest.approx(max(np.hypot(noisy["angle_noise"], quantised), quantised), rel=0.1)


def test_too_few_readings_have_the_noise_that_the_model_states():
    data = columns()
    data["i_a"] = np.where(np.arange(len(data["i_a"])) % 200 == 0, data["i_a"], np.nan)
    stated = np.hypot(BENCH.sensing["current_noise"], BENCH.sensing["current_lsb"] / np.sqrt(12.0))
    assert from_arrays(data, SAMPLE_PERIOD, BENCH.sensing).sigma["i_a"] == stated


@pytest.mark.promise(
    "Recordings", "Lost samples, saturated or constant readings, and pauses are noted, and do not change the verdict")
@pytest.mark.parametrize("lost", [1, 2, 7])
def test_a_step_of_the_duty_into_lost_samples_lies_in_their_middle_and_is_said(lost):
    data = columns()
    step = int(np.flatnonzero(np.abs(np.diff(data["duty"])) > 0.05)[2]) + 1
    first = step - lost // 2
    for name in data:
        data[name] = data[name].copy()
        data[name][first:first + lost] = np.nan
    signals = from_arrays(data, SAMPLE_PERIOD, BENCH.sensing)
    before, after = data["duty"][first - 1], data["duty"][first + lost]
    mean = np.mean(signals.duty[first:first + lost])  # the step may lie anywhere from the first lost sample on
    assert mean == pytest.approx(before + (after - before) * (lost / 2) / lost, abs=0.5 * abs(after - before) / lost)
    assert np.isnan(signals.i_a[first + lost:first + lost + 5]).all()
    assert any("1 step of the duty fell between samples" in note for note in signals.notes)


def test_a_current_of_which_unknown_steps_leave_hardly_anything_is_left_out_and_said():
    rng = np.random.default_rng(4)
    data = columns()
    data["duty"] = np.repeat(rng.uniform(0.2, 0.8, len(data["duty"])), 25)[:len(data["duty"])]
    lost = np.zeros(len(data["duty"]), dtype=bool)
    lost[24::25] = True  # the last sample before each step
    for name in data:
        data[name] = np.where(lost, np.nan, data[name])
    signals = from_arrays(data, SAMPLE_PERIOD, BENCH.sensing)
    assert not signals.has("i_a")
    assert any("hardly any reading of the current is left" in note for note in signals.notes)


@pytest.mark.parametrize("ends", [(-math.pi, math.pi), (0.0, 2.0 * math.pi)])
def test_turns_of_an_angle_that_is_read_within_one_are_joined(ends):
    t = np.arange(0.0, 10.0, 0.01)
    angle = 0.02 + 8.0 * np.sin(0.7 * t) + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    read = ends[0] + (angle - ends[0]) % (2.0 * math.pi)
    read[[50, 51, 400]] = np.nan
    joined, jumps = joined_turns(read)
    assert jumps > 3
    assert joined[np.isfinite(read)] == pytest.approx(angle[np.isfinite(read)])
    assert joined_turns(read[:300])[0] == pytest.approx(joined[:300], nan_ok=True)


@pytest.mark.parametrize("angle", [np.linspace(0.0, 40.0, 500), np.where(np.arange(500) % 90 == 60, 5.0, 0.1)])
def test_an_angle_over_several_turns_and_one_with_false_readings_stay_as_they_are(angle):
    same, jumps = joined_turns(angle)
    assert (same is angle, jumps) == (True, 0)


def test_joined_turns_are_said(tmp_path):
    columns_ = columns(8.0)
    columns_["theta"] = np.mod(columns_["theta"] + 0.01 * np.sin(np.arange(len(columns_["theta"]))), 2.0 * math.pi)
    bags.write(tmp_path / "bag", columns_, round(SAMPLE_PERIOD * 1e9))
    signals = signals_of(tmp_path / "bag", None, BENCH)
    (note,) = (n for n in signals.notes if "turn" in n)
    assert note.startswith("theta jumps by a turn ")
    assert np.nanmin(signals.theta) < -0.005
    assert np.nanmax(signals.theta) < 3.0


def test_a_speed_without_a_pulse_in_the_part_that_is_fitted_is_left_out():
    read = columns()
    late = np.arange(len(read["duty"])) > 0.8 * len(read["duty"])
    false = 50.0 + 1e3 * (np.arange(len(late)) % 9 == 0)
    signals = from_arrays({**read, "omega": np.where(late, read["omega"] + 50.0, false)}, SAMPLE_PERIOD, BENCH.sensing)
    assert not signals.has("omega")
    assert signals.pulses is None
    assert "omega was not read in the part that is fitted: it is left out" in signals.notes


def test_a_voltage_that_is_read_only_before_a_late_command_could_act_is_left_out():
    read = columns()
    v_a = np.where(np.arange(len(read["duty"])) < 200, read["v_a"], np.nan)
    signals = from_arrays({**read, "v_a": v_a}, SAMPLE_PERIOD, BENCH.sensing)
    assert not signals.has("v_a")
    assert "v_a was not read in the part that is fitted: it is left out" in signals.notes


def test_a_speed_that_is_false_in_the_part_that_is_held_out_is_left_out_there():
    read = columns()
    k = np.arange(len(read["duty"]))
    false = np.where(k >= 0.7 * len(k), np.where(k % 2 == 0, 900.0, 30.0), read["omega"])
    signals = from_arrays({**read, "omega": false}, SAMPLE_PERIOD, BENCH.sensing)
    assert np.isfinite(signals.omega[:signals.train]).sum() > 1000
    assert not np.isfinite(signals.omega[signals.train:]).any()
    assert signals.pulses.index.max() < signals.train
    assert "omega is false in the part that is held out: it is left out there" in signals.notes


@pytest.mark.parametrize("fit_nominal", [False, True])
def test_a_recording_that_is_too_slow_to_show_a_swing_is_refused(tmp_path, fit_nominal):
    bags.write(tmp_path / "bag", columns(), 1_000_000_000)
    with pytest.raises(RecordingError, match="its samples are 1 s apart, which shows no swing"):
        signals_of(tmp_path / "bag", None, BENCH, fit_nominal=fit_nominal)


@pytest.mark.parametrize("fit_nominal", [False, True])
def test_stamps_of_two_scales_are_refused_before_they_fill_the_memory(fit_nominal):
    made = columns(10.0)
    t = np.where(np.arange(len(made["duty"])) < 3000, 1e-9, SAMPLE_PERIOD).cumsum()
    with pytest.raises(RecordingError, match="they keep no sample period"):
        as_signals(recording(t, **made), BENCH, fit_nominal=fit_nominal)


@pytest.mark.filterwarnings("error")
def test_a_single_reading_of_the_angle_is_refused_in_one_line():
    made = columns()
    made["theta"] = np.where(np.arange(len(made["duty"])) == 9, made["theta"], np.nan)
    t = np.arange(len(made["duty"])) * SAMPLE_PERIOD
    for fit_nominal in (False, True):
        with pytest.raises(RecordingError, match="the arm angle was not read in the part that is fitted"):
            as_signals(recording(t, **made), BENCH, fit_nominal=fit_nominal)


def test_pieces_between_pauses_may_be_too_short_for_a_verdict(tmp_path):
    made = {name: x[:60] for name, x in columns().items()}
    steps_ns = np.where(np.arange(60) % 3 == 0, 11_000_000_000, 2_040_000)
    read_ = recording(np.cumsum(steps_ns) * 1e-9, **made)
    with pytest.raises(RecordingError, match="3 samples without a pause are too few for a verdict: record 5 s"):
        as_signals(read_, BENCH, fit_nominal=True)


def test_a_reading_has_noise_where_the_model_states_none_and_readings_are_few():
    duty = steps(8.0, 3)
    columns = {**rig.record(drawn_rig(3, {}), duty, 3)[0], "duty": duty}
    columns["v_a"] = np.where(np.arange(len(duty)) % 40 == 0, columns["v_a"], np.nan)
    assert from_arrays(columns, SAMPLE_PERIOD, load("thesis").sensing).sigma["v_a"] > 0.0
