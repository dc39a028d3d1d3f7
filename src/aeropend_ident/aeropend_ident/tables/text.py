# SPDX-License-Identifier: Apache-2.0
"""Tables in text files: CSV in all its dialects, TSV, columns between blanks.

The first lines determine the dialect: encoding, delimiter, decimal mark, header and units. Ambiguous numbers are
refused, not guessed. Cells are read line by line, so a file takes no more memory than its numbers.
"""

from __future__ import annotations

import codecs
import csv
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from aeropend_ident.tables.table import MOST_BYTES, SHOWN, Column, Floats, Table, TableError, check_size
from aeropend_ident.tables.units import is_unit, split_name, without_brackets
from aeropend_sim.wording import counted

SAMPLE = 400
"""Number of lines that determine the dialect (choice)."""

LONGEST = 1 << 16
"""[characters] Greatest length of a line (choice)."""

BLOCK = 1 << 20
"""[bytes] Size of the blocks that are decoded to find the encoding (choice)."""

DELIMITERS = (";", "\t", "|", ",", " ")
"""Delimiters in order of preference if several fit; " " means any number of blanks."""

NAMES = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas", " ": "blanks"}

EMPTY = {"", "nan", "na", "n/a", "#n/a", "#nv", "null", "none", "-", "--", "inf", "+inf", "-inf", "ovf", "-nan", "?"}
"""Texts for a missing reading, in lower case."""

COMMENTS = ("#", "%", "//")

ARROW = " -> "
"""Text of the Arduino IDE between the time of arrival of a line and the line."""

OTHER_NAMES = 2
"""Greatest difference between the numbers of names and of columns for a line to be one of names (choice)."""

READABLE = 0.6
"""Least share of readable cells in the sample, for a table of one column (choice)."""

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?$")
_COMMA_NUMBER = re.compile(r"[+-]?(?:\d+(?:,\d+)?|,\d+)(?:[eE][+-]?\d+)?$")
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:([.,' \u00a0\u202f’])\d{3})(?:\1\d{3})*(?:[.,]\d+)?$")
_MAYBE_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}$")
_CLOCK = re.compile(r"(?:(\S*\d)[T ]\s*)?(\d{1,3}):(\d{2})(?::(\d{2})(?:[.,:](\d{1,9}))?)?\s*([AaPp])?\.?(?:[Mm]\.?)?"
                    r"(?:Z|[+-]\d\d:?\d\d)?$")
_MINUTES = re.compile(r"(\d{1,3}):(\d{2})[.,](\d{1,9})$")
_WORDS = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?")


@dataclass(frozen=True)
class Dialect:
    """How a text file is to be read.

    Attributes:
        delimiter: one of `DELIMITERS`.
        decimals: "." or ",", of each column.
        width: cells in a line.
        first: line (from 1 on) with the first numbers.
        names, units: of the columns; "" where there are none.
        clocks: whether a column holds times of day.
        texts: whether a column holds hardly any number.
        head: names whose number is not that of the columns, which therefore have none.
    """

    delimiter: str
    decimals: tuple[str, ...]
    width: int
    first: int = 1
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    clocks: tuple[bool, ...] = ()
    texts: tuple[bool, ...] = ()
    head: tuple[str, ...] = ()


def number(cell: str, decimal: str) -> float | None:
    """A cell as a number with this decimal mark; NaN for an empty cell; None for other text."""
    cell = cell.strip()
    if (_NUMBER if decimal == "." else _COMMA_NUMBER).match(cell):
        return float(cell.replace(",", "."))
    return np.nan if cell.casefold() in EMPTY else None


def clock(cell: str) -> float | None:
    """[s] A time of day, since 1970 with an ISO date; None for other text."""
    cell = cell.strip()
    minutes = _MINUTES.match(cell)
    if minutes:
        return 60.0 * int(minutes.group(1)) + int(minutes.group(2)) + float(f"0.{minutes.group(3)}")
    match = _CLOCK.match(cell)
    if match is None:
        return None
    date, h, m, s, fraction, half = match.groups()
    hour = int(h) % 12 + 12 * (half in "Pp") if half else int(h)
    seconds = 3600.0 * hour + 60.0 * int(m) + int(s or 0) + (float(f"0.{fraction}") if fraction else 0.0)
    if date and hour < 24:
        try:
            day = datetime.strptime(date, "%Y-%m-%d").replace(tzinfo=timezone.utc)
        except ValueError:
            return seconds  # the day is not needed: midnight is found by the wrap of the clock
        return day.timestamp() + seconds
    return seconds


def read_text(path: Path, delimiter: str | None = None, decimal: str | None = None) -> Table:
    """Read a table from a text file.

    Args:
        path: the file.
        delimiter: where the file leaves them open.
        decimal: likewise.

    Raises:
        TableError: it holds no table; one line that says what is wrong.
        OSError: it cannot be read.
    """
    if path.stat().st_size > MOST_BYTES:
        raise TableError(f"{path}: is larger than {MOST_BYTES >> 30} GiB: split it")
    encoding, notes = _encoding(path)
    sample = [line for line, _ in zip(_lines(path, encoding), range(SAMPLE))]
    dialect = _dialect(path, sample, delimiter, decimal)
    if decimal is None:
        _check_marks(path, dialect, _lines(path, encoding))
    dialect = _head(path, sample, dialect)
    commas = [k for k, mark in enumerate(dialect.decimals) if mark == ","]
    if commas:
        where = "" if len(commas) == dialect.width else f" in column{'s' * (len(commas) > 1)} " + ", ".join(
            f"{k + 1}" for k in commas) + ", in others a decimal point"
        notes.append(f"numbers have a decimal comma{where}")
    return _Reading(path, dialect, notes).table(_lines(path, encoding))


def _encoding(path: Path) -> tuple[str, list[str]]:
    with path.open("rb") as file:
        start = file.read(BLOCK)
        for bom, encoding in ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"),
                              (codecs.BOM_UTF16_BE, "utf-16")):
            if start.startswith(bom):
                return encoding, ["encoding: UTF-16"] if encoding == "utf-16" else []
        zeros = [start[k::2].count(0) for k in (0, 1)]
        if max(zeros) > 0.3 * len(start) / 2 and min(zeros) == 0:
            return ("utf-16-be" if zeros[0] else "utf-16-le"), ["encoding: UTF-16"]
        if any(zeros) or any(start.count(byte) for byte in (1, 2, 3, 4, 5, 6)):
            raise TableError(f"{path}: holds bytes that no text has: not a table that can be read (CSV, TSV, text, "
                             ".xlsx, .mat, .npy, .npz)")
        decoder = codecs.getincrementaldecoder("utf-8")()
        try:
            while start:
                decoder.decode(start)
                start = file.read(BLOCK)
            decoder.decode(b"", final=True)
        except UnicodeDecodeError:
            return "cp1252", ["encoding: Windows-1252 (Latin-1)"]
    return "utf-8", []


def _lines(path: Path, encoding: str) -> Iterator[str]:
    """The lines of a file without line ends."""
    with path.open(encoding=encoding, errors="replace") as file:
        number = 0
        while line := file.readline(LONGEST + 1):
            number += 1
            if len(line) > LONGEST:
                raise TableError(f"{path}: line {number} is longer than {LONGEST} characters: not a table")
            yield line.rstrip("\n")


def split(line: str, delimiter: str) -> list[str]:
    """The cells of a line."""
    time, arrow, rest = line.partition(ARROW)
    if arrow and clock(time) is not None:
        return [time.strip(), *split(rest, delimiter)]
    if delimiter == " ":
        return line.split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]
    return [cell.strip() for cell in line.split(delimiter)]


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(COMMENTS)


def _readable(cell: str, decimal: str) -> bool:
    return number(cell, decimal) is not None or clock(cell) is not None


def _has_thousands(cell: str) -> bool:
    """Whether a number has marks of thousands and cannot be read otherwise."""
    return bool(_THOUSANDS.match(cell)) and number(cell, ".") is None and number(cell, ",") is None


def _dialect(path: Path, sample: Sequence[str], delimiter: str | None, decimal: str | None) -> Dialect:
    """Find delimiter, decimal marks and width: those with which most cells of the sample can be read."""
    lines = [line for line in sample if line.strip() and not _is_comment(line)]
    if not lines:
        if any(line.strip() for line in sample):
            raise TableError(f"{path}: holds nothing but comments: export the data as columns of numbers")
        raise TableError(f"{path}: the file is empty")
    lower = lines[len(lines) // 4 :]  # a head has no numbers
    best: tuple[tuple[float, float, int], Dialect] | None = None
    for d in (delimiter,) if delimiter else DELIMITERS:
        widths = Counter(len(split(line, d)) for line in lower)
        width = max(widths, key=lambda w: (widths[w], w))
        rows = [row for row in (split(line, d) for line in lower) if len(row) == width]
        same = sum(len(split(line, d)) == width for line in lines) / len(lines)
        filled = [[cell for cell in cells if cell.casefold() not in EMPTY] for cells in zip(*rows)]
        readable = [{mark: sum(_readable(cell, mark) or _has_thousands(cell) for cell in cells)
                     for mark in ((decimal,) if decimal else (".", ","))} for cells in filled]
        marks = _marks(readable)
        count = sum(one[mark] for one, mark in zip(readable, marks))
        share = count / max(sum(map(len, filled)), 1) * len(rows) / len(lower)
        score = (round(share, 2), round(same, 1), width)
        if best is None or score > best[0]:
            best = score, Dialect(d, marks, width)
    assert best is not None
    (share, _, _), found = best
    if share == 0.0 or (share < READABLE and found.width == 1):
        raise TableError(f"{path}: no table of numbers is found in it: export the data as columns of numbers")
    return found


def _marks(readable: Sequence[Mapping[str, int]]) -> tuple[str, ...]:
    """The decimal mark of each column; that of the others where a column does not tell.

    Args:
        readable: number of readable cells by mark, of each column.
    """
    clear = {max(one, key=lambda mark: one[mark]) for one in readable if len(set(one.values())) > 1}
    usual = clear.pop() if len(clear) == 1 else min(readable[0], default=".", key=".,".index) if readable else "."
    return tuple(max(one, key=lambda mark: one[mark]) if len(set(one.values())) > 1 else usual for one in readable)


def _check_marks(path: Path, dialect: Dialect, lines: Iterator[str]) -> None:
    """Refuse commas that may be decimal commas or mark thousands in every line of the file."""
    first = ""
    for line in lines if "," in dialect.decimals else ():
        if _is_comment(line):
            continue
        for cell, mark in zip(split(line, dialect.delimiter), dialect.decimals):
            if mark == "," and "," in cell and _COMMA_NUMBER.match(cell):
                if not _MAYBE_THOUSANDS.match(cell):
                    return
                first = first or cell
    if first:
        raise TableError(f"{path}: '{first}' may have a decimal comma or mark thousands: say --decimal , or write "
                         "the numbers without marks of thousands")


def _head(path: Path, sample: Sequence[str], dialect: Dialect) -> Dialect:
    """Find the first line of numbers and, above it, names and units."""
    rows = [(k, split(line, dialect.delimiter)) for k, line in enumerate(sample, 1)
            if line.strip() and not _is_comment(line)]
    lower = [row for _, row in rows[len(rows) // 4 :] if len(row) == dialect.width]
    clocks, texts = [], []
    for column in range(dialect.width):
        cells = [row[column] for row in lower if row[column].casefold() not in EMPTY]
        plain = sum(number(cell, dialect.decimals[column]) is not None for cell in cells)
        timed = sum(clock(cell) is not None for cell in cells)
        clocks.append(timed > plain)
        texts.append(max(timed, plain) < 0.5 * len(cells))
    start = next((k for k, (_, row) in enumerate(rows) if _is_data(row, dialect, texts)), 0)
    first = rows[start][0]
    if dialect.delimiter == "," and start and 2 * len(rows[start - 1][1]) == dialect.width:
        raise TableError(f"{path}: line {first} has twice as many cells as line {rows[start - 1][0]} has names: if "
                         "commas are decimal marks, they cannot split the cells as well; write it with semicolons")
    used = max((k + 1 for row in lower for k, cell in enumerate(row) if cell), default=dialect.width)
    above = [row for _, row in rows[:start] if _fits(row, dialect.width)]
    units: list[str] = []
    if above and all(not cell or is_unit(without_brackets(cell)) for cell in above[-1]) and any(above[-1]):
        units = [without_brackets(cell) for cell in above.pop()]
    names = above[-1] if above else _commented(sample[: first - 1], dialect, used)
    names, head = _named(names, dialect.width, used)
    own = [split_name(name)[1] for name in names]
    units = (units + [""] * dialect.width)[: dialect.width]
    return Dialect(dialect.delimiter, dialect.decimals, dialect.width, first, tuple(names),
                   tuple(line or name for line, name in zip(units, own)), tuple(clocks), tuple(texts), head)


def _named(names: list[str], width: int, used: int) -> tuple[list[str], tuple[str, ...]]:
    """A name for each column; or no names for the columns, and the names whose number is not that of the columns.

    Args:
        names: in the file.
        width: number of cells in a line.
        used: number of the last column that is not empty.
    """
    cells = len(names)
    while names and not names[-1]:
        names = names[:-1]
    if names and cells != width and len(names) != used:
        return [""] * width, tuple(names)
    return names + [""] * (width - len(names)), ()


def _fits(row: Sequence[str], width: int) -> bool:
    return len(row) == width or (abs(len(row) - width) <= OTHER_NAMES and len(row) > 1 and all(row[:-1]))


def _is_data(row: Sequence[str], dialect: Dialect, texts: Sequence[bool]) -> bool:
    if len(row) != dialect.width:
        return False
    cells = [(cell, mark) for cell, mark, is_text in zip(row, dialect.decimals, texts)
             if not is_text and cell.casefold() not in EMPTY]
    return bool(cells) and all(_readable(cell, mark) for cell, mark in cells)


def _commented(lines: Sequence[str], dialect: Dialect, used: int) -> list[str]:
    """Names in a comment or between blanks; none if their number does not fit."""
    for line in reversed([line for line in lines if line.strip()][-2:]):
        text = line.strip().lstrip("#%/").strip()
        for names in (split(text, dialect.delimiter), re.split(r"\s{2,}|\t", text), _WORDS.findall(text)):
            if len(names) in (dialect.width, used) and (_is_comment(line) or dialect.delimiter == " "):
                return names
    return []


@dataclass
class _Store:
    """A column during reading."""

    values: array[float] = field(default_factory=lambda: array("d"))
    bad: list[int] = field(default_factory=list)
    shown: list[str] = field(default_factory=list)
    complaint: str = ""


class _Reading:
    """Reads the rows of a table."""

    def __init__(self, path: Path, dialect: Dialect, notes: list[str]) -> None:
        self.path, self.dialect, self.notes = path, dialect, notes
        self.stores = [_Store() for _ in range(dialect.width)]
        self.numbers, self.lengths = array("q"), array("q")
        self.bad: list[int] = []
        self.complaint = ""
        self.short = 0

    def table(self, lines: Iterator[str]) -> Table:
        """Read all rows."""
        block: list[list[str]] = []
        last: tuple[int, str, list[str]] | None = None
        comments = 0
        for k, line in enumerate(lines, 1):
            if k < self.dialect.first or not line.strip():
                continue
            if _is_comment(line):
                comments += 1
                continue
            if last is not None:
                block.append(self._row(*last))
            last = k, line, split(line, self.dialect.delimiter)
            if len(block) >= 8192:
                self._take(block)
                block = []
        if last is not None:
            if len(last[2]) < self.dialect.width and len(self.numbers) + len(block) > 1:
                self.notes.append(f"the last line ({last[0]}) is broken off: left out")
            else:
                block.append(self._row(*last))
        self._take(block)
        if comments:
            self.notes.append(f"{counted(comments, 'comment')} among the rows left out")
        if self.short:
            self.notes.append(f"{counted(self.short, 'row')} with fewer cells than the others: the missing ones are "
                              "empty")
        return self._done()

    def _row(self, line: int, written: str, cells: list[str]) -> list[str]:
        width = self.dialect.width
        if len(cells) > width and any(cells[width:]):
            self.bad.append(len(self.numbers))
            self.complaint = self.complaint or (f"{self.path}: line {line} has {len(cells)} cells, the others have "
                                                f"{width}")
        elif len(cells) < width:
            self.short += 1
        self.numbers.append(line)
        self.lengths.append(len(written))
        return cells[:width] + [""] * (width - len(cells))

    def _take(self, rows: list[list[str]]) -> None:
        if not rows:
            return
        check_size(len(self.numbers), self.dialect.width, self.path)
        start = len(self.numbers) - len(rows)
        for column, (store, cells) in enumerate(zip(self.stores, zip(*rows))):
            if len(store.shown) < SHOWN:
                store.shown += [cell for cell in cells[:100] if cell][: SHOWN - len(store.shown)]
            store.values.extend(self._numbers(column, store, cells, start))

    def _numbers(self, column: int, store: _Store, cells: Sequence[str], start: int) -> list[float]:
        is_clock, decimal = self.dialect.clocks[column], self.dialect.decimals[column]
        if self.dialect.texts[column]:
            if not store.complaint:
                found = next((k for k, cell in enumerate(cells) if not _readable(cell, decimal)), None)
                store.complaint = "" if found is None else self._complain(start + found, column, cells[found])
            return [np.nan] * len(cells)
        if not is_clock and decimal == "." and "_" not in "".join(cells):
            try:
                return [float(cell) for cell in cells]
            except ValueError:
                pass  # cell by cell, then
        values = []
        for k, cell in enumerate(cells):
            value = clock(cell) if is_clock else number(cell, decimal)
            if value is None and is_clock and cell.casefold() in EMPTY:
                value = np.nan
            if value is None:
                if not store.bad:
                    store.complaint = self._complain(start + k, column, cell)
                store.bad.append(start + k)
                value = np.nan
            values.append(value)
        return values

    def _complain(self, row: int, column: int, cell: str) -> str:
        where = f"{self.path}: line {self.numbers[row]}, column {column + 1}"
        if self.dialect.names[column]:
            where += f" ({self.dialect.names[column]})"
        shown = cell if len(cell) <= 40 else cell[:37] + "..."
        if self.dialect.clocks[column]:
            return f"{where}: '{shown}' is no time of day"
        if _THOUSANDS.match(cell):
            return f"{where}: '{shown}' marks thousands: write numbers without such marks"
        own = self.dialect.decimals[column]
        other = "," if own == "." else "."
        if number(cell, other) is not None:
            mark = {".": "point", ",": "comma"}
            return f"{where}: '{shown}' has a decimal {mark[other]}, where others have a decimal {mark[own]}"
        return f"{where}: '{shown}' is not a number"

    def _done(self) -> Table:
        columns = []
        for k, store in enumerate(self.stores):
            values: Floats = np.frombuffer(store.values, dtype=np.float64) if store.values else np.empty(0)
            values = np.where(np.isfinite(values), values, np.nan)
            bad = np.arange(len(values)) if self.dialect.texts[k] else np.array(store.bad, dtype=np.int64)
            name, complaint = self.dialect.names[k], store.complaint
            if len(bad) and not complaint:  # each cell can be read: as nothing, a number or a time of day
                which = f"{k + 1} ({name})" if name else f"{k + 1}"
                complaint = f"{self.path}: column {which} holds hardly any number, or numbers and times of day"
            column = Column(name, values, self.dialect.units[k], self.dialect.clocks[k], tuple(store.shown), bad,
                            complaint)
            columns.append(column)
        while len(columns) > 1 and not columns[-1].shown and not columns[-1].name:
            columns.pop()  # a delimiter at the end of each line
        return Table(self.path, tuple(columns), np.array(self.numbers, dtype=np.int64), tuple(self.notes),
                     np.array(self.lengths, dtype=np.int64), np.array(self.bad, dtype=np.int64), self.complaint,
                     self.dialect.head)
