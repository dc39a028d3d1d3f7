# SPDX-License-Identifier: Apache-2.0
"""A specialised program as C99 that needs the standard library alone."""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence

from aeropend_sim.export.specialise import Function, Program, Type, fields, tuple_name

_SCALARS = {float: "double", int: "int", bool: "int"}

_CALLS = {"abs": "fabs", "max": "largest", "min": "smallest", "int": "(int)"}
"""Functions that C has by another name."""

_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Mod: "%", ast.Lt: "<", ast.LtE: "<=",
          ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.And: "&&", ast.Or: "||", ast.USub: "-",
          ast.UAdd: "+",
          ast.Not: "!"}

_TAKEN = frozenset((
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern",
    "float", "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed",
    "sizeof", "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while", "near",
    "far", "y0", "y1", "yn", "j0", "j1", "jn", "gamma", "time", "index", "signal", "remainder"))
"""Names that mean something else to C, or to a system's headers."""

_OWN = {
    "largest": "static double largest(double a, double b) { return b > a ? b : a; }\n",
    "smallest": "static double smallest(double a, double b) { return b < a ? b : a; }\n",
    "smallest_int": "static int smallest_int(int a, int b) { return b < a ? b : a; }\n",
    "sign": "static double sign(double x) { return x > 0.0 ? 1.0 : (x < 0.0 ? -1.0 : 0.0); }\n",
}
"""Functions that C does not have."""


def name_of(kind: Type) -> str:
    """A type as C names it."""
    return _SCALARS.get(kind) or tuple_name(kind)


def _safe(name: str) -> str:
    return f"{name}_" if name in _TAKEN else name


def structures(kinds: Sequence[Type]) -> str:
    """The tuples of a program as structures.

    Args:
        kinds: each after those that it holds.
    """
    return "\n".join(
        "typedef struct {\n" + "".join(f"    {name_of(each)} {_safe(name)};\n" for name, each in fields(kind).items())
        + f"}} {name_of(kind)};\n" for kind in kinds)


def functions(program: Program, public: Sequence[str] = ()) -> str:
    """The functions of a program, called ones first.

    Args:
        program: the program.
        public: names of the functions that other files may call.
    """
    written = "\n".join(_function(f, public=f.name in public) for f in program.functions)
    own = [text for name, text in _OWN.items() if re.search(rf"\b{name}\(", written)]
    return "".join(own) + "\n" * bool(own) + written


def prototype(f: Function) -> str:
    """How a function is declared."""
    arguments = ", ".join(f"{name_of(kind)} {_safe(name)}" for name, kind in f.arguments.items())
    return f"{name_of(f.returns)} {_safe(f.name)}({arguments or 'void'})"


def _function(f: Function, *, public: bool) -> str:
    writer = _Writer(f)
    body = writer.block(f.body, 1)
    used = [(name, kind) for name, kind in f.local.items() if name in writer.counted or _safe(name) in writer.read]
    declared = "".join(f"    {name_of(kind)} {_safe(name)};\n" for name, kind in [*used, *writer.more.items()])
    doc = f"/* {f.doc} */\n" if f.doc else ""
    return f"{doc}{'' if public else 'static '}{prototype(f)}\n{{\n{declared}{body}}}\n"


class _Writer:
    def __init__(self, f: Function) -> None:
        self.f = f
        self.read = {_safe(node.id) for s in f.body for node in ast.walk(s)
                     if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
        self.more: dict[str, Type] = {}
        """Variables that only C needs."""
        self.counted = {node.target.id for s in f.body for node in ast.walk(s) if isinstance(node, ast.For)}  # type: ignore[attr-defined]

    # --- statements

    def block(self, body: Sequence[ast.stmt], depth: int) -> str:
        pad = "    " * depth
        out = ""
        for s in body:
            if isinstance(s, ast.Return):
                assert s.value is not None
                out += f"{pad}return {self.whole(s.value)};\n"
            elif isinstance(s, ast.Assign):
                out += self._assign(s, pad)
            elif isinstance(s, ast.If):
                out += f"{pad}if ({self.whole(s.test)}) {{\n{self.block(s.body, depth + 1)}{pad}}}"
                out += f" else {{\n{self.block(s.orelse, depth + 1)}{pad}}}\n" if s.orelse else "\n"
            elif isinstance(s, ast.For):
                assert isinstance(s.target, ast.Name)
                assert isinstance(s.iter, ast.Call)
                name, bounds = _safe(s.target.id), [self.whole(each) for each in s.iter.args]
                first, end = bounds if len(bounds) > 1 else ["0", *bounds]
                inner = self.block(s.body, depth + 1)
                out += f"{pad}for ({name} = {first}; {name} < {end}; {name}++) {{\n{inner}{pad}}}\n"
        return out

    def _assign(self, s: ast.Assign, pad: str) -> str:
        (target,) = s.targets
        if isinstance(target, ast.Name):
            return f"{pad}{_safe(target.id)} = {self.whole(s.value)};\n"
        assert isinstance(target, ast.Tuple)
        names = [_safe(each.id) for each in target.elts]  # type: ignore[attr-defined]
        if isinstance(s.value, ast.Tuple):  # at once: a value may need the variable that the one before it sets
            kept = [self._variable(each.type) for each in s.value.elts]  # type: ignore[attr-defined]
            return "".join(f"{pad}{k} = {self.whole(v)};\n" for k, v in zip(kept, s.value.elts, strict=True)) + "".join(
                f"{pad}{name} = {k};\n" for name, k in zip(names, kept, strict=True))
        kind = s.value.type  # type: ignore[attr-defined]
        if isinstance(s.value, ast.Name):
            found, out = _safe(s.value.id), ""
        else:
            found = self._variable(kind)
            out = f"{pad}{found} = {self.whole(s.value)};\n"
        kept_of = zip(names, fields(kind), strict=True)
        return out + "".join(f"{pad}{name} = {found}.{_safe(each)};\n" for name, each in kept_of if name in self.read)

    def _variable(self, kind: Type) -> str:
        name = f"t{len(self.more) + 1}"
        while name in self.f.local or name in self.f.arguments:
            name += "_"
        self.more[name] = kind
        return name

    # --- expressions

    def whole(self, node: ast.expr) -> str:
        """An expression."""
        return self._written(node)[0]

    def _inner(self, node: ast.expr, rank: int) -> str:
        """An expression inside another one, in brackets if it binds less firmly."""
        text, own = self._written(node)
        return text if own >= rank else f"({text})"

    def _written(self, node: ast.expr) -> tuple[str, int]:
        """An expression, and how firmly it binds."""
        if isinstance(node, ast.Name):
            return _safe(node.id), 9
        if isinstance(node, ast.Constant):
            return self._number(node)
        if isinstance(node, ast.Attribute):
            return f"{self._inner(node.value, 9)}.{_safe(node.attr)}", 9
        if isinstance(node, ast.Tuple):
            parts = ", ".join(self.whole(each) for each in node.elts)
            return f"({name_of(node.type)}){{{parts}}}", 9  # type: ignore[attr-defined]
        if isinstance(node, ast.Call):
            return self._call(node), 9
        if isinstance(node, ast.IfExp):
            return f"{self._inner(node.test, 2)} ? {self._inner(node.body, 2)} : {self._inner(node.orelse, 1)}", 1
        if isinstance(node, ast.BoolOp):
            return f" {_SIGNS[type(node.op)]} ".join(self._inner(each, 3) for each in node.values), 2
        if isinstance(node, ast.Compare):
            sides = [self._inner(each, 5) for each in (node.left, *node.comparators)]
            pairs = [f"{a} {_SIGNS[type(op)]} {b}" for op, a, b in zip(node.ops, sides, sides[1:])]
            return " && ".join(pairs), 4 if len(pairs) == 1 else 2
        if isinstance(node, ast.UnaryOp):
            return f"{_SIGNS[type(node.op)]}{self._inner(node.operand, 8)}", 7
        if isinstance(node, ast.BinOp):
            return self._operation(node)
        raise NotImplementedError(ast.dump(node))

    def _operation(self, node: ast.BinOp) -> tuple[str, int]:
        if isinstance(node.op, ast.Pow):
            return f"pow({self.whole(node.left)}, {self.whole(node.right)})", 9
        rank = 5 if isinstance(node.op, (ast.Add, ast.Sub)) else 6
        left, right = self._inner(node.left, rank), self._inner(node.right, rank + 1)
        kinds = node.left.type, node.right.type  # type: ignore[attr-defined]
        if isinstance(node.op, ast.Div) and kinds == (int, int):
            left = f"(double){self._inner(node.left, 8)}"
        return f"{left} {_SIGNS[type(node.op)]} {right}", rank

    def _call(self, node: ast.Call) -> str:
        assert isinstance(node.func, ast.Name)
        name, kind = node.func.id, node.type  # type: ignore[attr-defined]
        parts = ", ".join(self.whole(each) for each in node.args)
        if hasattr(kind, "_fields") and name == tuple_name(kind):
            return f"({name}){{{parts}}}"
        if name == "min" and kind is int:
            return f"smallest_int({parts})"
        return f"{_CALLS.get(name, _safe(name))}({parts})"

    @staticmethod
    def _number(node: ast.Constant) -> tuple[str, int]:
        value = node.value
        if isinstance(value, (bool, int)):
            return str(int(value)), 9 if value >= 0 else 7
        assert isinstance(value, float)
        if value != value:
            return "NAN", 9
        if value in (float("inf"), float("-inf")):
            return ("INFINITY", 9) if value > 0.0 else ("-INFINITY", 7)
        return repr(value), 9 if value >= 0.0 and not repr(value).startswith("-") else 7
