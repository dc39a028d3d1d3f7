# SPDX-License-Identifier: Apache-2.0
"""Formulas of effects as machine code, built from the parts that `formula` has checked."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from numba import types

from aeropend_sim.compiled import c_function, njit
from aeropend_sim.model.formula import CONSTANTS, FUNCTIONS, QUANTITIES, parse


@njit(cached=False, error_model="numpy")
def _step(x: float) -> float:
    return 1.0 if x >= 0.0 else 0.0


@njit(cached=False, error_model="numpy")
def _sign(x: float) -> float:
    return 1.0 if x > 0.0 else (-1.0 if x < 0.0 else 0.0)


@njit(cached=False, error_model="numpy")
def _clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


@njit(cached=False, error_model="numpy")
def _table(x: float, *points: float) -> float:
    """Straight lines through points x1, y1, x2, y2, …; beyond the first and the last point the value stays."""
    if not x > points[0]:
        return points[1]
    for k in range(2, len(points), 2):
        if x <= points[k]:
            share = (x - points[k - 2]) / (points[k] - points[k - 2])
            return points[k - 1] + share * (points[k + 1] - points[k - 1])
    return points[len(points) - 1]


CALLS: dict[str, Callable[..., float]] = {
    **{name: getattr(math, name) for name in FUNCTIONS if hasattr(math, name)},
    "abs": abs, "min": min, "max": max, "clip": _clip, "sign": _sign, "step": _step, "table": _table,
}
"""What is called for each function of a formula."""

SIGNATURE = types.float64(*[types.float64] * (len(QUANTITIES) + 1), types.CPointer(types.float64))
"""A compiled formula takes the quantities in the order of `QUANTITIES`, the memory, and a pointer to parameters."""


class _Coded(ast.NodeTransformer):
    """The checked expression as code: parameters become elements of an array, integers become floats."""

    def __init__(self, parameters: Sequence[str], memory: str) -> None:
        self.parameters, self.memory = parameters, memory

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return ast.Constant(float(node.value))  # type: ignore[arg-type]

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if node.id in self.parameters:
            return ast.parse(f"p_[{self.parameters.index(node.id)}]", mode="eval").body
        if node.id in CONSTANTS:
            return ast.Constant(CONSTANTS[node.id])
        return ast.Name("m_" if node.id == self.memory else node.id, ast.Load())

    def visit_Call(self, node: ast.Call) -> ast.expr:
        return ast.Call(ast.Name(f"f_{node.func.id}", ast.Load()),  # type: ignore[attr-defined]
                        [self.visit(each) for each in node.args], [])


@cache
def compiled(text: str, parameters: tuple[str, ...], memory: str = "") -> Any:
    """A formula as a C function with `SIGNATURE`; its attribute `address` is where it lies.

    Args:
        text: a formula that `parse` has checked.
        parameters: their names, in the order of the array that the function takes.
        memory: name of the memory; "" for none.
    """
    known = [*QUANTITIES, *parameters, *([memory] * bool(memory))]
    body = _Coded(parameters, memory).visit(parse(text, known).expression)
    arguments = [*QUANTITIES, "m_", "p_"]
    function = ast.parse(f"def formula({', '.join(arguments)}):\n    return 0.0 + _\n")
    function.body[0].body[0].value.right = body  # type: ignore[attr-defined]
    names: dict[str, Any] = {f"f_{name}": call for name, call in CALLS.items()}
    exec(compile(ast.fix_missing_locations(function), "<formula>", "exec"), names)  # noqa: S102 - of checked parts
    return c_function(SIGNATURE, names["formula"])
