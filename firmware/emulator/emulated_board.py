# SPDX-License-Identifier: GPL-3.0-or-later
"""The emulated board on a serial port of this machine, in real time. The bridge connects to this port.

A period of the PWM, from TOP to TOP of Timer1, is simulated at its start by the wall clock. The sample in its middle is
taken 1.02 ms later. Bytes that have arrived at the port reach the board. Each frame is sent at the time of its last
byte.
"""

from __future__ import annotations

import argparse
import errno
import os
import queue
import random
import re
import signal
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from board import (
    ANGLE_ZERO,
    BROWN_OUT,
    CLOCK_HZ,
    EXTERNAL,
    GOOD_STATUS,
    PERIOD_CYCLES,
    POWER_ON,
    PROGRAM,
    Board,
    BoardError,
    Outcome,
)

from aeropend_sim.cli.command import Parser
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import PRESETS, Model, ModelError, from_flat, load, read_flat
from aeropend_sim.ros.realtime import monotonic_to_ros_ns, prepare_thread, request_realtime_priority

PERIOD_NS = PERIOD_CYCLES * 1_000_000_000 // CLOCK_HZ
BACKLOG = 49
"""Greatest lateness, in periods, that the program makes up for; if it is later, the board's time stops. A choice."""

FAULTS = {
    "reset": "the reset button",
    "brownout": "the supply dips, the processor resets",
    "hang": "the main program hangs; the watchdog resets it",
    "unplug": "no cable, no power (default 1 s); then a new power-on",
    "flip": "a bit in a byte is flipped, both ways; RATE per byte (default 0.001)",
    "lose": "a byte is lost, both ways; RATE per byte (default 0.001)",
    "stuck": "the encoder keeps its value",
    "parity": "the encoder's SSI parity is wrong",
    "magnet": "the encoder reports that the magnet is out of range",
    "dropout": "the IR sensor gives no pulses",
}

DESCRIPTION = "The emulated board with the aeropendulum, on a serial port of this machine. Prints the port's path."

EPILOG = """faults, NAME[@START][+LENGTH][:RATE] with times in s from the start; without LENGTH they do not end:
""" + "\n".join(f"  {name:<10} {text}" for name, text in FAULTS.items()) + """
  You can also type them while the board runs, one per line, without START; 'end' ends all of them.

examples:
  emulated_board --link /tmp/aeropend
  emulated_board --model my.yaml --effect coulomb_friction.accel=0.8 --set model.R_a=1.2
  emulated_board --fault reset@5 --fault flip@10+2:0.01

exit codes: 0 ended, by Ctrl-C too; 2 it cannot run (one line says why)"""


class UsageError(ValueError):
    """A request of the user that cannot be met. The message is one line."""


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        name: its name in `FAULTS`.
        start: [s] its start.
        length: [s] its duration; inf: without end.
        rate: its probability per byte.
    """

    name: str
    start: float
    length: float
    rate: float

    @classmethod
    def parse(cls, text: str, now: float | None = None) -> Fault:
        """Read NAME[@START][+LENGTH][:RATE].

        Args:
            text: the text.
            now: [s] start without START; None: START is required.

        Raises:
            UsageError: the text has another form.
        """
        number = r"([0-9.]+(?:e-?[0-9]+)?)"
        match = re.fullmatch(rf"(\w+)(?:@{number})?(?:\+{number})?(?::{number})?", text.strip())
        if match is None or match[1] not in FAULTS:
            names = ", ".join(FAULTS)
            raise UsageError(f"fault '{text.strip()}': give NAME[@START][+LENGTH][:RATE], NAME one of {names}")
        try:
            start, length, rate = (float(part) if part else None for part in match.groups()[1:])
        except ValueError:
            raise UsageError(f"fault '{text.strip()}': it has an invalid number") from None
        if start is None and now is None:
            raise UsageError(f"fault '{text.strip()}': give its start, as in {match[1]}@5")
        name = match[1]
        if length is None:
            length = 1.0 if name == "unplug" else float("inf")
        return cls(name, start if start is not None else now or 0.0, length, 0.001 if rate is None else rate)


class Port:
    """A pseudo-terminal in raw mode, and a symbolic link to it.

    Args:
        link: path of the link; None for no link.

    Attributes:
        lost: number of bytes that were not read in time.
        path: of the terminal.
    """

    def __init__(self, link: Path | None) -> None:
        self._link = link
        self.lost = 0
        if link is not None and (link.exists() or link.is_symlink()):
            if not link.is_symlink():
                raise UsageError(f"{link} exists and is not a link: name another with --link")
            if link.exists():
                raise UsageError(f"{link} is in use by another board: name another with --link")
            link.unlink()
        self.plug()

    def plug(self) -> None:
        """Create the port."""
        # an open slave keeps the master readable when the other side closes
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        if self._link is not None:
            try:
                self._link.symlink_to(self.path)
            except OSError as error:
                raise UsageError(f"cannot make the link {self._link}: {error.strerror}") from None

    def unplug(self) -> None:
        """Remove the port; programs that have it open get an error."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._slave)
        os.close(self._master)

    def read(self) -> bytes:
        """The bytes that have arrived from the other side."""
        try:
            return os.read(self._master, 4096)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise
            return b""

    def write(self, data: bytes) -> None:
        """Send bytes as far as there is room. The others are lost, and old bytes are removed first, as in a driver."""
        if not data:
            return
        try:
            sent = os.write(self._master, data)
        except BlockingIOError:
            sent = 0
        if sent < len(data):
            self.lost += len(data) - sent
            with suppress(termios.error):
                termios.tcflush(self._slave, termios.TCIFLUSH)  # no program reads: remove old bytes


class EmulatedBoard:
    """The board, its port, and the faults."""

    def __init__(self, board: Board, port: Port, faults: Sequence[Fault], seed: int, truth: TextIO | None) -> None:
        self._board, self._port, self._truth = board, port, truth
        self._waiting = sorted(faults, key=lambda fault: fault.start)
        self._lasting: list[tuple[float, Fault]] = []
        self._random = random.Random(seed)
        self._unsent = b""
        self._typed: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.stop = False

    def run(self) -> None:
        """Run until `stop`."""
        threading.Thread(target=self._read_standard_input, daemon=True).start()
        prepare_thread()
        request_realtime_priority()
        start = deadline = time.monotonic_ns()
        to_ros = monotonic_to_ros_ns()
        samples = 0
        while not self.stop:
            self._inject((deadline - start) * 1e-9)
            outcome = self._period(deadline)
            if self._truth is not None:
                self._write_truth(outcome, deadline + to_ros)
            samples += 1
            if samples % 490 == 0:
                to_ros = monotonic_to_ros_ns()
            deadline += PERIOD_NS
            late = (time.monotonic_ns() - deadline) // PERIOD_NS
            if late > BACKLOG:
                print(f"emulated_board: stood still for {late} periods", file=sys.stderr, flush=True)
                deadline += late * PERIOD_NS
            _sleep_until(deadline)

    def _period(self, start_ns: int) -> Outcome:
        board = self._board
        if not board.powered:
            return board.step()
        behind = (time.monotonic_ns() - start_ns) * CLOCK_HZ // 1_000_000_000
        board.chip.send(self._spoil(self._port.read()), min(behind, PERIOD_CYCLES - 1))
        outcome = board.step()
        data, times = board.chip.receive_timed()
        begin = 0
        for at, byte in enumerate(data):
            if byte == 0:
                _sleep_until(start_ns + (times[at] - outcome.start) * 1_000_000_000 // CLOCK_HZ)
                self._port.write(self._spoil(self._unsent + data[begin : at + 1]))
                self._unsent, begin = b"", at + 1
        self._unsent += data[begin:]
        return outcome

    def _write_truth(self, o: Outcome, start_ns: int) -> None:
        truth = self._board.truth
        written = start_ns + (o.written - o.start) * 1_000_000_000 // CLOCK_HZ
        assert self._truth is not None
        self._truth.write(
            f"{start_ns + PERIOD_NS // 2} {o.duty} {self._board.chip.duty_register} {written} "
            f"{truth.theta!r} {truth.theta_dot!r} {truth.i_a!r} {truth.omega!r} {truth.v_a!r}\n")

    def _inject(self, now: float) -> None:
        while not self._typed.empty():
            line = self._typed.get()
            if line == "end":
                self._lasting = [(0.0, fault) for _, fault in self._lasting]
                continue
            try:
                self._waiting.insert(0, Fault.parse(line, now))
            except UsageError as error:
                print(f"emulated_board: {error}", file=sys.stderr, flush=True)
        for fault in [fault for fault in self._waiting if fault.start <= now]:
            self._waiting.remove(fault)
            self._begin(fault, now)
        for ended in [item for item in self._lasting if item[0] <= now]:
            self._lasting.remove(ended)
            self._set(ended[1].name, False)

    def _begin(self, fault: Fault, now: float) -> None:
        chip = self._board.chip
        momentary: dict[str, Callable[[], None]] = {
            "reset": lambda: chip.reset(EXTERNAL), "brownout": lambda: chip.reset(BROWN_OUT), "hang": chip.hang,
        }
        if fault.name in momentary:
            if self._board.powered:
                momentary[fault.name]()
        else:
            self._set(fault.name, True)
            self._lasting.append((now + fault.length, fault))
        print(f"emulated_board: {fault.name} at {now:.3f} s", file=sys.stderr, flush=True)

    def _set(self, name: str, on: bool) -> None:
        board, plant = self._board, self._board.plant
        if name == "unplug" and on == board.powered:
            board.powered = not on
            if on:
                self._port.unplug()
                self._unsent = b""
            else:
                board.chip.reset(POWER_ON)
                self._port.plug()
                print(f"emulated_board: {self._port.path}", flush=True)
        elif name == "stuck":
            plant.stuck = on
        elif name == "dropout":
            plant.dropout = on
        elif name == "parity":
            plant.pins.parity_error = on
        elif name == "magnet":
            plant.pins.status = 0b10011 & ~0b10000 if on else GOOD_STATUS

    def _rate(self, name: str) -> float:
        return sum(fault.rate for _, fault in self._lasting if fault.name == name)

    def _spoil(self, data: bytes) -> bytes:
        if not self._lasting or not data:
            return data
        flip, lose, chance = self._rate("flip"), self._rate("lose"), self._random.random
        flipped = (byte ^ (1 << self._random.randrange(8)) if chance() < flip else byte for byte in data)
        return bytes(byte for byte in flipped if chance() >= lose)

    def _read_standard_input(self) -> None:
        for line in sys.stdin:
            if line.strip():
                self._typed.put(line.strip())


def _sleep_until(deadline_ns: int) -> None:
    wait = deadline_ns - time.monotonic_ns()
    if wait > 0:
        time.sleep(wait * 1e-9)


def _numbers(effects: Sequence[str], others: Sequence[str]) -> dict[str, float]:
    """Convert `--effect` and `--set` to the dotted names of a model file."""
    flat: dict[str, float] = {}
    for text in [f"effects.{effect}" for effect in effects] + list(others):
        name, equals, value = text.partition("=")
        effect = CATALOGUE.get(name.removeprefix("effects."))
        if not equals and effect is not None:
            flat |= {f"{name}.{key}": parameter.default for key, parameter in effect.parameters.items()}
            continue
        try:
            flat[name] = float(value)
        except ValueError:
            raise UsageError(f"'{text.removeprefix('effects.')}': give NAME=NUMBER") from None
    return flat


def _model(source: str, preset: str) -> Model:
    """Read a model like the plant node: a preset, or a file whose missing parameters come from a preset."""
    flat = read_flat(source)
    for name in [name for name, value in flat.items() if value in (None, "")]:
        del flat[name]
        flat |= _numbers([name.removeprefix("effects.")], [])
    return from_flat(flat, source, load(preset))


def _parser() -> Parser:
    parser = Parser(prog="emulated_board", description=DESCRIPTION, epilog=EPILOG,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE", help="model of the plant (default bench)")
    parser.add_argument("--preset", default="bench", choices=PRESETS,
                        help="supplies the missing parameters of the model file (default bench)")
    parser.add_argument("--effect", action="append", default=[], metavar="ID[.PARAMETER=VALUE]",
                        help="an effect of the plant; without a value it has the defaults of the catalogue")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE",
                        help="a parameter of the model, as in model.R_a=1.2")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random numbers (default 0)")
    parser.add_argument("--angle-zero", type=int, default=ANGLE_ZERO, metavar="COUNTS",
                        help=f"reading of the encoder when the arm hangs (default {ANGLE_ZERO})")
    parser.add_argument("--link", type=Path, metavar="PATH", help="a symbolic link to the port")
    parser.add_argument("--fault", action="append", default=[], metavar="FAULT", help="a fault, see below")
    parser.add_argument("--program", type=Path, default=PROGRAM, metavar="ELF", help="the board's program")
    parser.add_argument("--truth", type=Path, metavar="FILE",
                        help="write the true states, one line per sample: system time of sampling (ns), duty that acts "
                        "next, duty register, time of its last change (ns), theta, theta_dot, i_a, omega, v_a")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `emulated_board`."""
    arguments = _parser().parse_args(argv)
    port = truth = None
    try:
        faults = [Fault.parse(text) for text in arguments.fault]
        model = from_flat(_numbers(arguments.effect, arguments.set), "emulated_board",
                          _model(arguments.model, arguments.preset))
        board = Board(model, arguments.seed, arguments.program, arguments.angle_zero)
        if arguments.truth is not None:
            truth = arguments.truth.open("x", encoding="utf-8")
        board.plant.step(0.0)  # compiles it before the first deadline
        board.plant.reset()
        port = Port(arguments.link)
        program = EmulatedBoard(board, port, faults, arguments.seed, truth)

        def on_signal(*_: object) -> None:
            program.stop = True

        signal.signal(signal.SIGINT, on_signal)
        signal.signal(signal.SIGTERM, on_signal)
        print(f"emulated_board: {port.path}" + (f" ({arguments.link})" if arguments.link else ""), flush=True)
        program.run()
    except (BoardError, ModelError, UsageError) as error:
        print(f"emulated_board: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except FileExistsError:
        print(f"emulated_board: {arguments.truth} exists: name another file with --truth", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"emulated_board: {error.filename or 'the port'}: {error.strerror}", file=sys.stderr)
        return 2
    finally:
        if truth is not None:
            truth.close()
        if port is not None:
            with suppress(OSError):
                port.unplug()
    return 0


if __name__ == "__main__":
    sys.exit(main())
