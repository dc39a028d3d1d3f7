# SPDX-License-Identifier: Apache-2.0
"""A board of a few lines behind a real pty: it speaks the protocol, keeps its rules, and can be unplugged and reset.

It has no physics. For a board with the real firmware see firmware/emulator.
"""

import contextlib
import os
import select
import struct
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path

from aeropend_bridge import protocol
from aeropend_bridge.protocol import Flag, Type

PERIOD_NS = 2_040_000
LATENCY_NS = protocol.FRAME_NS[protocol.Scheme.PWM]


class PtyBoard:
    """Samples every 2.04 ms from a thread until `stop`.

    Args:
        path: where a link to the pty appears while the board is plugged in.
        version: protocol version that it tells.
        ticks: its clock when it is switched on.
        drift: how much slower its clock runs than the host's, a fraction.
        sample: overrides fields of the samples, given the output-compare value.

    Attributes:
        duty: what the output-compare register holds.
        applied: (monotonic ns, value) of its changes.
        taken: (board time, monotonic ns) of the latest samples.
        commands: types of the commands received.
    """

    def __init__(
        self,
        path: Path,
        version: int = protocol.VERSION,
        ticks: int = 1000,
        drift: float = 0.0,
        sample: Callable[[int], dict[str, int]] = lambda duty: {},
    ) -> None:
        self.path, self.version, self.sample = path, version, sample
        self._period = PERIOD_NS * (1.0 + drift)
        self._ticks = ticks
        self.taken: deque[tuple[int, int]] = deque(maxlen=5000)
        self.applied: deque[tuple[int, int]] = deque(maxlen=5000)
        self.commands: list[int] = []
        self.garbage = b""
        self.mute = False
        self._lock = threading.Lock()
        self._boot(power_on=True)
        self._master = self._slave = -1
        self.plug()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _boot(self, power_on: bool = False) -> None:
        self.duty, self.enabled, self.scheme, self.mode = 0, False, 0, 0
        self._cause = 1 if power_on else 2
        self._sequence = 0
        self._commanded = -1
        self._pending = b""

    def plug(self) -> None:
        """Offer a pty, under the same path as before."""
        with self._lock:
            master, self._slave = os.openpty()  # the slave stays open: no EIO while nobody listens
            tty.setraw(self._slave)
            os.set_blocking(master, False)
            self._master = master
            self.path.unlink(missing_ok=True)
            self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Take the pty away; the board stays on."""
        with self._lock:
            self.path.unlink()
            os.close(self._slave)
            os.close(self._master)
            self._master = -1

    def reset(self) -> None:
        """Press the reset button."""
        with self._lock:
            self._ticks = 1000
            self._set_duty(0)
            self._boot()
            self._hello()

    def stop(self) -> None:
        """Switch the board off."""
        self._end.set()
        self._thread.join()
        if self._master >= 0:
            self.unplug()

    def _run(self) -> None:
        due = float(time.monotonic_ns())
        while not self._end.is_set():
            due += self._period
            self._wait(due)
            at = time.monotonic_ns()
            with self._lock:
                if self.duty and at - self._commanded > protocol.COMMAND_TIMEOUT_S * 1e9:
                    self._set_duty(0)
                self._ticks = (self._ticks + protocol.SAMPLE_TICKS) % 2**32
                flags = Flag.ENABLED * self.enabled | Flag.SSI * self.scheme | Flag.PID * self.mode
                fields = {"current": 100, "angle": 200, "voltage": 40, "period": 0, "flags": flags}
                fields |= self.sample(self.duty)
                head = Type.SAMPLE, self._sequence, self._ticks, self.duty
                payload = struct.pack("<BBIBHHhIH", *head, *fields.values())
                self._sequence = (self._sequence + 1) % 256
                self.taken.append((self._ticks, int(due)))
            self._wait(due + LATENCY_NS)
            with self._lock:
                if not self.mute:
                    self._send(self.garbage + protocol.frame(payload))
                    self.garbage = b""

    def litter(self, data: bytes) -> None:
        """Send these bytes before the next sample."""
        with self._lock:
            self.garbage += data

    def _wait(self, until_ns: float) -> None:
        """Listen to commands until then."""
        while (left := until_ns - time.monotonic_ns()) > 0:
            master = self._master
            if master < 0:
                time.sleep(left * 1e-9)
                continue
            with contextlib.suppress(OSError, ValueError):
                if select.select([master], [], [], left * 1e-9)[0]:
                    with self._lock:
                        self._receive(os.read(master, 4096))

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody reads
            os.write(self._master, data)

    def _hello(self) -> None:
        payload = struct.pack(
            "<BBBBBBB16sI", Type.HELLO, self.version, 1, 2, 3, self._cause, self.scheme, bytes(16), 0xC0FFEE
        )
        self._send(protocol.frame(payload))

    def _receive(self, data: bytes) -> None:
        *frames, self._pending = (self._pending + data).split(b"\0")
        for payload in filter(None, map(protocol.unframe, frames)):
            self.commands.append(payload[0])
            kind, value = payload[0], payload[1:]
            if kind == Type.HELLO_REQUEST:
                self._hello()
                continue
            if kind == Type.DUTY:
                self._commanded = time.monotonic_ns()
                if self.enabled:
                    self._set_duty(round(struct.unpack("<H", value[1:])[0] * 255 / 65535))
                continue
            if kind == Type.ENABLE:
                self.enabled = bool(value[0])
                if not self.enabled:
                    self._set_duty(0)
            elif kind == Type.SCHEME:
                self.scheme = value[0]
            elif kind == Type.MODE:
                self.mode = value[0]
            self._send(protocol.frame(bytes([Type.ACK, kind, 0])))

    def _set_duty(self, duty: int) -> None:
        if duty != self.duty:
            self.duty = duty
            self.applied.append((time.monotonic_ns(), duty))
