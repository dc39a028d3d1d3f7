# SPDX-License-Identifier: Apache-2.0
"""The node that runs the model beside a rig, and says when the two part, where and why.

A thread takes the messages in batches, as `record` does, joins them to samples, and gives them to a `Watcher`. What the
model says is published with the stamps of the samples, the state of each place on `/diagnostics`. On an alarm it writes
the minute around it into a bag. Nothing that it publishes moves the rig.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rosbags.rosbag2.errors import WriterError
from sensor_msgs.msg import BatteryState, JointState
from std_srvs.srv import Trigger
from threadpoolctl import threadpool_limits

from aeropend_control.nodes import wire
from aeropend_ident.live.alarm_diagnosis import AlarmDiagnosis
from aeropend_ident.live.detector import Finding
from aeropend_ident.live.intake import Intake
from aeropend_ident.live.ring import AlarmBag, Message, Ring
from aeropend_ident.live.watcher import DRIFTED, PARTED, STALE, Place, Watcher
from aeropend_ident.nodes import said
from aeropend_ident.nodes.topic_recorder import TopicRecorder, qos_of
from aeropend_sim.errors import UserError
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.parameters import PRESETS, load
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import CpuShare, Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.settings import Setting, overrides, read_settings
from aeropend_sim.ros.usage import usage
from aeropend_sim.ros.worker import Worker

BATCH_S = 0.05
"""[s] Time between two batches (choice: half of what a picture may be late)."""

PICTURE_S = 1.0 / 30.0
"""[s] The same with a page (choice: 30 pictures a second)."""

LOOK_S = 0.5
"""[s] Time between two looks for publishers (choice)."""

SILENT_S = 0.5
"""[s] Time without a sample after which the rig counts as silent (choice: ten batches)."""

SURE = 0.5
"""Probability above which an effect is named (convention: more likely than not)."""

TOPICS = {
    interface.JOINT_STATES: "sensor_msgs/msg/JointState",
    interface.ARMATURE: "sensor_msgs/msg/BatteryState",
    interface.DUTY_COMMAND: "std_msgs/msg/Float64",
    interface.REFERENCE: "std_msgs/msg/Float64",
    interface.DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}

CLEAR = "~/clear"
"""Service `std_srvs/srv/Trigger`: take the rig as it is now."""

SETTINGS = {
    "model": Setting("bench", "model of the rig; a model file, for example verdict/augmented.yaml", choices=PRESETS,
                     path=True),
    "mean_hours": Setting(24.0, "mean time between two false alarms that is accepted", "h", 0.1, 1e4),
    "bags": Setting("alarms", "folder for the bag of each alarm; empty: none", path=True),
    "diagnose": Setting(False, "run diagnose on the bag of each alarm"),
    "page": Setting(False, "show a page in the browser"),
    "page_port": Setting(8080, "port of the page", low=1, high=65535),
    "page_address": Setting("127.0.0.1", "address of the page; anybody who reaches it may look"),
}

USAGE = usage(
    "watch: runs the model beside a rig and says when they part, where and why.\nReads joint_states, armature and"
    " duty_command; publishes model/joint_states, model/armature and /diagnostics. It moves nothing.",
    SETTINGS,
    [
        "watch",
        "watch --ros-args -p model:=verdict/augmented.yaml",
        "watch --ros-args -p page:=true",
        "watch --ros-args -r __ns:=/rig1 -p diagnose:=true",
    ],
    "  The service ~/clear takes the rig as it is now, after an alarm.",
)

THERE_BEFORE = ", which was there before the alarm"
"""Said of an effect that `diagnose` finds, and of which the residuals show no change."""

LEVEL = {PARTED: DiagnosticStatus.ERROR, DRIFTED: DiagnosticStatus.WARN, STALE: DiagnosticStatus.STALE}


class Watch(Node):
    """The node; see the module's docstring."""

    def __init__(self) -> None:
        """Prepare.

        Raises:
            UserError: a parameter, the model file or the folder for bags cannot be used.
        """
        super().__init__("watch", automatically_declare_parameters_from_overrides=True)
        given = overrides(self)
        if any(name.startswith(("model.", "sensing.", "effects.")) for name in given):
            raise UserError("give the parameters of a model as a file: -p model:=FILE")
        settings = read_settings(self, SETTINGS, given)
        self._settings = settings
        if settings["bags"]:
            _check_writable(Path(settings["bags"]))
        self._watcher = Watcher(load(settings["model"]), settings["mean_hours"])
        self._intake = Intake()
        self._ring = Ring()
        self._bag: AlarmBag | None = None
        self._bag_of = 0  # number of the alarm
        self._running: list[AlarmDiagnosis] = []
        self._diagnosed = ""  # verdict on the last alarm
        self._samples = self._malformed = 0
        self._heard = -math.inf
        self._crowded = self._told = ""
        self._warned: dict[str, float] = {}
        self._clear = threading.Event()
        self._cpu_share = CpuShare()
        self._lag_ms = 0.0

        qos = interface.QOS
        self._names = {self.resolve_topic_name(name): name for name in TOPICS}
        self._recorders = {name: TopicRecorder(name, TOPICS[short]) for name, short in self._names.items()}
        # no executor serves this node: the thread below reads its subscriptions
        self._subscriber = Node(f"_{self.get_name()}_subscriptions", namespace=self.get_namespace(),
                                context=self.context, use_global_arguments=False, enable_rosout=False,
                                start_parameter_services=False)
        self._joint_states = self.create_publisher(JointState, interface.MODEL_JOINT_STATES, qos)
        self._armature = self.create_publisher(BatteryState, interface.MODEL_ARMATURE, qos)
        self._alarm_publisher = self.create_publisher(DiagnosticArray, interface.DIAGNOSTICS, qos)
        self.create_service(Trigger, CLEAR, self._on_clear)
        self._diagnostics = Diagnostics(self, self._report, "model beside the rig", self._statuses)
        self._page: Any = None
        if settings["page"]:
            from aeropend_ident.live.server import Page

            self._page = Page(settings["page_address"], settings["page_port"], settings["model"])
            self.get_logger().info(f"page: {self._page.url}")
        self.get_logger().info(f"model {settings['model']}, limit {self._watcher.detector.limit:.1f} for one false"
                               f" alarm in {settings['mean_hours']:g} h")
        self._worker = Worker(self, self._run, "watch")
        self._worker.start()

    def close(self) -> None:
        """End the thread, the page and the bag."""
        self._worker.stop()
        if self._page is not None:
            self._page.close()
        if self._bag is not None:
            try:
                self._bag.close()
            except _BAG_FAILS as error:
                self._bag_fails(self._bag.path, error, "is not whole")
        for one in self._running:
            one.close()
        self._subscriber.destroy_node()

    # ---- the thread ------------------------------------------------------------------------------------------------

    def _run(self, end: threading.Event) -> None:
        look = 0.0
        with threadpool_limits(1):
            self._warm_up()
            while not end.wait(PICTURE_S if self._page else BATCH_S):
                now = time.monotonic()
                if now >= look:
                    self._look(now)
                    look = now + LOOK_S
                for name, recorder in self._recorders.items():
                    if recorder.subscription is not None:
                        self._drain(name, recorder)
                self._judge(now)

    def _warm_up(self) -> None:
        """Compile before the first sample."""
        import numpy as np

        from aeropend_ident.live.companion_model import Samples

        zeros = np.zeros(30)
        self._watcher.companion.step(Samples(zeros, zeros, zeros, zeros, zeros))
        self._watcher.companion.restart()

    def _look(self, now: float) -> None:
        """Subscribe to topics that have publishers, with a QoS that all of them are compatible with."""
        for name, recorder in self._recorders.items():
            recorder.follow(self._subscriber, self.get_publishers_info_by_topic(name), now,
                            partial(self._drain, name, recorder))
        crowds = [f"{r.publishers} publishers of {self._names[name]}: end all but one" for name, r in
                  self._recorders.items() if self._names[name] in (interface.JOINT_STATES, interface.ARMATURE)
                  and r.publishers > 1]
        self._crowded = crowds[0] if crowds else ""
        for one in [one for one in self._running if one.ended]:
            self._running.remove(one)
            self._on_diagnosed(one)

    def _drain(self, name: str, recorder: TopicRecorder) -> None:
        short, intake = self._names[name], self._intake
        while (taken := recorder.take()) is not None:
            received, data = taken
            message = Message(received or time.time_ns(), name, data)
            if self._settings["bags"]:
                self._ring.add(message)
                if self._bag is not None:
                    self._bag.add(message)
            try:
                if short == interface.JOINT_STATES:
                    stamp, position, velocity = wire.joints(data)
                    intake.joints(stamp, position.get(_ARM, math.nan), velocity.get(_ROTOR, math.nan))
                elif short == interface.ARMATURE:
                    intake.armature(*wire.armature(data))
                elif short == interface.DUTY_COMMAND:
                    intake.command = wire.read_float64(data)
                elif short == interface.REFERENCE and self._page is not None:
                    self._page.reference = wire.read_float64(data)
                elif short == interface.DIAGNOSTICS and self._page is not None:
                    self._hear(data)
            except wire.MALFORMED:
                self._malformed += 1
                self._warn(f"{short}: a message cannot be read, or its stamp is no time: ignored")

    def _hear(self, data: bytes) -> None:
        """Give the page what other nodes say of themselves."""
        own = self.get_fully_qualified_name().lstrip("/")
        for status in deserialize_message(data, DiagnosticArray).status:
            if not status.name.startswith(own):
                self._page.heard(status.name, status.level[0], status.message, {v.key: v.value for v in status.values})

    def _judge(self, now: float) -> None:
        watcher = self._watcher
        if self._clear.is_set():
            self._clear.clear()
            watcher.clear()
        if self._crowded:
            self._intake.forget()
            watcher.silent(self._crowded)
            self._warn(self._crowded)
            self._heard = now
        batches = self._intake.take()
        for batch in batches:
            if batch.broken and batch.broken != "start":
                self._warn(f"{batch.broken}: the model starts anew")
            residuals, found = watcher.step(batch, frozen=self._intake.frozen)
            if watcher.fault:
                self._warn(watcher.fault)
            self._publish(batch.stamps.tolist(), residuals.said)
            self._samples += len(batch.stamps)
            self._heard = now
            if self._page is not None:
                self._page.samples(batch, residuals)
            if found is not None:
                self._on_alarm(found)
            elif watcher.alarm is not None and watcher.alarm.hypothesis != self._told \
                    and watcher.alarm.probability > SURE:
                self._tell(watcher.alarm, "as it now looks, they have parted")
        if batches:
            self._lag_ms = (time.time_ns() - int(batches[-1].stamps[-1])) * 1e-6
        elif now - self._heard > SILENT_S and watcher.fault != _NO_SAMPLES and self._heard > -math.inf:
            watcher.silent(_NO_SAMPLES)
            self._intake.forget()
            self._warn(_NO_SAMPLES)
        if self._bag is not None:
            self._write_bag()
        if self._page is not None:
            self._page.state(self._watcher, self._intake, now)

    def _publish(self, stamps: list[int], model: Any) -> None:
        if self._joint_states.get_subscription_count():
            for stamp, theta, omega in zip(stamps, model.theta.tolist(), model.omega.tolist(), strict=True):
                self._joint_states.publish(said.joint_states(stamp, theta, omega))
        if self._armature.get_subscription_count():
            for stamp, v_a, i_a, duty in zip(stamps, model.v_a.tolist(), model.i_a.tolist(), model.duty.tolist(),
                                             strict=True):
                self._armature.publish(said.armature(stamp, v_a, i_a, duty))

    # ---- alarms ----------------------------------------------------------------------------------------------------

    def _on_alarm(self, found: Finding) -> None:
        self._diagnosed = ""
        self._tell(found, "model and rig have parted")
        message = DiagnosticArray(status=self._statuses())
        message.header.stamp = self.get_clock().now().to_msg()
        self._alarm_publisher.publish(message)
        if not self._settings["bags"] or self._bag is not None:
            return
        path = Path(self._settings["bags"]) / f"{datetime.now():alarm_%Y_%m_%d-%H_%M_%S}"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._bag = AlarmBag(path, self._ring, {name: TOPICS[short] for name, short in self._names.items()},
                                 lambda topic: [qos_of(info.qos_profile) for info in
                                                self.get_publishers_info_by_topic(topic)], time.time_ns())
            self._bag_of = self._watcher.alarms
        except _BAG_FAILS as error:
            self._bag_fails(path, error, "cannot be made")

    def _bag_fails(self, path: Path, error: Exception, what: str) -> None:
        reason = getattr(error, "strerror", None) or error
        self.get_logger().error(f"{path}: {reason}: the bag of the alarm {what}; make room on its disk, or give another"
                                " folder, as in -p bags:=alarms")

    def _tell(self, found: Finding, what: str) -> None:
        self._told = found.hypothesis if found.probability > SURE else ""
        ago = (self._watcher.now_ns - self._watcher.since_ns) * 1e-9
        self.get_logger().error(f"{what} at {found.place}, {ago:.1f} s ago: {why(found)}")

    def _write_bag(self) -> None:
        assert self._bag is not None
        path = self._bag.path
        try:
            if not self._bag.write(time.time_ns()):
                return
        except _BAG_FAILS as error:
            self._bag_fails(path, error, "is not whole")
            self._bag = None
            return
        self._bag = None
        self.get_logger().info(f"the minute around the alarm is in {path}")
        if self._settings["diagnose"]:
            self._running.append(AlarmDiagnosis(path, self._settings["model"], self._bag_of))
            self.get_logger().info(f"diagnose runs on it; its report will be {self._running[-1].report}")

    def _on_diagnosed(self, one: AlarmDiagnosis) -> None:
        verdict = one.verdict
        if not verdict:
            self.get_logger().error(f"diagnose has found no verdict for {one.out}: its line above says why")
            return
        stands = self._watcher.alarm is not None and one.alarm == self._watcher.alarms
        if stands and verdict in DEFINED and not self._watcher.changed(verdict):
            verdict += THERE_BEFORE
        self.get_logger().info(f"diagnose says of the minute around the alarm: {verdict}; see {one.report}")
        if one.alarm == self._watcher.alarms:
            self._diagnosed = verdict
        if self._page is not None:
            self._page.diagnosed(one.alarm, verdict)

    def _on_clear(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        there = self._watcher.alarm is not None
        self._clear.set()
        response.success = True
        response.message = "cleared: the rig as it is now is the new start" if there else "there was no alarm"
        return response

    # ---- diagnostics -----------------------------------------------------------------------------------------------

    def _warn(self, text: str) -> None:
        """Log a warning once in ten seconds."""
        now = time.monotonic()
        if now > self._warned.get(text, -math.inf) + 10.0:
            self.get_logger().warn(text)
            self._warned[text] = now

    def _report(self) -> tuple[str, Mapping[str, object]]:
        watcher, gap = self._watcher, self._watcher.free_gap
        alarm = watcher.alarm
        warnings = [watcher.fault]
        if alarm is not None:
            warnings.append(f"parted at {alarm.place}")
        values = {
            "samples": self._samples, "bridged": self._intake.lost, "doubled": self._intake.doubled,
            "impossible readings": self._intake.odd, "malformed": self._malformed, "breaks": watcher.breaks,
            "alarms": watcher.alarms, "diagnosed": self._diagnosed,
            "lost": sum(r.lost for r in self._recorders.values()),
            **{f"free run {channel}": gap[channel] for channel in gap},
            "learning": f"{watcher.to_learn:.0f} s of motion left" if watcher.to_learn else "done",
            "statistic": watcher.detector.statistic, "limit": watcher.detector.limit,
            "lag ms": self._lag_ms, "cpu share": self._cpu_share.since_last(),
        }
        return "; ".join(filter(None, warnings)), values

    def _statuses(self) -> list[DiagnosticStatus]:
        """One status for each place."""
        name = self.get_fully_qualified_name().lstrip("/")
        return [_status(f"{name}: {place}", state) for place, state in self._watcher.places.items()]


def why(found: Finding) -> str:
    """The effect of an alarm in words, as far as it is clear.

    Args:
        found: the change.
    """
    clear = "likeliest" if found.probability > SURE else "not clear yet why, perhaps"
    return f"{clear} {found.hypothesis} ({found.probability:.0%})"


def _status(name: str, place: Place) -> DiagnosticStatus:
    message = place.state
    if place.state == PARTED:
        message = f"model and rig have parted: {place.effect} ({place.probability:.0%})"
    elif place.state == DRIFTED:
        message = f"further off than a calibrated rig: {place.effect}"
    values: dict[str, object] = {
        "state": place.state, "gap": place.gap, "limit": place.limit, "residual": place.residual,
        "since": place.since_ns * 1e-9, "effect": place.effect, "probability": place.probability, "size": place.size,
    }
    return DiagnosticStatus(level=LEVEL.get(place.state, DiagnosticStatus.OK), name=name, message=message,
                            hardware_id="model beside the rig",
                            values=[KeyValue(key=k, value=f"{v:.10g}" if k == "since" else f"{v:.4g}"
                                             if isinstance(v, float) else str(v)) for k, v in values.items()])


_ARM, _ROTOR = interface.JOINTS
_BAG_FAILS = OSError, WriterError
_NO_SAMPLES = "no samples: plant or bridge does not publish, or its stamps stand still"


def _check_writable(folder: Path) -> None:
    """Refuse a folder in which no bag can be made, at the start and not at the first alarm."""
    there = next(one for one in (folder.absolute(), *folder.absolute().parents) if one.exists())
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        raise UserError(f"bags: {folder} cannot be written ({there} is {'not yours' if there.is_dir() else 'a file'}); "
                        "give another folder, as in -p bags:=alarms, or an empty name for no bags")


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `watch`."""
    return run(Watch, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
