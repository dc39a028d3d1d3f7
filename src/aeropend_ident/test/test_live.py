# SPDX-License-Identifier: Apache-2.0
"""The model beside the rig, without ROS: residuals, detection, interruptions."""

import copyreg
import json
import math
import os
import resource
import time
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numba.typed import List
from rosbags.rosbag2 import Reader

from aeropend_ident.commands import live
from aeropend_ident.live import false_alarms
from aeropend_ident.live.alarm_diagnosis import AlarmDiagnosis
from aeropend_ident.live.bank import columns, size_of
from aeropend_ident.live.companion_model import CHANNELS, Companion, Samples
from aeropend_ident.live.detector import Finding
from aeropend_ident.live.intake import Batch, Intake
from aeropend_ident.live.ring import AlarmBag, Message, Ring
from aeropend_ident.live.server import Page
from aeropend_ident.live.watcher import DRIFTED, EXPLAINED, PARTED, STALE, Watcher
from aeropend_ident.nodes.topic_recorder import DEPTH
from aeropend_ident.nodes.watch import why
from aeropend_sim.model import effect_file
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from aeropend_sim.model.rig import Rig

PERIOD_NS = round(SAMPLE_PERIOD * 1e9)
BEFORE, AFTER = 74.0, 20.0  # s: learned, and watched; the rotor turns when the effect begins
STEP = 25
LEARNED = round(BEFORE / SAMPLE_PERIOD) // STEP * STEP
copyreg.pickle(List, lambda members: (List, (list(members),)))  # so that a watcher can be copied


@cache
def readings(effect: str, parameter: str, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Duty and readings (4, N) of a rig that gets an effect after `BEFORE`, its numbers 3 % off the model's."""
    bench, rng = load("bench"), np.random.default_rng(5)
    numbers = {k: x * (1.0 + 0.03 * rng.uniform(-1.0, 1.0)) for k, x in bench.model.items()}
    duty = Excitation(duration=BEFORE + AFTER, seed=4).series()
    first = round(BEFORE / SAMPLE_PERIOD)
    rig = Rig(Model("rig", numbers, bench.sensing, {}), seed=2)
    before, _ = rig.run(duty[:first])
    if not effect:
        return duty, np.hstack([before, rig.run(duty[first:])[0]])
    other = Rig(Model("rig", numbers, bench.sensing, {effect: {parameter: size}}), seed=3)
    other._state, other._memory, other._count, other._past = rig._state, rig._memory, rig._count, rig._past
    return duty, np.hstack([before, other.run(duty[first:])[0]])


@cache
def learned() -> Watcher:
    """A watcher that has seen what each of the rigs does before anything begins, and has given no alarm."""
    watcher = Watcher(load("bench"))
    assert not fed(watcher, *readings("", "", 0.0), stop=LEARNED)
    return watcher


def watched(duty: np.ndarray, read: np.ndarray) -> tuple[Watcher, list[float]]:
    """A watcher that has seen it all, and the times of its alarms."""
    before = slice(LEARNED)
    assert np.array_equal(read[:, before], readings("", "", 0.0)[1][:, before])
    watcher = deepcopy(learned())
    return watcher, fed(watcher, duty, read, start=LEARNED)


def fed(watcher: Watcher, duty: np.ndarray, read: np.ndarray, start: int = 0, stop: int | None = None, away_ns: int = 0
        ) -> list[float]:
    """Times of the alarms of a watcher that sees this, or the samples from `start` to `stop`, after a break."""
    alarms = []
    for k in range(start, len(duty) - STEP if stop is None else stop, STEP):
        s = slice(k, k + STEP)
        batch = Batch(away_ns + PERIOD_NS * np.arange(k + 1, k + STEP + 1), Samples(*read[:, s], duty[s]),
                      "a break" if away_ns and k == start else "")
        if watcher.step(batch)[1] is not None:
            alarms.append(watcher.detector.time)
    return alarms


def test_a_rig_that_does_not_change_is_no_alarm():
    watcher, alarms = watched(*readings("", "", 0.0))
    assert not alarms
    assert all(place.state not in (PARTED, STALE) for place in watcher.places.values())


@pytest.mark.parametrize(("effect", "parameter", "size", "place"), [
    ("bridge_drop", "v_drop", 0.2, "actuator"), ("rotor_friction", "torque", 5e-4, "rotor"),
    ("current_offset", "bias", 0.06, "sensing"), ("coulomb_friction", "accel", 0.8, "arm"),
    ("coulomb_friction", "accel", 0.3, "arm"), ("ground_effect", "gain", 0.08, "thrust"),
    ("angle_offset", "bias", 0.01, "sensing"),
])
def test_an_effect_that_begins_is_told_with_instant_place_and_name(effect, parameter, size, place):
    watcher, alarms = watched(*readings(effect, parameter, size))
    assert len(alarms) == 1
    assert 0.0 < alarms[0] - BEFORE < 8.0
    assert watcher.places[place].state == PARTED
    others = [p for name, p in watcher.places.items() if name != place]
    assert all((p.state == EXPLAINED) == (p.gap > p.limit) for p in others if p.state != DRIFTED)
    assert watcher.alarm.hypothesis == effect
    low, high = watcher.alarm.within
    assert low - 0.5 < BEFORE < high + 0.5


def test_what_a_stage_showed_while_the_rig_was_learned_is_no_alarm_there_and_hides_none_elsewhere(monkeypatch):
    monkeypatch.setattr(learned().detector, "peaks", {**learned().detector.peaks, "motor": 1e5})
    assert not watched(*readings("rotor_friction", "torque", 5e-4))[1]
    watcher, alarms = watched(*readings("coulomb_friction", "accel", 0.3))
    assert len(alarms) == 1
    assert watcher.alarm.hypothesis == "coulomb_friction"


def test_an_alarm_stays_until_it_is_cleared():
    watcher, _ = watched(*readings("bridge_drop", "v_drop", 0.2))
    watcher.silent("nothing comes")
    assert watcher.places["actuator"].state == PARTED
    watcher.clear()
    assert watcher.alarm is None
    assert watcher.places["actuator"].state != PARTED
    duty, read = readings("bridge_drop", "v_drop", 0.2)
    last = slice(round((BEFORE + 2.0) / SAMPLE_PERIOD), None)
    assert not fed(watcher, duty[last], read[:, last])


def test_an_alarm_keeps_its_instant_and_its_entry_on_the_page_when_samples_were_missing():
    watcher, _ = watched(*readings("bridge_drop", "v_drop", 0.2))
    page, (duty, read) = Page("127.0.0.1", 0, "bench"), readings("bridge_drop", "v_drop", 0.2)
    told = []
    for away in range(0, 40, 10):
        page.state(watcher, Intake(), 10.0 * away)
        told += json.loads(page._state)["state"]["history"]
        page.diagnosed(watcher.alarms, "supply_sag")
        fed(watcher, duty[-60 * STEP:], read[:, -60 * STEP:], away_ns=(120 + away) * 10**9)
    page.close()
    assert len(told) == 4
    assert len({entry["at"] for entry in told}) == 1
    assert [entry["diagnosed"] for entry in told] == ["", *["supply_sag"] * 3]
    assert all(abs(since - BEFORE) < 1.0 for since in (*(entry["since"] for entry in told),
                                                       watcher.places["actuator"].since_ns * 1e-9))


def test_what_cannot_be_a_reading_is_no_alarm_and_no_crash():
    duty, read = readings("", "", 0.0)
    read = read.copy()
    rng = np.random.default_rng(1)
    first = round(BEFORE / SAMPLE_PERIOD)
    bad = first + np.flatnonzero(rng.random(len(duty) - first) < 0.02)
    read[rng.integers(0, 4, len(bad)), bad] = math.nan
    _, alarms = watched(duty, read)
    assert not alarms
    huge = read.copy()
    huge[3, first:first + 50] = 1e6
    assert np.isfinite(watched(duty, huge)[0].detector.statistic)


def test_a_fault_is_told_as_long_as_it_lasts():
    watcher, quiet = Watcher(load("bench")), np.zeros((5, STEP))

    def give(k, readings):
        watcher.step(Batch(PERIOD_NS * np.arange(k * STEP, (k + 1) * STEP), Samples(*readings)))
        return watcher.fault, {place.state for place in watcher.places.values()}

    assert watcher.fault == "no sample yet"
    assert give(0, quiet)[0] == ""
    assert not [give(k, quiet) for k in range(1, 8)][-1][1] & {STALE}
    assert give(8, np.full((5, STEP), 1e200)) == ("the readings are impossible", {STALE})
    assert give(9, quiet)[0] == ""
    watcher.silent("2 publishers")
    assert give(10, quiet)[0] == ""


def test_batches_are_cut_where_samples_are_missing_or_the_clock_steps():
    intake = Intake()

    def give(stamps):
        for stamp in stamps:
            intake.joints(stamp, 0.1, 100.0 + stamp % 7)
            intake.armature(stamp, 0.2 + 1e-3 * (stamp % 11), 0.5, 0.3)
        return intake.take()

    first = give(PERIOD_NS * np.arange(1, 51))
    assert [(len(b.stamps), b.broken) for b in first] == [(50, "start")]
    bridged = give(PERIOD_NS * np.concatenate([np.arange(51, 60), np.arange(65, 70)]))
    assert [(len(b.stamps), b.broken) for b in bridged] == [(19, "")]
    assert intake.lost == 5
    assert np.isnan(bridged[0].samples.theta[9:14]).all()
    assert (np.diff(bridged[0].stamps) == PERIOD_NS).all()
    (gap,) = give(PERIOD_NS * np.arange(1000, 1010))
    assert "without a sample" in gap.broken
    (back,) = give(PERIOD_NS * np.arange(500, 510))
    assert "went back" in back.broken


def test_stamps_that_jitter_or_repeat_do_not_start_the_model_anew():
    intake, jitter = Intake(), np.random.default_rng(1).integers(-800_000, 800_000, 2000)
    given = np.repeat(PERIOD_NS * np.arange(1, 2001) + jitter, np.where(np.arange(2000) % 5, 1, 2))
    batches = []
    for part in np.split(given, 40):
        for stamp in part.tolist():
            intake.joints(stamp, 0.1, 100.0)
            intake.armature(stamp, 0.2, 0.5, 0.3)
        batches += intake.take()
    assert {b.broken for b in batches} == {"start", ""}
    assert sum(len(b.stamps) for b in batches) == pytest.approx(2000, abs=1)
    assert intake.doubled == pytest.approx(400, abs=5)  # some more until the grid is known


def test_halves_are_joined_in_any_order_and_impossible_readings_are_counted():
    intake = Intake()
    intake.armature(PERIOD_NS, 0.1, 0.5, math.nan)
    intake.command = 0.25
    intake.armature(2 * PERIOD_NS, math.inf, 0.5, math.nan)
    intake.joints(PERIOD_NS, 0.3, 50.0)
    intake.joints(2 * PERIOD_NS, 1e9, 50.0)
    (batch,) = intake.take()
    assert batch.samples.theta[0] == 0.3
    assert np.isnan([batch.samples.theta[1], batch.samples.i_a[1]]).all()
    assert batch.samples.duty[1] == 0.25
    assert intake.odd == 3


def test_no_sample_is_lost_when_one_topic_comes_long_before_the_other():
    intake, stamps = Intake(), PERIOD_NS * np.arange(1, DEPTH + 1)
    for stamp in stamps.tolist():
        intake.joints(stamp, 0.3, 100.0)
    for stamp in stamps.tolist():
        intake.armature(stamp, 0.1, 0.5, 0.25)
    (batch,) = intake.take()
    assert np.array_equal(batch.stamps, stamps)
    assert intake.lost == 0


def alarm_bag(path: Path) -> AlarmBag:
    """A bag of an alarm, with some messages."""
    bag = AlarmBag(path, Ring(), {"duty_command": "std_msgs/msg/Float64"}, lambda _: [], alarm_ns=10**9)
    for k in range(1, 1001):
        bag.add(Message(k * 10**6, "duty_command", bytes(12)))
    return bag


def test_two_watchers_may_write_the_bag_of_an_alarm_in_the_same_second(tmp_path):
    bags = [alarm_bag(tmp_path / "alarm") for _ in range(3)]
    for bag in bags:
        bag.close()
    assert [bag.path.name for bag in bags] == ["alarm", "alarm_2", "alarm_3"]
    for bag in bags:
        with Reader(bag.path) as reader:
            assert reader.message_count == 1000


def test_the_bag_of_an_alarm_that_cannot_be_written_is_closed(tmp_path):
    bag = alarm_bag(tmp_path / "alarm")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            bag.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    held = [os.path.realpath(entry) for entry in Path("/proc/self/fd").iterdir()]
    assert not [path for path in held if path.startswith(str(tmp_path))]


def test_diagnose_of_the_bag_of_an_alarm_tells_its_verdict_or_why_there_is_none(bags, tmp_path, capfd):
    duty, read = readings("bridge_drop", "v_drop", 0.2)
    last = slice(round((BEFORE - 20.0) / SAMPLE_PERIOD), len(duty))
    made = bags.content(len(duty[last]), columns=dict(zip(Samples._fields, (*read[:, last], duty[last]), strict=True)))
    one = AlarmDiagnosis(bags.write(tmp_path / "alarm", made), "bench", 1, nice=0)
    other = AlarmDiagnosis(tmp_path / "gone", "bench", 2, nice=0)
    until = time.monotonic() + 120.0
    while not (one.ended and other.ended) and time.monotonic() < until:
        time.sleep(0.1)
    assert one.verdict == "bridge_drop"
    assert one.report.exists()
    assert other.verdict == ""
    (line,) = capfd.readouterr().err.splitlines()
    assert "gone" in line
    endless = AlarmDiagnosis(tmp_path / "alarm", "bench", 3, nice=0)
    endless.close()
    assert endless.ended
    assert endless.verdict == ""


def test_readings_that_do_not_change_are_frozen():
    intake = Intake()
    for k in range(1, 400):
        intake.joints(k * PERIOD_NS, 0.1, 100.0)
        intake.armature(k * PERIOD_NS, 0.2, 0.5, 0.3)
    intake.take()
    assert intake.frozen
    intake.joints(400 * PERIOD_NS, 0.2, 100.0)
    intake.armature(400 * PERIOD_NS, 0.2, 0.5, 0.3)
    intake.take()
    assert not intake.frozen


def test_the_limit_follows_from_the_mean_time_between_false_alarms():
    assert false_alarms.limit(48.0) > false_alarms.limit(24.0)
    assert false_alarms.mean_hours(false_alarms.limit(24.0)) == pytest.approx(24.0)


def test_a_torque_that_is_missing_is_no_speed_of_an_arm_at_rest():
    """What depends on the speed of the arm leaves nothing at rest, so that it cannot explain a torque that changes."""
    bench = load("bench")
    n = round(6.0 / SAMPLE_PERIOD)
    heavier = Model("rig", {**bench.model, "mgd_over_J": 1.1 * bench.model["mgd_over_J"]}, bench.sensing, {})
    duty = np.full(n, 0.35)
    read, _ = Rig(heavier, seed=1).run(np.full(round(20.0 / SAMPLE_PERIOD), 0.35))
    bank = columns(bench)
    companion = Companion(bench, bank)
    rows = companion.step(Samples(*read[:, -n:], duty)).rows["arm"]
    still = rows[n // 2:].mean(axis=0)
    moved = {c.effect: abs(still[0] - still[1 + k]) for k, c in enumerate(c for c in bank if "arm" in c.stages)}
    assert abs(still[0]) > 3.0
    for effect in ("axial_inflow", "encoder_lag", "quadratic_drag"):
        assert moved[effect] < 0.02, effect
    assert moved["cable_torque"] > 0.5


@pytest.mark.parametrize("effect", live.SWITCHED)
def test_each_effect_of_the_command_live_begins_at_its_instant(effect, tmp_path):
    live.draw(tmp_path, effect, 3.0, 7)
    changed = load(str(tmp_path / "rig.yaml"))
    duty = Excitation(duration=6.0, seed=4).series()
    with_, without = (Rig(Model("rig", changed.model, changed.sensing, effects), seed=1).run(duty)[0]
                      for effects in (changed.effects, {}))
    moved = np.abs(with_ - without).max(axis=0)
    first = round(3.0 / SAMPLE_PERIOD)
    assert moved[:first].max() < 1e-6
    assert moved[first:].max() > 0.01


@pytest.mark.parametrize(("effect", "own"), [
    ("cable_torque", {"k": 3.0, "theta0": 0.4}), ("encoder_eccentricity", {"amplitude": 0.03, "phase": 1.2}),
])
def test_an_effect_that_is_linear_in_two_parameters_has_two_columns_for_all_their_values(effect, own):
    bench = load("bench")
    duty = Excitation(duration=20.0, seed=4).series()
    read, _ = Rig(Model("rig", bench.model, bench.sensing, {effect: own}), seed=2).run(duty)
    bank = columns(bench)
    rows = Companion(bench, bank).step(Samples(*read, duty)).rows["arm"][round(2.0 / SAMPLE_PERIOD):]
    at = [k for k, c in enumerate(c for c in bank if "arm" in c.stages) if c.effect == effect]
    two = [c for c in bank if c.effect == effect]
    assert len(at) == len(two) == 2
    sizes = np.linalg.lstsq(rows[:, :1] - rows[:, [1 + k for k in at]], rows[:, 0], rcond=None)[0]
    found = size_of(two, [size * c.step for size, c in zip(sizes, two, strict=True)])
    assert found == pytest.approx(next(iter(own.values())), rel=0.1)


BY_FORMULA = {
    "theta": {"place": "sensing", "reading": "theta", "term": "k * sin(3 * theta) * (1 + step(t - 5))"},
    "i_a": {"place": "sensing", "reading": "i_a", "term": "k * abs(i_a)"},
    "v_a": {"place": "sensing", "reading": "v_a", "term": "k * v * step(t - 5)"},
    "late step": {"place": "actuator", "term": "k * v * step(t - 5)"},
    "memory": {"place": "actuator", "term": "k * (z - v)",
               "memory": {"name": "z", "unit": "V", "rate": "(v - z) / tau"}},
}


@pytest.mark.parametrize("name", BY_FORMULA)
def test_the_model_beside_the_rig_runs_its_effects_by_formula(name):
    size = {"unit": "rad" if name == "theta" else "-", "default": 0.1, "low": 0.0, "high": 1.0}
    tau = {"tau": {"unit": "s", "default": 0.05, "low": 0.01, "high": 1.0}} if name == "memory" else {}
    effect_file.define({"written": {**BY_FORMULA[name], "parameters": {"k": size, **tau}}}, "test")
    model = load("bench").with_effects({"written": {"k": 0.1, "tau": 0.05}})
    duty = Excitation(duration=10.0, seed=4).series()
    read, _ = Rig(model, seed=2).run(duty)
    companion = Companion(model, [])
    parts = [companion.step(Samples(*read[:, k:k + STEP], duty[k:k + STEP])) for k in range(0, len(duty), STEP)]
    effect_file.forget("written")
    left = {CHANNELS[c]: np.concatenate([p.rows[stage][p.channel[stage] == c, 0] for p in parts[80:]])
            for stage, c in (("actuator", 0), ("motor", 1), ("arm", 3))}
    said = np.concatenate([np.array(p.said) for p in parts], axis=1)
    free = {c: (read[k] - said[k]) / companion.floors[c] for k, c in enumerate(Samples._fields[:4]) if c != "omega"}
    for channel, rows in left.items():  # the motor is fed with a voltage that has noise: its current has some more
        assert np.sqrt(np.mean(rows ** 2)) < 1.3, channel
        assert np.sqrt(np.mean(free[channel] ** 2)) < 1.1, channel


def test_an_effect_is_named_only_if_it_is_more_likely_than_not():
    finding = Finding("ground_effect", "thrust", 20.0, 0.4, 80.0, 2.0, (79.0, 81.0), 0.71)
    assert why(finding) == "likeliest ground_effect (71%)"
    assert why(replace(finding, probability=0.14)) == "not clear yet why, perhaps ground_effect (14%)"
