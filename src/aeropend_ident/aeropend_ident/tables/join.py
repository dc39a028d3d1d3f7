# SPDX-License-Identifier: Apache-2.0
"""Several files of one experiment as one table: a row takes the last value that each file has at its time.

Nothing is interpolated. The rows are those of the first file, which is to hold the angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aeropend_ident.tables.guess import time_of
from aeropend_ident.tables.table import Column, Floats, Ints, Table, TableError

Clock = tuple[int, float | None] | None
"""The time of a table, as `time_of` gives it."""


def join(tables: Sequence[Table]) -> Table:
    """Join the tables of several files.

    Args:
        tables: that with the angle first; its rows stay.

    Raises:
        TableError: the times of a file are not clear; one line.
    """
    first, notes = tables[0], list(tables[0].notes)
    clock = time_of(first)
    number = None if clock is None else clock[0]
    rest = [(first, k, column) for k, column in enumerate(first.columns) if k != number]
    columns = [] if number is None else [first.columns[number]]
    for other in tables[1:]:
        theirs = time_of(other)
        rows, how = _rows(first, clock, other, theirs)
        signals = [k for k in range(len(other.columns)) if theirs is None or k != theirs[0]]
        notes += [f"{other.path.name}: {note}" for note in (*other.notes, how)]
        rest += [(other, k, _taken(other.columns[k], rows)) for k in signals]
    names = [column.name for _, _, column in rest]
    for table, k, column in rest:
        clash = names.count(column.name) > 1
        name = f"{table.path.stem}.{column.name or k + 1}" if clash and column.name else column.name
        if not name:
            single = sum(one is table for one, _, _ in rest) == 1
            name = table.path.stem if single else f"{table.path.stem}.{k + 1}"
        columns.append(replace(column, name=name))
    return Table(first.path, tuple(columns), first.lines, tuple(notes), first.lengths, first.bad, first.complaint)


def _rows(first: Table, mine: Clock, other: Table, theirs: Clock) -> tuple[Ints, str]:
    """The row of the other table for each row of the first, -1 for none; and how they were found."""
    if mine is None or theirs is None:
        if len(first) != len(other):
            missing = first if mine is None else other
            raise TableError(f"{missing.path}: no time is found in it, and it has {len(missing)} rows, not as many as "
                             "the file that it belongs to: add a column of the time")
        return np.arange(len(first)), "joined row by row"
    a, b = first.columns[mine[0]].values, other.columns[theirs[0]].values
    if len(a) == len(b) and bool(((a == b) | (np.isnan(a) & np.isnan(b))).all()):
        return np.arange(len(first)), "joined by its stamps, which are the same"
    for table, clock in ((first, mine), (other, theirs)):
        if clock[1] is None:
            raise TableError(f"{table.path}: the unit of its time is not clear, so that files cannot be joined: write "
                             "it into the name, as in 'time [ms]'")
    assert mine[1] is not None
    assert theirs[1] is not None
    return _held(mine[1] * a, theirs[1] * b, other)


def _held(a: Floats, b: Floats, other: Table) -> tuple[Ints, str]:
    known = np.flatnonzero(np.isfinite(b))
    order = known[np.argsort(b[known], kind="stable")]
    place = np.searchsorted(b[order], np.nan_to_num(a, nan=-np.inf) + 1e-9, side="right") - 1
    rows = np.where(place >= 0, order[np.maximum(place, 0)], -1)
    late = a > b[order[-1]] + 2.0 * float(np.median(np.abs(np.diff(b[order])))) if len(order) > 1 else a > b[order[-1]]
    rows[late] = -1
    found = rows >= 0
    if not found.any():
        raise TableError(f"{other.path}: its times ({b[order[0]]:.6g} to {b[order[-1]]:.6g} s) are not those of the "
                         f"first file ({np.nanmin(a):.6g} to {np.nanmax(a):.6g} s)")
    old = float((a[found] - b[rows[found]]).max())
    missing = f"; {int((~found).sum())} rows are outside of its times" if not found.all() else ""
    return rows, f"joined by its stamps: each row takes the last value before it, up to {1e3 * old:.4g} ms old{missing}"


def _taken(column: Column, rows: Ints) -> Column:
    values = np.where(rows >= 0, column.values[rows], np.nan)
    bad = np.flatnonzero(np.isin(rows, column.bad))
    return Column(column.name, values, column.unit, column.is_clock, column.shown, bad, column.complaint)
