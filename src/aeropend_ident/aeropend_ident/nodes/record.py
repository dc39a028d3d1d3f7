# SPDX-License-Identifier: Apache-2.0
"""The node that records a rig's topics into a rosbag2 bag.

Serialized messages are written with the time at which the middleware received them. A thread takes them from the
subscriptions in batches, without an executor: that costs a fraction of the time. While the disk is slow, messages wait
in the middleware, for up to ten seconds. Twice a second a checkpoint makes the bag complete on disk, so a recording
that is killed opens like any other and ends at most half a second early.
"""

from __future__ import annotations

import errno
import shutil
import sqlite3
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.validate_topic_name import validate_topic_name
from rich.console import Console
from rich.live import Live
from rich.text import Text
from rosbags.interfaces import Connection
from rosbags.rosbag2.errors import WriterError
from rosbags.typesys import Stores, get_typestore

from aeropend_ident.bags.container import STORAGES
from aeropend_ident.bags.msgtypes import learn
from aeropend_ident.bags.recording import split_topic
from aeropend_ident.bags.writer import PLUGINS, BagWriter
from aeropend_ident.nodes.topic_recorder import TopicRecorder, qos_of
from aeropend_sim.errors import UserError
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.settings import Setting, overrides, read_settings
from aeropend_sim.ros.usage import no_options, usage
from aeropend_sim.ros.worker import Worker

TAKE_S = 0.01
"""[s] Time between two readings of the subscriptions (choice: much shorter than the middleware holds messages)."""

CHECKPOINT_S = 0.5
"""[s] Time between two checkpoints of the bag: what a kill may lose (choice)."""

LOOK_S = 0.2
"""[s] Time between two looks for new publishers (choice)."""

SILENT_S = 2.0
"""[s] Time without a message after which a sampled topic is reported (choice: a thousand sample periods)."""

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
    "while_published": Setting("", "end when this topic has no publisher any more"),
    "truth": Setting(False, "record truth/joint_states and truth/armature too"),
    "topics": Setting("", "further topics to record, separated by commas"),
    "all": Setting(False, "record all topics"),
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
    "  Without OUT the bag is named after the time. Ctrl-C ends the recording.",
    "OUT",
)


class Record(Node):
    """The node; see the module's docstring."""

    def __init__(self, out: Path) -> None:
        """Prepare the recording.

        Raises:
            UserError: a parameter is wrong, or `out` exists.
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
        self._recorders: dict[str, TopicRecorder] = {}
        self._refused: set[tuple[str, str]] = set()
        try:
            if out.exists() and settings["overwrite"]:
                _remove_bag(out)
            self._writer = BagWriter(out, settings["storage"])
        except WriterError as error:
            raise UserError(f"{out} exists: give another name, or -p overwrite:=true to replace it") from error
        except OSError as error:
            raise UserError(f"{out}: cannot be written: {error.strerror}; give another name") from error
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        # No executor serves this node: the thread below reads its subscriptions.
        self._subscriber = Node(
            f"_{self.get_name()}_subscriptions",
            namespace=self.get_namespace(),
            context=self.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._first: float | None = None  # when the first message of the rig came, monotonic
        self._display = _Display(self, self._duration)
        self._diagnostics = Diagnostics(self, self._report)
        self._worker = Worker(self, self._record, "record")
        self._worker.start()

    def close(self) -> None:
        """Write what is left and close the bag."""
        self._worker.stop()
        self._display.stop()
        self._subscriber.destroy_node()
        if getattr(self, "error", None) is None:
            self._display.say(self._summary())

    def _resolve(self, topic: str) -> str:
        try:
            validate_topic_name(topic)
        except InvalidTopicNameException as error:
            raise UserError(f"'{topic}' is not a topic name") from error
        return str(self.resolve_topic_name(topic))

    # ---- the thread ------------------------------------------------------------------------------------------------

    def _record(self, end: threading.Event) -> None:
        stored = 0
        try:
            self._writer.open()
            checkpoint = look = now = time.monotonic()
            ends = False
            while not ends:
                now = time.monotonic()
                ends = end.wait(TAKE_S) or self._is_over(now)
                if now >= look or ends:
                    self._look(now)
                    look = now + LOOK_S
                until = time.time_ns() if ends else None  # all topics end at this time, however long the writing takes
                for recorder in self._recorders.values():
                    self._drain(recorder, until)
                if now >= checkpoint and not ends:
                    self._writer.checkpoint()
                    stored = sum(self._writer.counts.values())
                    checkpoint = now + CHECKPOINT_S
                self._display.update(now)
            for recorder in self._recorders.values():
                recorder.count_publishers(recorder.publishers, now)
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
        what = what.replace("disk I/O error", "the disk is full or fails")  # SQLite reports no more on some disks
        if stored:
            return UserError(f"{self._out}: {what}: the recording ends here, {stored} messages are safe in it")
        shutil.rmtree(self._out, ignore_errors=True)
        return UserError(f"{self._out}: cannot be written: {what}")

    def _drain(self, recorder: TopicRecorder, until: int | None = None) -> None:
        while (taken := recorder.take()) is not None:
            received, message = taken
            if until is not None and received > until:
                return
            if recorder.connection is None:
                recorder.connection = self._connect(recorder)
            self._writer.write(recorder.connection, received or time.time_ns(), message)
            recorder.count += 1
            recorder.heard = time.monotonic()
            if self._first is None and self._is_of_rig(recorder):
                self._first = recorder.heard

    def _is_of_rig(self, recorder: TopicRecorder) -> bool:
        """Whether a rig sends this topic by itself, in any namespace: with `all` it may be any."""
        split = split_topic(recorder.topic, recorder.msgtype)
        return recorder.topic in self._sampled or (split is not None and split[1] in SAMPLED)

    def _connect(self, recorder: TopicRecorder) -> Connection:
        """Add a topic to the bag, with the QoS that its publishers offer."""
        publishers = self.get_publishers_info_by_topic(recorder.topic)
        return self._writer.add_connection(
            recorder.topic,
            recorder.msgtype,
            typestore=self._typestore,
            offered_qos_profiles=[qos_of(info.qos_profile) for info in publishers],
        )

    def _look(self, now: float) -> None:
        """Subscribe to new topics, with a QoS that all their publishers are compatible with."""
        wanted = dict(self._wanted)
        if self._everything or not all(wanted.values()):
            for topic, types in self.get_topic_names_and_types():
                if (self._everything and topic not in wanted) or wanted.get(topic) == "":
                    wanted[topic] = types[0]
        for topic, msgtype in wanted.items():
            if msgtype and (topic, msgtype) not in self._refused:
                self._update(topic, msgtype, now)
        if self._follow:
            there = self.count_publishers(self._follow) > 0
            self._follow_seen = self._follow_seen or there
            if there or not self._follow_seen:
                self._follow_gone = None
            elif self._follow_gone is None:
                self._follow_gone = now

    def _update(self, topic: str, msgtype: str, now: float) -> None:
        recorder = self._recorders.get(topic)
        if recorder is None:
            try:
                recorder = TopicRecorder(topic, msgtype)
                learn(self._typestore, msgtype)
            except LookupError as error:
                self._refused.add((topic, msgtype))
                self._display.say(f"{topic} is not recorded: {error}", warn=True)
                return
            self._recorders[topic] = recorder
        recorder.follow(self._subscriber, self.get_publishers_info_by_topic(topic), now,
                        partial(self._drain, recorder))
        silent = topic in self._sampled and now - recorder.heard > SILENT_S
        if silent and not recorder.silent:
            since = "no message yet" if not recorder.count else "silent"
            self._display.say(f"{topic}: {since}, {recorder.publishers} publishers", warn=True)
        elif recorder.silent and not silent:
            self._display.say(f"{topic}: messages again")
        recorder.silent = silent

    def _is_over(self, now: float) -> bool:
        if self._duration and self._first is not None and now - self._first >= self._duration:
            return True
        return self._follow_gone is not None and now - self._follow_gone >= CHECKPOINT_S

    # ---- reports ----------------------------------------------------------------------------------------------

    def recorders(self) -> list[TopicRecorder]:
        """Return the topics recorded so far."""
        return list(self._recorders.values())

    def elapsed(self, now: float) -> float:
        """Return the time since the first message of the rig, s."""
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
        parts = [f"{self.shorten(recorder.topic)} {recorder.count}" for recorder in self.recorders() if recorder.count]
        lost = {self.shorten(recorder.topic): recorder.lost for recorder in self.recorders()}
        joining = sum(recorder.lost_joining for recorder in self.recorders())
        return f"{self._out}: {span:.1f} s recorded: {', '.join(parts)}; {losses(lost, joining)}"

    def _report(self) -> tuple[str, Mapping[str, object]]:
        recorders = self.recorders()
        counters: dict[str, object] = {"bag": self._out, "lost": sum(recorder.lost for recorder in recorders)}
        counters |= {self.shorten(recorder.topic): recorder.count for recorder in recorders}
        silent = [self.shorten(recorder.topic) for recorder in recorders if recorder.silent]
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
        """Show the rates, if the last time was long enough ago."""
        if now - self._at < self._every:
            return
        parts = []
        for recorder in self._node.recorders():
            rate = (recorder.count - self._counts.get(recorder.topic, 0)) / (now - self._at)
            self._counts[recorder.topic] = recorder.count
            if recorder.count:
                lost = f" lost {recorder.lost}" if recorder.lost else ""
                parts.append(f"{self._node.shorten(recorder.topic)} {rate:.1f} Hz{lost}")
        self._at = now
        line = f"{self._node.elapsed(now):.0f}{self._of} s   {'   '.join(parts) or 'waiting for messages'}"
        if self._live:
            self._live.update(Text(f"recording {line}", overflow="ellipsis", no_wrap=True), refresh=True)
        else:
            self._node.get_logger().info(line)

    def say(self, text: str, *, warn: bool = False) -> None:
        """Print a line that stays."""
        if self._live:
            self._console.print(Text(text, style="yellow" if warn else ""))
        elif warn:
            self._node.get_logger().warn(text)
        else:
            self._node.get_logger().info(text)

    def stop(self) -> None:
        """Remove the line that changes."""
        if self._live:
            self._live.stop()


def losses(lost: Mapping[str, int], joining: int) -> str:
    """A sentence on the messages lost of each topic, and on those lost while a publisher was new."""
    if not any(lost.values()):
        return "none lost"
    of = ", ".join(f"{topic} {count}" for topic, count in lost.items() if count)
    when = f", {joining} of them in the first second of a publisher" if joining else ""
    return f"{sum(lost.values())} lost ({of}){when}"


def _remove_bag(path: Path) -> None:
    """Remove a bag, and only a bag."""
    if path.is_symlink():  # whoever gives the name of a link need not know which recording it stands for
        raise UserError(f"{path} is a link to {path.resolve()}: it is not overwritten, give that name or another one")
    if path.resolve() == Path.cwd():
        raise UserError(f"{path} is the folder in which record runs: it is not overwritten, go out of it first")
    parts = (*STORAGES, "metadata.yaml")
    if not path.is_dir() or not all(any(part in file.name for part in parts) for file in path.iterdir()):
        raise UserError(f"{path} is not a bag, or holds other files too: it is not overwritten, give another name")
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
