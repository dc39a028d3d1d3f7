# SPDX-License-Identifier: Apache-2.0
"""Columns become quantities of the rig in SI."""

import math

import numpy as np
import pytest
from arm_tables import ANGLE, DUTY, MAPPED, NUMBERS, TIME, imported, lines, put, refused

from aeropend_ident.tables.units import parse


@pytest.mark.promise("Tables", "Units, signs, zeros and counts are converted")
@pytest.mark.parametrize(("quantity", "unit", "of_one"), [
    ("theta", "deg", math.radians(1.0)), ("theta", "rad", 1.0), ("theta", "turn", 2 * math.pi),
    ("theta", "°", math.radians(1.0)), ("theta", "Grad", math.radians(1.0)), ("theta", "54deg", math.radians(54.0)),
    ("theta", "counts:1024", 2 * math.pi / 1024), ("omega", "rpm", 2 * math.pi / 60), ("omega", "U/min", math.pi / 30),
    ("omega", "1/min", math.pi / 30), ("omega", "Hz", 2 * math.pi), ("omega", "rad/s", 1.0),
    ("omega", "0.5rpm", math.pi / 60), ("duty", "%", 0.01), ("duty", "1", 1.0), ("duty", "counts:255", 1 / 255),
    ("current", "mA", 1e-3), ("current", "A", 1.0), ("current", "-4.9mA", -4.9e-3), ("voltage", "mV", 1e-3),
    ("voltage", "V", 1.0), ("time", "ms", 1e-3), ("time", "us", 1e-6), ("time", "s", 1.0), ("time", "min", 60.0),
])  # fmt: skip
def test_units(quantity, unit, of_one):
    assert parse(quantity, unit).size == pytest.approx(of_one)


@pytest.mark.promise("Tables", "Units, signs, zeros and counts are converted")
def test_every_quantity_arrives_in_si(tmp_path):
    text = "t [ms],Winkel,pwm,n,I,U,soll\n" + lines(1e3 * TIME, ANGLE, 255 * DUTY / 100, 900 + ANGLE, 10 * ANGLE,
                                                    ANGLE, 0 * TIME + 20, form="{:.9f}")
    recording = imported(tmp_path, put(tmp_path, text), "--time", "t", "--theta", "winkel:deg", "--duty",
                         "pwm:counts:255", "--omega", "n:rpm", "--current", "I:mA", "--voltage", "6:V",
                         "--reference", "soll:deg")
    np.testing.assert_allclose(recording.t, TIME, atol=1e-9)
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE), atol=1e-9)
    np.testing.assert_allclose(recording.duty, DUTY / 100, atol=1e-7)
    np.testing.assert_allclose(recording.omega, (900 + ANGLE) * math.pi / 30, rtol=1e-9)
    np.testing.assert_allclose(recording.i_a, ANGLE / 100, atol=1e-6)
    np.testing.assert_allclose(recording.v_a, ANGLE, atol=1e-5)
    np.testing.assert_allclose(recording.reference, [math.radians(20.0)])
    np.testing.assert_allclose(recording.command, [0.0, 0.3, 0.0, 0.3], atol=1e-7)
    assert recording.notes == ()
    assert recording.complete


def test_pulses_of_a_servo(tmp_path):
    text = "t,x,esc\n" + lines(TIME, ANGLE, 1000 + 10 * DUTY)
    recording = imported(tmp_path, put(tmp_path, text), *MAPPED, "--duty", "esc:counts:1000..2000")
    np.testing.assert_allclose(recording.duty, DUTY / 100, atol=1e-7)


@pytest.mark.promise("Tables", "Units, signs, zeros and counts are converted")
@pytest.mark.parametrize("zero", ["-83deg", "-83", "-1.44862328rad", "end"])
def test_zero_is_what_is_read_when_the_arm_hangs(tmp_path, zero):
    x = np.where(TIME < 2.5, ANGLE, 0.0)
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + lines(TIME, x - 83.0)), *MAPPED, "--zero", zero)
    np.testing.assert_allclose(recording.theta, np.radians(x), atol=1e-4)


@pytest.mark.promise("Tables", "Units, signs, zeros and counts are converted")
def test_flipped_counts(tmp_path):
    x = 512 - np.rint(ANGLE / 360 * 1024)
    recording = imported(tmp_path, put(tmp_path, lines(TIME, x, form="{:.2f}")), "--time", "1:s", "--theta",
                         "2:counts:1024", "--zero", "512", "--flip")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE), atol=math.pi / 1000)


def test_an_encoder_that_passes_the_end_of_its_turn(tmp_path, capsys):
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + lines(TIME, ANGLE % 360.0)), *MAPPED)
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE), atol=1e-4)
    assert "passes the end of its turn" in capsys.readouterr().out


@pytest.mark.promise("Tables", "A command in volts is a share of the supply, or the voltage itself")
def test_a_command_in_volts(tmp_path, capsys):
    path = put(tmp_path, "t,x,u [V]\n" + lines(TIME, ANGLE, DUTY / 100 * 12.0))
    assert "needs the voltage of the supply" in refused(capsys, path, tmp_path / "bag", *MAPPED, "--duty", "u")
    for option, supply in (("u", "12V"), ("u:V", "12"), ("u [V]:1000mV", "12000mV")):
        recording = imported(tmp_path, path, *MAPPED, "--duty", option, "--supply", supply)
        np.testing.assert_allclose(recording.duty, DUTY / 100, atol=1e-5)
    assert "--supply 'x': give its voltage" in refused(capsys, path, tmp_path / "bag", *MAPPED, "--duty", "u",
                                                       "--supply", "x")
    assert "for a command in volts" in refused(capsys, path, tmp_path / "bag", *MAPPED, "--supply", "12V")


@pytest.mark.promise("Tables", "A command that goes both ways is refused until it is said what it does")
def test_a_command_that_goes_both_ways(tmp_path, capsys):
    path = put(tmp_path, "t,x,u\n" + lines(TIME, ANGLE, DUTY - 10.0))
    said = refused(capsys, path, tmp_path / "bag", *MAPPED, "--duty", "u:%")
    assert "does it reverse the motor in 100 rows of 200 (--both-ways reverse), brake it (brake)" in said
    recording = imported(tmp_path, path, *MAPPED, "--duty", "u:%", "--both-ways", "clip")
    np.testing.assert_allclose(recording.duty, np.maximum(DUTY - 10.0, 0.0) / 100, atol=1e-7)
    assert "duty: 100 rows of 200 below 0, down to -10 %, set to 0 (as you say)" in capsys.readouterr().out


@pytest.mark.promise("Tables", "A command that reverses the motor keeps its sign")
def test_a_command_that_reverses_the_motor(tmp_path, capsys):
    path = put(tmp_path, "t,x,u\n" + lines(TIME, ANGLE, DUTY - 10.0))
    recording = imported(tmp_path, path, *MAPPED, "--duty", "u:%", "--both-ways", "reverse")
    np.testing.assert_allclose(recording.duty, (DUTY - 10.0) / 100, atol=1e-7)
    assert "duty: 100 rows of 200 below 0, down to -10 %: they reverse the motor" in capsys.readouterr().out
    path = put(tmp_path, "t,x,u\n" + lines(TIME, ANGLE, DUTY - 110.0))
    assert "outside -100..100 %: is its unit right?" in refused(
        capsys, path, tmp_path / "other", *MAPPED, "--duty", "u:%", "--both-ways", "reverse")


def test_days_since_long_ago(tmp_path):
    path = put(tmp_path, "t,x\n" + "".join(f"{739000.25 + t / 86400.0:.10f},{x:.4f}\n" for t, x in zip(TIME, ANGLE)))
    recording = imported(tmp_path, path, "--time", "t:day", "--theta", "x:deg")
    np.testing.assert_allclose(recording.t - recording.t[0], TIME, atol=1e-4)


def test_a_motor_that_was_off(tmp_path):
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + NUMBERS), *MAPPED, "--motor-off")
    assert not recording.duty.any()
    assert recording.command.tolist() == [0.0]


def test_what_was_not_measured_is_not_there(tmp_path):
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + NUMBERS), *MAPPED)
    assert recording.channels == ("theta",)
    assert len(recording.command) == 0


@pytest.mark.parametrize(("options", "says"), [
    (("--theta", "x:deg"), "no time: give --time COLUMN, or --rate HZ"),
    (("--time", "t:s"), "give --theta at least"),
    (("--time", "t:s", "--theta", "y:deg"), 'no such column; its columns are 1 "t", 2 "x", 3 "pwm"'),
    (("--time", "t:s", "--theta", "4:deg"), "no such column"),
    (("--time", "t:s", "--theta", "x"), "say the unit of column 2 \"x\", as in --theta 'x:deg'"),
    (("--time", "t:s", "--theta", "x:volt"), "'volt' is no unit of theta: give deg, rad"),
    (("--time", "t:s", "--theta", "x:counts:0"), "those of a full turn"),
    (("--time", "t:s", "--theta", "x:0deg"), "is no unit"),
    (("--time", "t:clock", "--theta", "x:deg"), "holds no times of day"),
    (("--time", "t:s", "--theta", "t:deg"), "is given as time and as theta"),
    ((*MAPPED, "--duty", "pwm:1"), "goes to 30, outside 0..100 %: is its unit right?"),
    (("--time", "t:s", "--theta", "pwm:deg", "--duty", "x:%"), "as a duty in % goes to -"),
    ((*MAPPED, "--duty", "pwm:counts:5..5"), "of none and full"),
    ((*MAPPED, "--zero", "down"), "give a reading, as in --zero -83deg"),
    ((*MAPPED, "--zero", "3apples"), "'apples' is no unit"),
    ((*MAPPED, "--zero", "start"), "the arm moves by"),
    ((*MAPPED, "--rate", "50"), "contradict each other"),
    ((*MAPPED, "--motor-off", "--duty", "pwm:%"), "contradict each other"),
    (("--rate", "-5", "--theta", "x:deg"), "is not a rate"),
    (("--rate", "50", "--theta", "x:deg", "--clock", "even"), "omit it"),
    ((*MAPPED, "--delimiter", "ab"), "cannot split cells"),
    ((*MAPPED, "--sheet", "One"), "is no workbook"),
    ((*MAPPED, "--nonsense"), "unrecognized arguments"),
])  # fmt: skip
def test_what_cannot_be_mapped_is_said_in_one_line(tmp_path, capsys, options, says):
    path = put(tmp_path, "t,x,pwm\n" + lines(TIME, ANGLE, DUTY))
    assert says in refused(capsys, path, tmp_path / "bag", *options)
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(("options", "says"), [
    (("--time", "t:ms", "--theta", "x:deg"), "time: you say ms, the file says s"),
    (("--time", "t:us", "--theta", "x:deg"), "rows a second: is the unit of the time right?"),
    (("--time", "t:s", "--theta", "x:turn"), "theta goes round more than twice"),
    (("--time", "t:min", "--theta", "x:deg"), "rows a second are few"),
])  # fmt: skip
def test_what_is_doubtful_is_told(tmp_path, capsys, options, says):
    imported(tmp_path, put(tmp_path, "t [s],x\n" + NUMBERS), *options)
    assert says in capsys.readouterr().out


@pytest.mark.parametrize(("quantity", "unit"), [("theta", "turn"), ("omega", "Hz"), ("voltage", "V"), ("current", "A"),
                                                ("reference", "deg")])
def test_numbers_that_are_no_readings_are_left_out_and_counted(tmp_path, capsys, quantity, unit):
    wrong = np.isin(np.arange(len(TIME)), [40, 41, 120])
    path = put(tmp_path, "t,x,y\n" + lines(TIME, ANGLE / 360.0, np.where(wrong, 1.7e308, 1.0), form="{:.6g}"))
    angle = () if quantity == "theta" else ("--theta", "x:turn")
    recording = imported(tmp_path, path, "--time", "t:s", *angle, f"--{quantity}", f"y:{unit}")
    said = capsys.readouterr().out
    assert "note: 3 readings of " in said
    assert "are no possible number (first " in said
    assert "inf" not in said.replace("(first inf", "")
    read = getattr(recording, {"voltage": "v_a", "current": "i_a"}.get(quantity, quantity))
    assert np.abs(read[np.isfinite(read)]).max() < 10.0
    assert quantity == "reference" or np.flatnonzero(np.isnan(read)).tolist() == [40, 41, 120]


def test_a_table_without_a_possible_reading_is_refused(tmp_path, capsys):
    path = put(tmp_path, "t,x\n" + lines(TIME, ANGLE * 0.0 + 1e300, form="{:.6g}"))
    assert "no reading is left: 200 readings of theta are no possible number" in refused(
        capsys, path, tmp_path / "bag", *MAPPED)
    assert not (tmp_path / "bag").exists()


def test_two_columns_of_one_name_go_by_number(tmp_path, capsys):
    path = put(tmp_path, "t,x,x\n" + lines(TIME, ANGLE, -ANGLE))
    assert "may be column 2 \"x\" and 3 \"x\": give its number" in refused(capsys, path, tmp_path / "bag", *MAPPED)
    np.testing.assert_allclose(imported(tmp_path, path, "--time", "t:s", "--theta", "3:deg").theta, np.radians(-ANGLE),
                               atol=1e-4)
