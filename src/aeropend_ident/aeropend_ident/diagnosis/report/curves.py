# SPDX-License-Identifier: Apache-2.0
"""The free curves of something outside the catalogue, as pictures with their knots and a plain sentence each."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.report.number_format import marks, quantity, with_unit

Array = NDArray[np.float64]

WIDTH, HEIGHT = 1600, 400
"""Units of a drawing, stretched to whatever size the page gives it."""

TERMS = {
    ("actuator", "V"): "voltage", ("electrical", "V"): "voltage in the winding",
    ("electrical", "Ω"): "voltage in the winding per ampere", ("rotor", "N·m"): "torque on the rotor",
    ("thrust", "rad/s²"): "force of the air, as acceleration of the arm", ("thrust", "-"): "share of the thrust",
    ("arm", "rad/s²"): "torque on the arm, as acceleration", ("arm", "1/s"): "torque on the arm, per arm rate",
    ("sensing", "rad"): "error of the angle read", ("sensing", "A"): "error of the current read",
}
"""What is missing, by place and unit; positive where it drives or lifts."""

VARIABLES = {
    "theta": ("θ", "the arm angle", "rad"), "theta_dot": ("θ̇", "the arm rate", "rad/s"),
    "omega": ("ω", "the rotor speed", "rad/s"), "i_a": ("i_a", "the armature current", "A"),
    "duty": ("τ", "the duty", ""), "t": ("t", "time", "s"),
    "omega, slowly": ("", "the rotor speed of the last seconds", "rad/s"),
    "slope of omega": ("", "the slope of the rotor speed", "rad/s²"),
    "steps": ("", "samples after a step of the duty", ""),
}
"""Symbol, plain name and unit of what a curve is drawn over."""

LATE = re.compile(r"step of the duty, (\d+) samples? ago")
NOTHING = 0.1
"""A curve that does less than this share of what the strongest does is called flat."""

JUMP = 0.55
"""Share of a curve's height between two neighbouring knots that is told."""


@dataclass(frozen=True)
class Factors:
    """RMS over the recording of what a curve is multiplied by, by what its name says in brackets, and of duty steps."""

    thrust: float
    rate: float
    current: float
    step: float

    def of(self, said: str) -> float:
        """The factor of a curve whose name ends like this; 1 if nothing is said."""
        return {"share of the thrust": self.thrust, "damping": self.rate, "resistance": self.current}.get(said, 1.0)


@dataclass(frozen=True)
class _Curve:
    """A curve as it is drawn: knots x and values y (K,), without the straight line that a number does as well.

    Attributes:
        name, unit: as in `diagnosis.json`.
        line: that straight line (K,), 0 where no number of the model does as well.
        amount: RMS of what the curve does in the recording, in units of the place. slant: of what the line does.
    """

    name: str
    unit: str
    x: Array
    y: Array
    line: Array
    amount: float
    slant: float = 0.0


def drawn(unknown: Mapping[str, Any], factors: Factors, fitted: float) -> dict[str, Any] | None:
    """What the page needs to draw the term; None where there is no curve.

    Args:
        unknown: `place` and `curves`, as in `diagnosis.json`.
        factors: what multiplies the curves.
        fitted: s, end of the data they were fitted to; nothing holds a curve over time beyond it.
    """
    curves = [c for c in (_curve(row, factors, fitted) for row in _rows(unknown["curves"])) if c is not None]
    if not curves:
        return None
    curves.sort(key=lambda c: -c.amount)
    most = curves[0].amount
    spans: dict[str, float] = {}
    for unit in {c.unit for c in curves}:  # a curve that does little looks little beside one of another unit
        alike = [c for c in curves if c.unit == unit]
        share = max(c.amount for c in alike) / most if most > 0.0 else 1.0
        spans[unit] = max(float(np.ptp(np.append(c.y, 0.0))) for c in alike) * max(1.0, 0.5 / max(share, 1e-6))
    return {"place": unknown["place"], "cells": [_cell(c, unknown["place"], spans[c.unit], most) for c in curves]}


def _rows(curves: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, Array, Array]]:
    """Name, unit, knots (K,) and values (K,) of each curve; those of single steps of the duty as one over their age."""
    rows, ages, heights, unit = [], [], [], ""
    for c in curves:
        x, y = np.asarray(c["at"], dtype=float), np.asarray(c["value"], dtype=float)
        late = LATE.fullmatch(c["variable"])
        if late and len(y):
            ages.append(float(late[1]))
            heights.append(float(y[-1] - y[0]) if len(y) > 1 else float(y[0]))
            unit = f"{c['unit']} per unit of duty"
        elif len(x) == len(y) > 1:
            rows.append((c["variable"], c["unit"], x, y))
    if len(ages) > 1:
        rows.append(("steps", unit, np.array(ages), np.array(heights)))
    return rows


def _curve(row: tuple[str, str, Array, Array], factors: Factors, fitted: float) -> _Curve | None:
    name, unit, x, y = row
    variable, _, said = name.partition(" (")
    factor = factors.step if variable == "steps" else factors.of(said.rstrip(")"))
    if variable == "t":
        inside = x < fitted
        if 0 < inside.sum() < len(x):
            x, y = np.append(x[inside], fitted), np.append(y[inside], y[inside][-1])
    if len(x) < 2 or not np.isfinite(y).all():
        return None
    line = np.zeros(len(x))
    if variable == "steps":
        return _Curve(name, unit, x, y, line, factor * float(np.sqrt(np.mean(y**2))))
    weight = np.ones(len(x))  # knots are quantiles: each stands for the same share of the time
    weight[[0, -1]] = 0.5

    def amount(z: Array) -> float:
        return factor * float(np.sqrt(np.average((z - np.average(z, weights=weight))**2, weights=weight)))

    if not said and variable != "t":
        line = np.asarray(np.polyval(np.polyfit(x, y, 1, w=np.sqrt(weight)), x), dtype=np.float64)
    bend = y - line  # constants move freely between curves and numbers: drawn from where the variable is zero
    return _Curve(name, unit, x, bend - np.interp(np.clip(0.0, x[0], x[-1]), x, bend), line, amount(bend), amount(line))


def _cell(c: _Curve, place: str, span: float, most: float) -> dict[str, Any]:
    variable = c.name.partition(" (")[0]
    symbol, plain, unit = VARIABLES.get(variable, ("", variable, ""))
    term = TERMS.get((place, c.unit.partition(" ")[0]), "what is missing")
    low, high = float(min(c.y.min(), 0.0)), float(max(c.y.max(), 0.0))
    room = 0.5 * max(span - (high - low), 0.0) + 0.1 * span or 0.5
    low, high = low - room, high + room
    left, right = float(c.x[0]), float(c.x[-1])

    points = [f"{WIDTH * (a - left) / (right - left):.0f} {HEIGHT * (high - b) / (high - low):.0f}"
              for a, b in zip(c.x, c.y, strict=True)]
    scale, shown = _scale(max(-low, high), c.unit)
    words = "next to nothing" if c.amount < NOTHING * most else _words(c.x, scale * c.y, unit, shown)
    if c.slant > NOTHING * most:
        rise = quantity(scale * float(c.line[-1] - c.line[0]), shown, 2)
        words += f"; besides, a slope by {rise} in all, which the model's numbers may do as well"
    ticks = [{"at": 100.0 - m["at"], "text": m["text"]} for m in marks(scale * low, scale * high, 5)]
    return {"symbol": symbol, "plain": plain, "unit": unit, "term": term, "term_unit": shown,
            "words": f"{words[:1].upper()}{words[1:]}.",
            "said": f"{term} against {plain}, a curve with {len(c.x)} knots: {words}",
            "curve": "M" + "L".join(points), "knots": "".join(f"M{p}h0" for p in points),
            "ticks": ticks, "marks": marks(left, right, 4),
            "grid": "".join(f"M0 {HEIGHT * m['at'] / 100.0:.0f}h{WIDTH}" for m in ticks)}


def _scale(most: float, unit: str) -> tuple[float, str]:
    """What values are multiplied by for an axis with short marks, and the unit of that axis."""
    if unit == "-":
        return 100.0, "%"
    return (1e3, f"m{unit}") if most < 0.05 and unit in {"N·m", "V", "A", "rad", "Ω"} else (1.0, unit)


def _words(x: Array, y: Array, x_unit: str, y_unit: str) -> str:
    """The shape of a curve (K,) in words: from where to where, jumps, extremes."""
    steps, span = np.diff(y), float(np.ptp(y))

    def at(k: int) -> str:
        return _rounded(float(x[k]), float(np.ptp(x)), x_unit)

    def value(k: int) -> str:
        return _rounded(float(y[k]), span, y_unit)

    against = min(-steps[steps < 0.0].sum(), steps[steps > 0.0].sum())
    k = int(np.argmax(np.abs(steps)))
    if against < 0.12 * span:
        text = f"{'rises' if y[-1] > y[0] else 'falls'} from {value(0)} at {at(0)} to {value(-1)} at {at(-1)}"
        if len(x) > 4 and abs(steps[k]) > JUMP * span and x[k + 1] - x[k] < 0.3 * (x[-1] - x[0]):
            text += f", most of it between {at(k)} and {at(k + 1)}"
    else:
        top, bottom = int(np.argmax(y)), int(np.argmin(y))
        inner = [j for j in (top, bottom) if 0 < j < len(x) - 1]
        if len(inner) == 1:
            (j,) = inner
            text = (f"{'peaks' if j == top else 'dips'} at {value(j)} near {at(j)}, "
                    f"from {value(0)} at {at(0)} to {value(-1)} at {at(-1)}")
        else:
            text = (f"goes up and down, highest at {value(top)} near {at(top)}, "
                    f"lowest at {value(bottom)} near {at(bottom)}")
    return text


def _rounded(value: float, span: float, unit: str) -> str:
    """A value to two digits; 0 where it is next to nothing beside the span."""
    return with_unit("0", unit) if abs(value) < 0.02 * span else quantity(value, unit, 2)
