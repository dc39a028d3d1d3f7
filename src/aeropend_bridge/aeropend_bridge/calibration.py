# SPDX-License-Identifier: Apache-2.0
"""Calibration of a rig: conversion of raw counts to SI units, and the parameter files that hold it."""

from __future__ import annotations

import math
import os
import tempfile
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import yaml

from aeropend_bridge.protocol import TICK_NS, Flag, Sample
from aeropend_sim.errors import UserError
from aeropend_sim.untrusted import load_yaml, printable

DEFAULT = "motor_shield.yaml"
SECTION = "calibration"
"""Section of the calibration in a parameter file."""
_TURN = 2.0 * math.pi


class Measured(NamedTuple):
    """A sample in SI units: rad, rad/s, V, A, and the duty 0..1. Values that were not measured are NaN."""

    theta: float
    omega: float
    v_a: float
    i_a: float
    duty: float


class CalibrationError(UserError):
    """A calibration cannot be measured, read or written."""


@dataclass(frozen=True)
class Calibration:
    """The calibration of a rig.

    Attributes:
        current_zero: [counts] reading without current.
        current_per_count: [A] scale of the current.
        voltage_zero: [counts] reading without voltage.
        voltage_per_count: [V] scale of the voltage.
        pwm_zero: [counts] reading of the hanging arm, encoder read by its PWM output.
        pwm_per_count: [rad] scale of the angle, encoder read by its PWM output.
        ssi_zero: [counts] reading of the hanging arm, encoder read by SSI.
        ssi_per_count: [rad] scale of the angle, encoder read by SSI.
        pulses_per_rev: IR pulses per turn of the rotor.
        latency: [s] smallest delay of a frame by the line (USB), beside its transmission.
    """

    current_zero: float
    current_per_count: float
    voltage_zero: float
    voltage_per_count: float
    pwm_zero: float
    pwm_per_count: float
    ssi_zero: float
    ssi_per_count: float
    pulses_per_rev: float
    latency: float

    def measured(self, raw: Sample) -> Measured:
        """Convert a sample to SI units; an angle with an error flag is NaN."""
        if raw.flags & Flag.SSI:
            bad = raw.flags & (Flag.SSI_PARITY | Flag.SSI_STATUS)
            theta = math.nan if bad else (raw.angle - self.ssi_zero) * self.ssi_per_count
        else:
            theta = (raw.angle - self.pwm_zero) * self.pwm_per_count
        theta -= _TURN * round(theta / _TURN) if math.isfinite(theta) else 0.0
        omega = _TURN / (self.pulses_per_rev * raw.period * TICK_NS * 1e-9) if raw.period else 0.0
        return Measured(
            theta,
            omega,
            (raw.voltage - self.voltage_zero) * self.voltage_per_count,
            (raw.current - self.current_zero) * self.current_per_count,
            raw.duty / 255.0,
        )


NAMES = tuple(field.name for field in fields(Calibration))


@dataclass(frozen=True)
class Number:
    """A value of the calibration.

    Attributes:
        unit: its unit; "-" for none.
        low: smallest value.
        high: greatest value.
        description: its meaning.
    """

    unit: str
    low: float
    high: float
    description: str


NUMBERS = {
    "current_zero": Number("counts", -1024.0, 1024.0, "current converter without current"),
    "current_per_count": Number("A", -1.0, 1.0, "current per count"),
    "voltage_zero": Number("counts", -512.0, 512.0, "voltage converter without voltage"),
    "voltage_per_count": Number("V", -1.0, 1.0, "voltage per count"),
    "pwm_zero": Number("counts", -1024.0, 1024.0, "encoder's PWM output while the arm hangs"),
    "pwm_per_count": Number("rad", -0.1, 0.1, "angle per count, encoder's PWM output"),
    "ssi_zero": Number("counts", -1024.0, 1024.0, "SSI position while the arm hangs"),
    "ssi_per_count": Number("rad", -0.1, 0.1, "angle per count, SSI"),
    "pulses_per_rev": Number("-", 0.01, 1e4, "IR pulses per turn of the rotor"),
    "latency": Number("s", 0.0, 0.1, "smallest delay of a frame by the line, such as USB"),
}


@cache
def default() -> Calibration:
    """Return the calibration of nominal parts, wired as in firmware/README.md."""
    text = (files("aeropend_bridge") / "config" / DEFAULT).read_text(encoding="utf-8")
    return Calibration(**yaml.safe_load(text)["/**"]["ros__parameters"][SECTION])


def load(path: str | Path) -> Calibration:
    """Read the calibration in a ROS 2 parameter file. Missing values take their defaults.

    Args:
        path: of the file.

    Raises:
        CalibrationError: the file cannot be read, or a value in it cannot be used.
    """
    try:
        tree = load_yaml(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise CalibrationError(f"{path}: the calibration file cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, yaml.YAMLError):
        raise CalibrationError(f"{path}: not a parameter file; the presets show the form") from None
    try:
        (section,) = (part["ros__parameters"][SECTION] for part in tree.values())
        given = dict(section)
    except (AttributeError, KeyError, TypeError, ValueError):
        raise CalibrationError(f"{path}: not a calibration; it reads '/**: ros__parameters: {SECTION}: ...'") from None
    for name, value in given.items():
        if name not in NUMBERS:
            raise CalibrationError(f"{path}: unknown number {name!r}; known: {', '.join(NUMBERS)}")
        known = NUMBERS[name]
        try:  # 1e-5 is text in YAML 1.1
            given[name] = value = float(value)
        except (TypeError, ValueError, OverflowError):
            raise CalibrationError(f"{path}: {name} is {value!r}; give a number") from None
        if not known.low <= value <= known.high:
            raise CalibrationError(f"{path}: {name} = {value:g} is out of range; give {known.low:g} to {known.high:g}")
    return Calibration(**{**vars(default()), **given})


def save(calibration: Calibration, path: str | Path, comment: str = "") -> None:
    """Write a parameter file for the bridge; `path` is replaced in one step.

    Args:
        calibration: the calibration.
        path: of the file.
        comment: lines at the top of the file; each gets the prefix `# `.

    Raises:
        CalibrationError: the file cannot be written. An old file is then unchanged.
    """
    lines = [f"# {printable(line)}" for line in comment.splitlines()]
    lines += ["/**:", "  ros__parameters:", f"    {SECTION}:"]
    for name in NAMES:
        number = repr(float(getattr(calibration, name)))
        if "e" in number and "." not in number:  # it would be text in YAML 1.1
            number = number.replace("e", ".0e")
        known = NUMBERS[name]
        lines.append(f"      {name + ': ' + number:<44} # {known.unit}; {known.description}")
    path = Path(path)
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write("\n".join(lines) + "\n")
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise CalibrationError(f"{path}: the calibration file cannot be written: {error.strerror}") from None
