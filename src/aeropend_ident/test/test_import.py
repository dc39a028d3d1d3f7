# SPDX-License-Identifier: Apache-2.0
"""Tables become recordings: the proposal, and what `import` makes of it."""

import json
import math
import shlex

import numpy as np
import pytest
import yaml
from arm_tables import (
    ANGLE,
    DRIVEN,
    DUTY,
    LONG,
    MAPPED,
    NUMBERS,
    PUSH,
    TIME,
    comma,
    driven,
    imported,
    lines,
    put,
    refused,
)

from aeropend_ident.bags.cdr import decode, encode
from aeropend_ident.bags.recording import read
from aeropend_ident.commands import diagnose
from aeropend_ident.commands.import_table import main
from aeropend_sim.cli.command import called
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import load
from aeropend_sim.model.rig import record


def proposed(capsys, path):
    """The command that is proposed for a file."""
    assert main([str(path)]) == 2
    out, err = capsys.readouterr()
    assert "--accept" in err
    program = called("import", "aeropend_ident")
    (command,) = (line for line in out.splitlines() if line.startswith(f"  {program} "))
    return shlex.split(command.removeprefix(f"  {program}")), out


@pytest.mark.promise("Tables", "`import` shows the columns of a file and proposes their meaning")
@pytest.mark.parametrize("head", [
    "t [s],theta [deg],pwm [%]", "Zeit / s,Winkel / °,Tastgrad / %", "tiempo,ángulo,ciclo", "temps (s),angle (°),pwm",
    "время,угол,ШИМ", "时间,角度,占空比", "time_s,angle_deg,duty_pct",
])  # fmt: skip
def test_what_is_obvious_is_proposed_and_works_as_it_stands(tmp_path, capsys, head):
    path = put(tmp_path, head + "\n" + lines(LONG, DRIVEN, PUSH))
    command, out = proposed(capsys, path)
    assert "0.0000  0.0200  0.0400" in out
    assert not (tmp_path / "bag").exists()
    command[1] = str(tmp_path / "bag")
    assert main(command) == 0
    recording = read(tmp_path / "bag")
    np.testing.assert_allclose(recording.theta, np.radians(DRIVEN), atol=1e-4)
    np.testing.assert_allclose(recording.duty, PUSH / 100, atol=1e-7)
    assert main([str(path), str(tmp_path / "same"), "--accept"]) == 0
    np.testing.assert_array_equal(read(tmp_path / "same").theta, recording.theta)


def test_a_proposal_for_columns_without_names(tmp_path, capsys):
    command, _ = proposed(capsys, put(tmp_path, lines(1e3 * TIME + 5000, ANGLE, form="{:.1f}")))
    assert command[2:] == ["--time", "1:ms", "--theta", "2:deg"]
    text = "".join(f"12:00:{t:06.3f};{x:.1f}\n" for t, x in zip(TIME, ANGLE))
    assert proposed(capsys, put(tmp_path, text))[0][2:] == ["--time", "1", "--theta", "2:deg"]


@pytest.mark.promise("Tables", "`import` shows the columns of a file and proposes their meaning")
@pytest.mark.parametrize(("text", "says"), [
    ("t,angle 1,angle 2\n" + lines(TIME, ANGLE, driven(0.0 * TIME + 50.0)), "the name of column 2 says theta too"),
    ("t,angle\n" + lines(TIME, ANGLE / 15.0), "rad or deg?"),
    ("t,angle\n" + "".join(f"{t:.2f},{x:.0f}\n" for t, x in zip(TIME, ANGLE)), "deg, or counts of a turn?"),
    ("t,angle,pwm\n" + "".join(f"{t:.2f},{x:.2f},{u:.0f}\n" for t, x, u in zip(LONG, DRIVEN, PUSH)),
     "check --duty pwm:counts:255"),
    ("t,angle,pwm\n" + lines(TIME, ANGLE, DUTY), "but column 2 \"angle\" does not follow it"),
    ("t,pwm,angle\n" + lines(LONG, DRIVEN, PUSH), "but it does not move as an arm"),
    ("t,angle,v\n" + lines(LONG, DRIVEN, PUSH / 10), "of which supply? add --supply 12V"),
    ("t,angle,u\n" + lines(LONG, DRIVEN, np.where(PUSH > 0.0, PUSH, -20.0)), "add --both-ways reverse, brake or clip"),
    ("k,angle,u\n" + lines(np.arange(len(LONG)), DRIVEN, PUSH), "a counter of rows, or ms?"),
])  # fmt: skip
def test_what_is_not_obvious_is_not_accepted(tmp_path, capsys, text, says):
    assert main([str(put(tmp_path, text)), str(tmp_path / "bag"), "--accept"]) == 2
    out, err = capsys.readouterr()
    assert says in out
    assert "check first what is not clear" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "bag").exists()


@pytest.mark.promise("Tables", "A command in volts is a share of the supply, or the voltage itself")
def test_a_command_in_volts_is_the_voltage_where_the_supply_is_not_known(tmp_path):
    path = put(tmp_path, "t,angle,u [V]\n" + lines(LONG, DRIVEN, PUSH / 10))
    recording = imported(tmp_path, path, "--accept")
    np.testing.assert_allclose(recording.v_a, PUSH / 10, atol=1e-5)
    assert "duty" not in recording.channels
    recording = imported(tmp_path, path, "--accept", "--supply", "10V")
    np.testing.assert_allclose(recording.duty, PUSH / 100, atol=1e-5)


def test_a_single_impossible_number_is_left_out_with_a_line(tmp_path, capsys):
    wrong = np.where(np.arange(len(LONG)) == 300, 1e300, np.radians(DRIVEN))
    head = "t [s],angle [rad],omega [rad/s],duty\n"
    speed = 100.0 * (PUSH > 0.0) + np.radians(DRIVEN)
    path = put(tmp_path, head + lines(LONG, wrong, speed, PUSH / 100, form="{:.9g}"))
    command, out = proposed(capsys, path)
    assert "line 302, column 2 \"angle [rad]\": 1e+300 is no possible number: left out" in out
    assert command[2:6] == ["--time", "t [s]", "--theta", "angle [rad]"]


def test_a_constant_angle_is_said_and_no_speed_takes_its_place(tmp_path, capsys):
    head = "t [s],angle [rad],omega [rad/s],duty\n"
    path = put(tmp_path, head + lines(LONG, 0.0 * LONG + 0.3, DRIVEN, PUSH / 100))
    assert main([str(path)]) == 2
    out, _ = capsys.readouterr()
    assert "its name says the angle, but it is 0.3 all the time: constant" in out
    assert "--theta COLUMN:UNIT" in out
    assert "omega [rad/s]:deg" not in out


def test_a_recording_that_is_mended_says_nothing_of_even_stamps(tmp_path, capsys):
    path = put(tmp_path, "t,x\n" + lines(TIME, ANGLE))
    assert main([str(path), str(tmp_path / "bag"), *MAPPED]) == 0
    capsys.readouterr()
    assert main([str(tmp_path / "bag"), str(tmp_path / "new"), "--flip"]) == 0
    assert "stamps" not in capsys.readouterr().out


def test_a_table_of_steady_states_is_no_recording(tmp_path, capsys):
    text = "".join(f"{2.4 + 0.15 * k:.2f}\t{0.05 + 0.01 * k:.4f}\n" for k in range(17))
    assert "bench_test takes it" in refused(capsys, put(tmp_path, text))


def test_where_it_comes_from_is_kept(tmp_path):
    path = put(tmp_path, "t,x,rest\n" + lines(np.round(TIME, 2), ANGLE, ANGLE))
    imported(tmp_path, path, *MAPPED, "--zero", "2.5deg")
    (bag,) = (one for one in tmp_path.iterdir() if one.is_dir())
    kept = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]["custom_data"]
    assert kept["imported_from"] == "run.csv"
    assert kept["import_command"] == f"import run.csv {bag.name} --time t:s --theta x:deg --zero 2.5deg"
    assert "hanging at 2.5deg" in kept["import_mapping"]
    assert kept["import_left_out"] == '3 "rest"'
    assert str(tmp_path) not in (bag / "metadata.yaml").read_text()


def test_several_files_become_a_recording_each(tmp_path, capsys):
    paths = [put(tmp_path, "t,x\n" + lines(TIME, k * ANGLE), f"run{k}.csv") for k in (1, 2)]
    assert main([*map(str, paths), str(tmp_path / "bags"), *MAPPED]) == 0
    np.testing.assert_allclose(read(tmp_path / "bags" / "run2").theta, 2 * read(tmp_path / "bags" / "run1").theta,
                               atol=1e-4)
    bad = put(tmp_path, "t,x\n" + NUMBERS + "4.0,x\n4.1,0\n", "bad.csv")
    assert "(1 recording before it is made)" in refused(capsys, paths[0], bad, tmp_path / "more", *MAPPED)
    assert "two files are called run1" in refused(capsys, paths[0], paths[0], tmp_path / "z", *MAPPED)


def test_what_steers_a_terminal_is_never_shown(tmp_path, capsys):
    path = put(tmp_path, "t,x,\x1b[31mred\n" + lines(TIME, ANGLE, ANGLE) + "4.0,\x1b[2J,0\n4.1,0,0\n")
    assert main([str(path)]) == 2
    assert main([str(path), str(tmp_path / "bag"), *MAPPED]) == 2
    assert main([str(path), str(tmp_path / "bag"), *MAPPED, "--skip-bad"]) == 0
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err + (tmp_path / "bag" / "metadata.yaml").read_text()
    assert "\\x1b[31mred" in out
    assert "'\\x1b[2J' is not a number" in err


def test_nothing_is_overwritten_or_left_half_written(tmp_path, capsys):
    path = put(tmp_path, "t,x\n" + NUMBERS)
    (tmp_path / "bag").mkdir()
    assert "is there already" in refused(capsys, path, tmp_path / "bag", *MAPPED)
    assert "is no recording, and is not replaced" in refused(capsys, path, tmp_path / "bag", *MAPPED, "--overwrite")
    assert not list((tmp_path / "bag").iterdir())
    assert main([str(path), str(tmp_path / "made"), *MAPPED]) == 0
    assert "or add --overwrite" in refused(capsys, path, tmp_path / "made", *MAPPED)
    assert main([str(path), str(tmp_path / "made"), *MAPPED, "--overwrite"]) == 0
    assert "is a file: name the recording" in refused(capsys, path, path, *MAPPED)
    assert "cannot be written: Not a directory" in refused(capsys, path, path / "bag", *MAPPED)
    assert "name the recording to make" in refused(capsys, path, *MAPPED)
    assert "no such file" in refused(capsys, tmp_path / "none.csv", tmp_path / "new", *MAPPED)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["bag", "made", "run.csv"]


def test_encode_is_the_inverse_of_decode(bags):
    kind = "sensor_msgs/msg/JointState"
    template = bags.joint(0, [math.nan, math.nan], [math.nan, math.nan])
    values = np.random.default_rng(0).normal(size=(5, 2))
    messages = encode(template, kind, {"position": values, "header.stamp.sec": np.arange(5)})
    (block,), failed = decode(messages, kind)
    assert not failed
    np.testing.assert_array_equal(block.numbers["position"], values)
    np.testing.assert_array_equal(block.numbers["header.stamp.sec"], np.arange(5))
    assert np.isnan(block.numbers["velocity"]).all()
    assert block.names["name"] == ("arm", "rotor")


@pytest.mark.promise("Tables", "A table leads to a verdict")
def test_from_a_german_table_to_a_verdict(tmp_path):
    """A rig of 98 Hz, its CSV as Excel writes it in Germany, up to the report."""
    duty = Excitation(duration=20.0, seed=3).series()
    read_, _ = record(load("bench"), duty, 1)
    every = slice(None, None, 5)
    time = np.arange(len(duty))[every] * 0.00204
    text = "Messung;;\r\nZeit [s];Winkel [°];Tastgrad [%]\r\n" + comma(lines(
        time, np.degrees(read_["theta"])[every], 100.0 * duty[every], split=";", end="\r\n"))
    path = put(tmp_path, text, encoding="cp1252")
    assert main([str(path), str(tmp_path / "bag"), "--accept"]) == 0
    assert diagnose.main([str(tmp_path / "bag"), "--fit-nominal", "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert found["duration_s"] == pytest.approx(time[-1], abs=0.02)
    assert found["channels"]["theta"]["gap_after"] < math.radians(1.0)
    assert (tmp_path / "out" / "report.html").is_file()


def test_what_is_said_of_a_column_goes_before_what_is_guessed(tmp_path, capsys):
    path = put(tmp_path, "t,pot,u\n" + "".join(
        f"{t:.4f},{512.0 + x / 0.264:.0f},{u:.2f}\n" for t, x, u in zip(LONG, DRIVEN, PUSH / 100.0)))
    assert main([str(path), str(tmp_path / "bag"), "--accept"]) == 2
    assert "0.264deg for a potentiometer of 270 degrees" in capsys.readouterr().out
    recording = imported(tmp_path, path, "--accept", "--theta", "pot:0.264deg", "--zero", "512")
    np.testing.assert_allclose(recording.theta, np.radians(DRIVEN), atol=np.radians(0.14))
    np.testing.assert_allclose(recording.duty, PUSH / 100.0, atol=1e-6)


@pytest.fixture
def recorded(bags, tmp_path):
    """A recording of 200 samples."""
    return bags.write(tmp_path / "bag", bags.content(200))


def changed(recorded, *words):
    """The recording before and after an import with these options."""
    assert main([str(recorded), str(recorded.with_name("new")), *words]) == 0
    return read(recorded), read(recorded.with_name("new"))


def test_a_recording_is_imported_with_another_unit_sign_and_place_of_its_channels(recorded):
    before, after = changed(recorded, "--theta", "theta:deg", "--flip", "--current", "v_a:-1mA", "--voltage", "i_a:V")
    np.testing.assert_allclose(after.theta, -np.radians(before.theta), rtol=1e-12)
    np.testing.assert_allclose(after.i_a, -1e-3 * before.v_a, rtol=1e-6)
    for name, same in (("v_a", before.i_a), ("omega", before.omega), ("duty", before.duty), ("t", before.t)):
        np.testing.assert_allclose(getattr(after, name), same, rtol=1e-6, err_msg=name)
    assert after.reference.tolist() == [-0.4]


def test_a_duty_in_percent_becomes_a_fraction(bags, tmp_path):
    duty = np.linspace(0.0, 80.0, 200)
    before = bags.write(tmp_path / "bag", bags.content(200, columns={"duty": duty}))
    assert main([str(before), str(tmp_path / "new"), "--duty", "duty:%"]) == 0
    np.testing.assert_allclose(read(tmp_path / "new").duty, duty / 100.0, rtol=1e-6)


def test_a_recording_is_imported_only_to_change_something(recorded, capsys):
    for words in ([recorded], [recorded, recorded.with_name("new")]):
        assert "is a recording already: name what to change" in refused(capsys, *words)
    assert not recorded.with_name("new").exists()


@pytest.mark.filterwarnings("error")
def test_a_table_with_numbers_that_can_be_no_reading_is_shown(tmp_path, capsys):
    odd = np.where(np.arange(len(TIME)) % 3 > 0, 1.7e308, ANGLE)
    assert main([str(put(tmp_path, lines(TIME, ANGLE, odd, form="{:.4g}")))]) == 2
    shown = capsys.readouterr()
    assert "1.7e+308" in shown.out
    assert len(shown.err.splitlines()) == 1


def test_a_time_whose_rows_fall_together_is_refused(tmp_path, capsys):
    path = put(tmp_path, lines(1e-3 * TIME, ANGLE, form="{:.6f}"))
    said = refused(capsys, path, tmp_path / "bag", "--time", "1:ns", "--theta", "2:deg")
    assert "less than 1 ns from row to row: is the unit of the time right?" in said


def test_a_column_without_numbers_is_named_where_each_cell_can_be_read(tmp_path, capsys):
    path = put(tmp_path, "t;theta;omega\n0,000;0,100;NaN\n")
    said = refused(capsys, path, tmp_path / "bag", "--time", "1:s", "--theta", "2:rad", "--omega", "3:rad/s")
    assert "column 3 (omega) holds hardly any number" in said
