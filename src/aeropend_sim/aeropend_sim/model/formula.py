# SPDX-License-Identifier: Apache-2.0
"""Formulas of effects: text in, a checked expression out.

A formula is arithmetic over named quantities, with a few functions. Its text is never executed: it is parsed, and each
part of it is checked against what is allowed here. `compiled_formula` makes machine code of the checked parts.
"""

from __future__ import annotations

import ast
import difflib
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from aeropend_sim.errors import UserError

LONGEST = 2000
"""Greatest number of characters of a formula. A choice: the longest of the catalogue has 60."""

MOST_PARTS = 400
"""Greatest number of operators, numbers and names in a formula. A choice."""

QUANTITIES = {"theta": "rad", "theta_dot": "rad/s", "omega": "rad/s", "thrust": "N", "i_a": "A", "v": "V", "t": "s"}
"""The quantities that a formula may use, and their units, in the order in which a compiled formula takes them.

Angle and rate of the arm, speed of the rotor, thrust, current, voltage, and time since the start."""

_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}


class FormulaError(UserError):
    """A formula that cannot be used. The message is one line, without the place of the formula."""


# --- functions


def _step(x: float) -> float:
    return 1.0 if x >= 0.0 else 0.0


def _sign(x: float) -> float:
    return 1.0 if x > 0.0 else (-1.0 if x < 0.0 else 0.0)


def _clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


def _table(x: float, *points: float) -> float:
    """Straight lines through points x1, y1, x2, y2, …; beyond the first and the last point the value stays."""
    if not x > points[0]:
        return points[1]
    for k in range(2, len(points), 2):
        if x <= points[k]:
            share = (x - points[k - 2]) / (points[k] - points[k - 2])
            return points[k - 1] + share * (points[k + 1] - points[k - 1])
    return points[len(points) - 1]


PURE, KEEPS, FREE = "pure number", "keeps", "free"


@dataclass(frozen=True)
class _Function:
    """A function that a formula may call.

    Attributes:
        call: what it does; `compiled_formula` does the same.
        arguments: their number; None: x and at least two points.
        unit: `PURE`: takes and gives pure numbers; `KEEPS`: all arguments have one unit, which it gives; `FREE`: takes
            any unit, and gives a pure number.
    """

    call: Callable[..., float]
    arguments: int | None
    unit: str


FUNCTIONS = {
    **{name: _Function(getattr(math, name), 1, PURE)
       for name in ("sin", "cos", "tan", "atan", "sinh", "cosh", "tanh", "exp", "log")},
    "sqrt": _Function(math.sqrt, 1, KEEPS), "abs": _Function(abs, 1, KEEPS), "min": _Function(min, 2, KEEPS),
    "max": _Function(max, 2, KEEPS), "clip": _Function(_clip, 3, KEEPS), "sign": _Function(_sign, 1, FREE),
    "step": _Function(_step, 1, FREE), "table": _Function(_table, None, KEEPS),
}
"""The functions of a formula. step(x) is 1 from 0 on, else 0; table(x, x1, y1, x2, y2, …) joins points by lines."""

CONSTANTS = {"pi": math.pi}


# --- units

Dimension = tuple[Fraction, ...]
"""Exponents of kg, m, s and A; an angle is a pure number."""

_BASE = ("kg", "m", "s", "A")


def _dimension(**exponents: int) -> Dimension:
    return tuple(Fraction(exponents.get(base, 0)) for base in _BASE)


_SYMBOLS = {
    "-": _dimension(), "1": _dimension(), "rad": _dimension(), "%": _dimension(), "kg": _dimension(kg=1),
    "m": _dimension(m=1), "s": _dimension(s=1), "A": _dimension(A=1), "Hz": _dimension(s=-1),
    "N": _dimension(kg=1, m=1, s=-2), "W": _dimension(kg=1, m=2, s=-3), "J": _dimension(kg=1, m=2, s=-2),
    "V": _dimension(kg=1, m=2, s=-3, A=-1), "Ω": _dimension(kg=1, m=2, s=-3, A=-2),
    "H": _dimension(kg=1, m=2, s=-2, A=-2), "F": _dimension(kg=-1, m=-2, s=4, A=2),
}
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_TO_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_FACTOR = re.compile(r"(rad|Hz|kg|[-1%msAHNWJVΩF])(?:\^?(-?\d+)|([⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+))?[·* ]?")


def dimension(unit: str, of: str = "") -> Dimension:
    """Dimension of a unit as it is written here: factors with powers; all after the first stroke are below it.

    Args:
        unit: such as `rad/s²`, `N·m·s`, `1/A²s`, `N*s^2/rad^2`; `-` is a pure number.
        of: what has it, for the error message.

    Raises:
        FormulaError: it is not a unit.
    """
    total = _dimension()
    for symbol, exponent in _powers(unit, of).items():
        total = tuple(t + exponent * d for t, d in zip(total, _SYMBOLS[symbol], strict=True))
    return total


def _powers(unit: str, of: str = "") -> dict[str, int]:
    """The factors of a unit and their powers."""
    found: dict[str, int] = {}
    above, _, below = unit.translate({ord("("): "", ord(")"): "", 0x2126: "Ω"}).partition("/")
    below = below.replace("/", "·")
    for part, power in ((above, 1), (below, -1)):
        at = 0
        while at < len(part):
            factor = _FACTOR.match(part, at)
            if factor is None:
                raise FormulaError(f"{of}{': ' * bool(of)}'{unit}' is not a unit; write factors such as "
                                   f"{', '.join(_SYMBOLS)}, as in N·m/s²")
            exponent = power * int(factor[2] or (factor[3] or "1").translate(_SUPERSCRIPTS))
            found[factor[1]] = found.get(factor[1], 0) + exponent
            at = factor.end()
    if not above:
        raise FormulaError(f"the unit of {of or 'a quantity'} is missing; write - for a pure number")
    return found


def product(factors: Sequence[tuple[str, int]]) -> str:
    """Unit of a product.

    Args:
        factors: the unit and the power of each factor.

    Raises:
        FormulaError: one of them is not a unit.
    """
    total: dict[str, int] = {}
    for unit, power in factors:
        for symbol, exponent in _powers(unit).items():
            total[symbol] = total.get(symbol, 0) + power * exponent

    def joined(sign: int) -> str:
        return "·".join(symbol + (str(abs(x)).translate(_TO_SUPERSCRIPTS) if abs(x) != 1 else "")
                        for symbol, x in total.items() if x * sign > 0 and symbol not in ("-", "1"))

    above, below = joined(1), joined(-1)
    if not below:
        return above or "-"
    return f"{above or '1'}/{f'({below})' if '·' in below else below}"


def _written(d: Dimension) -> str:
    """A dimension in base units."""
    def factors(sign: int) -> str:
        return "·".join(base + (f"^{abs(x)}" if abs(x) != 1 else "")
                        for base, x in zip(_BASE, d, strict=True) if x * sign > 0)

    above, below = factors(1), factors(-1)
    return (above or "1") + (f"/{below}" if below else "") if above or below else "a pure number"


class _Units(ast.NodeVisitor):
    """Dimension of each part of a formula; None for a number alone, which may have any unit in a sum."""

    def __init__(self, of: Mapping[str, Dimension]) -> None:
        self.of = of

    def one(self, nodes: Sequence[ast.expr]) -> Dimension | None:
        """The dimension that all parts must share."""
        found = [(n, d) for n in nodes if (d := self.visit(n)) is not None]
        for node, d in found[1:]:
            if d != found[0][1]:
                raise FormulaError(f"{ast.unparse(found[0][0])} is {_written(found[0][1])} and {ast.unparse(node)} is "
                                   f"{_written(d)}: these cannot be added or compared; "
                                   "give each constant as a parameter with its unit")
        return found[0][1] if found else None

    def pure(self, node: ast.expr, what: str) -> None:
        """Check that a part is a pure number."""
        d = self.visit(node)
        if d is not None and any(d):
            raise FormulaError(f"{what} needs a pure number, and {ast.unparse(node)} is {_written(d)}")

    def visit_Constant(self, _: ast.Constant) -> Dimension | None:
        return None

    def visit_Name(self, node: ast.Name) -> Dimension | None:
        return self.of.get(node.id)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> Dimension | None:
        return self.visit(node.operand)

    def visit_BinOp(self, node: ast.BinOp) -> Dimension | None:
        if isinstance(node.op, (ast.Add, ast.Sub)):
            return self.one([node.left, node.right])
        if isinstance(node.op, ast.Pow):
            return self._power(node)
        left, right = self.visit(node.left), self.visit(node.right)
        if left is None and right is None:
            return None
        sign = -1 if isinstance(node.op, ast.Div) else 1
        nothing = _dimension()
        return tuple(a + sign * b for a, b in zip(left or nothing, right or nothing, strict=True))

    def _power(self, node: ast.BinOp) -> Dimension | None:
        base = self.visit(node.left)
        if base is not None and any(base):
            try:
                exponent = Fraction(ast.literal_eval(node.right)).limit_denominator(12)
            except (ValueError, TypeError):
                raise FormulaError(f"{ast.unparse(node.left)} is {_written(base)}: "
                                   "raise it to a number, or divide it by a parameter of its unit first") from None
            return tuple(exponent * x for x in base)
        self.pure(node.right, "an exponent")
        return base

    def visit_Call(self, node: ast.Call) -> Dimension | None:
        name = node.func.id  # type: ignore[attr-defined]
        kind = FUNCTIONS[name].unit
        if name == "table":
            self.one([node.args[0], *node.args[1::2]])
            return self.one(node.args[2::2])
        if kind == KEEPS:
            d = self.one(node.args)
            return tuple(x / 2 for x in d) if name == "sqrt" and d is not None else d
        if kind == PURE:
            self.pure(node.args[0], name)
        else:
            self.visit(node.args[0])
        return _dimension()


# --- parsing


@dataclass(frozen=True)
class Formula:
    """A checked formula.

    Attributes:
        text: as it was written.
        names: the quantities, parameters and memory that it uses.
    """

    text: str
    names: frozenset[str]

    @property
    def expression(self) -> ast.expr:
        """Its syntax tree."""
        return ast.parse(self.text.strip(), mode="eval").body

    def check_units(self, unit: str, units: Mapping[str, str]) -> None:
        """Check that it gives a unit.

        Args:
            unit: that it must give.
            units: of everything that it uses, by name.

        Raises:
            FormulaError: a sum of different units, a function of what is no pure number, or another unit as the result.
        """
        found = _Units({name: dimension(u) for name, u in units.items()}).visit(self.expression)
        if found is not None and found != dimension(unit):
            raise FormulaError(f"{self.text.strip()} is {_written(found)}, and {_written(dimension(unit))} ({unit}) is "
                               "needed; give each constant as a parameter with its unit")


def parse(text: str, known: Collection[str]) -> Formula:
    """Read a formula.

    Args:
        text: an expression with + - * / **, brackets, numbers, known names and `FUNCTIONS`.
        known: names that it may use.

    Raises:
        FormulaError: it is not such an expression, or too long.
    """
    if not isinstance(text, str) or not text.strip():
        raise FormulaError("a formula is missing; write an expression such as -k * theta_dot")
    if len(text) > LONGEST:
        raise FormulaError(f"the formula has {len(text)} characters; {LONGEST} are allowed")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = getattr(error, "msg", None) or "nested too deeply"
        raise FormulaError(f"'{_short(text)}' is no formula: {reason}") from None
    try:
        parts = [node for node in ast.walk(tree) if isinstance(node, ast.expr)]
        if len(parts) > MOST_PARTS:
            raise FormulaError(f"the formula has {len(parts)} operators, numbers and names; {MOST_PARTS} are allowed")
        return Formula(text, frozenset(_names(tree, known)))
    except RecursionError:
        raise FormulaError(f"'{_short(text)}' is nested too deeply") from None


def _names(node: ast.expr, known: Collection[str]) -> set[str]:
    """Check a part of a formula; returns the names in it."""
    if isinstance(node, ast.Constant):
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)) or not _finite(node.value):
            raise FormulaError(f"{ast.unparse(node)[:60]} is no number that a formula can hold")
        return set()
    if isinstance(node, ast.Name):
        if node.id not in known and node.id not in CONSTANTS:
            near = difflib.get_close_matches(node.id, [*known, *CONSTANTS], n=1)
            raise FormulaError(f"'{node.id}' is not known here; "
                               + (f"did you mean {near[0]}?" if near else "known: " + ", ".join([*known, *CONSTANTS])))
        return {node.id} if node.id in known else set()
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.UAdd, ast.USub)):
        return _names(node.operand, known)
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        return _names(node.left, known) | _names(node.right, known)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        _check_call(node.func.id, len(node.args))
        return set().union(*(_names(each, known) for each in node.args))
    hint = "; write ** for a power" if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor) else ""
    raise FormulaError(f"'{_short(ast.unparse(node))}' is not allowed: use numbers, names, + - * / **, brackets and "
                       f"{', '.join(FUNCTIONS)}{hint}")


def _check_call(name: str, count: int) -> None:
    if name not in FUNCTIONS:
        near = difflib.get_close_matches(name, FUNCTIONS, n=1)
        raise FormulaError(f"there is no function {name}; "
                           + (f"did you mean {near[0]}?" if near else "known: " + ", ".join(FUNCTIONS)))
    wanted = FUNCTIONS[name].arguments
    if wanted is None:
        if count < 5 or count % 2 == 0:
            raise FormulaError(f"{name} takes x and at least two points, as in {name}(x, x1, y1, x2, y2)")
    elif count != wanted:
        raise FormulaError(f"{name} takes {wanted} argument{'s' * (wanted > 1)}, not {count}")


def _finite(value: float) -> bool:
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 60 else f"{text[:60]}…"
