# SPDX-License-Identifier: Apache-2.0
"""Reading a recording, and diagnosing it."""

import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from aeropend_ident.bags import recording
from aeropend_ident.signals.from_bag import signals_of
from aeropend_ident.testing.bags import write
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import Model, load
from aeropend_sim.model.rig import record
from aeropend_sim.ros import interface
from evaluation.benchmarks import measure
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, Target, interleaved
from evaluation.benchmarks.nodes import PERIOD_NS
from evaluation.blind.peers import sparse_regression, stepwise_bic

SECONDS = 70.0
EFFECT = "coulomb_friction"
SPARSE, STEPWISE = "sparse regression of the discrepancy", "stepwise BIC on the output error"
LIMIT_S = 420.0
"""What takes longer counts as never done."""
START_NS = 1_700_000_000_000_000_000
TYPES = {interface.JOINT_STATES: "sensor_msgs/msg/JointState", interface.ARMATURE: "sensor_msgs/msg/BatteryState",
         interface.DUTY_COMMAND: "std_msgs/msg/Float64"}


# ru_maxrss of a child begins with what its parent has, so the parent is a small one.
START = """
import json, resource, subprocess, sys, time
start = time.perf_counter()
try:
    done = subprocess.run(sys.argv[2:], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=float(sys.argv[1]))
    code, said = done.returncode, done.stdout.decode()
except subprocess.TimeoutExpired:
    code, said = None, "not done in time"
used = resource.getrusage(resource.RUSAGE_CHILDREN)
seconds = time.perf_counter() - start
print(json.dumps([code, said, seconds, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024]))
"""


class Run(NamedTuple):
    """What a process took: s by the clock, s CPU, bytes of memory at its peak; inf where it was not done in time."""

    seconds: float
    cpu: float
    peak: float


def diagnosed(*args: str | Path, code: int = 0, limit: float = LIMIT_S) -> Run:
    """Run `diagnose` as it is installed.

    Args:
        args: of its command line.
        code: the exit code expected.
        limit: s it may take.

    Raises:
        NotMeasuredError: it is not installed, or ended otherwise.
    """
    command = Path(sys.executable).parent / "diagnose"
    if not command.exists():
        raise NotMeasuredError(f"there is no {command}: run make demo or make test once")
    done = subprocess.run([sys.executable, "-c", START, str(limit), str(command), *map(str, args)],
                          capture_output=True, text=True, check=True)
    ended, said, seconds, cpu, peak = json.loads(done.stdout)
    if ended is None:
        return Run(math.inf, math.inf, math.inf)
    if ended != code:
        raise NotMeasuredError(f"diagnose ended with {ended}: {' '.join(said.split())[-300:]}")
    return Run(seconds, cpu, peak)


def rig_with(*effects: str) -> Model:
    """`bench` with effects at their default sizes."""
    return load("bench").with_effects({id_: {name: p.default for name, p in CATALOGUE[id_].parameters.items()}
                                       for id_ in effects})


def make(path: Path) -> Path:
    """Write the bag that `record` would have written of a simulated rig with one effect."""
    duty = Excitation(duration=SECONDS).series().astype(np.float32).astype(float)
    rig, _ = record(rig_with(EFFECT), duty)
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
                   {"messages": sum(map(len, peer.values()))}, load=about, main=True)]


def diagnosing(quick: bool) -> list[Figure]:
    """`diagnose` on a 70 s recording: time and peak memory, beside two ways to choose among the same effects."""
    about = measure.load()
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        bag = make(Path(folder) / "bag")
        outs = [Path(folder) / f"out{k}" for k in range(1 if quick else 3)]
        runs = [diagnosed(bag, "--out", out) for out in outs]
        found = json.loads((outs[-1] / "diagnosis.json").read_text(encoding="utf-8"))
        model = load("bench")
        signals = signals_of(bag, None, model)
        peers = {SPARSE: sparse_regression(signals, model), STEPWISE: stepwise_bic(signals, model)}
    seconds = np.array([one.seconds for one in runs])
    of_peer = Spread.of(peers[STEPWISE]["seconds"])
    said = {"diagnose": found["which"], **peers}
    note = f"{EFFECT}: " + ", ".join(f"{name} says {' + '.join(x['effects']) or 'none'}" for name, x in said.items())
    note += f"; {runs[-1].cpu:.1f} s CPU; the regression took {peers[SPARSE]['seconds']:.1f} s"
    return [Figure("diagnose on a 70 s recording", "s", Spread.of(seconds), Target(10.0),
                   STEPWISE, of_peer, Spread.of(seconds / of_peer.median),
                   {"verdict": found["which"], "peers": peers}, note, about, main=True),
            Figure("diagnose on a 70 s recording: peak memory", "MB", Spread.of([one.peak / 1e6 for one in runs]),
                   load=about)]


def unknown(quick: bool) -> list[Figure]:
    """`diagnose --fit-nominal` on angle and command alone: 60 s at 98 Hz and 1024 steps a turn."""
    about = measure.load()
    duty = Excitation(duration=60.0).series().astype(np.float32).astype(float)[::5]
    duty = np.repeat(duty, 5)
    rig, _ = record(rig_with("cable_torque"), duty)
    nothing = np.full(len(duty[::5]), math.nan)
    columns = {"theta": rig["theta"][::5], "omega": nothing, "i_a": nothing, "v_a": nothing, "duty": duty[::5]}
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        bag = Path(folder) / "bag"
        write(bag, columns, 5 * PERIOD_NS)
        runs = [diagnosed(bag, "--fit-nominal", "--out", Path(folder) / f"out{k}") for k in range(1 if quick else 3)]
        found = json.loads((Path(folder) / "out0" / "diagnosis.json").read_text(encoding="utf-8"))
    return [Figure("diagnose --fit-nominal, 60 s of angle and command", "s", Spread.of([one.seconds for one in runs]),
                   Target(20.0), details={"verdict": found["which"]},
                   note=f"verdict {found['which']['verdict']} for cable_torque; {runs[-1].cpu:.1f} s CPU", load=about,
                   main=True)]
