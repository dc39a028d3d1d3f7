# SPDX-License-Identifier: Apache-2.0
"""The board's program for the tests: built, altered, run in the emulator, and checked.

Each check takes a program, so that the same check that the real one passes must fail on an altered one.

Run as a command, `python -m boards CAPTURES`, it measures what is too long for the suite.
"""

import binascii
import fcntl
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cobs import cobs

FIRMWARE = Path(__file__).parents[2] / "firmware"
sys.path.insert(0, str(FIRMWARE / "emulator"))

from board import GOOD_STATUS, PERIOD_CYCLES, TICK_CYCLES, Board, Chip, Pins  # noqa: E402 - not installed

from aeropend_sim.model.parameters import Model, load  # noqa: E402

SAMPLE, HELLO, ACK = 1, 2, 3
DUTY, HELLO_REQUEST, ENABLE, SCHEME, PID_GAINS, PID_REFERENCE, MODE, WRITE_CALIBRATION = range(0x10, 0x18)
(ENABLED, SSI, SSI_PARITY, SSI_STATUS, PULSE_REJECTED, COMMAND_TIMEOUT, PID, WATCHDOG, BROWN_OUT_RESET, RECEIVE_ERROR,
 NEW_PERIOD) = (1 << bit for bit in range(11))

PERIOD_TICKS = PERIOD_CYCLES // TICK_CYCLES
STEERED_CYCLES = 5
"""Steps in which a command is moved through a period: fewer than between looking for TOP and writing the duty."""
OVERFLOW_CYCLES = 65536 * TICK_CYCLES
VOLTAGE_LSB = 2.56 / 512
FAST = ((1, 1), (2, 1), (3, 1), (4, 1), (5, 1), (6, 1), (13, 2))
"""Revolutions in overflows of Timer4."""


def build() -> None:
    """Build the program and the emulator, once, however many tests ask at the same time."""
    with (FIRMWARE / "Makefile").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        subprocess.run(["make", "--silent", "-C", str(FIRMWARE), "program"], check=True)


def altered(folder: Path, file: str, old: str, new: str) -> Path:
    """Build a copy of the program in which `old` has become `new` in one place, and return it."""
    for source in (*FIRMWARE.glob("*.[ch]"), FIRMWARE / "Makefile"):
        shutil.copy(source, folder)
    text = (folder / file).read_text()
    assert text.count(old) == 1, f"'{old}' is {text.count(old)} times in {file}"
    (folder / file).write_text(text.replace(old, new))
    subprocess.run(["make", "--silent", "-C", str(folder), "build/aeropend.elf"], check=True)
    return folder / "build/aeropend.elf"


def frame(payload: bytes) -> bytes:
    """Return the frame of a payload."""
    return cobs.encode(payload + binascii.crc_hqx(payload, 0xFFFF).to_bytes(2, "big")) + b"\0"


class Sample(NamedTuple):
    """A SAMPLE message, as README.md says."""

    sequence: int
    time: int
    duty: int
    current: int
    angle: int
    voltage: int
    period: int
    flags: int


class Host:
    """The other end of the line: takes frames apart and counts the bad ones."""

    def __init__(self, chip: Chip | Board) -> None:
        self._chip = chip
        self._rest = b""
        self.bad = 0
        self.samples: list[Sample] = []
        self.answers: list[bytes] = []

    def read(self) -> "Host":
        """Take what has come; samples go to `samples`, all else to `answers`."""
        *frames, self._rest = (self._rest + self._chip.receive()).split(b"\0")
        for encoded in filter(None, frames):
            try:
                data = cobs.decode(encoded)
            except cobs.DecodeError:
                self.bad += 1
                continue
            payload = data[:-2]
            if not payload or binascii.crc_hqx(payload, 0xFFFF) != int.from_bytes(data[-2:], "big"):
                self.bad += 1
            elif payload[0] == SAMPLE:
                self.samples.append(Sample(*struct.unpack("<BIBHHhIH", payload[1:])))
            else:
                self.answers.append(payload)
        return self

    def send(self, kind: int, fields: str = "", *values: float) -> None:
        """Send a command."""
        self._chip.send(frame(bytes([kind]) + struct.pack(f"<{fields}", *values)))

    def duty(self, duty: float) -> None:
        """Command a duty, 0..1."""
        self.send(DUTY, "BH", 0, round(duty * 65535))

    def forget(self) -> None:
        """Read, and drop it all."""
        self.read()
        self.samples, self.answers = [], []


class Bench:
    """A chip with given voltages on its pins, and its host."""

    def __init__(self, program: Path, **pins: float) -> None:
        self.chip = Chip(program)
        self.pins = Pins(**{"status": GOOD_STATUS, "positive": 0.5, "negative": 0.5, **pins})
        self.host = Host(self.chip)
        self.run(5)
        self.host.forget()

    def run(self, periods: int = 1, edges: Sequence[int] | np.ndarray = ()) -> None:
        """Run periods."""
        self.chip.run(self.pins, edges, periods)

    def sample(self) -> Sample:
        """Return a sample that was taken with these voltages from its beginning."""
        self.run(3)
        return self.host.read().samples[-1]

    def answer(self, kind: int, fields: str = "", *values: float) -> bytes:
        """Send a command and return what it answers."""
        self.host.forget()
        self.host.send(kind, fields, *values)
        self.run(3)
        answers = self.host.read().answers
        assert len(answers) == 1, f"{len(answers)} answers"
        return answers[0]

    def enable(self) -> None:
        """Enable the board."""
        assert self.answer(ENABLE, "B", 1) == bytes([ACK, ENABLE, 0])


def quiet(model: str = "bench") -> Model:
    """Return a model whose measurements have no noise."""
    model = load(model)
    return Model(model.name, model.model, {name: 0.0 if name.endswith("_noise") else value
                                           for name, value in model.sensing.items()})


def check_sampling(program: Path) -> None:
    """Samples come each 2.04 ms of the board's own time, none is missing, and the duty acts for just as long."""
    bench = Bench(program)
    start = bench.chip.cycle
    bench.run(600)
    assert bench.chip.cycle - start == 600 * PERIOD_CYCLES
    samples = bench.host.read().samples
    assert 599 <= len(samples) <= 601
    assert {(b.sequence - a.sequence) % 256 for a, b in pairwise(samples)} == {1}
    assert {b.time - a.time for a, b in pairwise(samples)} == {PERIOD_TICKS}
    assert bench.host.bad == 0


def check_duty_told(program: Path) -> None:
    """The duty in a sample is the one that acted while it was taken, at whatever time in the period commands came."""
    for scheme in (0, 1):
        bench = Bench(program)
        origin = bench.chip.cycle - 9 * PERIOD_CYCLES // 2  # of the board's time: half a period before the first TOP
        bench.answer(SCHEME, "B", scheme)
        bench.enable()
        random = np.random.default_rng(4)
        acting, told = {}, {}
        for delay in range(0, PERIOD_CYCLES, STEERED_CYCLES):  # TOP comes once in between
            bench.chip.send(frame(bytes([DUTY, 0]) + random.bytes(2)), delay)
            acting[(bench.chip.cycle + PERIOD_CYCLES // 2 - origin) // TICK_CYCLES] = bench.chip.outcome.duty
            bench.run()
            told |= {sample.time: sample.duty for sample in bench.host.read().samples}
        bench.run(2)
        told |= {sample.time: sample.duty for sample in bench.host.read().samples}
        assert len(set(acting.values())) > 50
        assert acting == {time: told[time] for time in acting}


def check_voltage(program: Path) -> None:
    """The armature voltage is read within 1 LSB over the whole range, without offset, whatever else is on the pins."""
    random = np.random.default_rng(1)
    bench = Bench(program)
    for scheme in (0, 1):
        assert bench.answer(SCHEME, "B", scheme) == bytes([ACK, SCHEME, 0])
        errors = []
        for volts in [-2.56, 2.555, *random.uniform(-2.56, 2.555, 250).tolist()]:
            low = random.uniform(max(0.0, -volts), min(5.0, 5.0 - volts))
            bench.pins.negative, bench.pins.positive = low, low + volts
            bench.pins.angle, bench.pins.current = random.choice([0.0, 2.5]), random.choice([0.0, 2.5])
            errors.append(bench.sample().voltage - volts / VOLTAGE_LSB)
        assert np.abs(errors).max() <= 1.0
        assert abs(np.mean(errors)) <= 0.1


def edges_onto_overflows(first: int, captures: int, seed: int) -> Iterator[np.ndarray]:
    """Edges of a rotor that turns with 3..200 rev/s, cycles, many of them within 45 us of an overflow of Timer4.

    Args:
        first: cycle of an overflow, from which on they come.
        captures: how many at least.
        seed: of the speeds.

    Yields:
        A run of edges each, at one speed that drifts over the overflow, the next one reached as fast as the motor can.
    """
    random = np.random.default_rng(seed)
    at, turn, made = float(first), OVERFLOW_CYCLES / 3, 0
    while made < captures:
        # so many revolutions in so many overflows: 30 to 198 rev/s, or 3 to 30
        fast = random.random() < 0.8
        revolutions, overflows = FAST[random.integers(len(FAST))] if fast else (1, int(random.integers(1, 11)))
        target = OVERFLOW_CYCLES * overflows / revolutions
        run = []
        while turn != target:
            reach = min(0.3 * turn, 60.0 * (turn / 16e6) ** 2 * turn)  # by 60 rev/s^2
            turn = float(np.clip(target, turn - reach, turn + reach))
            at += turn
            run.append(round(at))
        # then it drifts: slowly over the very cycle of the overflow, or anywhere about it
        slow = random.random() < 0.5
        drift = int(random.choice([-2, -1, 1, 2] if slow else [-9, -3, 7, 23]))
        aim = -20.0 * drift if slow else random.uniform(-100, 600)
        # a little longer turns until one ends where it begins
        missing = (first + aim - at) % (OVERFLOW_CYCLES / revolutions)
        turns = 2 + int(missing / (25.0 * (turn / 16e6) ** 2 * turn))
        for longer in [missing / turns] * turns + [drift / revolutions] * (40 * revolutions // overflows + 6):
            at += target + longer
            run.append(round(at))
        made += len(run)
        yield np.array(run)


def check_speed(program: Path, captures: int = 6000, seed: int = 1) -> tuple[int, int]:
    """Each revolution is timed within 1 tick, none is refused, however its edges lie to the overflows.

    Returns:
        Captures checked, and how many of them were within 45 us of an overflow.
    """
    bench = Bench(program)
    overflow = bench.chip.next_overflow
    edges: list[np.ndarray] = []
    timed: list[int] = []

    def take() -> None:
        for sample in bench.host.read().samples:
            assert not sample.flags & PULSE_REJECTED, "a good pulse was refused"
            if sample.flags & NEW_PERIOD:
                timed.append(sample.period)
        assert bench.host.bad == 0
        bench.host.forget()

    for run in edges_onto_overflows(overflow, captures, seed):
        while len(run):
            start = bench.chip.cycle
            last = run[: np.searchsorted(run, start + 2000 * PERIOD_CYCLES)][-1:]  # the line holds no more
            periods = int((last[0] - start) // PERIOD_CYCLES) + 1 if len(last) else 2000
            count = np.searchsorted(run, start + periods * PERIOD_CYCLES)
            bench.run(periods, run[:count] - start)
            edges.append(run[:count])
            run = run[count:]
            take()
    bench.run(3)
    take()
    at = np.concatenate(edges)
    turns = np.diff(at) / TICK_CYCLES
    assert len(timed) == len(turns), f"{len(timed)} periods for {len(turns)} revolutions"
    assert np.abs(timed - turns).max() <= 1.0
    return len(turns), int(((at - overflow + 720) % OVERFLOW_CYCLES < 1440).sum())


def check_watchdog(program: Path) -> None:
    """A main program that hangs is reset within 100 ms, the duty is 0 from then on, and the host gets a message."""
    bench = Bench(program)
    bench.enable()
    bench.host.duty(0.5)
    bench.run(3)
    assert bench.chip.outcome.duty == 128
    bench.chip.hang()
    bench.host.forget()
    bench.run(49)
    assert bench.chip.outcome.resets == 1
    assert bench.chip.duty_register == 0
    bench.run(5)
    hello = bench.host.read().answers[0]
    assert hello[0] == HELLO
    assert hello[5] & 0b1000
    assert bench.host.samples[-1].flags & WATCHDOG


def check_bad_frames(program: Path) -> None:
    """A command with a wrong bit in it does nothing, and the host gets a message; the next one counts."""
    random = np.random.default_rng(2)
    bench = Bench(program)
    bench.enable()
    for _ in range(60):
        bench.host.duty(0.0)
        bench.run(2)
        good = frame(struct.pack("<BBH", DUTY, 0, 40000))
        bad = bytearray(good)
        bit = int(random.integers(8 * (len(good) - 1)))
        bad[bit // 8] ^= 1 << bit % 8
        bench.host.forget()
        bench.chip.send(bytes(bad) + b"\0")
        bench.run(3)
        assert bench.chip.duty_register == 0, bytes(bad).hex()
        assert any(s.flags & RECEIVE_ERROR for s in bench.host.read().samples)
        bench.chip.send(good)
        bench.run(3)
        assert bench.chip.duty_register == 156


def check_disabled(program: Path) -> None:
    """Nothing moves the motor while the board is disabled, nor when it is enabled before the next command."""
    bench = Bench(program)
    for mode in (0, 1):
        assert bench.answer(MODE, "B", mode) == bytes([ACK, MODE, 0])
        bench.answer(PID_GAINS, "6f", 1.0, 0.0, 0.0, 0.0, 0.3, 1.0)

        def command(mode: int = mode) -> None:
            if mode:
                bench.host.send(PID_REFERENCE, "f", 3.0)
            else:
                bench.host.duty(0.7)
            bench.run(3)

        command()
        assert bench.chip.duty_register == 0
        bench.enable()
        assert bench.chip.duty_register == 0
        command()
        assert bench.chip.duty_register > 0
        bench.answer(ENABLE, "B", 0)
        assert bench.chip.duty_register == 0
        command()
        assert bench.chip.duty_register == 0


def check_timeout(program: Path) -> None:
    """The motor has no voltage 100 ms after the last command, and still had some after 90."""
    for mode in (0, 1):
        bench = Bench(program)
        bench.answer(MODE, "B", mode)
        bench.answer(PID_GAINS, "6f", 1.0, 0.0, 0.0, 0.0, 0.3, 1.0)
        bench.enable()
        for _ in range(100):  # as long as commands come it goes on
            if mode:
                bench.host.send(PID_REFERENCE, "f", 3.0)
            else:
                bench.host.duty(0.7)
            bench.run(2)
            assert bench.chip.duty_register > 0
        bench.run(3)  # the last one is there
        sent = bench.chip.cycle - 5 * PERIOD_CYCLES
        assert bench.chip.outcome.duty > 0
        while bench.chip.outcome.duty > 0:
            bench.run(1)
            assert bench.chip.cycle - sent < 0.2 * 16e6
        assert 0.090 <= (bench.chip.cycle - sent) / 16e6 <= 0.100
        assert bench.host.read().samples[-1].flags & COMMAND_TIMEOUT or bench.sample().flags & COMMAND_TIMEOUT


def check_receiver(program: Path) -> None:
    """Commands back to back, pulses and SSI at once: no byte is lost."""
    bench = Bench(program)
    bench.answer(SCHEME, "B", 1)
    bench.host.forget()
    for k in range(200):
        for _ in range(9):
            bench.host.duty(0.5)
        bench.run(1, [k * 163])
    assert bench.chip.outcome.overruns == 0
    assert not any(s.flags & RECEIVE_ERROR for s in bench.host.read().samples)


CHECKS: tuple[Callable[[Path], object], ...] = (
    check_sampling, check_duty_told, check_voltage, check_speed, check_watchdog, check_bad_frames, check_disabled,
    check_timeout, check_receiver)


def _measure(captures: int) -> None:
    build()
    board = Board(quiet())
    begin, cpu = time.perf_counter(), time.process_time()
    for _ in range(3000):
        board.step()
    simulated = 3000 * PERIOD_CYCLES / 16e6
    print(f"emulator with plant: {simulated / (time.process_time() - cpu):.1f} x real time by its processor time, "
          f"{simulated / (time.perf_counter() - begin):.1f} by the wall clock")
    begin = time.perf_counter()
    checked, near = check_speed(FIRMWARE / "build/aeropend.elf", captures)
    print(f"{checked} captures, {near} of them within 45 us of an overflow: each within 1 tick, none refused "
          f"({time.perf_counter() - begin:.0f} s)")


if __name__ == "__main__":
    _measure(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000)
