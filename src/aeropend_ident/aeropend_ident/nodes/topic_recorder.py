# SPDX-License-Identifier: Apache-2.0
"""One topic of a recording: its subscription, its counts, and its QoS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from aeropend_ident.bags.msgtypes import message_class

JOINING_S = 1.2
"""[s] Time in which a publisher and its subscriptions find each other; the middleware may lose messages meanwhile.

Choice: discovery of this middleware takes some tenths of a second."""

DEPTH = 5000
"""Messages that the middleware holds for a subscription: ten seconds at the sample rate."""


class TopicRecorder:
    """One recorded topic.

    Attributes:
        topic: its full name.
        msgtype: its message type.
        message_class: the class of that type.
        subscription: to the topic; None before the first publisher was looked for.
        qos: of the subscription.
        connection: of the topic in the bag; None before the first message.
        count: number of messages written.
        lost: number of messages that were published and did not arrive, as their sequence numbers show.
        lost_joining: number of these while a publisher was new.
        heard: [s] monotonic time of the last message; before the first, of the subscription.
        silent: whether the topic was reported as silent.
        publishers: number of publishers.
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
        self._last: list[int] = []  # last sequence number of each publisher; the latest at the end
        self._skipped = 0
        self._settled = True  # no publisher so far: the first one will be alone
        self._heard_of = False
        self._joined = -math.inf

    def take(self) -> tuple[int, bytes] | None:
        """Take the next message: receive time [ns] (0 if unknown) and serialized message. None if there is none."""
        handle = self.subscription.handle
        with handle:
            taken = handle.take_message(self.message_class, True)
        if taken is None:
            return None
        message, info = taken
        number = info["publication_sequence_number"]
        if number is not None:
            # the publisher is not known; the nearest number that it may follow gives the right sum for any publisher
            before = max((last for last in self._last if last < number), default=None)
            all_known = len(self._last) >= self.publishers
            if before is not None and (all_known or before == number - 1):
                self._skipped += number - before - 1
                self._last.remove(before)
            self._last.append(number)
        return info["received_timestamp"], message

    def follow(self, subscriber: Node, publishers: Sequence[TopicEndpointInfo], now: float, drain: Callable[[], None]
               ) -> None:
        """Subscribe with a QoS that all publishers are compatible with, unless the subscription has it already.

        Args:
            subscriber: node of the subscription.
            publishers: of the topic now.
            now: [s] monotonic time.
            drain: takes what waits in the subscription, before another one takes its place.
        """
        self.count_publishers(len(publishers), now)
        qos = qos_for([info.qos_profile for info in publishers])
        if self.subscription is not None and (not publishers or qos == self.qos):
            return
        if self.subscription is not None:
            drain()
            subscriber.destroy_subscription(self.subscription)
        self.qos = qos
        self.subscription = subscriber.create_subscription(self.message_class, self.topic, _ignore, qos, raw=True)

    def count_publishers(self, publishers: int, now: float) -> None:
        """Note the number of publishers.

        The sequence numbers show losses as long as the publishers stay the same. The interval after a change does not
        count either: it begins with waiting messages of all publishers.

        Args:
            publishers: their number now.
            now: [s] monotonic time.
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


def qos_for(offered: list[QoSProfile]) -> QoSProfile:
    """The strictest QoS that is compatible with every publisher."""
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = bool(offered) and all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def qos_of(qos: QoSProfile) -> Qos:
    """A QoS of rclpy as one of rosbags."""
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


def _ignore(message: bytes) -> None:
    """A callback that is never called: no executor serves the subscription."""


def _time(nanoseconds: int) -> QosTime:
    return QosTime(*divmod(nanoseconds, 1_000_000_000))
