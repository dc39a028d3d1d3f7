# SPDX-License-Identifier: Apache-2.0
"""A table as it was read: columns of numbers, and what was noticed on the way."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_BYTES = 1 << 30
"""Size of a file from which on it is refused."""

MOST_NUMBERS = 50_000_000
"""Rows times columns from which on a table is refused: 400 MB in memory."""

MOST_COLUMNS = 1000

SHOWN = 3
"""First cells of a column that are kept as they were written."""


class TableError(ValueError):
    """A table cannot be used; the message is one line for a person."""


@dataclass(frozen=True, eq=False)
class Column:
    """One column.

    Attributes:
        name: what the file calls it, its unit included; "" where it has no name.
        values: (N,) numbers, in the unit of the file; NaN where a cell is empty or cannot be read.
        unit: what the file says the unit is; "" where it does not.
        is_clock: the cells are times of day or dates, and the values s.
        shown: the first cells that are not empty, as they were written.
        bad: (K,) rows whose cell holds something that is no number.
        complaint: the first of them, in one line that says where and what.
    """

    name: str
    values: Floats
    unit: str = ""
    is_clock: bool = False
    shown: tuple[str, ...] = ()
    bad: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    complaint: str = ""

    @property
    def is_text(self) -> bool:
        """Whether it holds hardly any number."""
        return len(self.bad) > 0.5 * max(len(self.values), 1)


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one length.

    Attributes:
        path: the file.
        columns: from left to right.
        lines: (N,) where each row is in the file, from 1 on: its line, or its row in a sheet or an array.
        lengths: (N,) characters of each row, where it is text.
        bad: (K,) rows that do not fit the table, with other numbers of cells.
        complaint: the first of them, in one line.
        notes: what was noticed while reading, one line each.
    """

    path: Path
    columns: tuple[Column, ...]
    lines: Ints
    notes: tuple[str, ...] = ()
    lengths: Ints | None = None
    bad: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    complaint: str = ""

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.lines)

    def label(self, number: int) -> str:
        """What a person calls a column, by its number from 0 on: '2 "angle [deg]"', or just '2'."""
        name = self.columns[number].name
        return f'{number + 1} "{name}"' if name else f"{number + 1}"


def many(number: int, what: str, plural: str = "") -> str:
    """A number of things: '1 row', '3 rows'."""
    return f"{number} {what}" if number == 1 else f"{number} {plural or what + 's'}"


def check_size(rows: int, columns: int, path: Path) -> None:
    """Refuse what would not fit in memory.

    Raises:
        TableError: too large.
    """
    if columns > MOST_COLUMNS:
        raise TableError(f"{path}: has {columns} columns, more than {MOST_COLUMNS}: it is no recording of one rig")
    if rows * columns > MOST_NUMBERS:
        raise TableError(f"{path}: holds more than {MOST_NUMBERS // 10**6} million numbers: split it, or leave out "
                         "columns that are not needed")
