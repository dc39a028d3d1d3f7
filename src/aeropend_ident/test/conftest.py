# SPDX-License-Identifier: Apache-2.0
"""Bags made the way `ros2 bag record` makes them, and real processes on a ROS domain of their own."""

import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT, BATTERY, FLOAT = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Float64"
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 2_040_000
NAN = math.nan


def _header(stamp_ns: int, frame_id: str = "") -> Any:
    time = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))
    return STORE.types["std_msgs/msg/Header"](time, frame_id)


def joint(
    stamp_ns: int,
    position: Sequence[float],
    velocity: Sequence[float],
    names: Sequence[str] = ("arm", "rotor"),
    frame_id: str = "",
    *,
    little_endian: bool = True,
) -> bytes:
    """Serialize a JointState."""
    message = STORE.types[JOINT](
        _header(stamp_ns, frame_id), list(names), np.array(position, float), np.array(velocity, float), np.array([])
    )
    return bytes(STORE.serialize_cdr(message, JOINT, little_endian=little_endian))


def battery(
    stamp_ns: int, v_a: float, i_a: float, duty: float, frame_id: str = "", *, little_endian: bool = True
) -> bytes:
    """Serialize a BatteryState."""
    cells = np.array([], np.float32)
    message = STORE.types[BATTERY](
        _header(stamp_ns, frame_id), v_a, NAN, i_a, NAN, NAN, NAN, duty, 0, 0, 0, True, cells, cells, "armature", ""
    )
    return bytes(STORE.serialize_cdr(message, BATTERY, little_endian=little_endian))


def number(value: float, *, little_endian: bool = True) -> bytes:
    """Serialize a Float64."""
    return bytes(STORE.serialize_cdr(STORE.types[FLOAT](value), FLOAT, little_endian=little_endian))


@dataclass
class Content:
    """What to put into a bag: topic, type, receive time (ns), message; and the arrays a reader is to find in it."""

    messages: list[tuple[str, str, int, bytes]] = field(default_factory=list)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)

    def without(self, *topics: str) -> "Content":
        """Leave topics out."""
        return Content([one for one in self.messages if one[0] not in topics], self.arrays)


def content(
    count: int = 50, namespace: str = "", seed: int = 0, columns: Mapping[str, np.ndarray] | None = None
) -> Content:
    """Make up samples of a rig, or take columns as given, with two commands and one reference among them."""
    rng = np.random.default_rng(seed)
    stamps = START_NS + PERIOD_NS * np.arange(count)
    arrays = {
        "stamp_ns": stamps,
        "theta": rng.normal(size=count),
        "omega": rng.normal(size=count),
        "v_a": rng.normal(size=count).astype(np.float32).astype(float),
        "i_a": rng.normal(size=count).astype(np.float32).astype(float),
        "duty": rng.random(count).astype(np.float32).astype(float),
        **(columns or {}),
    }
    messages = []
    for row, stamp in enumerate(stamps.tolist()):
        one = {name: float(values[row]) for name, values in arrays.items()}
        sample = joint(stamp, [one["theta"], NAN], [NAN, one["omega"]])
        messages.append((f"{namespace}/joint_states", JOINT, stamp + 300_000, sample))
        motor = battery(stamp, one["v_a"], one["i_a"], one["duty"])
        messages.append((f"{namespace}/armature", BATTERY, stamp + 400_000, motor))
        if row in (10, 30):
            messages.append((f"{namespace}/duty_command", FLOAT, stamp + 500_000, number(row / 100)))
        if row == 20:
            messages.append((f"{namespace}/reference", FLOAT, stamp + 500_000, number(0.4)))
    return Content(messages, arrays)


def write_bag(path: Path, made: Content, storage: str = "mcap", **compression: Any) -> Path:
    """Write a bag with rosbags."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression:
        writer.set_compression(**compression)
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, msgtype, received, message in made.messages:
            if (topic, msgtype) not in connections:
                connections[topic, msgtype] = writer.add_connection(topic, msgtype, typestore=STORE)
            writer.write(connections[topic, msgtype], received, message)
    return path


@dataclass(frozen=True)
class Bags:
    """The functions above, for test modules."""

    joint: Callable[..., bytes] = joint
    battery: Callable[..., bytes] = battery
    number: Callable[..., bytes] = number
    content: Callable[..., Content] = content
    Content: type[Content] = Content
    write: Callable[..., Path] = write_bag
    store: Any = STORE


@pytest.fixture(scope="session")
def bags() -> Bags:
    """Make bags."""
    return Bags()


WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % 2
"""Which of two processes that run tests beside each other this is."""


class Processes:
    """Starts programs on a ROS domain of this test's own, and ends by process id what is left of them."""

    _number = os.getpid()

    def __init__(self, folder: Path) -> None:
        Processes._number += 1
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(50 + 25 * WORKER + Processes._number % 25),  # below 50: those of test/graph.py
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "PYTHONUNBUFFERED": "1",
        }
        self.folder = folder
        self._started: list[subprocess.Popen[str]] = []

    def start(self, *arguments: str, module: str = "", code: str = "", **options: Any) -> subprocess.Popen[str]:
        """Start a module or a piece of code with arguments, in the test's folder."""
        what = ["-m", module] if module else ["-c", code]
        process = subprocess.Popen(
            [sys.executable, *what, *arguments],
            cwd=self.folder,
            env=self.environment,
            text=True,
            **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options},
        )
        self._started.append(process)
        return process

    def end(self, process: subprocess.Popen[str], number: int = signal.SIGINT) -> tuple[int, str]:
        """Send a signal; return exit code and what was said on standard error."""
        process.send_signal(number)
        return self.wait(process)

    @staticmethod
    def wait(process: subprocess.Popen[str], timeout: float = 60.0) -> tuple[int, str]:
        """Wait for the end; return exit code and what was said on standard error."""
        _, said = process.communicate(timeout=timeout)
        return process.returncode, said

    def kill(self) -> None:
        """End whatever runs."""
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.communicate()


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    """Start processes."""
    running = Processes(tmp_path)
    yield running
    running.kill()
