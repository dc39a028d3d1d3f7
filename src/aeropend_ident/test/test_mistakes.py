# SPDX-License-Identifier: Apache-2.0
"""Mistaken units, signs, zeros and columns are recognised by physics, and the command that is said mends them."""

import re
import shlex
import struct
from pathlib import Path

import numpy as np
import pytest

from aeropend_ident.bags import mending
from aeropend_ident.bags.recording import CHANNELS, RecordingError, read
from aeropend_ident.checkup.bag import checks
from aeropend_ident.commands import bench, excitation_quality, identify
from aeropend_ident.commands.import_table import main as import_
from aeropend_ident.signals import mistakes
from aeropend_ident.signals.from_bag import as_signals
from aeropend_ident.signals.signals import Mounting
from aeropend_ident.testing.bags import write
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.cli.command import called
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD

COMMAND = called("import", "aeropend_ident")
JOINT = "sensor_msgs/msg/JointState"
PERIOD_NS = round(SAMPLE_PERIOD * 1e9)
SURE = {
    "degrees": lambda c: {"theta": np.degrees(c["theta"])},
    "turned over": lambda c: {"theta": -c["theta"]},
    "degrees, turned over": lambda c: {"theta": -np.degrees(c["theta"])},
    "hangs at -90 degrees": lambda c: {"theta": c["theta"] - 0.5 * np.pi},
    "mA": lambda c: {"i_a": 1e3 * c["i_a"]},
    "mV": lambda c: {"v_a": 1e3 * c["v_a"]},
    "current turned over": lambda c: {"i_a": -c["i_a"]},
    "voltage turned over": lambda c: {"v_a": -c["v_a"]},
    "speed turned over": lambda c: {"omega": -c["omega"]},
    "current and voltage": lambda c: {"i_a": c["v_a"], "v_a": c["i_a"]},
    "angle and speed": lambda c: {"theta": c["omega"], "omega": c["theta"]},
    "duty and current": lambda c: {"duty": c["i_a"], "i_a": c["duty"]},
    "duty turned over": lambda c: {"duty": -c["duty"]},
    "percent": lambda c: {"duty": 100.0 * c["duty"]},
    "rpm": lambda c: {"omega": c["omega"] * 60.0 / (2.0 * np.pi)},
    "turns a second": lambda c: {"omega": c["omega"] / (2.0 * np.pi)},
    "mA and mV": lambda c: {"i_a": 1e3 * c["i_a"], "v_a": 1e3 * c["v_a"]},
    "degrees and rpm": lambda c: {"theta": np.degrees(c["theta"]), "omega": c["omega"] * 60.0 / (2.0 * np.pi)},
    "hangs at 90, in degrees": lambda c: {"theta": np.degrees(c["theta"]) + 90.0},
    "hangs at 0.4, turned over": lambda c: {"theta": 0.4 - c["theta"]},
    "-1 without drive": lambda c: {"duty": 2.0 * c["duty"] - 1.0},
}
LIKELY = {
    "hangs at 0.4 rad": lambda c: {"theta": c["theta"] + 0.4},
}


def drawn(seed, effects=None, duration=5.0):
    """Channels and duty of a rig that begins at rest."""
    duty = np.concatenate([np.zeros(250), steps(duration, seed)])
    return {**rig.record(drawn_rig(seed, effects or {}), duty, seed)[0], "duty": duty}


@pytest.fixture(scope="module")
def columns():
    return drawn(31)


def mended(said, bag):
    """The recording that the command in this line makes."""
    program, *words = shlex.split(re.search(r"`(.*?)`", said)[1].removeprefix("ros2 run aeropend_ident "))
    assert Path(program).name == "import"
    assert words[:2] == [str(bag), str(bag.with_name("bag_mended"))]
    assert f"writes a mended copy to {words[1]}" in said
    assert import_(words) == 0
    return read(words[1])


def alike(recording, columns):
    for name in CHANNELS:
        np.testing.assert_allclose(getattr(recording, name), columns[name], rtol=1e-6, atol=2e-6, err_msg=name)


@pytest.mark.parametrize("what", SURE)
def test_a_sure_mistake_is_refused_with_the_command_that_mends_it(columns, tmp_path, what):
    write(tmp_path / "bag", columns | SURE[what](columns), PERIOD_NS)
    with pytest.raises(RecordingError) as refused:
        as_signals(read(tmp_path / "bag"), BENCH)
    new = mended(str(refused.value), tmp_path / "bag")
    if "hangs" in what:
        np.testing.assert_allclose(new.theta, columns["theta"], atol=0.06)  # the nominal model is not the rig
    else:
        alike(new, columns)
    assert as_signals(new, BENCH).notes == ()


def test_an_angle_in_counts_is_refused_with_the_command_that_mends_it(columns, tmp_path):
    write(tmp_path / "bag", columns | {"theta": np.rint(columns["theta"] * 1024 / (2.0 * np.pi)) + 257.0}, PERIOD_NS)
    with pytest.raises(RecordingError, match=r"the angle is in counts:1024 .* --zero 2\d\d`") as refused:
        as_signals(read(tmp_path / "bag"), BENCH)
    np.testing.assert_allclose(mended(str(refused.value), tmp_path / "bag").theta, columns["theta"], atol=0.06)


@pytest.mark.parametrize("what", LIKELY)
def test_a_likely_mistake_is_a_note_with_the_command_that_mends_it(columns, tmp_path, what):
    write(tmp_path / "bag", columns | LIKELY[what](columns), PERIOD_NS)
    (said,) = (note for note in as_signals(read(tmp_path / "bag"), BENCH).notes if "it looks as if" in note)
    new = mended(said, tmp_path / "bag")
    np.testing.assert_allclose(new.theta, columns["theta"], atol=0.05)
    np.testing.assert_allclose(new.omega, columns["omega"], atol=1e-4)


def test_a_speed_in_rpm_is_likely_where_nothing_shows_that_the_model_is_of_this_rig(columns):
    odd = columns | {"omega": columns["omega"] * 60.0 / (2.0 * np.pi), "theta": np.full(len(columns["duty"]), np.nan)}
    (one,) = mistakes.found(odd, columns["duty"], SAMPLE_PERIOD, BENCH)
    assert (one.sure, one.options) == (False, ("--omega omega:rpm",))


def test_a_name_that_is_taken_is_not_proposed(tmp_path):
    bag = tmp_path / "my bag"
    assert mending.named(mending.mend("--flip"), bag) == (
        f"`{COMMAND} '{bag}' '{bag}_mended' --flip` writes a mended copy to {bag}_mended")
    bag.with_name("my bag_mended").mkdir()
    assert mending.named(mending.mend("--flip"), bag) == (
        f"`{COMMAND} '{bag}' '{bag}_mended2' --flip` writes a mended copy to {bag}_mended2")


def test_a_motor_that_runs_while_the_duty_stays_at_0_is_refused(columns):
    still = np.zeros(len(columns["duty"]))
    for names, words in (((), "the voltage varies by"), (("v_a",), "the speed varies by")):
        missing = {name: np.full(len(still), np.nan) for name in names}
        (one,) = mistakes.found(columns | missing, still, SAMPLE_PERIOD, BENCH)
        assert one.sure
        assert one.what.startswith("the duty stays at 0, but ")
        assert words in one.what
    c = rig.record(drawn_rig(31, {}), still, 31)[0]
    assert mistakes.found(c, still, SAMPLE_PERIOD, BENCH) == []


def test_a_duty_that_is_inverted_is_refused(columns):
    (one,) = mistakes.found(columns, 1.0 - columns["duty"], SAMPLE_PERIOD, BENCH)
    assert (one.sure, one.options) == (True, ("--duty duty:counts:1..0",))
    assert "inverted (the rig follows 1 - duty)" in one.what


def test_the_voltage_of_a_supply_is_refused(columns):
    (one,) = mistakes.found(columns | {"v_a": 12.0 - 0.1 * columns["i_a"]}, columns["duty"], SAMPLE_PERIOD, BENCH)
    assert one.sure
    assert one.what.startswith("it looks as if the voltage is that of the supply")
    steady = {**rig.record(drawn_rig(31, {}), np.full(4000, 0.45), 31)[0]}
    assert mistakes.found(steady, np.linspace(4e-7, 5e-7, 4000), SAMPLE_PERIOD, BENCH) == []


def test_joints_on_a_topic_of_another_name_are_said(columns, bags, tmp_path):
    made = bags.content(len(columns["duty"]), columns=columns)
    bag = bags.write(tmp_path / "bag", bags.Content(
        [("/joints" if topic == "/joint_states" else topic, *rest) for topic, *rest in made.messages]))
    with pytest.raises(RecordingError, match=r"there is no joint_states; /joints has another name: record it"):
        as_signals(read(bag), BENCH)


def test_a_rotor_that_runs_up_under_the_duty_of_the_first_sample_is_no_mistake():
    duty = np.full(4000, 0.45)
    assert mistakes.found(rig.record(drawn_rig(31, {}), duty, 31)[0], duty, SAMPLE_PERIOD, BENCH) == []


@pytest.mark.parametrize("missing", [(), ("v_a",)])
def test_a_voltage_before_its_duty_is_refused_and_a_speed_is_a_note(missing):
    c = drawn(31, duration=20.0)
    late = np.concatenate([np.zeros(245), c["duty"][:-245]])
    (one,) = mistakes.found(c | {name: np.full(len(late), np.nan) for name in missing}, late, SAMPLE_PERIOD, BENCH)
    assert one.sure == (not missing)
    assert re.search(r"stamped 0\.(48|49|50|51|52) s late", one.what)


@pytest.mark.parametrize("effect", [None, "speed_spikes", "encoder_lag", "command_delay", "angle_offset"])
def test_a_rig_with_an_effect_has_no_mistake(effect):
    for seed in range(3):
        c = drawn(40 + seed, {effect: {}} if effect else {})
        assert mistakes.found(c, c["duty"], SAMPLE_PERIOD, BENCH) == []
        assert mistakes.without_model(c["theta"], c["duty"], c["i_a"], c["v_a"]) == []
    assert effect is None or effect in CATALOGUE


@pytest.mark.parametrize("channel", ["omega", "i_a", "v_a"])
def test_a_size_that_no_rig_has_is_refused(columns, channel):
    odd = columns | {channel: np.where(np.arange(len(columns["duty"])) % 2000 < 700, 1e3, 1.0) * columns[channel]}
    (one,) = mistakes.found(odd, columns["duty"], SAMPLE_PERIOD, BENCH)
    assert one.sure
    assert "check its unit, or give the model file" in one.what


def test_an_angle_whose_mounting_is_known_is_no_mistake(columns, tmp_path):
    mounting = Mounting(0.5, flipped=True)
    write(tmp_path / "bag", columns | {"theta": 0.5 - columns["theta"]}, PERIOD_NS)
    assert as_signals(read(tmp_path / "bag"), BENCH, mounting=mounting).notes == ()
    with pytest.raises(RecordingError, match="turned over"):
        as_signals(read(tmp_path / "bag"), BENCH)


def test_an_angle_whose_zero_is_set_while_it_is_recorded_is_refused(columns):
    half = np.arange(len(columns["duty"])) > len(columns["duty"]) // 2
    (one,) = mistakes.found(columns | {"theta": columns["theta"] + 3.0 * half}, columns["duty"], SAMPLE_PERIOD, BENCH)
    assert one.sure
    assert "the angle jumps by 3 rad at 2.8 s" in one.what
    single = np.where(np.arange(len(half)) % 500 < 3, 9.0, columns["theta"])
    assert mistakes.found(columns | {"theta": single}, columns["duty"], SAMPLE_PERIOD, BENCH) == []


def test_the_voltage_of_a_supply_is_no_current(columns):
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(columns["duty"]))
    for sag in (0.0, 0.3):
        supply = 12.0 - sag * columns["i_a"] + noise
        assert mistakes.without_model(columns["theta"], columns["duty"], columns["v_a"], supply) == []


def test_of_an_uncalibrated_rig_degrees_and_exchanged_columns_are_a_note(columns, tmp_path):
    changed = {"theta": np.degrees(columns["theta"]), "i_a": columns["v_a"], "v_a": columns["i_a"]}
    write(tmp_path / "bag", columns | changed, PERIOD_NS)
    notes = as_signals(read(tmp_path / "bag"), BENCH, fit_nominal=True).notes
    assert any("bag_mended --theta theta:deg` writes a mended copy" in note for note in notes)
    assert any("bag_mended --current v_a:A --voltage i_a:V` writes a mended copy" in note for note in notes)


@pytest.mark.parametrize(("command", "words"), [
    (identify.main, []), (excitation_quality.main, []), (bench.main, ["--steady"])])
def test_every_command_with_a_model_says_it(columns, tmp_path, monkeypatch, capsys, command, words):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "bag", columns | {"i_a": -columns["i_a"]}, PERIOD_NS)
    assert command([*words, "bag"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "bag: it looks as if the current is turned over" in line


@pytest.mark.parametrize(("names", "options"), [
    (("pendulum", "rotor"), "--theta pendulum:rad"),
    (("the pole", "rotor"), "--theta 'the pole:rad'")])
def test_an_arm_of_another_name_is_named_with_the_command_that_takes_it(columns, bags, tmp_path, names, options):
    made = bags.content(len(columns["duty"]), columns=columns)
    stamps, joints = made.arrays["stamp_ns"].tolist(), []
    for k, stamp in enumerate(stamps):
        position, speed = [float(columns["theta"][k]), np.nan], [np.nan, float(columns["omega"][k])]
        joints.append(("/joint_states", JOINT, stamp, bags.joint(stamp, position, speed, names)))
    bag = bags.write(tmp_path / "bag", bags.Content([*made.without("/joint_states").messages, *joints]))
    with pytest.raises(RecordingError) as refused:
        as_signals(read(bag), BENCH)
    assert f"joint_states has the joint {names[0]}, none is called arm" in str(refused.value)
    assert options in str(refused.value)
    new = mended(str(refused.value), bag)
    np.testing.assert_allclose(new.theta, columns["theta"])
    np.testing.assert_allclose(new.omega, columns["omega"])


def test_both_joints_of_other_names_can_be_taken(columns, bags, tmp_path):
    made = bags.content(len(columns["duty"]), columns=columns)
    joints = []
    for k, stamp in enumerate(made.arrays["stamp_ns"].tolist()):
        position, speed = [float(columns["theta"][k]), np.nan], [np.nan, float(columns["omega"][k])]
        joints.append(("/joint_states", JOINT, stamp, bags.joint(stamp, position, speed, ("pole", "fan"))))
    bag = bags.write(tmp_path / "bag", bags.Content([*made.without("/joint_states").messages, *joints]))
    with pytest.raises(RecordingError, match=r"no arm angle: .*its joints: fan, pole.*if pole is the arm, ") as refused:
        as_signals(read(bag), BENCH)
    alike(mended(str(refused.value), bag), columns)


def test_stamps_in_another_unit_are_refused_with_the_command_that_mends_them(columns, bags, tmp_path):
    made = bags.content(len(columns["duty"]), columns=columns)
    messages = []
    for topic, kind, received, raw in made.without("/duty_command", "/reference").messages:
        stamp = int(made.arrays["stamp_ns"][len(messages) // 2]) // 1000
        messages.append((topic, kind, received, raw[:4] + struct.pack("<iI", *divmod(stamp, 10**9)) + raw[12:]))
    bag = bags.write(tmp_path / "bag", bags.Content(messages))
    with pytest.raises(RecordingError, match="but it was received over 5") as no:
        as_signals(read(bag), BENCH)
    assert [check.level for check in checks(str(bag), BENCH) if check.level != "ok"] == ["error"]  # nothing of 0 s
    new = mended(str(no.value), bag)
    assert new.duration == pytest.approx(read(bag).duration * 1000, rel=1e-3)
    assert new.period == pytest.approx(SAMPLE_PERIOD, rel=0.1)
