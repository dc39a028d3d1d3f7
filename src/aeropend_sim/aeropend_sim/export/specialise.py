# SPDX-License-Identifier: Apache-2.0
"""The source of the model's functions with a model's parameters put in: a program that is small and needs no library.

The equations stay in one place. Here the very functions that numba compiles are read as syntax trees, and evaluated as
far as the parameters are known (partial evaluation, N. Jones, C. Gomard, P. Sestoft 1993). What remains depends on
state and input alone. `python_source` and `c_source` write it.

It reads what those functions use: assignments, branches, loops over `range`, arithmetic, named tuples, and functions of
math and numpy on single numbers.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import operator
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Type = Any
"""float, int, bool, a NamedTuple, or tuple[…] of these."""

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.Mod: operator.mod, ast.USub: operator.neg, ast.UAdd: operator.pos,
    ast.Not: operator.not_, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne, ast.Is: operator.is_, ast.IsNot: operator.is_not, ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
}

SAME = {np.abs: "abs", np.maximum: "max", np.minimum: "min", np.expm1: "expm1", np.sqrt: "sqrt", np.sign: "sign",
        abs: "abs", min: "min", max: "max", int: "int",
        **{getattr(math, name): name for name in ("sin", "cos", "tan", "atan", "sinh", "cosh", "tanh", "exp", "expm1",
                                                  "log", "sqrt", "floor", "copysign")}}
"""Functions of one or more numbers, and the name that they have in what remains."""


@dataclass(frozen=True)
class Known:
    """A value that is known before the program runs."""

    value: Any


@dataclass
class Function:
    """A function of what remains.

    Attributes:
        name: its name.
        arguments: name -> type, of those that it uses.
        returns: type of its value.
        body: statements; each expression in it has its type as the attribute `type`.
        local: name -> type, of its other variables.
        doc: first line of the docstring of its source.
        constant: its value, if that is known.
    """

    name: str
    arguments: dict[str, Type] = field(default_factory=dict)
    returns: Type = float
    body: list[ast.stmt] = field(default_factory=list)
    local: dict[str, Type] = field(default_factory=dict)
    doc: str = ""
    constant: Known | None = None


Value = Known | ast.expr
Hook = Callable[["Program", Sequence[Value]], Value]


class Program:
    """Functions that remain of some functions, each specialised for what is known of its arguments.

    Args:
        public: functions that keep all arguments that are not known.
        hooks: function -> what stands for a call of it.
        instead: function -> function that is read in its place.
    """

    def __init__(self, public: Sequence[Any] = (), hooks: Mapping[Any, Hook] = {}, instead: Mapping[Any, Any] = {}
                 ) -> None:
        self._finished: list[Function] = []
        self._public, self._hooks, self._instead = [plain(f) for f in public], hooks, instead
        self._made: dict[Any, Function] = {}
        self._names = {"largest", "smallest", "smallest_int", "range", *SAME.values()}

    @property
    def functions(self) -> list[Function]:
        """The public functions and those that they call, called ones first."""
        waiting = [f.name for key, f in self._made.items() if isinstance(key, tuple) and key[0] in self._public]
        by_name, kept = {f.name: f for f in self._finished}, set()
        while waiting:
            if (name := waiting.pop()) in by_name and name not in kept:
                kept.add(name)
                waiting += [node.id for s in by_name[name].body for node in ast.walk(s) if isinstance(node, ast.Name)]
        return [f for f in self._finished if f.name in kept]

    def tuples(self) -> list[Type]:
        """The named tuples and tuples of the program, each after those that it holds."""
        found: dict[str, Type] = {}

        def visit(t: Type) -> None:
            if t in (float, int, bool):
                return
            for inner in fields(t).values():
                visit(inner)
            found.setdefault(tuple_name(t), t)

        for f in self.functions:
            for t in (f.returns, *f.arguments.values(), *f.local.values()):
                visit(t)
            for statement in f.body:
                for node in ast.walk(statement):
                    if isinstance(node, ast.expr) and hasattr(node, "type"):
                        visit(node.type)
        return list(found.values())

    def add(self, function: Any, known: Mapping[str, Any] = {}) -> Function:
        """A function, specialised.

        Args:
            function: of Python, or compiled by numba.
            known: values of some of its arguments.
        """
        function = plain(self._instead.get(function, function))
        parameters = [p.name for p in inspect.signature(function).parameters.values()]
        given: list[Value | None] = [Known(known[p]) if p in known else None for p in parameters]
        return self._specialise(function, given)

    def formula(self, name: str, expression: ast.expr, arguments: Mapping[str, Type], known: Mapping[str, Any],
                doc: str) -> Function:
        """A function of one expression.

        Args:
            name: of the function.
            expression: over its arguments and what is known.
            arguments: name -> type.
            known: name -> value, or function.
            doc: what it is.
        """
        if (made := self._made.get(name)) is not None:
            return made
        f = self._made[name] = Function(self._free(name), doc=doc)
        body = _Body(self, {**{n: Known(v) for n, v in known.items()},
                            **{n: typed(ast.Name(n, ast.Load()), t) for n, t in arguments.items()}}, {}, f)
        value = residual(body.evaluate(expression))
        f.body = [ast.Return(value)]
        self._finish(f, arguments)
        return f

    def call(self, f: Function, given: Mapping[str, Value]) -> Value:
        """A call of a function of the program."""
        if f.constant is not None:
            return f.constant
        arguments = [residual(given[name]) for name in f.arguments]
        return typed(ast.Call(ast.Name(f.name, ast.Load()), arguments, []), f.returns)

    def called(self, function: Any, given: Sequence[Value]) -> Value:
        """What stands for a call of a Python function in what remains."""
        if function in self._hooks:
            return self._hooks[function](self, given)
        function = plain(self._instead.get(function, function))
        signature = inspect.signature(function)
        named: dict[str, Value] = {}
        rest = list(given)
        for p in signature.parameters.values():
            if p.kind is p.VAR_POSITIONAL:
                named |= {f"{p.name}_{k}": value for k, value in enumerate(rest)}
                rest = []
            else:
                named[p.name] = rest.pop(0) if rest else Known(p.default)
        f = self._specialise(function, list(given))
        return self.call(f, named)

    def _specialise(self, function: Any, given: Sequence[Value | None]) -> Function:
        """The function for what is known of its arguments: of numbers only whole ones count, so that there are few."""
        signature = inspect.signature(function)
        env: dict[str, Value] = {}
        arguments: dict[str, Type] = {}
        key: list[Any] = [function]
        rest = list(given)
        for p in signature.parameters.values():
            if p.kind is p.VAR_POSITIONAL:
                parts = [self._argument(f"{p.name}_{k}", float, value, arguments, key, every=True)
                         for k, value in enumerate(rest)]
                env[p.name] = ast.Tuple([residual(part) for part in parts], ast.Load())
                continue
            value = rest.pop(0) if rest else Known(p.default)
            wanted = annotation(p.annotation, function.__globals__)
            env[p.name] = self._argument(p.name, wanted, value, arguments, key)
        if (made := self._made.get(tuple(key))) is not None:
            return made
        doc = (inspect.getdoc(function) or "").partition("\n")[0]
        f = self._made[tuple(key)] = Function(self._free(function.__name__.lstrip("_")), doc=doc)
        tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        closed = inspect.getclosurevars(function).nonlocals
        body = _Body(self, env, {**function.__globals__, **closed}, f)
        f.body = body.block(tree.body)
        self._finish(f, arguments, whole=function in self._public)
        return f

    def _argument(self, name: str, wanted: Type, value: Value | None, arguments: dict[str, Type], key: list[Any],
                  *, every: bool = False) -> Value:
        if isinstance(value, Known) and (every or not isinstance(value.value, float)):
            key.append(_hashed(value.value))
            return value
        kind = wanted if value is None or isinstance(value, Known) else value.type  # type: ignore[attr-defined]
        key.append(kind)
        arguments[name] = float if kind is int and wanted is float else kind
        return typed(ast.Name(name, ast.Load()), arguments[name])

    def _finish(self, f: Function, arguments: Mapping[str, Type], *, whole: bool = False) -> None:
        """Leave out what nothing uses, and note the types."""
        while True:
            read = {node.id for statement in f.body for node in ast.walk(statement)
                    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
            kept = _without_unread(f.body, read)
            if len(list(_statements(kept))) == len(list(_statements(f.body))):
                break
            f.body = kept
        f.arguments = {name: kind for name, kind in arguments.items() if whole or name in read}
        f.local = {name: kind for name, kind in f.local.items() if name in read | _written(f.body)
                   and name not in f.arguments}
        returned = [s.value for s in _statements(f.body) if isinstance(s, ast.Return)]
        f.returns = returned[0].type  # type: ignore[union-attr]
        if any(r.type is float for r in returned):  # type: ignore[union-attr]
            f.returns = float
        only = f.body[0]
        if isinstance(only, ast.Return) and isinstance(only.value, ast.Constant):
            f.constant = Known(only.value.value)
        else:
            self._finished.append(f)

    def _free(self, name: str) -> str:
        free, k = name, 2
        while free in self._names:
            free, k = f"{name}_{k}", k + 1
        self._names.add(free)
        return free


class _Body:
    """Evaluation of a function's statements; `env` has what is known of each variable, or its name."""

    def __init__(self, program: Program, env: dict[str, Value], names: Mapping[str, Any], f: Function) -> None:
        self.program, self.env, self.names, self.f = program, env, names, f

    # --- statements

    def block(self, statements: Sequence[ast.stmt]) -> list[ast.stmt]:
        out: list[ast.stmt] = []
        for statement in statements:
            out += self._statement(statement)
            if out and _ends(out[-1]):
                break
        return out

    def _statement(self, s: ast.stmt) -> list[ast.stmt]:
        if isinstance(s, ast.Expr):
            return []  # a docstring
        if isinstance(s, ast.Return):
            assert s.value is not None
            return [ast.Return(residual(self.evaluate(s.value)))]
        if isinstance(s, ast.Assign):
            return self._assign(s.targets, self.evaluate(s.value))
        if isinstance(s, ast.AnnAssign):
            assert s.value is not None
            return self._assign([s.target], self.evaluate(s.value))
        if isinstance(s, ast.AugAssign):
            assert isinstance(s.target, ast.Name)
            whole = ast.BinOp(ast.Name(s.target.id, ast.Load()), s.op, s.value)
            return self._assign([s.target], self.evaluate(whole))
        if isinstance(s, ast.If):
            return self._if(s)
        if isinstance(s, ast.For):
            return self._for(s)
        raise NotImplementedError(f"{self.f.name}: {ast.unparse(s)}")

    def _assign(self, targets: Sequence[ast.expr], value: Value) -> list[ast.stmt]:
        out: list[ast.stmt] = []
        for target in targets:
            if isinstance(target, ast.Name):
                out += self._set(target.id, value)
            else:
                assert isinstance(target, ast.Tuple)
                names = [each.id for each in target.elts]  # type: ignore[attr-defined]
                out += self._unpack(names, value)
        return out

    def _set(self, name: str, value: Value) -> list[ast.stmt]:
        if isinstance(value, ast.Name) and value.id == name:
            return []
        if isinstance(value, Known) and not isinstance(value.value, (float, int, tuple)):
            self.env[name] = value
            return []
        out = self._store(name, value)
        self.env[name] = value if isinstance(value, Known) else self._name(name)
        return out

    def _store(self, name: str, value: Value) -> list[ast.stmt]:
        code = residual(value)
        kind = code.type  # type: ignore[attr-defined]
        before = self.f.local.get(name, kind)
        self.f.local[name] = kind if before == kind else float
        return [ast.Assign([typed(ast.Name(name, ast.Store()), kind)], code, lineno=0)]

    def _name(self, name: str) -> ast.expr:
        return typed(ast.Name(name, ast.Load()), self.f.local[name])

    def _unpack(self, names: Sequence[str], value: Value) -> list[ast.stmt]:
        if isinstance(value, ast.Tuple) or (isinstance(value, Known) and isinstance(value.value, tuple)):
            values: list[Value] = [_known(v) for v in value.elts] if isinstance(value, ast.Tuple) else [
                Known(x) for x in value.value]
            later = [_names(v) for v in values]
            if any(name in set().union(*later[k + 1:]) for k, name in enumerate(names)):
                for name, v in zip(names, values, strict=True):
                    self._set(name, v)
                    self.env[name] = self._name(name)
                at_once = ast.Tuple([residual(v) for v in values], ast.Load())
                variables = [typed(ast.Name(n, ast.Store()), self.f.local[n]) for n in names]
                return [ast.Assign([ast.Tuple(variables, ast.Store())], at_once, lineno=0)]
            return [s for name, v in zip(names, values, strict=True) for s in self._set(name, v)]
        code = residual(value)
        kinds = list(fields(code.type).values())  # type: ignore[attr-defined]
        for name, kind in zip(names, kinds, strict=True):
            before = self.f.local.get(name, kind)
            self.f.local[name] = kind if before == kind else float
            self.env[name] = typed(ast.Name(name, ast.Load()), self.f.local[name])
        target = ast.Tuple([typed(ast.Name(n, ast.Store()), k) for n, k in zip(names, kinds, strict=True)], ast.Store())
        return [ast.Assign([target], code, lineno=0)]

    def _if(self, s: ast.If) -> list[ast.stmt]:
        test = self.evaluate(s.test)
        if isinstance(test, Known):
            return self.block(s.body if test.value else s.orelse)
        before = dict(self.env)
        body = self.block(s.body)
        after, self.env = self.env, dict(before)
        orelse = self.block(s.orelse)
        if body and _ends(body[-1]):
            pass
        elif orelse and _ends(orelse[-1]):
            self.env = after
        else:
            self._forget({n for n in after | self.env if not _alike(after.get(n), self.env.get(n))})
        return [ast.If(test, body or [ast.Pass()], orelse)] if body or orelse else []

    def _forget(self, names: Iterable[str]) -> None:
        for name in names:
            if name in self.f.local:
                self.env[name] = self._name(name)

    def _for(self, s: ast.For) -> list[ast.stmt]:
        assert isinstance(s.iter, ast.Call)
        assert isinstance(s.target, ast.Name)
        bounds = [self.evaluate(each) for each in s.iter.args]
        name = s.target.id
        if all(isinstance(b, Known) for b in bounds) and _counts(s.body, name):
            out: list[ast.stmt] = []
            for k in range(*(b.value for b in bounds)):  # type: ignore[union-attr]
                self.env[name] = Known(k)
                out += self.block(s.body)
            return out
        assigned = _written(s.body)
        entered = [st for n in assigned if isinstance(v := self.env.get(n), Known) and n not in self.f.local
                   for st in self._store(n, v)]
        self._forget(assigned)
        self.f.local[name] = int
        self.env[name] = self._name(name)
        body = self.block(s.body)
        self._forget(assigned)
        call = ast.Call(ast.Name("range", ast.Load()), [residual(b) for b in bounds], [])
        return [*entered, ast.For(typed(ast.Name(name, ast.Store()), int), call, body, [], lineno=0)]

    # --- expressions

    def evaluate(self, node: ast.expr) -> Value:
        found: Value = getattr(self, f"_eval_{type(node).__name__}")(node)
        return found

    def _eval_Constant(self, node: ast.Constant) -> Value:
        return Known(node.value)

    def _eval_Name(self, node: ast.Name) -> Value:
        if node.id in self.env:
            return self.env[node.id]
        return Known(self.names[node.id] if node.id in self.names else getattr(builtins, node.id))

    def _eval_Tuple(self, node: ast.Tuple) -> Value:
        parts: list[Value] = []
        for each in node.elts:
            if isinstance(each, ast.Starred):
                parts += self._elements(self.evaluate(each.value))
            else:
                parts.append(self.evaluate(each))
        if all(isinstance(p, Known) for p in parts):
            return Known(tuple(p.value for p in parts))  # type: ignore[union-attr]
        code = [residual(p) for p in parts]
        return typed(ast.Tuple(code, ast.Load()), tuple[tuple(c.type for c in code)])  # type: ignore[attr-defined, misc]

    def _elements(self, value: Value) -> list[Value]:
        if isinstance(value, Known):
            return [Known(x) for x in value.value]
        return [field_of(value, name) for name in fields(value.type)]  # type: ignore[attr-defined]

    def _eval_Attribute(self, node: ast.Attribute) -> Value:
        value = self.evaluate(node.value)
        if isinstance(value, Known):
            return Known(getattr(value.value, node.attr))
        return field_of(value, node.attr)

    def _eval_Subscript(self, node: ast.Subscript) -> Value:
        value, at = self.evaluate(node.value), self.evaluate(node.slice)
        assert isinstance(at, Known), ast.unparse(node)
        if isinstance(value, Known):
            return Known(value.value[at.value])
        if isinstance(value, ast.Tuple):
            return _known(value.elts[at.value])
        return field_of(value, list(fields(value.type))[at.value])  # type: ignore[attr-defined]

    def _eval_UnaryOp(self, node: ast.UnaryOp) -> Value:
        value = self.evaluate(node.operand)
        if isinstance(value, Known):
            return Known(_OPERATORS[type(node.op)](value.value))
        kind = bool if isinstance(node.op, ast.Not) else value.type  # type: ignore[attr-defined]
        return typed(ast.UnaryOp(node.op, value), kind)

    def _eval_BinOp(self, node: ast.BinOp) -> Value:
        a, b = self.evaluate(node.left), self.evaluate(node.right)
        if isinstance(a, Known) and isinstance(b, Known):
            return Known(_OPERATORS[type(node.op)](a.value, b.value))
        left, right = residual(a), residual(b)
        whole = left.type is int and right.type is int and not isinstance(node.op, ast.Div)  # type: ignore[attr-defined]
        return typed(ast.BinOp(left, node.op, right), int if whole else float)

    def _eval_BoolOp(self, node: ast.BoolOp) -> Value:
        stops = isinstance(node.op, ast.Or)
        parts = []
        for each in node.values:
            value = self.evaluate(each)
            if isinstance(value, Known):
                if bool(value.value) is stops:
                    return value
                continue
            parts.append(value)
        if not parts:
            return Known(not stops)
        return parts[0] if len(parts) == 1 else typed(ast.BoolOp(node.op, parts), bool)

    def _eval_Compare(self, node: ast.Compare) -> Value:
        values = [self.evaluate(each) for each in (node.left, *node.comparators)]
        if isinstance(node.ops[0], (ast.Is, ast.IsNot)) and not isinstance(values[0], Known):
            return Known(isinstance(node.ops[0], ast.IsNot))  # only what is known can be None
        if all(isinstance(v, Known) for v in values):
            return Known(all(_OPERATORS[type(op)](a.value, b.value)  # type: ignore[union-attr]
                             for op, a, b in zip(node.ops, values, values[1:])))
        code = [residual(v) for v in values]
        return typed(ast.Compare(code[0], node.ops, code[1:]), bool)

    def _eval_IfExp(self, node: ast.IfExp) -> Value:
        return self.choice(self.evaluate(node.test), lambda: self.evaluate(node.body),
                           lambda: self.evaluate(node.orelse))

    def choice(self, test: Value, then: Callable[[], Value], other: Callable[[], Value]) -> Value:
        """What a condition chooses."""
        if isinstance(test, Known):
            return then() if test.value else other()
        a, b = residual(then()), residual(other())
        kind = a.type if a.type == b.type else float  # type: ignore[attr-defined]
        return typed(ast.IfExp(test, a, b), kind)

    def _eval_Call(self, node: ast.Call) -> Value:
        target = self.evaluate(node.func)
        assert isinstance(target, Known), ast.unparse(node)
        function = target.value
        given: list[Value] = []
        for each in node.args:
            if isinstance(each, ast.Starred):
                given += self._elements(self.evaluate(each.value))
            else:
                given.append(self.evaluate(each))
        if function is np.asarray or function is float:
            return given[0]
        assert not node.keywords, ast.unparse(node)
        if function is np.where:
            return self.choice(given[0], lambda: given[1], lambda: given[2])
        if hasattr(function, "_fields"):
            defaults = function._field_defaults
            given += [Known(defaults[name]) for name in function._fields[len(given):]]
            return typed(ast.Call(ast.Name(function.__name__, ast.Load()), [residual(g) for g in given], []), function)
        if function in self.program._hooks:
            return self.program.called(function, given)
        if function is len and isinstance(given[0], ast.Tuple):
            return Known(len(given[0].elts))
        if all(isinstance(g, Known) for g in given) and not (
                isinstance(plain(function), types.FunctionType) and any(isinstance(
                    g.value, tuple) for g in given)):  # type: ignore[union-attr]
            value = function(*(g.value for g in given))  # type: ignore[union-attr]
            return Known(float(value) if isinstance(value, (np.floating, np.ndarray)) else value)
        if function in SAME:
            code = [residual(g) for g in given]
            name = SAME[function]
            kind = int if name == "int" or (name in ("abs", "min", "max") and all(
                c.type is int for c in code)) else float  # type: ignore[attr-defined]
            return typed(ast.Call(ast.Name(name, ast.Load()), code, []), kind)
        return self.program.called(function, given)


def plain(function: Any) -> Any:
    """The Python function of one that numba may have compiled."""
    return getattr(function, "py_func", function)


def typed(node: ast.expr, kind: Type) -> ast.expr:
    """An expression with its type noted."""
    node.type = kind  # type: ignore[attr-defined]
    return node


def field_of(value: ast.expr, name: str) -> ast.expr:
    """A field of a tuple."""
    kind = value.type  # type: ignore[attr-defined]
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name) and value.func.id == tuple_name(kind):
        return value.args[list(fields(kind)).index(name)]
    return typed(ast.Attribute(value, name, ast.Load()), fields(kind)[name])


def _known(value: ast.expr | Known) -> Value:
    return Known(value.value) if isinstance(value, ast.Constant) else value


def residual(value: Value) -> ast.expr:
    """A value as an expression."""
    if not isinstance(value, Known):
        return value
    x = value.value
    if isinstance(x, (bool, np.bool_)):
        return typed(ast.Constant(bool(x)), bool)
    if isinstance(x, (int, float, np.floating)):
        x = x if isinstance(x, int) else float(x)
        return typed(ast.Constant(x), type(x))
    if hasattr(x, "_fields"):
        parts = [residual(Known(each)) for each in x]
        return typed(ast.Call(ast.Name(type(x).__name__, ast.Load()), parts, []), type(x))
    if isinstance(x, tuple):
        parts = [residual(Known(each)) for each in x]
        return typed(ast.Tuple(parts, ast.Load()), tuple[tuple(p.type for p in parts)])  # type: ignore[attr-defined, misc]
    raise NotImplementedError(repr(x))


def fields(kind: Type) -> dict[str, Type]:
    """The fields of a tuple: name -> type."""
    if hasattr(kind, "_fields"):
        return dict(typing.get_type_hints(kind))
    return {f"_{k}": each for k, each in enumerate(typing.get_args(kind))}


def tuple_name(kind: Type) -> str:
    """A name for a tuple; that of its class if it has one."""
    if hasattr(kind, "_fields"):
        return str(kind.__name__)
    letters = {float: "d", int: "i", bool: "b"}
    return "Tuple_" + "".join(letters.get(each) or f"_{tuple_name(each)}" for each in typing.get_args(kind))


def annotation(written: Any, names: Mapping[str, Any]) -> Type:
    """The type that an annotation means; arrays are single numbers here."""
    kind = eval(written, dict(names)) if isinstance(written, str) else written  # noqa: S307 - of our own source
    kinds = [each for each in typing.get_args(kind) if each is not type(None)]
    if isinstance(kind, types.UnionType) and len(kinds) == 1:
        kind = kinds[0]
    if kind in (float, int, bool) or hasattr(kind, "_fields") or typing.get_origin(kind) is tuple:
        return kind
    return float


def _hashed(value: Any) -> Any:
    try:
        hash(value)
    except TypeError:
        return id(value)
    return value


def _names(value: Value) -> set[str]:
    """The variables of an expression."""
    return set() if isinstance(value, Known) else {n.id for n in ast.walk(value) if isinstance(n, ast.Name)}


def _alike(a: Value | None, b: Value | None) -> bool:
    if isinstance(a, Known) and isinstance(b, Known):
        return a.value is b.value or (type(a.value) is type(b.value) and bool(a.value == b.value))
    return not isinstance(a, Known) and not isinstance(b, Known)


def _statements(body: Iterable[ast.stmt]) -> Iterable[ast.stmt]:
    for s in body:
        yield s
        for inner in (getattr(s, "body", []), getattr(s, "orelse", [])):
            yield from _statements(inner)


def _written(body: Iterable[ast.stmt]) -> set[str]:
    """Names that statements assign."""
    return {node.id for s in body for node in ast.walk(s) if isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Store)}


def _without_unread(body: Sequence[ast.stmt], read: set[str]) -> list[ast.stmt]:
    kept: list[ast.stmt] = []
    for s in body:
        if isinstance(s, ast.Assign) and not _written([s]) & read:
            continue
        if isinstance(s, ast.If):
            inner, orelse = _without_unread(s.body, read), _without_unread(s.orelse, read)
            if not [each for each in inner + orelse if not isinstance(each, ast.Pass)]:
                continue
            s = ast.If(s.test, inner or [ast.Pass()], orelse)
        elif isinstance(s, ast.For):
            s = ast.For(s.target, s.iter, _without_unread(s.body, read) or [ast.Pass()], [], lineno=0)
        kept.append(s)
    return kept


def _ends(s: ast.stmt) -> bool:
    """Whether nothing after a statement runs."""
    if isinstance(s, ast.If):
        return bool(s.body and s.orelse) and _ends(s.body[-1]) and _ends(s.orelse[-1])
    return isinstance(s, ast.Return)


def _counts(body: Sequence[ast.stmt], name: str) -> bool:
    """Whether a loop uses its number as an index or an argument, so that it must be unrolled."""
    for s in body:
        for node in ast.walk(s):
            inside: list[ast.AST] = []
            if isinstance(node, ast.Subscript):
                inside = [node.slice]
            elif isinstance(node, ast.Call):
                inside = list(node.args)
            if any(isinstance(each, ast.Name) and each.id == name for part in inside for each in ast.walk(part)):
                return True
    return False
