# SPDX-License-Identifier: Apache-2.0
"""Pictures of a blind check: confusion, accuracy against size, and calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.blind.score import SIZES, Calibration, Confusion, Figure


def draw_confusion(matrix: Confusion, path: Path) -> None:
    """The confusion matrix as PNG: counts, shaded by the share of their row."""
    from matplotlib.figure import Figure as Picture

    counts = np.array(matrix.counts, dtype=float).reshape(len(matrix.rows), len(matrix.columns))
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    picture = Picture(figsize=(3.2 + 0.36 * len(matrix.columns), 3.0 + 0.32 * max(len(matrix.rows), 1)), dpi=110,
                      layout="constrained")
    axes = picture.subplots()
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(matrix.columns)), matrix.columns, rotation=60, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(matrix.rows)), matrix.rows)
    axes.set_xticks(np.arange(len(matrix.columns) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(matrix.rows) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="0.85", linewidth=0.5)
    axes.tick_params(which="minor", length=0)
    for (j, k), n in np.ndenumerate(counts):
        if n:
            right = matrix.rows[j] == matrix.columns[k] or (
                matrix.rows[j].startswith("outside") and matrix.columns[k] == "unknown")
            dark = shares[j, k] > 0.55
            axes.text(k, j, f"{n:.0f}", ha="center", va="center", fontsize=9, fontweight="bold" if right else "normal",
                      color="white" if dark else "black" if right else "firebrick")
    axes.set_xlabel("verdict")
    axes.set_ylabel("truth")
    picture.savefig(path)


def draw_sizes(lines: Mapping[str, Sequence[Figure]], path: Path) -> None:
    """Shares against size as PNG, one line a name, with 95 % intervals."""
    from matplotlib.figure import Figure as Picture

    picture = Picture(figsize=(7.0, 4.2), dpi=110, layout="constrained")
    axes = picture.subplots()
    for j, (name, classes) in enumerate(lines.items()):
        x = [math.sqrt(SIZES[k] * SIZES[k + 1]) * (1.0 + 0.012 * (j - len(lines) / 2)) for k in range(len(classes))]
        _with_intervals(axes, x, classes, name)
    axes.set_xscale("log")
    axes.set_xticks(SIZES, [f"{s:g}" for s in SIZES])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("size of the effect, floors")
    axes.set_ylabel("share of recordings")
    axes.set_ylim(-0.03, 1.03)
    axes.legend(loc="lower right")
    picture.savefig(path)


def draw_calibration(c: Calibration, path: Path) -> None:
    """Hit rate against stated probability as PNG."""
    from matplotlib.figure import Figure as Picture

    picture = Picture(figsize=(4.6, 4.4), dpi=110, layout="constrained")
    axes = picture.subplots()
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    _with_intervals(axes, [math.nan if s is None else s for s in c.stated], c.classes, "first effect")
    for x, f in zip(c.stated, c.classes):
        if x is not None and f.value is not None:
            axes.annotate(f"{f.count}", (x, f.value), textcoords="offset points", xytext=(-6, 5), ha="right",
                          fontsize=8)
    axes.set_xlabel("probability stated")
    axes.set_ylabel("share that is right")
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    picture.savefig(path)


def _with_intervals(axes: Any, x: Sequence[float], classes: Sequence[Figure], name: str) -> None:
    known = [(p, f.value, f.low, f.high) for p, f in zip(x, classes)
             if f.value is not None and f.low is not None and f.high is not None]
    if known:
        where, value, low, high = (np.array(c) for c in zip(*known))
        spread = np.maximum(np.array([value - low, high - value]), 0.0)
        axes.errorbar(where, value, yerr=spread, marker="o", markersize=4, linewidth=1.2, capsize=2, label=name)
