# SPDX-License-Identifier: Apache-2.0
"""The section on an unknown effect: its free curves as pictures with their knots, and a plain sentence each."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.document import CANNOT_TELL, Curve, DiagnosisDocument, UnknownEffect
from aeropend_ident.diagnosis.report.binned import variable
from aeropend_ident.diagnosis.report.drawing import HEIGHT, WIDTH, from_top, grid
from aeropend_ident.diagnosis.report.number_format import MOST, Tick, percent, quantity, ticks, with_unit
from aeropend_ident.diagnosis.report.variables import VARIABLES, Variable
from aeropend_ident.signals.statistics import rms

Array = NDArray[np.float64]

TERMS = {
    ("actuator", "V"): "voltage", ("electrical", "V"): "voltage in the winding",
    ("electrical", "Ω"): "voltage in the winding per ampere", ("rotor", "N·m"): "torque on the rotor",
    ("thrust", "rad/s²"): "force of the air, as acceleration of the arm", ("thrust", "-"): "share of the thrust",
    ("thrust", "N"): "force of the air",
    ("arm", "rad/s²"): "torque on the arm, as acceleration", ("arm", "1/s"): "torque on the arm, per arm rate",
    ("sensing", "rad"): "error of the angle reading", ("sensing", "A"): "error of the current reading",
    ("sensing", "V"): "error of the voltage reading",
}
"""What is missing, by place and unit; positive where it drives or lifts."""

LATE = re.compile(r"step of the duty, (\d+) samples? ago")
"""Variable of a curve that belongs to a single step of the duty."""

NOTHING = 0.1
"""Share of the effect of the strongest curve below which another one is called almost zero (choice)."""

JUMP = 0.55
"""Share of a curve's height between two neighbouring knots from which the text mentions them (choice)."""

WHOLE = 1.0
"""Share of the thrust at which a curve is cut off.

Derived: at -100 % no thrust is left. A free curve goes beyond it only where there is hardly any thrust to show it."""

STEP = 1e-3
"""Change of the duty between two samples from which it is a step (choice)."""


@dataclass(frozen=True)
class Factors:
    """What curves are multiplied by: RMS over the recordings.

    Attributes:
        thrust: [rad/s^2] of the thrust, as acceleration of the arm.
        rate: [rad/s] of the rate of the arm.
        current: [A] of the current.
        step: of the steps of the duty.
    """

    thrust: float
    rate: float
    current: float
    step: float

    def of(self, name: str) -> float:
        """The factor with this name in the brackets of a curve; 1 for any other name."""
        return {"share of the thrust": self.thrust, "damping": self.rate, "resistance": self.current}.get(name, 1.0)


@dataclass(frozen=True)
class CurvePicture:
    """A free curve as the page draws it.

    Attributes:
        variable: what it is drawn over.
        term: what its values are.
        unit: of the values.
        text: its shape in a sentence.
        label: what the picture shows, in words.
        curve: its path.
        knots: path of its knots.
        ticks: of the vertical axis.
        marks: ticks of the horizontal axis.
        grid: path of the grid.
    """

    variable: Variable
    term: str
    unit: str
    text: str
    label: str
    curve: str
    knots: str
    ticks: list[Tick]
    marks: list[Tick]
    grid: str


@dataclass(frozen=True)
class Unknown:
    """The content of the section.

    Attributes:
        place: of the effect.
        pictures: the curve that does most comes first.
        learned: id of the term in the augmented model that the curves are; "" if they are only a picture.
    """

    place: str
    pictures: list[CurvePicture]
    learned: str = ""


@dataclass(frozen=True)
class _Curve:
    """A curve as it is drawn, without the straight line that a parameter of the model does as well.

    Attributes:
        name: as in the document.
        unit: as in the document.
        x: (K,) knots.
        y: (K,) values.
        line: (K,) that straight line, 0 where no parameter does as well.
        amount: RMS of what the curve does in the recording, in units of the place.
        slant: the same of the line.
        cut: whether values beyond `WHOLE` were cut off.
    """

    name: str
    unit: str
    x: Array
    y: Array
    line: Array
    amount: float
    slant: float = 0.0
    cut: bool = False


def section(diagnosis: Diagnosis, document: DiagnosisDocument) -> Unknown | None:
    """The content of the section; None if no unknown effect is part of the verdict.

    Args:
        diagnosis: the diagnosis.
        document: its document.
    """
    unknown = document.which.unknown
    if unknown is None or document.which.verdict == CANNOT_TELL:
        return None
    n = diagnosis.augmented.model
    speed, current = (np.concatenate([np.asarray(r[c]) for r in diagnosis.after]) for c in ("omega", "i_a"))
    rate = np.concatenate([variable(s, "theta_dot") for s in diagnosis.signals])
    step = np.concatenate([np.diff(s.duty) for s in diagnosis.signals])
    factors = Factors(n["L_over_J"] * n["k_thrust"] * _rms(speed**2), _rms(rate), _rms(current),
                      _rms(step[np.abs(step) > STEP]))
    return draw(unknown, factors, max(s.train * s.period for s in diagnosis.signals))


def draw(unknown: UnknownEffect, factors: Factors, fitted: float) -> Unknown | None:
    """Draw the curves; None if there is none to draw.

    Args:
        unknown: the effect.
        factors: what multiplies the curves.
        fitted: [s] end of the fitted data; nothing determines a curve over time after it.
    """
    bends = not unknown.id  # a learned term is drawn as the plant runs it
    curves = [c for c in (_curve(row, factors, fitted, bends=bends) for row in _rows(unknown.curves)) if c is not None]
    if not curves:
        return None
    curves.sort(key=lambda c: -c.amount)
    most = curves[0].amount
    spans: dict[str, float] = {}
    for unit in {c.unit for c in curves}:  # a curve that does little looks little beside one of another unit
        alike = [c for c in curves if c.unit == unit]
        share = max(c.amount for c in alike) / most if most > 0.0 else 1.0
        spans[unit] = max(float(np.ptp(np.append(c.y, 0.0))) for c in alike) * max(1.0, 0.5 / max(share, 1e-6))
    return Unknown(unknown.place, [_picture(c, unknown.place, spans[c.unit], most) for c in curves], unknown.id)


def _rms(x: Array) -> float:
    """Root mean square of the known values of x (N,)."""
    known = x[np.isfinite(x)]
    return rms(known) if len(known) else 0.0


def _rows(curves: Sequence[Curve]) -> list[tuple[str, str, Array, Array]]:
    """Name, unit, knots (K,) and values (K,) of each curve; those of single steps of the duty as one over their age."""
    rows, ages, heights, unit = [], [], [], ""
    for c in curves:
        x, y = np.asarray(c.at, dtype=float), np.asarray(c.value, dtype=float)
        late = LATE.fullmatch(c.variable)
        if late and len(y):
            ages.append(float(late[1]))
            heights.append(float(y[-1] - y[0]) if len(y) > 1 else float(y[0]))
            unit = f"{c.unit} per unit of duty"
        elif len(x) == len(y) > 1:
            rows.append((c.variable, c.unit, x, y))
    if len(ages) > 1:
        rows.append(("steps", unit, np.array(ages), np.array(heights)))
    return rows


def _curve(row: tuple[str, str, Array, Array], factors: Factors, fitted: float, *, bends: bool) -> _Curve | None:
    name, unit, x, y = row
    over, _, factor_name = name.partition(" (")
    factor = factors.step if over == "steps" else factors.of(factor_name.rstrip(")"))
    if over == "t":
        inside = x < fitted
        if 0 < inside.sum() < len(x):
            x, y = np.append(x[inside], fitted), np.append(y[inside], y[inside][-1])
    if len(x) < 2 or not (np.abs(y) < MOST).all():
        return None
    line = np.zeros(len(x))
    if over == "steps":
        return _Curve(name, unit, x, y, line, factor * float(np.sqrt(np.mean(y**2))))
    weight = np.ones(len(x))  # knots are quantiles: each stands for the same share of the time
    weight[[0, -1]] = 0.5

    def amount(z: Array) -> float:
        return factor * float(np.sqrt(np.average((z - np.average(z, weights=weight))**2, weights=weight)))

    if not bends:
        return _Curve(name, unit, x, y, line, amount(y))
    if not factor_name and over != "t":
        line = np.asarray(np.polyval(np.polyfit(x, y, 1, w=np.sqrt(weight)), x), dtype=np.float64)
    # constants move freely between curves and parameters: drawn from where the variable is zero
    bend = y - line
    drawn = bend - np.interp(np.clip(0.0, x[0], x[-1]), x, bend)
    cut = unit == "-" and bool((np.abs(drawn) > WHOLE).any())
    if cut:  # from the middle of its values, which the wild ones do not move
        drawn = bend = np.clip(bend - np.median(bend), -WHOLE, WHOLE)
    return _Curve(name, unit, x, drawn, line, amount(bend), amount(line), cut)


def _picture(c: _Curve, place: str, span: float, most: float) -> CurvePicture:
    over = c.name.partition(" (")[0]
    v = VARIABLES.get(over, Variable("", over, "", article=False))
    term = TERMS.get((place, c.unit.partition(" ")[0]), "what is missing")
    low, high = float(min(c.y.min(), 0.0)), float(max(c.y.max(), 0.0))
    room = 0.5 * max(span - (high - low), 0.0) + 0.1 * span or 0.5
    low, high = low - room, high + room
    left, right = float(c.x[0]), float(c.x[-1])

    points = [f"{WIDTH * (a - left) / (right - left):.0f} {HEIGHT * (high - b) / (high - low):.0f}"
              for a, b in zip(c.x, c.y, strict=True)]
    scale, unit = _scale(max(-low, high), c.unit)
    text = "almost zero" if c.amount < NOTHING * most else _shape(c.x, scale * c.y, v.unit, unit)
    if c.slant > NOTHING * most:
        rise = quantity(scale * float(c.line[-1] - c.line[0]), unit, 2)
        text += f"; in addition a straight line, {rise} from end to end, that parameters of the model can describe"
    if c.cut:
        text += f"; it is cut off at {percent(WHOLE)}, where there is too little thrust to show it"
    marks = from_top(ticks(scale * low, scale * high, 5))
    return CurvePicture(v, term, unit, f"{text[:1].upper()}{text[1:]}.",
                        f"{term} against {v.phrase}, a curve with {len(c.x)} knots: {text}", "M" + "L".join(points),
                        "".join(f"M{p}h0" for p in points), marks, ticks(left, right, 4), grid(marks))


def _scale(most: float, unit: str) -> tuple[float, str]:
    """Factor on the values that makes the texts of an axis short, and the unit of that axis."""
    if unit == "-":
        return 100.0, "%"
    return (1e3, f"m{unit}") if most < 0.05 and unit in {"N·m", "V", "A", "rad", "Ω"} else (1.0, unit)


def _shape(x: Array, y: Array, x_unit: str, y_unit: str) -> str:
    """The shape of a curve in words: its ends, jumps, extremes.

    Args:
        x: (K,) knots.
        y: (K,) values.
        x_unit: of the knots.
        y_unit: of the values.
    """
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
    """A value to two digits; 0 if it is below 2 % of the span."""
    return with_unit("0", unit) if abs(value) < 0.02 * span else quantity(value, unit, 2)
