# SPDX-License-Identifier: Apache-2.0
"""Results of earlier runs of `make bench`: what was measured again, which ratios got worse, and what else changed."""

from pathlib import Path

from evaluation.results import Document, full, on_same, read

WORSE = 0.2
"""Increase of a ratio that is reported, if its quartiles do not overlap those of the run before either (choice)."""


def renewed(folder: Path) -> Document | None:
    """The latest full run of `make bench` with the sections measured again since (`--only`), listed in its "again"."""
    document = full(folder)
    if document is None:
        return None
    figures = {one["name"]: one for one in document["figures"]}
    missing, again = document["not_measured"], []
    for path in sorted(folder.glob("[0-9]*.json")):
        part = read(path)
        if (part and part.get("quick") is False and not part["full"] and part["date"] > document["date"]
                and on_same(part, document["machine"]) and not part["not_measured"] and "names" in part):
            figures |= {one["name"]: one for one in part["figures"]}
            missing = [line for line in missing if line.partition(":")[0] not in part["names"]]
            again.append(f"{', '.join(part['names'])} on {part['date'][:10]}, commit {part['machine']['commit']}")
    missed = [name for name, one in figures.items() if one["met"] is False]
    return {**document, "figures": list(figures.values()), "not_measured": missing, "missed": missed, "again": again}


def worse(now: Document, then: Document) -> list[str]:
    """The ratios that got worse, a line each."""
    old = {one["name"]: one for one in then["figures"]}
    lines = []
    for one in now["figures"]:
        a, b = one["ratio"], old.get(one["name"], {}).get("ratio")
        if not a or not b or one["peer_name"] != old[one["name"]]["peer_name"]:
            continue
        if (one["target"] or "").startswith("≥"):
            bad = a["median"] < b["median"] / (1.0 + WORSE) and a["q3"] < b["q1"]
        else:
            bad = a["median"] > b["median"] * (1.0 + WORSE) and a["q1"] > b["q3"]
        if bad:
            lines.append(f"{one['name']}: {a['median']:.3g} of {one['peer_name']}, was {b['median']:.3g} "
                         f"(load {one['load']:.1f}, was {old[one['name']]['load']:.1f})")
    return lines


def changed(now: Document, then: Document) -> str:
    """What else is not as it was: versions, commit, load."""
    a, b = now["machine"], then["machine"]
    rows = [(k, b.get(k, "none"), a.get(k, "none")) for k in dict.fromkeys([*b, *a]) if b.get(k) != a.get(k)]
    rows.append(("load", f"{then['load_before']:.1f}", f"{now['load_before']:.1f}"))
    return ", ".join(f"{name} {x} -> {y}" for name, x, y in rows)
