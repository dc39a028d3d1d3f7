# SPDX-License-Identifier: Apache-2.0
"""Excitation of a simulated or real rig by a duty signal.

The node waits for a subscriber of `duty_command`. Then it publishes each change of the duty at its time, and repeats
the duty at least every 20 ms, because a board switches off after 100 ms without a command. Time is the node's clock:
with `use_sim_time` it follows `/clock` at any speed. If the process was stopped, overdue duties are skipped and not
sent late. The last command of the node is duty 0, however it ends.
"""

import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from std_msgs.msg import Float64

from aeropend_sim.errors import UserError
from aeropend_sim.model.excitation import KINDS, LONGEST, MOST_LEVELS, Excitation
from aeropend_sim.model.parameters import LARGEST_SEED, SAMPLE_PERIOD
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.settings import Setting, overrides, read_settings
from aeropend_sim.ros.usage import usage
from aeropend_sim.ros.worker import Worker

PERIOD_NS = round(SAMPLE_PERIOD * 1e9)
REPEAT = 9
"""[samples] Time between repetitions of the same duty: 18.4 ms, well below the board's 100 ms."""
NEWS_S = 5.0
"""[s] Time between lines on progress if there is no terminal (choice)."""

_DEFAULT = Excitation()
SETTINGS = {
    "kind": Setting(_DEFAULT.kind, "the signal", choices=tuple(KINDS)),
    "duration": Setting(_DEFAULT.duration, "length of the signal", "s", 0.01, LONGEST),
    "seed": Setting(_DEFAULT.seed, "the same seed gives the same signal", low=0, high=LARGEST_SEED),
    "duty_min": Setting(_DEFAULT.duty_min, "least duty of latin_hypercube, staircase, multisine", low=-1.0, high=1.0),
    "duty_max": Setting(_DEFAULT.duty_max, "greatest duty of the same", low=-1.0, high=1.0),
    "hold_min": Setting(_DEFAULT.hold_min, "shortest hold of latin_hypercube", "s", SAMPLE_PERIOD, 600.0),
    "hold_max": Setting(
        _DEFAULT.hold_max,
        "longest hold of latin_hypercube; each hold of steps; lift of free_decay",
        "s",
        SAMPLE_PERIOD,
        600.0,
    ),
    "levels": Setting(_DEFAULT.levels, "intervals of latin_hypercube, stairs of staircase", low=2, high=MOST_LEVELS),
    "rest": Setting(_DEFAULT.rest, "duty 0 after each hypercube, and after each lift of free_decay", "s", 0.0, 600.0),
    "duty": Setting(_DEFAULT.duty, "duty of hold and free_decay", low=-1.0, high=1.0),
    "sequence": Setting(list(_DEFAULT.sequence), "duties of steps and holds, repeated", low=-1.0, high=1.0),
    "holds": Setting(list(_DEFAULT.holds), "time of each duty of holds", "s", SAMPLE_PERIOD, LONGEST),
    "frequencies": Setting(list(_DEFAULT.frequencies), "of multisine", "Hz", 1e-4, 0.5 / SAMPLE_PERIOD),
    "duty_rate": Setting(_DEFAULT.duty_rate, "greatest rate of the duty, of every kind; 0: it may jump", "1/s", 0.0,
                         1e3),
}

USAGE = usage(
    "excite: publishes a duty signal on duty_command, then duty 0, and ends.",
    SETTINGS,
    [
        "excite",
        "excite --ros-args -p duration:=30.0 -p seed:=3",
        "excite --ros-args --params-file experiment.yaml",
        "excite --ros-args -p kind:=steps -p 'sequence:=[0.0, 0.3, 0.5]' -p hold_max:=4.0",
    ],
)


def changes(series: np.ndarray, repeat: int = REPEAT) -> np.ndarray:
    """Samples at which a signal must be published: where it changes, and every `repeat` samples in between.

    Args:
        series: [-1..1] (N,) duty.
        repeat: [samples] longest distance.

    Returns:
        (M,) rising indices; the first is 0.
    """
    starts = np.flatnonzero(np.diff(series, prepend=np.nan))
    ends = np.append(starts[1:], len(series))
    return np.concatenate([np.arange(start, end, repeat) for start, end in zip(starts, ends, strict=True)])


class Excite(Node):
    """The node. It ends (`done`) after the signal."""

    def __init__(self) -> None:
        super().__init__("excite", automatically_declare_parameters_from_overrides=True)
        settings = read_settings(self, SETTINGS, overrides(self))
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()
        }
        self._excitation = Excitation(**values)
        self._series = self._excitation.series()
        self._publisher = self.create_publisher(Float64, interface.DUTY_COMMAND, interface.QOS)
        self._sent = 0
        self._left_out = 0
        self._at = 0
        self._start = 0
        self._clock = self.get_clock()
        self._simulated = self._clock.ros_time_is_active
        self._clock_ticked = threading.Event()
        self._jumps = self._clock.create_jump_callback(
            JumpThreshold(min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1)),
            post_callback=lambda _: self._clock_ticked.set(),
        )
        self._diagnostics = Diagnostics(self, self._report)
        self._worker = Worker(self, self._excite, "duty")
        self._worker.start()

    def close(self) -> None:
        """Stop the signal; its thread sends duty 0."""
        self._worker.stop()

    def _excite(self, end: threading.Event) -> None:
        try:
            if self._wait_for_listener(end) and self._wait_for_clock(end):
                self._play(end)
        finally:
            self._rest()

    def _wait_for_listener(self, end: threading.Event) -> bool:
        topic = self._publisher.topic_name
        return self._wait(
            lambda: self._publisher.get_subscription_count() > 0,
            f"no subscriber to {topic} yet: waiting for a plant or a bridge",
            end,
        )

    def _wait_for_clock(self, end: threading.Event) -> bool:
        return self._wait(self._now, "use_sim_time is set: waiting for /clock", end)

    def _wait(self, condition: Callable[[], Any], message: str, end: threading.Event) -> bool:
        """Wait for a condition and log `message` every few seconds. False if the node is to stop."""
        patience = time.monotonic() + 1.0
        while not condition():
            if end.wait(0.05):
                return False
            if time.monotonic() > patience:
                self.get_logger().info(message)
                patience = time.monotonic() + NEWS_S
        return True

    def _play(self, end: threading.Event) -> None:
        series, due = self._series, changes(self._series)
        x = self._excitation
        self.get_logger().info(f"{x.kind}, {x.duration:g} s, duty {series.min():.3g} to {series.max():.3g}")
        self._start = self._now()
        with ProgressShow(x.kind, x.duration, self.get_logger().info) as progress:
            i = 0
            while i < len(due):
                if not self._sleep_until(int(due[i]), end):
                    return
                self._at = min((self._now() - self._start) // PERIOD_NS, len(series) - 1)
                following = int(np.searchsorted(due, self._at, side="right"))
                self._left_out += following - i - 1
                i = following
                self._publisher.publish(Float64(data=float(series[self._at])))
                self._sent += 1
                progress.show(self._at * SAMPLE_PERIOD)
            self._sleep_until(len(series), end)
            progress.show(x.duration)

    def _now(self) -> int:
        """[ns] The node's time; in real time the monotonic clock, which cannot be set."""
        return int(self._clock.now().nanoseconds) if self._simulated else time.monotonic_ns()

    def _sleep_until(self, sample: int, end: threading.Event) -> bool:
        """Sleep until the time of this sample. False if the node is to stop."""
        while not end.is_set():
            self._clock_ticked.clear()
            now = self._now()
            if now < self._start:
                raise UserError("/clock went back: was the plant started again? Start excite again as well")
            left = self._start + sample * PERIOD_NS - now
            if left <= 0:
                return True
            if self._simulated:
                self._clock_ticked.wait(0.1)
            else:
                time.sleep(min(left * 1e-9, 0.1))
        return False

    def _rest(self) -> None:
        """Send duty 0 ten times in 0.2 s. A confirmation by the middleware would take up to 3 s (its heartbeat)."""
        for _ in range(10):
            self._publisher.publish(Float64(data=0.0))
            time.sleep(0.02)

    def _report(self) -> tuple[str, dict[str, object]]:
        values = {
            "kind": self._excitation.kind,
            "seconds": self._at * SAMPLE_PERIOD,
            "of seconds": len(self._series) * SAMPLE_PERIOD,
            "sent": self._sent,
            "left out": self._left_out,
        }
        return "", values


class ProgressShow:
    """Shows progress: a bar on a terminal, else a line every few seconds.

    Args:
        label: name of the task.
        total_s: [s] length of the task.
        log: gets each line.
    """

    def __init__(self, label: str, total_s: float, log: Callable[[str], Any]) -> None:
        console = Console(stderr=True)
        self._total_s = total_s
        self._log = log
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(label, total=total_s)
        self._due = time.monotonic() + NEWS_S

    def __enter__(self) -> "ProgressShow":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, done_s: float) -> None:
        """Show the time [s] that is done."""
        self._bar.update(self._task, completed=done_s)
        if self._bar.disable and time.monotonic() > self._due:
            self._due += NEWS_S
            self._log(f"{done_s:.0f} of {self._total_s:.0f} s")


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `excite`."""
    return run(Excite, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
