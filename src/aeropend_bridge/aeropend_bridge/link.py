# SPDX-License-Identifier: Apache-2.0
"""A serial port that may disappear and come back. Reading waits, writing does not."""

from __future__ import annotations

import os
import select
import threading
import time
from contextlib import suppress

import serial

from aeropend_sim.errors import UserError


class LinkError(UserError):
    """The port cannot be opened, or has disappeared. The message is one line with the reason and the remedy."""


class Link:
    """One port. One thread opens, reads and closes; all threads may write.

    Args:
        port: path of the device, resolved at each opening.
        baud: [bit/s] rate.

    Attributes:
        dropped: number of writes that were dropped because the port was full or closed.
    """

    def __init__(self, port: str, baud: int) -> None:
        self.port = port
        self._baud = baud
        self._serial: serial.Serial | None = None
        self._lock = threading.Lock()
        self._torn = False
        self.dropped = 0

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._serial is not None

    def open(self) -> None:
        """Open the port, for this program only.

        Raises:
            LinkError: it cannot be opened now.
        """
        self.close()
        try:
            opened = serial.Serial(self.port, self._baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise LinkError(self._reason(error)) from error
        with self._lock:
            self._serial, self._torn = opened, False

    def _reason(self, error: Exception) -> str:
        text = str(error)
        if isinstance(error, FileNotFoundError) or "No such file" in text:
            return f"there is no {self.port}: plug the board in, or name its port"
        if "exclusively lock" in text:
            return f"{self.port} is in use by another program: end it"
        if "Permission denied" in text:
            return f"{self.port} may not be opened: join its group (sudo usermod -aG dialout $USER) and log in again"
        if any(said in text for said in ("Inappropriate ioctl", "Is a directory", "No such device")):
            return f"{self.port} is no serial port: name that of the board (`doctor` lists the ports)"
        return f"{self.port} cannot be opened: {getattr(error, 'strerror', None) or text}"

    def close(self) -> None:
        """Close the port if it is open."""
        with self._lock:
            if self._serial is not None:
                with suppress(OSError):
                    self._serial.close()
                self._serial = None

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """Wait for bytes.

        Args:
            timeout_s: [s] longest wait.

        Returns:
            The bytes, none after `timeout_s`, and the monotonic time of the host at which they were there, ns.

        Raises:
            LinkError: the port has disappeared.
        """
        if self._serial is None:
            raise LinkError(f"{self.port} is not open")
        try:
            fd = self._serial.fileno()
            if not select.select([fd], [], [], timeout_s)[0]:
                return b"", time.monotonic_ns()
            now = time.monotonic_ns()
            data = os.read(fd, 4096)  # the size of a terminal: larger buffers fragment the heap
        except BlockingIOError:
            return b"", time.monotonic_ns()
        except (OSError, ValueError) as error:
            raise LinkError(f"lost {self.port}: {getattr(error, 'strerror', None) or error}") from error
        if not data:
            raise LinkError(f"lost {self.port}: it was closed")
        return data, now

    def write(self, data: bytes) -> bool:
        """Write a frame if that is possible at once; return whether it was written."""
        with self._lock:
            if self._serial is None:
                self.dropped += 1
                return False
            if self._torn:  # ends the part of a frame that was sent
                data = b"\0" + data
            try:
                written = os.write(self._serial.fileno(), data)
            except (OSError, ValueError):  # full, or disappeared, which reading reports
                self.dropped += 1
                return False
            self._torn = written < len(data)
            self.dropped += self._torn
            return not self._torn
