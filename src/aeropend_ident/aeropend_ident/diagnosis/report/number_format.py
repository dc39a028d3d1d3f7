# SPDX-License-Identifier: Apache-2.0
"""Numbers as a person reads them: digits that count, units, intervals, shares, and ticks along an axis."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from aeropend_sim.cli.axis import multiples, tick_step


def quantity(value: float | None, unit: str = "", digits: int = 3) -> str:
    """A number to some significant digits with its unit: `0.0320 rad`, `1.78 × 10⁻⁵ kg·m²`, or a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    exponent = _exponent(value)
    text = fixed(value, exponent, digits - 1 - _magnitude(value) + exponent)
    return with_unit(text + _power(exponent), unit)


def exact(value: float) -> str:
    """A number as it was given, to six digits: `43629`, `6.8 × 10⁻⁴`."""
    if not math.isfinite(value):
        return "–"
    exponent = _exponent(value)
    return f"{value / 10.0**exponent:.6g}".replace("-", "−") + _power(exponent)


def interval(value: float, low: float, high: float) -> tuple[str, str]:
    """A value and its interval to the digits that the interval leaves certain: `0.799`, `0.798 to 0.801`."""
    if not all(map(math.isfinite, (value, low, high))):
        return quantity(value), f"{quantity(low)} to {quantity(high)}"
    exponent = _exponent(max((value, low, high), key=abs))
    half = 0.5 * (high - low)
    decimals = exponent - _magnitude(half) + 1 if half > 0.0 else exponent - _magnitude(value) + 3
    decimals = min(decimals, exponent - _magnitude(max(value, low, high, key=abs)) + 6)
    texts = [fixed(x, exponent, decimals) for x in (value, low, high)]
    return texts[0] + _power(exponent), f"{texts[1]} to {texts[2]}{_power(exponent)}"


def percent(share: float | None, sign: bool = False) -> str:
    """A share (0..1) in percent; never rounded to 0 or 100 from outside, unless it is a change (`sign`)."""
    if share is None or not math.isfinite(share):
        return "–"
    x = 100.0 * share
    if not sign and 0.0 < x < 0.1:
        return with_unit("<\N{NO-BREAK SPACE}0.1", "%")
    if not sign and 99.9 < x < 100.0:
        return with_unit(">\N{NO-BREAK SPACE}99.9", "%")
    if -0.05 < x < 0.0 and not sign:
        x = 0.0
    text = f"{x:.{int(x != 0.0 and (abs(x) < 10.0 or 99.0 < abs(x) < 100.0))}f}"
    if sign and float(text) == 0.0:
        text = "0"
    elif sign and x > 0.0:
        text = f"+{text}"
    return with_unit(text, "%").replace("-", "−")


def probability(p: float) -> str:
    """A probability in percent; never certain."""
    return percent(min(max(p, 1e-6), 1.0 - 1e-6))


def _magnitude(x: float) -> int:
    return math.floor(math.log10(abs(x))) if x != 0.0 else 0


def _exponent(x: float) -> int:
    magnitude = _magnitude(x)
    return magnitude if magnitude < -3 or magnitude > 4 else 0


def fixed(x: float, exponent: int, decimals: int) -> str:
    """A number over a power of ten, with so many decimals: `fixed(-1234.5, 3, 2)` is `−1.23`."""
    return f"{round(x / 10.0**exponent, decimals) + 0.0:.{max(decimals, 0)}f}".replace("-", "−")


def _power(exponent: int) -> str:
    digits = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10{digits}" if exponent else ""


def with_unit(text: str, unit: str) -> str:
    """A number and its unit, never torn apart at the end of a line; `-` is no unit."""
    return f"{text}\N{NO-BREAK SPACE}{unit}" if unit not in ("", "-") else text


def minus(formula: str) -> str:
    """A formula with its hyphens as minus signs; those between letters stay."""
    return re.sub(r"(?<![A-Za-z])-", "−", formula)


def ends(low: float, high: float) -> list[str]:
    """The ends of a range to two digits of its width."""
    decimals = 1 - _magnitude(high - low)
    return [fixed(x, 0, decimals) for x in (low, high)]


class Tick(NamedTuple):
    """A round value on an axis: its position in percent of the way from low to high, and its text."""

    at: float
    text: str


def ticks(low: float, high: float, about: int) -> list[Tick]:
    """Round values on an axis.

    Args:
        low: value at its lower end.
        high: value at its upper end.
        about: number of ticks, roughly.
    """
    step = tick_step(low, high, about, tolerance=0.001)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [Tick(100.0 * (k * step - low) / (high - low), fixed(k * step, 0, decimals))
            for k in multiples(low, high, step)]
