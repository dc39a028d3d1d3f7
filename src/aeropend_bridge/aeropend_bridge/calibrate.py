# SPDX-License-Identifier: Apache-2.0
"""Measures the readings of a rig at rest, and writes a calibration file for the bridge.

The duty is 0, the arm hangs still and the propeller stands. Then angle, current and voltage are 0, and the readings of
the board are their zeros. Scales are not measured; they come from the file of --base, or from the nominal parts.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path

from aeropend_bridge import calibration, protocol
from aeropend_bridge.calibration import Calibration, CalibrationError
from aeropend_bridge.link import Link
from aeropend_bridge.protocol import Flag, Hello, Message, Mode, Sample, Scheme
from aeropend_sim.cli.command import EXIT_CODES, Parser, entry_point
from aeropend_sim.cli.progress import Show, nothing, progress

PATIENCE_S = 5.0
"""[s] Time in which the board must answer. A choice: the boot loader of a Mega takes 1 s."""
SETTLE_S = 0.2
"""[s] Pause after a change of the scheme, in which both stages of the angle filter settle. A choice."""
STILL = 2.0
"""[counts] Standard deviation of the angle above which the arm moves. A choice."""
SPREAD = 20.0
"""[counts] Standard deviation of current and voltage above which the wiring has a fault. A choice."""
BAD_ANGLES = 0.01
"""Share of angles with errors above which the encoder counts as not wired for this scheme. A choice."""
COUNTS = 1024

EXAMPLES = f"""examples, with the arm hanging still and no bridge running:
  calibrate my_calibration.yaml
  calibrate my_calibration.yaml --port /dev/ttyACM1 --seconds 10
  bridge --ros-args --params-file my_calibration.yaml      use the calibration

{EXIT_CODES}"""


def middle(counts: Sequence[int]) -> float:
    """Return the median of integers, interpolated within its count.

    A converter that ends at 0 cuts the noise there. The mean is then too high, the median is not.
    """
    ordered = sorted(counts)
    median = ordered[len(ordered) // 2]
    if median == ordered[0] and ordered.count(median) * 2 > len(ordered):
        return float(median)
    below = sum(value < median for value in ordered)
    return median - 0.5 + (len(ordered) / 2 - below) / ordered.count(median)


def mean_on_circle(counts: Sequence[int], turn: int = COUNTS) -> tuple[float, float]:
    """Return mean and standard deviation of positions on a circle.

    Args:
        counts: the positions.
        turn: counts of one turn; the mean is in 0..turn.
    """
    first = counts[0]
    offsets = [(value - first + turn // 2) % turn - turn // 2 for value in counts]
    mean = sum(offsets) / len(offsets)
    return (first + mean) % turn, math.sqrt(sum((value - mean) ** 2 for value in offsets) / len(offsets))


def _spread(counts: Sequence[int]) -> float:
    mean = sum(counts) / len(counts)
    return math.sqrt(sum((value - mean) ** 2 for value in counts) / len(counts))


def zeros(base: Calibration, pwm: Sequence[Sample], ssi: Sequence[Sample]) -> tuple[Calibration, list[str]]:
    """Find the zeros of a rig at rest.

    Args:
        base: supplies all other values.
        pwm: samples with the encoder read by its PWM output.
        ssi: samples with the encoder read by SSI.

    Returns:
        The calibration, and one line for each value that could not be measured.

    Raises:
        CalibrationError: the rig is not at rest, or the angle cannot be read.
    """
    everything = [*pwm, *ssi]
    if not everything:
        raise CalibrationError("the board sends no samples: reset it and try again")
    if any(sample.duty for sample in everything):
        raise CalibrationError("the motor is driven: end the program that commands it")
    if any(sample.period for sample in everything):
        raise CalibrationError("the propeller turns: wait until it stands")
    found, notes = {}, []
    for name, values in (
        ("current", [sample.current for sample in everything]),
        ("voltage", [sample.voltage for sample in everything]),
    ):
        if (spread := _spread(values)) > SPREAD:
            raise CalibrationError(f"the {name} reads {spread:.0f} counts of noise: look at its wiring")
        found[f"{name}_zero"] = middle(values)
    for name, samples in (("pwm", pwm), ("ssi", ssi)):
        bad = sum(bool(sample.flags & (Flag.SSI_PARITY | Flag.SSI_STATUS)) for sample in samples)
        good = [sample.angle for sample in samples if not sample.flags & (Flag.SSI_PARITY | Flag.SSI_STATUS)]
        if bad > BAD_ANGLES * len(samples) or not good:
            why = f"{bad} of {len(samples)} angles came with errors" if samples else f"scheme {name} gave no sample"
            notes.append(f"{name}_zero is not measured: {why}")
            continue
        found[f"{name}_zero"], spread = mean_on_circle(good)
        if spread > STILL:
            raise CalibrationError(f"the arm moves ({spread:.1f} counts, scheme {name}): let it hang still")
    if len(notes) == 2:
        raise CalibrationError("no angle comes without errors: look at the encoder's magnet and wiring")
    return replace(base, **{name: round(value, 3) for name, value in found.items()}), notes


class _Board:
    """The board at a serial port, without a node."""

    def __init__(self, port: str) -> None:
        self._link = Link(port, protocol.BAUD)
        self._link.open()
        self._receiver = protocol.Receiver()

    def close(self) -> None:
        self._link.close()

    def _messages(self) -> list[Message]:
        return self._receiver.feed(self._link.read(0.1)[0])

    def greet(self) -> Hello:
        """Request and return its HELLO."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            self._link.write(protocol.hello_request())
            for message in self._messages():
                if isinstance(message, Hello):
                    if message.version != protocol.VERSION:
                        raise CalibrationError(
                            f"the board speaks protocol version {message.version}, this program {protocol.VERSION}:"
                            " flash the firmware that came with it"
                        )
                    return message
        raise CalibrationError(f"the board at {self._link.port} does not answer: is the firmware flashed?")

    def samples(self, scheme: Scheme, seconds: float, show: Show, done: float) -> list[Sample]:
        """Collect samples of a scheme, with duty 0.

        Args:
            scheme: how the board reads the encoder.
            seconds: [s] length.
            show: shows the progress in s.
            done: [s] progress at the start.
        """
        for command in (
            protocol.duty_command(0, 0.0), protocol.enable(False), protocol.set_mode(Mode.DIRECT),
            protocol.set_scheme(scheme),
        ):  # fmt: skip
            self._link.write(command)
        settled = time.monotonic() + SETTLE_S
        while time.monotonic() < settled:
            self._messages()
        samples: list[Sample] = []
        while (now := time.monotonic()) < settled + seconds:
            show(done + now - settled)
            samples += [
                message
                for message in self._messages()
                if isinstance(message, Sample) and bool(message.flags & Flag.SSI) == (scheme == Scheme.SSI)
            ]
        return samples


def calibrate(port: str, seconds: float, base: Calibration, show: Show = nothing) -> tuple[Calibration, list[str]]:
    """Measure the zeros of the rig at a port.

    Args:
        port: serial port of the board; no other program may use it.
        seconds: [s] time for each way of reading the encoder.
        base: supplies all other values.
        show: shows the progress in s, up to twice `seconds`.

    Returns:
        As `zeros`.

    Raises:
        CalibrationError: the rig is not at rest or does not answer.
        LinkError: the port cannot be opened, or is gone.
    """
    board = _Board(port)
    try:
        board.greet()
        pwm = board.samples(Scheme.PWM, seconds, show, 0.0)
        return zeros(base, pwm, board.samples(Scheme.SSI, seconds, show, seconds))
    finally:
        board.close()


@entry_point("calibrate")
def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `calibrate`."""
    parser = Parser(
        prog="calibrate",
        description="Measures zero angle, current and voltage of a rig at rest and writes a calibration file.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="calibration file to write")
    parser.add_argument("--port", type=Path, default=Path("/dev/ttyACM0"),
                        help="serial port of the board (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0,
                        help="time for each way of reading the encoder (default: 3)")
    parser.add_argument("--base", type=Path, metavar="FILE", help="calibration file that supplies the scales")
    parser.add_argument("--force", action="store_true", help="replace FILE if there is one")
    options = parser.parse_args(args)
    if not 0.1 <= options.seconds <= 600.0:
        raise CalibrationError(f"--seconds is {options.seconds:g}: give 0.1 to 600")
    if options.file.exists() and not options.force:
        raise CalibrationError(f"there is a {options.file} already: give --force to replace it")
    if not options.file.absolute().parent.is_dir():
        raise CalibrationError(f"there is no folder {options.file.absolute().parent}: make it first")
    base = calibration.load(options.base) if options.base else calibration.default()
    with progress("reading the board at rest", 2.0 * options.seconds) as show:
        found, notes = calibrate(str(options.port), options.seconds, base, show)
    calibration.save(
        found, options.file, f"Calibration measured at rest on {date.today().isoformat()}.\n" + "\n".join(notes)
    )
    for note in notes:
        print(f"note: {note}")
    for name in calibration.NAMES:
        if name.endswith("_zero"):
            print(f"{name:<13} {getattr(found, name):8.2f} counts")
    print(f"written to {options.file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
