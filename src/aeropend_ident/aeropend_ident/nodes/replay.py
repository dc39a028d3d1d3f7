# SPDX-License-Identifier: Apache-2.0
"""The node that publishes a bag's messages again, byte for byte and with the timing they were received with.

Every message has a deadline counted from the start, so lateness does not add up. A recorded duty_command drives a
plant, simulated or real; when it ends, or is stopped, a duty of 0 is sent so that the plant does not run on.
"""

from __future__ import annotations

import heapq
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rosbags.interfaces import Connection, ConnectionExtRosbag2, QosDurability
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from aeropend_ident.bags.container import Bag
from aeropend_ident.bags.msgtypes import message_class
from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.bags.recording import split_topic
from aeropend_sim.errors import UserError
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.settings import Setting, overrides, read_settings
from aeropend_sim.ros.usage import no_options, usage
from aeropend_sim.ros.worker import Worker

HORIZON_NS = 1_000_000_000
"""Messages may lie in a bag this much out of order, ns.

Choice: a hundred batches of `record`, which writes one topic after another; it bounds the memory."""
PAUSE_NS = 60_000_000_000
"""A pause that is longer is said before anything is sent, ns (choice: nobody waits so long without a word)."""
SLEEP_S = 0.05
"""The longest the thread sleeps without looking whether it is to end, s (choice)."""
ACKNOWLEDGE_S = 1.0
"""How long the end waits for each topic until subscribers have the last messages, s.

Choice: one that hangs holds up the end, so not long."""
CLOCK = "/clock"

SETTINGS = {
    "rate": Setting(1.0, "how many times faster than recorded", low=1e-3, high=1e3),
    "start": Setting(0.0, "begin this far into the bag", "s", 0.0, 1e9),
    "loop": Setting(False, "begin again at the end"),
    "topics": Setting("", "only these, with commas between them, relative to the rig's namespace or full names"),
    "namespace": Setting("", "only the rig that was recorded in this namespace"),
    "subscribers": Setting(1, "begin when every topic has this many", low=0, high=1000),
    "wait": Setting(5.0, "but wait for them no longer than this", "s", 0.0, 1e6),
    "clock": Setting(0.0, "publish /clock with the recorded time this often; 0: not at all", "Hz", 0.0, 1e3),
    "stop_duty": Setting(True, "after a duty_command, end with duty 0"),
}

USAGE = usage(
    "replay: publishes the messages of BAG again, with their own timing.",
    SETTINGS,
    [
        "replay BAG [--ros-args ...]",
        "replay my_bag",
        "replay my_bag --ros-args -p topics:=duty_command              (drives a plant as it was driven)",
        "replay my_bag --ros-args -p rate:=0.5 -p start:=10.0 -p loop:=true",
        "replay my_bag --ros-args -p topics:=duty_command -r __ns:=/rig2",
    ],
    "  Topics keep the names they were recorded with. In a namespace (-r __ns:=/rig2) the rig's topics move into it.",
    "BAG",
)

Event = tuple[int, Connection, bytes]
"""Receive time (ns), connection, message."""


class Plan:
    """What of a bag is replayed. Knows nothing of ROS.

    Attributes:
        bag: the bag.
        names: recorded (topic, type) -> name without the rig's namespace, "" when the topic belongs to no rig.
        connections: chosen (topic, type) -> connection.
        start: receive time of the first message played, ns.
        end: receive time of the last message played, ns.
        pauses: receive times of the last message before each long pause and of the first one after it, ns.
    """

    def __init__(self, path: Path | str, topics: Iterable[str] = (), namespace: str = "", start: float = 0.0) -> None:
        """Look through a bag.

        Args:
            path: the bag.
            topics: relative or full names; all when empty.
            namespace: only topics below it; all when empty.
            start: how far into the chosen messages to begin, s.

        Raises:
            RecordingError: the bag cannot be used, or does not hold what was asked for.
        """
        self.bag = Bag(path)
        self.names: dict[tuple[str, str], str] = {}
        self.connections: dict[tuple[str, str], Connection] = {}
        self._topics = tuple(topics)
        self._namespace = "/" + namespace.strip("/") if namespace else ""
        for _ in self.bag.messages(self._note):
            pass  # only to learn what is in it
        chosen = self._choose()
        first, last = 2**63, -1
        cells: dict[int, tuple[int, int]] = {}
        for connection, received, _ in self.bag.messages(lambda topic, msgtype: (topic, msgtype) in chosen):
            self.connections.setdefault((connection.topic, connection.msgtype), connection)
            first, last = min(first, received), max(last, received)
            low, high = cells.get(received // PAUSE_NS, (received, received))
            cells[received // PAUSE_NS] = min(low, received), max(high, received)
        if last < 0:
            raise RecordingError(f"{path}: holds no messages to replay: record again")
        self.start, self.end = first + round(start * 1e9), last
        if self.start > self.end:
            raise RecordingError(f"{path}: start is {start:g} s, but it lasts {(last - first) / 1e9:.3f} s: give less")
        self._first = first
        self.pauses = [(before, after) for (_, before), (after, _) in pairwise(cells[cell] for cell in sorted(cells))
                       if after - before > PAUSE_NS and before >= self.start]

    def warning(self) -> str | None:
        """What to say of long pauses before anything is sent; None if there are none."""
        if not self.pauses:
            return None
        before, after = self.pauses[0]
        number = f"pauses {len(self.pauses)} times, first" if len(self.pauses) > 1 else "pauses"
        at = (before - self.start) / 1e9
        return (f"{self.bag.path} {number} for {(after - before) / 1e9:.0f} s, {at:.0f} s after the start, as where a "
                "clock was set: nothing is sent meanwhile; to begin after it, give "
                f"-p start:={(after - self._first) // 10**6 / 1e3:.3f}")

    @property
    def duration(self) -> float:
        """Time from the first message played to the last, s."""
        return (self.end - self.start) / 1e9

    def events(self) -> Iterator[Event]:
        """Yield the messages in the order they were received.

        The last duty_command and reference before the start come first, at the start: they were still in force.
        """
        held: dict[tuple[str, str], Event] = {}
        for event in self._in_order():
            received, connection, message = event
            key = (connection.topic, connection.msgtype)
            if received < self.start:
                if self.names[key] in (interface.DUTY_COMMAND, interface.REFERENCE):
                    held[key] = (self.start, connection, message)
                continue
            if held:
                yield from held.values()
                held = {}
            yield event

    def _note(self, topic: str, msgtype: str) -> bool:
        split = split_topic(topic, msgtype)
        self.names[topic, msgtype] = split[1] if split else ""
        return False

    def _choose(self) -> set[tuple[str, str]]:
        there = set(self.names)
        places = {topic.removesuffix(name).rstrip("/") for (topic, _), name in self.names.items() if name} | {""}
        if self._namespace:
            places = {self._namespace.rstrip("/")}
            there = {key for key in there if key[0].startswith(f"{self._namespace.rstrip('/')}/")}
        if not self.names:
            raise RecordingError(f"{self.bag.path}: holds no messages to replay: record again")
        if not self._topics:
            chosen = there
        else:
            chosen = set()
            for wanted in self._topics:
                full = {wanted} if wanted.startswith("/") else {f"{place}/{wanted}" for place in places}
                found = {key for key in there if key[0] in full}
                if not found:
                    raise RecordingError(f"{self.bag.path}: no topic {wanted} in it{self._listed()}")
                chosen |= found
        if not chosen:
            raise RecordingError(f"{self.bag.path}: no topic in namespace {self._namespace}{self._listed()}")
        return chosen

    def _listed(self) -> str:
        topics = sorted({topic for topic, _ in self.names})
        return f"; it holds {', '.join(topics)}: name one of these"

    def _in_order(self) -> Iterator[Event]:
        """Sort by receive time, over the distance that messages may be out of order."""
        heap: list[tuple[int, int, Connection, bytes]] = []
        newest = 0
        messages = self.bag.messages(lambda topic, msgtype: (topic, msgtype) in self.connections)
        for number, (connection, received, message) in enumerate(messages):
            heapq.heappush(heap, (received, number, connection, message))
            newest = max(newest, received)
            while heap[0][0] < newest - HORIZON_NS:
                received, _, connection, message = heapq.heappop(heap)
                yield received, connection, message
        while heap:
            received, _, connection, message = heapq.heappop(heap)
            yield received, connection, message


class Replay(Node):
    """The node; see the module's docstring."""

    def __init__(self, path: Path) -> None:
        """Make the publishers.

        Raises:
            UserError: a parameter is wrong, or the bag cannot be replayed.
        """
        super().__init__("replay", automatically_declare_parameters_from_overrides=True)
        settings = read_settings(self, SETTINGS, overrides(self))
        self._rate: float = settings["rate"]
        self._loop: bool = settings["loop"]
        self._subscribers: int = settings["subscribers"]
        self._wait: float = settings["wait"]
        self._stop_duty: bool = settings["stop_duty"]
        topics = [topic.strip() for topic in settings["topics"].split(",") if topic.strip()]
        self._plan = Plan(path, topics, settings["namespace"], settings["start"])
        if self._loop and self._plan.start == self._plan.end:
            raise UserError(f"{path}: what would be replayed was received at one instant, and a loop of it would not "
                            "wait: leave loop out, or begin earlier")
        if settings["clock"] and self._plan.end >= interface.LATEST_NS:
            raise UserError(f"{path}: was received beyond 2038, which {CLOCK} cannot tell: leave clock out")
        for problem in self._plan.bag.problems:
            self.get_logger().warn(problem)
        if (said := self._plan.warning()) is not None:
            self.get_logger().warn(said)
        self._outlets: dict[tuple[str, str], Publisher] = {}
        self._duty_outlets: list[Publisher] = []
        for key, connection in self._plan.connections.items():
            self._advertise(key, connection, required=bool(topics))
        if not self._outlets:
            raise UserError(f"{path}: none of its message types is installed")
        self._clock_outlet = self.create_publisher(Clock, CLOCK, interface.QOS) if settings["clock"] else None
        self._tick_ns = round(1e9 / settings["clock"]) if settings["clock"] else 0
        self._sent = 0
        self._late = 0.0
        self._driving = False
        self._diagnostics = Diagnostics(self, self._report)
        self._worker = Worker(self, self._replay, "replay")
        self._worker.start()

    def close(self) -> None:
        """Stop, and leave no plant driven."""
        self._worker.stop()
        if self._driving and self._stop_duty:
            for publisher in self._duty_outlets:
                publisher.publish(Float64(data=0.0))
            self.get_logger().info("duty 0 sent, so that the plant stops")
        for publisher in self._outlets.values():  # nothing sent is lost because we go
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_S))
        if getattr(self, "error", None) is None and self._sent:
            self.get_logger().info(f"{self._sent} messages sent, at most {self._late * 1e3:.1f} ms late")

    def _advertise(self, key: tuple[str, str], connection: Connection, *, required: bool) -> None:
        topic, msgtype = key
        name = self._plan.names[key]
        if topic == CLOCK and self.get_parameter("clock").value:
            return  # ours takes its place
        target = name if name and self.get_namespace() != "/" else topic
        try:
            kind = message_class(msgtype)
        except LookupError as error:
            if required:
                raise UserError(f"{topic} cannot be replayed: {error}") from error
            self.get_logger().warn(f"{topic} is left out: {error}")
            return
        resolved = self.resolve_topic_name(target)
        if resolved in {publisher.topic_name for publisher in self._outlets.values()}:
            raise UserError(f"several recorded topics would become {resolved}: choose a rig with -p namespace:=/...")
        publisher = self._outlets[key] = self.create_publisher(kind, target, _qos_like(connection))
        if name == interface.DUTY_COMMAND:
            self._duty_outlets.append(publisher)

    # ---- the thread ------------------------------------------------------------------------------------------------

    def _replay(self, end: threading.Event) -> None:
        if not self._await_listeners(end):
            return
        with self._progress() as progress:
            bar = progress.add_task("", total=None if self._loop else max(self._plan.duration, 1e-9))
            begin = time.monotonic()
            while self._play(begin, end, progress, bar) and self._loop and not end.is_set():
                begin += self._plan.duration / self._rate

    def _await_listeners(self, end: threading.Event) -> bool:
        """Wait for discovery. False when it is time to end."""
        deadline = time.monotonic() + self._wait
        while deaf := [p for p in self._outlets.values() if p.get_subscription_count() < self._subscribers]:
            if time.monotonic() >= deadline:
                counts = (f"{outlet.topic_name} {outlet.get_subscription_count()}" for outlet in deaf)
                self.get_logger().warn(f"begins with few or no subscribers: {', '.join(sorted(counts))}")
                break
            if end.wait(SLEEP_S):
                return False
        for publisher in self._outlets.values():
            if self.count_publishers(publisher.topic_name) > 1:
                self.get_logger().warn(f"{publisher.topic_name} has other publishers too: their messages will mix")
        return not end.is_set()

    def _play(self, begin: float, end: threading.Event, progress: Progress, bar: TaskID) -> bool:
        """Publish the bag once. False when it was ended."""
        start = self._plan.start
        tick = start
        for received, connection, message in self._plan.events():
            publisher = self._outlets.get((connection.topic, connection.msgtype))
            if publisher is None:
                continue
            while self._clock_outlet is not None and tick <= received:
                if not self._until(begin + (tick - start) / 1e9 / self._rate, end):
                    return False
                self._clock_outlet.publish(Clock(clock=interface.stamp(tick)))
                tick += self._tick_ns
            deadline = begin + (received - start) / 1e9 / self._rate
            if not self._until(deadline, end):
                return False
            publisher.publish(message)
            self._late = max(self._late, time.monotonic() - deadline)
            self._sent += 1
            if publisher in self._duty_outlets:
                self._driving = message[4:] != bytes(8)
            if self._sent % 64 == 0:
                progress.update(bar, completed=(received - start) / 1e9)
        return True

    def _until(self, deadline: float, end: threading.Event) -> bool:
        """Sleep until a deadline. False when it is time to end."""
        while (left := deadline - time.monotonic()) > SLEEP_S:
            if end.wait(min(left - SLEEP_S / 2, threading.TIMEOUT_MAX)):
                return False
        if left > 0:
            time.sleep(left)
        return not end.is_set()

    def _progress(self) -> Progress:
        console = Console(stderr=True)
        columns = (TextColumn("replaying"), BarColumn(), TextColumn("{task.completed:.0f} of {task.total:.0f} s"),
                   TimeRemainingColumn())
        looping = (TextColumn("replaying again and again, {task.completed:.0f} s"),)
        return Progress(
            *(looping if self._loop else columns), console=console, transient=True, disable=not sys.stderr.isatty()
        )

    def _report(self) -> tuple[str, Mapping[str, object]]:
        return "", {"bag": self._plan.bag.path, "sent": self._sent, "latest_ms": self._late * 1e3}


def _qos_like(connection: Connection) -> QoSProfile:
    """RELIABLE (docs/interfaces.md), which serves every subscriber; latched when the recorded publisher was."""
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    latched = any(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in connection.ext.offered_qos_profiles)
    return QoSProfile(
        history=interface.QOS.history,
        depth=interface.QOS.depth,
        reliability=interface.QOS.reliability,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _bag(words: list[str]) -> Path:
    no_options(words)
    if len(words) != 1:
        raise UserError(f"name one BAG{', not ' + ' '.join(words) if words else ''}: see --help")
    return Path(words[0])


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `replay`."""
    return run(Replay, args, USAGE, _bag)


if __name__ == "__main__":
    sys.exit(main())
