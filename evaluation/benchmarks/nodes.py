# SPDX-License-Identifier: Apache-2.0
"""The plant and the recorder as real processes, beside what most people write with rclpy and rosbags."""

import os
import struct
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState

from aeropend_ident.bags import recording
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.ros import interface
from aeropend_sim.ros.transport import without_shared_memory
from evaluation.benchmarks import measure
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, Target
from evaluation.support import graph
from evaluation.support.graph import PATIENCE_S, parameters
from evaluation.support.sleeper import Sleeper

Stamps = NDArray[np.int64]

PERIOD_NS = round(SAMPLE_PERIOD * 1e9)
PEERS = Path(__file__).parent / "peers"
NAMESPACE = f"/bench_{os.getpid()}"
"""Of every node: another rig on this machine may have hit on the same domain."""
SETTLE_S = 3.0
"""Start-up that is not measured."""
PEER_S = 30.0
"""How long a peer runs at most."""


class Process(graph.Process):
    """One of our commands as it is installed, or a peer's file, in the benchmark's namespace."""

    def command(self, *args: str) -> list[str]:
        """What is run.

        Raises:
            NotMeasuredError: it is not installed.
        """
        command = [str(Path(sys.executable).parent / self.name)]
        if self.name.endswith(".py"):
            command = [sys.executable, str(PEERS / self.name)]
        elif not Path(command[0]).exists():
            raise NotMeasuredError(f"there is no {command[0]}: run make demo or make test once")
        ros = [] if "--ros-args" in args else ["--ros-args"]
        return [*command, *args, *ros, "-r", f"__ns:={NAMESPACE}"]

    def cpu_s(self) -> float:
        """CPU time used so far, s."""
        fields = Path(f"/proc/{self.popen.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def check(self) -> None:
        """Raise when it has ended by an error."""
        if self.popen.poll():
            said = " ".join(self.output.split())[-300:]
            raise NotMeasuredError(f"{self.name} ended with {self.popen.returncode}: {said}")


class Listener:
    """Notes when samples of joint_states were due (their stamps) and when they were published (by the middleware)."""

    def __init__(self) -> None:
        without_shared_memory()
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node("benchmark", namespace=NAMESPACE)
        qos = QoSProfile(reliability=interface.QOS.reliability, history=interface.QOS.history, depth=5000)
        self._subscription = self._node.create_subscription(JointState, interface.JOINT_STATES, print, qos, raw=True)

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        rclpy.try_shutdown()

    def listen(self, process: Process, seconds: float) -> tuple[Stamps, Stamps]:
        """Listen for some seconds; returns (N,) due and (N,) published, ns."""
        due, published = [], []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.01)
            process.check()
            handle = self._subscription.handle
            with handle:
                while (taken := handle.take_message(JointState, True)) is not None:
                    seconds_, nanoseconds = struct.unpack_from("<iI", taken[0], 4)
                    due.append(seconds_ * 1_000_000_000 + nanoseconds)
                    published.append(taken[1]["source_timestamp"])
        return np.array(due, dtype=np.int64), np.array(published, dtype=np.int64)

    def wait(self, process: Process) -> None:
        """Wait for the first sample."""
        end = time.monotonic() + PATIENCE_S
        while not len(self.listen(process, 0.1)[0]):
            if time.monotonic() > end:
                raise NotMeasuredError(f"{process.name}: no sample within {PATIENCE_S:.0f} s")


def rhythm(name: str, seconds: float) -> dict[str, float]:
    """Run something that publishes samples, and measure ticks missed, lateness (ms) and CPU (% of a core).

    A program that only sleeps runs beside it. It shows which ticks no program could meet on this machine.
    """
    listener = Listener()
    try:
        with Process(name) as process:
            listener.wait(process)
            listener.listen(process, SETTLE_S)
            with Sleeper() as sleeper:
                cpu, start = process.cpu_s(), time.monotonic()
                due, published = listener.listen(process, seconds)
                cpu, wall = process.cpu_s() - cpu, time.monotonic() - start
                slept = sleeper.ended()
    finally:
        listener.close()
    ticks = np.unique(np.round((due - due[0]) / PERIOD_NS).astype(np.int64))
    lateness = (published - due) * 1e-6
    return {"missed": float(ticks[-1] - ticks[0] + 1 - len(ticks)),
            "late": float((lateness >= PERIOD_NS * 1e-6).sum()),
            "sleeper_late": float(slept["late ticks"]),
            "ticks": float(len(ticks)),
            "lateness_p50_ms": float(np.percentile(lateness, 50)),
            "lateness_p99_ms": float(np.percentile(lateness, 99)),
            "lateness_max_ms": float(lateness.max()),
            "cpu_percent": 100.0 * cpu / wall}


def plant(quick: bool) -> list[Figure]:
    """The plant node in real time, beside a node with an rclpy timer and the same two messages."""
    seconds = 10.0 if quick else 60.0
    about = measure.load()
    ours, peer = rhythm("plant", seconds), rhythm("timer_node.py", min(seconds, PEER_S))
    details = {"seconds": seconds, "ours": ours, "peer": peer}

    timer = f"rclpy timer node, {min(seconds, PEER_S):.0f} s"
    missed = ours["missed"] + ours["late"]

    def figure(name: str, unit: str, value: float, beside: str, other: float, limit: float, note: str = "") -> Figure:
        return Figure(f"plant, {seconds:.0f} s: {name}", unit, Spread.of(value), Target(limit), beside,
                      Spread.of(other), None, details, note, about, main=True)

    return [
        figure("ticks missed or a period late", f"of {ours['ticks'] + ours['missed']:.0f}", missed,
               "a program that only sleeps, at the same time", ours["sleeper_late"], 0.0),
        figure("p99 from due to published", "ms", ours["lateness_p99_ms"], timer, peer["lateness_p99_ms"], 0.5),
        figure("CPU of a core", "%", ours["cpu_percent"], timer, peer["cpu_percent"], 25.0,
               "the timer node simulates nothing"),
    ]


def recorded(recorder: str, seconds: float, bag: Path) -> dict[str, float]:
    """Record plant and excite, and count what is missing in the bag."""
    with Process("plant") as plant_, Process("excite", *parameters(duration=seconds + 60.0)) as excite:
        with Process(recorder, str(bag)) as process:
            listening = time.monotonic() + PATIENCE_S
            while not (bag.exists() and _grows(bag)):
                process.check()
                if time.monotonic() > listening:
                    raise NotMeasuredError(f"{recorder} recorded nothing within {PATIENCE_S:.0f} s")
            cpu, start = process.cpu_s(), time.monotonic()
            while time.monotonic() < start + seconds:
                time.sleep(0.2)
                for one in plant_, excite, process:
                    one.check()
            cpu, wall = process.cpu_s() - cpu, time.monotonic() - start
        process.check()
    found = recording.read(bag, NAMESPACE)
    on_grid = (found.stamp_ns - found.stamp_ns[0]) % PERIOD_NS == 0
    whole = np.flatnonzero(np.isfinite(found.v_a) & np.isfinite(found.theta))
    both = slice(int(whole[0]), int(whole[-1]) + 1)  # one topic is heard before the other: that loses nothing
    result = {"samples": float(len(found)), "seconds": found.duration, "lost": float(found.lost),
              "off_grid": float((~on_grid).sum()), "commands": float(len(found.command)),
              "without_armature": float(np.isnan(found.v_a[both]).sum()),
              "without_angle": float(np.isnan(found.theta[both]).sum()),
              "heard_by_halves": float(len(found) - len(found.theta[both])),
              "cpu_percent": 100.0 * cpu / wall}
    return result | _counted(bag, found.stamp_ns)


def _grows(bag: Path) -> bool:
    def size() -> int:
        return sum(file.stat().st_size for file in bag.iterdir())

    before = size()
    time.sleep(1.5)
    return size() > before + 10_000


def _counted(bag: Path, stamps: Stamps) -> dict[str, float]:
    """What the plant's own counter, in the recorded diagnostics, says: samples published between its reports."""
    counters: list[tuple[int, int, int]] = []
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic == interface.DIAGNOSTICS]
        for connection, _, raw in reader.messages(connections) if connections else ():
            message = reader.deserialize(raw, connection.msgtype)
            for status in message.status:
                values = {value.key: value.value for value in status.values}
                if status.name == f"{NAMESPACE[1:]}/plant":
                    at = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
                    counters.append((at, int(values["samples"]), int(values["lost ticks"])))
    if len(counters) < 2:
        return {}
    first, last = counters[0], counters[-1]
    there = int(((stamps > first[0]) & (stamps <= last[0])).sum())
    return {"plant_published": float(last[1] - first[1]), "recorded_meanwhile": float(there),
            "plant_lost": float(last[2] - first[2])}


def record(quick: bool) -> list[Figure]:
    """`record` beside plant and excite, beside a node with decoded subscriptions and rosbags' Writer."""
    seconds = 20.0 if quick else 300.0
    about = measure.load()
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        ours = recorded("record", seconds, Path(folder) / "ours")
        peer = recorded("plain_recorder.py", min(seconds, PEER_S), Path(folder) / "peer")
    for one in ours, peer:
        one["lost_per_minute"] = one["lost"] / one["seconds"] * 60.0
    details = {"ours": ours, "peer": peer}
    if "plant_published" not in ours:
        raise NotMeasuredError("record: the plant's counters are not in the bag: nothing to count against")
    short = ours["plant_published"] - ours["recorded_meanwhile"]  # may be one, a sample between counter and stamp
    on_grid = ours["lost"] - ours["plant_lost"] + ours["without_armature"] + ours["without_angle"]
    missing = Spread.of(max(on_grid, short if short > 1.0 else 0.0))
    return [
        Figure(f"record, {seconds:.0f} s beside plant and excite: messages lost", "", missing, Target(0.0),
               f"rclpy + rosbags Writer, {min(seconds, PEER_S):.0f} s",
               Spread.of(peer["lost"] + peer["without_armature"] + peer["without_angle"]), None, details,
               f"plant counted {ours['plant_published']:.0f}, recorded meanwhile {ours['recorded_meanwhile']:.0f}",
               about, main=True),
        Figure("record: CPU of a core", "%", Spread.of(ours["cpu_percent"]), None, "rclpy + rosbags Writer",
               Spread.of(peer["cpu_percent"]), None, load=about, main=True),
    ]
