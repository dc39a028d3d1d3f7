# SPDX-License-Identifier: Apache-2.0
"""The decision thresholds of the diagnosis, found in the source.

A threshold is a number at the level of a module whose name is in upper case, a limit of a pair whose docstring begins
with "Range", or a numeric field of a policy. Left out is what its docstring marks as (format), (layout) or (memory).
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from itertools import pairwise
from types import ModuleType
from typing import Any, TypeGuard

from aeropend_ident.diagnosis import policy

PACKAGES = ("aeropend_ident.signals", "aeropend_ident.estimation", "aeropend_ident.diagnosis")
"""Packages whose modules hold thresholds."""

ORIGINS = ("derived", "convention", "choice", "measured")
"""Words that name the origin of a threshold: after an opening parenthesis, or at the begin of a sentence."""

LEFT_OUT = ("(format)", "(layout)", "(memory)")
"""Marks in the docstrings of numbers that decide nothing about a recording."""

POLICIES = ("CALIBRATED", "UNCALIBRATED", "FREE_DECAY")
"""Names of the policies in `diagnosis.policy`."""

IN_0_TO_1 = ("probability", "share", "part of")
"""First words of the docstring of a number that lies between 0 and 1."""

UNIT = re.compile(r"\[([^\]]*)\]\s*")
"""The unit in brackets that a docstring begins with."""


@dataclass(frozen=True)
class Threshold:
    """A decision threshold.

    Attributes:
        module: that defines it.
        name: in the module; of a policy with the field, as in CALIBRATED.unknown.form.
        value: its number.
        unit: "" for a pure number.
        text: its docstring without the unit.
        origins: the words of `ORIGINS` that the docstring has.
    """

    module: str
    name: str
    value: float
    unit: str
    text: str
    origins: tuple[str, ...]

    @property
    def id(self) -> str:
        """Module below `aeropend_ident`, and name."""
        return f"{self.module.partition('.')[2]}.{self.name}"

    @property
    def constant(self) -> str:
        """The name in the module that holds it."""
        return re.split(r"[.\[]", self.name)[0]

    @property
    def field(self) -> tuple[str, ...]:
        """Names of the fields that lead to it in a policy."""
        return tuple(self.name.split(".")[1:])

    @property
    def place(self) -> int | None:
        """Its place in a pair."""
        return int(self.name[-2]) if self.name.endswith("]") else None

    def scaled(self, factor: float) -> float:
        """The value for a factor on it.

        A whole number is rounded and changes by 1 at least. Between 0 and 1 it is the distance to the nearer of 0 and 1
        that is scaled: 0.9 becomes 0.93 or 0.87.
        """
        if isinstance(self.value, int):
            step = max(round(abs(factor - 1.0) * self.value), 1)
            return max(self.value + (step if factor > 1.0 else -step), 0)
        if self.text.lower().startswith(IN_0_TO_1) and 0.5 < self.value < 1.0:
            return 1.0 - (1.0 - self.value) * factor
        return self.value * factor


def modules() -> list[ModuleType]:
    """All modules of `PACKAGES`, imported."""
    found = []
    for name in PACKAGES:
        package = importlib.import_module(name)
        found += [importlib.import_module(m.name) for m in pkgutil.walk_packages(package.__path__, f"{name}.")
                  if not m.ispkg]
    return found


def thresholds() -> list[Threshold]:
    """Every decision threshold, in the order of the source."""
    return [t for module in modules() for t in thresholds_of(module)]


def thresholds_of(module: ModuleType) -> list[Threshold]:
    """The decision thresholds of one module."""
    return [*_of_module(module), *_of_policies(module)]


@cache
def tree(module: ModuleType) -> ast.Module:
    """The source of a module, parsed."""
    return ast.parse(inspect.getsource(module))


def assigned(statement: ast.stmt) -> list[str]:
    """Names that a statement at the level of a module assigns to."""
    if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and statement.value:
        return [statement.target.id]
    if isinstance(statement, ast.Assign):
        return [n.id for target in statement.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    return []


def _of_module(module: ModuleType) -> Iterator[Threshold]:
    body = tree(module).body
    for statement, after in zip(body, [*body[1:], None]):
        text = _string(after)
        if any(mark in text for mark in LEFT_OUT):
            continue
        for name in assigned(statement):
            value = getattr(module, name, None)
            if not name.isupper():
                continue
            if _is_number(value):
                yield _threshold(module, name, value, text)
            elif isinstance(value, tuple) and len(value) == 2 and text.startswith("Range"):
                for k, limit in enumerate(value):
                    yield _threshold(module, f"{name}[{k}]", limit, text)


def _of_policies(module: ModuleType) -> Iterator[Threshold]:
    if module is not policy:
        return
    body = tree(module).body
    for statement, after in pairwise(body):
        for name in set(assigned(statement)) & set(POLICIES):
            yield from _of_fields(module, name, getattr(policy, name), _string(after))


def _of_fields(module: ModuleType, name: str, holder: Any, below: str) -> Iterator[Threshold]:
    """Thresholds of a policy or its limits; `below`: its docstring, with the origin of fields that name none."""
    texts = _attributes(type(holder))
    for field in fields(holder):
        value = getattr(holder, field.name)
        if is_dataclass(value):
            yield from _of_fields(module, f"{name}.{field.name}", value, below)
        elif _is_number(value):
            text = texts.get(field.name, "")
            found = _threshold(module, f"{name}.{field.name}", value, text)
            yield found if found.origins else replace(found, origins=_origins(below))


def _attributes(holder: type) -> dict[str, str]:
    """Attribute -> its text in the docstring of a class."""
    section = inspect.cleandoc(holder.__doc__ or "").partition("Attributes:")[2]
    entries = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
    return {name: re.sub(r"\s+", " ", text) for name, text in entries}


def _threshold(module: ModuleType, name: str, value: float, text: str) -> Threshold:
    unit = UNIT.match(text)
    return Threshold(module.__name__, name, value, unit[1] if unit else "", UNIT.sub("", text, count=1), _origins(text))


def _origins(text: str) -> tuple[str, ...]:
    return tuple(o for o in ORIGINS if re.search(rf"\({o}\b|\b{o.capitalize()}[:;,]", text))


def _string(statement: ast.stmt | None) -> str:
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant) and isinstance(
            statement.value.value, str):
        return inspect.cleandoc(statement.value.value)
    return ""


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
