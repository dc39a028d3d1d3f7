# SPDX-License-Identifier: Apache-2.0
"""The node that every control law runs in: topics, timing and safety.

A sample of the rig is two messages with the same stamp, `joint_states` and `armature`. When both have arrived, the node
calls the law once and publishes its duty on `duty_command`. The `Supervisor` decides whether the law is called and
whether its duty is published. The last command of the node is duty 0, however it ends.

Gains and limits can be set while the node runs. The law takes them without a bump, or refuses them and continues.
"""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_control.laws.registry import LAWS, Law, LawKind
from aeropend_control.nodes import wire
from aeropend_control.nodes.supervisor import Supervisor
from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import PRESETS, load
from aeropend_sim.model.rig import Sample
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import CpuShare, Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.realtime import request_realtime_priority
from aeropend_sim.ros.settings import Setting, overrides, read_settings
from aeropend_sim.ros.usage import Usage, usage

WATCH_S = 0.01
"""[s] Period of the check for missing samples (choice; a fifth of the default timeout)."""
WAITING = 100
"""Number of half samples that wait for the other half (choice)."""
AGAIN_S = 10.0
"""[s] A fault is logged again only after it was absent for this time (choice)."""
WARM_UP = 20
"""Number of samples that a law processes before the first real one, so that its functions are compiled (choice)."""

ARM, ROTOR = interface.JOINTS
TUNED = "tuned"


def settings(kind: LawKind) -> dict[str, Setting]:
    """The parameters of a law's node without its gains."""
    low, high = kind.reference_limits
    unit = kind.reference_unit
    return {
        "model": Setting(
            "bench", "model of the rig; a model file, for example augmented.yaml", choices=PRESETS, path=True
        ),
        "gains": Setting(
            TUNED, "source of gains that are not given: tuned for the model, or a set", choices=(TUNED, *kind.presets)
        ),
        "reference_min": Setting(low, "least reference that is accepted", unit, low, high, live=True),
        "reference_max": Setting(high, "greatest reference that is accepted", unit, low, high, live=True),
        "angle_limit": Setting(
            1.4, "beyond this angle, up or down, duty 0 until the next reference", "rad", 0.1, math.pi, live=True
        ),
        "timeout": Setting(0.05, "time without a sample after which the duty is 0", "s", 0.01, 10.0, live=True),
    }


def usage_of(name: str) -> Usage:
    """Text of `--help` of a law's node."""
    kind = LAWS[name]
    gains = [
        f"  {gain:<18} {q.description}; {q.low:g}..{q.high:g} {q.unit}".removesuffix(" -")
        + ("" if q.default is None else f"; default {q.default:g}")
        for gain, q in kind.parameters.items()
    ]
    return usage(
        f"{name}: {kind.summary}.\nReads joint_states, armature and reference ({kind.reference_unit}), publishes "
        "duty_command.",
        settings(kind),
        [
            name,
            f"{name} --ros-args -p model:=verdict/augmented.yaml",
            f"{name} --ros-args -r __ns:=/rig1 -p angle_limit:=1.0",
        ],
        "\n".join(
            ["gains, set in the same way:", *gains, "", "Gains and limits can be set while it runs: ros2 param set."]
        ),
        further={gain: Setting(q.low, q.description) for gain, q in kind.parameters.items()},
    )


class Controller(Node):
    """A law in its node; see the module's docstring."""

    def __init__(self, name: str) -> None:
        """Prepare the node of a law.

        Args:
            name: a key of `LAWS`, which is also the name of the node.

        Raises:
            UserError: a parameter, the model file or a gain cannot be used.
        """
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self._kind = LAWS[name]
        values = self._read()
        self._supervisor = Supervisor(
            self._law,
            measures=(self._kind.measures,),
            unit=self._kind.reference_unit,
            low=values["reference_min"],
            high=values["reference_max"],
            angle_limit=values["angle_limit"],
            timeout=values["timeout"],
        )
        self._joints: dict[int, tuple[float, float]] = {}
        self._armatures: dict[int, list[float]] = {}
        self._heard = False
        self._quiet = 0  # checks since the last sample
        self._longest_ns = 0
        self._malformed = 0  # messages
        self._logged: dict[str, float] = {}
        self._cpu_share = CpuShare()

        qos = interface.QOS
        self._publisher = self.create_publisher(Float64, interface.DUTY_COMMAND, qos)
        self.create_subscription(JointState, interface.JOINT_STATES, self._on_joint_states, qos, raw=True)
        self.create_subscription(BatteryState, interface.ARMATURE, self._on_armature, qos, raw=True)
        self.create_subscription(Float64, interface.REFERENCE, self._on_reference, qos)
        # wall time: without samples /clock does not move either
        self._watch = self.create_timer(WATCH_S, self._on_watch, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._diagnostics = Diagnostics(self, self._report, name)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        gains = ", ".join(f"{key} {values[key]:.4g}" for key in self._kind.parameters)
        self.get_logger().info(f"model {values['model']}, {gains}")
        gc.collect()
        gc.freeze()  # the garbage collector skips these objects between two samples
        request_realtime_priority()

    def close(self) -> None:
        """Send duty 0 ten times in 0.2 s. A confirmation by the middleware would take up to 3 s (its heartbeat)."""
        for _ in range(10):
            self._publisher.publish(Float64(data=0.0))
            time.sleep(0.02)

    # ---- parameters ------------------------------------------------------------------------------------------------

    def _read(self) -> dict[str, Any]:
        """Make the law from the given parameters, and declare all parameters."""
        given = overrides(self)
        if any(name.startswith(("model.", "sensing.", "effects.")) for name in given):
            raise UserError("give the parameters of a model as a file: -p model:=FILE")
        table = settings(self._kind)
        source, choice = (table[name].check(name, given.get(name, table[name].default)) for name in ("model", "gains"))
        model = load(source)
        gains: dict[str, float] = dict(self._kind.presets.get(choice, {}))
        gains |= {name: value for name, value in given.items() if name in self._kind.parameters}
        if not gains.keys() >= self._kind.parameters.keys():
            gains = {**self._kind.tune(model), **gains}
        self._law = self._kind.make(model, gains)
        _warm_up(self._law, self._kind)
        self._table = table | {
            name: Setting(float(gains[name]), q.description, q.unit.removeprefix("-"), q.low, q.high, live=True)
            for name, q in self._kind.parameters.items()
        }
        values = read_settings(self, self._table, given)
        _check_order(values)
        return values

    def _on_set_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Set all of these parameters, or none."""
        named = {one.name: one.value for one in parameters if one.name in self._table}
        supervisor = self._supervisor
        try:
            new = {name: self._table[name].check(name, value) for name, value in named.items()}
            _check_order({"reference_min": supervisor.low, "reference_max": supervisor.high, **new})
            self._law.retune({name: value for name, value in new.items() if name in self._kind.parameters})
        except UserError as error:
            self.get_logger().warn(f"parameters refused, the loop continues: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        supervisor.low = new.get("reference_min", supervisor.low)
        supervisor.high = new.get("reference_max", supervisor.high)
        supervisor.angle_limit = new.get("angle_limit", supervisor.angle_limit)
        supervisor.timeout = new.get("timeout", supervisor.timeout)
        return SetParametersResult(successful=True)

    # ---- messages --------------------------------------------------------------------------------------------------

    def _on_joint_states(self, message: bytes) -> None:
        try:
            stamp, position, velocity = wire.joints(message)
        except wire.MALFORMED:
            self._on_malformed(interface.JOINT_STATES)
            return
        reading = (position.get(ARM, math.nan), velocity.get(ROTOR, math.nan))
        other = self._armatures.pop(stamp, None)
        if other is None:
            _keep(self._joints, stamp, reading)
        else:
            self._on_sample(stamp, *reading, *other)

    def _on_armature(self, message: bytes) -> None:
        try:
            stamp, *reading = wire.armature(message)
        except wire.MALFORMED:
            self._on_malformed(interface.ARMATURE)
            return
        other = self._joints.pop(stamp, None)
        if other is None:
            _keep(self._armatures, stamp, reading)
        else:
            self._on_sample(stamp, *other, *reading)

    def _on_malformed(self, topic: str) -> None:
        self._malformed += 1
        self._log_fault(f"{topic}: a message cannot be read, or its stamp is no time: ignored")

    def _on_sample(self, stamp: int, theta: float, omega: float, i_a: float, v_a: float, applied: float) -> None:
        start = time.monotonic_ns()
        self._heard, self._quiet = True, 0
        supervisor = self._supervisor
        supervisor.note_applied(applied)
        duty = supervisor.step(stamp, Sample(theta, omega, i_a, v_a))
        if duty is not None:
            self._publisher.publish(wire.float64(duty))
            self._longest_ns = max(self._longest_ns, time.monotonic_ns() - start)
        for said in filter(None, (supervisor.fault, supervisor.doubt)):
            self._log_fault(said)

    def _on_reference(self, message: Float64) -> None:
        supervisor = self._supervisor
        before = supervisor.reference
        if not supervisor.set_reference(message.data):
            self._log_fault(supervisor.refusal)
        elif supervisor.reference != before:
            self.get_logger().info(f"reference {supervisor.reference:g} {self._kind.reference_unit}")

    def _on_watch(self) -> None:
        # count checks, not time: if this process was stopped, samples wait in the queue behind the first check
        self._quiet += 1
        supervisor = self._supervisor
        if self._heard and self._quiet * WATCH_S > supervisor.timeout:
            self._heard = False
            supervisor.on_timeout()
            self._publisher.publish(Float64(data=0.0))
            self._log_fault(supervisor.fault)

    # ---- log and diagnostics ---------------------------------------------------------------------------------------

    def _log_fault(self, fault: str) -> None:
        """Log a fault once, and again after it was absent for `AGAIN_S`."""
        now = time.monotonic()
        if now > self._logged.get(fault, -math.inf) + AGAIN_S:
            self.get_logger().warn(fault)
        self._logged[fault] = now

    def _report(self) -> tuple[str, Mapping[str, object]]:
        supervisor = self._supervisor
        warnings = [supervisor.fault, supervisor.refusal]
        for topic, ours in ((interface.DUTY_COMMAND, 1), (interface.JOINT_STATES, 1)):
            others = self.count_publishers(topic) - ours
            if others > 0:
                warnings.append(f"{others + 1} publishers of {topic}: end all but one")
                self._log_fault(warnings[-1])
        if not self._heard and not supervisor.fault:
            warnings.append("no sample yet (joint_states and armature with the same stamp): duty 0")
        values = {
            "reference": supervisor.reference,
            "duty": supervisor.duty,
            **supervisor.counts,
            "malformed": self._malformed,
            "longest step ms": 1e-6 * self._longest_ns,
            "cpu share": self._cpu_share.since_last(),
        }
        return "; ".join(filter(None, warnings)), values


def _keep(waiting: dict[int, Any], stamp: int, half: Any) -> None:
    """Store half a sample until the other half arrives; drop the oldest if there are too many."""
    waiting[stamp] = half
    if len(waiting) > WAITING:
        del waiting[next(iter(waiting))]


def _check_order(values: Mapping[str, float]) -> None:
    if not values["reference_min"] < values["reference_max"]:
        raise UserError("parameters reference_min and reference_max: give reference_min < reference_max")


def _warm_up(law: Law, kind: LawKind) -> None:
    """Run a law so that all its functions are compiled before the first real sample."""
    for k in range(WARM_UP):
        law.step(Sample(0.01 * k, 50.0, 0.1, 0.5), sum(kind.reference_limits) / 2.0)
    law.reset()


def main(name: str, args: Sequence[str] | None = None) -> int:
    """Run the node of a law.

    Args:
        name: a key of `LAWS`.
        args: arguments of the command line; None: those of the process.

    Returns:
        The exit code.
    """
    return run(partial(Controller, name), args, usage_of(name))


def small_signal(args: Sequence[str] | None = None) -> int:
    """Entry point of `small_signal`."""
    return main("small_signal", args)


def feedback_linearization(args: Sequence[str] | None = None) -> int:
    """Entry point of `feedback_linearization`."""
    return main("feedback_linearization", args)


def cascade(args: Sequence[str] | None = None) -> int:
    """Entry point of `cascade`."""
    return main("cascade", args)


def feedback_linearization_cascade(args: Sequence[str] | None = None) -> int:
    """Entry point of `feedback_linearization_cascade`."""
    return main("feedback_linearization_cascade", args)


if __name__ == "__main__":  # python -m aeropend_control.nodes.controller LAW --ros-args ...
    sys.argv[:2] = sys.argv[1:2]
    sys.exit(main(sys.argv[0]))
