# SPDX-License-Identifier: Apache-2.0
"""A board, and a calibration file, that are out to harm. `FUZZ=100` tries a hundred times as much."""

import math
import os
import tempfile
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aeropend_bridge.calibration import Calibration, default, load
from aeropend_bridge.clock import BUCKETS, BoardClock
from aeropend_bridge.protocol import TICK_NS, Sample

FUZZ = int(os.environ.get("FUZZ", "1"))

COUNTS = st.builds(Sample, st.integers(0, 255), st.integers(0, 2**32 - 1), st.integers(0, 255), st.integers(0, 1023),
                   st.integers(0, 1023), st.integers(-512, 511), st.integers(0, 2**32 - 1), st.integers(0, 2**11 - 1))


def settled(examples):
    return settings(max_examples=examples * FUZZ, deadline=None, derandomize=True, database=None)


@settled(200)
@given(COUNTS)
def test_what_the_converters_can_give_becomes_numbers(sample):
    theta, *others = default().measured(sample)
    assert all(math.isfinite(value) for value in others)
    assert math.isnan(theta) or abs(theta) <= math.pi + 1e-9


@settled(100)
@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 10**9)), min_size=1, max_size=400))
@example([(k * 2**31 % 2**32, 2_040_000) for k in range(400)])
@example([(200_000, 0), (0, 0), (200_000, 0), (0, 0), (400_000, 0)])  # a clock that goes back, twice to one time
def test_whatever_a_board_says_of_its_clock_stamps_rise(jumps):
    clock, arrival, stamps = BoardClock(TICK_NS), 10**18, []
    for ticks, later in jumps:
        arrival += later
        board = clock.extend(ticks)
        clock.add(board, arrival)
        assert len(clock._buckets) <= BUCKETS
        assert math.isfinite(clock.early_ns(board, arrival))
        if clock.settled:
            stamps.append(clock.host_ns(board))
    assert all(before < after for before, after in pairwise(stamps))
    assert all(0 < stamp < 2**63 for stamp in stamps)


FILES = st.one_of(
    st.binary(max_size=200),
    st.tuples(st.sampled_from(["latency", "current_zero", "pulses_per_rev", "no", "\x1b[2J"]), st.one_of(
        st.sampled_from(["9" * 400, "1" + "0" * 5000, "!!int x", "!!timestamp x", "2001-99-99", "[1]", "{a: 1}", ".nan",
                         "~", "&a [*a]", "\"\\x1b[31m\""]),
        st.floats().map(repr), st.text(max_size=10))).map(
        lambda pair: f"/**:\n  ros__parameters:\n    calibration: {{{pair[0]!r}: {pair[1]}}}".encode(
            "utf-8", "surrogatepass")),
    st.sampled_from([b"[" * 100_000, b"{a: " * 100_000, b"a: &a [*a]", b"? [a]\n: b"]))


@settled(200)
@given(FILES)
def test_any_calibration_file_is_one_or_one_line(data):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rig.yaml"
        path.write_bytes(data)
        try:
            assert isinstance(load(path), Calibration)
        except ValueError as error:
            said = str(error)
        else:
            return
        assert said.startswith(f"{path}: ")
        assert said.isprintable()


def test_a_number_beyond_all_floats_is_one_line(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text("/**:\n  ros__parameters:\n    calibration: {latency: 1" + "0" * 400 + "}\n")
    with pytest.raises(ValueError, match=r"latency is 1000.*give a number"):
        load(path)
