# SPDX-License-Identifier: Apache-2.0
"""Which recordings a threshold can act on: those whose diagnosis runs a line that reads it.

Where no such line runs, the verdict cannot depend on the threshold, and nothing is computed again.
"""

from __future__ import annotations

import ast
import dataclasses
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any
from unittest import mock

from aeropend_ident.diagnosis import diagnosis, policy
from evaluation.sensitivity.changed import aliases, changed, defaults, loaded, uses
from evaluation.sensitivity.thresholds import POLICIES, Threshold, assigned, tree

Line = tuple[str, int]
"""Name of a module and number of a line; or a policy with a field, as in CALIBRATED.undecided, and 0."""

BEFORE, AFTER = "before", "after"
"""Parts of a diagnosis: up to the identified nominal model of an uncalibrated rig, and from there on."""


def lines_of(threshold: Threshold) -> set[Line]:
    """Lines that read a threshold. A field of a policy has one entry, under its name."""
    if threshold.field:
        return {(threshold.name, 0)}
    found: set[Line] = set()
    for holder, alias in aliases(threshold.module, threshold.constant):
        source = tree(holder)
        for node in ast.walk(source):
            if isinstance(node, ast.Name) and node.id == alias and isinstance(node.ctx, ast.Load):
                found.add((holder.__name__, node.lineno))
        for function, _ in defaults(holder, source, alias):
            code = function.__code__
            found |= {(holder.__name__, line) for *_, line in code.co_lines() if line is not None}
        for statement in source.body:  # constants that are computed from it
            names = assigned(statement)
            if names and names != [alias] and uses(statement.value, alias):  # type: ignore[attr-defined]
                found |= {(f"{names[0]}.{field}", 0) for field in _fields()}
    for other in loaded():  # read as an attribute of its module
        for node in ast.walk(tree(other)):
            if isinstance(node, ast.Attribute) and node.attr == threshold.constant:
                found.add((other.__name__, node.lineno))
    return found


def _fields() -> Iterator[str]:
    """Names of all numbers of a policy."""
    for field in dataclasses.fields(policy.Policy):
        yield field.name
    for field in dataclasses.fields(policy.UnknownLimits):
        yield f"unknown.{field.name}"


@contextmanager
def watched() -> Iterator[dict[str, set[Line]]]:
    """Collect the lines of the diagnosis that run during a block, and the fields of policies that are read."""
    modules = {str(m.__file__): m.__name__ for m in loaded()}
    seen: dict[str, set[Line]] = {BEFORE: set(), AFTER: set()}
    part = [BEFORE]

    def on_call(frame: FrameType, event: str, argument: Any) -> Callable[..., Any] | None:
        del event, argument
        module = modules.get(frame.f_code.co_filename)
        if module is None:
            return None

        def on_line(frame: FrameType, event: str, argument: Any) -> Callable[..., Any]:
            del event, argument
            seen[part[0]].add((module, frame.f_lineno))
            return on_line

        seen[part[0]].add((module, frame.f_lineno))
        return on_line

    def begin(*arguments: Any, **options: Any) -> Any:
        part[0] = AFTER
        return rest(*arguments, **options)

    rest = diagnosis.policy_of
    with ExitStack() as stack:
        for name in POLICIES:
            spied = _spied(getattr(policy, name), name, lambda field: seen[part[0]].add((field, 0)))
            stack.enter_context(changed(policy.__name__, name, spied))
        stack.enter_context(mock.patch.object(diagnosis, "policy_of", begin))
        threading.settrace(on_call)
        sys.settrace(on_call)
        try:
            yield seen
        finally:
            sys.settrace(None)
            threading.settrace(None)


def _spied(holder: Any, name: str, read: Callable[[str], None]) -> Any:
    """A copy of a policy, or of its limits, that reports each field that is read."""
    numbers = {f.name: getattr(holder, f.name) for f in dataclasses.fields(holder)}
    numbers = {k: _spied(v, f"{name}.{k}", read) if dataclasses.is_dataclass(v) else v for k, v in numbers.items()}

    class Spied(type(holder)):  # type: ignore[misc]
        def __getattribute__(self, field: str) -> Any:
            if field in numbers:
                read(f"{name}.{field}")
            return super().__getattribute__(field)

    return Spied(**numbers)
