# SPDX-License-Identifier: Apache-2.0
"""Tables in files of several formats, which are recognised by their first bytes and not by their names.

The files may come from anybody: nothing in them is run (no pickles, no formulas), what they would take in memory is
known before they are unpacked, and nothing but the file itself is read.
"""

from __future__ import annotations

import io
import json
import math
import struct
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from datetime import date, datetime, time, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.tables import text
from aeropend_ident.tables.align import align
from aeropend_ident.tables.table import (
    MOST_BYTES,
    MOST_COLUMNS,
    SHOWN,
    Column,
    Table,
    TableError,
    check_size,
)
from aeropend_ident.tables.units import is_unit, split_name, without_brackets

MOST_UNPACKED = 1 << 29
"""Bytes that a file may hold once it is unpacked."""

MOST_TEXT = 1 << 26
"""Bytes of a workbook's texts and styles, which are held in memory."""

OPAQUE = "<object>"
"""End of the name of a variable that is an object of MATLAB."""

OPAQUE_SAYS = ("a table or timeseries object, which only MATLAB can read: save its columns there, as in "
               "writetable(T, 'run.csv') or t = ts.Time; x = ts.Data; save('run.mat', 't', 'x', '-v7')")

HDF5 = b"\x89HDF\r\n\x1a\n"

Arrays = dict[str, NDArray[Any]]


FARTHEST, FEW = 1e9, 0.01
"""Number over that below which 99 % of a column are, from which on it is no possible one, and the share of such numbers
below which they are single ones (choices)."""


def read(path: Path, *, sheet: str | None = None, delimiter: str | None = None, decimal: str | None = None) -> Table:
    """Read the table of a file, without single numbers that can be none.

    Args:
        path: CSV, TSV, text, .xlsx, .mat, .npy or .npz.
        sheet: of a workbook, where several hold numbers.
        delimiter: of text, where the file leaves them open.
        decimal: likewise.

    Raises:
        TableError: there is no table in it, or it cannot be read; one line that says why.
    """
    try:
        if not path.exists():
            raise TableError(f"{path}: no such file")
        if not path.is_file():
            raise TableError(f"{path}: is no file")
        if not path.stat().st_size:
            raise TableError(f"{path}: the file is empty")
        kind = _kind(path)
        if sheet is not None and kind != "xlsx":
            raise TableError(f"{path}: is no workbook: leave --sheet away")
        if kind == "text":
            return without_impossible(align(text.read_text(path, delimiter, decimal)))
        if path.stat().st_size > MOST_BYTES:
            raise TableError(f"{path}: is larger than {MOST_BYTES >> 30} GiB: split it")
        if kind == "xlsx":
            return without_impossible(_workbook(path, sheet))
        readers = {"npy": _npy, "npz": _npz, "mat": _matlab}
        return without_impossible(_of_arrays(path, readers[kind](path)))
    except OSError as error:
        raise TableError(f"{path}: cannot be read: {error.strerror or error}") from None
    except MemoryError:
        raise TableError(f"{path}: is too large for the memory of this machine") from None


def without_impossible(table: Table) -> Table:
    """A table without single numbers that are far beyond all others of their column, with a note on each column."""
    columns, notes = list(table.columns), list(table.notes)
    for k, column in enumerate(columns):
        size = np.abs(column.values)
        known = size[np.isfinite(size)]
        if not len(known) or column.is_clock:
            continue
        usual = float(np.percentile(known, 100.0 * (1.0 - FEW), method="lower"))
        wrong = np.flatnonzero(np.isfinite(size) & (size > FARTHEST * max(usual, 1.0)))
        if not len(wrong):
            continue
        first = f"line {table.lines[wrong[0]]}, column {table.label(k)}: {column.values[wrong[0]]:g}"
        more = f" (and {len(wrong) - 1} more in this column)" if len(wrong) > 1 else ""
        notes.append(f"{first} is no possible number{more}: left out")
        values = column.values.copy()
        values[wrong] = np.nan
        columns[k] = replace(column, values=values)
    return replace(table, columns=tuple(columns), notes=tuple(notes))


def _kind(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(132)
    if start.startswith(b"PK\x03\x04"):
        try:
            with zipfile.ZipFile(path) as archive:
                names = archive.namelist()
        except (zipfile.BadZipFile, NotImplementedError, ValueError):
            raise TableError(f"{path}: is a damaged ZIP file: copy it again, or save it again") from None
        if any(name.startswith("xl/") for name in names):
            return "xlsx"
        if names and all(name.endswith(".npy") for name in names):
            return "npz"
        if "mimetype" in names:
            raise TableError(f"{path}: is an OpenDocument file: save it as .xlsx or .csv")
        raise TableError(f"{path}: is a ZIP file: unpack it first")
    if start.startswith(b"\x93NUMPY"):
        return "npy"
    if start.startswith(b"\xd0\xcf\x11\xe0"):
        raise TableError(f"{path}: is an old Excel file (.xls): save it as .xlsx or .csv")
    if start.startswith((b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"7z\xbc\xaf", b"Rar!")):
        raise TableError(f"{path}: is compressed: unpack it first")
    if start.startswith(b"\x89MCAP"):
        raise TableError(f"{path}: is a recording already")
    if start.startswith((HDF5, b"MATLAB ")) or start[124:128] in (b"\x00\x01IM", b"\x01\x00MI") or is_matlab_4(start):
        return "mat"
    return "text"


def is_matlab_4(start: bytes) -> bool:
    """Whether a file begins as one of MATLAB 4 does: it has no mark, but a header of a matrix with its name.

    Source: MAT-File Format, The MathWorks: type (MOPT), rows, columns, whether complex, length of the name.
    """
    for order in ("<", ">"):
        if len(start) >= 21:
            kind, rows, columns, imaginary, name = struct.unpack(f"{order}5i", start[:20])
            # in MOPT, M is the order of bytes, O is 0, P the type of the numbers, T full, text or sparse
            fits = kind // 1000 == (order == ">") and kind // 100 % 10 == 0 and kind // 10 % 10 <= 5 and kind % 10 <= 2
            text = start[20 : 20 + max(name - 1, 0)]
            if fits and kind >= 0 and rows > 0 and columns > 0 and imaginary in (0, 1) and 2 <= name <= 64 and (
                    text.isascii() and text.replace(b"_", b"a").isalnum()):
                return True
    return False


# Excel


def _workbook(path: Path, sheet: str | None) -> Table:
    """Read a sheet. The value of a formula is the one that Excel stored in the file."""
    import openpyxl

    with zipfile.ZipFile(path) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    held = sum(size for name, size in sizes.items() if not name.startswith("xl/worksheets/"))
    if sum(sizes.values()) > MOST_UNPACKED or held > MOST_TEXT:
        raise TableError(f"{path}: would take {sum(sizes.values()) >> 20} MiB unpacked: save the sheet as .csv")
    try:
        with warnings.catch_warnings(), path.open("rb") as file:  # by its name, openpyxl refuses some
            warnings.simplefilter("ignore")  # of styles and the like that it does not know
            book = openpyxl.load_workbook(file, read_only=True, data_only=True, keep_links=False)
            try:
                return _sheet(path, book, sheet)
            finally:
                book.close()
    except (TableError, MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:  # whatever is in the file, openpyxl raises what its parsers raise
        why = " ".join(str(error).split())[:100] or type(error).__name__
        raise TableError(f"{path}: cannot be read as a workbook ({why}): save it again, or as .csv") from None


def _sheet(path: Path, book: Any, wanted: str | None) -> Table:
    names = [one.title for one in book.worksheets]
    if wanted is not None and wanted not in names:
        raise TableError(f"{path}: has no sheet '{wanted}'; its sheets are {', '.join(names)}")
    found: list[tuple[str, Table]] = []
    for one in book.worksheets:
        if wanted is None or one.title == wanted:
            table = _cells(path, one)
            if table is not None:
                found.append((one.title, table))
    if not found:
        raise TableError(f"{path}: no table of numbers is found in {wanted or 'any of its sheets'}")
    if len(found) > 1:
        raise TableError(f"{path}: several sheets hold tables ({', '.join(name for name, _ in found)}): choose one "
                         "with --sheet")
    return found[0][1]


def _cells(path: Path, sheet: Any) -> Table | None:
    """The rows of a sheet as a table; None without a table of numbers."""
    sheet.reset_dimensions()  # the dimensions in the file may be wrong
    rows: list[tuple[Any, ...]] = []
    numbers: list[int] = []
    width = 0
    for k, row in enumerate(sheet.iter_rows(values_only=True, max_col=MOST_COLUMNS + 1), 1):
        cells: tuple[Any, ...] = tuple(row)
        while cells and cells[-1] in (None, ""):
            cells = cells[:-1]
        if cells:
            width = max(width, len(cells))
            check_size(len(rows), width, path)
            rows.append(cells)
            numbers.append(k)
    full = [row + (None,) * (width - len(row)) for row in rows]
    lower = full[len(full) // 4 :]
    plain = []
    for c in range(width):
        filled = [row[c] for row in lower if row[c] not in (None, "")]
        if sum(_number(cell) is not None for cell in filled) > 0.5 * len(filled):
            plain.append(c)
    start = next((k for k, row in enumerate(full) if sum(_number(row[c]) is not None for c in plain) > 0
                  and not any(isinstance(row[c], str) and _number(row[c]) is None for c in plain)), None)
    if start is None or len(full) - start < 2:
        return None
    above = [["" if cell is None else " ".join(str(cell).split()) for cell in row] for row in full[:start]]
    units = [""] * width
    if above and any(above[-1]) and all(not cell or is_unit(without_brackets(cell)) for cell in above[-1]):
        units = [without_brackets(cell) for cell in above.pop()]
    names = above[-1] if above else [""] * width
    columns = []
    for c in range(width):
        column = _column(path, sheet.title, names[c], c, [row[c] for row in full[start:]], numbers[start:])
        if column.shown or column.name:
            columns.append(Column(column.name, column.values, units[c] or split_name(names[c])[1], column.is_clock,
                                  column.shown, column.bad, column.complaint))
    return Table(path, tuple(columns), np.array(numbers[start:], dtype=np.int64), (f"sheet: {sheet.title}",))


def _number(cell: Any) -> float | None:
    """A cell as a number, dates and times of day in s; None for other cells."""
    if isinstance(cell, bool) or cell is None:
        return None
    if isinstance(cell, (int, float)):
        return float(cell)
    if isinstance(cell, datetime):
        return (cell if cell.tzinfo else cell.replace(tzinfo=timezone.utc)).timestamp()
    if isinstance(cell, timedelta):
        return cell.total_seconds()
    if isinstance(cell, time):
        return 3600.0 * cell.hour + 60.0 * cell.minute + cell.second + 1e-6 * cell.microsecond
    if isinstance(cell, str) and cell.strip():
        value = text.number(cell, ".")
        return value if value is not None else text.clock(cell)
    return None


def _column(path: Path, sheet: str, name: str, c: int, cells: Sequence[Any], rows: Sequence[int]) -> Column:
    dates = sum(_is_time(cell) for cell in cells)
    clock = dates > 0.5 * sum(cell not in (None, "") for cell in cells)
    values = np.full(len(cells), np.nan)
    bad, complaint = [], ""
    for k, cell in enumerate(cells):
        value = _number(cell)
        empty = cell is None or (isinstance(cell, str) and cell.strip().casefold() in text.EMPTY)
        if value is not None and (_is_time(cell) == clock or math.isnan(value)):
            values[k] = value
        elif not empty:
            bad.append(k)
            kind = f"a {'date or time' if _is_time(cell) else 'number'}" if value is not None else ""
            what = f"is {kind}, others are not" if kind else "is not a number"
            if isinstance(cell, str) and text.number(cell, ",") is not None:
                what = "is text with a decimal comma, not a number"
            complaint = complaint or (f"{path}: sheet {sheet}, row {rows[k]}, column {c + 1}"
                                      f"{f' ({name})' if name else ''}: '{str(cell)[:40]}' {what}")
    values[~np.isfinite(values)] = np.nan
    shown = tuple(str(cell) for cell in cells[:100] if cell not in (None, ""))[:SHOWN]
    return Column(name, values, "", clock, shown, np.array(bad, dtype=np.int64), complaint)


def _is_time(cell: Any) -> bool:
    return isinstance(cell, (date, time, timedelta)) or (isinstance(cell, str) and text.clock(cell) is not None)


# NumPy


def _npy(path: Path) -> Arrays:
    try:
        return {"": np.load(path, mmap_mode="r", allow_pickle=False)}
    except (OSError, MemoryError):
        raise
    except Exception as error:  # whatever is in the file, numpy raises what its parsers raise
        raise TableError(f"{path}: {_numpy_says(error)}") from None


def _npz(path: Path) -> Arrays:
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > MOST_UNPACKED:
            raise TableError(f"{path}: would take more than {MOST_UNPACKED >> 20} MiB unpacked: split it")
        found = {}
        for entry in archive.infolist():
            found[entry.filename[: -len(".npy")]] = _npz_entry(path, archive, entry)
        return found


def _npz_entry(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    try:
        raw = archive.read(entry)
        shape, dtype = _npy_header(raw)
        if dtype.hasobject:
            raise ValueError("Object arrays cannot be loaded")
        if math.prod(shape) * dtype.itemsize > len(raw):
            raise ValueError("it is shorter than it says")
        return np.asarray(np.load(io.BytesIO(raw), allow_pickle=False))
    except (OSError, MemoryError):
        raise
    except Exception as error:  # as above
        raise TableError(f"{path}: {entry.filename}: {_numpy_says(error)}") from None


def _npy_header(raw: bytes) -> tuple[tuple[int, ...], np.dtype[Any]]:
    stream = io.BytesIO(raw)
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError("its format is not known")
    shape, _, dtype = readers[version](stream)
    return shape, dtype


def _numpy_says(error: Exception) -> str:
    if "bject" in str(error) or "pickle" in str(error):
        return "holds Python objects, which are not read from files: save plain arrays of numbers"
    return f"cannot be read as a NumPy array ({' '.join(str(error).split())[:80]})"


# MATLAB


def _matlab(path: Path) -> Arrays:
    """Read a MATLAB file in a process of its own, because damaged files crash the libraries."""
    full = str(path.resolve())
    child = subprocess.run([sys.executable, "-m", "aeropend_ident.tables.matlab", full], check=False, cwd="/",
                           capture_output=True, stdin=subprocess.DEVNULL)  # "/": -m looks for modules where it starts
    if child.returncode == 2:
        raise TableError(child.stderr.decode(errors="replace").strip().splitlines()[-1].replace(full, str(path), 1))
    if child.returncode:
        raise TableError(f"{path}: cannot be read as a MATLAB file: it is damaged; save it again with save(..., '-v7')")
    with np.load(io.BytesIO(child.stdout), allow_pickle=False) as found:
        names = json.loads(found["names"].tobytes())
        return {name: found[f"a{k}"] for k, name in enumerate(names)}


# Arrays


def _of_arrays(path: Path, arrays: Arrays) -> Table:
    """The columns of arrays with the most frequent length."""
    columns: list[tuple[str, NDArray[Any]]] = []
    notes = []
    for name, array in arrays.items():
        if array.dtype.names and array.ndim == 1:
            columns += [(f"{name}.{key}".lstrip("."), array[key]) for key in array.dtype.names if array[key].ndim == 1]
        elif array.dtype.kind in "biuf" and array.size > 1 and np.squeeze(array).ndim <= 2:
            columns += _columns(path, name, array)
        elif name.endswith(OPAQUE):
            notes.append(f"left out: {name.removesuffix(OPAQUE) or 'a variable'}, {OPAQUE_SAYS}")
        elif array.dtype.kind == "M" and array.ndim == 1:
            columns.append((name, array))
        else:
            notes.append(f"left out: {name or 'the array'}, which is no series of numbers")
    plain = [(name, values) for name, values in columns if values.dtype.kind in "biufM"]
    if not plain and any(name.endswith(OPAQUE) for name in arrays):
        raise TableError(f"{path}: holds {OPAQUE_SAYS}")
    if not plain:
        raise TableError(f"{path}: no series of numbers is found in it")
    lengths = [len(values) for _, values in plain]
    length = max(set(lengths), key=lambda n: (lengths.count(n) * (n > 1), n))
    others = [f"{name} ({len(values)})" for name, values in plain if len(values) != length]
    if others:
        notes.append(f"left out, for their length is not {length}: {', '.join(others)}")
    kept = [(name, values) for name, values in plain if len(values) == length]
    check_size(length, len(kept), path)
    return Table(path, tuple(_series(name, values) for name, values in kept), np.arange(1, length + 1), tuple(notes))


def _columns(path: Path, name: str, array: NDArray[Any]) -> list[tuple[str, NDArray[Any]]]:
    """The columns of an array of numbers; the longer side is that of the samples."""
    array = np.squeeze(array)
    if array.ndim == 1:
        return [(name, array)]
    if array.shape[1] > array.shape[0]:
        array = array.T
    check_size(array.shape[0], array.shape[1], path)
    return [(f"{name}[{k + 1}]" if name else "", array[:, k]) for k in range(array.shape[1])]


def _series(name: str, values: NDArray[Any]) -> Column:
    if values.dtype.kind == "M":
        seconds = values.astype("datetime64[ns]").astype(np.int64) / 1e9
        seconds[np.isnat(values)] = np.nan
        shown = tuple(str(value) for value in values[:SHOWN])
        return Column(name, seconds, "", is_clock=True, shown=shown)
    numbers = values.astype(np.float64)
    numbers[~np.isfinite(numbers)] = np.nan
    first = numbers[np.isfinite(numbers)][:SHOWN]
    unit = "" if name.endswith("]") else split_name(name)[1]  # what is in brackets is the number in a matrix
    return Column(name, numbers, unit, shown=tuple(f"{value:.10g}" for value in first))
