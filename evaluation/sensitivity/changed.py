# SPDX-License-Identifier: Apache-2.0
"""A threshold with another value, in every module that holds it.

A constant is bound by its own module, by modules that imported its name, as default of arguments, and in constants that
were computed from it. All of them follow the change. Functions compiled by numba would not, but none reads a threshold.
"""

from __future__ import annotations

import ast
import dataclasses
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FunctionType, ModuleType
from typing import Any

from evaluation.sensitivity.thresholds import PACKAGES, Threshold, assigned, modules, tree

Binding = tuple[Any, str, Any]
"""Object, attribute, and the new value of the attribute."""


def new_constant(threshold: Threshold, value: float) -> Any:
    """What the threshold's constant becomes: a number, a pair or a policy."""
    old = getattr(sys.modules[threshold.module], threshold.constant)
    if threshold.place is not None:
        return tuple(value if k == threshold.place else x for k, x in enumerate(old))
    return _replaced(old, threshold.field, value) if threshold.field else value


@contextmanager
def changed(module: str, name: str, value: Any) -> Iterator[list[Binding]]:
    """Give a constant another value wherever it is bound, for the time of a block; yields the changed names."""
    undo: list[Binding] = []
    try:
        _bind(sys.modules[module], name, value, undo)
        yield undo
    finally:
        for holder, attribute, old in reversed(undo):
            setattr(holder, attribute, old)


def aliases(module: str, name: str) -> list[tuple[ModuleType, str]]:
    """The module and those that imported the name, each with the name that it has there."""
    found = [(sys.modules[module], name)]
    for other in loaded():
        for node in tree(other).body:
            if isinstance(node, ast.ImportFrom) and node.module == module:
                found += [(other, a.asname or a.name) for a in node.names if a.name == name]
    return found


def loaded() -> list[ModuleType]:
    """The modules that thresholds act in."""
    modules()
    return [m for n, m in list(sys.modules.items()) if n.startswith(tuple(f"{p}." for p in PACKAGES))
            and getattr(m, "__file__", None) and not hasattr(m, "__path__")]


def _bind(module: ModuleType, name: str, value: Any, undo: list[Binding]) -> None:
    for holder, alias in aliases(module.__name__, name):
        undo.append((holder, alias, getattr(holder, alias)))
        setattr(holder, alias, value)
        source = tree(holder)
        for function, k in defaults(holder, source, alias):
            undo.append((function, "__defaults__", function.__defaults__))
            old = function.__defaults__ or ()
            function.__defaults__ = (*old[:k], value, *old[k:][1:])
        for statement in source.body:
            made = assigned(statement)
            if len(made) == 1 and made[0] != alias and uses(statement.value, alias):  # type: ignore[attr-defined]
                code = compile(ast.Expression(statement.value), str(holder.__file__), "eval")  # type: ignore[attr-defined]
                _bind(holder, made[0], eval(code, vars(holder)), undo)


def uses(node: ast.AST, name: str) -> bool:
    """Whether an expression reads a name, outside of functions."""
    return not isinstance(node, ast.Lambda) and (
        (isinstance(node, ast.Name) and node.id == name) or any(uses(n, name) for n in ast.iter_child_nodes(node)))


def defaults(module: ModuleType, source: ast.Module, name: str) -> list[tuple[FunctionType, int]]:
    """Functions of a module that have a name as the default of an argument, with the place of the default."""
    found = []
    for statement in source.body:
        inner = statement.body if isinstance(statement, ast.ClassDef) else [statement]
        holder = getattr(module, statement.name) if isinstance(statement, ast.ClassDef) else module
        for node in inner:
            if isinstance(node, ast.FunctionDef):
                function = getattr(holder, node.name)
                found += [(getattr(function, "__func__", function), k) for k, default in enumerate(node.args.defaults)
                          if isinstance(default, ast.Name) and default.id == name]
    return found


def _replaced(holder: Any, field: tuple[str, ...], value: float) -> Any:
    if len(field) > 1:
        value = _replaced(getattr(holder, field[0]), field[1:], value)
    return dataclasses.replace(holder, **{field[0]: value})
