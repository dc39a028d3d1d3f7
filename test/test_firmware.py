# SPDX-License-Identifier: Apache-2.0
"""The parts of the board's program that know nothing of the chip, compiled for this machine."""

import binascii
import ctypes
import math
import re
import subprocess
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from boot_loader import BootLoader
from evaluation.support.boards import FIRMWARE, altered, build, frame
from hypothesis import given
from hypothesis import strategies as st

FRAME_MAX = 36
TICKS_PER_S = 2_000_000
FIRST, PERIOD, REJECTED = range(3)


class Decoder(ctypes.Structure):
    """`struct decoder`."""

    _fields_ = [("bytes", ctypes.c_uint8 * FRAME_MAX), ("length", ctypes.c_uint8), ("bad", ctypes.c_bool)]


class Speed(ctypes.Structure):
    """`struct speed`."""

    _fields_ = [("period", ctypes.c_uint32), ("last", ctypes.c_uint32), ("started", ctypes.c_bool),
                ("refused", ctypes.c_uint8), ("expected", ctypes.c_uint32)]


class Gains(ctypes.Structure):
    """`struct gains`."""

    _fields_ = [(name, ctypes.c_float) for name in ("kp", "ki", "kd", "filter", "low", "high")]


class Pid(ctypes.Structure):
    """`struct pid`."""

    _fields_ = [("gains", Gains), ("reference", ctypes.c_float), ("integral", ctypes.c_float),
                ("derivative", ctypes.c_float), ("before", ctypes.c_float), ("started", ctypes.c_bool)]


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The program's sources as a library of this machine, out-of-bounds accesses and overflows trapped."""
    path = tmp_path_factory.mktemp("firmware") / "firmware.so"
    sources = [str(FIRMWARE / name) for name in ("protocol.c", "speed.c", "pid.c")]
    subprocess.run(["gcc", "-std=gnu11", "-O1", "-Wall", "-Wextra", "-Werror", "-fsanitize=undefined,bounds-strict",
                    "-fsanitize-undefined-trap-on-error", "-fPIC", "-shared", "-o", str(path), *sources, "-lm"],
                   check=True)
    library = ctypes.CDLL(str(path))
    library.frame_encode.restype = library.frame_decode.restype = ctypes.c_uint8
    library.pid_step.restype = ctypes.c_float
    library.gains_valid.restype = ctypes.c_bool
    return library


def encode(firmware: ctypes.CDLL, payload: bytes) -> bytes:
    out = (ctypes.c_uint8 * FRAME_MAX)()
    return bytes(out[: firmware.frame_encode(payload, len(payload), out)])


def decode(firmware: ctypes.CDLL, data: bytes, decoder: Decoder | None = None) -> list[bytes]:
    decoder = decoder or Decoder()
    payloads = []
    for byte in data:
        length = firmware.frame_decode(ctypes.byref(decoder), byte)
        if length:
            payloads.append(bytes(decoder.bytes[:length]))
    return payloads


class TestFrames:
    @given(payload=st.binary(min_size=1, max_size=32))
    def test_are_cobs_and_the_crc_of_the_host(self, firmware: ctypes.CDLL, payload: bytes) -> None:
        assert encode(firmware, payload) == frame(payload)
        assert decode(firmware, frame(payload)) == [payload]

    @given(noise=st.lists(st.integers(0, 255), max_size=400), payload=st.binary(min_size=1, max_size=32))
    def test_are_found_again_after_anything(self, firmware: ctypes.CDLL, noise: list[int], payload: bytes) -> None:
        decoder = Decoder()
        decode(firmware, bytes(noise), decoder)
        assert decode(firmware, b"\0" + frame(payload) + frame(payload), decoder)[-2:] == [payload, payload]

    def test_with_wrong_bits_are_refused_and_noted(self, firmware: ctypes.CDLL) -> None:
        random = np.random.default_rng(3)
        accepted = 0
        for _ in range(4000):
            payload = random.bytes(19)
            good = frame(payload)
            bad = bytearray(good)
            for bit in random.choice(8 * (len(good) - 1), int(random.integers(1, 4)), replace=False):
                bad[bit // 8] ^= 1 << bit % 8
            decoder = Decoder()
            accepted += any(len(got) == len(payload) for got in decode(firmware, bytes(bad), decoder))
            assert decoder.bad
        assert accepted == 0

    def test_that_are_too_long_are_refused(self, firmware: ctypes.CDLL) -> None:
        decoder = Decoder()
        assert decode(firmware, b"\1" * 300 + b"\0", decoder) == []
        assert decoder.bad
        assert decode(firmware, frame(b"next"), decoder) == [b"next"]

    def test_of_nothing_but_a_checksum_are_refused(self, firmware: ctypes.CDLL) -> None:
        assert binascii.crc_hqx(b"", 0xFFFF) == 0xFFFF
        assert decode(firmware, b"\x03\xff\xff\0") == []


class Rotor:
    """Pulses at given times, s, as the program sees them."""

    def __init__(self, firmware: ctypes.CDLL) -> None:
        self._firmware = firmware
        self.speed = Speed()

    def pulse(self, at: float) -> int:
        return int(self._firmware.speed_pulse(ctypes.byref(self.speed), round(at * TICKS_PER_S) % 2**32))

    def pulses(self, times: "np.ndarray | list[float]") -> list[int]:
        return [self.pulse(at) for at in times]

    @property
    def period(self) -> float:
        return self.speed.period / TICKS_PER_S


class TestSpeed:
    def test_the_first_pulse_gives_none(self, firmware: ctypes.CDLL) -> None:
        rotor = Rotor(firmware)
        assert rotor.pulse(1.0) == FIRST
        assert rotor.period == 0.0
        assert rotor.pulse(1.03) == PERIOD
        assert rotor.period == pytest.approx(0.03)

    @pytest.mark.parametrize("acceleration", [30.0, 120.0])
    def test_a_start_from_rest_is_followed(self, firmware: ctypes.CDLL, acceleration: float) -> None:
        rotor = Rotor(firmware)
        times = np.sqrt(2.0 * (np.arange(60) + 0.3) / acceleration)  # of an even acceleration, rev/s^2
        answers = rotor.pulses(times)
        assert REJECTED not in answers
        assert rotor.period == pytest.approx(times[-1] - times[-2], abs=1e-6)

    @pytest.mark.parametrize("rate", [15.0, 30.0, 100.0, 200.0])
    @pytest.mark.parametrize("share", [0.1, 0.3])
    def test_a_false_pulse_is_left_out(self, firmware: ctypes.CDLL, rate: float, share: float) -> None:
        rotor = Rotor(firmware)
        rotor.pulses(np.arange(10) / rate)
        assert rotor.pulse((9 + share) / rate) == REJECTED
        assert rotor.pulse(10 / rate) == PERIOD
        assert rotor.period == pytest.approx(1 / rate, abs=1e-6)

    def test_a_missed_pulse_is_no_slow_revolution(self, firmware: ctypes.CDLL) -> None:
        rotor = Rotor(firmware)
        rotor.pulses(np.arange(10) / 100.0)
        assert rotor.pulse(0.11) == REJECTED
        assert rotor.period == pytest.approx(0.01)
        assert rotor.pulse(0.12) == PERIOD

    def test_a_new_speed_is_believed_in_the_end(self, firmware: ctypes.CDLL) -> None:
        rotor = Rotor(firmware)
        rotor.pulses(np.arange(10) / 20.0)
        rotor.pulses(0.45 + np.arange(1, 8) / 120.0)
        assert rotor.period == pytest.approx(1 / 120.0, abs=1e-6)

    def test_a_pulse_too_soon_is_noise(self, firmware: ctypes.CDLL) -> None:
        rotor = Rotor(firmware)
        rotor.pulse(0.0)
        assert rotor.pulse(0.003) == REJECTED

    def test_half_a_second_without_a_pulse_is_rest(self, firmware: ctypes.CDLL) -> None:
        rotor = Rotor(firmware)
        rotor.pulses([0.0, 0.05, 0.1])
        firmware.speed_age(ctypes.byref(rotor.speed), round(0.55 * TICKS_PER_S))
        assert rotor.period == pytest.approx(0.05)
        firmware.speed_age(ctypes.byref(rotor.speed), round(0.61 * TICKS_PER_S))
        assert rotor.period == 0.0
        assert rotor.pulse(0.62) == FIRST

    def test_the_clock_may_wrap(self, firmware: ctypes.CDLL) -> None:
        rotor = Rotor(firmware)
        wrap = 2**32 / TICKS_PER_S
        assert rotor.pulses(wrap - 0.055 + np.arange(11) / 100.0) == [FIRST] + [PERIOD] * 10
        firmware.speed_age(ctypes.byref(rotor.speed), round(0.05 * TICKS_PER_S))
        assert rotor.period == pytest.approx(0.01)


class TestPid:
    def make(self, **gains: float) -> Pid:
        return Pid(Gains(**{"low": 0.0, "high": 1.0, **gains}))

    def step(self, firmware: ctypes.CDLL, pid: Pid, measurement: float, period: float = 0.002) -> float:
        return float(firmware.pid_step(ctypes.byref(pid), ctypes.c_float(measurement), ctypes.c_float(period)))

    def test_is_the_sum_of_its_parts(self, firmware: ctypes.CDLL) -> None:
        pid = self.make(kp=0.5, ki=2.0, kd=0.1, low=0.0, high=1.0)
        pid.reference = 1.0
        assert self.step(firmware, pid, 0.4) == pytest.approx(0.5 * 0.6, rel=1e-6)
        # the integral of the first step, and the measurement's derivative
        wanted = 0.5 * 0.59 + 2.0 * 0.6 * 0.002 - 0.1 * 0.01 / 0.002
        assert wanted < 0.0
        assert self.step(firmware, pid, 0.41) == 0.0
        integral = 2.0 * 0.002 * (0.6 + 0.59)  # it goes on below the limit, as that leads back
        assert self.step(firmware, pid, 0.41) == pytest.approx(0.5 * 0.59 + integral, rel=1e-5)

    def test_a_step_of_the_reference_does_not_kick(self, firmware: ctypes.CDLL) -> None:
        pid = self.make(kp=0.1, kd=1.0)
        pid.reference = 1.0
        self.step(firmware, pid, 0.0)
        pid.reference = 2.0
        assert self.step(firmware, pid, 0.0) == pytest.approx(0.2, rel=1e-6)

    def test_does_not_wind_up(self, firmware: ctypes.CDLL) -> None:
        pid = self.make(kp=0.5, ki=5.0, high=0.6)
        pid.reference = 2.0
        for _ in range(2000):
            assert self.step(firmware, pid, 0.0) == pytest.approx(0.6, rel=1e-6)
        pid.reference = -0.1
        assert self.step(firmware, pid, 0.0) < 0.6

    def test_filters_the_derivative(self, firmware: ctypes.CDLL) -> None:
        pid = self.make(kd=0.01, filter=0.02)
        self.step(firmware, pid, 1.0)
        outputs = [self.step(firmware, pid, 1.0 - 0.5 * 0.002 * k) for k in range(1, 60)]
        assert outputs[0] == pytest.approx(0.1 * 0.005, rel=1e-3)
        assert outputs[-1] == pytest.approx(0.005, rel=1e-2)

    def test_a_reset_forgets(self, firmware: ctypes.CDLL) -> None:
        pid = self.make(ki=5.0)
        pid.reference = 1.0
        for _ in range(50):
            self.step(firmware, pid, 0.0)
        firmware.pid_reset(ctypes.byref(pid))
        assert self.step(firmware, pid, 0.3) == 0.0

    @pytest.mark.parametrize(
        "wrong", [{"kp": math.nan}, {"ki": math.inf}, {"filter": -1.0}, {"low": 0.5, "high": 0.4}, {"high": 1.1},
                  {"low": -0.1}, {"low": math.nan}])
    def test_refuses_gains_it_cannot_run_with(self, firmware: ctypes.CDLL, wrong: dict[str, float]) -> None:
        assert firmware.gains_valid(ctypes.byref(self.make(kp=1.0).gains))
        assert not firmware.gains_valid(ctypes.byref(self.make(**{"kp": 1.0, **wrong}).gains))


class TestWiring:
    """What a person wires by README.md is what the program uses."""

    MEGA: ClassVar = {
        "D9": "PH6", "D11": "PB5", "D12": "PB6", "D22": "PA0", "D23": "PA1", "D24": "PA2", "D49": "PL0",
        "A0": "ADC0", "A1": "ADC1", "A2": "ADC2", "A3": "ADC3"}
    """Pins of an Arduino Mega 2560 and of its chip, as Arduino's pinout of the board (A000067) has them."""

    def wired(self) -> dict[str, str]:
        """Return the chip's pin by the board's, of README.md."""
        rows = re.findall(r"^\| ([DA]\d+) \| (P[A-L]\d|ADC\d+)\b", (FIRMWARE / "README.md").read_text(), re.MULTILINE)
        return dict(rows)

    @pytest.mark.promise("Hardware", "The wiring diagram shows the pins that the program uses")
    def test_the_board_s_pins_are_the_chip_s_pins_beside_them(self) -> None:
        assert self.wired() == self.MEGA

    @pytest.mark.promise("Hardware", "The wiring diagram shows the pins that the program uses")
    def test_the_program_uses_the_pins_that_are_wired(self) -> None:
        pins = (FIRMWARE / "pins.h").read_text()
        digital = {board: chip for chip, board in re.findall(r"^#define \w+ (P\w\d)\s+// (D\d+)", pins, re.MULTILINE)}
        analog = {pin: f"ADC{pin[1:]}" for line in re.findall(r"^#define ADC_.*// (.*)", pins, re.MULTILINE)
                  for pin in re.findall(r"\bA\d\b", line)}
        assert {"D49": "PL0", **digital, **analog} == self.wired()  # Timer4 has its capture pin, PL0, from the chip


class TestBuild:
    def test_prints_what_the_program_takes(self) -> None:
        build()
        done = subprocess.run(["make", "-C", str(FIRMWARE)], check=True, capture_output=True, text=True)
        for word in ("Program: ", "Data: ", "Stack: ", "Interrupts: ", "Receiver: "):
            assert word in done.stdout

    def test_flash_asks_for_the_port(self) -> None:
        build()
        done = subprocess.run(["make", "-C", str(FIRMWARE), "flash"], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert "flash: name the board's port" in done.stderr

    def flash(self, loader: BootLoader) -> subprocess.CompletedProcess[str]:
        """Flash the program through a boot loader, which ends."""
        build()
        try:
            return subprocess.run(["make", "-C", str(FIRMWARE), "flash", f"PORT={loader.port}"], capture_output=True,
                                  text=True, check=False)
        finally:
            loader.stop()

    @pytest.mark.promise("Hardware", "Flashing verifies the program on the board")
    def test_flash_writes_the_program_and_reads_it_back(self, tmp_path: Path) -> None:
        loader = BootLoader()
        done = self.flash(loader)
        assert done.returncode == 0, done.stderr
        image = tmp_path / "program.bin"
        sections = ["-j", ".text", "-j", ".data"]
        subprocess.run(["avr-objcopy", *sections, "-O", "binary", FIRMWARE / "build/aeropend.elf", image], check=True)
        program = image.read_bytes()
        assert loader.flash == program.ljust(len(loader.flash), b"\xff")
        assert loader.left

    @pytest.mark.promise("Hardware", "Flashing verifies the program on the board")
    def test_a_flash_that_does_not_hold_the_program_is_told(self) -> None:
        done = self.flash(BootLoader(worn=0x123))
        assert done.returncode == 2
        assert "verification" in done.stderr

    def test_the_same_sources_make_the_same_program(self, tmp_path: Path) -> None:
        programs = []
        for name in ("a", "b"):
            (tmp_path / name).mkdir()
            elf = altered(tmp_path / name, "protocol.h", "#define FIRMWARE_PATCH 0", "#define FIRMWARE_PATCH 7")
            subprocess.run(["avr-objcopy", "-O", "binary", str(elf), str(elf.with_suffix(".bin"))], check=True)
            programs.append(elf.with_suffix(".bin").read_bytes())
        assert programs[0] == programs[1]
