# SPDX-License-Identifier: Apache-2.0
"""The command that gives a controller a reference: waits until somebody listens, sends it, and ends."""

from __future__ import annotations

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
"""How often the reference is sent, and s in between: confirmation by the middleware would take up to 3 s."""
NEWS_S = 3.0
"""s after which it says that nobody listens."""

USAGE = usage(
    "reference: gives a controller its reference, and ends. Rad from hanging; for cascade the rotor's speed in rad/s.",
    {},
    [
        "reference VALUE [--ros-args ...]",
        "reference 0.4",
        "reference 0.4 --ros-args -r __ns:=/rig1",
    ],
    "It waits for a controller, which refuses what is out of its range, says so, and keeps the reference it had.\n"
    "ros2 topic pub --once /reference std_msgs/msg/Float64 '{data: 0.4}' does the same.",
    "VALUE",
)


class Reference(Node):
    """Sends one value until it surely has been heard."""

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
        start, said = time.monotonic(), False

        def heard() -> bool:
            nonlocal said
            if not said and time.monotonic() > start + NEWS_S:
                said = True
                self.get_logger().info(f"nobody listens to {self._publisher.topic_name} yet: waiting for a controller")
            return bool(self._publisher.get_subscription_count())

        if wait_until(heard, end):
            for _ in range(REPEATS):
                self._publisher.publish(Float64(data=self._value))
                time.sleep(REPEAT_S)


def value_of(words: Sequence[str]) -> float:
    """The reference that the arguments give.

    Raises:
        UserError: none, more than one, or not a number.
    """
    if len(words) != 1:
        raise UserError(f"give one number, not {' '.join(words) or 'none'}: reference 0.4 (see --help)")
    try:
        return float(words[0])
    except ValueError:
        raise UserError(f"'{words[0]}' is no number: reference 0.4 (see --help)") from None


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `reference`."""
    return run(Reference, args, USAGE, value_of)


if __name__ == "__main__":
    sys.exit(main())
