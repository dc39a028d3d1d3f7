# SPDX-License-Identifier: Apache-2.0
"""Real node processes for the tests, and a node of the tests' own that listens to them."""

import atexit
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from aeropend_sim.ros import interface
from aeropend_sim.ros.transport import without_shared_memory

MODULES = {
    "plant": "aeropend_sim.nodes.plant",
    "pose": "aeropend_sim.nodes.pose",
    "bridge": "aeropend_bridge.bridge",
    "calibrate": "aeropend_bridge.calibrate",
    "excite": "aeropend_control.nodes.excite",
    "small_signal": "aeropend_control.nodes.controller small_signal",
    "feedback_linearization": "aeropend_control.nodes.controller feedback_linearization",
    "cascade": "aeropend_control.nodes.controller cascade",
    "feedback_linearization_cascade": "aeropend_control.nodes.controller feedback_linearization_cascade",
    "reference": "aeropend_control.nodes.reference",
    "step_test": "aeropend_control.nodes.step_run",
    "record": "aeropend_ident.nodes.record",
    "replay": "aeropend_ident.nodes.replay",
    "watch": "aeropend_ident.nodes.watch",
    "diagnose": "aeropend_ident.commands.diagnose",
}
PATIENCE_S = 60.0
"""How long a test waits for what must come: discovery and a first compilation take long on a loaded machine."""
AGAIN_S = 5.0
"""How long a service may take before it is asked again, s."""
LAST_WORDS_S = 5.0
"""How long a process that does not end may take to say what its threads do, s."""


def isolate() -> None:
    """Keep this process and those it starts on this machine and in a domain of their own."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(os.getpid() % 50)
    log = tempfile.mkdtemp(prefix="aeropend_log_")
    atexit.register(shutil.rmtree, log, ignore_errors=True)
    os.environ["ROS_LOG_DIR"] = log


class Process:
    """A command in a process of its own, stopped when a `with` is left; its output goes to one file.

    Args:
        name: a key of MODULES.
        args: its arguments.
    """

    def __init__(self, name: str, *args: str) -> None:
        self.name = name
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        self.popen = subprocess.Popen(self.command(*args), stdout=self._output, stderr=subprocess.STDOUT,
                                      env={**os.environ, "PYTHONFAULTHANDLER": "1"})

    def command(self, *args: str) -> list[str]:
        """What is run."""
        return [sys.executable, "-m", *MODULES[self.name].split(), *args]

    def __enter__(self) -> "Process":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def output(self) -> str:
        """What it has printed so far, standard output and error together."""
        self._output.seek(0)
        return self._output.read().decode()

    def wait_for(self, text: str) -> "Process":
        """Wait until it has printed this text, and return the process."""
        end = time.monotonic() + PATIENCE_S
        while text not in self.output:
            assert self.popen.poll() is None, f"ended with {self.popen.returncode}: {self.output}"
            assert time.monotonic() < end, f"'{text}' never came: {self.output}"
            time.sleep(0.02)
        return self

    def wait_for_handlers(self) -> "Process":
        """Wait until it handles SIGTERM, which Python does not do on its own, and return the process."""
        end = time.monotonic() + PATIENCE_S
        while not self._caught() >> (signal.SIGTERM - 1) & 1:
            assert self.popen.poll() is None, f"ended with {self.popen.returncode}: {self.output}"
            assert time.monotonic() < end, "it never handled the signal"
            time.sleep(0.01)
        return self

    def _caught(self) -> int:
        status = Path(f"/proc/{self.popen.pid}/status").read_text()
        return next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt"))

    def send(self, number: signal.Signals) -> "Process":
        """Send a signal."""
        self.popen.send_signal(number)
        return self

    def wait(self, timeout: float = PATIENCE_S) -> int:
        """Wait for the end and return the exit code; if it does not end, say what each of its threads does.

        Raises:
            TimeoutExpired: with the output; the process has been aborted.
        """
        try:
            return self.popen.wait(timeout)
        except subprocess.TimeoutExpired:
            self.popen.send_signal(signal.SIGABRT)  # its fault handler prints the threads
            with suppress(subprocess.TimeoutExpired):
                self.popen.wait(LAST_WORDS_S)
            raise subprocess.TimeoutExpired(f"{self.name}: {self.output}", timeout) from None

    def stop(self) -> int:
        """End it as Ctrl-C does and return the exit code; kill it when it does not."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGCONT)
            self.popen.send_signal(signal.SIGINT)
        try:
            return self.wait()
        finally:
            self.popen.kill()
            self.popen.wait()


def parameters(**values: object) -> list[str]:
    """Return the ROS arguments that set these parameters; `__` in a name stands for a dot."""
    args = ["--ros-args"]
    for name, value in values.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        args += ["-p", f"{name.replace('__', '.')}:={text}"]
    return args


class Graph:
    """The tests' own node."""

    def __init__(self) -> None:
        with patch.dict(os.environ):  # who is started later chooses for itself
            without_shared_memory()
            rclpy.init(args=[])
            self.node = Node("test")
        self._executor = EventsExecutor()
        self._executor.add_node(self.node)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Spin until a condition holds, and return it."""
        end = time.monotonic() + PATIENCE_S
        while not (result := condition()):
            assert time.monotonic() < end, f"waited {PATIENCE_S:.0f} s for {what}"
            self._executor.spin_once(timeout_sec=0.02)
        return result

    def shown(self, topic: str) -> dict[str, dict[str, list[TopicEndpointInfo]]] | None:
        """The publishers and the subscriptions, by topic, of the one process that publishes a topic; None: not known.

        The question is by process, not by node: the node of an entity is known from messages, and one of them may be
        lost for good when two processes send theirs at once (https://github.com/ros2/rmw_fastrtps/issues/792).
        """
        processes = {_process(info) for info in self.node.get_publishers_info_by_topic(topic)}
        if len(processes) != 1:
            return None
        found: dict[str, dict[str, list[TopicEndpointInfo]]] = {"publishers": {}, "subscriptions": {}}
        for name, _ in self.node.get_topic_names_and_types():
            for kind, infos in (
                ("publishers", self.node.get_publishers_info_by_topic(name)),
                ("subscriptions", self.node.get_subscriptions_info_by_topic(name)),
            ):
                if own := [info for info in infos if _process(info) in processes]:
                    found[kind][name] = own
        return found

    @contextmanager
    def listening(self, kind: type, topic: str) -> Iterator[list[Any]]:
        """Collect the messages of a topic, from when its publisher is known."""
        messages: list[Any] = []
        subscription = self.node.create_subscription(kind, topic, messages.append, interface.QOS)
        try:
            self.until(lambda: self.node.count_publishers(topic), f"a publisher of {topic}")
            yield messages
        finally:
            self.node.destroy_subscription(subscription)
            self._executor.spin_once(timeout_sec=0)  # only now does it let go

    @contextmanager
    def talking(self, kind: type, topic: str) -> Iterator[Callable[[Any], None]]:
        """Publish on a topic, from when somebody listens."""
        publisher = self.node.create_publisher(kind, topic, interface.QOS)
        try:
            self.until(publisher.get_subscription_count, f"a subscriber of {topic}")
            yield publisher.publish
        finally:
            self.node.destroy_publisher(publisher)

    def call(self, kind: type, service: str, request: Any) -> Any:
        """Call a service and return its response.

        A server that does not know the client's ear yet answers in vain, so a request without an answer is repeated.
        """
        client = self.node.create_client(kind, service)
        asked: list[Any] = []
        try:
            self.until(client.service_is_ready, f"service {service}")
            begun = time.monotonic()

            def answered() -> Any:
                if time.monotonic() > begun + len(asked) * AGAIN_S:
                    asked.append(client.call_async(request))
                return next((future for future in asked if future.done()), None)

            return self.until(answered, f"an answer of {service}").result()
        finally:
            self.node.destroy_client(client)

    def diagnostics(self, name: str, enough: Callable[[dict[str, str]], bool] = bool) -> dict[str, str]:
        """Return the counters of a node, once they are enough."""
        with self.listening(DiagnosticArray, interface.DIAGNOSTICS) as messages:

            def find() -> dict[str, str] | None:
                for message in messages:
                    for status in message.status:
                        values = {value.key: value.value for value in status.values}
                        if status.name == name and enough(values):
                            return values
                return None

            return self.until(find, f"diagnostics of {name}")


def _process(info: TopicEndpointInfo) -> tuple[int, ...]:
    """The process an endpoint lives in: the prefix of its id (DDSI-RTPS 2.5, section 8.2.4)."""
    return tuple(info.endpoint_gid[:12])


def stamps(messages: Sequence[Any]) -> list[int]:
    """Return the header stamps of messages, ns."""
    return [interface.stamp_ns(message.header.stamp) for message in messages]
