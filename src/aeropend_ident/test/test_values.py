# SPDX-License-Identifier: Apache-2.0
"""Whatever numbers, stamps and names a whole bag holds: a result or one line, never a traceback or a numpy warning.

`FUZZ=100` tries a hundred times as much, with the commands that take seconds.
"""

import io
import math
import os
import shutil
import tempfile
import warnings
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aeropend_ident.bags.cdr import encode
from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.commands import bench, diagnose, doctor, excitation_quality, identify, recover, step_response
from aeropend_ident.commands.import_table import main as import_
from aeropend_ident.nodes.replay import Plan
from aeropend_ident.testing.rigs import drawn_rig, steps
from aeropend_sim.model import rig

FUZZ = int(os.environ.get("FUZZ", "1"))
JOINT, BATTERY, FLOAT = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Float64"
CHANNELS = ("theta", "omega", "i_a", "v_a", "duty")
START, PERIOD = 1_700_000_000_000_000_000, 2_040_000
DURATION = 6.0

NUMBERS = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, -1e-310, 1e-38, 1e300, -1e300, 3.4e38, 1e19, 1e6,
                     -1e6, 1e4, -1e4, 999.9, 55.0, 1.7, 1.0000001, -0.5, -1.0, 1.0, 0.999]),
    st.floats(width=32), st.floats(-2.0, 2.0))
SECONDS = st.sampled_from([-2**31, -86_400, -1, 0, 1, 1_699_913_600, 1_700_086_400, 2**31 - 1])
NANOSECONDS = st.sampled_from([0, 999_999_999, 10**9, 1_500_000_000, 2**31, 2**32 - 1])
ROWS = st.one_of(st.tuples(st.integers(0, 10**6), st.sampled_from([1, 2, 7])),  # where, how many
                 st.tuples(st.sampled_from([0, 1000, 10**6]), st.sampled_from([300, 2000, 10**6])))
NAMES = st.lists(st.sampled_from(["arm", "rotor", "Arm", "плечо", "臂", "", "\u202earm", "x" * 300]), max_size=4)
ARRAYS = st.lists(st.sampled_from([0.3, -40.0, math.nan, math.inf, 1e300]), max_size=4)
EDITS = st.lists(st.one_of(
    st.tuples(st.just("set"), ROWS, st.sampled_from(CHANNELS), NUMBERS),
    st.tuples(st.just("scale"), ROWS, st.sampled_from(CHANNELS),
              st.sampled_from([-1.0, 0.0, 180.0 / math.pi, 100.0, 255.0, 1e3, 9.55, 1e-3, 1e-20, 1e200])),
    st.tuples(st.just("shift"), ROWS, st.sampled_from(CHANNELS), st.sampled_from([math.pi, -1.6, 0.4, 1e3, -0.2])),
    st.tuples(st.just("swap"), st.just((0, 10**6)), st.sampled_from(CHANNELS), st.sampled_from(CHANNELS)),
    st.tuples(st.just("sec"), ROWS, st.just("both"), SECONDS),
    st.tuples(st.just("nanosec"), ROWS, st.sampled_from(["both", "joints", "armature"]), NANOSECONDS),
    st.tuples(st.just("clock"), ROWS, st.sampled_from(["stamps", "receipt", "all"]),
              st.sampled_from([-86_400, -5, 3, 86_400, 2 * 10**8])),
    st.tuples(st.just("joints"), ROWS, NAMES, st.tuples(ARRAYS, ARRAYS)),
    st.tuples(st.just("command"), ROWS, st.sampled_from(["/duty_command", "/reference"]), NUMBERS),
    st.tuples(st.just("drop"), ROWS, st.sampled_from(["/joint_states", "/armature"]), st.just(0)),
), min_size=1, max_size=4)


@pytest.fixture(scope="module")
def columns():
    duty = steps(DURATION, 3)
    return {**rig.record(drawn_rig(3, {}), duty, 3)[0], "duty": duty}


def written(bags, folder, columns, edits):
    """A recording with these edits."""
    count = len(columns["duty"])
    c = {name: x.copy() for name, x in columns.items()}
    stamps = START + PERIOD * np.arange(count)
    received = stamps + 300_000
    parts = {topic: list(np.divmod(stamps, 10**9)) for topic in ("joints", "armature")}
    odd, dropped, commands = {}, {"/joint_states": set(), "/armature": set()}, [(200, "/reference", 0.3)]
    for what, (first, many), where, value in edits:
        rows = np.arange(first % count, min(first % count + many, count))
        if what == "set":
            c[where][rows] = value
        elif what == "scale":
            c[where][rows] *= value
        elif what == "shift":
            c[where][rows] += value
        elif what == "swap":
            c[where], c[value] = c[value].copy(), c[where].copy()
        elif what in ("sec", "nanosec"):
            for topic in parts if where == "both" else [where]:
                parts[topic][what == "nanosec"][rows] = value
        elif what == "clock":
            for topic in parts if where != "receipt" else []:
                parts[topic][0][rows] += value
            received[rows] += value * 10**9 if where != "stamps" else 0
        elif what == "joints":
            odd |= {int(row): (where, *value) for row in rows}
        elif what == "command":
            commands.append((int(rows[0]), where, value))
        else:
            dropped[where] |= set(rows.tolist())
    nothing = np.full(count, np.nan)
    with np.errstate(all="ignore"):
        joints = encode(bags.joint(0, [0.0, 0.0], [0.0, 0.0]), JOINT, {
            "header.stamp.sec": np.clip(parts["joints"][0], -2**31, 2**31 - 1),
            "header.stamp.nanosec": parts["joints"][1],
            "position": np.stack((c["theta"], nothing), axis=1), "velocity": np.stack((nothing, c["omega"]), axis=1)})
        armatures = encode(bags.battery(0, 0.0, 0.0, 0.0), BATTERY, {
            "header.stamp.sec": np.clip(parts["armature"][0], -2**31, 2**31 - 1),
            "header.stamp.nanosec": parts["armature"][1],
            **{field: c[name].astype(np.float32) for field, name in (("voltage", "v_a"), ("current", "i_a"),
                                                                     ("percentage", "duty"))}})
    for row, (names, position, velocity) in odd.items():
        joints[row] = bags.joint(0, position, velocity, names)[:4] + joints[row][4:12] + bags.joint(
            0, position, velocity, names)[12:]
    received = np.clip(received, 0, 2**63 - 10**9)
    messages = []
    for row in range(count):
        for topic, kind, raw in (("/joint_states", JOINT, joints[row]), ("/armature", BATTERY, armatures[row])):
            if row not in dropped[topic]:
                messages.append((topic, kind, int(received[row]), raw))
    messages += [(topic, FLOAT, int(received[row]), bags.number(value)) for row, topic, value in commands]
    return bags.write(folder / "bag", bags.Content(messages))


def commands_over(bag, folder):
    """Each command that reads a recording, with its arguments."""
    yield doctor.main, [bag]
    yield step_response.main, [bag, "--plot", folder / "steps.svg"]
    yield bench.main, ["--steady", bag, "--duty-map", bag, "--thrust", bag, "--out", folder / "bench"]
    yield recover.main, [bag, "--out", folder / "recovered"]
    yield import_, [bag, folder / "imported", "--flip"]
    if FUZZ > 1:
        yield excitation_quality.main, [bag]
        yield diagnose.main, [bag, "--out", folder / "verdict", "--jobs", 1, "--seconds", 0.2]
        yield diagnose.main, [bag, "--out", folder / "uncalibrated", "--jobs", 1, "--seconds", 0.2, "--uncalibrated"]
        yield identify.main, [bag, "--out", folder / "identified", "--method", "sindy", "--terms",
                              "sin(theta),theta_dot,omega*omega,i_a,omega,v_a"]


def use(bags, columns, edits):
    """Run every command: exit code 0, or 2 with one line; no warning of numpy."""
    folder = Path(tempfile.mkdtemp())
    try:
        bag = written(bags, folder, columns, edits)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", ResourceWarning)
            for command, words in commands_over(bag, folder):
                error = io.StringIO()
                with redirect_stdout(io.StringIO()), redirect_stderr(error):
                    code = command([str(word) for word in words])
                assert code in (0, 2), command
                if command is not doctor.main:
                    assert len(error.getvalue().splitlines()) == (code == 2), (command, error.getvalue())
            with suppress(RecordingError):
                list(Plan(bag).events())
    finally:
        shutil.rmtree(folder)


ALL = (0, 10**6)
FEW = (1234, 2)


@settings(max_examples=12 * FUZZ, deadline=None, derandomize=FUZZ == 1, database=None)
@given(EDITS)
@example([("set", FEW, "duty", -0.5), ("set", (2000, 1), "duty", 1.7), ("set", (2500, 1), "duty", 55.0)])
@example([("set", FEW, "theta", math.inf), ("set", FEW, "i_a", -math.inf), ("set", (9, 1), "v_a", 1e300)])
@example([("set", FEW, "omega", 5e-324), ("nanosec", FEW, "both", 1_500_000_000), ("sec", (99, 3), "both", -5)])
@example([("set", (2000, 10**6), "omega", math.inf)])
@example([("scale", ALL, "omega", 9.55)])
@example([("joints", FEW, ["臂"], ([], [])), ("joints", (99, 9), ["rotor", "arm"], ([0.1], [0.2, 0.3]))])
def test_any_values_give_a_result_or_one_line(bags, columns, edits):
    use(bags, columns, edits)
