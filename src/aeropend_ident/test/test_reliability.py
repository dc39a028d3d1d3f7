# SPDX-License-Identifier: Apache-2.0
"""Recordings as they come from a bench: with holes, stuck and clipped channels, cropped, out of order.

The verdict is the same within its intervals, or one line says why there is none; never a confident wrong answer.
"""

import json
import math
from functools import cache

import numpy as np
import pytest

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.commands import diagnose as command
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD

EFFECTS = {"none": {}, "coulomb_friction": {"coulomb_friction": {}}, "brush_drop": {"brush_drop": {}},
           "supply_sag": {"supply_sag": {}}}
SEED = 31


@cache
def _recorded(effect):
    duty = steps(16.0, SEED)
    columns, _ = rig.record(drawn_rig(SEED, EFFECTS[effect]), duty, SEED)
    return {**columns, "duty": duty}


def recorded(effect, **replaced):
    return {name: x.copy() for name, x in _recorded(effect).items()} | replaced


def without(channels):
    return {name: np.full(len(_recorded("none")["duty"]), np.nan) for name in channels}


def verdict(columns, period=SAMPLE_PERIOD, notes=None):
    signals = from_arrays(columns, period, BENCH.sensing, name="my_bag")
    if notes is not None:
        notes += signals.notes
    return diagnose(BENCH, [signals]).body["which"]


@cache
def _untouched(effect):
    return verdict(recorded(effect))


def interval(which, effect):
    found = next(c for c in which["candidates"] if c["effect"] == effect)
    return found["parameters"][CATALOGUE[effect].size]


def assert_same(which, effect):
    """The effect and no other, with an interval that meets that of the whole recording; what is left is explained."""
    assert which["verdict"] == effect, which["unexplained"]
    assert which["effects"] == ([] if effect == "none" else [effect])
    if effect != "none":
        mine, whole = interval(which, effect), interval(_untouched(effect), effect)
        assert mine["low"] <= whole["high"]
        assert whole["low"] <= mine["high"]


@pytest.mark.parametrize("effect", EFFECTS)
def test_the_whole_recording_gives_the_truth(effect):
    assert_same(_untouched(effect), effect)


@pytest.mark.parametrize("effect", ["none", "supply_sag"])
def test_lost_samples_change_nothing(effect):
    columns, rng = recorded(effect), np.random.default_rng(0)
    lost = rng.random(len(columns["duty"])) < 0.05
    for start in rng.integers(0, len(lost), 6):
        lost[start:start + 50] = True
    assert_same(verdict({name: np.where(lost, np.nan, x) for name, x in columns.items()}), effect)


@pytest.mark.parametrize(("channel", "effect"), [
    ("theta", "coulomb_friction"), ("omega", "coulomb_friction"), ("i_a", "supply_sag"),
    ("v_a", "brush_drop")])
def test_a_channel_that_is_gone_for_three_seconds_changes_nothing(channel, effect):
    columns = recorded(effect)
    columns[channel][3000:4500] = np.nan
    assert_same(verdict(columns), effect)


@pytest.mark.promise("Verdict", "Channels that were not measured leave a verdict on the others")
@pytest.mark.parametrize(("missing", "effect"), [
    (("v_a",), "none"), (("omega", "i_a", "v_a"), "none"), (("omega",), "coulomb_friction"),
    (("i_a",), "coulomb_friction"), (("omega", "i_a", "v_a"), "coulomb_friction")])
def test_a_channel_that_was_not_measured_changes_nothing_for_the_arm(missing, effect):
    assert_same(verdict(recorded(effect, **without(missing))), effect)


@pytest.mark.promise("Verdict", "An effect upstream is not blamed on a stage downstream")
@pytest.mark.parametrize(("missing", "effect"), [
    (("v_a",), "brush_drop"), (("omega", "i_a", "v_a"), "brush_drop"),
    (("i_a",), "supply_sag"), (("omega", "i_a", "v_a"), "supply_sag")])
def test_what_needs_a_channel_that_was_not_measured_is_never_called_something_else(missing, effect):
    which = verdict(recorded(effect, **without(missing)))
    assert which["verdict"] in {effect, "unknown", "none"}
    assert set(which["effects"]) <= {effect}


@pytest.mark.parametrize(("part", "effect"), [
    (slice(4500), "coulomb_friction"), (slice(-4500, None), "none"), (slice(3000, 6000), "none"),
    (slice(3000, 6000), "coulomb_friction")])
def test_a_part_says_the_same(part, effect):
    assert_same(verdict({name: x[part] for name, x in recorded(effect).items()}), effect)


@pytest.mark.parametrize("effect", ["none", "coulomb_friction"])
def test_every_second_sample_says_the_same(effect):
    assert_same(verdict({name: x[::2] for name, x in recorded(effect).items()}, 2.0 * SAMPLE_PERIOD), effect)


@pytest.mark.parametrize(("channel", "limit", "effect"), [
    ("theta", 0.45, "none"), ("theta", 0.45, "coulomb_friction"), ("i_a", 0.4, "brush_drop"),
    ("i_a", 0.6, "supply_sag")])
def test_a_channel_at_the_end_of_its_range_is_left_out_there_and_said(channel, limit, effect):
    columns, notes = recorded(effect), []
    assert np.mean(columns[channel] > limit) > 0.02
    columns[channel] = np.minimum(columns[channel], limit)
    assert_same(verdict(columns, notes=notes), effect)
    assert [note for note in notes if note.startswith(channel) and f"{limit:g}" in note]


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_an_angle_that_never_changes_is_no_ground_for_a_verdict(value):
    columns = recorded("none")
    columns["theta"][:] = value
    with pytest.raises(RecordingError, match=r"^my_bag: .*angle") as raised:
        from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing, name="my_bag")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("channel", ["omega", "i_a"])
def test_another_channel_that_never_changes_is_left_out_and_said(channel):
    columns, notes = recorded("coulomb_friction"), []
    columns[channel][:] = columns[channel].mean()
    assert_same(verdict(columns, notes=notes), "coulomb_friction")
    assert [note for note in notes if note.startswith(channel) and "left out" in note]


@pytest.mark.parametrize("channel", ["theta", "omega", "i_a", "v_a"])
def test_single_readings_that_jump_out_change_nothing(channel):
    columns, rng = recorded("coulomb_friction"), np.random.default_rng(1)
    hit = rng.random(len(columns["duty"])) < 0.005
    columns[channel][hit] += rng.choice([-1.0, 1.0], int(hit.sum())) * np.ptp(columns[channel])
    assert_same(verdict(columns), "coulomb_friction")


# --- real bags, through the command


class Bag:
    """Samples on their way into a bag: stamps in ns, and columns."""

    def __init__(self, effect="coulomb_friction", duration=9.0):
        n = round(duration / SAMPLE_PERIOD)
        self.columns = {name: x[:n] for name, x in recorded(effect).items()}
        self.stamps = 1_700_000_000_000_000_000 + 2_040_000 * np.arange(n)
        self.topics = {"joint_states", "armature"}
        self.order = np.arange(n)

    def messages(self, bags):
        made = []
        for row, stamp in enumerate(self.stamps.tolist()):
            one = {name: float(x[row]) for name, x in self.columns.items()}
            received = int(self.stamps[self.order[row]])
            if "joint_states" in self.topics:
                sample = bags.joint(stamp, [one["theta"], math.nan], [math.nan, one["omega"]])
                made.append(("/joint_states", "sensor_msgs/msg/JointState", received + 300_000, sample))
            if "armature" in self.topics:
                motor = bags.battery(stamp, one["v_a"], one["i_a"], one["duty"])
                made.append(("/armature", "sensor_msgs/msg/BatteryState", received + 400_000, motor))
            if "duty_command" in self.topics:
                made.append(("/duty_command", "std_msgs/msg/Float64", received, bags.number(one["duty"])))
        return bags.Content(made)


@pytest.fixture
def run(bags, tmp_path, capsys):
    """Write a bag, diagnose it: exit code, `diagnosis.json` without the run's own data, standard error."""
    def run_it(bag):
        name = f"bag{len(list(tmp_path.iterdir()))}"
        path = bags.write(tmp_path / name, bag.messages(bags))
        out = tmp_path / f"{name}_out"
        code = command.main([str(path), "--out", str(out)])
        complained = capsys.readouterr().err
        body = json.loads((out / "diagnosis.json").read_text()) if out.exists() else {}
        return code, {key: x for key, x in body.items() if key not in {"bags", "seconds"}}, complained

    return run_it


def test_the_order_of_messages_and_the_time_of_day_do_not_matter(run):
    code, plain, _ = run(Bag())
    assert code == 0
    assert plain["which"]["verdict"] == "coulomb_friction"
    mixed = Bag()
    mixed.order = np.random.default_rng(0).permutation(len(mixed.order))
    assert run(mixed) == (0, plain, "")
    for shift in (7 * 3600 * 10**9, 10**9 - mixed.stamps[0]):  # hours later; a simulation's clock from 1 s on
        shifted = Bag()
        shifted.stamps = shifted.stamps + shift
        assert run(shifted) == (0, plain, "")


@pytest.mark.promise(
    "Recordings", "Lost samples, saturated or constant readings, and pauses are noted, and do not change the verdict")
def test_stamps_that_jitter_and_lost_messages_change_nothing(run):
    bag = Bag()
    rng = np.random.default_rng(0)
    bag.stamps = bag.stamps + rng.integers(-200_000, 200_000, len(bag.stamps))
    kept = rng.random(len(bag.stamps)) > 0.05
    bag.stamps, bag.columns = bag.stamps[kept], {name: x[kept] for name, x in bag.columns.items()}
    bag.order = np.arange(len(bag.stamps))
    code, body, _ = run(bag)
    assert code == 0
    assert_same(body["which"], "coulomb_friction")
    assert any("missing" in note for note in body["notes"])


@pytest.mark.promise(
    "Recordings", "Lost samples, saturated or constant readings, and pauses are noted, and do not change the verdict")
@pytest.mark.parametrize("pause", [600.0, 365.0 * 86400.0])
def test_after_a_pause_only_the_longest_piece_counts(run, pause):
    bag = Bag(duration=11.0)
    half = round(8.0 / SAMPLE_PERIOD)
    bag.stamps[half:] += int(pause * 1e9)
    code, body, _ = run(bag)
    assert code == 0
    assert_same(body["which"], "coulomb_friction")
    assert body["duration_s"] == pytest.approx(8.0, abs=0.01)
    assert any(f"first for {pause:.0f} s" in note for note in body["notes"])


def test_without_armature_the_commands_are_the_duty(run):
    bag = Bag()
    bag.topics = {"joint_states", "duty_command"}
    code, body, _ = run(bag)
    assert code == 0
    assert body["which"]["verdict"] == "coulomb_friction"
    assert set(body["channels"]) == {"theta", "omega"}


def _one_second(bag):
    bag.stamps = bag.stamps[:490]


def _set_back(bag):
    bag.stamps = bag.stamps - 3_000_777_000 * (np.arange(len(bag.stamps)) > 2200)


def _no_duty(bag):
    bag.topics = {"joint_states"}


def _no_angle(bag):
    bag.topics = {"armature"}


def _nan_angle(bag):
    bag.columns["theta"] = np.full(len(bag.stamps), np.nan)


def _nan_duty(bag):
    bag.columns["duty"] = np.full(len(bag.stamps), np.nan)


def _motor_off(bag):
    _at_rest(bag, 0.0)


def _held(bag):
    _at_rest(bag, 0.3)


def _at_rest(bag, duty):
    n = len(bag.stamps)
    columns, _ = rig.record(BENCH, np.full(n + 5000, duty), 1)
    bag.columns = {name: x[-n:] for name, x in columns.items()} | {"duty": np.full(n, duty)}


@pytest.mark.promise("Recordings", "A recording whose stamps keep no period is refused in one line")
@pytest.mark.parametrize(("spoil", "words"), [
    (_one_second, "490 samples in 1 s"), (_set_back, "fit no sample period"), (_no_duty, "no duty"),
    (_no_angle, "no arm angle"), (_nan_angle, "no arm angle"), (_nan_duty, "no duty"), (_motor_off, "nothing happens"),
    (_held, "nothing happens")])
def test_where_nothing_can_be_told_one_line_says_why(run, spoil, words):
    bag = Bag()
    spoil(bag)
    code, body, complained = run(bag)
    assert (code, body) == (2, {})
    assert complained.startswith("diagnose: ")
    assert complained.count("\n") == 1
    assert words in complained
