# SPDX-License-Identifier: Apache-2.0
"""The board of a real rig as a ROS 2 node, with the topics, services and rate of the simulated plant.

Stamps are the instants of sampling by the board's clock; the module `clock` converts them to ROS time. After the port
was opened or the board was reset, no sample is published until the clock has settled (0.4 s). The stamps then have a
gap, which is counted.

The board sets the duty to 0 if it receives no command for 100 ms. The simulated plant holds the last `duty_command`.
For the same behaviour, this node repeats the present duty every `REPEAT_S`. The executor repeats it, so the motor stops
if the node ends, hangs or loses its port. After the port was lost, the board was reset, or the node was stopped, the
duty is 0 until the next command. Commands that were sent while the node was stopped do not count.

One thread reads the port and publishes. The callbacks of the executor send commands. A command that cannot be written
at once is dropped.
"""

import math
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from aeropend_bridge import calibration, protocol
from aeropend_bridge.clock import BoardClock
from aeropend_bridge.link import Link, LinkError
from aeropend_bridge.protocol import Flag, Hello, Mode, Sample, Scheme
from aeropend_sim.errors import UserError
from aeropend_sim.ros.diagnostics import Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.realtime import CLOCK_STEP_NS, prepare_thread, request_realtime_priority
from aeropend_sim.ros.rig_interface import RigInterface
from aeropend_sim.ros.settings import Setting, overrides, read_settings
from aeropend_sim.ros.usage import usage
from aeropend_sim.ros.worker import Worker

REPEAT_S = 0.02
"""[s] Time between repetitions of the duty. Derived: the board may miss four within its timeout of 100 ms."""
RETRY_S = 0.1
"""[s] Time between attempts to open the port, and between requests to the board. A choice."""
SILENCE_S = 0.1
"""[s] Time without a sample after which the board counts as not connected. A choice."""

ANSWER_S = 0.3
"""[s] A HELLO later than this after a request is no answer: the board was reset. A choice."""

SETTINGS = {
    "port": Setting("/dev/ttyACM0", "serial port of the board; better a path in /dev/serial/by-id"),
    "scheme": Setting("pwm", "how the board reads the encoder", choices=("pwm", "ssi")),
    **{
        f"{calibration.SECTION}.{name}": Setting(
            getattr(calibration.default(), name), known.description, known.unit, known.low, known.high
        )
        for name, known in calibration.NUMBERS.items()
    },
}

USAGE = usage(
    "bridge: the board of a real aeropendulum. Publishes joint_states and armature at 490.196 Hz, takes duty_command.",
    SETTINGS,
    [
        "bridge",
        "bridge --ros-args -p port:=/dev/ttyACM1 -p scheme:=ssi",
        "bridge --ros-args --params-file my_calibration.yaml       (from `calibrate my_calibration.yaml`)",
    ],
    "  flash the board with `make -C firmware flash`; wiring in firmware/README.md",
)


@dataclass
class Counts:
    """Events since the start of the node. `/diagnostics` has the same names, with spaces."""

    samples: int = 0
    lost_samples: int = 0
    reconnects: int = 0
    board_resets: int = 0
    gaps: int = 0
    samples_without_command: int = 0
    receive_errors_on_the_board: int = 0
    speed_pulses_rejected: int = 0
    angles_with_errors: int = 0
    commands_without_board: int = 0
    commands_refused_by_the_board: int = 0
    stalls: int = 0
    commands_of_a_stall: int = 0


class Bridge(RigInterface):
    """The node. See the module's docstring for time and commands, and docs/interfaces.md for topics."""

    def __init__(self) -> None:
        super().__init__("bridge")
        settings = read_settings(self, SETTINGS, overrides(self))
        prefix = f"{calibration.SECTION}."
        numbers = {name.removeprefix(prefix): value for name, value in settings.items() if name.startswith(prefix)}
        self._calibration = calibration.Calibration(**numbers)
        self._scheme = Scheme[settings["scheme"].upper()]
        self._link = Link(settings["port"], protocol.BAUD)
        self._receiver = protocol.Receiver()
        latency_ns = protocol.FRAME_NS[self._scheme] + round(self._calibration.latency * 1e9)
        self._clock_of_board = BoardClock(protocol.TICK_NS, latency_ns)
        self._sequence = 0
        self._settings_sent = self._commanded = 0.0
        self._ignore_until = -math.inf
        self._hello: Hello | None = None
        self._asked = -math.inf
        self._other_version: int | None = None
        self._last: Sample | None = None
        self._last_time = 0
        self._heard = -math.inf
        self._counts = Counts()
        self._gap_max = 0.0
        self._stamp = 0
        self._problem = ""

        self.advertise()
        self._diagnostics = Diagnostics(self, self._report, "aeropendulum's board")
        self._repeat = self.create_timer(REPEAT_S, self._on_repeat, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._worker = Worker(self, self._serve, "samples")
        self._worker.start()

    def close(self) -> None:
        """Stop the motor and close the port."""
        self._worker.stop()
        if self._hello is not None:
            self.duty = 0.0
            self._command()
        self._link.close()

    # ---- the thread that reads -------------------------------------------------------------------------------------

    def _serve(self, end: threading.Event) -> None:
        prepare_thread()
        request_realtime_priority()
        while not end.is_set():
            self._serve_port(end)

    def _serve_port(self, end: threading.Event) -> None:
        try:
            self._link.open()
            self._problem = ""
            self._receiver.restart()
            self._converse(end)
        except LinkError as error:
            self._lose(str(error))
            end.wait(RETRY_S)

    def _lose(self, why: str) -> None:
        if self._link.is_open:
            self._counts.reconnects += 1
        self._link.close()
        self._forget_board()
        if why != self._problem:
            self.get_logger().warn(f"{why}; trying again every {RETRY_S:g} s")
            self._problem = why

    def _forget_board(self) -> None:
        """Forget the state of the board. The duty is 0 until the next command."""
        with self.lock:
            self._hello, self._last, self.duty = None, None, 0.0
        self._clock_of_board.restart()

    def _converse(self, end: threading.Event) -> None:
        link, receiver = self._link, self._receiver
        clock_checked = -math.inf
        while not end.is_set():
            now = time.monotonic()
            if self._hello is None and now - self._asked >= RETRY_S:
                self._ask()
            if now - clock_checked >= 1.0:
                clock_checked = now
                self.follow_system_clock()
            data, arrival_ns = link.read(RETRY_S)
            samples: list[Sample] = []
            for message in receiver.feed(data):
                if isinstance(message, Sample):
                    samples.append(message)
                elif isinstance(message, Hello):
                    samples.clear()  # from before the reset, or from an unknown board
                    self._greet(message)
                elif message.status != protocol.Status.OK:
                    self._counts.commands_refused_by_the_board += 1
            if samples and self._hello is not None:
                self._take(samples, arrival_ns)

    def _ask(self) -> None:
        self._asked = time.monotonic()
        self._link.write(protocol.hello_request())

    def _greet(self, hello: Hello) -> None:
        if hello.version != protocol.VERSION:
            if self._other_version != hello.version:  # ask again: a disturbed frame must not end the node
                self._other_version = hello.version
                self._ask()
                return
            raise UserError(
                f"the board at {self._link.port} speaks protocol version {hello.version}, this bridge speaks"
                f" {protocol.VERSION}: flash the firmware that came with it (make -C firmware flash"
                f" PORT={self._link.port})"
            )
        self._other_version = None
        firmware = ".".join(map(str, hello.firmware))
        if self._hello is None:
            self.get_logger().info(f"board at {self._link.port}: firmware {firmware}, build {hello.build:08x}")
        elif time.monotonic() - self._asked > ANSWER_S:
            self._counts.board_resets += 1
            self.get_logger().warn(f"the board was reset ({hello.why_reset()}): duty 0 until the next command")
            self._forget_board()
        with self.lock:
            self._hello = hello
            self._send_settings()

    def _send_settings(self) -> None:
        self._settings_sent = time.monotonic()
        self._link.write(
            protocol.set_mode(Mode.DIRECT)
            + protocol.set_scheme(self._scheme)
            + protocol.enable(self.enabled)
        )
        self._command()

    def _take(self, samples: list[Sample], arrival_ns: int) -> None:
        """Publish the samples of one read.

        Args:
            samples: in the order of arrival.
            arrival_ns: [ns] arrival of the last one, host's monotonic clock.
        """
        clock, counts = self._clock_of_board, self._counts
        for sample in samples:
            board_ns = clock.extend(sample.time)
            if self._last is not None:
                periods = round((board_ns - self._last_time) / (protocol.SAMPLE_TICKS * protocol.TICK_NS))
                if periods <= 0 or (clock.settled and clock.early_ns(board_ns, arrival_ns) > CLOCK_STEP_NS):
                    counts.board_resets += 1  # and its HELLO was lost
                    self.get_logger().warn("the board's clock restarted: duty 0 until the next command")
                    self._forget_board()
                    return
                counts.lost_samples += periods - 1
            self._last, self._last_time = sample, board_ns
            self._note(sample)
            if sample is samples[-1]:
                clock.add(board_ns, arrival_ns)
            if clock.settled:
                self._publish(sample, clock.host_ns(board_ns) + self.to_ros_ns)
        self._heard = time.monotonic()

    def _note(self, sample: Sample) -> None:
        flags, counts = sample.flags, self._counts
        counts.samples_without_command += bool(flags & Flag.COMMAND_TIMEOUT)
        counts.receive_errors_on_the_board += bool(flags & Flag.RECEIVE_ERROR)
        counts.speed_pulses_rejected += bool(flags & Flag.PULSE_REJECTED)
        counts.angles_with_errors += bool(flags & Flag.SSI and flags & (Flag.SSI_PARITY | Flag.SSI_STATUS))

    def _publish(self, sample: Sample, stamp_ns: int) -> None:
        theta, omega, v_a, i_a, duty = self._calibration.measured(sample)
        gap = (stamp_ns - self._stamp) * 1e-9
        if self._stamp and gap > SILENCE_S:
            self._counts.gaps += 1
            self._gap_max = max(self._gap_max, gap)
            self.get_logger().warn(f"no samples for {gap:.3f} s")
        self._stamp = stamp_ns
        self.publish_sample(stamp_ns, theta, omega, v_a, i_a, duty)
        self._counts.samples += 1

    # ---- the callbacks of the executor -----------------------------------------------------------------------------

    def _command(self) -> None:
        """Send the present duty to the board."""
        self._commanded = time.monotonic()
        self._sequence = (self._sequence + 1) & 0xFF
        self._link.write(protocol.duty_command(self._sequence, self.duty))

    def take_duty(self, duty: float) -> None:
        """Send a commanded duty to the board, if there is one and the node did not stand still before."""
        if self._hello is None:
            self._counts.commands_without_board += 1
        elif self._ignores_commands_after_stall():
            self._counts.commands_of_a_stall += 1
        elif self.enabled:
            self.duty = duty
            self._command()

    def _ignores_commands_after_stall(self) -> bool:
        """Set the duty to 0 if this node stood still; return whether a command may be from before.

        The board has stopped the motor. A command that waited in the middleware must not start it again.
        """
        now = time.monotonic()
        since = now - self._commanded
        if since > protocol.COMMAND_TIMEOUT_S and self.duty > 0.0:
            self._counts.stalls += 1
            self.get_logger().warn(f"stood still for {since:.2f} s: duty 0 until the next command")
            self.duty = 0.0
            self._ignore_until = now + REPEAT_S
        return now < self._ignore_until

    def _on_repeat(self) -> None:
        with self.lock:
            if self._hello is None:
                return
            self._ignores_commands_after_stall()
            if time.monotonic() - self._commanded > 0.5 * REPEAT_S:
                self._command()
            if self._last is not None and time.monotonic() - self._settings_sent > RETRY_S:
                flags = self._last.flags
                actual = bool(flags & Flag.ENABLED), bool(flags & Flag.SSI), bool(flags & Flag.PID)
                if actual != (self.enabled, self._scheme == Scheme.SSI, False):
                    self._send_settings()

    def enabled_changed(self) -> None:
        """Send the new setting to the board. It is sent again until the flags of the samples show it."""
        if self._hello is not None:
            self._send_settings()

    def _report(self) -> tuple[str, dict[str, object]]:
        hello, lost = self._hello, self._counts.lost_samples
        connected = hello is not None and time.monotonic() - self._heard < SILENCE_S
        values: dict[str, object] = {
            **{name.replace("_", " "): count for name, count in asdict(self._counts).items()},
            "bad frames": self._receiver.bad,
            "refused commands": self.refused,
            "clamped commands": self.clamped,
            "dropped writes": self._link.dropped,
            "clock steps": self.clock_steps,
            "longest gap s": self._gap_max,
            "connected": connected,
            "enabled": self.enabled,
            "port": self._link.port,
            "firmware": ".".join(map(str, hello.firmware)) if hello else "",
            "clock drift ppm": self._clock_of_board.drift * 1e6,
            "clock stops": self._clock_of_board.stops,
            "clock offset s": (self._stamp - self._last_time) * 1e-9,
            "cpu share": self.cpu_share.since_last(),
        }
        if not connected:
            return self._problem or f"the board at {self._link.port} sends nothing", values
        return (f"{lost} samples lost" if lost else ""), values


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `bridge`."""
    return run(Bridge, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
