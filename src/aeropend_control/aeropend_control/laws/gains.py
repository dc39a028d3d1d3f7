# SPDX-License-Identifier: Apache-2.0
"""What a gain is, and the check of gains that a person gives."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass


class GainError(ValueError):
    """A gain that cannot be used; the message is one line for a person."""


@dataclass(frozen=True)
class Gain:
    """A number that tunes a law: its unit, the range that makes sense, what it is if nobody says, what it means.

    A `default` of None is computed from the model file.
    """

    unit: str
    low: float
    high: float
    default: float | None
    description: str


def checked(known: Mapping[str, Gain], given: Mapping[str, float]) -> dict[str, float]:
    """The gains given, as floats.

    Raises:
        GainError: one line that says which gain is unknown, not a number or out of its range.
    """
    return {name: _check(known, name, value) for name, value in given.items()}


def _check(known: Mapping[str, Gain], name: str, value: object) -> float:
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        raise GainError(f"unknown gain '{name}'; " + (f"did you mean {near[0]}?" if near else
                                                      f"known: {', '.join(known)}"))
    gain = known[name]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise GainError(f"{name} is {value!r}; give a number" + (f" in {gain.unit}" if gain.unit != "-" else ""))
    if not gain.low <= value <= gain.high:
        size = f"{value:g} {gain.unit}" if gain.unit != "-" else f"{value:g}"
        raise GainError(f"{name} = {size} is out of range; give {gain.low:g} to {gain.high:g}")
    return float(value)
