# SPDX-License-Identifier: Apache-2.0
"""Tables of bench tests: columns with names and units, as in `v_a [V], i_a [A], omega [rpm]`."""

from __future__ import annotations

import re
from pathlib import Path

from aeropend_ident.bench_tests.estimates import BenchTestError, Rows
from aeropend_ident.tables import files
from aeropend_ident.tables.table import TableError
from aeropend_ident.tables.units import UnitError, parse

QUANTITIES = {"t": "time", "v_a": "voltage", "i_a": "current", "omega": "omega", "duty": "duty", "theta": "theta",
              "thrust": "force"}
"""Columns, and what their units are units of."""

FORCES = {"N": 1.0, "mN": 1e-3, "gf": 9.80665e-3, "g": 9.80665e-3, "kgf": 9.80665, "kg": 9.80665}
"""Units of a force, N; those of a mass are what scales show."""

USUAL = {"t": "s", "v_a": "V", "i_a": "A", "theta": "rad", "thrust": "N"}
"""Units where a table gives none. Of a speed and a duty it must: the thesis' Table 4.3 calls V per RPM "Vs/rad"."""

_NAME = re.compile(r"^\s*([A-Za-z_]+)\s*(?:[\[(]\s*([^\])]*?)\s*[\])])?\s*$")


def read_rows(path: Path, columns: str | None = None) -> Rows:
    """Read a table of any kind that `import` reads.

    Args:
        path: the file. columns: names and units, separated by commas, if the file has none of its own.

    Raises:
        BenchTestError: it cannot be used; one line that says where and why.
    """
    try:
        table = files.read(path)
    except TableError as error:
        raise BenchTestError(str(error)) from None
    names = [column.name for column in table.columns] if columns is None else columns.split(",")
    if len(names) != len(table.columns):
        raise BenchTestError(f"{path}: has {len(table.columns)} columns, --columns names {len(names)}")
    found = {}
    for column, cell in zip(table.columns, names):
        name, size, low = _column(cell, path)
        if name in found:
            raise BenchTestError(f"{path}: {name} is there twice")
        if column.complaint:
            raise BenchTestError(column.complaint)
        found[name] = (column.values - low) * size
    if table.complaint:
        raise BenchTestError(table.complaint)
    return Rows(path.name, found, notes=table.notes)


def _column(cell: str, path: Path) -> tuple[str, float, float]:
    """The quantity of a column, the size of its unit, and the number that stands for zero."""
    match = _NAME.match(cell)
    name, unit = (match.group(1), match.group(2)) if match else ("", None)
    if name not in QUANTITIES:
        raise BenchTestError(f"{path}: '{cell.strip()}' names no column; give each a quantity and its unit, as in "
                             f"'v_a [V],omega [rpm]' ({', '.join(QUANTITIES)}), in the first line or with --columns")
    if unit is None and name not in USUAL:
        raise BenchTestError(f"{path}: {name} needs its unit, as in '{name} [{'rpm' if name == 'omega' else '%'}]'")
    unit = unit or USUAL[name]
    if name == "thrust":
        if unit not in FORCES:
            raise BenchTestError(f"{path}: '{unit}' is no unit of a thrust: give {', '.join(FORCES)}")
        return name, FORCES[unit], 0.0
    try:
        known = parse(QUANTITIES[name], unit)
    except UnitError as error:
        raise BenchTestError(f"{path}: {error}") from None
    return name, known.size, known.low
