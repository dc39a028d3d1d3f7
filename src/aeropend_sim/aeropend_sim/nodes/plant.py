# SPDX-License-Identifier: Apache-2.0
"""The simulated rig as a ROS 2 node, with the topics, services and rate of the real one.

Real time. A thread takes a sample every 2.040 ms, at absolute deadlines. The stamps are the deadlines, not the instants
at which the thread woke, so they lie on an exact grid. A sample counts as late if the next one is already due. It is
still published, and the thread catches up without pauses. If the process stood still for more than `BACKLOG` samples,
the older samples are not published and count as lost. The rig is simulated through them, so that its time stays equal
to ROS time. If the system clock is set, the grid moves by whole periods, with a warning.

Other speeds (`speed` not 1). The stamps are simulated time, which starts one period after 0, and `/clock` has it before
each sample. No sample is left out: if the computer is too slow, simulated time runs slower than `speed`. The plant does
not wait for subscribers: a slow one loses samples, and the stamps show the gap.

All parameters are read at the start and fixed while the node runs: a recording belongs to one model.
"""

import math
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, JointState
from std_srvs.srv import Trigger

from aeropend_sim.errors import UserError
from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import CATALOGUE, DEFINED, PARAMETER_MISMATCH
from aeropend_sim.model.parameters import (
    LARGEST_SEED,
    MODEL_NAMES,
    PARAMETERS,
    PRESETS,
    SAMPLE_PERIOD,
    SECTIONS,
    Model,
    from_flat,
    load,
    to_flat,
    with_definitions,
)
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.realtime import prepare_thread, request_realtime_priority
from aeropend_sim.ros.rig_interface import RigInterface
from aeropend_sim.ros.settings import Setting, declare, overrides, read_settings
from aeropend_sim.ros.usage import usage
from aeropend_sim.ros.worker import Worker

PERIOD_NS = round(SAMPLE_PERIOD * 1e9)
BACKLOG = 49
"""Greatest number of late samples that are all published: 100 ms. A choice."""

SETTINGS = {
    "preset": Setting("bench", "model that supplies all parameters that are not set", choices=PRESETS),
    "effect_file": Setting("", "file of effects by formula, which may then be set as effects.ID", path=True),
    "seed": Setting(0, "seed of noise and gusts", low=0, high=LARGEST_SEED),
    "speed": Setting(
        1.0, "simulated over real time; not 1: publishes /clock; 0: as fast as possible", low=0.0, high=1e3
    ),
    "publish_truth": Setting(False, "publish truth/joint_states and truth/armature"),
}

def _setting(name: str) -> Setting:
    """Description of one parameter of a model file, by its full name."""
    section, _, rest = name.partition(".")
    if section == "effects":
        effect, _, key = rest.partition(".")
        if effect != PARAMETER_MISMATCH:
            q = DEFINED[effect].parameters[key]
            return Setting(q.default, f"{DEFINED[effect].physics}: {q.description}", q.unit, q.low, q.high)
        name = f"model.{key}"
    p = PARAMETERS[name]
    return Setting(p.low, p.description, p.unit, p.low, p.high)


PARAMETER_NAMES = [
    *PARAMETERS,
    *(f"effects.{effect.id}.{key}" for effect in CATALOGUE.values() for key in effect.parameters),
    *(f"effects.{PARAMETER_MISMATCH}.{key}" for key in MODEL_NAMES),
]
"""The full names of all parameters of a model file."""

USAGE = usage(
    "plant: the simulated aeropendulum. Publishes joint_states and armature at 490.196 Hz, takes duty_command.",
    SETTINGS,
    [
        "plant",
        "plant --ros-args -p preset:=thesis -p seed:=3",
        "plant --ros-args --params-file model.yaml -p publish_truth:=true",
        "plant --ros-args -p model.R_a:=1.2 -p effects.coulomb_friction.accel:=0.8",
    ],
    "  model.*, sensing.*, effects.ID.*: the parameters of a model file; missing parameters of an effect take their"
    " defaults\n  effects: " + ", ".join([*CATALOGUE, PARAMETER_MISMATCH]),
    further={name: _setting(name) for name in PARAMETER_NAMES},
)


class Pace:
    """The absolute deadlines of a periodic thread, and statistics of its lateness.

    Args:
        period_ns: [ns] time between deadlines.
        backlog: greatest number of periods by which a deadline may be missed; older deadlines are skipped.
        clock: returns monotonic time, ns.
        sleep: sleeps for a number of seconds.
    """

    BIN_NS = 10_000
    BINS = 1000

    def __init__(
        self,
        period_ns: int,
        backlog: int,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._period = period_ns
        self._backlog = backlog
        self._clock = clock
        self._sleep = sleep
        self.deadline = clock()
        self.late = 0
        self.max_lateness_ns = 0
        self._histogram = [0] * (self.BINS + 1)

    def next(self) -> int:
        """Sleep until the next deadline, and return the number of deadlines that were skipped before it."""
        self.deadline += self._period
        wait = self.deadline - self._clock()
        while wait > 0:
            self._sleep(wait * 1e-9)
            wait = self.deadline - self._clock()
        lateness = -wait
        given_up = 0
        if lateness >= self._period:
            self.late += 1
            given_up = max(0, lateness // self._period - self._backlog)
            self.deadline += given_up * self._period
        if lateness > self.max_lateness_ns:
            self.max_lateness_ns = lateness
        self._histogram[min(lateness // self.BIN_NS, self.BINS)] += 1
        return given_up

    def percentile_ms(self, share: float) -> float:
        """A percentile of the lateness, ms, in steps of 0.01 up to 10.

        Args:
            share: 0..1.
        """
        wanted = share * sum(self._histogram)
        count = 0
        for at, number in enumerate(self._histogram):
            count += number
            if count >= wanted:
                return (at + 1) * self.BIN_NS * 1e-6
        return math.inf


class Plant(RigInterface):
    """The node. See the module's docstring for time, and docs/interfaces.md for topics."""

    def __init__(self) -> None:
        super().__init__("plant")
        given = overrides(self)
        settings, model = read_parameters(self, given)
        # imported here: compiling can take seconds, and signals must be handled before
        from aeropend_sim.model.rig import Rig

        self._rig = Rig(model, settings["seed"])
        self._rig.run(np.zeros(1))  # compiles before the first deadline
        self._rig.reset()
        self.lowest = -1.0 if model.numbers()["reverse"] > 0.0 else 0.0
        self._speed: float = settings["speed"]
        self._samples = 0
        self._lost = 0
        self._pace: Pace | None = None

        qos = interface.QOS
        self.advertise()
        self._truth = settings["publish_truth"]
        if self._truth:
            self._truth_joint_states = self.create_publisher(JointState, interface.TRUTH_JOINT_STATES, qos)
            self._truth_armature = self.create_publisher(BatteryState, interface.TRUTH_ARMATURE, qos)
        if self._speed != 1.0:
            self._clock_publisher = self.create_publisher(Clock, "/clock", qos)
        self.create_service(Trigger, interface.RESET, self._on_reset)
        self._diagnostics = Diagnostics(self, self._report, "simulated aeropendulum")
        effects = ", ".join(model.effects) or "none"
        self.get_logger().info(f"model {settings['preset']}, effects: {effects}, speed {self._speed:g}")
        self._worker = Worker(self, self._simulate if self._speed != 1.0 else self._real_time, "samples")
        self._worker.start()

    def close(self) -> None:
        """Stop sampling."""
        self._worker.stop()

    def _real_time(self, end: threading.Event) -> None:
        prepare_thread()
        request_realtime_priority()
        pace = self._pace = Pace(PERIOD_NS, BACKLOG)
        while not end.is_set():
            given_up = pace.next()
            if given_up:
                self._lost += given_up
                with self.lock:
                    for done in range(0, given_up, 10_000):  # bounds the memory
                        self._rig.run(np.full(min(given_up - done, 10_000), self.duty))
                self.get_logger().warn(f"stood still: {given_up} samples lost, {self._lost} in all")
            self._sample(pace.deadline + self.to_ros_ns)
            if self._samples % 490 == 0:
                self.follow_system_clock(PERIOD_NS)

    def _simulate(self, end: threading.Event) -> None:
        prepare_thread()
        if self._speed > 0.0:
            self._pace = Pace(round(PERIOD_NS / self._speed), BACKLOG)
        stamp_ns = 0
        while not end.is_set():
            if self._pace is not None:
                self._pace.next()
            stamp_ns += PERIOD_NS
            self._clock_publisher.publish(Clock(clock=interface.stamp(stamp_ns)))
            self._sample(stamp_ns)

    def _sample(self, stamp_ns: int) -> None:
        with self.lock:
            duty = self.duty
            read, true = self._rig.sample(duty)
        self.publish_sample(stamp_ns, read.theta, read.omega, read.v_a, read.i_a, duty)
        if self._truth:
            self._truth_joint_states.publish(
                interface.joint_states_message(stamp_ns, true.theta, true.omega, true.theta_dot, true.rotor_angle)
            )
            self._truth_armature.publish(interface.armature_message(stamp_ns, true.v_a, true.i_a, duty))
        self._samples += 1

    def take_duty(self, duty: float) -> None:
        """Hold a commanded duty, if the rig is enabled."""
        if self.enabled:
            self.duty = duty

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self.lock:
            self._rig.reset()
            self.duty = 0.0
        response.success = True
        response.message = "at rest, duty 0"
        return response

    def _report(self) -> tuple[str, dict[str, object]]:
        pace = self._pace
        values: dict[str, object] = {
            "samples": self._samples,
            "late ticks": pace.late if pace else 0,
            "lost ticks": self._lost,
            "refused commands": self.refused,
            "clamped commands": self.clamped,
            "lateness max ms": pace.max_lateness_ns * 1e-6 if pace else 0.0,
            "lateness p99 ms": pace.percentile_ms(0.99) if pace else 0.0,
            "clock steps": self.clock_steps,
            "cpu share": self.cpu_share.since_last(),
            "enabled": self.enabled,
        }
        return (f"{self._lost} samples lost" if self._lost else ""), values


def read_parameters(node: Node, given: dict[str, Any]) -> tuple[dict[str, Any], Model]:
    """Check and declare the parameters of the node.

    Args:
        node: the node of the plant.
        given: the values that were set, by full name.

    Returns:
        The settings, and the model.

    Raises:
        UserError: unknown name, wrong type, or out of range.
    """
    mine = {name: value for name, value in given.items() if name.split(".")[0] not in SECTIONS}
    settings = read_settings(node, SETTINGS, mine)
    if settings["effect_file"]:
        effect_file.load(settings["effect_file"])
    flat = with_definitions({name: value for name, value in given.items() if name not in mine}, "parameters")
    model = from_flat(_with_defaults(flat), "parameters", load(settings["preset"]))
    for name, value in to_flat(model).items():
        declare(node, name, value, _setting(name).descriptor())
    return settings, model


def _with_defaults(flat: dict[str, Any]) -> dict[str, Any]:
    """Replace the empty values of a parameter file: `effects: {}`, and an effect without parameters."""
    resolved: dict[str, Any] = {}
    for name, value in flat.items():
        effect = DEFINED.get(name.removeprefix("effects."))
        if value == "" and name.startswith("effects.") and effect is not None:
            resolved |= {f"{name}.{key}": parameter.default for key, parameter in effect.parameters.items()}
        elif value == "" and name in SECTIONS:
            continue
        elif name == "effects":
            raise UserError(f"parameter effects is {value!r}: give effects by id, as effects: {{gust: {{sigma: 1.5}}}}")
        else:
            resolved[name] = value
    return resolved


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `plant`."""
    return run(Plant, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
