# SPDX-License-Identifier: Apache-2.0
"""Rows are dated as they were measured, whatever clock stamped them."""

import re

import numpy as np
import pytest
from arm_tables import ANGLE, DUTY, MAPPED, TIME, imported, lines, put, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from aeropend_ident.tables.clock import ClockError, date


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


@pytest.mark.promise(
    "Tables", "Time stamps that are late, rounded, repeated or out of order are repaired, and the repairs are listed")
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


@pytest.mark.promise(
    "Tables", "Time stamps that are late, rounded, repeated or out of order are repaired, and the repairs are listed")
@given(rate=RATES, rows=st.integers(2, 32), apart=st.sampled_from([0.0, 1e-4]))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_rows_that_come_in_bursts(rate, rows, apart):
    true = np.arange(1500) / rate
    burst = (np.arange(1500) // rows + 1) * rows / rate + apart * (np.arange(1500) % rows)
    error, found = off(true, burst)
    assert error < 0.02 / rate or (apart and rate == 1000.0)
    assert found.measured == 1500


def test_bursts_that_are_true_are_kept():
    """Eight samples 5 ms apart, then a pause of 127 ms, as of a loop that stops to print: the angle shows it."""
    true = np.concatenate([start + 0.005 * np.arange(8) for start in 0.1625 * np.arange(90)])
    error, found = off(true, np.round(true, 3))
    assert error < 1e-3
    assert "the angle is" in found.notes[0]
    assert "times rougher on an even clock" in found.notes[0]
    assert found.measured == len(true)
    np.testing.assert_allclose(np.diff(found.time), found.period, rtol=1e-6)


@pytest.mark.promise("Tables", "No reading is invented: rows that are lost leave gaps")
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


@pytest.mark.promise("Tables", "No reading is invented: rows that are lost leave gaps")
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
    assert "restarts once" in found.notes[0]


@pytest.mark.promise(
    "Tables", "Time stamps that are late, rounded, repeated or out of order are repaired, and the repairs are listed")
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


@pytest.mark.promise(
    "Tables", "Time stamps that are late, rounded, repeated or out of order are repaired, and the repairs are listed")
@pytest.mark.parametrize(("stamps", "options", "says"), [
    (lambda t: np.where(t > 5.0, t - 5.0, t), {}, "time goes back from 5 s to 0.02 s (a restart"),
    (lambda t: np.where(t > 5.0, t - 86400.0, t), {}, "leave out --time and give --rate HZ"),
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
