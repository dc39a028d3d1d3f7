# SPDX-License-Identifier: GPL-3.0-or-later
"""The board with the aeropendulum on its pins, in simulated time: one period of the PWM per call.

`board.c` emulates the processor and its peripherals; the plant is `aeropend_sim`. Both are stepped from TOP to TOP of
Timer1, where the duty changes. The sample is in the middle of the period, where the pulse is.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aeropend_sim.model import sensing
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from aeropend_sim.model.rig import Rig

BUILD = Path(__file__).parents[1] / "build"
PROGRAM = BUILD / "aeropend.elf"
LIBRARY = BUILD / "libboard.so"

CLOCK_HZ = 16_000_000
"""[Hz] Clock of the processor."""
PERIOD_CYCLES = 64 * 510
TICK_CYCLES = 8
"""[cycles] One tick of the board's time."""
REFERENCE_V = 2.56
CURRENT_V_PER_A = 1.65
"""[V/A] Scale of the current at A0: the motor shield gives 3.3 V at 2 A."""
LOW_SIDE_V, LOW_SIDE_OHM = 0.3, 0.5
"""[V], [Ω] Voltage drop of the H-bridge between the motor's lower terminal (A1) and ground: transistor and shunt."""
ANGLE_ZERO = 256
"""[counts] Reading of the encoder when the arm hangs."""
ANGLE_COUNTS = 1024
GOOD_STATUS = 0b10000
"""OCF set, COF, LIN, MagINC and MagDEC clear."""

POWER_ON, EXTERNAL, BROWN_OUT = 1, 2, 4
"""Causes of a reset, as in MCUSR."""


class Pins(ctypes.Structure):
    """State of the pins during a period, in V and counts; see `board.h`."""

    _fields_ = [
        ("current", ctypes.c_double),
        ("angle", ctypes.c_double),
        ("positive", ctypes.c_double),
        ("negative", ctypes.c_double),
        ("position", ctypes.c_uint16),
        ("status", ctypes.c_uint8),
        ("parity_error", ctypes.c_uint8),
    ]


class Outcome(ctypes.Structure):
    """Result of a period; see `board.h`."""

    _fields_ = [
        ("start", ctypes.c_uint64),
        ("cycles", ctypes.c_uint32),
        ("duty", ctypes.c_uint8),
        ("running", ctypes.c_uint8),
        ("resets", ctypes.c_uint16),
        ("overruns", ctypes.c_uint16),
        ("ssi_faults", ctypes.c_uint16),
        ("written", ctypes.c_uint64),
    ]


class Load(ctypes.Structure):
    """Load by the interrupts, in cycles, and size of the stack, in bytes; see `board.h`."""

    _fields_ = [
        ("cycles", ctypes.c_uint64),
        ("longest", ctypes.c_uint32),
        ("longest_of", ctypes.c_uint32 * 64),
        ("receiver_waited", ctypes.c_uint32),
        ("stack", ctypes.c_uint32),
    ]


class BoardError(RuntimeError):
    """The emulator cannot be used. The message is one line."""


class Chip:
    """The processor with its program; the caller sets the pins."""

    def __init__(self, program: Path = PROGRAM, library: Path = LIBRARY) -> None:
        """Load a program and turn the power on.

        Args:
            program: ELF file of the board's program.
            library: the emulator.

        Raises:
            BoardError: one of them is missing or cannot be loaded.
        """
        for file in (program, library):
            if not file.exists():
                raise BoardError(f"{file} is missing: build it with 'make -C firmware'")
        try:
            self._library = ctypes.CDLL(str(library))
        except OSError as error:
            raise BoardError(f"{library} cannot be loaded: {error}") from None
        call = self._library
        call.board_new.restype = ctypes.c_void_p
        call.board_next_overflow.restype = call.board_cycle.restype = ctypes.c_uint64
        call.board_duty_register.restype = ctypes.c_uint8
        handle = call.board_new(str(program).encode())
        if not handle:
            raise BoardError(f"{program} is not a program for the board")
        self._handle = ctypes.c_void_p(handle)
        self._bytes = (ctypes.c_uint8 * 65536)()
        self._times = (ctypes.c_uint64 * 65536)()
        self.outcome = Outcome()
        self._outcome = ctypes.byref(self.outcome)

    def close(self) -> None:
        """Free the memory. No other method may be called after this."""
        if self._handle:
            self._library.board_free(self._handle)
            self._handle = ctypes.c_void_p()

    def __del__(self) -> None:
        if hasattr(self, "_handle"):
            self.close()

    def run(self, pins: Pins, edges: Sequence[int] | np.ndarray = (), periods: int = 1) -> Outcome:
        """Run periods with constant pins.

        Args:
            pins: state of the pins.
            edges: [cycles] rising edges at the IR input, from the start, ascending.
            periods: number of periods.

        Returns:
            The result; the same object at each call.

        Raises:
            BoardError: the processor has stopped.
        """
        count = len(edges)
        array = None
        if count:
            array = np.ascontiguousarray(edges, dtype=np.uint32).ctypes.data_as(ctypes.POINTER(ctypes.c_uint32))
        if self._library.board_run(self._handle, ctypes.byref(pins), periods, array, count, self._outcome) != 0:
            raise BoardError("the processor has stopped: the program slept with interrupts off, or ran out of memory")
        return self.outcome

    def send(self, data: bytes, delay: int = 0) -> int:
        """Send bytes to the board.

        Args:
            data: the bytes.
            delay: [cycles] time until the first one.

        Returns:
            The number of bytes for which there was room.
        """
        return int(self._library.board_send(self._handle, data, len(data), delay))

    def receive(self) -> bytes:
        """The bytes that the board has sent since the last call."""
        count = self._library.board_receive(self._handle, self._bytes, None, len(self._bytes))
        return ctypes.string_at(self._bytes, count)

    def receive_timed(self) -> tuple[bytes, list[int]]:
        """As `receive`, and the cycle at which each byte was complete."""
        count = self._library.board_receive(self._handle, self._bytes, self._times, len(self._bytes))
        return ctypes.string_at(self._bytes, count), list(self._times[:count])

    def reset(self, cause: int = EXTERNAL) -> None:
        """Reset the processor. Its time continues, its memory stays.

        Args:
            cause: of the reset, as in MCUSR.
        """
        self._library.board_reset(self._handle, cause)

    def hang(self) -> None:
        """Stop the main program until a reset; interrupts continue."""
        self._library.board_hang(self._handle)

    @property
    def cycle(self) -> int:
        """Cycles since power-on, at the end of the last period."""
        return int(self._library.board_cycle(self._handle))

    @property
    def next_overflow(self) -> int:
        """Cycle at which Timer4 next overflows."""
        return int(self._library.board_next_overflow(self._handle))

    @property
    def duty_register(self) -> int:
        """OCR1A as last written, 0..255."""
        return int(self._library.board_duty_register(self._handle))

    @property
    def load(self) -> Load:
        """Load by the interrupts so far, and size of the stack."""
        load = Load()
        self._library.board_load(self._handle, ctypes.byref(load))
        return load


@dataclass(frozen=True)
class Truth:
    """State of the plant at a sampling instant, SI units."""

    theta: float
    theta_dot: float
    i_a: float
    omega: float
    v_a: float


class Plant(Rig):
    """The rig, simulated in halves of the PWM period. Its readings are voltages, bits and pulses."""

    def __init__(self, model: Model, seed: int = 0, angle_zero: int = ANGLE_ZERO) -> None:
        """At rest, hanging.

        Args:
            model: parameters and effects; the board replaces the resolutions.
            seed: of all random numbers.
            angle_zero: [counts] reading of the encoder when the arm hangs.
        """
        bare = {"angle_lsb": 0.0, "current_lsb": 0.0, "voltage_lsb": 0.0, "speed_tick": 0.0, "speed_noise": 0.0,
                "speed_pulses_per_rev": 1.0}
        self._zero = angle_zero
        self.pins = Pins(status=GOOD_STATUS)
        self.stuck = False
        """Whether the encoder keeps its value."""
        self.dropout = False
        """Whether the IR sensor gives no pulses."""
        super().__init__(Model(model.name, model.model, {**model.sensing, **bare}, model.effects), seed,
                         SAMPLE_PERIOD / 2)

    def reset(self) -> None:
        """As `Rig.reset`."""
        super().reset()
        self._pulse = self._turn = math.nan
        self._false_pulses: list[float] = []

    def step(self, duty: float) -> tuple[Pins, list[int], Truth]:
        """Advance by one period of the PWM.

        Args:
            duty: 0..1.

        Returns:
            State of the pins, rising edges of the IR sensor (cycles from the start), state in the middle.
        """
        reading, state = self.run(np.array([duty, duty]))
        memory, chain = self._memory, self._chain
        start = memory.time - self.period
        self._note_false(reading[1, 0])
        times = self._new_pulse(memory.last_pulse)
        self._note_false(reading[1, 1])
        # pulses between the last reading and the end of the period
        last, _, _ = sensing.time_pulses(memory, self._state.omega, self._state.rotor_angle, _NO_SPIKES, 0.0, chain)
        times += self._new_pulse(last)
        times += [at for at in self._false_pulses if at < start + 2.0 * self.period]
        self._false_pulses = [at for at in self._false_pulses if at >= start + 2.0 * self.period]

        theta, _, i_a, v_a = reading[:, 1].tolist()
        pins = self.pins
        if not self.stuck:
            # the PWM output is high for p + 1 of 1025 us; divider and filter scale 5 V to 2.56 V
            pins.angle = REFERENCE_V * (self._counts(theta) + 1.0) / 1025.0
            unfiltered = sensing.encoder_angle(state[0, 1], chain) + theta - memory.stage2
            pins.position = round(self._counts(unfiltered)) % ANGLE_COUNTS
        pins.current = CURRENT_V_PER_A * i_a
        pins.negative = LOW_SIDE_V + LOW_SIDE_OHM * abs(i_a) if duty > 0.0 else 0.0
        pins.positive = pins.negative + v_a
        edges = [] if self.dropout else sorted(max(0, round((at - start) * CLOCK_HZ)) for at in times)
        return pins, edges, Truth(*state[:5, 1].tolist())

    def _counts(self, angle: float) -> float:
        return (angle / (2.0 * math.pi) * ANGLE_COUNTS + self._zero) % ANGLE_COUNTS

    def _new_pulse(self, at: float) -> list[float]:
        if math.isnan(at) or at <= self._pulse + 1e-9:
            return []
        self._turn = at - self._pulse
        self._pulse = at
        return [at]

    def _note_false(self, speed: float) -> None:
        """Turn a false speed (`speed_spikes`) into a false pulse: 2π / speed after the last true one."""
        if not math.isnan(self._turn) and speed * self._turn > 2.0 * math.pi * 1.2:
            self._false_pulses.append(self._pulse + 2.0 * math.pi / speed)
        self._turn = math.nan


_NO_SPIKES = np.ones(2)


class Board:
    """The board in its rig: chip and plant, for tests in simulated time."""

    def __init__(self, model: Model | None = None, seed: int = 0, program: Path = PROGRAM,
                 angle_zero: int = ANGLE_ZERO) -> None:
        """Turn the power on, the arm hanging at rest.

        Args:
            model: of the plant; `bench` by default.
            seed: of all random numbers.
            program: ELF file.
            angle_zero: [counts] reading of the encoder when the arm hangs.

        Raises:
            BoardError: the program or the emulator is missing.
        """
        self.chip = Chip(program)
        self.plant = Plant(model or load("bench"), seed, angle_zero)
        self.powered = True
        """Whether the board has power; without it the PWM pin is low."""
        self.truth = Truth(0.0, 0.0, 0.0, 0.0, 0.0)
        """State of the plant at the last sampling instant."""

    def step(self) -> Outcome:
        """Run one period of the PWM."""
        outcome = self.chip.outcome
        pins, edges, self.truth = self.plant.step(outcome.duty / 255.0 if self.powered else 0.0)
        if not self.powered:
            return outcome
        return self.chip.run(pins, edges)

    def send(self, data: bytes) -> int:
        """Send bytes to the board; return the number for which there was room."""
        return self.chip.send(data)

    def receive(self) -> bytes:
        """The bytes that the board has sent since the last call."""
        return self.chip.receive()
