# SPDX-License-Identifier: Apache-2.0
"""Units of the quantities in a table: spellings in many languages, and factors to SI."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from aeropend_sim.errors import UserError

DEGREE = math.pi / 180.0
TURN = 2.0 * math.pi
RPM = TURN / 60.0

CLOCK = "clock"
"""The unit of a time of day or a date, whose values are in s."""

ANGLES = {
    "deg": DEGREE, "rad": 1.0, "turn": TURN, "mrad": 1e-3, "°": DEGREE, "º": DEGREE, "degree": DEGREE,
    "degrees": DEGREE, "degs": DEGREE, "grad": DEGREE, "grados": DEGREE, "graus": DEGREE, "gradi": DEGREE,
    "degrés": DEGREE, "graden": DEGREE, "stopnie": DEGREE, "град": DEGREE, "度": DEGREE,
    "radian": 1.0, "radians": 1.0, "рад": 1.0, "turns": TURN, "rev": TURN, "revs": TURN,
}  # fmt: skip
SPEEDS = {
    "rad/s": 1.0, "rpm": RPM, "deg/s": DEGREE, "turn/s": TURN, "Hz": TURN, "rads": 1.0, "rad_s": 1.0, "rad/sec": 1.0,
    "rad·s⁻¹": 1.0, "rad s^-1": 1.0, "rad*s^-1": 1.0, "1/min": RPM, "min-1": RPM, "min^-1": RPM, "min⁻¹": RPM,
    "U/min": RPM, "u/min": RPM, "Upm": RPM, "tr/min": RPM, "giri/min": RPM, "rev/min": RPM, "r/min": RPM,
    "omw/min": RPM, "ob/min": RPM, "об/мин": RPM, "rps": TURN, "rev/s": TURN, "U/s": TURN, "°/s": DEGREE,
    "grad/s": DEGREE, "1/s": TURN,
}  # fmt: skip
UNITS: dict[str, dict[str, float]] = {
    "time": {
        "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "day": 86400.0, CLOCK: 1.0, "µs": 1e-6,
        "μs": 1e-6, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "sek": 1.0, "sekunden": 1.0, "sekunde": 1.0,
        "seg": 1.0, "segundos": 1.0, "secondes": 1.0, "secondi": 1.0, "с": 1.0, "сек": 1.0, "мс": 1e-3, "秒": 1.0,
        "毫秒": 1e-3, "msec": 1e-3, "millis": 1e-3, "millisec": 1e-3, "milliseconds": 1e-3, "usec": 1e-6,
        "micros": 1e-6, "microseconds": 1e-6, "days": 86400.0, "d": 86400.0,
    },
    "theta": ANGLES,
    "duty": {"%": 1e-2, "1": 1.0, "‰": 1e-3, "percent": 1e-2, "pct": 1e-2, "prozent": 1e-2, "-": 1.0, "fraction": 1.0},
    "omega": SPEEDS,
    "current": {"A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6, "μA": 1e-6, "amp": 1.0, "amps": 1.0, "ampere": 1.0,
                "а": 1.0, "ма": 1e-3},
    "voltage": {"V": 1.0, "mV": 1e-3, "volt": 1.0, "volts": 1.0, "в": 1.0, "мв": 1e-3},
    "reference": {**ANGLES, **SPEEDS},
}  # fmt: skip
"""Quantity -> unit -> its factor to SI. Messages list the first units of each quantity."""

LISTED = {"time": 8, "theta": 4, "duty": 3, "omega": 5, "current": 3, "voltage": 2, "reference": 4}
"""Number of units of each quantity that messages list."""

NAMES_TOO = ("d", "h", "1", "-")
"""Units that are no unit where they are the whole name of a column; nor are spellings like `a` for A."""

COUNTED = ("theta", "duty", "reference")
"""Quantities that may be given in counts."""

_SIZED = re.compile(r"^([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*\*?\s*(\S.*)$")
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)"
_COUNTS = re.compile(rf"^counts:({_NUMBER})(?:\.\.({_NUMBER}))?$", re.IGNORECASE)
_BRACKETS = re.compile(r"^(.*?)\s*[\[(<{]\s*([^\])>}]*?)\s*[\])>}]\s*$")
_SLASH = re.compile(r"^(.*?\S)\s*(?:/| in )\s*(\S+)$")
_TAIL = re.compile(r"^(.*[^_\s])_(deg|rad|rpm|ms|us|sec|s|mA|A|mV|V|pct|percent|rad_s|counts)$")


class UnitError(UserError):
    """A unit is unknown; the message is part of a line for the user."""


@dataclass(frozen=True)
class Unit:
    """Conversion of a number in a table: SI value = (number - low) * size.

    Attributes:
        text: the unit as the user writes it.
        size: factor to SI.
        low: the number that means zero.
        is_speed: the unit of a reference is one of speed, not of angle.
    """

    text: str
    size: float
    low: float = 0.0
    is_speed: bool = False


def known(quantity: str, text: str) -> str | None:
    """The unit of a quantity with this spelling, as in `UNITS`; None if it is unknown."""
    text = text.strip()
    units = UNITS[quantity]
    if text in units:
        return text
    same = [unit for unit in units if unit.casefold() == text.casefold().rstrip(".")]
    return same[0] if len({units[unit] for unit in same}) == 1 else None


def parse(quantity: str, text: str) -> Unit:
    """Read a unit: `deg`, `0.1deg` (the number 1 is 0.1 degrees), `counts:1024`, `counts:1000..2000`.

    For an angle, the counts are those of a full turn. For a duty, they are those of duty 1, or those of duty 0 and 1.

    Args:
        quantity: a key of `UNITS`.
        text: the unit.

    Raises:
        UnitError: it is not a unit of this quantity.
    """
    counts = _COUNTS.match(text.strip())
    if counts and quantity in COUNTED:
        first, second = float(counts.group(1)), counts.group(2)
        if quantity != "duty":
            if second is not None or first <= 0.0:
                raise UnitError(f"'{text}': counts of an angle are those of a full turn, as in counts:1024")
            return Unit(text, TURN / first)
        low, high = (first, float(second)) if second is not None else (0.0, first)
        if low == high:
            raise UnitError(f"'{text}': counts of a duty are those of full duty, or of none and full, as in counts:255 "
                            "or counts:1000..2000")
        return Unit(text, 1.0 / (high - low), low)
    unit, factor = known(quantity, text), 1.0
    if unit is None:
        sized = _SIZED.match(text.strip())
        unit = known(quantity, sized.group(2)) if sized else None
        factor = float(sized.group(1)) if sized else 1.0
        if unit is None or factor == 0.0:
            raise UnitError(f"'{text}' is no unit of {quantity}: give {listed(quantity)}")
    if unit == CLOCK and factor != 1.0:
        raise UnitError(f"'{text}': a time of day has no size")
    return Unit(text.strip(), factor * UNITS[quantity][unit], is_speed=unit in SPEEDS and quantity == "reference")


def listed(quantity: str) -> str:
    """Text that lists the units of a quantity."""
    names = list(UNITS[quantity])[: LISTED[quantity]]
    if quantity == "duty":
        return ", ".join(names) + ", counts:255 (those of full duty) or counts:1000..2000 (of none and of full)"
    return ", ".join(names) + (" or counts:1024 (those of a turn)" if quantity in COUNTED else "")


def split_name(name: str) -> tuple[str, str]:
    """Split a column's name into name and unit: 'angle [deg]', 'angle (deg)', 'angle / deg', 'angle_deg'.

    Returns:
        The name, and the unit as in the text; "" without a known unit.
    """
    if is_unit(name) and name.strip() not in NAMES_TOO and any(name.strip() in units for units in UNITS.values()):
        return name.strip(), name.strip()
    for pattern in (_BRACKETS, _SLASH, _TAIL):
        match = pattern.match(name.strip())
        if match and is_unit(match.group(2)):
            return match.group(1).strip(), match.group(2)
    return name.strip(), ""


def is_unit(text: str) -> bool:
    """Whether a text is a unit of any quantity."""
    return any(known(quantity, text) is not None for quantity in UNITS) or text.casefold() in ("counts", "lsb", "ticks")


def without_brackets(text: str) -> str:
    """The unit in a cell of a line of units: '[s]', '(deg)', 'V'."""
    return text.strip().strip("[](){}<>").strip()
