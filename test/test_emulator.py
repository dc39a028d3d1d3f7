# SPDX-License-Identifier: Apache-2.0
"""The unmodified program in the emulated board, in simulated time; and that altered programs do not pass."""

import math
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import serial
from board import ANGLE_ZERO, BROWN_OUT, EXTERNAL, PROGRAM, REFERENCE_V, Board, BoardError, Chip, Pins
from emulated_board import Fault, main
from emulated_board import _model as read_model
from evaluation.support import boards
from evaluation.support.boards import (
    ACK,
    BROWN_OUT_RESET,
    CHECKS,
    COMMAND_TIMEOUT,
    DUTY,
    ENABLE,
    ENABLED,
    FIRMWARE,
    HELLO,
    HELLO_REQUEST,
    MODE,
    NEW_PERIOD,
    PERIOD_TICKS,
    PID,
    PID_GAINS,
    PID_REFERENCE,
    PULSE_REJECTED,
    SCHEME,
    SSI,
    SSI_PARITY,
    SSI_STATUS,
    VOLTAGE_LSB,
    WRITE_CALIBRATION,
    Bench,
    Host,
    altered,
    quiet,
)

from aeropend_sim.model.parameters import load

OK, BAD_VALUE, UNKNOWN_TYPE, DISABLED = range(4)
CURRENT_LSB = 2.56 / 1024 / 1.65
LONGEST_COMMAND = 25


@pytest.fixture(scope="module", autouse=True)
def built() -> None:
    """The program and the emulator are built and new."""
    boards.build()


@pytest.fixture
def bench() -> Bench:
    """A board with voltages on its pins."""
    return Bench(PROGRAM)


@pytest.mark.promise("Hardware", "The board's program runs in an emulated ATmega2560 behind a serial port")
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__.removeprefix("check_"))
def test_the_program_passes(check: Callable[[Path], object]) -> None:
    check(PROGRAM)


SETTLE = "        ADMUX = ADC_VOLTAGE;\n        conversion = "
"""Where the angle's conversion leads to the first discarded one."""

ALTERED = {
    "fast PWM": ("main.c", "_BV(CS11) | _BV(CS10);", "_BV(WGM12) | 3;", boards.check_sampling),
    "10-bit PWM": ("main.c", "_BV(COM1A1) | _BV(WGM10)", "_BV(COM1A1) | 3", boards.check_sampling),
    "no discarded conversion": ("main.c", f"{SETTLE}SETTLE_FIRST;", f"{SETTLE}VOLTAGE;", boards.check_voltage),
    "one discarded conversion": ("main.c", "conversion = SETTLE_SECOND;", "conversion = VOLTAGE;",
                                 boards.check_voltage),
    "reference of 5 V": ("pins.h", "(_BV(REFS1) | _BV(REFS0))", "_BV(REFS0)", boards.check_voltage),
    "unsigned voltage": ("main.c", "(int16_t)(ADC << 6) >> 6", "ADC", boards.check_voltage),
    "no overflow check": ("main.c", "if ((TIFR4 & _BV(TOV4)) && count < 0x8000)", "if (0)", boards.check_speed),
    "duty changed at any time": ("main.c", "while (TCNT1 >= TOP - 1 &&", "while (0 &&", boards.check_duty_told),
    "overflow before any count": ("main.c", "(TIFR4 & _BV(TOV4)) && count < 0x8000", "TIFR4 & 1",
                                  boards.check_speed),
    "watchdog off": ("main.c", "wdt_enable(WDTO_60MS)", "wdt_disable()", boards.check_watchdog),
    "watchdog fed by an interrupt": ("main.c", "    conversion = CURRENT;", "wdt_reset(); conversion = CURRENT;",
                                     boards.check_watchdog),
    "CRC not checked": ("protocol.c", "length > 2 && crc16(d->bytes, length - 2) ==", "length > 2 || length ==",
                        boards.check_bad_frames),
    "duty while disabled": ("main.c", "if (enabled && mode == MODE_DIRECT)", "if (mode == MODE_DIRECT)",
                            boards.check_disabled),
    "disabled with the duty it had": ("main.c", "if (!payload[1] || !enabled)", "if (payload[1] && !enabled)",
                                      boards.check_disabled),
    "no timeout": ("main.c", "++command_age == COMMAND_TIMEOUT", "++command_age == 0", boards.check_timeout),
    "a long interrupt": ("main.c", "sei(); // the receiver", "__builtin_avr_delay_cycles(200); // the",
                         boards.check_receiver),
}


@pytest.mark.parametrize("name", ALTERED)
def test_an_altered_program_does_not(name: str, tmp_path: Path) -> None:
    file, old, new, check = ALTERED[name]
    program = altered(tmp_path, file, old, new)
    with pytest.raises(AssertionError):
        check(program)


class TestCommands:
    def test_hello_tells_what_the_board_is(self, bench: Bench) -> None:
        hello = bench.answer(HELLO_REQUEST)
        assert len(hello) == 27
        assert hello[:5] == bytes([HELLO, 1, 1, 0, 0])
        assert hello[5] == 1  # power-on

    def test_hello_comes_by_itself_at_the_start(self) -> None:
        chip = Chip()
        host = Host(chip)
        chip.run(Pins(), (), 5)
        assert [answer[0] for answer in host.read().answers] == [HELLO]
        assert host.samples[0].time == PERIOD_TICKS

    @pytest.mark.parametrize(
        ("kind", "fields", "values", "status"),
        [
            (ENABLE, "B", (1,), OK), (ENABLE, "B", (2,), BAD_VALUE), (ENABLE, "", (), BAD_VALUE),
            (SCHEME, "B", (1,), OK), (SCHEME, "B", (2,), BAD_VALUE), (SCHEME, "BB", (1, 1), BAD_VALUE),
            (MODE, "B", (1,), OK), (MODE, "B", (2,), BAD_VALUE),
            (PID_GAINS, "6f", (1, 1, 1, 0.01, 0, 1), OK), (PID_GAINS, "6f", (1, 1, 1, 0.01, 1, 0), BAD_VALUE),
            (PID_GAINS, "6f", (math.nan, 1, 1, 0.01, 0, 1), BAD_VALUE), (PID_GAINS, "5f", (1, 1, 1, 0, 0), BAD_VALUE),
            (PID_REFERENCE, "f", (1,), DISABLED), (PID_REFERENCE, "f", (math.inf,), BAD_VALUE),
            (WRITE_CALIBRATION, "15B", range(15), BAD_VALUE), (HELLO_REQUEST, "B", (1,), BAD_VALUE),
            (0x18, "", (), UNKNOWN_TYPE), (0x00, "", (), UNKNOWN_TYPE), (0xFF, "4B", range(4), UNKNOWN_TYPE),
        ],
    )
    def test_are_acknowledged(self, bench: Bench, kind: int, fields: str, values: tuple, status: int) -> None:
        assert bench.answer(kind, fields, *values) == bytes([ACK, kind, status])

    def test_duty_is_rounded_and_not_acknowledged(self, bench: Bench) -> None:
        bench.enable()
        for duty in [0.0, 1.0, 0.5, *np.linspace(0.0, 1.0, 40).tolist()]:
            bench.host.duty(duty)
            bench.run(2)
            assert bench.chip.duty_register == math.floor(round(duty * 65535) * 255 / 65535 + 0.5)
        assert bench.host.read().answers[1:] == []

    def test_a_short_duty_does_nothing(self, bench: Bench) -> None:
        bench.enable()
        bench.host.send(DUTY, "BB", 0, 200)
        bench.run(3)
        assert bench.chip.duty_register == 0

    def test_calibration_is_kept(self, bench: Bench) -> None:
        block = bytes(range(200, 216))
        bench.host.forget()
        bench.host.send(WRITE_CALIBRATION, "16s", block)
        bench.run(40)
        assert bench.host.read().answers == [bytes([ACK, WRITE_CALIBRATION, OK])]
        bench.chip.reset(EXTERNAL)
        bench.run(5)
        assert bench.host.read().answers[-1][7:23] == block
        assert bench.answer(HELLO_REQUEST)[7:23] == block


class TestSamples:
    def test_take_the_current_while_the_pulse_is_high(self, bench: Bench) -> None:
        bench.pins.current = 1.0
        bench.enable()
        for duty in (5, 20, 128, 255):
            bench.host.duty(duty / 255)
            assert bench.sample().current == 400
        bench.host.duty(0.0)
        assert bench.sample().current == 0

    def test_read_the_angle_of_each_position(self, bench: Bench) -> None:
        for position in range(0, 1024, 7):
            bench.pins.position = position
            bench.pins.angle = (position + 0.3) / 1024 * REFERENCE_V
            assert bench.sample().angle == position
        bench.answer(SCHEME, "B", 1)
        bench.pins.angle = 0.0
        for position in [0, 1, 2, 511, 512, 1023, *range(3, 1024, 5)]:
            bench.pins.position = position
            sample = bench.sample()
            assert sample.angle == position
            assert sample.flags & (SSI | SSI_PARITY | SSI_STATUS) == SSI
        assert bench.chip.outcome.ssi_faults == 0
        bench.answer(SCHEME, "B", 0)
        assert bench.sample().angle == 0

    @pytest.mark.parametrize("status", range(32))
    def test_check_what_the_encoder_says_of_itself(self, status: int) -> None:
        bench = Bench(PROGRAM, position=333)
        bench.answer(SCHEME, "B", 1)
        bench.pins.status = status
        good = status & 0b11100 == 0b10000
        assert bool(bench.sample().flags & SSI_STATUS) == (not good)
        assert not bench.sample().flags & SSI_PARITY
        bench.pins.parity_error = 1
        assert bench.sample().flags & SSI_PARITY
        bench.pins.parity_error = 0
        assert not bench.sample().flags & SSI_PARITY

    def test_tell_of_false_pulses_once(self, bench: Bench) -> None:
        for _ in range(20):
            bench.run(10, [5000])
        bench.host.forget()
        bench.run(10, [5000, 5000 + 8000 * 8])
        bench.run(10, [5000])
        flags = [sample.flags for sample in bench.host.read().samples]
        assert sum(bool(flag & PULSE_REJECTED) for flag in flags) == 1
        assert sum(bool(flag & NEW_PERIOD) for flag in flags) == 2
        assert {sample.period for sample in bench.host.samples} == {10 * PERIOD_TICKS}
        bench.run(250)
        assert bench.host.read().samples[-1].period == 0

    def test_tell_the_cause_of_a_reset(self, bench: Bench) -> None:
        bench.enable()
        bench.host.duty(0.5)
        bench.run(3)
        bench.chip.reset(BROWN_OUT)
        bench.run(1)
        assert bench.chip.outcome.duty == 0
        bench.run(4)
        sample = bench.host.read().samples[-1]
        assert sample.flags & BROWN_OUT_RESET
        assert not sample.flags & ENABLED
        assert sample.time < 10 * PERIOD_TICKS


class TestLoad:
    def test_interrupts_take_little(self) -> None:
        bench = Bench(PROGRAM)
        bench.answer(SCHEME, "B", 1)
        bench.enable()
        for k in range(500):
            bench.host.duty(0.5)
            bench.run(1, [163 * k % 32640] if k % 3 == 0 else [])
        load = bench.chip.load
        assert load.cycles / bench.chip.cycle <= 0.4
        assert load.receiver_waited <= 640
        assert load.stack < 1024


class TestWithThePlant:
    def start(self, board: Board) -> Host:
        for _ in range(5):
            board.step()
        return Host(board)

    def settle(self, board: Board, host: Host, duty: float, periods: int) -> None:
        host.send(ENABLE, "B", 1)
        for k in range(periods):
            if k % 20 == 0:
                host.duty(duty)
            board.step()
            if k % 1000 == 0:
                host.forget()

    @pytest.mark.promise("Hardware", "The board's program runs in an emulated ATmega2560 behind a serial port")
    @pytest.mark.parametrize("scheme", [0, 1])
    def test_samples_are_what_the_plant_does(self, scheme: int) -> None:
        board = Board(quiet())
        host = self.start(board)
        host.send(SCHEME, "B", scheme)
        self.settle(board, host, 0.5, 3000)
        host.forget()
        for k in range(40):
            if k % 20 == 0:
                host.duty(0.5)
            board.step()
        sample, truth = host.read().samples[-1], board.truth
        assert truth.theta > 0.5
        zero = ANGLE_ZERO + (0 if scheme else 1)
        assert sample.angle - zero == pytest.approx(truth.theta / (2.0 * math.pi) * 1024, abs=1.5)
        assert sample.current * CURRENT_LSB == pytest.approx(truth.i_a, abs=2 * CURRENT_LSB)
        assert sample.voltage * VOLTAGE_LSB == pytest.approx(truth.v_a, abs=VOLTAGE_LSB)
        assert 2.0 * math.pi / (sample.period * 0.5e-6) == pytest.approx(truth.omega, rel=1e-3)
        assert host.bad == 0

    def test_the_same_seed_gives_the_same_bytes(self) -> None:
        def run(seed: int) -> bytes:
            board = Board(load("bench"), seed)
            host = self.start(board)
            host.send(ENABLE, "B", 1)
            data = b""
            for k in range(300):
                if k % 20 == 0:
                    host.duty(0.6)
                board.step()
                data += board.receive()
            return data

        assert run(1) == run(1)
        assert run(1) != run(2)

    def test_the_board_can_hold_an_angle_by_itself(self) -> None:
        board = Board(load("bench"))
        host = self.start(board)
        host.send(SCHEME, "B", 1)
        host.send(MODE, "B", 1)
        host.send(PID_GAINS, "6f", 0.25, 0.35, 0.12, 0.05, 0.0, 0.8)
        host.send(ENABLE, "B", 1)
        angles = []
        for k in range(6000):
            if k % 20 == 0:
                host.send(PID_REFERENCE, "f", (ANGLE_ZERO + 80) * 2.0 * math.pi / 1024)
            board.step()
            if k % 500 == 0:
                host.read()
            angles.append(board.truth.theta)
        assert host.read().samples[-1].flags & (PID | ENABLED | COMMAND_TIMEOUT) == PID | ENABLED
        assert np.mean(angles[-1000:]) == pytest.approx(80 * 2.0 * math.pi / 1024, abs=0.01)
        assert np.std(angles[-1000:]) < 0.02

    def test_a_spike_of_the_speed_is_a_false_pulse(self) -> None:
        model = quiet().with_effects({"speed_spikes": {"rate": 3.0}})
        board = Board(model)
        host = self.start(board)
        self.settle(board, host, 0.8, 2500)
        host.forget()
        speeds = []
        for k in range(2000):
            if k % 20 == 0:
                host.duty(0.8)
            board.step()
            speeds.append(board.truth.omega)
        host.read()
        assert any(sample.flags & PULSE_REJECTED for sample in host.samples)

    def test_sensors_can_fail(self) -> None:
        board = Board(quiet())
        host = self.start(board)
        host.send(SCHEME, "B", 1)
        self.settle(board, host, 0.5, 2000)
        host.forget()
        board.plant.stuck = board.plant.dropout = True
        for _ in range(400):
            host.duty(0.2)
            board.step()
        samples = host.read().samples
        assert len({sample.angle for sample in samples[2:]}) == 1
        assert abs(board.truth.theta - (samples[-1].angle - ANGLE_ZERO) * 2.0 * math.pi / 1024) > 0.05
        assert samples[-1].period == 0
        board.plant.stuck = board.plant.dropout = False
        for _ in range(100):
            host.duty(0.5)
            board.step()
        sample = host.read().samples[-1]
        assert sample.angle - ANGLE_ZERO == pytest.approx(board.truth.theta / (2.0 * math.pi) * 1024, abs=2)
        assert sample.period > 0

    def test_without_power_nothing_moves(self) -> None:
        board = Board(quiet())
        host = self.start(board)
        self.settle(board, host, 0.6, 1500)
        assert board.truth.omega > 100.0
        host.forget()
        board.powered = False
        for _ in range(2000):
            board.step()
        assert board.truth.v_a == 0.0
        assert board.truth.omega < 20.0
        assert host.read().samples == []


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    with pytest.raises(BoardError, match="make -C firmware"):
        Chip(tmp_path / "none.elf")
    (tmp_path / "text.elf").write_text("not a program")
    with pytest.raises(BoardError, match="not a program"):
        Chip(tmp_path / "text.elf")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("reset@5", Fault("reset", 5.0, math.inf, 0.001)),
        ("unplug@2.5", Fault("unplug", 2.5, 1.0, 0.001)),
        ("flip@1+3:1e-2", Fault("flip", 1.0, 3.0, 0.01)),
        (" lose:0.5 ", Fault("lose", 9.0, math.inf, 0.5)),
    ],
)
def test_faults_are_read(text: str, fault: Fault) -> None:
    assert Fault.parse(text, now=9.0) == fault


@contextmanager
def emulated_board(*args: str) -> Iterator[subprocess.Popen]:
    """Run the program `emulated_board`; it is stopped in the end."""
    process = subprocess.Popen([sys.executable, str(FIRMWARE / "emulator/emulated_board.py"), *args], text=True,
                               stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=30)


class Line:
    """A serial port with the face of a chip, for `Host`."""

    def __init__(self, path: str) -> None:
        self._port = serial.Serial(path, 500_000, timeout=0.05)

    def send(self, data: bytes) -> None:
        """Send."""
        self._port.write(data)

    def receive(self) -> bytes:
        """Take what there is."""
        return self._port.read(4096)

    def close(self) -> None:
        """Let go of the port."""
        self._port.close()


def wait_for(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end, f"{what} never came"
        time.sleep(0.01)


@pytest.mark.live
class TestProgram:
    @pytest.mark.promise("Hardware", "The board's program runs in an emulated ATmega2560 behind a serial port")
    def test_is_a_serial_port_that_can_fail(self, tmp_path: Path) -> None:
        link, truth = tmp_path / "port", tmp_path / "truth"
        with emulated_board("--link", str(link), "--truth", str(truth), "--effect", "coulomb_friction") as process:
            assert process.stdout is not None
            assert process.stdin is not None
            told = process.stdout.readline()
            assert re.fullmatch(rf"emulated_board: /dev/pts/\d+ \({re.escape(str(link))}\)\n", told)
            host = Host(Line(str(link)))
            wait_for(lambda: host.read().samples, "a sample")
            host.bad = 0
            host.send(ENABLE, "B", 1)

            def duty_acts() -> bool:
                host.duty(0.4)
                return host.read().samples[-1].duty == 102

            wait_for(duty_acts, "the duty")
            first = len(host.samples)
            wait_for(lambda: len(host.read().samples) > first + 500, "samples")
            assert {(b.sequence - a.sequence) % 256 for a, b in pairwise(host.samples[first:])} == {1}
            assert host.bad == 0

            def type_in(line: str) -> None:
                process.stdin.write(line + "\n")
                process.stdin.flush()

            host.forget()
            type_in("reset")
            wait_for(lambda: any(answer[0] == HELLO for answer in host.read().answers), "HELLO")
            assert host.read().samples[-1].duty == 0

            type_in("unplug+0.3")
            wait_for(lambda: not link.is_symlink(), "the port's end")
            wait_for(link.exists, "the port")
            host = Host(Line(str(link)))
            wait_for(lambda: host.read().samples, "a sample after the cable came back")

            type_in("flip:0.02")
            host.bad = 0

            wait_for(lambda: host.read().bad > 3, "bad frames")
        assert process.returncode == 0
        assert not link.is_symlink()
        lines = [line.split() for line in truth.read_text().splitlines()]
        assert {len(line) for line in lines} == {9}
        steps = np.diff([int(line[0]) for line in lines])
        assert np.median(steps) == 2_040_000
        assert max(float(line[7]) for line in lines) > 1.0

    @pytest.mark.parametrize(
        ("args", "says"),
        [
            (["--model", "none.yaml"], "none.yaml: no such model file"),
            (["--effect", "coulomb_fiction"], "coulomb_fiction': give NAME=NUMBER"),
            (["--effect", "coulomb_friction.accl=1"], "unknown parameter of coulomb_friction 'accl'"),
            (["--set", "model.R_a=-1"], "out of range"),
            (["--fault", "reset"], "give its start, as in reset@5"),
            (["--fault", "explode@1"], "fault 'explode@1': give NAME"),
            (["--program", "none.elf"], "build it with 'make -C firmware'"),
            (["--link", "/nowhere/port"], "cannot make the link"),
            (["--truth", __file__], "exists: name another file"),
        ],
    )
    def test_says_in_one_line_what_is_wrong(
        self, args: list[str], says: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(args) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert len(err.splitlines()) == 1
        assert err.startswith("emulated_board: ")
        assert says in err

    def test_takes_the_files_that_the_plant_takes(self, tmp_path: Path) -> None:
        file = tmp_path / "effects.yaml"
        file.write_text("/**: {ros__parameters: {preset: thesis, effects: {gust: {sigma: 2.0}, thrust_lag: }}}")
        model = read_model(str(file), "thesis")
        assert model.effects["gust"]["sigma"] == 2.0
        assert model.effects["thrust_lag"]["tau"] > 0.0
        assert model.model == load("thesis").model

    def test_takes_no_name_that_is_in_use(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "file").write_text("mine")
        assert main(["--link", str(tmp_path / "file")]) == 2
        assert "is not a link" in capsys.readouterr().err
        assert (tmp_path / "file").read_text() == "mine"
        (tmp_path / "left").symlink_to("gone")
        with emulated_board("--link", str(tmp_path / "left")) as process:
            assert process.stdout is not None
            process.stdout.readline()
            assert (tmp_path / "left").exists()
            assert main(["--link", str(tmp_path / "left")]) == 2
            assert "is in use by another board" in capsys.readouterr().err
