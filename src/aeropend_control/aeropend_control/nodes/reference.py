# SPDX-License-Identifier: Apache-2.0
"""Command that sends a reference to a controller: it waits for a subscriber, sends the reference, and ends."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Sequence

from rclpy.node import Node
from std_msgs.msg import Float64

from aeropend_sim.errors import UserError
from aeropend_sim.ros import interface
from aeropend_sim.ros.program import run
from aeropend_sim.ros.usage import usage
from aeropend_sim.ros.worker import Worker, wait_until

REPEATS, REPEAT_S = 10, 0.02
"""Number of times that the reference is sent, and [s] time between them. A confirmation by the middleware would take
up to 3 s (its heartbeat)."""
NEWS_S = 3.0
"""[s] Time after which a message reports that there is no subscriber (choice)."""

USAGE = usage(
    "reference: sends a reference to a controller, and ends. Angle in rad from hanging; for cascade speed in rad/s.",
    {},
    [
        "reference VALUE [--ros-args ...]",
        "reference 0.4",
        "reference 0.4 --ros-args -r __ns:=/rig1",
    ],
    "It waits for a controller. A controller refuses a value out of its range, reports that, and keeps the old one.\n"
    "ros2 topic pub --once /reference std_msgs/msg/Float64 '{data: 0.4}' does the same.",
    "VALUE",
)


class Reference(Node):
    """The node. It sends one value several times and ends."""

    def __init__(self, value: float) -> None:
        super().__init__("reference")
        self._value = value
        self._publisher = self.create_publisher(Float64, interface.REFERENCE, interface.QOS)
        self._worker = Worker(self, self._send, "reference")
        self._worker.start()

    def close(self) -> None:
        """Stop waiting."""
        self._worker.stop()

    def _send(self, end: threading.Event) -> None:
        start, reported = time.monotonic(), False

        def has_subscriber() -> bool:
            nonlocal reported
            if not reported and time.monotonic() > start + NEWS_S:
                reported = True
                self.get_logger().info(f"no subscriber to {self._publisher.topic_name} yet: waiting for a controller")
            return bool(self._publisher.get_subscription_count())

        if wait_until(has_subscriber, end):
            for _ in range(REPEATS):
                self._publisher.publish(Float64(data=self._value))
                time.sleep(REPEAT_S)


def value_of(words: Sequence[str]) -> float:
    """The reference on the command line.

    Args:
        words: the arguments without those for ROS.

    Raises:
        UserError: no argument, more than one, or not a number.
    """
    if len(words) != 1:
        raise UserError(f"give one number, not {' '.join(words) or 'none'}: reference 0.4 (see --help)")
    try:
        value = float(words[0])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"'{words[0]}' is not a number: reference 0.4 (see --help)")
    return value


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `reference`."""
    return run(Reference, args, USAGE, value_of)


if __name__ == "__main__":
    sys.exit(main())
