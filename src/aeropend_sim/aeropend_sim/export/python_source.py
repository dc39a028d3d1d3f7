# SPDX-License-Identifier: Apache-2.0
"""A specialised program as Python that needs the standard library alone."""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterable

from aeropend_sim.export.specialise import Function, Program, Type, fields, tuple_name

_IN_MATH = {"sin", "cos", "tan", "atan", "sinh", "cosh", "tanh", "exp", "expm1", "log", "sqrt", "floor", "copysign"}

_OWN = {"sign": "def sign(x):\n    return 1.0 if x > 0.0 else (-1.0 if x < 0.0 else 0.0)\n"}
"""Functions that Python does not have."""


def _written(kind: Type) -> str:
    if kind in (float, int, bool):
        return str(kind.__name__)
    return tuple_name(kind) if hasattr(kind, "_fields") else "tuple"


def source(program: Program) -> str:
    """The named tuples and functions of a program.

    Args:
        program: whose functions are written in its order, called ones first.
    """
    parts = ["import math\nfrom typing import NamedTuple\n"]
    called = {node.func.id for f in program.functions for node in _nodes(f)
              if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    parts += [text for name, text in _OWN.items() if name in called]
    for kind in program.tuples():
        if hasattr(kind, "_fields"):
            rows = "\n".join(f"    {name}: {_written(each)}" for name, each in fields(kind).items())
            parts.append(f"class {tuple_name(kind)}(NamedTuple):\n{rows}\n")
    return "\n\n".join([*parts, *map(_function, program.functions)])


def _nodes(f: Function) -> Iterable[ast.AST]:
    for statement in f.body:
        yield from ast.walk(statement)


class _Named(ast.NodeTransformer):
    """Names as Python has them: functions of math, and fields of tuples without names."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name) and node.func.id in _IN_MATH:
            return ast.Call(ast.Attribute(ast.Name("math", ast.Load()), node.func.id, ast.Load()), node.args, [])
        return node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        kind = node.value.type  # type: ignore[attr-defined]
        self.generic_visit(node)
        if not hasattr(kind, "_fields"):
            return ast.Subscript(node.value, ast.Constant(int(node.attr[1:])), ast.Load())
        return node


def _function(f: Function) -> str:
    body = [ast.unparse(ast.fix_missing_locations(_Named().visit(copy.deepcopy(s)))) for s in f.body]
    head = f"def {f.name}({', '.join(f.arguments)}):\n"
    doc = f'    """{f.doc}"""\n' if f.doc else ""
    return head + doc + "".join(f"    {line}\n" for text in body for line in text.splitlines())
