# SPDX-License-Identifier: Apache-2.0
"""A recording as a table, so that the unit, the sign, the zero or the place of a channel in it can be set right."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from aeropend_ident.bags import recording
from aeropend_ident.bags.container import STORAGES
from aeropend_ident.tables.mapping import CHANNELS
from aeropend_ident.tables.table import SHOWN, Column, Floats, Table, check_size
from aeropend_ident.tables.units import TURN

AS_RECORDED = {"time": "t:s", "theta": "theta:rad", "omega": "omega:rad/s", "current": "i_a:A", "voltage": "v_a:V",
               "duty": "duty:1", "reference": "reference:rad"}
"""Quantity -> its column and unit in a recording (docs/interfaces.md)."""


def is_recording(path: Path) -> bool:
    """Whether a file or a folder is a recording, by its name."""
    return path.is_dir() or path.suffix in STORAGES


def read(path: Path, namespace: str | None = None) -> Table:
    """Read a recording as a table: t, the channels, the reference and other joints, each as it was recorded.

    Args:
        path: a rosbag2 folder, or a bare .mcap or .db3 file.
        namespace: of the rig, if the recording holds several.

    Raises:
        RecordingError: it cannot be used.
        TableError: it is too long.
    """
    read_ = recording.read(path, namespace, judged=False)
    check_size(len(read_), len(AS_RECORDED), path)
    columns = {"t": read_.t} | {name: getattr(read_, name) for name in CHANNELS.values()}
    if len(read_.reference):
        last = np.searchsorted(read_.reference_ns, read_.received_ns, side="right") - 1
        columns["reference"] = np.where(last >= 0, read_.reference[last], np.nan)
    columns |= {name: x for name, x in read_.others.items() if name not in columns}
    kept = {name: np.where(np.isfinite(x), x, np.nan) for name, x in columns.items()}
    return Table(path, tuple(_column(name, x) for name, x in kept.items() if np.isfinite(x).any()),
                 np.arange(1, len(read_) + 1), read_.notes)


def options(table: Table, said: Mapping[str, str]) -> dict[str, str]:
    """The options for all columns of a recording: those of the user, and the others as they were recorded.

    Args:
        table: the recording.
        said: quantity -> column, of the user.
    """
    taken = {text.partition(":")[0] for text in said.values()}
    columns = {column.name: column for column in table.columns}
    out = {quantity: text for quantity, text in AS_RECORDED.items()
           if quantity not in said and text.partition(":")[0] in columns.keys() - taken}
    if "reference" in out and np.nanmax(np.abs(columns["reference"].values)) > TURN:  # of a speed: no angle is as large
        out["reference"] = "reference:rad/s"
    return {**out, **said}


def _column(name: str, values: Floats) -> Column:
    first = values[np.isfinite(values)][:SHOWN]
    return Column(name, values, shown=tuple(f"{value:.10g}" for value in first))
