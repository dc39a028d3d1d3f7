# SPDX-License-Identifier: Apache-2.0
"""The README's table of figures, from the results of a run."""

from collections.abc import Mapping
from typing import Any

from evaluation.benchmarks.measure import number


def _cell(spread: Mapping[str, float] | None, unit: str) -> str:
    if not spread:
        return ""
    text = number(spread["median"], unit)
    return text if spread["repeats"] == 1 else f"{text} [{number(spread['q1'], '')} .. {number(spread['q3'], '')}]"


def table(document: Mapping[str, Any]) -> str:
    """The main figures as Markdown, on which machine, when and of what they were measured, and the notes to them."""
    lines = ["| figure | ours | peer | ratio | target | met |", "| --- | --- | --- | --- | --- | --- |"]
    for one in document["figures"]:
        if one["main"]:
            peer = one["peer_name"] and f"{one['peer_name']}: {_cell(one['peer'], one['unit'])}"
            met = {True: "yes", False: "**no**", None: ""}[one["met"]]
            ours, ratio = _cell(one["ours"], one["unit"]), _cell(one["ratio"], "")
            cells = (one["name"], ours, peer, ratio, one["target"] or "", met)
            lines.append("| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |")
    judged = [one["met"] for one in document["figures"] if one["met"] is not None]
    machine = document["machine"]
    said = (f"Median [quartiles] of {machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, "
            f"{document['date'][:10]}, commit {machine['commit']}, load {document['load_before']:.1f} at the start. "
            f"Of all targets {sum(judged)} of {len(judged)} are met")
    missed = [*document["missed"], *document["not_measured"]]
    notes = [f"- {one['name']}: {one['note']}" for one in document["figures"] if one["main"] and one["note"]]
    said += f"; not: {'; '.join(missed)}." if missed else "."
    said += f" Measured again since: {'; '.join(document['again'])}." if document["again"] else ""
    return "\n".join([*lines, "", said, *([""] if notes else []), *notes])
