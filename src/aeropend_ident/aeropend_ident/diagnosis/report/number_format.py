# SPDX-License-Identifier: Apache-2.0
"""Numbers as texts: significant digits, units, intervals, shares, and ticks of an axis."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from aeropend_sim.cli.axis import multiples, tick_step

MOST, LEAST = 1e15, 1e-15
"""Magnitude from which a number is no measurement of a rig, and below which it is zero (choice)."""

LONG, LONGEST = 1e6, 7
"""Value on an axis, and number of its decimals, from which it is written with a power of ten (layout)."""

UNKNOWN = "–"
"""Text of a number that is not known."""

BOUND = 9.995
"""Share from which a text gives only a bound, "> 999 %" (choice: what is off by a factor of ten needs no digits)."""


def sane(value: float | None) -> float:
    """A number that a person can read: NaN where it is unknown or too large for a measurement, 0 where it is nothing.

    Args:
        value: the number.
    """
    if value is None or not abs(value) < MOST:
        return math.nan
    return value if abs(value) > LEAST else 0.0


def quantity(value: float | None, unit: str = "", digits: int = 3) -> str:
    """A number with its unit: `0.0320 rad`, `1.78 × 10⁻⁵ kg·m²`.

    Args:
        value: the number; None or no finite number gives a dash.
        unit: its unit; "" or "-" for none.
        digits: significant digits.
    """
    x = sane(value)
    if not math.isfinite(x):
        return UNKNOWN
    if x == 0.0:
        return with_unit("0", unit)
    exponent = _exponent(x)
    return with_unit(fixed(x, exponent, digits - 1 - _magnitude(x) + exponent) + _power(exponent), unit)


def plain_quantity(value: float | None, unit: str = "", digits: int = 3) -> str:
    """As `quantity`, in plain characters, for a terminal.

    Args:
        value: in `unit`.
        unit: of it.
        digits: significant digits.
    """
    return quantity(value, unit, digits).replace("\N{NO-BREAK SPACE}", " ").replace("−", "-")


def exact(value: float) -> str:
    """A number as it was given, to at most six digits: `43629`, `6.8 × 10⁻⁴`."""
    x = sane(value)
    if not math.isfinite(x):
        return UNKNOWN
    exponent = _exponent(x)
    return f"{x / 10.0**exponent:.6g}".replace("-", "−") + _power(exponent)


def plain(value: float | None, digits: int = 4) -> str:
    """A number for a terminal, without an exponent where that is short: `0.7994`, `-1.2e-05`, `110`.

    Args:
        value: the number; None or no finite number gives a question mark.
        digits: significant digits.
    """
    x = sane(value)
    if not math.isfinite(x):
        return "?"
    text = f"{x:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(x) < 1e6 else text


def interval(value: float, low: float, high: float) -> tuple[str, str]:
    """A value and its interval, to two digits of half of the width: `0.7994`, `0.7981 to 0.8006`.

    A positive number that its interval does not tell from 0 is a bound: `< 0.30`, `0 to 0.30`.

    Args:
        value: the estimate.
        low: lower end of the interval.
        high: upper end of the interval.

    Returns:
        The value and the interval, as texts.
    """
    numbers = [sane(x) for x in (value, low, high)]
    if not all(map(math.isfinite, numbers)):
        return quantity(value), f"{quantity(low)} to {quantity(high)}"
    largest = max(numbers, key=abs)
    exponent = _exponent(largest)
    half = 0.5 * (numbers[2] - numbers[1])
    decimals = exponent - _magnitude(half) + 1 if half > 0.0 else exponent - _magnitude(numbers[0]) + 3
    decimals = min(decimals, exponent - _magnitude(largest) + 6)
    texts = [fixed(x, exponent, decimals) for x in numbers]
    zero = fixed(0.0, 0, decimals)
    if low >= 0.0 < high and texts[0] == texts[1] == zero != texts[2]:
        top = texts[2] + _power(exponent)
        return f"<\N{NO-BREAK SPACE}{top}", f"0 to {top}"
    shown = quantity(value, digits=1) if texts[0] == zero else texts[0] + _power(exponent)
    return shown, f"{texts[1]} to {texts[2]}{_power(exponent)}"


def percent(share: float | None, sign: bool = False) -> str:
    """A share in percent.

    Args:
        share: [0..1] the share. One between 0 and 1 is never rounded to 0 or 100, one far outside is a bound.
        sign: whether it is a change: it has a sign and is rounded in any case.
    """
    if share is None or math.isnan(share):
        return UNKNOWN
    if abs(share) >= BOUND:
        return with_unit(f"{'>' if share > 0.0 else '<'}\N{NO-BREAK SPACE}{'+' if sign and share > 0.0 else ''}"
                         f"{'−' if share < 0.0 else ''}999", "%")
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


def plain_time(seconds: float) -> str:
    """An instant for a terminal, to 10 ms: `12.30`."""
    return f"{seconds:.2f}" if 0.005 <= abs(seconds) < LONG else plain(seconds, 2)


def plain_percent(share: float | None, decimals: int = 0) -> str:
    """A share in percent for a terminal, without the sign %: `88`, `>999`.

    Args:
        share: [0..1] the share; None or NaN gives a question mark.
        decimals: number of decimals.
    """
    if share is None or math.isnan(share):
        return "?"
    if abs(share) >= BOUND:
        return ">999" if share > 0.0 else "<-999"
    return f"{round(100.0 * share, decimals) + 0.0:.{decimals}f}"


def fit_text(fit: float) -> str:
    """The fit of a free run, 1 - RMS / spread, in words where the model is worse than a constant: `98 %`."""
    return f"{plain_percent(fit)} %" if not fit < 0.0 else "worse than a constant"


def probability(p: float) -> str:
    """A probability (0 to 1) in percent; never 0 or 100."""
    return UNKNOWN if math.isnan(p) else percent(min(max(p, 1e-6), 1.0 - 1e-6))


def _magnitude(x: float) -> int:
    return math.floor(math.log10(abs(x))) if x != 0.0 else 0


def _exponent(x: float) -> int:
    magnitude = _magnitude(float(f"{x:.2e}"))  # 9.999 is 10.0 in three digits
    return magnitude if magnitude < -3 or magnitude > 4 else 0


def fixed(x: float, exponent: int, decimals: int) -> str:
    """A number with a fixed number of decimals: `fixed(-1234.5, 3, 2)` is `−1.23`.

    Args:
        x: the number.
        exponent: power of ten that it is divided by.
        decimals: number of decimals.
    """
    return f"{round(x / 10.0**exponent, decimals) + 0.0:.{max(decimals, 0)}f}".replace("-", "−")


def _power(exponent: int) -> str:
    digits = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10{digits}" if exponent else ""


def with_unit(text: str, unit: str) -> str:
    """A number and its unit with a space that does not break a line.

    Args:
        text: the number.
        unit: its unit; "" or "-" for none.
    """
    return f"{text}\N{NO-BREAK SPACE}{unit}" if unit not in ("", "-") else text


def minus(formula: str) -> str:
    """A formula with its hyphens as minus signs; those between letters stay."""
    return re.sub(r"(?<![A-Za-z])-", "−", formula)


def ends(low: float, high: float) -> list[str]:
    """The ends of a range, to two digits of its width.

    Args:
        low: lower end.
        high: upper end.
    """
    decimals = 1 - _magnitude(high - low) if math.isfinite(high - low) else 0
    texts = [_on_axis(x, decimals) for x in (low, high)]
    return ["0" if text == fixed(0.0, 0, decimals) else text for text in texts]


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
    return [Tick(100.0 * (k * step - low) / (high - low), _on_axis(k * step, decimals))
            for k in multiples(low, high, step)]


def _on_axis(x: float, decimals: int) -> str:
    """A value on an axis, with a power of ten only where it would be too long."""
    return fixed(x, 0, decimals) if abs(x) < LONG and decimals < LONGEST else quantity(x)
