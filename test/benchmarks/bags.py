# SPDX-License-Identifier: Apache-2.0
"""Reading a recording, and diagnosing it."""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from aeropend_ident import recording
from aeropend_sim import interface
from aeropend_sim.effects import CATALOGUE
from aeropend_sim.excitation import Excitation
from aeropend_sim.parameters import load
from aeropend_sim.rig import record
from benchmarks import measure
from benchmarks.measure import Figure, NotMeasuredError, Spread, Target, interleaved
from benchmarks.nodes import PERIOD_NS

SECONDS = 70.0
EFFECT = "coulomb_friction"
START_NS = 1_700_000_000_000_000_000
TYPES = {interface.JOINT_STATES: "sensor_msgs/msg/JointState", interface.ARMATURE: "sensor_msgs/msg/BatteryState",
         interface.DUTY_COMMAND: "std_msgs/msg/Float64"}


def make(path: Path) -> Path:
    """Write the bag that `record` would have written of a simulated rig with one effect."""
    model = load("bench")
    model = model.with_effects({EFFECT: {name: p.default for name, p in CATALOGUE[EFFECT].parameters.items()}})
    duty = Excitation(duration=SECONDS).series().astype(np.float32).astype(float)
    rig, _ = record(model, duty)
    store, nan, none = get_typestore(Stores.ROS2_JAZZY), math.nan, np.array([])
    joint, battery, float64 = (store.types[TYPES[topic]] for topic in TYPES)

    def header(stamp: int) -> Any:
        return store.types["std_msgs/msg/Header"](
            store.types["builtin_interfaces/msg/Time"](*divmod(stamp, 1_000_000_000)), "")

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {topic: writer.add_connection(f"/{topic}", kind, typestore=store) for topic, kind in TYPES.items()}

        def write(topic: str, received: int, message: Any) -> None:
            writer.write(topics[topic], received, store.serialize_cdr(message, TYPES[topic]))

        for k, (theta, omega, i_a, v_a, now) in enumerate(zip(*rig.values(), duty, strict=True)):
            stamp = START_NS + k * PERIOD_NS
            if k == 0 or now != duty[k - 1]:
                write(interface.DUTY_COMMAND, stamp - 500_000, float64(now))
            write(interface.JOINT_STATES, stamp + 300_000,
                  joint(header(stamp), list(interface.JOINTS), np.array([theta, nan]), np.array([nan, omega]), none))
            write(interface.ARMATURE, stamp + 400_000,
                  battery(header(stamp), v_a, nan, i_a, nan, nan, nan, now, 0, 0, 0, True, none, none,
                          interface.ARMATURE_LOCATION, ""))
    return path


def decode(path: Path) -> dict[str, np.ndarray]:
    """What rosbags' documentation does: decode every message, take the numbers from it."""
    rows: dict[str, list[tuple[float, ...]]] = {f"/{topic}": [] for topic in TYPES}
    with AnyReader([path]) as reader:
        for connection, time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == f"/{interface.JOINT_STATES}":
                stamp = message.header.stamp
                row = (stamp.sec * 1_000_000_000 + stamp.nanosec, message.position[0], message.velocity[1])
            elif connection.topic == f"/{interface.ARMATURE}":
                stamp = message.header.stamp
                row = (stamp.sec * 1_000_000_000 + stamp.nanosec, message.voltage, message.current, message.percentage)
            else:
                row = (time_ns, message.data)
            rows[connection.topic].append(row)
    return {topic: np.array(found) for topic, found in rows.items()}


def reading(quick: bool) -> list[Figure]:
    """A 70 s bag into arrays, beside rosbags' own decoding."""
    about = measure.load()
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        bag = make(Path(folder) / "bag")
        ours, peer = recording.read(bag), decode(bag)
        if not np.array_equal(ours.theta, peer["/joint_states"][:, 1]) or not np.array_equal(
            ours.i_a, peer["/armature"][:, 2]
        ):
            raise AssertionError("aeropend_ident and rosbags read different numbers: one of them is wrong")
        ours_s, peer_s = interleaved(3 if quick else 9, lambda: recording.read(bag), lambda: decode(bag))
    return [Figure("reading a 70 s bag into arrays", "s CPU", Spread.of(ours_s), Target(0.2),
                   "rosbags AnyReader.deserialize", Spread.of(peer_s), Spread.of(ours_s / peer_s),
                   {"messages": sum(map(len, peer.values()))}, load=about)]


def diagnosing(quick: bool) -> list[Figure]:
    """`diagnose` on a 70 s recording: time and peak memory. No other program does this."""
    command = Path(sys.executable).parent / "diagnose"
    if not command.exists():
        raise NotMeasuredError(f"there is no {command}: run make demo or make test once")
    about = measure.load()
    seconds, memory = [], []
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        bag = make(Path(folder) / "bag")
        for k in range(1 if quick else 3):
            out = Path(folder) / f"out{k}"
            with (Path(folder) / "output").open("w+") as output:
                start = time.perf_counter()
                process = subprocess.Popen([str(command), str(bag), "--out", str(out)], stdout=output, stderr=output)
                _, status, usage = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(status)
                seconds.append(time.perf_counter() - start)
                output.seek(0)
                if process.returncode:
                    said = " ".join(output.read().split())[-300:]
                    raise NotMeasuredError(f"diagnose ended with {process.returncode}: {said}")
            memory.append(usage.ru_maxrss / 1024.0)
        found = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    note = f"verdict {found['which']['verdict']} for {EFFECT}, {found['seconds']} s of it the diagnosis itself"
    return [Figure("diagnose on a 70 s recording", "s", Spread.of(seconds), details={"verdict": found["which"]},
                   note=note, load=about),
            Figure("diagnose: peak memory", "MiB", Spread.of(memory), load=about)]
