# SPDX-License-Identifier: Apache-2.0
"""Shapes that a term of one quantity may have, as texts of the formula language with free constants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NUMPY: dict[str, Callable[..., Array]] = {
    "sin": np.sin, "cos": np.cos, "atan": np.arctan, "cosh": np.cosh, "tanh": np.tanh, "exp": np.exp, "abs": np.abs,
    "min": np.minimum, "max": np.maximum, "clip": np.clip, "sign": np.sign,
    "step": lambda x: np.where(np.asarray(x) >= 0.0, 1.0, 0.0),
}
"""The functions of the formula language that shapes use, for arrays."""


@dataclass(frozen=True)
class Constant:
    """A free constant of shapes. Values are those for a quantity whose greatest size is 1.

    Attributes:
        name: in a formula.
        description: its meaning.
        power: its unit is the quantity's unit to this power.
        start: values at which a search begins; none: quantiles of the quantity.
        low: smallest value.
        high: greatest value.
        wide: factor up to which the constant of a proposal may differ from its value; 0: it may move by `MOVE`.
    """

    name: str
    description: str
    power: int
    start: tuple[float, ...]
    low: float
    high: float
    wide: float


PLACES = 9
"""Number of quantiles at which a place is tried first (choice: a learned curve has 9 to 14 points)."""

CONSTANTS = {
    "s": Constant("scale", "size of the quantity at which the curve bends", 1, (0.03, 0.1, 0.3, 0.8), 0.01, 5.0, 5.0),
    "w": Constant("width", "width", 1, (0.08, 0.2, 0.5), 0.03, 5.0, 5.0),
    "c": Constant("centre", "place on the axis of the quantity", 1, (), -1.0, 1.0, 0.0),
    "d": Constant("end", "second place on the axis of the quantity", 1, (), -1.0, 1.0, 0.0),
    "n": Constant("exponent", "exponent", 0, (0.5, 1.5, 2.5, 4.0), 0.2, 6.0, 2.0),
    "r": Constant("reference", "reference of the power, fixed", 1, (1.0,), 1.0, 1.0, 1.001),
    "a": Constant("rise", "relative rise near zero", 0, (0.5, 2.0), -0.9, 10.0, 5.0),
    "f": Constant("frequency", "angle per unit of the quantity", -1, (1.5, 3.0, 4.5, 6.5, 9.0, 13.0), 0.5, 20.0, 2.0),
    "p": Constant("phase", "phase", 0, (0.0, 1.5708), -7.0, 7.0, 0.0),
}
"""The constants of shapes by letter. Starts and bounds are choices: narrower bends than 0.01 of the range are steps,
wider ones than 5 ranges are straight lines or parabolas."""


@dataclass(frozen=True)
class Shape:
    """A curve over a quantity x, without its size.

    Attributes:
        text: with {x} for the quantity, and {s} and so on for `CONSTANTS`.
        power: its unit is the quantity's unit to this power.
        letters: of its constants, in the order of arguments.
    """

    text: str
    power: int = 0
    letters: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "letters", tuple(k for k in CONSTANTS if f"{{{k}}}" in self.text))

    @property
    def doubles(self) -> bool:
        """Whether another shape is the same where x has one sign."""
        return "abs({x})" in self.text and "sign" not in self.text

    def __call__(self, x: Array, constants: Array) -> Array:
        """Its values.

        Args:
            x: (N,) the quantity.
            constants: its constants.
        """
        return _function(self.text, self.letters)(x, *constants) + np.zeros_like(x)

    def starts(self, x: Array) -> Array:
        """(G, constants) values at which a search begins.

        Args:
            x: (N,) the quantity, at most 1 in size.
        """
        places = np.quantile(x, (np.arange(PLACES) + 0.5) / PLACES)
        grids = [CONSTANTS[k].start or places for k in self.letters]
        points = list(product(*grids))
        found = np.array(points, dtype=float).reshape(len(points), len(self.letters))
        if "d" in self.letters:
            c, d = self.letters.index("c"), self.letters.index("d")
            found = found[found[:, c] < found[:, d]]
        return found


@cache
def _function(text: str, letters: tuple[str, ...]) -> Callable[..., Array]:
    code = text.format(x="x", **{k: k for k in letters})
    return eval(f"lambda {', '.join(['x', *letters])}: {code}", dict(NUMPY))  # noqa: S307 - texts of this file


SHAPES = (
    Shape("1"), Shape("{x}", 1), Shape("{x} * abs({x})", 2), Shape("{x}**2", 2), Shape("{x}**3", 3), Shape("{x}**4", 4),
    Shape("abs({x})", 1),
    Shape("sign({x}) * (abs({x}) / {r})**{n}"), Shape("(abs({x}) / {r})**{n}"),
    Shape("tanh({x} / {s})"), Shape("tanh(({x} - {c}) / {s})"), Shape("atan({x} / {s})"),
    Shape("(1 + {a} * exp(-({x} / {w})**2)) * tanh({x} / {s})"),
    Shape("exp(-(({x} - {c}) / {w})**2)"), Shape("({x} - {c}) / {w} * exp(-(({x} - {c}) / {w})**2)"),
    Shape("1 / (1 + (({x} - {c}) / {w})**2)"), Shape("1 / (1 + ({x} / {w})**2)"),
    Shape("{x} / {w} / (1 + ({x} / {w})**2)"),
    Shape("exp(-abs({x}) / {w})"), Shape("exp({x} / {w})"), Shape("exp(-{x} / {w})"),
    Shape("cosh(({x} - {c}) / {w})"),
    Shape("max(0, {x} - {c})", 1), Shape("max(0, {c} - {x})", 1),
    Shape("max(0, {x} - {c})**2", 2), Shape("max(0, {c} - {x})**2", 2),
    Shape("clip({x}, -{s}, {s})", 1), Shape("clip({x}, {c}, {d})", 1),
    Shape("step({x} - {c})"),
    Shape("sin({f} * {x} + {p})"),
)
"""What physics gives: friction, drag, springs, walls, wells, thresholds, saturation, cogging."""
