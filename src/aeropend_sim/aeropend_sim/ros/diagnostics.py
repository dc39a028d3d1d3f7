# SPDX-License-Identifier: Apache-2.0
"""The counters of a node on `/diagnostics`."""

import time
from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from aeropend_sim.ros import interface


class CpuShare:
    """CPU time of this process over wall time."""

    def __init__(self) -> None:
        self._last = time.monotonic(), time.process_time()

    def since_last(self) -> float:
        """CPU share since the last call: 1 is one core."""
        (wall_before, cpu_before), (wall, cpu) = self._last, (time.monotonic(), time.process_time())
        self._last = wall, cpu
        return (cpu - cpu_before) / (wall - wall_before) if wall > wall_before else 0.0


class Diagnostics:
    """Publishes the counters of a node on `/diagnostics` once per second of wall time.

    Args:
        node: the node.
        report: returns the present warning ("" for none) and the counters.
        hardware_id: the device that the node stands for.
        further: returns statuses that are published with the node's own.
    """

    def __init__(
        self,
        node: Node,
        report: Callable[[], tuple[str, Mapping[str, object]]],
        hardware_id: str = "",
        further: Callable[[], list[DiagnosticStatus]] = list,
    ) -> None:
        self._node = node
        self._report = report
        self._hardware_id = hardware_id
        self._further = further
        self._publisher = node.create_publisher(DiagnosticArray, interface.DIAGNOSTICS, interface.QOS)
        # wall time: a node must report even when its /clock has stopped
        self._timer = node.create_timer(1.0, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Publish the counters now."""
        warning, values = self._report()
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if warning else DiagnosticStatus.OK,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=warning or "ok",
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status, *self._further()])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
