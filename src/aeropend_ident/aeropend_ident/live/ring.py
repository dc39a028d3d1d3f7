# SPDX-License-Identifier: Apache-2.0
"""The messages of the last seconds, and the bag of the time around an alarm."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.rosbag2.errors import WriterError
from rosbags.typesys import Stores, get_typestore

from aeropend_ident.bags.msgtypes import learn
from aeropend_ident.bags.writer import BagWriter

BEFORE_S, AFTER_S = 45.0, 15.0
"""[s] Of a bag, before and after the alarm (choice: a minute, as `diagnose` needs, whose verdict is wanted soon)."""

AT_ONCE = 2000
"""Messages that are written in one go (choice: some hundredths of a second)."""

MOST = 200_000
"""Messages that are kept at most (choice: three times those of the sample rate)."""


class Message(NamedTuple):
    """One message: receive time [ns], topic, serialized."""

    received: int
    topic: str
    data: bytes


class Ring:
    """Keeps the messages of the last `BEFORE_S` seconds."""

    def __init__(self) -> None:
        self.messages: deque[Message] = deque(maxlen=MOST)

    def add(self, message: Message) -> None:
        """Keep a message, and drop what is too old."""
        self.messages.append(message)
        oldest = message.received - round(BEFORE_S * 1e9)
        while self.messages[0].received < oldest:
            self.messages.popleft()


class AlarmBag:
    """A bag that begins with what the ring holds and goes on with what comes.

    Args:
        path: folder to make; if it is there, the next that is not: `path_2`.
        ring: the messages before the alarm.
        types: topic -> message type.
        offered: returns the QoS that the publishers of a topic offer, as for `BagWriter.add_connection`.
        alarm_ns: [ns] receive time of the alarm.

    Attributes:
        path: folder of the bag.
        end_ns: [ns] receive time after which a message is not taken any more.

    Raises:
        OSError: the disk is full or failed, or the folder cannot be made.
    """

    def __init__(self, path: Path, ring: Ring, types: dict[str, str], offered: Callable[[str], Any], alarm_ns: int
                 ) -> None:
        self.end_ns = alarm_ns + round(AFTER_S * 1e9)
        self._types, self._offered = types, offered
        self._waiting = deque(ring.messages)
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Any] = {}
        self._writer = _opened(path)
        self.path = self._writer.path

    def add(self, message: Message) -> None:
        """Take a message that came after the alarm."""
        if message.received <= self.end_ns:
            self._waiting.append(message)

    def write(self, now_ns: int) -> bool:
        """Write some of what waits; returns whether the bag is complete and closed.

        Raises:
            OSError: the disk is full or failed; the bag is given up.
        """
        self._write(AT_ONCE)
        if self._waiting or now_ns < self.end_ns:
            return False
        self.close()
        return True

    def close(self) -> None:
        """Write what waits, and end the bag.

        Raises:
            OSError: as for `write`.
        """
        self._write(len(self._waiting), last=True)

    def _write(self, most: int, *, last: bool = False) -> None:
        try:
            for _ in range(min(most, len(self._waiting))):
                self._put(self._waiting.popleft())
            if last:
                self._writer.close()
        except Exception:
            self._writer.abort()  # else its file stays open
            raise

    def _put(self, message: Message) -> None:
        if message.topic not in self._connections:
            msgtype = self._types[message.topic]
            learn(self._typestore, msgtype)
            self._connections[message.topic] = self._writer.add_connection(
                message.topic, msgtype, typestore=self._typestore, offered_qos_profiles=self._offered(message.topic))
        self._writer.write(self._connections[message.topic], message.received, message.data)


def _opened(path: Path, number: int = 1) -> BagWriter:
    """A new bag at a path, or beside it: two watchers may give the alarm in the same second into the same folder."""
    own = path if number == 1 else path.with_name(f"{path.name}_{number}")
    try:
        writer = BagWriter(own)
        writer.open()
    except WriterError:
        if not own.exists():
            raise
        return _opened(path, number + 1)
    return writer
