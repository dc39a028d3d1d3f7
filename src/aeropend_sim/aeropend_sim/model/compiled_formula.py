# SPDX-License-Identifier: Apache-2.0
"""Formulas of effects as machine code, which LLVM makes of the parts that `formula` has checked.

numba takes 28 ms to compile a formula, LLVM alone 6 (measured on eight); a search tries dozens of formulas.
"""

from __future__ import annotations

import ast
import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count, pairwise
from typing import Any

from llvmlite import ir
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

from aeropend_sim.model.formula import CONSTANTS, QUANTITIES, parse

NUMBER = ir.DoubleType()
SIGNATURE = ir.FunctionType(NUMBER, [NUMBER] * (len(QUANTITIES) + 1) + [NUMBER.as_pointer()])
"""A compiled formula takes the quantities in the order of `QUANTITIES`, the memory, and a pointer to parameters."""

_numbered = count()


@dataclass(frozen=True)
class Code:
    """A compiled formula.

    Attributes:
        address: where the function lies.
        library: what keeps it there.
    """

    address: int
    library: Any

    @property
    def ctypes(self) -> Callable[..., float]:
        """The function, to be called from Python."""
        numbers = [ctypes.c_double] * (len(QUANTITIES) + 1)
        return ctypes.CFUNCTYPE(ctypes.c_double, *numbers, ctypes.POINTER(ctypes.c_double))(self.address)


@cache
def compiled(text: str, parameters: tuple[str, ...], memory: str = "") -> Code:
    """A formula as a function of C with `SIGNATURE`.

    Args:
        text: a formula that `parse` has checked.
        parameters: their names, in the order of the array that the function takes.
        memory: name of the memory; "" for none.
    """
    expression = parse(text, [*QUANTITIES, *parameters, *([memory] * bool(memory))]).expression
    name = f"aeropend_formula_{next(_numbered)}"
    library = cpu_target.target_context.codegen().create_library(name)
    module = library.create_ir_module(name)
    function = ir.Function(module, SIGNATURE, name)
    builder = ir.IRBuilder(function.append_basic_block())
    *given, numbers = function.args
    known = dict(zip([*QUANTITIES, memory], given, strict=True))
    for k, own in enumerate(parameters):
        known[own] = builder.load(builder.gep(numbers, [ir.IntType(64)(k)]))
    builder.ret(_Writer(builder, known).value(expression))
    with global_compiler_lock:
        library.add_ir_module(module)
        library.finalize()
    return Code(library.get_pointer_to_function(name), library)


class _Writer:
    """Writes the instructions of an expression.

    Args:
        builder: where they go.
        known: values of the names.
    """

    def __init__(self, builder: ir.IRBuilder, known: Mapping[str, ir.Value]) -> None:
        self.to = builder
        self.known = {**{name: NUMBER(x) for name, x in CONSTANTS.items()}, **known}

    def value(self, node: ast.expr) -> ir.Value:
        """The value of a part of the expression."""
        if isinstance(node, ast.Constant):
            return NUMBER(float(node.value))  # type: ignore[arg-type]
        if isinstance(node, ast.Name):
            return self.known[node.id]
        if isinstance(node, ast.UnaryOp):
            inner = self.value(node.operand)
            return self.to.fneg(inner) if isinstance(node.op, ast.USub) else inner
        if isinstance(node, ast.BinOp):
            left, right = self.value(node.left), self.value(node.right)
            if isinstance(node.op, ast.Pow):
                return self.outside("llvm.pow.f64", left, right)
            write = {ast.Add: self.to.fadd, ast.Sub: self.to.fsub, ast.Mult: self.to.fmul, ast.Div: self.to.fdiv}
            return write[type(node.op)](left, right)
        assert isinstance(node, ast.Call)
        assert isinstance(node.func, ast.Name)
        return self.called(node.func.id, [self.value(x) for x in node.args])

    def called(self, name: str, x: Sequence[ir.Value]) -> ir.Value:
        """The value of a function of a formula."""
        zero, one = NUMBER(0.0), NUMBER(1.0)
        if name == "min":
            return self.to.select(self.to.fcmp_ordered("<", x[1], x[0]), x[1], x[0])
        if name == "max":
            return self.to.select(self.to.fcmp_ordered(">", x[1], x[0]), x[1], x[0])
        if name == "clip":
            return self.called("min", [self.called("max", x[:2]), x[2]])
        if name == "step":
            return self.to.select(self.to.fcmp_ordered(">=", x[0], zero), one, zero)
        if name == "sign":
            below = self.to.select(self.to.fcmp_ordered("<", x[0], zero), NUMBER(-1.0), zero)
            return self.to.select(self.to.fcmp_ordered(">", x[0], zero), one, below)
        if name == "table":
            return self.table(x[0], list(zip(x[1::2], x[2::2], strict=True)))
        if name == "abs":
            return self.outside("llvm.fabs.f64", *x)
        known = {"sin", "cos", "exp", "log", "sqrt"}
        return self.outside(f"llvm.{name}.f64" if name in known else name, *x)

    def outside(self, name: str, *x: ir.Value) -> ir.Value:
        """The value of a function of LLVM or of the C library."""
        module = self.to.module
        called = module.globals.get(name) or ir.Function(module, ir.FunctionType(NUMBER, [NUMBER] * len(x)), name)
        return self.to.call(called, x)

    def table(self, x: ir.Value, points: Sequence[tuple[ir.Value, ir.Value]]) -> ir.Value:
        """Straight lines through points; beyond the first and the last point the value stays."""
        done = self.to.append_basic_block()
        ends = [(points[0][1], self.to.block)]
        following = self.to.append_basic_block()
        self.to.cbranch(self.to.fcmp_ordered(">", x, points[0][0]), following, done)
        for (x0, y0), (x1, y1) in pairwise(points):
            self.to.position_at_end(following)
            here, following = self.to.append_basic_block(), self.to.append_basic_block()
            self.to.cbranch(self.to.fcmp_ordered("<=", x, x1), here, following)
            self.to.position_at_end(here)
            share = self.to.fdiv(self.to.fsub(x, x0), self.to.fsub(x1, x0))
            ends.append((self.to.fadd(y0, self.to.fmul(share, self.to.fsub(y1, y0))), here))
            self.to.branch(done)
        self.to.position_at_end(following)
        self.to.branch(done)
        ends.append((points[-1][1], following))
        self.to.position_at_end(done)
        found = self.to.phi(NUMBER)
        for value, block in ends:
            found.add_incoming(value, block)
        return found
