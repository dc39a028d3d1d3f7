# SPDX-License-Identifier: Apache-2.0
"""A column as `guess` sees it: what its name and unit say, and what its numbers say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aeropend_ident.tables.names import STRONG, Meaning, meaning, whole_words
from aeropend_ident.tables.table import Column, Table
from aeropend_ident.tables.traits import Traits, traits
from aeropend_ident.tables.units import known, split_name

LEAST_SPEED = 20.0
"""Least maximum of a motor speed, in rad/s or rpm (choice: at 20 rad/s a propeller lifts 1 % of that at 200)."""


@dataclass(frozen=True, eq=False)
class Seen:
    """All that is known about a column."""

    column: Column
    meaning: Meaning
    traits: Traits
    words: tuple[str, ...]
    counts: bool
    """Whether the numbers may be counts: they are whole, and not written with decimals."""


def look_at(table: Table) -> list[Seen]:
    """All that is known about each column of a table."""
    out = []
    for k, column in enumerate(table.columns):
        x = column.values[np.isfinite(column.values)]
        decimals = table.lengths is not None and any("." in cell or "," in cell for cell in column.shown)
        meant = _meaning(table, k)
        if meant.quantity == "omega" and not column.unit and len(x) and np.abs(x).max() < LEAST_SPEED:
            meant = Meaning()  # giriş, an input, may have lost its last letter: giri is the speed of a motor
        out.append(Seen(column, meant, traits(column.values), tuple(whole_words(column.name)),
                        not decimals and bool((x == np.rint(x)).all())))
    return out


def _meaning(table: Table, k: int) -> Meaning:
    """What the name of a column means; that of a matrix does not tell which of its columns is which."""
    columns = [split_name(column.name)[0] if column.unit else column.name for column in table.columns]
    name = columns[k]
    series = name.rstrip("0123456789")
    if series != name and sum(other.rstrip("0123456789") == series != other for other in columns) > 2:
        return Meaning()  # x1, x2, x3
    stem = name.rpartition("[")[0]
    same = [other for other in columns if stem and other.rpartition("[")[0] == stem and other.endswith("]")]
    if name.endswith("]") and same[2:]:
        return Meaning()
    if name.endswith("]") and same[1:] and name == same[0]:
        return Meaning()  # the time, where there are two
    return meaning(table.columns[k].name, table.columns[k].unit)


def says(one: Seen, quantity: str) -> float:
    """[nats] What name and unit say about a quantity."""
    odds = 0.0
    if one.meaning.quantity == quantity:
        odds = one.meaning.odds
    elif one.meaning.quantity == "voltage" and quantity == "duty":
        odds = 0.0
    elif one.meaning.quantity:
        odds = -one.meaning.odds
    unit = one.column.unit
    if unit and unit not in ("1", "-"):
        if known(quantity, unit) or (quantity == "theta" and unit.casefold() in ("counts", "ticks", "lsb")):
            odds += STRONG
        elif not (quantity == "duty" and (known("voltage", unit) or known("time", unit) == "us"
                                          or unit.casefold() in ("counts", "ticks", "lsb"))):
            odds -= STRONG
    return odds
