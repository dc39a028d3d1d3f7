# SPDX-License-Identifier: Apache-2.0
"""The node that records a rig's topics into a rosbag2 bag.

Messages are written as they come off the wire, with the time at which the middleware received them. A thread takes
them from the subscriptions in bunches, without an executor in between: that costs a fraction of the time, and what
arrives while the disk is slow waits in the middleware, up to ten seconds of it. Twice a second the bag is made whole
on disk, so a recording that is killed opens like any other and ends at most half a second early.
"""

from __future__ import annotations

import errno
import math
import shutil
import sqlite3
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.validate_topic_name import validate_topic_name
from rich.console import Console
from rich.live import Live
from rich.text import Text
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.errors import WriterError
from rosbags.typesys import Stores, get_typestore

from aeropend_ident.bags.container import STORAGES
from aeropend_ident.bags.msgtypes import learn, message_class
from aeropend_ident.bags.writer import PLUGINS, BagWriter
from aeropend_sim.errors import UserError
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.settings import Setting, overrides, read_settings
from aeropend_sim.ros.usage import no_options, usage
from aeropend_sim.ros.worker import Worker

TAKE_S = 0.01
CHECKPOINT_S = 0.5
LOOK_S = 0.2
"""How often new publishers are looked for, s."""
JOINING_S = 1.2
"""While a publisher and its listeners find each other the middleware may lose what is sent in between, s."""
SILENT_S = 2.0
"""A topic of the sample rate that is silent for longer is reported, s."""
DEPTH = 5000
"""Messages the middleware holds for us: ten seconds at the sample rate."""

SAMPLED = {
    interface.JOINT_STATES: "sensor_msgs/msg/JointState",
    interface.ARMATURE: "sensor_msgs/msg/BatteryState",
}
TOPICS = {
    **SAMPLED,
    interface.DUTY_COMMAND: "std_msgs/msg/Float64",
    interface.REFERENCE: "std_msgs/msg/Float64",
    interface.DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}
TRUTH = {
    interface.TRUTH_JOINT_STATES: "sensor_msgs/msg/JointState",
    interface.TRUTH_ARMATURE: "sensor_msgs/msg/BatteryState",
}

SETTINGS = {
    "storage": Setting("mcap", "file format", choices=tuple(PLUGINS)),
    "duration": Setting(0.0, "end this long after the first message of the rig; 0: no end", "s", 0.0, 1e6),
    "while_published": Setting("", "end when the last publisher of this topic has gone"),
    "truth": Setting(False, "record truth/joint_states and truth/armature too"),
    "topics": Setting("", "more topics to record, with commas between them"),
    "all": Setting(False, "record every topic there is"),
    "overwrite": Setting(False, "replace the bag OUT if there is one"),
}

USAGE = usage(
    "record: writes joint_states, armature, duty_command, reference and /diagnostics into the bag OUT (a new folder).",
    SETTINGS,
    [
        "record [OUT] [--ros-args ...]",
        "record my_bag",
        "record my_bag --ros-args -p duration:=70.0",
        "record my_bag --ros-args -p while_published:=duty_command",
        "record my_bag --ros-args -r __ns:=/rig1 -p truth:=true -p storage:=sqlite3",
    ],
    "  OUT is named after the time when it is left out. Ctrl-C ends the recording.",
    "OUT",
)


class Tap:
    """One recorded topic.

    Attributes:
        count: messages written.
        lost: messages that were published to us and did not arrive, as far as their numbers tell.
        lost_joining: those of them while a publisher was new.
        heard: when the last message came (monotonic, s); when the tap was opened, before the first.
    """

    def __init__(self, topic: str, msgtype: str) -> None:
        self.topic = topic
        self.msgtype = msgtype
        self.message_class = message_class(msgtype)
        self.subscription: Any = None
        self.qos: QoSProfile | None = None
        self.connection: Connection | None = None
        self.count = 0
        self.lost = self.lost_joining = 0
        self.heard = time.monotonic()
        self.silent = False
        self.publishers = 0
        self._last: list[int] = []  # number of each publisher's last message, by its own count; the latest at the end
        self._skipped = 0
        self._settled = True  # nobody has been there yet, so whoever comes first is alone
        self._heard_of = False
        self._joined = -math.inf

    def take(self) -> tuple[int, bytes] | None:
        """Take the next message: receive time (ns, 0 if unknown) and what was on the wire. None when there is none."""
        handle = self.subscription.handle
        with handle:
            taken = handle.take_message(self.message_class, True)
        if taken is None:
            return None
        message, info = taken
        number = info["publication_sequence_number"]
        if number is not None:
            # who it is from is not told; of those that it may follow, the nearest: the sum is right whichever it was
            before = max((last for last in self._last if last < number), default=None)
            all_known = len(self._last) >= self.publishers
            if before is not None and (all_known or before == number - 1):
                self._skipped += number - before - 1
                self._last.remove(before)
            self._last.append(number)
        return info["received_timestamp"], message

    def count_publishers(self, publishers: int, now: float) -> None:
        """Note how many publishers there are now (monotonic, s).

        Numbers tell what was lost as long as it is the same publishers. The interval after one has come or gone counts
        as little: it begins with what waits from all.
        """
        alone = publishers <= 1 and (self.publishers == 1 or not self._heard_of)
        settled = alone or publishers == self.publishers > 1
        if settled and self._settled:
            self.lost += self._skipped
            if now <= self._joined + JOINING_S:
                self.lost_joining += self._skipped
            self._last = self._last[-max(publishers, 1):]
        else:
            self._last.clear()
        if publishers > self.publishers:
            self._joined = now
        self._skipped, self._settled = 0, settled
        self._heard_of |= publishers > 0
        self.publishers = publishers


class Record(Node):
    """The node; see the module's docstring."""

    def __init__(self, out: Path) -> None:
        """Prepare to record into `out`.

        Raises:
            UserError: a parameter is wrong, or `out` is there.
        """
        super().__init__("record", automatically_declare_parameters_from_overrides=True)
        settings = read_settings(self, SETTINGS, overrides(self))
        self._out = out
        self._duration: float = settings["duration"]
        self._everything: bool = settings["all"]
        wanted = TOPICS | (TRUTH if settings["truth"] else {})
        self._sampled = {self.resolve_topic_name(name) for name in SAMPLED}
        self._wanted: dict[str, str] = {self.resolve_topic_name(name): kind for name, kind in wanted.items()}
        for name in filter(None, (name.strip() for name in settings["topics"].split(","))):
            self._wanted.setdefault(self._resolve(name), "")
        follow = settings["while_published"]
        self._follow = self._resolve(follow) if follow else ""
        self._follow_seen = False
        self._follow_gone: float | None = None
        self._taps: dict[str, Tap] = {}
        self._refused: set[tuple[str, str]] = set()
        if out.exists() and settings["overwrite"]:
            _remove_bag(out)
        try:
            self._writer = BagWriter(out, settings["storage"])
        except WriterError as error:
            raise UserError(f"{out} exists: give another name, or -p overwrite:=true to replace it") from error
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        # A node of its own, which no executor serves: its subscriptions are read by the thread below.
        self._ears = Node(
            f"_{self.get_name()}_subscriptions",
            namespace=self.get_namespace(),
            context=self.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._first: float | None = None  # when the first message came, monotonic
        self._display = _Display(self, self._duration)
        self._diagnostics = Diagnostics(self, self._report)
        self._worker = Worker(self, self._record, "record")
        self._worker.start()

    def close(self) -> None:
        """Write what is left and close the bag."""
        self._worker.stop()
        self._display.stop()
        self._ears.destroy_node()
        if getattr(self, "error", None) is None:
            self._display.say(self._summary())

    def _resolve(self, topic: str) -> str:
        try:
            validate_topic_name(topic)
        except InvalidTopicNameException as error:
            raise UserError(f"'{topic}' is no topic name") from error
        return str(self.resolve_topic_name(topic))

    # ---- the thread ------------------------------------------------------------------------------------------------

    def _record(self, end: threading.Event) -> None:
        stored = 0
        try:
            self._writer.open()
            checkpoint = look = time.monotonic()
            ends = False
            while not ends:
                now = time.monotonic()
                ends = end.wait(TAKE_S) or self._is_over(now)
                if now >= look or ends:
                    self._look(now)
                    look = now + LOOK_S
                until = time.time_ns() if ends else None  # all topics end there, however long it takes to write them
                for tap in self._taps.values():
                    self._drain(tap, until)
                if now >= checkpoint and not ends:
                    self._writer.checkpoint()
                    stored = sum(self._writer.counts.values())
                    checkpoint = now + CHECKPOINT_S
                self._display.update(now)
            for tap in self._taps.values():
                tap.count_publishers(tap.publishers, now)
            self._writer.close()
        except (OSError, sqlite3.Error, WriterError) as error:
            raise self._failure(error, stored) from error
        finally:
            if self._writer.storage is not None:
                self._writer.abort()

    def _failure(self, error: Exception, stored: int) -> UserError:
        number = getattr(error, "errno", None)
        full = number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) or "full" in str(error)
        what = "the disk is full" if full else getattr(error, "strerror", None) or str(error)
        what = what.replace("disk I/O error", "the disk is full or fails")  # SQLite knows no more of some file systems
        if stored:
            return UserError(f"{self._out}: {what}: the recording ends here, {stored} messages are safe in it")
        shutil.rmtree(self._out, ignore_errors=True)
        return UserError(f"{self._out}: cannot be written: {what}")

    def _drain(self, tap: Tap, until: int | None = None) -> None:
        while (taken := tap.take()) is not None:
            received, message = taken
            if until is not None and received > until:
                return
            if tap.connection is None:
                tap.connection = self._connect(tap)
            self._writer.write(tap.connection, received or time.time_ns(), message)
            tap.count += 1
            tap.heard = time.monotonic()
            if self._first is None and tap.topic != interface.DIAGNOSTICS:  # ours and other nodes' are always there
                self._first = tap.heard

    def _connect(self, tap: Tap) -> Connection:
        """Enter a topic in the bag, with the QoS its publishers offer."""
        publishers = self.get_publishers_info_by_topic(tap.topic)
        return self._writer.add_connection(
            tap.topic,
            tap.msgtype,
            typestore=self._typestore,
            offered_qos_profiles=[_qos_of(info.qos_profile) for info in publishers],
        )

    def _look(self, now: float) -> None:
        """Subscribe to what has appeared, with a QoS that hears all its publishers."""
        wanted = dict(self._wanted)
        if self._everything or not all(wanted.values()):
            for topic, types in self.get_topic_names_and_types():
                if (self._everything and topic not in wanted) or wanted.get(topic) == "":
                    wanted[topic] = types[0]
        for topic, msgtype in wanted.items():
            if msgtype and (topic, msgtype) not in self._refused:
                self._tap(topic, msgtype, now)
        if self._follow:
            there = self.count_publishers(self._follow) > 0
            self._follow_seen = self._follow_seen or there
            if there or not self._follow_seen:
                self._follow_gone = None
            elif self._follow_gone is None:
                self._follow_gone = now

    def _tap(self, topic: str, msgtype: str, now: float) -> None:
        tap = self._taps.get(topic)
        if tap is None:
            try:
                tap = Tap(topic, msgtype)
                learn(self._typestore, msgtype)
            except LookupError as error:
                self._refused.add((topic, msgtype))
                self._display.say(f"{topic} is not recorded: {error}", warn=True)
                return
            self._taps[topic] = tap
        publishers = self.get_publishers_info_by_topic(topic)
        tap.count_publishers(len(publishers), now)
        qos = _qos_for([info.qos_profile for info in publishers])
        if tap.subscription is None or (tap.publishers and qos != tap.qos):
            if tap.subscription is not None:
                self._drain(tap)
                self._ears.destroy_subscription(tap.subscription)
            tap.qos = qos
            tap.subscription = self._ears.create_subscription(tap.message_class, topic, _ignore, qos, raw=True)
        silent = topic in self._sampled and now - tap.heard > SILENT_S
        if silent and not tap.silent:
            since = "no message yet" if not tap.count else "silent"
            self._display.say(f"{topic}: {since}, {tap.publishers} publishers", warn=True)
        elif tap.silent and not silent:
            self._display.say(f"{topic}: messages again")
        tap.silent = silent

    def _is_over(self, now: float) -> bool:
        if self._duration and self._first is not None and now - self._first >= self._duration:
            return True
        return self._follow_gone is not None and now - self._follow_gone >= CHECKPOINT_S

    # ---- what is told ----------------------------------------------------------------------------------------------

    def taps(self) -> list[Tap]:
        """Return the topics recorded so far."""
        return list(self._taps.values())

    def elapsed(self, now: float) -> float:
        """Return the time since the first message, s."""
        return now - self._first if self._first is not None else 0.0

    def shorten(self, topic: str) -> str:
        """Return a topic without the node's own namespace."""
        return topic.removeprefix(self.get_namespace().rstrip("/") + "/")

    def _summary(self) -> str:
        """One line on the whole recording."""
        start, end = self._writer.min_timestamp, self._writer.max_timestamp
        if end == 0:
            return f"{self._out}: no message was received; the bag is empty"
        span = (end - start) / 1e9
        parts = [f"{self.shorten(tap.topic)} {tap.count}" for tap in self.taps() if tap.count]
        lost = {self.shorten(tap.topic): tap.lost for tap in self.taps()}
        joining = sum(tap.lost_joining for tap in self.taps())
        return f"{self._out}: {span:.1f} s recorded: {', '.join(parts)}; {losses(lost, joining)}"

    def _report(self) -> tuple[str, Mapping[str, object]]:
        taps = self.taps()
        counters: dict[str, object] = {"bag": self._out, "lost": sum(tap.lost for tap in taps)}
        counters |= {self.shorten(tap.topic): tap.count for tap in taps}
        silent = [self.shorten(tap.topic) for tap in taps if tap.silent]
        return f"silent: {', '.join(silent)}" if silent else "", counters


class _Display:
    """Progress: one line that changes on a terminal, a line of log every five seconds elsewhere."""

    def __init__(self, node: Record, duration: float) -> None:
        self._node = node
        self._of = f" of {duration:g}" if duration else ""
        self._console = Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False, transient=True) if sys.stderr.isatty() else None
        self._every = 1.0 if self._live else 5.0
        self._at = time.monotonic()
        self._counts: dict[str, int] = {}
        if self._live:
            self._live.start()

    def update(self, now: float) -> None:
        """Show the rates when it is time to."""
        if now - self._at < self._every:
            return
        parts = []
        for tap in self._node.taps():
            rate = (tap.count - self._counts.get(tap.topic, 0)) / (now - self._at)
            self._counts[tap.topic] = tap.count
            if tap.count:
                lost = f" lost {tap.lost}" if tap.lost else ""
                parts.append(f"{self._node.shorten(tap.topic)} {rate:.1f} Hz{lost}")
        self._at = now
        line = f"{self._node.elapsed(now):.0f}{self._of} s   {'   '.join(parts) or 'waiting for messages'}"
        if self._live:
            self._live.update(Text(f"recording {line}", overflow="ellipsis", no_wrap=True), refresh=True)
        else:
            self._node.get_logger().info(line)

    def say(self, text: str, *, warn: bool = False) -> None:
        """Say something once."""
        if self._live:
            self._console.print(Text(text, style="yellow" if warn else ""))
        elif warn:
            self._node.get_logger().warn(text)
        else:
            self._node.get_logger().info(text)

    def stop(self) -> None:
        """Take the changing line away."""
        if self._live:
            self._live.stop()


def losses(lost: Mapping[str, int], joining: int) -> str:
    """Say how many messages of each topic were lost, and how many of them while a publisher was new."""
    if not any(lost.values()):
        return "none lost"
    of = ", ".join(f"{topic} {count}" for topic, count in lost.items() if count)
    when = f", {joining} of them in the first second of a publisher" if joining else ""
    return f"{sum(lost.values())} lost ({of}){when}"


def _ignore(message: bytes) -> None:
    """Stand in for the callback that an executor would call."""


def _qos_for(offered: list[QoSProfile]) -> QoSProfile:
    """Choose a QoS that is compatible with every publisher, and the strictest that is."""
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = bool(offered) and all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _qos_of(qos: QoSProfile) -> Qos:
    """Turn rclpy's QoS into rosbags'."""
    return Qos(
        QosHistory(qos.history.value),
        qos.depth,
        QosReliability(qos.reliability.value),
        QosDurability(qos.durability.value),
        _time(qos.deadline.nanoseconds),
        _time(qos.lifespan.nanoseconds),
        QosLiveliness(qos.liveliness.value),
        _time(qos.liveliness_lease_duration.nanoseconds),
        qos.avoid_ros_namespace_conventions,
    )


def _time(nanoseconds: int) -> QosTime:
    return QosTime(*divmod(nanoseconds, 1_000_000_000))


def _remove_bag(path: Path) -> None:
    """Remove a bag, and only a bag."""
    parts = (*STORAGES, "metadata.yaml")
    if not path.is_dir() or not all(any(part in file.name for part in parts) for file in path.iterdir()):
        raise UserError(f"{path} is no bag, or holds other files too: it is not overwritten, give another name")
    shutil.rmtree(path)


def _out(words: list[str]) -> Path:
    no_options(words)
    if len(words) > 1:
        raise UserError(f"one OUT only, not {' '.join(words)}: see --help")
    return Path(words[0] if words else f"{datetime.now():aeropend_%Y_%m_%d-%H_%M_%S}")


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `record`."""
    return run(Record, args, USAGE, _out)


if __name__ == "__main__":
    sys.exit(main())
