# SPDX-License-Identifier: Apache-2.0
"""Units of columns by their numbers: the range and the smallest step tell most of them.

Each function returns the unit for the option, the reason in words, and whether no other unit fits.
"""

from __future__ import annotations

import numpy as np

from aeropend_ident.tables.table import Floats
from aeropend_ident.tables.units import UNITS, known

Scale = tuple[str, str, bool]

SLOWEST, FASTEST = 5.0, 3000.0
"""[Hz] Rates of a recording, for the unit of its time (choices)."""

STAMPS = (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9), ("day", 86400.0))
"""Units of stamps: the size of a step tells between them, for rates are within a factor of 1000 (derived)."""

NAMED = {"ms": "ms", "millis": "ms", "us": "us", "micros": "us", "s": "s", "sec": "s", "seconds": "s"}
"""Words in the name of a time -> its unit."""

SMALLEST_DEGREES, LARGEST_DEGREES = 7.0, 720.0
"""Ranges of an angle in degrees: less is rad, more is counts (choices: a circle has 6.3 rad)."""

LARGEST_READING = 400.0
"""Largest reading in degrees (choice: a turn, and a zero that is a little off)."""

FEWEST_COUNTS = 30.0
"""Greatest range of whole numbers that are degrees rather than counts (choice: 10 degrees with 1024 counts a turn)."""

LARGEST_RADIANS, SMALLEST_RADIANS = 3.5, 0.05
"""Ranges of an angle in rad (choices: half a circle; 3 degrees)."""

FULL = (255, 1000, 1023, 4095, 65535)
"""Usual counts of full duty."""

PERCENT = {"duty", "dutycycle", "tastgrad", "tastverhaltnis", "throttle", "ciclo", "percent", "скважность", "占空比"}
"""Words for a command that is a share of full duty."""

PULSES = {"esc", "us", "servo", "pulse", "throttle", "ppm"}
"""Words for a command that is the width of a pulse."""

LEAST_SHARE = 0.1
"""Least duty that is taken for one if the number 1 is full duty (choice)."""

LEAST_PERCENT = 30.0
"""Least maximum of a command in percent where the file does not say so (choice: less does not lift an arm, and the
volts of a small supply do not reach it)."""


def of_time(values: Floats, said: str, words: list[str]) -> Scale:
    """Unit of a time.

    Args:
        values: (N,) numbers.
        said: the unit in the file; "" without one.
        words: of the name.
    """
    x = values[np.isfinite(values)]
    steps = np.diff(x)
    steps = steps[steps > 0.0]
    if not len(steps):
        return "", "it does not rise", False
    step = float(np.median(steps))
    rows = float(np.mean(steps)) * len(steps) / max(len(x) - 1, 1)  # stamps that repeat say less
    fits = [unit for unit, size in STAMPS if SLOWEST <= 1.0 / (rows * size) <= FASTEST]
    named = said or next((unit for word, unit in NAMED.items() if word in words), "")
    if named:
        plain = known("time", named) or named
        possible = 0.1 <= 1.0 / (rows * UNITS["time"][plain]) <= 1e5 if said else plain in fits
        return "" if said else plain, f"in {named}" if possible else f"in {named}, {step:.4g} apart?", possible
    if x[0] in (0.0, 1.0) and (steps == 1.0).all():
        return "", "steps of 1: a counter of rows, or ms?", False
    if not fits:
        return "", f"{step:.3g} apart: in which unit?", False
    return fits[0], f"{step:.3g} apart", len(fits) == 1


def of_angle(values: Floats, *, counts: bool, named: bool) -> Scale:
    """Unit of an angle.

    Args:
        values: (N,) numbers.
        counts: they are written as counts would be.
        named: its name says that it is an angle, not a sensor.
    """
    x = values[np.isfinite(values)]
    low, high = float(x.min()), float(x.max())
    span, text = high - low, f"{low:.4g} to {high:.4g}"
    if counts and span >= 4.0:
        if span <= FEWEST_COUNTS and named:
            return "deg", text, True
        if span <= 400.0 and named:
            return "deg", f"whole numbers, {text}: deg, or counts of a turn?", False
        return "", (f"whole numbers, {text}: counts of a turn, as counts:1024, or degrees a count, as 0.264deg for a "
                    "potentiometer of 270 degrees on 10 bit?"), False
    if span > LARGEST_DEGREES or max(high, -low) > LARGEST_READING:
        return "", f"{text}: counts of what?", False
    if span > SMALLEST_DEGREES:
        return "deg", text, True
    return "rad", text if SMALLEST_RADIANS <= span <= LARGEST_RADIANS else f"{text}: rad or deg?", (
        SMALLEST_RADIANS <= span <= LARGEST_RADIANS)


def of_command(values: Floats, words: list[str], *, counts: bool, units: bool = False) -> Scale:
    """Unit of a command.

    Args:
        values: (N,) numbers.
        words: of the name.
        counts: they are written as counts would be.
        units: the file has the unit of the angle, so that it would have % too.
    """
    x = values[np.isfinite(values)]
    low, top = float(x.min()), float(x.max())
    text = f"{low:.4g} to {top:.4g}"
    if low >= 900.0 and 1100.0 <= top <= 2100.0:
        sure = low <= 1000.0 or top == 2000.0 or bool(set(words) & PULSES)
        return "counts:1000..2000", f"{text}, as pulses in µs" + "?" * (not sure), sure
    if top <= 1.0:
        return "1", f"up to {top:.4g}", top >= LEAST_SHARE
    full = next((full for full in FULL if top <= full), None)
    if counts and top > 100.0 and full:
        sure = top in FULL or (full == 255 and top != 180.0)
        return f"counts:{full}", f"whole numbers up to {top:g}" + ": or of others?" * (not sure), sure
    if top > 100.0 or (top < LEAST_PERCENT and not counts):
        return f"counts:{top:g}", (f"{text}: in which unit? counts:{top:g} makes the largest full duty, enough for a "
                                   "rig that is not calibrated"), False
    pwm = "pwm" in words  # what a microcontroller writes into its register
    if counts and not ((top == 100.0 and not pwm and not units) or set(words) & PERCENT):
        return "counts:255" if pwm else "%", f"whole numbers up to {top:g}: %, or counts of 255?", False
    return "%", f"up to {top:.4g}", True


def of_electric(quantity: str, values: Floats) -> Scale:
    """Unit of a current or a voltage."""
    top = float(np.nanmax(np.abs(values)))
    small, large, limit = ("A", "mA", 40.0) if quantity == "current" else ("V", "mV", 100.0)
    return (small, f"up to {top:.3g}", True) if top < limit else (large, f"up to {top:.3g}", top > 10.0 * limit)
