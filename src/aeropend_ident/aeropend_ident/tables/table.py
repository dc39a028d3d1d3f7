# SPDX-License-Identifier: Apache-2.0
"""A table: columns of numbers, with notes on the reading of the file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.errors import UserError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_BYTES = 1 << 30
"""[bytes] Greatest size of a file (choice)."""

MOST_NUMBERS = 50_000_000
"""Greatest number of rows times columns: 400 MB in memory (choice)."""

MOST_COLUMNS = 1000
"""Greatest number of columns (choice)."""

SHOWN = 3
"""Number of cells of a column that are kept as text, to show them."""

LEAST, MOST = 1e-30, 1e30
"""Amounts between which a number may be a reading, in whatever unit (choice: products of four are still numbers)."""


class TableError(UserError):
    """A table cannot be used; the message is one line for the user."""


@dataclass(frozen=True, eq=False)
class Column:
    """One column.

    Attributes:
        name: its name in the file, with its unit; "" without a name.
        values: (N,) numbers in the unit of the file; NaN if a cell is empty or cannot be read.
        unit: the unit in the file; "" without one.
        is_clock: the cells are times of day or dates; the values are in s.
        shown: text of the first cells that are not empty.
        bad: (K,) rows whose cell is not a number.
        complaint: message on the first of these rows, one line.
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
        """Whether more than half of the cells are not numbers."""
        return len(self.bad) > 0.5 * max(len(self.values), 1)


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one length.

    Attributes:
        path: the file.
        columns: from left to right.
        lines: (N,) position of each row in the file, from 1: line, or row of a sheet or an array.
        lengths: (N,) number of characters of each row; None if the file is not text.
        bad: (K,) rows with a different number of cells.
        complaint: message on the first of these rows, one line.
        notes: on the reading of the file, one line each.
        head: names that the columns do not have, because there are more or fewer of them than columns.
    """

    path: Path
    columns: tuple[Column, ...]
    lines: Ints
    notes: tuple[str, ...] = ()
    lengths: Ints | None = None
    bad: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    complaint: str = ""
    head: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.lines)

    def possible(self) -> Table:
        """The table without the numbers that can be no reading, whatever their unit."""
        x = [np.where(np.abs(c.values) < LEAST, 0.0, c.values) for c in self.columns]
        return replace(self, columns=tuple(replace(c, values=np.where(np.abs(v) <= MOST, v, np.nan))
                                           for c, v in zip(self.columns, x, strict=True)))

    def label(self, number: int) -> str:
        """Text for a column (number from 0) in a message: '2 "angle [deg]"', or '2' without a name."""
        name = self.columns[number].name
        return f'{number + 1} "{name}"' if name else f"{number + 1}"


def check_size(rows: int, columns: int, path: Path) -> None:
    """Refuse a table that is too large for the memory.

    Args:
        rows: number of rows.
        columns: number of columns.
        path: the file, for the message.

    Raises:
        TableError: it is too large.
    """
    if columns > MOST_COLUMNS:
        raise TableError(f"{path}: has {columns} columns, more than {MOST_COLUMNS}: it is no recording of one rig")
    if rows * columns > MOST_NUMBERS:
        raise TableError(f"{path}: holds more than {MOST_NUMBERS // 10**6} million numbers: split it, or leave out "
                         "columns that are not needed")
