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
"""Column -> quantity of its unit."""

FORCES = {"N": 1.0, "mN": 1e-3, "gf": 9.80665e-3, "g": 9.80665e-3, "kgf": 9.80665, "kg": 9.80665}
"""[N] Units of a force; those of a mass are for scales."""

USUAL = {"t": "s", "v_a": "V", "i_a": "A", "theta": "rad", "thrust": "N"}
"""Unit of a column without one. A speed and a duty need a unit: Table 4.3 of the thesis has V per RPM as "Vs/rad"."""

_NAME = re.compile(r"^\s*([A-Za-z_]+)\s*(?:[\[(]\s*([^\])]*?)\s*[\])])?\s*$")


def read_rows(path: Path, columns: str | None = None) -> Rows:
    """Read a table in any format that `import` reads.

    Args:
        path: the file.
        columns: names and units, separated by commas, for a file without a line of names.

    Raises:
        BenchTestError: the table cannot be used; the message says where and why.
    """
    try:
        table = files.read(path)
    except TableError as error:
        raise BenchTestError(str(error)) from None
    names = [column.name for column in table.columns] if columns is None else columns.split(",")
    if len(names) != len(table.columns):
        raise BenchTestError(f"{path}: has {len(table.columns)} columns, --columns names {len(names)}")
    if columns is None and not any(names):
        why = "; ".join(table.notes) or "its first line names no columns"
        raise BenchTestError(f"{path}: {why}; give each column a name and a unit in the first line, or with --columns")
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
    """The quantity of a column, the size of its unit, and the reading that means zero."""
    match = _NAME.match(cell)
    name, unit = (match.group(1), match.group(2)) if match else ("", None)
    if name not in QUANTITIES:
        raise BenchTestError(f"{path}: '{cell.strip()}' names no column; give each column a quantity and its unit, as "
                             f"in 'v_a [V],omega [rpm]' ({', '.join(QUANTITIES)}), in the first line or with --columns")
    if unit is None and name not in USUAL:
        raise BenchTestError(f"{path}: {name} needs its unit, as in '{name} [{'rpm' if name == 'omega' else '%'}]'")
    unit = unit or USUAL[name]
    if name == "thrust":
        if unit not in FORCES:
            raise BenchTestError(f"{path}: '{unit}' is not a unit of thrust; give {', '.join(FORCES)}")
        return name, FORCES[unit], 0.0
    try:
        known = parse(QUANTITIES[name], unit)
    except UnitError as error:
        raise BenchTestError(f"{path}: {error}") from None
    return name, known.size, known.low
