# SPDX-License-Identifier: Apache-2.0
"""Tables of every kind become recordings, or one line that says why not."""

import datetime
import io
import json
import math
import re
import shlex
import zipfile
import zlib

import h5py
import numpy as np
import openpyxl
import pytest
import scipy.io
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from aeropend_ident import diagnose
from aeropend_ident.cdr import decode, encode
from aeropend_ident.import_table import main
from aeropend_ident.recording import read
from aeropend_ident.tables import files
from aeropend_ident.tables.clock import ClockError, date
from aeropend_ident.tables.table import TableError
from aeropend_ident.tables.units import parse
from aeropend_sim.excitation import Excitation
from aeropend_sim.parameters import load
from aeropend_sim.rig import record

RATE = 50.0
TIME = np.arange(200) / RATE
ANGLE = 40.0 * np.exp(-0.1 * TIME) * np.cos(6.0 * TIME)  # deg
DUTY = np.floor(TIME) % 2 * 30.0  # %


def lines(*columns, form="{:.4f}", split=",", end="\n"):
    """Rows of text."""
    return "".join(split.join(form.format(x) for x in row) + end for row in zip(*columns))


def comma(text):
    return text.replace(".", ",")


def put(tmp_path, content, name="run.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


def imported(tmp_path, path, *options):
    """Import, and read the recording."""
    bag = tmp_path / f"bag{len(list(tmp_path.iterdir()))}"
    assert main([str(path), str(bag), *options]) == 0
    return read(bag)


def refused(capsys, *arguments):
    """The one line that is said, and no more."""
    try:
        code = main([str(one) for one in arguments])
    except SystemExit as error:
        code = error.code
    said = capsys.readouterr().err
    assert code == 2
    assert said.startswith("import: ")
    assert said.count("\n") == 1
    return said


# Dialects of text

NUMBERS = lines(TIME, ANGLE)
DIALECTS = {
    "plain": ("t,x\n" + NUMBERS, "utf-8"),
    "no head": (NUMBERS, "utf-8"),
    "semicolons and decimal commas": ("t;x\n" + comma(lines(TIME, ANGLE, split=";")), "utf-8"),
    "tabs": ("t\tx\n" + lines(TIME, ANGLE, split="\t"), "utf-8"),
    "tabs and decimal commas": ("t\tx\n" + comma(lines(TIME, ANGLE, split="\t")), "utf-8"),
    "bars": ("t|x\n" + lines(TIME, ANGLE, split="|"), "utf-8"),
    "columns between blanks": ("  t   x\n" + lines(TIME, ANGLE, form="{:12.4f}", split=" "), "utf-8"),
    "commas and blanks": ("t, x\n" + lines(TIME, ANGLE, split=", "), "utf-8"),
    "BOM": ("t,x\n" + NUMBERS, "utf-8-sig"),
    "UTF-16": ("t,x\n" + NUMBERS, "utf-16"),
    "UTF-16, no BOM": ("t,x\n" + NUMBERS, "utf-16-le"),
    "UTF-16, other order": ("t,x\n" + NUMBERS, "utf-16-be"),
    "Latin-1": ("t [s],Messgröße [°]\n" + NUMBERS, "latin-1"),
    "Windows line ends": ("t,x\r\n" + lines(TIME, ANGLE, end="\r\n"), "utf-8"),
    "old Macintosh line ends": ("t,x\r" + lines(TIME, ANGLE, end="\r"), "utf-8"),
    "quoted": ('"t","x"\n' + lines(TIME, ANGLE, form='"{:.4f}"'), "utf-8"),
    "quoted decimal commas": ('"t","x"\n' + comma(lines(TIME, ANGLE, form='"{:.4f}"', split=";")).replace(";", ","),
                              "utf-8"),
    "comments": ("# rig 7\n% by hand\n// yes\nt,x\n# now\n" + NUMBERS + "# end\n", "utf-8"),
    "names in a comment": ("# t, x\n" + NUMBERS, "utf-8"),
    "line of units": ("t;x\ns;°\n" + comma(lines(TIME, ANGLE, split=";")), "utf-8"),
    "preamble": ("Gerät: A;;\nDatum;3.4.2024;\n\nt;x\n[s];[deg]\n" + comma(lines(TIME, ANGLE, split=";")), "utf-8"),
    "delimiter at the end": ("t,x,\n" + lines(TIME, ANGLE, end=",\n"), "utf-8"),
    "blank lines": ("t,x\n\n" + lines(TIME, ANGLE, end="\n\n"), "utf-8"),
    "exponents": ("t,x\n" + lines(TIME, ANGLE, form="{:.6e}"), "utf-8"),
    "text beside": ("state,t,x\n" + "".join(f"RUN,{line}\n" for line in NUMBERS.splitlines()), "utf-8"),
    "no line end at the end": ("t,x\n" + NUMBERS.rstrip("\n"), "utf-8"),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_dialects(tmp_path, name):
    text, encoding = DIALECTS[name]
    table = files.read(put(tmp_path, text, encoding=encoding))
    k = 1 if name == "text beside" else 0
    np.testing.assert_allclose(table.columns[k].values, TIME, atol=1e-4)
    np.testing.assert_allclose(table.columns[k + 1].values, ANGLE, atol=1e-3)
    assert len(table.columns) == k + 2
    if "no head" not in name:
        assert (table.columns[k].name[0], table.columns[k + 1].name[0]) in (("t", "x"), ("t", "M"))
    if "unit" in name or name in ("Latin-1", "preamble"):
        assert table.columns[0].unit == "s"
        assert parse("theta", table.columns[1].unit).size == pytest.approx(math.radians(1.0))


def test_readings_that_are_not_there(tmp_path):
    rows = [f"{t},{x}" for t, x in zip(TIME, ["", "NaN", "n/a", "-", "inf", "#N/A", "null", *ANGLE[7:]])]
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + "\n".join(rows)), "--time", "t:s", "--theta", "x:deg")
    assert np.flatnonzero(np.isnan(recording.theta)).tolist() == [0, 1, 2, 3, 4, 5, 6]


def test_columns_that_are_left_out_are_named(tmp_path, capsys):
    path = put(tmp_path, "t,x,wind,sun\n" + lines(TIME, ANGLE, ANGLE, TIME))
    imported(tmp_path, path, "--time", "t:s", "--theta", "x:deg")
    assert 'left out: columns 3 "wind", 4 "sun"' in capsys.readouterr().out


def test_a_last_line_that_is_broken_off_is_told(tmp_path, capsys):
    path = put(tmp_path, "t,x,y\n" + lines(TIME, ANGLE, ANGLE) + "4.0,1")
    assert len(imported(tmp_path, path, "--time", "t:s", "--theta", "x:deg")) == len(TIME)
    assert "the last line (202) is broken off" in capsys.readouterr().out


MAPPED = ("--time", "t:s", "--theta", "x:deg")
UNREADABLE = {
    "t,x\n" + NUMBERS + "4.0,1.2.3\n4.1,0\n": "line 202, column 2 (x): '1.2.3' is not a number",
    "t,x\n" + NUMBERS + "4.0,hello\n4.1,0\n": "'hello' is not a number; mend it, or give --skip-bad",
    "t,x\n" + NUMBERS + "4.0,1,2\n4.1,0\n": "line 202 has 3 cells, the others have 2",
    "t;x\n" + comma(lines(TIME, ANGLE, split=";")) + "4,0;1.5\n4,1;0\n": "'1.5' has a decimal point, where others have",
    "t;x\n" + comma(lines(TIME, ANGLE, split=";")) + "4,0;1.234,5\n4,1;0\n": "'1.234,5' marks thousands",
    "t,x\n" + NUMBERS + '4.0,"1,234.5"\n4.1,0\n': "'1,234.5' marks thousands",
    "t;x\n" + "".join(f"{k};1,{k + 100}\n" for k in range(200)): "may have a decimal comma or mark thousands",
    "t,x\n" + comma(NUMBERS): "commas are decimal marks, they cannot split the cells as well",
    "hello\nworld\n" * 20: "no table of numbers",
    "\n\n": "the file is empty",
    "": "the file is empty",
    b"\x00\x01\x02" * 100: "bytes that no text has",
    "t,x\n" + NUMBERS + "1" * 70000 + "\n": "line 202 is longer",
}


@pytest.mark.parametrize("text", UNREADABLE, ids=range(len(UNREADABLE)))
def test_what_cannot_be_read_is_said_in_one_line(tmp_path, capsys, text):
    said = refused(capsys, put(tmp_path, text), tmp_path / "bag", *MAPPED)
    assert UNREADABLE[text] in said
    assert not (tmp_path / "bag").exists()


def test_rows_that_cannot_be_read_are_left_out_on_demand(tmp_path, capsys):
    text = "t,x\n" + NUMBERS.replace("0.2000,", "0.2000,?!", 1).replace("0.4000,", "0.4000,1,", 1)
    recording = imported(tmp_path, put(tmp_path, text), *MAPPED, "--skip-bad")
    assert len(recording) == len(TIME) - 2
    assert recording.lost == 2
    assert "2 rows that cannot be read left out, first: line 12" in capsys.readouterr().out


def test_marks_that_the_file_leaves_open_can_be_told(tmp_path):
    text = "t;x\n" + "".join(f"{k};{1 + k % 3},{k + 100}\n" for k in range(200))
    recording = imported(tmp_path, put(tmp_path, text), "--time", "t:ms", "--theta", "x:rad", "--decimal", ",",
                         "--delimiter", ";")
    np.testing.assert_allclose(recording.theta, [1 + k % 3 + (k + 100) / 1000 for k in range(200)])


# Units and mapping


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


@pytest.mark.parametrize("zero", ["-83deg", "-83", "-1.44862328rad", "end"])
def test_zero_is_what_is_read_when_the_arm_hangs(tmp_path, zero):
    x = np.where(TIME < 2.5, ANGLE, 0.0)
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + lines(TIME, x - 83.0)), *MAPPED, "--zero", zero)
    np.testing.assert_allclose(recording.theta, np.radians(x), atol=1e-4)


def test_flipped_counts(tmp_path):
    x = 512 - np.rint(ANGLE / 360 * 1024)
    recording = imported(tmp_path, put(tmp_path, lines(TIME, x, form="{:.2f}")), "--time", "1:s", "--theta",
                         "2:counts:1024", "--zero", "512", "--flip")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE), atol=math.pi / 1000)


def test_an_encoder_that_passes_the_end_of_its_turn(tmp_path, capsys):
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + lines(TIME, ANGLE % 360.0)), *MAPPED)
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE), atol=1e-4)
    assert "passes the end of its turn" in capsys.readouterr().out


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
    ((*MAPPED, "--accept"), "give one"),
    (("--rate", "-5", "--theta", "x:deg"), "is not a rate"),
    (("--rate", "50", "--theta", "x:deg", "--clock", "even"), "leave it away"),
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


def test_two_columns_of_one_name_go_by_number(tmp_path, capsys):
    path = put(tmp_path, "t,x,x\n" + lines(TIME, ANGLE, -ANGLE))
    assert "may be column 2 \"x\" and 3 \"x\": give its number" in refused(capsys, path, tmp_path / "bag", *MAPPED)
    np.testing.assert_allclose(imported(tmp_path, path, "--time", "t:s", "--theta", "3:deg").theta, np.radians(-ANGLE),
                               atol=1e-4)


# Clocks


def swings(time, seed=0):
    """An arm that swings, in deg, as a 10-bit sensor reads it."""
    noise = np.random.default_rng(seed).normal(size=len(time))
    return 80.0 * np.exp(-0.1 * time) * np.cos(6.0 * time) + 0.2 * noise


def off(true, stamps, **options):
    """By how much rows are dated wrong at most, s, an offset aside; and what is said."""
    found = date(np.asarray(stamps), swings(true), np.arange(1, len(true) + 1), **options)
    measured = found.rows >= 0
    error = found.time[measured] - true[found.rows[measured]]
    assert (np.diff(found.time) > 0.0).all()
    return float(np.abs(error - np.median(error)).max()), found


RATES = st.sampled_from([20.0, 49.0, 120.0, 490.196, 1000.0])


@given(rate=RATES, resolution=st.sampled_from([1e-6, 1e-3, 0.01, 0.046]), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_stamps_that_are_rounded_or_of_polls(rate, resolution, seed):
    true = np.arange(1000) / rate
    phase = np.random.default_rng(seed).random() * resolution
    error, _ = off(true, np.ceil((true + phase) / resolution) * resolution)
    assert error < max(0.03 / rate, 0.01 * resolution)


@given(rate=RATES, late=st.floats(0.05, 1.5), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_stamps_of_arrival_that_are_late_by_chance(rate, late, seed):
    true = np.arange(1500) / rate
    delays = np.random.default_rng(seed).exponential(late / rate, size=len(true))
    assert off(true, np.maximum.accumulate(true + delays))[0] < 0.2 / rate


@given(rate=RATES, rows=st.integers(2, 32), apart=st.sampled_from([0.0, 1e-4]))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_rows_that_come_in_bursts(rate, rows, apart):
    true = np.arange(1500) / rate
    burst = (np.arange(1500) // rows + 1) * rows / rate + apart * (np.arange(1500) % rows)
    error, found = off(true, burst)
    assert error < 0.02 / rate or (apart and rate == 1000.0)
    assert found.measured == 1500


def test_bursts_that_are_true_are_kept():
    """Eight samples 5 ms apart, then a pause of 127 ms, as a loop that stops to print takes them: the angle tells."""
    true = np.concatenate([start + 0.005 * np.arange(8) for start in 0.1625 * np.arange(90)])
    error, found = off(true, np.round(true, 3))
    assert error < 1e-3
    assert "the angle is" in found.notes[0]
    assert "times rougher on an even clock" in found.notes[0]
    assert found.measured == len(true)
    np.testing.assert_allclose(np.diff(found.time), found.period, rtol=1e-6)


def test_rows_that_are_irregular_are_kept_where_they_are():
    true = np.cumsum(np.random.default_rng(1).uniform(0.6, 1.4, 800)) / 50.0
    error, found = off(true, true)
    assert error < 1e-3
    assert found.measured == 800
    assert (found.rows < 0).any()


def test_a_serial_line_that_sets_the_pace():
    """At 9600 baud a row takes as long as it is, and the host polls: neither its stamps nor an even clock are right."""
    lengths = np.array([len(f"{x:.2f}") + 2 for x in swings(np.arange(1500) * 8e-3)])
    true = np.cumsum(lengths) * 1e-3
    stamps = np.ceil(true / 0.046) * 0.046
    error, found = off(true, stamps, lengths=lengths)
    assert error < 0.01
    assert "serial line" in found.notes[0]
    assert off(true, stamps, clock="even")[0] > 0.015


@given(rate=RATES, seed=st.integers(0, 99), resolution=st.sampled_from([0.0, 1e-3]))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_rows_that_are_lost_leave_gaps(rate, seed, resolution):
    true = np.arange(1500) / rate
    kept = np.random.default_rng(seed).random(1500) > 0.01
    kept[:2] = kept[-2:] = True
    stamps = np.round(true / resolution) * resolution if resolution and rate < 900.0 else true
    error, found = off(true[kept], stamps[kept])
    assert error < 0.05 / rate
    assert f"{1500 - kept.sum()} row" in found.notes[-1]


def test_a_pause_is_left_open_in_bursts_too():
    true = np.arange(3000) / 490.0
    kept = (true < 2.0) | (true > 3.5)
    error, found = off(true[kept], (np.ceil(true / 0.046) * 0.046)[kept])
    assert error < 1e-3
    assert "1 gap" in found.notes[-1]


@pytest.mark.parametrize(("stamps", "options"), [
    (lambda t: (t + 60.0) % 65.536, {"tick": 1e-3}),
    (lambda t: (t + 4290.0) % 4294.967296, {"tick": 1e-6}),
    (lambda t: (t + 86390.0) % 86400.0, {"is_clock": True}),
    (lambda t: (t + 50.0) % 60.0, {"is_clock": True}),
])  # fmt: skip
def test_clocks_that_start_anew(stamps, options):
    true = np.arange(1000) / 50.0
    error, found = off(true, stamps(true), **options)
    assert error < 1e-6
    assert "starts anew once" in found.notes[0]


def test_rows_out_of_order_and_repeated():
    true = np.arange(500) / 50.0
    order = np.arange(500)
    order[[100, 101, 300, 301]] = [101, 100, 301, 300]
    error, found = off(true[order], true[order])
    assert error < 1e-9
    assert "2 rows out of order" in found.notes[0]
    twice = np.repeat(true, 2)
    error, found = off(twice, twice, repeats=np.tile([False, True], 500))
    assert error < 1e-9
    assert found.measured == 500
    assert off(true[::-1], true[::-1])[0] < 1e-9


def test_a_clock_that_was_set_back_a_little():
    true = np.arange(1000) / 50.0
    error, found = off(true, np.where(true > 7.0, true - 0.4, true))
    assert error < 1e-6
    assert "set back by 400 ms after line 351" in found.notes[-1]


def test_rows_without_a_time_are_told():
    true = np.arange(300) / 50.0
    found = off(true, np.where(np.arange(300) == 10, np.nan, true))[1]
    assert found.measured == 299
    assert "1 row without a time left out" in found.notes


@pytest.mark.parametrize(("stamps", "options", "says"), [
    (lambda t: np.where(t > 5.0, t - 5.0, t), {}, "time goes back from 5 s to 0.02 s (a restart"),
    (lambda t: t * 0.0, {}, "the same time"),
    (lambda t: t * np.nan, {}, "too few"),
    (np.floor, {"clock": "stamps"}, "leave --clock stamps away"),
    (lambda t: np.random.default_rng(0).permutation(t) / 20.0, {}, "dated"),
])  # fmt: skip
def test_times_that_cannot_be_repaired_are_refused(stamps, options, says):
    with pytest.raises(ClockError, match=re.escape(says)):
        off(np.arange(600) / 50.0, stamps(np.arange(600) / 50.0), **options)


@pytest.mark.parametrize(("cells", "start"), [
    ("12:34:{:06.3f}", 45240.0), ("12:34:{:09.6f}", 45240.0), ("2024-04-03 12:34:{:06.3f}", 1712147640.0),
    ("2024-04-03T12:34:{:06.3f}Z", 1712147640.0), ("3.4.2024 12:34:{:06.3f}", 45240.0),
    ("1:34:{:06.3f} PM", 48840.0), ("34:{:06.3f}", 2040.0),
])  # fmt: skip
def test_times_of_day(tmp_path, cells, start):
    text = "Uhrzeit;x\n" + "".join(f"{cells.format(t)};{x:.3f}\n" for t, x in zip(TIME, ANGLE))
    recording = imported(tmp_path, put(tmp_path, text), "--time", "Uhrzeit", "--theta", "x:deg")
    np.testing.assert_allclose(recording.t, TIME, atol=1e-6)
    assert recording.stamp_ns[0] == pytest.approx(start * 1e9, abs=1e3)


def test_lines_as_the_arduino_ide_stamps_them(tmp_path):
    text = "".join(f"14:57:{t:06.3f} -> {x:.3f},{u:.0f}\n" for t, x, u in zip(TIME, ANGLE, DUTY))
    recording = imported(tmp_path, put(tmp_path, text, "log.txt"), "--time", "1", "--theta", "2:deg", "--duty", "3:%")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE), atol=1e-4)
    np.testing.assert_allclose(recording.t, TIME, atol=1e-6)


def test_a_rate_instead_of_times(tmp_path):
    recording = imported(tmp_path, put(tmp_path, "x\n" + lines(ANGLE)), "--rate", "50", "--theta", "x:deg")
    np.testing.assert_allclose(recording.t, TIME, atol=1e-9)


def test_times_before_zero_and_of_now(tmp_path, capsys):
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + lines(TIME - 1.0, ANGLE)), *MAPPED)
    assert recording.stamp_ns[0] == 0
    assert "time begins at -1 s: shifted" in capsys.readouterr().out
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + lines(TIME + 1.7e9, ANGLE)), *MAPPED)
    assert recording.stamp_ns[0] == pytest.approx(1.7e18, abs=1e3)
    np.testing.assert_allclose(recording.t, TIME, atol=1e-6)
    assert "is the unit of the time right?" in refused(
        capsys, put(tmp_path, "t,x\n" + lines(1e3 * TIME + 1.7e12, ANGLE)), tmp_path / "no", *MAPPED)


# Other files


def workbook(path, rows, title="Data", more=()):
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.title = title
    for row in rows:
        sheet.append(row)
    for name, others in more:
        other = book.create_sheet(name)
        for row in others:
            other.append(row)
    book.save(path)
    return path


def table_rows(*head):
    return [*head, *([float(t), float(x), float(u)] for t, x, u in zip(TIME, ANGLE, DUTY))]


def test_a_workbook(tmp_path):
    head = [["Versuch 3"], [], ["Zeit", "Winkel", "PWM"], ["s", "°", "%"]]
    path = workbook(tmp_path / "run.xlsx", table_rows(*head), more=[("Notes", [["nothing", "here"]])])
    recording = imported(tmp_path, path, "--time", "Zeit", "--theta", "winkel", "--duty", "PWM")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE))
    np.testing.assert_allclose(recording.t, TIME, atol=1e-9)
    np.testing.assert_allclose(recording.duty, DUTY / 100, atol=1e-7)


def test_a_workbook_with_dates(tmp_path):
    begin = datetime.datetime(2024, 4, 3, 12, 34, 40)
    rows = [[begin + datetime.timedelta(seconds=float(t)), float(x)] for t, x in zip(TIME, ANGLE)]
    recording = imported(tmp_path, workbook(tmp_path / "run.xlsx", [["Zeit", "x"], *rows]), "--time", "Zeit", "--theta",
                         "x:deg")
    np.testing.assert_allclose(recording.t, TIME, atol=2e-3)  # Excel keeps ms


def test_workbooks_that_cannot_be_used(tmp_path, capsys):
    two = workbook(tmp_path / "two.xlsx", table_rows(["t", "x", "u"]), more=[("Other", table_rows())])
    assert "several sheets hold tables (Data, Other): choose one with --sheet" in refused(capsys, two, tmp_path / "b",
                                                                                        *MAPPED)
    assert len(imported(tmp_path, two, "--sheet", "Other", "--time", "1:s", "--theta", "2:deg")) == len(TIME)
    said = refused(capsys, two, tmp_path / "b", *MAPPED, "--sheet", "X")
    assert "has no sheet 'X'; its sheets are Data, Other" in said
    none = workbook(tmp_path / "none.xlsx", [["a", "b"], ["c", "d"]])
    assert "no table of numbers" in refused(capsys, none, tmp_path / "b", *MAPPED)
    rows = table_rows(["t", "x", "u"])
    rows[7][1] = "1,5"
    german = workbook(tmp_path / "german.xlsx", rows)
    assert "row 8, column 2 (x): '1,5' is text with a decimal comma" in refused(capsys, german, tmp_path / "b", *MAPPED)
    rows[7][1] = datetime.datetime(2024, 1, 5)
    dated = workbook(tmp_path / "dated.xlsx", rows)
    assert "is a date or time, others are not" in refused(capsys, dated, tmp_path / "b", *MAPPED)
    (tmp_path / "old.xls").write_bytes(b"\xd0\xcf\x11\xe0" + bytes(200))
    assert "old Excel file" in refused(capsys, tmp_path / "old.xls", tmp_path / "b", *MAPPED)


def test_what_would_fill_the_memory_is_refused(tmp_path, capsys):
    with zipfile.ZipFile(tmp_path / "bomb.xlsx", "w") as archive:
        archive.writestr("xl/worksheets/sheet1.xml", "")
        archive.infolist()[0].file_size = 600 << 20
    assert "would take 600 MiB unpacked" in refused(capsys, tmp_path / "bomb.xlsx", tmp_path / "b", *MAPPED)
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w") as archive:
        archive.writestr("t.npy", head.getvalue())
    assert "shorter than it says" in refused(capsys, tmp_path / "bomb.npz", tmp_path / "b", *MAPPED)
    packed = zlib.compress(bytes(32 << 20), 1)
    element = (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little") + packed
    (tmp_path / "bomb.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + 17 * element)
    assert "more than 512 MiB unpacked" in refused(capsys, tmp_path / "bomb.mat", tmp_path / "b", *MAPPED)
    (tmp_path / "wide.csv").write_text(lines(*np.ones((1100, 5)), form="{:.0f}"))
    assert "more than 1000" in refused(capsys, tmp_path / "wide.csv", tmp_path / "b", "--time", "1:s")


def test_matlab_files(tmp_path, capsys):
    scipy.io.savemat(tmp_path / "run.mat", {"t": TIME, "log": {"angle": ANGLE[:, None], "note": "hello"}, "k": 3.0,
                                            "both": np.stack((TIME, ANGLE)), "short": TIME[:50]})
    recording = imported(tmp_path, tmp_path / "run.mat", "--time", "t:s", "--theta", "log.angle:deg")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE))
    said = capsys.readouterr().out
    assert "short (50)" in said
    assert "left out: log.note" in said
    recording = imported(tmp_path, tmp_path / "run.mat", "--time", "both[1]:s", "--theta", "both[2]:deg")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE))
    with h5py.File(tmp_path / "new.mat", "w", userblock_size=512) as file:
        file["t"], file["log/angle"] = TIME[None, :], ANGLE[None, :]
        file["out"] = h5py.ExternalLink("/etc/passwd", "/")
    with (tmp_path / "new.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    recording = imported(tmp_path, tmp_path / "new.mat", "--time", "t:s", "--theta", "log.angle:deg")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE))


def test_numpy_files(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.stack((TIME, ANGLE), axis=1))
    np.savez(tmp_path / "b.npz", t=TIME, x=ANGLE.astype(np.float32), name=np.array("rig"))
    np.save(tmp_path / "c.npy", np.rec.fromarrays([TIME, ANGLE], names="t,x"))
    for name, options in (("a.npy", ("--time", "1:s", "--theta", "2:deg")), ("b.npz", MAPPED), ("c.npy", MAPPED)):
        recording = imported(tmp_path, tmp_path / name, *options)
        np.testing.assert_allclose(recording.theta, np.radians(ANGLE), rtol=1e-6)
    np.save(tmp_path / "d.npy", np.array([{"t": 1}, 2]), allow_pickle=True)
    assert "holds Python objects" in refused(capsys, tmp_path / "d.npy", tmp_path / "b", *MAPPED)


SEEDS = {}


def seed(name):
    """The bytes of a small file of each kind."""
    if name not in SEEDS:
        file = io.BytesIO()
        if name == "xlsx":
            workbook(file, table_rows(["t", "x", "u"])[:30])
        elif name == "npy":
            np.save(file, np.stack((TIME, ANGLE), axis=1))
        elif name == "npz":
            np.savez(file, t=TIME, x=ANGLE)
        else:
            file.write(("t;x\n" + comma(lines(TIME[:30], ANGLE[:30], split=";"))).encode("utf-16"))
        SEEDS[name] = file.getvalue()
    return SEEDS[name]


@given(name=st.sampled_from(["xlsx", "npy", "npz", "text"]), damage=st.lists(
    st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=8),
    end=st.floats(0.1, 1.0))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path_factory, name, damage, end):
    raw = bytearray(seed(name))
    for place, byte in damage:
        raw[int(place * len(raw))] = byte
    path = tmp_path_factory.mktemp("damaged") / "file"
    path.write_bytes(raw[: int(end * len(raw))])
    try:
        said = f"{len(files.read(path).columns)} columns"
    except TableError as error:
        said = str(error)
    assert said
    assert "\n" not in said


def test_a_matlab_file_that_crashes_its_reader_is_refused(tmp_path, capsys):
    scipy.io.savemat(tmp_path / "run.mat", {"t": TIME, "s": {"a": ANGLE}})
    raw = bytearray((tmp_path / "run.mat").read_bytes())
    for k in range(128, len(raw), 97):
        raw[k] ^= 0x5A
    (tmp_path / "run.mat").write_bytes(raw)
    assert "cannot be read as a MATLAB file" in refused(capsys, tmp_path / "run.mat", tmp_path / "b", *MAPPED)


# Proposals


def proposed(capsys, path):
    """The command that is proposed for a file."""
    assert main([str(path)]) == 2
    out, err = capsys.readouterr()
    assert "--accept" in err
    (command,) = (line for line in out.splitlines() if line.startswith("  import "))
    return shlex.split(command)[1:], out


@pytest.mark.parametrize("head", [
    "t [s],theta [deg],pwm [%]", "Zeit / s,Winkel / °,Tastgrad / %", "tiempo,ángulo,ciclo", "temps (s),angle (°),pwm",
    "время,угол,ШИМ", "时间,角度,占空比", "time_s,angle_deg,duty_pct",
])  # fmt: skip
def test_what_is_obvious_is_proposed_and_works_as_it_stands(tmp_path, capsys, head):
    path = put(tmp_path, head + "\n" + lines(TIME, ANGLE, DUTY))
    command, out = proposed(capsys, path)
    assert "0.0000  0.0200  0.0400" in out
    assert not (tmp_path / "bag").exists()
    command[1] = str(tmp_path / "bag")
    assert main(command) == 0
    recording = read(tmp_path / "bag")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE), atol=1e-4)
    np.testing.assert_allclose(recording.duty, DUTY / 100, atol=1e-7)
    assert main([str(path), str(tmp_path / "same"), "--accept"]) == 0
    np.testing.assert_array_equal(read(tmp_path / "same").theta, recording.theta)


def test_a_proposal_for_columns_without_names(tmp_path, capsys):
    command, _ = proposed(capsys, put(tmp_path, lines(1e3 * TIME + 5000, ANGLE, form="{:.0f}")))
    assert command[2:] == ["--time", "1:ms", "--theta", "2:deg"]
    text = "".join(f"12:00:{t:06.3f};{x:.1f}\n" for t, x in zip(TIME, ANGLE))
    assert proposed(capsys, put(tmp_path, text))[0][2:] == ["--time", "1", "--theta", "2:deg"]


@pytest.mark.parametrize(("text", "says"), [
    ("t,angle 1,angle 2\n" + lines(TIME, ANGLE, ANGLE), "perhaps --theta 'angle 2:deg' (one of 2 such columns)"),
    ("t,angle\n" + lines(TIME, ANGLE / 57.3), "rad or deg?"),
    ("t,angle,speed\n" + lines(TIME, ANGLE, ANGLE), "perhaps --omega speed:UNIT (its name; rad/s or rpm?)"),
    ("t,angle,pwm\n" + lines(TIME, ANGLE, 5 * DUTY, form="{:.0f}"), "perhaps --duty pwm:counts:255"),
])  # fmt: skip
def test_what_is_not_obvious_is_not_accepted(tmp_path, capsys, text, says):
    assert main([str(put(tmp_path, text)), str(tmp_path / "bag"), "--accept"]) == 2
    out, err = capsys.readouterr()
    assert says in out
    assert "which is not clear" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "bag").exists()


def test_a_table_of_steady_states_is_no_recording(tmp_path, capsys):
    text = "".join(f"{2.4 + 0.15 * k:.2f}\t{0.05 + 0.01 * k:.4f}\n" for k in range(17))
    assert "bench_test takes it" in refused(capsys, put(tmp_path, text))


# The recording


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
    assert not list((tmp_path / "bag").iterdir())
    assert "is a file: name the recording" in refused(capsys, path, path, *MAPPED)
    assert "cannot be written: Not a directory" in refused(capsys, path, path / "bag", *MAPPED)
    assert "name the recording to make" in refused(capsys, path, *MAPPED)
    assert "no such file" in refused(capsys, tmp_path / "none.csv", tmp_path / "new", *MAPPED)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["bag", "run.csv"]


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
