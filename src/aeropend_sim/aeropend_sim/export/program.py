# SPDX-License-Identifier: Apache-2.0
"""A model as a program: the functions of `plant_step` with its parameters put in, effects by formula included."""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aeropend_sim.export import plant_step
from aeropend_sim.export.specialise import Known, Program, Type, Value, field_of
from aeropend_sim.model import terms as model_terms
from aeropend_sim.model.arm import sine_cosine
from aeropend_sim.model.effects import Effect
from aeropend_sim.model.formula import CONSTANTS, FUNCTIONS, QUANTITIES, parse
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.untrusted import one_line

TERM, RATE, SLOT = range(3)
"""Columns of `Terms.calls`."""


def _library_sine_cosine(x: float) -> tuple[float, float]:
    """(sin x, cos x)."""
    return math.sin(x), math.cos(x)


MEMORY = "_memory"
"""Name of the memory of an effect in its formulas; no effect file can define it."""


class _Formulas:
    """Functions of a model's effects by formula; the hooks by which the equations call them."""

    def __init__(self) -> None:
        self._rows: dict[int, list[tuple[Effect, dict[str, float], int]]] = {}

    def hold(self, terms: model_terms.Terms | None, effects: Mapping[str, Mapping[str, float]],
             places: Sequence[str]) -> None:
        """Note which effects the rows of `terms` are."""
        if terms is not None:
            self._rows[terms.calls] = model_terms.in_order(effects, places)

    def entry(self, _program: Program, given: Sequence[Value]) -> Value:
        """`terms._entry`."""
        table, row, column = (g.value for g in given)  # type: ignore[union-attr]
        effect, numbers, slot = self._rows[table][row]
        if column == SLOT:
            return Known(slot)
        if column == RATE and not effect.memory:
            return Known(0)
        return Known(_Called(effect, numbers, rate=column == RATE))

    def call(self, program: Program, given: Sequence[Value]) -> Value:
        """`terms._call`."""
        which, q, memory = given[:3]
        called = which.value  # type: ignore[union-attr]
        effect = called.effect
        values = {name: Known(getattr(q.value, name)) if isinstance(q, Known) else field_of(q, name)
                  for name in QUANTITIES}
        if effect.memory:
            values[MEMORY] = memory
        arguments: dict[str, Type] = dict.fromkeys(values, float)
        known = {**CONSTANTS, **called.numbers, **{name: f.call for name, f in FUNCTIONS.items()}}
        text, name, doc = effect.term, f"term_{effect.id}", effect.physics
        if called.rate:
            text, name, doc = effect.rate, f"rate_{effect.id}", f"d{effect.memory}/dt of {effect.id}"
        tree = _Coded(effect.memory).visit(parse(text, [*QUANTITIES, effect.memory, *called.numbers]).expression)
        return program.call(program.formula(name, tree, arguments, known, in_comment(doc)), values)


@dataclass(frozen=True)
class _Called:
    """What stands for the address of a formula: the term of an effect, or the rate of its memory."""

    effect: Effect
    numbers: dict[str, float]
    rate: bool


class _Coded(ast.NodeTransformer):
    """Whole numbers of a formula are floats, as in `compiled_formula`; the memory gets a name that nothing else has."""

    def __init__(self, memory: str) -> None:
        self.memory = memory

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return ast.Constant(float(node.value))  # type: ignore[arg-type]

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.Name(MEMORY, ast.Load()) if node.id == self.memory else node


def in_comment(text: str) -> str:
    """A text of unknown origin for a comment of C or a docstring of Python, which it cannot end.

    Args:
        text: of a model file.
    """
    return one_line(text).replace("\\", "/").replace("*/", "* /").replace("/*", "/ *").replace('"', "'")


def build(model: Model, period: float = SAMPLE_PERIOD, *, library_sine: bool = False,
          functions: Sequence[Any] = plant_step.FUNCTIONS) -> Program:
    """A model as a program.

    Args:
        model: parameters and effects.
        period: [s] time between samples.
        library_sine: call sin and cos of the library, which differ from the model's own by 1e-15.
        functions: of `plant_step` that the program offers.
    """
    known = plant_step.known(model, period)
    formulas = _Formulas()
    formulas.hold(known.added, model.effects, model_terms.PLACES)
    for terms, reading in ((known.wrong_angle, "theta"), (known.wrong_current, "i_a"), (known.wrong_voltage, "v_a")):
        formulas.hold(terms, model.effects, (reading,))
    hooks = {model_terms._entry: formulas.entry, model_terms._call: formulas.call}
    program = Program(functions, hooks, {sine_cosine: _library_sine_cosine} if library_sine else {})
    for function in functions:
        program.add(function, {"k": known})
    return program

