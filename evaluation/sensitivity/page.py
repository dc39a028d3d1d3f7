# SPDX-License-Identifier: Apache-2.0
"""docs/results/thresholds.md: each decision threshold, and what a change of it does to the verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

from evaluation.sensitivity.recordings import DURATION, FAINT, RECORDINGS
from evaluation.sensitivity.thresholds import Threshold

FACTORS = (0.7, 1.3)
"""Factors on a threshold."""

AFTERWARDS = ("diagnosis.report.", "diagnosis.experiment_design.", "diagnosis.batch.", "diagnosis.document.",
              "diagnosis.validation.")
"""Modules that run after the verdict, or beside it."""

Rows = Mapping[tuple[str, float], Mapping[str, Any]]
"""Threshold and factor -> "considered": recordings, and "verdicts": of those of them that it can act on."""


def not_varied(threshold: Threshold) -> str:
    """Why a threshold is not varied; "": it is."""
    if threshold.id.startswith(AFTERWARDS):
        return "acts after the verdict"
    return "" if threshold.value else "is zero"


KINDS = {"calibrated": "calibrated rigs", "faint": "calibrated rigs with faint effects",
         "driven": "uncalibrated rigs with the angle and the command alone", "decay": "free decays"}
"""Kind of rig in `RECORDINGS` -> words."""

COLUMNS = ("threshold", "value", "unit", "origin", "read in", "right ×0.7 / ×1 / ×1.3",
           "verdicts changed ×0.7 / ×1.3", "other decisions changed ×0.7 / ×1.3")
"""Head of the table."""

NOTES = (
    """"Read in" is the number of diagnoses that run a line with the threshold; the others cannot change. A whole number
    is rounded and changes by at least 1. For a probability or a share above 0.5 the distance to 1 is multiplied. "Other
    decisions" are the regions that are reported, the pairs of hypotheses that are not separable, the number of reasons
    for an unknown effect, and the parameters that are determined; they are counted where the verdict is the same.""",
    """`GROWTH`, `PEAK`, `NOTICEABLE`, `FORM_SHOWS`, `SCATTER` and `GOOD_ENOUGH` are ratios near 1. Times 0.7 they are
    below 1: noise then counts as a misfit, a true speed as a false capture, and a free swing as a push. A change of the
    verdict is then expected.""")
"""What the table does not say itself."""

@dataclass(frozen=True)
class Outcome:
    """What one change of a threshold does.

    Attributes:
        right: number of right verdicts.
        base: the same with the unchanged threshold.
        of: number of recordings.
        changed: recordings whose verdict (effects found, first effect, place) changed.
        besides: recordings whose other decisions changed: regions, rivals not ruled out, parameters determined.
        read: number of recordings whose diagnosis reads the threshold.
    """

    right: int
    base: int
    of: int
    changed: tuple[str, ...]
    besides: tuple[str, ...]
    read: int


def outcome(rows: Rows, before: Mapping[str, Any], threshold: Threshold, factor: float) -> Outcome | None:
    """The outcome of one change; None: not measured."""
    row = rows.get((threshold.id, factor))
    if row is None:
        return None
    names = [n for n in before if n in row["considered"]]
    after = {n: row["verdicts"].get(n, before[n]) for n in names}
    changed = tuple(n for n in names if after[n]["answer"] != before[n]["answer"])
    besides = tuple(n for n in names if n not in changed and after[n]["besides"] != before[n]["besides"])
    return Outcome(sum(after[n]["right"] for n in names), sum(before[n]["right"] for n in names), len(names), changed,
                   besides, len(row["verdicts"]))


def page(found: Sequence[Threshold], unchanged: Mapping[str, Any], rows: Rows) -> str:
    """The page as Markdown.

    Args:
        found: all thresholds.
        unchanged: date, commit and verdicts with unchanged thresholds.
        rows: verdicts with changed thresholds.
    """
    before = {name: row["verdict"] for name, row in unchanged["recordings"].items()}
    both: dict[str, tuple[Outcome, ...]] = {}
    for t in found:
        made = [o for f in FACTORS if (o := outcome(rows, before, t, f)) is not None]
        if len(made) == len(FACTORS) and not not_varied(t):
            both[t.id] = tuple(made)
    varied = [t for t in found if t.id in both and both[t.id][0].read]
    rest = [(t, not_varied(t) or ("not read in these diagnoses" if t.id in both else "not measured"))
            for t in found if t not in varied]
    right = sum(v["right"] for v in before.values())
    table = [f"| {' | '.join(COLUMNS)} |", "| --- " * len(COLUMNS) + "|", *(_row(t, both[t.id]) for t in varied)]
    unvaried = ["| threshold | value | unit | origin | why |", "| --- | --- | --- | --- | --- |"]
    unvaried += [f"| `{t.id}` | {t.value:g} | {t.unit} | {', '.join(t.origins)} | {why} |" for t, why in rest]
    return "\n\n".join([
        "# Decision thresholds and their sensitivity", *map(_wrapped, _introduction(unchanged, len(before), right)),
        "## What the verdict depends on", _wrapped(_summary(varied, both)),
        "## Thresholds that were varied", *map(_wrapped, NOTES), "\n".join(table),
        "## Thresholds that were not varied", "\n".join(unvaried)]) + "\n"


def _wrapped(text: str) -> str:
    return fill(" ".join(text.split()), 120, break_long_words=False, break_on_hyphens=False)


def _introduction(unchanged: Mapping[str, Any], count: int, right: int) -> list[str]:
    kinds = [sum(row[0] == kind for row in RECORDINGS) for kind in KINDS]
    parts = ", ".join(f"{n} of {words}" for n, words in zip(kinds, KINDS.values(), strict=True))
    return [f"""Measured on {unchanged['date']} with the diagnosis of commit {unchanged['commit']} by
        `python -m evaluation.sensitivity`. `python -m evaluation.sensitivity --docs` writes this page.""",
        f"""Each threshold of the diagnosis was multiplied by 0.7 and by 1.3, one at a time, and {count} simulated
        recordings were diagnosed with it: {parts}. The generator is that of `make blind`; no constant was tuned on
        these recordings. The calibrated rigs have one effect, two effects, none, or one outside the catalogue. After a
        refit of the parameters, a faint effect leaves a gap of {FAINT[0]:g} to {FAINT[1]:g} times the noise floor; the
        others leave 1.5 to 10 times the floor. A driven recording lasts {DURATION:g} s.""",
        f"""A verdict is right if it names all effects and no other, and the place of one of them. With unchanged
        thresholds {right} of {count} verdicts are right. The set is small: a threshold that changes nothing here may
        change the verdict on another recording. The table shows which thresholds matter; it gives no error rates."""]


def _summary(varied: Sequence[Threshold], both: Mapping[str, tuple[Outcome, ...]]) -> str:
    def most(t: Threshold) -> int:
        return max(len(o.changed) for o in both[t.id])

    strong = sorted((t for t in varied if most(t)), key=most, reverse=True)
    fall = sum(any(o.right < o.base for o in both[t.id]) for t in strong)
    same = len(varied) - len(strong)
    text = f"Of {len(varied)} thresholds that act on these recordings, {same} change no verdict at ±30 %."
    if not strong:
        return text
    named = "; ".join(f"`{t.id}` ({_changes(both[t.id])})" for t in strong)
    return (f"{text} The other {len(strong)} change one or more, and {fall} of them make fewer verdicts right. The "
            f"strongest first: {named}.")


def _changes(outcomes: Sequence[Outcome]) -> str:
    low, high = outcomes
    return f"×0.7 changes {len(low.changed) or 'none'}, ×1.3 {len(high.changed) or 'none'}"


def _row(t: Threshold, outcomes: Sequence[Outcome]) -> str:
    low, high = outcomes
    return (f"| `{t.id}` | {t.value:g} | {t.unit} | {', '.join(t.origins)} | {low.read} of {low.of} | "
            f"{low.right} / {low.base} / {high.right} | {len(low.changed)} / {len(high.changed)} | "
            f"{len(low.besides)} / {len(high.besides)} |")
