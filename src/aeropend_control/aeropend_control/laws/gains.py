# SPDX-License-Identifier: Apache-2.0
"""Gains of a law: unit, range, default and meaning; and the check of given values."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass

from aeropend_sim.errors import UserError


class GainError(UserError):
    """A gain cannot be used; the message is one line for the user."""


@dataclass(frozen=True)
class Gain:
    """A gain or another tuning parameter of a law.

    Attributes:
        unit: of the value; "-" for none.
        low: least value.
        high: greatest value.
        default: value if none is given; None: computed from the model.
        description: meaning, for `--help`.
    """

    unit: str
    low: float
    high: float
    default: float | None
    description: str


def checked(known: Mapping[str, Gain], given: Mapping[str, float]) -> dict[str, float]:
    """Check given gains.

    Args:
        known: the gains of the law, by name.
        given: values by name.

    Returns:
        The given values as floats.

    Raises:
        GainError: a gain is unknown, not a number or out of its range; one line that names it.
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
