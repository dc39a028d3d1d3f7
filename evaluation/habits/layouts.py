# SPDX-License-Identifier: Apache-2.0
"""Files of tables: text in its dialects, workbooks, MATLAB files in their layouts, NumPy, several files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import scipy.io

from evaluation.habits.tables import Cells, Drawn, without_units

LAYOUTS = {"text": 0.66, "xlsx": 0.06, "several files": 0.07, "mat, variables": 0.05, "mat, one matrix": 0.03,
           "mat, To File": 0.03, "mat v4": 0.03, "mat, structure with time": 0.03, "mat, timeseries": 0.02, "npz": 0.02}
"""Layout -> share of the tables."""

MARKS = {"comma": ",", "semicolon": ";", "tab": "\t", "blank": " ", "bar": "|"}


def write(made: Drawn, folder: Path, rng: np.random.Generator) -> list[Path]:
    """Write a table; the first file is the one to import, the others belong to it.

    Args:
        made: the table; the layout is added to its habits.
        folder: for the files.
        rng: of the layout.
    """
    layout = str(rng.choice(list(LAYOUTS), p=list(LAYOUTS.values())))
    timed = made.columns[0].role == "t" and made.habits["clock"] not in ("clock", "iso", "index", "nothing")
    if layout not in ("text", "xlsx") and not (timed and all(c.digits is not None for c in made.columns)):
        layout = "text"
    if layout == "mat v4" and made.habits["clock"] == "days":
        layout = "text"
    made.habits["layout"] = layout
    if layout not in ("text", "xlsx"):
        made.habits["units"] = "not written"
    if made.habits["units"] == "not written":
        made.truth.asks = made.truth.asks or without_units(made)
    folder.mkdir(parents=True)
    columns = {_variable(c.name) or f"x{k + 1}": c.values for k, c in enumerate(made.columns)}
    names = list(columns)
    both = np.stack([c.values for c in made.columns])
    if layout == "text":
        return [_text(made, folder / "run.csv", rng)]
    if layout == "several files":
        return _several(made, folder)
    if layout == "xlsx":
        return [_workbook(made, folder / "run.xlsx")]
    if layout == "npz":
        np.savez(folder / "run.npz", **columns)
        return [folder / "run.npz"]
    holds: dict[str, Any] = columns
    if layout == "mat, one matrix":
        holds = {"data": both.T}
        _forget(made)
    elif layout in ("mat, To File", "mat v4"):
        holds = {"ans" if rng.random() < 0.5 else "Log": both}
        _forget(made)
    elif layout == "mat, structure with time":
        signals = np.array([(c.values[:, None], n) for c, n in zip(made.columns[1:], names[1:])],
                           dtype=[("values", object), ("label", object)])
        holds = {"ScopeData": {"time": made.columns[0].values[:, None], "signals": signals, "blockName": "rig/Scope"}}
    elif layout == "mat, timeseries":
        holds = {n: {"Time": made.columns[0].values[:, None], "Data": c.values[:, None], "Name": n}
                 for c, n in zip(made.columns[1:], names[1:])}
    scipy.io.savemat(folder / "run.mat", holds, format="4" if layout == "mat v4" else "5")
    return [folder / "run.mat"]


def _forget(made: Drawn) -> None:
    """A matrix has no names."""
    made.habits["names"] = "none"


def _variable(name: str) -> str:
    plain = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name).strip("_")
    return plain if plain[:1].isalpha() else ""


def _cell(column: Cells, k: int, decimal: str) -> str:
    if column.digits is None:
        return column.texts[k]
    text = f"{column.values[k]:.{column.digits}f}"
    return text.replace(".", ",") if decimal == "," else text


def _headed(column: Cells, style: str) -> str:
    if not column.unit or not column.name:
        return column.name
    return {"brackets": f"{column.name} [{column.unit}]", "round": f"{column.name} ({column.unit})",
            "slash": f"{column.name} / {column.unit}", "underscore": f"{column.name}_{column.unit}"}[style]


def _text(made: Drawn, path: Path, rng: np.random.Generator) -> Path:
    columns = made.columns
    mark = str(rng.choice(list(MARKS), p=[0.5, 0.2, 0.17, 0.08, 0.05]))
    split = MARKS[mark]
    decimal = "," if split in ";\t" and rng.random() < 0.4 else "."
    marks = [decimal] * len(columns)
    made.habits["decimal"] = {".": "point", ",": "comma"}[decimal]
    if split in ";\t" and rng.random() < 0.15:
        marks = [str(x) for x in rng.choice([".", ","], len(columns))]
        made.habits["decimal"] = "mixed"
    if split == " ":
        for column in columns:
            column.name = column.name.replace(" ", "_")
    made.habits["delimiter"] = mark
    style = str(rng.choice(["brackets", "round", "slash"] if split != " " else ["underscore"]))
    if any(column.unit in ("°", "%") for column in columns) and style == "underscore":
        style = "round"
    header = str(rng.choice(["plain", "comment", "title", "units line", "one more", "one less", "preamble"],
                            p=[0.6, 0.08, 0.08, 0.08, 0.05, 0.03, 0.08]))
    named = any(column.name for column in columns)
    lines: list[str] = []
    if named:
        made.habits["header"] = header
        names = [_headed(c, style) for c in columns]
        if header == "units line" and made.habits["units"] == "written" and all(c.unit for c in columns):
            lines = [split.join(c.name for c in columns), split.join(c.unit for c in columns)]
        elif header == "one more":
            lines = [split.join([*names, "aux9" if rng.random() < 0.5 else "temp"])]
        elif header == "one less" and len(names) > 3:
            lines = [split.join(names[:-1])]
        elif header == "comment":
            lines = ["# " + split.join(names)]
        elif header == "title":
            lines = ["Measurement 3", "", split.join(names)]
        elif header == "preamble":
            lines = ["% rig: arm 2", "% controller: on", "% operator: me", split.join(names)]
        else:
            lines = [split.join(names)]
    end = split if rng.random() < 0.05 and split != " " else ""
    lines += [split.join(_cell(c, k, m) for c, m in zip(columns, marks)) + end for k in range(len(columns[0].values))]
    encoding = str(rng.choice(["utf-8", "utf-8-sig", "utf-16"], p=[0.85, 0.1, 0.05]))
    line_end = "\r\n" if rng.random() < 0.4 else "\n"
    path.write_bytes((line_end.join(lines) + line_end).encode(encoding))
    return path


def _several(made: Drawn, folder: Path) -> list[Path]:
    """A file for each signal, with its own stamps."""
    t, paths = made.columns[0], []
    signals = sorted(made.columns[1:], key=lambda c: c.role != "y")
    for k, column in enumerate(signals):
        stem = _variable(column.name) or f"signal{k + 1}"
        path = folder / f"{k}_{stem}.csv" if (folder / f"{stem}.csv").exists() else folder / f"{stem}.csv"
        rows = [f"{_cell(t, i, '.')},{_cell(column, i, '.')}" for i in range(len(t.values))]
        head = [f"{t.name},{column.name}"] if column.name else []
        path.write_text("\n".join(head + rows) + "\n", encoding="utf-8")
        paths.append(path)
    return paths


def _workbook(made: Drawn, path: Path) -> Path:
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append([_headed(c, "brackets") for c in made.columns])
    for k in range(len(made.columns[0].values)):
        sheet.append([c.texts[k] if c.digits is None else float(c.values[k]) for c in made.columns])
    book.save(path)
    return path
