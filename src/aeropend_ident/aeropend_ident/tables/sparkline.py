# SPDX-License-Identifier: Apache-2.0
"""A small picture of a column, in one line of text."""

from __future__ import annotations

import numpy as np

from aeropend_ident.tables.table import Floats

BLOCKS, LETTERS = "▁▂▃▄▅▆▇█", "_.-~=+*#"
"""From low to high, for terminals that show block elements, and for those that do not."""

WIDTH = 24
"""Number of characters (choice)."""


def sparkline(values: Floats, encoding: str | None = "utf-8") -> str:
    """A picture of numbers (N,): one character for each part, by its mean; a blank where nothing is known.

    Args:
        values: the numbers; NaN if missing.
        encoding: of the terminal.
    """
    marks = BLOCKS
    try:
        BLOCKS.encode(encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        marks = LETTERS
    parts = [part[np.isfinite(part)] for part in np.array_split(values, min(WIDTH, max(len(values), 1)))]
    means = np.array([part.mean() if len(part) else np.nan for part in parts])
    if not np.isfinite(means).any():
        return ""
    low, span = np.nanmin(means), float(np.nanmax(means) - np.nanmin(means))
    levels = (means - low) / span * (len(marks) - 1) if span > 0.0 else np.where(np.isfinite(means), 0.0, np.nan)
    return "".join(" " if np.isnan(level) else marks[round(float(level))] for level in levels)
