# SPDX-License-Identifier: Apache-2.0
"""Columns that are computed from others: errors, copies, derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeropend_ident.tables.names import STRONG
from aeropend_ident.tables.seen import Seen, says
from aeropend_ident.tables.table import Floats, Table
from aeropend_ident.tables.traits import Origin, differences, is_error, origins
from aeropend_ident.tables.units import known

FOLLOWS = -4.0
"""[nats] Log odds of a column that is computed from another one (choice: 50 to 1)."""

OF_THE_MOTOR = ("omega", "current")
"""Quantities that are measured, although they may be late copies of the command."""


@dataclass(frozen=True)
class Explained:
    """Columns that are computed from others.

    Attributes:
        why: how each follows, in words.
        odds: [nats] log odds of angle or command for each.
        loops: triples of which one is the difference of the others, as reference, angle and error.
        late: late copies -> the column that they copy.
    """

    why: dict[int, str]
    odds: dict[int, float]
    loops: list[tuple[int, int, int]]
    late: dict[int, int]


def explain(table: Table, seen: list[Seen], numbers: dict[int, Floats]) -> Explained:
    """Recognise columns that are computed from others.

    Args:
        table: the table.
        seen: its columns.
        numbers: of the columns to compare: number of the column -> (N,) values without gaps.
    """
    odds: dict[int, float] = {}
    late: dict[int, int] = {}
    why: dict[int, str] = {}
    loops, errors = [], set()
    for trio in differences(numbers):
        k = _error_of(seen, numbers, trio)
        why[k] = "the difference of columns {} and {}".format(*(table.label(j) for j in trio if j != k))
        errors.add(k)
        loops.append(trio)
        odds |= {j: FOLLOWS for j in trio if j == k or seen[j].traits.holds or (  # the reference, then
            seen[j].meaning.quantity == "reference")}
    hidden = [k for k in numbers if not any(k in trio for trio in loops) and not seen[k].traits.holds
              and seen[k].meaning.quantity not in ("theta", "duty", "voltage") and any(
                  is_error(table.columns[k].values, table.columns[j].values)
                  and (says(seen[j], "theta") > 0.0 or (len(numbers) == 2 and k > j)) for j in numbers if j != k)]
    for k in hidden:
        why[k] = "what is missing to a reference that jumps and holds"
        odds[k] = FOLLOWS
    rest = [k for k in numbers if k not in errors and k not in hidden]
    said = {"same": "the same as", "filtered": "a filtered copy of", "late": "a late copy of",
            "noisy": "a noisy copy of", "derivative": "a derivative of"}
    for k, origin in _ordered(seen, origins([one.traits for one in seen], rest)).items():
        if seen[k].meaning.quantity in OF_THE_MOTOR and seen[k].meaning.odds >= STRONG:
            continue  # the motor follows the command
        commanded = [seen[j].meaning.quantity in ("duty", "voltage") for j in (k, origin.of)]
        if origin.how in said and commanded != [True, False]:  # a controller makes its command of the angle
            why[k] = f"{said[origin.how]} column {table.label(origin.of)}"
            odds[k] = FOLLOWS
            late |= {k: origin.of} if origin.how == "late" else {}
    return Explained(why, odds, loops, late)


def _error_of(seen: list[Seen], numbers: dict[int, Floats], trio: tuple[int, int, int]) -> int:
    """Which of three columns is the error: by its name, or for it jumps with the reference, and does not hold."""
    named = [k for k in trio if seen[k].meaning.quantity == "error"]
    rest = named or [k for k in trio if seen[k].meaning.quantity not in ("theta", "reference", "duty")] or list(trio)
    moving = [k for k in rest if not seen[k].traits.holds] or rest
    if len(moving) == len(trio):  # a smooth reference: the error is small
        return min(moving, key=lambda k: float(np.mean(numbers[k] ** 2)))
    return max(moving, key=lambda k: float(np.abs(np.diff(numbers[k])).max()))


def _ordered(seen: list[Seen], found: dict[int, Origin]) -> dict[int, Origin]:
    """Of two columns that follow from each other, that with the clearer name and unit stays."""
    out = {}
    for k, origin in found.items():
        clearer = _clarity(seen[k]) > _clarity(seen[origin.of])
        named = clearer and seen[origin.of].meaning.quantity not in ("", "theta", "duty")
        if (origin.how == "same" and clearer) or named:
            out[origin.of] = Origin(k, origin.how)
        else:
            out[k] = origin
    return out


def _clarity(one: Seen) -> float:
    """How clearly name and unit say that a column is the angle or the command."""
    unit = one.column.unit
    of_arm = bool(unit) and bool(known("theta", unit) or known("duty", unit))
    return one.meaning.odds * (one.meaning.quantity in ("theta", "duty")) + of_arm
