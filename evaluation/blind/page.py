# SPDX-License-Identifier: Apache-2.0
"""The figures of a blind check as text: lines, and the tables of docs/results."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from evaluation import results
from evaluation.blind import score

Figure = Mapping[str, Any]
"""A `score.Figure` as JSON."""


def conditions(count: int, seed: int) -> dict[str, Any]:
    """The conditions of a run: date, machine, and the options that decide which recordings are made."""
    return {"date": f"{datetime.now().astimezone():%Y-%m-%d}", "machine": results.machine(), "count": count,
            "seed": seed}


def value(figure: Figure) -> str:
    """The value of a figure, in % if it is a share."""
    if figure["value"] is None:
        return "-"
    return f"{100.0 * figure['value']:.1f} %" if figure["share"] else f"{figure['value']:.3g}"


def interval(figure: Figure) -> str:
    """The 95 % interval of a figure, empty if it has none."""
    if figure["low"] is None or figure["high"] is None:
        return ""
    return f"{100.0 * figure['low']:.1f} to {100.0 * figure['high']:.1f}" if figure["share"] else \
        f"{figure['low']:.3g} to {figure['high']:.3g}"


def target(figure: Figure) -> str:
    """The target of a figure, empty if it has none."""
    scale, unit = (100.0, " %") if figure["share"] else (1.0, "")
    low, high = figure["at_least"], figure["at_most"]
    if low is not None and high is not None:
        return f"{scale * low:g} to {scale * high:g}{unit}"
    if low is not None:
        return f"at least {scale * low:g}{unit}"
    return f"at most {scale * high:g}{unit}" if high is not None else ""


def line(figure: Figure) -> str:
    """A figure as a line of text: value, 95 % interval, count, target, and whether it is met."""
    if figure["value"] is None:
        return f"{figure['name']}: nothing to measure"
    between = f" (95 %: {interval(figure)})" if interval(figure) else ""
    goal = f", {target(figure)}: {'met' if figure['met'] else 'MISSED'}" if target(figure) else ""
    return f"{figure['name']}: {value(figure)}{between} of {figure['count']}{goal}"


def printed(figures: list[score.Figure]) -> list[score.Figure]:
    """The figures, after each was printed in a line."""
    for f in figures:
        print(line(f.document()))
    return figures


def closed(share: float | None) -> str:
    """How much of the closable gap closes; None if there was nothing to close."""
    return "nothing to close" if share is None else f"{100.0 * share:.0f} % closed"


def table(document: results.Document) -> str:
    """All figures as Markdown, the peers beside them where they have the same figure, and the conditions of the run.

    Args:
        document: "conditions" and "figures"; "peers" as in the results.json of `report`, if some were asked.
    """
    peers: dict[str, dict[str, Figure]] = {name: {f["name"]: f for f in one["figures"]}
                                           for name, one in document.get("peers", {}).items()}
    rows = [["figure", "value", "95 %", "of", "target", "met", *peers]]
    for f in document["figures"]:
        met = {True: "yes", False: "**no**", None: ""}[f["met"]]
        beside = [value(theirs[f["name"]]) if f["name"] in theirs else "" for theirs in peers.values()]
        rows.append([f["name"], value(f), interval(f), str(f["count"]), target(f), met, *beside])
    return "\n".join([*markdown(rows), "", said(document)])


def markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table; the first row is its head."""
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return [lines[0], "|" + " --- |" * len(rows[0]), *lines[1:]]


def said(document: results.Document) -> str:
    """When, where and with which options a run was made."""
    run = document["conditions"]
    machine = run["machine"]
    beside = "".join(f" {name} was asked for {one['recordings']} of them." for name, one
                     in document.get("peers", {}).items())
    return (f"Measured on {run['date']}: {run['count']} recordings, seed {run['seed']}, commit {machine['commit']}, "
            f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}.{beside}")


def write(folder: Path, name: str) -> None:
    """Write the table of a run into its page.

    Args:
        folder: with the results.json of the run.
        name: "blind" or "uncalibrated", the page in docs/results.

    Raises:
        SystemExit: there is no results.json, or the page has no place for the table; one line.
    """
    page = results.ROOT / "docs" / "results" / f"{name}.md"
    try:
        document = json.loads((folder / "results.json").read_text(encoding="utf-8"))
        page.write_text(results.put(page.read_text(encoding="utf-8"), name, table(document)), encoding="utf-8")
    except FileNotFoundError as error:
        raise SystemExit(f"blind: {error.filename} does not exist: run make blind first") from None
    except ValueError as error:
        raise SystemExit(f"blind: {page}: {error}") from None
    print(page.relative_to(results.ROOT))
