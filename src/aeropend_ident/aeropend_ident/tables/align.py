# SPDX-License-Identifier: Apache-2.0
"""Which name belongs to which column, where a header has one name more or less than there are columns.

The order of the names is kept. Each column that may have no name, or each name that may have no column, is tried. The
log odds of time, angle and command say how likely an alignment is; a gap at either end is likelier than one between.
A column has a name if all likely alignments agree on it. If some give it a name and the others none, the name has a
question mark, so that no other column is taken for what the name says.
"""

from __future__ import annotations

from dataclasses import replace

from aeropend_ident.tables.guess import SURE, log_odds
from aeropend_ident.tables.names import WEAK
from aeropend_ident.tables.table import Table
from aeropend_ident.tables.units import split_name
from aeropend_sim.wording import counted

UNSURE = "?"
"""End of a name that may belong to the column."""


def align(table: Table) -> Table:
    """Name the columns of a table with the names that its header has.

    Args:
        table: `head` has the names, if their number is not that of the columns.
    """
    head, width = table.head, len(table.columns)
    if not head:
        return table
    tried = [_named(table, names) for names in _alignments(head, width)]
    odds = [log_odds(one) - WEAK * (0 < k < len(tried) - 1) for k, one in enumerate(tried)]
    likely = [one for one, at in zip(tried, odds) if at > max(odds) - SURE]
    named = [{one.columns[k].name for one in likely} for k in range(width)]
    names = [_of(each) for each in named]
    unnamed = [k + 1 for k, name in enumerate(names) if not name or name.endswith(UNSURE)]
    note = f"{counted(len(head), 'name')} ({', '.join(head)}) for {counted(width, 'column')}: "
    if len(unnamed) == width:
        names = [""] * width
        note += "which belongs to which is not clear, so that columns have numbers only"
    else:
        note += "the numbers tell which belongs to which" + (
            f", but for column{'s' * (len(unnamed) > 1)} {', '.join(map(str, unnamed))}" if unnamed else "")
    return replace(_named(table, names), head=(), notes=(*table.notes, note))


def _of(names: set[str]) -> str:
    """The name of a column that has any of some names; "" stands for none."""
    if len(names) == 1:
        return min(names)
    given = names - {""}
    return min(given) + UNSURE if len(given) == 1 else ""


def _alignments(head: tuple[str, ...], width: int) -> list[list[str]]:
    """The names of the columns if one name is left out, or one column has none."""
    if len(head) == width + 1:
        return [[*head[:k], *head[k + 1 :]] for k in range(len(head))]
    if len(head) == width - 1:
        return [[*head[:k], "", *head[k:]] for k in range(width)]
    return []


def _named(table: Table, names: list[str]) -> Table:
    columns = [replace(column, name=name, unit=column.unit or split_name(name)[1])
               for column, name in zip(table.columns, names)]
    return replace(table, columns=tuple(columns))
