# SPDX-License-Identifier: Apache-2.0
"""A thread of a node, whose errors end the program."""

import threading
from collections.abc import Callable

from rclpy.node import Node


class Worker(threading.Thread):
    """A thread of a node. An exception in it ends the program, like an exception in a callback.

    Args:
        node: gets the attribute `error` when `target` raises, and `done` when it returns.
        target: called with an event; it returns soon after the event is set.
        name: name of the thread, as system tools show it.
    """

    def __init__(self, node: Node, target: Callable[[threading.Event], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._node = node
        self._body = target
        self._end = threading.Event()

    def run(self) -> None:
        """Run the target; this is the thread's body."""
        try:
            self._body(self._end)
            self._node.done = True
        except Exception as error:  # the main thread raises it
            self._node.error = error

    def stop(self) -> None:
        """Ask the target to return, and wait until it has returned."""
        self._end.set()
        if self.is_alive():
            self.join()


def wait_until(condition: Callable[[], bool], stop: threading.Event, poll_s: float = 0.05) -> bool:
    """Wait until a condition holds.

    Args:
        condition: polled.
        stop: ends the wait early.
        poll_s: [s] time between two polls.

    Returns:
        Whether the condition holds; False if `stop` was set first.
    """
    while not condition():
        if stop.wait(poll_s):
            return False
    return True
