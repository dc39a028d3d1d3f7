# SPDX-License-Identifier: Apache-2.0
"""The serial protocol between board and host: frames, messages, and the decoding of a stream of bytes.

The names are those of firmware/protocol.h; firmware/README.md describes the fields. A frame is COBS(payload + CRC-16,
high byte first) and a zero byte. The CRC is that of CCITT with the initial value 0xFFFF. The first byte of the payload
is the type of the message; numbers are little endian. Board times are u32 ticks of 0.5 µs; they wrap after 35.8 min.

A frame with a correct CRC is still refused if its length does not fit its type, or if a value is outside the range of
the board's converters. The reason: a flipped bit in a COBS code byte changes several bytes at once, and a CRC of 16
bits accepts one in 65536 of such frames.
"""

from __future__ import annotations

import binascii
import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

from cobs import cobs

VERSION = 1
"""Version of the protocol of this module."""
BAUD = 500_000
"""[bit/s] Rate of the line."""
TICK_NS = 500
"""[ns] Unit of board times."""
SAMPLE_TICKS = 4080
"""[ticks] Board time between samples: 64 · 510 cycles of 62.5 ns."""
CALIBRATION_SIZE = 16
"""Bytes that the board stores for the host."""
LONGEST = 64
"""Number of bytes between two zeros from which on they are no frame. A choice: frames have at most 36."""
COMMAND_TIMEOUT_S = 0.1
"""[s] Time without a DUTY command after which the board sets the duty to 0."""


class Type(IntEnum):
    """Type of a message: the first byte of its payload."""

    SAMPLE = 0x01
    HELLO = 0x02
    ACK = 0x03
    DUTY = 0x10
    HELLO_REQUEST = 0x11
    ENABLE = 0x12
    SCHEME = 0x13
    PID_GAINS = 0x14
    PID_REFERENCE = 0x15
    MODE = 0x16
    WRITE_CALIBRATION = 0x17


class Scheme(IntEnum):
    """How the board reads the encoder: its filtered PWM output by the ADC, or SSI."""

    PWM = 0
    SSI = 1


FRAME_NS = {Scheme.PWM: 1_123_000, Scheme.SSI: 1_019_000}
"""[ns] Time from the sampling instant to the last bit of its frame: conversions, computation, 23 bytes. Measured with
the emulator."""


class Mode(IntEnum):
    """Source of the duty: the commands of the host, or the PID on the board."""

    DIRECT = 0
    PID = 1


class Status(IntEnum):
    """Answer of the board to a command."""

    OK = 0
    BAD_VALUE = 1
    UNKNOWN_TYPE = 2
    DISABLED = 3


class Flag(IntFlag):
    """Bits of the flags of a sample."""

    ENABLED = 1 << 0
    SSI = 1 << 1
    SSI_PARITY = 1 << 2
    SSI_STATUS = 1 << 3
    PULSE_REJECTED = 1 << 4
    COMMAND_TIMEOUT = 1 << 5
    PID = 1 << 6
    WATCHDOG_RESET = 1 << 7
    BROWN_OUT = 1 << 8
    RECEIVE_ERROR = 1 << 9
    NEW_PERIOD = 1 << 10


_FLAGS = (1 << 11) - 1

RESET_CAUSES = {0: "power-on", 1: "reset line", 2: "brown-out", 3: "watchdog", 4: "JTAG"}
"""Reset causes by bit of MCUSR (data sheet of the ATmega2560, 12.5.1)."""


class Sample(NamedTuple):
    """One sample, in raw counts.

    Attributes:
        sequence: number of the frame, 0..255.
        time: [ticks] board time of the sampling instant.
        duty: output-compare value that acts, 0..255.
        current: [counts] 0..1023.
        angle: [counts] 0..1023.
        voltage: [counts] -512..511.
        period: [ticks] duration of the last turn of the rotor; 0: none.
        flags: see `Flag`.
    """

    sequence: int
    time: int
    duty: int
    current: int
    angle: int
    voltage: int
    period: int
    flags: int


class Hello(NamedTuple):
    """Description of the board.

    Attributes:
        version: of the protocol.
        firmware: version of the firmware.
        reset_cause: register MCUSR after the last reset.
        scheme: how it reads the encoder.
        calibration: bytes that a host has stored on the board.
        build: hash of the firmware.
    """

    version: int
    firmware: tuple[int, int, int]
    reset_cause: int
    scheme: int
    calibration: bytes
    build: int

    def why_reset(self) -> str:
        """The reset cause as text."""
        return " and ".join(text for bit, text in RESET_CAUSES.items() if self.reset_cause >> bit & 1) or "unknown"


class Ack(NamedTuple):
    """The answer of the board to a command.

    Attributes:
        of: type of the command.
        status: see `Status`.
    """

    of: int
    status: int


Message = Sample | Hello | Ack

_SAMPLE = struct.Struct("<BBIBHHhIH")
_HELLO = struct.Struct(f"<BBBBBBB{CALIBRATION_SIZE}sI")
_ACK = struct.Struct("<BBB")


def frame(payload: bytes) -> bytes:
    """Return the bytes on the wire for a payload."""
    return cobs.encode(payload + binascii.crc_hqx(payload, 0xFFFF).to_bytes(2, "big")) + b"\0"


def unframe(between_zeros: bytes) -> bytes | None:
    """Return the payload of the bytes between two zeros, or None if they are no frame."""
    if not 4 <= len(between_zeros) < LONGEST:
        return None
    try:
        content = cobs.decode(between_zeros)
    except cobs.DecodeError:
        return None
    # the CRC of a message and its own CRC is 0
    return content[:-2] if binascii.crc_hqx(content, 0xFFFF) == 0 else None


def parse(payload: bytes) -> Message | None:
    """Return the message of a payload from the board, or None if it is no message or has an impossible value."""
    kind, size = payload[0], len(payload)
    if kind == Type.SAMPLE and size == _SAMPLE.size:
        sample = Sample._make(_SAMPLE.unpack(payload)[1:])
        possible = (
            sample.current < 1024
            and sample.angle < 1024
            and -512 <= sample.voltage < 512
            and sample.flags <= _FLAGS
        )
        return sample if possible else None
    if kind == Type.HELLO and size == _HELLO.size:
        _, version, major, minor, patch, cause, scheme, calibration, build = _HELLO.unpack(payload)
        return Hello(version, (major, minor, patch), cause, scheme, calibration, build)
    if kind == Type.HELLO and size > 1:  # of another protocol version: the rest of its layout is not known
        return Hello(payload[1], (0, 0, 0), 0, 0, bytes(CALIBRATION_SIZE), 0) if payload[1] != VERSION else None
    if kind == Type.ACK and size == _ACK.size:
        return Ack._make(_ACK.unpack(payload)[1:])
    return None


class Receiver:
    """Decodes a stream of bytes into messages. It stores at most one unfinished frame.

    Attributes:
        bad: number of refused frames. Bytes before the first zero do not count.
    """

    def __init__(self) -> None:
        self.bad = 0
        self._rest = b""
        self._synchronised = False
        self._too_long = False

    def restart(self) -> None:
        """Start with a stream that was just opened."""
        self._rest = b""
        self._synchronised = self._too_long = False

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes, and return the messages that they complete."""
        pieces = (self._rest + data).split(b"\0")
        self._rest = pieces.pop()
        messages: list[Message] = []
        for piece in pieces:
            if not self._synchronised or self._too_long:
                self.bad += self._synchronised
                self._synchronised, self._too_long = True, False
            elif piece:
                payload = unframe(piece)
                message = parse(payload) if payload else None
                if message is None:
                    self.bad += 1
                else:
                    messages.append(message)
        if len(self._rest) >= LONGEST:
            self._rest, self._too_long = b"", True
        return messages


def duty_command(sequence: int, duty: float) -> bytes:
    """Frame of DUTY. The board does not acknowledge it.

    Args:
        sequence: 0..255.
        duty: 0..1.
    """
    return frame(struct.pack("<BBH", Type.DUTY, sequence, round(duty * 65535)))


def hello_request() -> bytes:
    """Frame of HELLO_REQUEST; the board answers with HELLO."""
    return frame(bytes([Type.HELLO_REQUEST]))


def enable(on: bool) -> bytes:
    """Frame of ENABLE; False means duty 0."""
    return frame(bytes([Type.ENABLE, on]))


def set_scheme(scheme: Scheme) -> bytes:
    """Frame of SCHEME."""
    return frame(bytes([Type.SCHEME, scheme]))


def set_mode(mode: Mode) -> bytes:
    """Frame of MODE."""
    return frame(bytes([Type.MODE, mode]))


def pid_gains(kp: float, ki: float, kd: float, filter_s: float, low: float, high: float) -> bytes:
    """Frame of PID_GAINS.

    Args:
        kp: [1/rad] proportional gain, duty per angle.
        ki: [1/(rad·s)] integral gain.
        kd: [s/rad] derivative gain.
        filter_s: [s] time constant of the derivative filter.
        low: smallest duty.
        high: greatest duty.
    """
    return frame(struct.pack("<B6f", Type.PID_GAINS, kp, ki, kd, filter_s, low, high))


def pid_reference(theta: float) -> bytes:
    """Frame of PID_REFERENCE.

    Args:
        theta: [rad] reference of the angle, as the encoder reads it.
    """
    return frame(struct.pack("<Bf", Type.PID_REFERENCE, theta))


def write_calibration(block: bytes) -> bytes:
    """Frame of WRITE_CALIBRATION.

    Args:
        block: bytes to store on the board.

    Raises:
        ValueError: the block is not `CALIBRATION_SIZE` bytes.
    """
    if len(block) != CALIBRATION_SIZE:
        raise ValueError(f"a calibration block of {len(block)} bytes: the board stores {CALIBRATION_SIZE}")
    return frame(bytes([Type.WRITE_CALIBRATION]) + block)
