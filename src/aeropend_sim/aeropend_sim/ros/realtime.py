# SPDX-License-Identifier: Apache-2.0
"""Timing of a periodic thread: priority, garbage collector, and the offset between the two clocks."""

import gc
import os
import sys
import time
from contextlib import suppress
from pathlib import Path

CLOCK_STEP_NS = 50_000_000
"""[ns] Greater change of the offset between the clocks means that the system clock was set. A choice."""


def prepare_thread() -> None:
    """Keep other threads and the garbage collector from delaying this one."""
    sys.setswitchinterval(0.0002)
    gc.collect()
    gc.freeze()


def request_realtime_priority() -> None:
    """Ask for real-time priority for all threads of this process. Without the permission, nothing changes.

    Root has the permission, and users with a limit on `rtprio`. All threads need the priority: otherwise a thread that
    holds a lock for which the sampling thread waits would itself wait for other programs.
    """
    with suppress(OSError):
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(1))


def monotonic_to_ros_ns() -> int:
    """System time minus `time.monotonic_ns()`, ns. The reading with the smallest uncertainty of five."""
    readings = []
    for _ in range(5):
        before = time.monotonic_ns()
        now = time.time_ns()
        after = time.monotonic_ns()
        readings.append((after - before, now - (before + after) // 2))
    return min(readings)[1]
