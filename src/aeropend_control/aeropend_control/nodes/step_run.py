# SPDX-License-Identifier: Apache-2.0
"""The command `step_test`: it steps the reference of a running controller and describes the step responses.

The messages of the rig are stored as received and decoded after the test. A reference counts from the first sample
after it was sent. The last reference is 0.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node
from rich.console import Console
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_control.analysis import step_report
from aeropend_control.analysis.step_response import StepResponse, step_responses
from aeropend_control.laws.registry import LAWS
from aeropend_control.nodes import wire
from aeropend_control.nodes.excite import ProgressShow
from aeropend_sim.cli.command import Parser
from aeropend_sim.errors import UserError
from aeropend_sim.readings import MOST
from aeropend_sim.ros import interface
from aeropend_sim.ros.program import run
from aeropend_sim.ros.usage import EXIT_CODES
from aeropend_sim.ros.worker import Worker, wait_until

LEVELS = {"theta": (0.2, 0.4, 0.7), "omega": (99.5,)}
"""[rad], [rad/s] Default levels, by what is measured (choices); 99.5 rad/s is the thesis' 950 RPM."""
FILES = ("steps.csv", "steps.json", "steps.svg")
MATCHED_S = 0.5
"""[s] Time for the controller to discover this node (choice)."""
NAMES_S = 5.0
"""[s] Longest wait for the node names of the subscribers (choice)."""
SILENT_S = 2.0
"""[s] Wall time without a sample after which the test is aborted (choice)."""
NEWS_S = 5.0
"""[s] Time between messages while waiting (choice)."""
REPEATS, REPEAT_S = 3, 0.01
"""Number of times that a reference is sent, and [s] time between them (choices)."""

EXAMPLES = f"""\
examples, with a plant or bridge and a controller running:
  step_test
  step_test --levels 0.1 0.3 0.1 --hold 4 --out my_steps
  step_test --ros-args -r __ns:=/rig1

It writes steps.csv (the samples), steps.json (the figures) and steps.svg (a drawing) to DIR. To record a bag of the
test, first start `record my_bag --ros-args -p while_published:=reference`. `step_response my_bag` prints the table from
the bag.

{EXIT_CODES}"""


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line, without ROS arguments; exits with code 2 and one line if it is wrong."""
    parser = Parser(
        prog="step_test", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Step a running controller's reference, and print t_r, t_p, t_s, M_p and the steady-state error "
                    "with their limits (Table 6.1 of the thesis).")
    parser.add_argument("--levels", nargs="+", type=float, metavar="LEVEL",
                        help="values of the reference, rad (rad/s for cascade); default 0.2 0.4 0.7; for cascade 99.5")
    parser.add_argument("--hold", type=float, default=5.0, metavar="S", help="time at each level, default 5 s")
    parser.add_argument("--law", choices=LAWS, help="the running controller; default: the subscriber of reference")
    parser.add_argument("--out", type=Path, metavar="DIR",
                        help="folder for the results; default: a new one, named after date and time")
    parser.add_argument("--overwrite", action="store_true", help="replace existing results in DIR")
    options = parser.parse_args(arguments)
    if not 0.5 <= options.hold <= 600.0:
        parser.error(f"--hold {options.hold:g}: give 0.5 to 600 s")
    for level in options.levels or ():
        if not math.isfinite(level):
            parser.error(f"--levels {level:g}: give numbers")
    if options.out is None:
        options.out = Path(f"{datetime.now():step_test_%Y_%m_%d-%H_%M_%S}")
    there = [name for name in FILES if (options.out / name).exists()]
    if there and not options.overwrite:
        parser.error(f"{options.out} holds {there[0]} already: give another --out, or --overwrite")
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"{options.out} is no folder: give another --out")
    return options


class StepTest(Node):
    """The node. It ends (`done`) after the steps.

    Attributes:
        outcome: prints the results; None if the test did not finish.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("step_test")
        self.outcome: Callable[[Console], None] | None = None
        self._options = options
        self._joints: list[bytes] = []
        self._armatures: list[bytes] = []
        self._heard = time.monotonic()
        self._steps: list[tuple[int, float]] = []  # stamp [ns] of the last sample before, and the reference
        qos = interface.QOS
        self._publisher = self.create_publisher(Float64, interface.REFERENCE, qos)
        self.create_subscription(JointState, interface.JOINT_STATES, self._on_joint_states, qos, raw=True)
        self.create_subscription(BatteryState, interface.ARMATURE, self._on_armature, qos, raw=True)
        self._worker = Worker(self, self._test, "steps")
        self._worker.start()

    def close(self) -> None:
        """Stop the test."""
        self._worker.stop()

    def _on_joint_states(self, message: bytes) -> None:
        with suppress(*wire.MALFORMED):
            wire.joints(message)
            self._joints.append(message)
            self._heard = time.monotonic()

    def _on_armature(self, message: bytes) -> None:
        with suppress(*wire.MALFORMED):
            wire.armature(message)
            self._armatures.append(message)

    # ---- the thread ------------------------------------------------------------------------------------------------

    def _test(self, end: threading.Event) -> None:
        options = self._options
        if not (self._wait(lambda: self._joints, f"no {interface.JOINT_STATES} yet: waiting for a plant or a bridge",
                           end)
                and self._wait(self._publisher.get_subscription_count,
                               f"no subscriber to {self._publisher.topic_name} yet: waiting for a controller", end)):
            return
        known = self._known_laws
        give_up = time.monotonic() + NAMES_S  # a node's name may be known later than its subscription
        wait_until(lambda: len(known()) == 1 or time.monotonic() > give_up or bool(options.law), end)
        if not options.law and len(known()) != 1:
            raise UserError(f"{' and '.join(known()) or 'no known law'} listens to "
                            f"{self._publisher.topic_name}: give --law")
        law = options.law or known()[0]
        kind = LAWS[law]
        low, high = kind.reference_limits
        levels = options.levels or LEVELS[kind.measures]
        for level in levels:
            if not low <= level <= high:
                raise UserError(f"level {level:g}: {law} takes {low:g} to {high:g} {kind.reference_unit}")
        if end.wait(MATCHED_S):
            return
        try:
            with ProgressShow(f"steps of {law}", options.hold * len(levels), self.get_logger().info) as progress:
                for number, level in enumerate(levels):
                    self._step(level)
                    if not self._hold(options.hold, options.hold * number, progress, end):
                        return
            joints, armatures = list(self._joints), list(self._armatures)
        finally:
            self._step(0.0 if low <= 0.0 <= high else low)
        self._finish(law, joints, armatures)

    def _wait(self, condition: Callable[[], Any], message: str, end: threading.Event) -> bool:
        """Wait for a condition and log `message` every few seconds. False if the node is to stop."""
        patience = time.monotonic() + 1.0

        def met() -> bool:
            nonlocal patience
            if time.monotonic() > patience:
                self.get_logger().info(message)
                patience = time.monotonic() + NEWS_S
            return bool(condition())

        return wait_until(met, end)

    def _known_laws(self) -> list[str]:
        """The laws that subscribe to the reference, by the names of their nodes."""
        listeners = self.get_subscriptions_info_by_topic(self._publisher.topic_name)
        return sorted({info.node_name for info in listeners} & LAWS.keys())

    def _step(self, level: float) -> None:
        """Send a reference, which counts from the next sample."""
        self._steps.append((wire.stamp_ns(self._joints[-1]), level))
        for _ in range(REPEATS):
            self._publisher.publish(Float64(data=level))
            time.sleep(REPEAT_S)

    def _hold(self, seconds: float, before: float, progress: ProgressShow, end: threading.Event) -> bool:
        """Wait until the last sample is `seconds` [s] after the step. False if the node is to stop."""
        start, _ = self._steps[-1]
        while (passed := 1e-9 * (wire.stamp_ns(self._joints[-1]) - start)) < seconds:
            if end.wait(0.05):
                return False
            if passed < 0.0:
                raise UserError("the stamps of the samples went back: was the plant started again?")
            if time.monotonic() - self._heard > SILENT_S:
                raise UserError(f"no sample for {SILENT_S:g} s: did the plant or the bridge end?")
            progress.show(before + passed)
        return True

    def _finish(self, law: str, joints: Sequence[bytes], armatures: Sequence[bytes]) -> None:
        """Decode the messages, describe the responses and write the results."""
        kind = LAWS[law]
        # without the reference that ends the test: stamps of a real clock may lie a little off the grid, after it
        references = self._steps[:-1]
        end = references[-1][0] + round(1e9 * self._options.hold)
        time_, columns, lost = _columns(joints, armatures, references, end)
        y = columns[kind.measures]
        if not np.isfinite(y).all():
            raise UserError(f"{interface.JOINT_STATES} holds no {kind.measures}: there is no response")
        described = step_responses(time_, y, columns["reference"])
        write(self._options.out, law, time_, columns, described)

        def show(console: Console) -> None:
            console.print(step_report.table({law: described}, {law: kind.reference_unit}))
            note = f"{lost} of {len(time_)} samples lost; " if lost else ""
            console.print(f"{note}{self._options.out}: {', '.join(FILES)}", soft_wrap=True)

        self.outcome = show


def _columns(joints: Sequence[bytes], armatures: Sequence[bytes], references: Sequence[tuple[int, float]], end: int
             ) -> tuple[step_report.Array, dict[str, step_report.Array], int]:
    """Decode and join the messages after the first reference.

    Args:
        joints: serialized `joint_states`.
        armatures: serialized `armature`.
        references: stamp [ns] of the last sample before each reference, and the reference.
        end: [ns] stamp of the last sample that is used.

    Returns:
        Time [s] (M,), columns (M,), and the number of missing samples.
    """
    first = references[0][0]
    rows: dict[int, list[float]] = {}
    arm, rotor = interface.JOINTS
    for message in joints:
        stamp, position, velocity = wire.joints(message)
        if first < stamp <= end:
            rows[stamp] = [position.get(arm, math.nan), velocity.get(rotor, math.nan), math.nan, math.nan, math.nan]
    for message in armatures:
        stamp, *reading = wire.armature(message)
        if stamp in rows:
            rows[stamp][2:] = reading
    stamps = np.array(sorted(rows), dtype=np.int64)
    table = np.array([rows[stamp] for stamp in stamps.tolist()])
    read = {name: np.where(np.abs(x) <= MOST[name], x, np.nan)
            for name, x in zip(step_report.COLUMNS[2:], table.T, strict=True)}
    grid, columns, lost = step_report.on_grid(1e-9 * (stamps - stamps[0]), read)
    starts = 1e-9 * (np.array([stamp for stamp, _ in references]) - int(stamps[0]))
    levels = np.array([level for _, level in references])
    columns["reference"] = levels[np.searchsorted(starts, grid, side="left") - 1]
    return grid, columns, lost


def write(out: Path, law: str, time_: step_report.Array, columns: dict[str, step_report.Array],
          described: Sequence[StepResponse]) -> None:
    """Write the files of a step test.

    Args:
        out: folder of the results.
        law: name of the law.
        time_: [s] (M,).
        columns: (M,) each.
        described: the step responses.

    Raises:
        UserError: the folder cannot be made or written.
    """
    kind = LAWS[law]
    limit = step_report.limits(law)
    document = {
        "format": 1, "law": law, "unit": kind.reference_unit,
        "limits": {name: value for name, value in limit._asdict().items() if math.isfinite(value)},
        "steps": [{name: value if math.isfinite(value) else None for name, value in step._asdict().items()}
                  | {"missed": step_report.missed(step, limit)} for step in described],
    }
    drawing = step_report.draw(time_, columns["reference"], columns[kind.measures], columns["duty"],
                         f"{law}: steps of the reference", f"{kind.measures} / {kind.reference_unit}")
    try:
        out.mkdir(parents=True, exist_ok=True)
        rows = {"time": time_, **{name: columns[name] for name in step_report.COLUMNS[1:]}}
        step_report.write_csv(out / "steps.csv", rows)
        (out / "steps.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        (out / "steps.svg").write_text(drawing, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{out}: cannot be written: {error.strerror}") from error


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `step_test`."""
    nodes: list[StepTest] = []

    def make(options: argparse.Namespace) -> StepTest:
        nodes.append(StepTest(options))
        return nodes[-1]

    code = run(make, args, read=parse)
    for node in nodes:
        if node.outcome is not None and code == 0:
            node.outcome(Console(width=None if sys.stdout.isatty() else 120))
        elif code == 0:
            print("step_test: interrupted, nothing written", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
