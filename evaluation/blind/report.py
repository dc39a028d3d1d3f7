# SPDX-License-Identifier: Apache-2.0
"""The report of a blind check: tables, pictures and results.json, with the peers beside the diagnosis."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from evaluation.blind import page, pictures
from evaluation.blind.score import (
    KINDS,
    Answer,
    Calibration,
    Figure,
    Label,
    Pairs,
    against_limit,
    answer_of_diagnosis,
    answer_of_peer,
    besides,
    both,
    by_effect,
    by_size,
    calibration,
    confusion,
    figures,
    median,
    of_kind,
    pair,
    right_first,
    right_named,
    right_place,
    scored,
    share,
)

WIDTH = 116
"""Columns of the tables where no terminal says how many there are."""


def report(labels: Sequence[Mapping[str, Any]], verdicts: Mapping[str, Mapping[str, Any]],
           peers: Mapping[str, Mapping[str, Mapping[str, Any]]], out: Path,
           limits: Mapping[str, Mapping[str, Any]] | None = None, console: Console | None = None,
           conditions: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Score everything, print the tables, and write results.json, confusion.png, size.png, calibration.png.

    Args:
        labels: the opened labels.
        verdicts: recording -> diagnosis.json.
        peers: peer -> recording -> {"effects": [keys], "place": .., "seconds": ..}; a peer is scored on the recordings
            that it was given, beside the diagnosis on the same ones.
        out: folder, made if it is not there.
        limits: recording -> what `limit.limit` says.
        console: where the tables go.
        conditions: of the run, as `page.conditions` gives them.

    Returns:
        The content of results.json; `passed` says whether every target is met.
    """
    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)
    out.mkdir(parents=True, exist_ok=True)
    pairs = pair(labels, verdicts, answer_of_diagnosis)
    all_ = figures(pairs) + (against_limit(pairs, limits) if limits is not None else [])
    effects = {effect: [share("first", [right_first(t, a) for t, a in group]),
                        share("named", [right_named(t, a) for t, a in group]),
                        share("place", [right_place(t, a) for t, a in group])]
               for effect, group in by_effect(pairs).items()}
    beside = {}
    for name, said in peers.items():
        mine = [label for label in labels if label["name"] in said]
        beside[name] = (pair(mine, said, answer_of_peer),
                        [(t, a) for t, a in pairs if t.name in said])
    sizes = {"right effect first": by_size(pairs), "right place": by_size(pairs, right_place)}
    sizes |= {f"{name}: right effect first": by_size(theirs) for name, (theirs, _) in beside.items()}
    stated, matrix = calibration(pairs), confusion(pairs)

    _print_figures(console, f"Blind check, {len(pairs)} recordings", all_)
    for name, (theirs, ours) in beside.items():
        _print_beside(console, name, theirs, ours)
    _print_classes(console, "Each effect alone", effects, ("right first", "or named", "right place"))
    _print_classes(console, "Accuracy against size, floors",
                   {c.name: [s[j] for s in sizes.values()] for j, c in enumerate(sizes["right place"])}, list(sizes))
    _print_calibration(console, stated)
    pictures.draw_confusion(matrix, out / "confusion.png")
    pictures.draw_sizes(sizes, out / "size.png")
    pictures.draw_calibration(stated, out / "calibration.png")
    results = {
        "conditions": conditions,
        "recordings": {kind: len(of_kind(pairs, kind)) for kind in KINDS},
        "passed": all(f.met for f in all_ if f.judged),
        "figures": [f.document() for f in all_],
        "effects": {k: dict(zip(("right_first", "named", "right_place"), map(asdict, v))) for k, v in effects.items()},
        "peers": {name: {"recordings": len(theirs), "figures": [asdict(f) for f in _peer_figures(theirs)],
                         "diagnose": [asdict(f) for f in _peer_figures(ours)]}
                  for name, (theirs, ours) in beside.items()},
        "limits": limits,
        "size": {name: [asdict(f) for f in classes] for name, classes in sizes.items()},
        "calibration": asdict(stated),
        "confusion": asdict(matrix),
        "misses": [{"name": t.name, "kind": t.kind, "form": t.form, "size": t.size, "truth": sorted(t.keys),
                    "said": [a.first, *(f for f in a.found if f != a.first)], "named": list(a.named), "place": a.place}
                   for t, a in pairs if not _right(t, a)],
    }
    (out / "results.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    console.print(f"Pictures and results.json are in {out}")
    return results


def _right(t: Label, a: Answer) -> bool:
    return {"single": right_first(t, a), "none": a.first == "none" and not a.claims, "two": both(t, a),
            "outside": a.first == "unknown" and right_place(t, a)}[t.kind]


def _peer_figures(pairs: Pairs) -> list[Figure]:
    seconds = [a.seconds for _, a in pairs if a.seconds is not None]
    return [*scored(pairs), *besides(pairs), median("seconds, median", seconds, at_most=10.0)]


def _text(f: Figure) -> str:
    return page.value(asdict(f))


def _interval_text(f: Figure) -> str:
    return page.interval(asdict(f))


def _target_text(f: Figure) -> str:
    return page.target(asdict(f))


def _verdict_text(f: Figure) -> str:
    if not f.judged:
        return ""
    if f.value is None:
        return "[red]not measured[/]"
    return "[green]met[/]" if f.met else "[red]missed[/]"


def _print_figures(console: Console, title: str, rows: Sequence[Figure]) -> None:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("figure", "value", "95 %", "of", "target", ""):
        table.add_column(column, justify="left" if column in {"figure", ""} else "right")
    for f in rows:
        table.add_row(f.name, _text(f), _interval_text(f), str(f.count), _target_text(f), _verdict_text(f))
    console.print(table)


def _print_beside(console: Console, name: str, theirs: Pairs, ours: Pairs) -> None:
    table = Table(title=f"Beside {name}, on {len(theirs)} recordings", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("figure", "diagnose", "95 %", name, "95 %"):
        table.add_column(column, justify="left" if column == "figure" else "right")
    for mine, peer in zip(_peer_figures(ours), _peer_figures(theirs)):
        table.add_row(mine.name.partition(":")[0] if "worst" in mine.name else mine.name, _text(mine),
                      _interval_text(mine), _text(peer), _interval_text(peer))
    console.print(table)


def _print_classes(console: Console, title: str, rows: Mapping[str, Sequence[Figure]], names: Sequence[str]) -> None:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("")
    table.add_column("of", justify="right")
    for name in names:
        table.add_column(name, justify="right")
    for row, each in rows.items():
        table.add_row(row, str(each[0].count), *(_text(f) for f in each))
    console.print(table)


def _print_calibration(console: Console, c: Calibration) -> None:
    brier = "" if c.brier is None else (f"; Brier score {c.brier:.4f} (stating the base rate: "
                                        f"{c.brier_of_base_rate:.4f})")
    table = Table(title=f"Probability of the first effect{brier}", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("stated", "of", "mean stated", "right", "95 %"):
        table.add_column(column, justify="right")
    for f, mean in zip(c.classes, c.stated):
        if f.count:
            table.add_row(f.name, str(f.count), f"{100.0 * (mean or 0.0):.1f} %", _text(f), _interval_text(f))
    console.print(table)
