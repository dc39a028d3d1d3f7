# SPDX-License-Identifier: Apache-2.0
"""The candidate terms of sparse identification: the thesis' library of 31 terms, and terms of the user.

A term is a product of factors: `theta`, `omega^1.8`, `sin(theta)`, `theta_dot*abs(theta_dot)`, or `1`.
If n is not an integer, x^n is |x|^n with the sign of x.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.compiled import njit
from aeropend_sim.errors import UserError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LARGEST = 1e100
"""Greatest value of a term (choice: sums of its squares are still numbers)."""

POWER, SIN, COS, ABS, SIGN = range(5)
_FUNCTIONS = {"sin": SIN, "cos": COS, "abs": ABS, "sign": SIGN}
_FACTOR = re.compile(r"(?:(?P<call>[a-z]+)\((?P<inner>\w+)\)|(?P<name>[A-Za-z_]\w*))(?:\^(?P<power>[0-9.]+))?$")


class TermError(UserError):
    """A term cannot be read; the message is one line for a person."""


class Factor(NamedTuple):
    """One factor of a term.

    Attributes:
        kind: `POWER`, `SIN`, `COS`, `ABS` or `SIGN`.
        variable: column of its variable.
        power: the exponent; used by `POWER` only.
    """

    kind: int
    variable: int
    power: float


class Table(NamedTuple):
    """A library for compiled code: term j is the product of the factors first[j] to first[j + 1]."""

    first: Indices
    kind: Indices
    variable: Indices
    power: Array


@dataclass(frozen=True)
class Library:
    """Candidate terms over named variables.

    Attributes:
        variables: names of the columns: states, then inputs.
        names: names of the terms.
        table: the terms for compiled code.
    """

    variables: tuple[str, ...]
    names: tuple[str, ...]
    table: Table

    @classmethod
    def of(cls, variables: Sequence[str], names: Sequence[str]) -> Library:
        """A library of terms.

        Args:
            variables: names of the columns: states, then inputs.
            names: names of the terms.

        Raises:
            TermError: a term is not understood, names an unknown variable, or is given twice.
        """
        factors = [parse(name, variables) for name in names]
        if len(set(names)) < len(names):
            twice = next(name for k, name in enumerate(names) if name in names[:k])
            raise TermError(f"the term '{twice}' is given twice")
        flat = [f for one in factors for f in one]
        table = Table(np.cumsum([0, *map(len, factors)], dtype=np.int64),
                      np.array([f.kind for f in flat], dtype=np.int64),
                      np.array([f.variable for f in flat], dtype=np.int64),
                      np.array([f.power for f in flat], dtype=float))
        return cls(tuple(variables), tuple(names), table)

    def __len__(self) -> int:
        return len(self.names)

    def check(self, values: Array) -> None:
        """Make sure that the terms are numbers to compute with.

        Args:
            values: (N, len(variables)) the variables.

        Raises:
            TermError: a term is too large.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            large = ~(np.abs(self(values)) <= LARGEST).all(axis=0)
        if large.any():
            raise TermError(f"the term '{self.names[int(np.argmax(large))]}' is too large to compute with where this "
                            "recording goes: give smaller powers")

    def __call__(self, values: Array) -> Array:
        """Values (N, terms) of the terms for variables (N, len(variables))."""
        values = np.ascontiguousarray(values, dtype=float)
        out = np.empty((len(values), len(self)))
        for j, name in enumerate(self.names):
            column = np.ones(len(values))
            for factor in parse(name, self.variables):
                column = column * _apply(factor, values[:, factor.variable])
            out[:, j] = column
        return out


def parse(term: str, variables: Sequence[str]) -> list[Factor]:
    """The factors of a term; none for `1`.

    Args:
        term: the term as text.
        variables: names of the columns.

    Raises:
        TermError: the term is not understood, or names an unknown variable.
    """
    if term == "1":
        return []
    factors = []
    for text in term.replace(" ", "").split("*"):
        match = _FACTOR.match(text)
        call = match and match["call"]
        if match is None or (call and (call not in _FUNCTIONS or match["power"])):
            raise TermError(f"the term '{term}' is not understood at '{text}': write products of {', '.join(variables)}"
                            ", of powers as in omega^1.8, and of sin(), cos(), abs(), sign() of one")
        name = match["inner"] or match["name"]
        if name not in variables:
            raise TermError(f"the term '{term}' has the unknown variable '{name}'; known: {', '.join(variables)}")
        try:
            power = float(match["power"] or 1.0)
        except ValueError:
            raise TermError(f"the term '{term}' has the power '{match['power']}', which is not a number") from None
        factors.append(Factor(_FUNCTIONS[call] if call else POWER, list(variables).index(name), power))
    return factors


def thesis_terms(variables: Sequence[str]) -> list[str]:
    """The thesis' library: 1, each variable, each product of two, sine and cosine of each (31 terms for 5)."""
    return [*polynomials(variables, 2), *(f"{f}({v})" for v in variables for f in ("sin", "cos"))]


def polynomials(variables: Sequence[str], degree: int) -> list[str]:
    """Names of all products of variables up to a degree."""
    names, last = ["1"], [("", 0)]
    for _ in range(degree):
        last = [(f"{name}*{v}".lstrip("*"), j) for name, start in last for j, v in enumerate(variables) if j >= start]
        names += [name for name, _ in last]
    return names


def _apply(factor: Factor, x: Array) -> Array:
    if factor.kind == SIN:
        return np.sin(x)
    if factor.kind == COS:
        return np.cos(x)
    if factor.kind == ABS:
        return np.abs(x)
    if factor.kind == SIGN:
        return np.sign(x)
    if factor.power == 1.0:
        return x
    if factor.power == np.floor(factor.power):
        return np.asarray(x**int(factor.power))
    return np.asarray(np.sign(x) * np.abs(x) ** factor.power)


# inlined: in a call, counting the references to so many arrays takes longer than the terms
@njit(cached=False, inline="always", error_model="numpy")
def factor_at(kind: int, power: float, x: float) -> float:
    """Value of a factor at x."""
    if kind == SIN:
        return np.sin(x)
    if kind == COS:
        return np.cos(x)
    if kind == ABS:
        return abs(x)
    if kind == SIGN:
        return np.sign(x)
    if power == 1.0:
        return x
    if power == 2.0:
        return x * x
    if power == np.floor(power):
        return x**power
    return np.sign(x) * abs(x) ** power


@njit(cached=False, inline="always", error_model="numpy")
def slope_at(kind: int, power: float, x: float) -> float:
    """Derivative of a factor at x."""
    if kind == SIN:
        return np.cos(x)
    if kind == COS:
        return -np.sin(x)
    if kind == ABS:
        return np.sign(x)
    if kind == SIGN:
        return 0.0
    if power == 1.0:
        return 1.0
    if power == 2.0:
        return 2.0 * x
    if power == np.floor(power):
        return power * x ** (power - 1.0)
    return power * abs(x) ** (power - 1.0) if abs(x) > 0.0 else 0.0


@njit(cached=False, inline="always", error_model="numpy")
def terms_at(x: Array, which: Indices, table: Table, value: Array, slope: Array) -> None:
    """Evaluate terms and, if slope has rows, their derivatives.

    Args:
        x: (V,) the variables.
        which: indices of the terms to evaluate.
        table: the library.
        value: (terms,) receives the values.
        slope: (terms, V) receives the derivatives; without rows, they are left out.
    """
    with_slope = slope.shape[0] > 0
    for j in which:
        product = 1.0
        a, b = table.first[j], table.first[j + 1]
        for f in range(a, b):
            product *= factor_at(table.kind[f], table.power[f], x[table.variable[f]])
        value[j] = product
        if with_slope:
            for k in range(slope.shape[1]):
                slope[j, k] = 0.0
            for f in range(a, b):
                rest = slope_at(table.kind[f], table.power[f], x[table.variable[f]])
                for k in range(a, b):
                    if k != f:
                        rest *= factor_at(table.kind[k], table.power[k], x[table.variable[k]])
                slope[j, table.variable[f]] += rest
