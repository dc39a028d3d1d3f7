# SPDX-License-Identifier: Apache-2.0
"""The terms of effects by formula inside the compiled equations: one compiled simulation serves every formula.

A formula is compiled alone, in some milliseconds, and called by its address. So a new formula does not
compile the equations again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from aeropend_sim.compiled import njit
from aeropend_sim.errors import UserError
from aeropend_sim.model.compiled_formula import compiled
from aeropend_sim.model.effects import DEFINED, Effect, is_active
from aeropend_sim.model.formula import QUANTITIES

Array = NDArray[np.float64]

PLACES = ("actuator", "electrical", "rotor", "thrust", "arm", "rotor friction", "arm friction")
"""Where the equations take terms: the places of the chain, and the sizes of the dry friction at two of them."""

SLOTS = 4
"""Greatest number of effects by formula with a memory in one model. A choice."""

COLUMNS = 4
"""Columns of the table of `Terms.calls`."""

NUDGE = 1e-5
"""Relative change of a quantity by which a slope is taken (derived: about the cube root of rounding)."""


class Quantities(NamedTuple):
    """What a formula takes, at one instant; see `formula.QUANTITIES`."""

    theta: float
    theta_dot: float
    omega: float
    thrust: float
    i_a: float
    v: float
    t: float


class Terms(NamedTuple):
    """The terms of a model's effects by formula.

    Attributes:
        calls: address of a table of whole numbers, a row a term in the order of places: address of the term, address of
            the rate of its memory or 0, slot of the memory, address of its parameters.
        memories: number of effects with a memory.
        actuator: end of the rows of this place, and so on in the order of `PLACES`.
    """

    calls: int
    memories: int
    actuator: int
    electrical: int
    rotor: int
    thrust: int
    arm: int
    rotor_friction: int
    arm_friction: int


class _Held(Terms):
    """Terms that keep what their addresses point to; compiled code is faster with addresses than with arrays."""

    arrays: tuple[Any, ...]


Memory = tuple[float, float, float, float]
"""The states of the effects with a memory."""

EMPTY: Memory = (0.0,) * SLOTS  # type: ignore[assignment]
"""The memory at the start."""


def terms(effects: Mapping[str, Mapping[str, float]], places: Sequence[str] = PLACES) -> Terms | None:
    """The terms of the active effects by formula; None if there are none.

    Args:
        effects: effect id -> parameter name -> value, complete.
        places: of the chain, or readings, of which terms are wanted.

    Raises:
        UserError: more than `SLOTS` of them have a memory.
    """
    active = in_order(effects, places)
    if not active:
        return None
    rows = []
    for e, numbers, slot in active:
        own = tuple(e.parameters)
        rate = compiled(e.rate, own, e.memory).address if e.memory else 0
        rows.append((compiled(e.term, own, e.memory).address, rate, slot, list(numbers.values())))
    return _held(rows, [sum(_where(e) in places[:k + 1] for e, *_ in active) for k in range(len(PLACES))])


def in_order(effects: Mapping[str, Mapping[str, float]], places: Sequence[str] = PLACES
             ) -> list[tuple[Effect, dict[str, float], int]]:
    """The active effects by formula in the order of their rows in `Terms`, each with its parameters and its slot.

    Args:
        effects: effect id -> parameter name -> value, complete.
        places: of the chain, or readings, of which terms are wanted.

    Raises:
        UserError: more than `SLOTS` of them have a memory.
    """
    active = sorted(((e, p) for id_, p in effects.items() if (e := DEFINED.get(id_)) is not None and e.term
                     and _where(e) in places and is_active(id_, p)), key=lambda one: places.index(_where(one[0])))
    memories = [bool(e.memory) for e, _ in active]
    if sum(memories) > SLOTS:
        raise UserError(f"{sum(memories)} effects by formula with a memory; {SLOTS} are possible in one model")
    return [(e, {name: p.get(name, q.neutral) for name, q in e.parameters.items()}, min(sum(memories[:k]), SLOTS - 1))
            for k, (e, p) in enumerate(active)]


def _where(e: Effect) -> str:
    """Where the equations, or a reading, take the term of an effect."""
    return e.reading or (f"{e.place} friction" if e.sticks else e.place)


def _held(rows: Sequence[tuple[int, int, int, Sequence[float]]], ends: Sequence[int]) -> Terms:
    """Terms by the addresses of term and rate, slot of the memory and parameters; and the end of each place.

    Raises:
        ValueError: a term has no address, since it is no formula.
    """
    if not all(term for term, *_ in rows):
        raise ValueError("a term that is no formula cannot be called")
    numbers = np.array([float(x) for *_, own in rows for x in own])
    calls, at = np.zeros((len(rows), COLUMNS), dtype=np.int64), numbers.ctypes.data
    for call, (term, rate, slot, own) in zip(calls, rows, strict=True):
        call[:] = term, rate, slot, at
        at += 8 * len(own)
    held = _Held(calls.ctypes.data, sum(rate != 0 for _, rate, *_ in rows), *ends)
    held.arrays = calls, numbers
    return held


@intrinsic
def _call(_typing: Any, address: Any, q: Any, memory: Any, numbers: Any) -> Any:
    """Call a compiled formula by its address."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        address, q, memory, numbers = arguments
        number = ir.DoubleType()
        function = ir.FunctionType(number, [number] * (len(QUANTITIES) + 1) + [number.as_pointer()])
        target = builder.inttoptr(address, function.as_pointer())
        own = [builder.extract_value(q, k) for k in range(len(QUANTITIES))]
        return builder.call(target, [*own, memory, builder.inttoptr(numbers, number.as_pointer())])

    return types.float64(address, q, memory, numbers), generate


@intrinsic
def _entry(_typing: Any, table: Any, row: Any, column: Any) -> Any:  # noqa: ARG001 - numba gives their types
    """Entry of a table of four columns at an address."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        table, row, column = arguments
        whole = ir.IntType(64)
        at = builder.add(builder.mul(row, whole(COLUMNS)), column)
        return builder.load(builder.gep(builder.inttoptr(table, whole.as_pointer()), [at]))

    return types.int64(types.int64, types.int64, types.int64), generate


@njit(forceinline=True, error_model="numpy")
def term_sum(first: int, end: int, q: Quantities, memory: Memory, x: Terms) -> float:
    """Sum of some terms.

    Args:
        first: row of the first.
        end: row after the last.
        q: quantities.
        memory: states of the effects with a memory.
        x: terms.
    """
    total = 0.0
    for j in range(first, end):
        own = memory[_entry(x.calls, j, 2)] if x.memories > 0 else 0.0
        total += _call(_entry(x.calls, j, 0), q, own, _entry(x.calls, j, 3))
    return total


@njit(forceinline=True, error_model="numpy")
def _put(memory: Memory, slot: int, value: float) -> Memory:
    return (value if slot == 0 else memory[0], value if slot == 1 else memory[1],
            value if slot == 2 else memory[2], value if slot == 3 else memory[3])


@njit(forceinline=True, error_model="numpy")
def remembered(memory: Memory, near: Memory, q: Quantities, h: float, x: Terms) -> Memory:
    """The memories after a time, by the exponential Rosenbrock-Euler method: each rate is made linear in its memory.

    Args:
        memory: at the start.
        near: around which the rates are made linear.
        q: quantities, constant.
        h: [s] time.
        x: terms.
    """
    out = memory
    for j in range(x.arm_friction):
        rate = _entry(x.calls, j, 1)
        if rate != 0:
            slot, numbers = _entry(x.calls, j, 2), _entry(x.calls, j, 3)
            m0, z = memory[slot], near[slot]
            nudge = NUDGE * max(abs(z), 1e-3)
            here = _call(rate, q, z, numbers)
            slope = (_call(rate, q, z + nudge, numbers) - here) / nudge
            a = slope * h
            weight = np.expm1(a) / a if abs(a) > 1e-8 else 1.0 + 0.5 * a
            out = _put(out, slot, m0 + h * weight * (here + slope * (m0 - z)))
    return out


@njit(nogil=True, error_model="numpy")
def _series(values: Array, h: float, x: Terms, held: Array, out: Array) -> None:
    memory = (held[0], held[1], held[2], held[3])
    for k in range(values.shape[1]):
        q = Quantities(values[0, k], values[1, k], values[2, k], values[3, k], values[4, k], values[5, k],
                       values[6, k])
        out[k] = term_sum(0, x.arm_friction, q, memory, x)
        if x.memories > 0:
            middle = remembered(memory, memory, q, 0.5 * h, x)
            memory = remembered(memory, middle, q, h, x)
    held[0], held[1], held[2], held[3] = memory


def series(effects: Mapping[str, Mapping[str, float]], place: str, count: int, period: float, start: float = 0.0,
           memory: Array | None = None, **known: Array) -> Array:
    """Sum of the terms at a place over a recording, from quantities at its samples.

    Args:
        effects: effect id -> parameter name -> value, complete.
        place: of the chain, or the reading of terms at place `sensing`.
        count: N, number of samples.
        period: [s] time between samples.
        start: [s] time of the first sample.
        memory: (SLOTS,) states of the effects with a memory at the first sample; afterwards those for the sample after
            the last. None: from 0 on.
        **known: quantities by name, (N,) each or scalar; the others are 0, the time from `start` on.

    Returns:
        (N,) sum.
    """
    x = terms(effects, (place,))
    return np.zeros(count) if x is None else _along(x, count, period, known, start, memory)


def along(text: str, parameters: Mapping[str, float], count: int, period: float, memory: str = "", rate: str = "",
          **known: Array) -> Array:
    """Value of a formula over a recording.

    Args:
        text: the formula.
        parameters: by name.
        count: N, number of samples.
        period: [s] time between samples.
        memory: name of its memory; "" for none.
        rate: formula of the derivative of that memory.
        **known: as for `series`.

    Returns:
        (N,) values.
    """
    names = tuple(parameters)
    addresses = [compiled(each, names, memory).address if each else 0 for each in (text, rate)]
    return _along(_held([(addresses[0], addresses[1], 0, list(parameters.values()))], [1] * len(PLACES)), count, period,
                  known)


def _along(x: Terms, count: int, period: float, known: Mapping[str, Array], start: float = 0.0,
           memory: Array | None = None) -> Array:
    values, out = np.zeros((len(QUANTITIES), count)), np.zeros(count)
    for row, name in zip(values, QUANTITIES, strict=True):
        row[:] = known.get(name, start + np.arange(count) * period if name == "t" else 0.0)
    _series(values, period, x, np.zeros(SLOTS) if memory is None else memory, out)
    return out
