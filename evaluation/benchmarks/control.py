# SPDX-License-Identifier: Apache-2.0
"""The controllers as real processes beside a plant: from the stamp of a sample to its command, and what that costs."""

import struct
import time

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Float64

from aeropend_control.laws.registry import LAWS
from aeropend_control.nodes import wire
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.ros import interface
from aeropend_sim.ros.transport import without_shared_memory
from evaluation.benchmarks import measure
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, Target
from evaluation.benchmarks.nodes import NAMESPACE, PEER_S, SETTLE_S, Process
from evaluation.support.graph import PATIENCE_S

LONGEST = "feedback_linearization_cascade"
"""The law that does most, which runs for long."""
HOLD = {"theta": 0.4, "omega": 80.0}
"""What is held meanwhile."""
AFTER_S = 0.03
"""A command later than this after the last sample is the 0 of the silence, or of the end."""


class Wiretap:
    """Hears samples and commands as the plant does: a command's time is when it came here."""

    def __init__(self) -> None:
        without_shared_memory()
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node("benchmark", namespace=NAMESPACE)
        qos = QoSProfile(reliability=interface.QOS.reliability, history=interface.QOS.history, depth=5000)
        self._taps = [
            (kind, self._node.create_subscription(kind, topic, print, qos, raw=True))
            for kind, topic in ((BatteryState, interface.ARMATURE), (Float64, interface.DUTY_COMMAND))
        ]
        self._reference = self._node.create_publisher(Float64, interface.REFERENCE, interface.QOS)
        self.samples: list[tuple[int, float]] = []  # stamp, duty applied from it on
        self.commands: list[tuple[int, float]] = []  # received, duty

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        rclpy.try_shutdown()

    def listen(self, seconds: float, *processes: Process) -> None:
        """Collect for some seconds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.01)
            for process in processes:
                process.check()
            for (kind, subscription), found in zip(self._taps, (self.samples, self.commands), strict=True):
                handle = subscription.handle
                with handle:
                    while (taken := handle.take_message(kind, True)) is not None:
                        raw, info = taken
                        if kind is BatteryState:
                            stamp, _, _, duty = wire.armature(raw)
                            found.append((stamp, duty))
                        else:
                            found.append((info["received_timestamp"], struct.unpack_from("<d", raw, 4)[0]))

    def refer(self, value: float, *processes: Process) -> None:
        """Wait for the loop to be closed, and give it a reference."""
        end = time.monotonic() + PATIENCE_S
        while not (self._reference.get_subscription_count() and self.samples and self.commands):
            self.listen(0.1, *processes)
            if time.monotonic() > end:
                raise NotMeasuredError(f"{processes[-1].name}: no command within {PATIENCE_S:.0f} s")
        self._reference.publish(Float64(data=value))


def measured(law: str, seconds: float, *command: str) -> dict[str, float]:
    """Let a controller hold the arm, and measure every command's delay from the stamp of its sample.

    The plant ends first: its last sample and the last command belong together, or nearly, and so on to the first.
    """
    tap = Wiretap()
    try:
        plant = Process("plant")
        try:
            with Process(*(command or (law,))) as controller:
                tap.refer(HOLD[LAWS[law].measures], plant, controller)
                tap.listen(SETTLE_S, plant, controller)
                cpu, start = controller.cpu_s(), time.monotonic()
                first = tap.samples[-1][0]
                tap.listen(seconds, plant, controller)
                cpu, wall = controller.cpu_s() - cpu, time.monotonic() - start
                plant.stop()
                tap.listen(0.5, controller)
        finally:
            plant.stop()
    finally:
        tap.close()
    samples = [sample for sample in tap.samples if sample[0] > first]
    last = samples[-1][0]
    commands = [command for command in tap.commands if first < command[0] <= last + 1e9 * AFTER_S]
    count = min(len(samples), len(commands))
    stamps = np.array([stamp for stamp, _ in samples[-count:]])
    received = np.array([at for at, _ in commands[-count:]])
    asked = np.array([duty for _, duty in commands[-count:]], dtype=np.float32)
    applied = np.array([duty for _, duty in samples[-count:]], dtype=np.float32)
    # the last sample may have had no command, or the last command no sample; the quickest takes part of a period
    off = int((received - stamps).min() // round(1e9 * SAMPLE_PERIOD))
    if off:
        stamps, applied = (x[off:] if off > 0 else x[:off] for x in (stamps, applied))
        received, asked = (x[:-off] if off > 0 else x[-off:] for x in (received, asked))
    delay = 1e-6 * (received - stamps)
    grid = np.diff(stamps)
    return {"samples": float(len(samples)), "commands": float(len(commands)),
            # commands on their way when the measurement began may be more; one missed later would put all that
            # came before it on the wrong sample, which shows in those that act from the next one on
            "missed": float(max(len(samples) - len(commands), 0) + (grid > 1.5e9 * SAMPLE_PERIOD).sum()),
            "next_percent": 100.0 * float(np.mean(applied[1:] == np.clip(asked[:-1], 0.0, 1.0))),
            "delay_p50_ms": float(np.percentile(delay, 50)), "delay_p99_ms": float(np.percentile(delay, 99)),
            "delay_max_ms": float(delay.max()), "cpu_percent": 100.0 * cpu / wall}


def loop(quick: bool) -> list[Figure]:
    """Each law's node; the one that does most for ten minutes, beside the same law in a plain rclpy node."""
    seconds, short = (15.0, 8.0) if quick else (600.0, 12.0)
    about = measure.load()
    ours = measured(LONGEST, seconds)
    peer = measured(LONGEST, min(seconds, PEER_S), "plain_controller.py", LONGEST)
    others = {law: measured(law, short) for law in LAWS if law != LONGEST}
    details = {"ours": ours, "peer": peer, **others}

    def figure(name: str, unit: str, key: str, target: Target | None, note: str = "") -> Figure:
        return Figure(f"{LONGEST}, {seconds:.0f} s: {name}", unit, Spread.of(ours[key]), target,
                      f"the law in a plain rclpy node, {min(seconds, PEER_S):.0f} s", Spread.of(peer[key]), None,
                      details, note, about, main=target is not None)

    return [
        figure("samples missed or without a command", "", "missed", Target(0.0),
               f"of {ours['samples']:.0f}, the plain node of {peer['samples']:.0f}"),
        figure("p50 from stamp to command received", "ms", "delay_p50_ms", Target(1.0)),
        figure("p99 from stamp to command received", "ms", "delay_p99_ms", Target(3.0)),
        figure("commands that act from the next sample on", "%", "next_percent", None),
        figure("CPU of a core", "%", "cpu_percent", Target(30.0)),
        *(Figure(f"{law}, {short:.0f} s: {name}", unit, Spread.of(one[key]), Target(limit), load=about)
          for law, one in others.items()
          for name, unit, key, limit in (("p99 from stamp to command received", "ms", "delay_p99_ms", 3.0),
                                         ("CPU of a core", "%", "cpu_percent", 30.0))),
    ]
