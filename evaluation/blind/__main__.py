# SPDX-License-Identifier: Apache-2.0
"""The blind check: recordings of withheld effects are made, diagnosed, and only then compared with their labels.

    make blind                            312 recordings of 70 s: about an hour on two cores, 2.5 GB
    make blind ARGS="--count 60 --seed 7"
    make blind ARGS="--uncalibrated --count 120"    uncalibrated rigs
    make blind ARGS="--circumstances --count 100"   rigs as they are: many imperfections, feedback, lost samples
    make blind ARGS="--without --count 60"          what the catalogue does not hold: flagged, placed, learned
    make blind ARGS="--forms --count 60"            effects that follow another law than the catalogue has
    make blind ARGS="--sequential --count 60"       experiments by design: limits, pairs, one after another
    make blind ARGS=--docs                          the table of the last run goes into docs/results/blind.md

Steps can be run alone: --steps make,diagnose,peers,score. The labels stay sealed until every verdict is written.
"""

from __future__ import annotations

import argparse
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from aeropend_ident.bags import recording
from aeropend_ident.signals.from_bag import from_recording
from aeropend_ident.testing import bags
from aeropend_sim.model.effects import RANDOM
from aeropend_sim.model.parameters import load
from evaluation.blind import (
    cases,
    circumstances,
    folder,
    forms,
    limit,
    open_set,
    page,
    pairs,
    peers,
    plant,
    report,
    score,
    sequential,
    uncalibrated,
)

SPARSE, BIC = "sparse regression of the discrepancy (pysindy)", "stepwise BIC on output error"
SHARES = {"single": 0.54, "none": 0.18, "two": 0.14, "outside": 0.14}


def plan(count: int, seed: int) -> list[tuple[str, list[str], str, bool]]:
    """Kind, effects, form and whether the loop is closed, of each recording; every effect as often as any other."""
    rng = np.random.default_rng([seed, 1])
    inside, outside = [*plant.EFFECTS, "parameter_mismatch"], list(plant.OUTSIDE)
    singles = round(SHARES["single"] * count)
    rows: list[tuple[str, list[str], str, bool]] = []
    order = [e for _ in range(singles // len(inside) + 1) for e in rng.permutation(inside)]
    rows += [("single", [str(e)], str(rng.choice(["table", "other"])), bool(rng.random() < 0.1))
             for e in order[:singles]]
    rows += [("none", [], "table", bool(rng.random() < 0.1)) for _ in range(round(SHARES["none"] * count))]
    rows += [("two", [str(e) for e in rng.choice(list(plant.EFFECTS), 2, replace=False)],
              str(rng.choice(["table", "other"])), False) for _ in range(round(SHARES["two"] * count))]
    order = [e for _ in range(count // len(outside) + 1) for e in rng.permutation(outside)]
    rows += [("outside", [str(e)], "table", False) for e in order[: round(SHARES["outside"] * count)]]
    return [rows[k] for k in rng.permutation(len(rows))]


def make(out: Path, count: int, seed: int, duration: float, jobs: int) -> None:
    """Make the recordings, and seal their labels."""
    nominal = load(folder.MODEL)

    def one(k: int, row: tuple[str, list[str], str, bool]) -> dict[str, object]:
        kind, effects, form, closed = row
        case, columns = cases.draw(f"r{k:03d}", kind, effects, form, nominal.model, nominal.sensing,
                                   seed * 100_003 + k, duration, closed_loop=closed)
        bags.write(out / "recordings" / case.name, columns, round(plant.PERIOD * 1e9))
        return case.label()

    folder.make_all(out, plan(count, seed), one, jobs)


def ask_peers(out: Path, jobs: int, every: int) -> None:
    """Write what two peers say: sparse regression of every recording, stepwise BIC of one in `every`: it is slow."""
    model = load(folder.MODEL)

    def one(_: int, row: tuple[str, str]) -> tuple[str, str, dict[str, Any]]:
        peer, name = row
        signals = from_recording(recording.read(str(out / "recordings" / name)), model.sensing)
        answer = peers.sparse_regression if peer == SPARSE else peers.stepwise_bic
        return peer, name, answer(signals, model)

    names = folder.names(out)
    rows = [(SPARSE, n) for n in names] + [(BIC, n) for n in names[::every]]
    answers: dict[str, dict[str, Any]] = {SPARSE: {}, BIC: {}}
    for peer, name, answer in folder.each("asking peers", rows, one, jobs):
        answers[peer][name] = answer
    (out / "peers.json").write_text(json.dumps(answers))


def limits(out: Path, labels: list[dict[str, Any]], jobs: int) -> dict[str, Any]:
    """What a likelihood test that knows both hypotheses would reach, for the single effects of the table's form."""
    model = load(folder.MODEL)

    def one(_: int, label: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        signals = from_recording(recording.read(str(out / "recordings" / label["name"])), model.sensing)
        effect = label["effects"][0]
        return label["name"], limit.limit(label["numbers"], {effect["effect"]: effect["parameters"]}, signals.duty,
                                          signals.sigma)

    rows = [c for c in labels if c["kind"] == "single" and c["form"] == "table" and not c["closed_loop"]
            and c["effects"][0]["effect"] not in RANDOM]
    return dict(folder.each("finding the limit", rows, one, jobs))


def _other_rigs(options: argparse.Namespace, steps: list[str]) -> None:
    name, make_all, report_, fit_nominal = (
        ("circumstances", partial(circumstances.make_all, only=options.row), circumstances.report, False)
        if options.circumstances else
        ("unknown", uncalibrated.make, uncalibrated.report, True))
    out = options.out / name
    if "make" in steps:
        shutil.rmtree(out, ignore_errors=True)
        make_all(out, options.count, options.seed, options.duration, options.jobs)
    if "diagnose" in steps:
        folder.diagnose_all(out, options.jobs, fit_nominal=fit_nominal)
    if "score" in steps:
        _save(out, report_(out), options)


def _save(out: Path, found: list[score.Figure], options: argparse.Namespace) -> None:
    made = {"conditions": page.conditions(options.count, options.seed), "figures": [f.document() for f in found]}
    (out / "results.json").write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Run the steps asked for."""
    parser = argparse.ArgumentParser(prog="blind", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=312, help="recordings (default 312)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=70.0, help="s of each recording (default 70)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--out", type=Path, default=Path("blind-results"))
    parser.add_argument("--steps", default="make,diagnose,peers,score")
    parser.add_argument("--bic-every", type=int, default=4, help="ask stepwise BIC for one recording in so many")
    parser.add_argument("--only", nargs="*", default=[], help="diagnose only these recordings")
    parser.add_argument("--uncalibrated", "--unknown", action="store_true",
                        help="uncalibrated rigs: angle and command alone, and free decays")
    parser.add_argument("--circumstances", action="store_true",
                        help="rigs with many small imperfections, in closed loop, with wrong noise and lost samples")
    parser.add_argument("--row", choices=list(circumstances.ROWS), default="", metavar="CIRCUMSTANCE",
                        help="only this circumstance, as messy")
    parser.add_argument("--pairs", action="store_true",
                        help="pairs of recordings of one rig between which something was changed, or nothing")
    parser.add_argument("--without", action="store_true",
                        help="open set: effects outside the catalogue, and each effect of it left out of the catalogue")
    parser.add_argument("--forms", action="store_true", help="effects that follow another law than docs/effects.md has")
    parser.add_argument("--sequential", action="store_true",
                        help="experiments by design: limits, pairs of effects, and one experiment after another")
    parser.add_argument("--docs", action="store_true",
                        help="run nothing, write the table of the last run into docs/results")
    options = parser.parse_args()
    steps = options.steps.split(",")
    if options.docs:
        part, name = (("unknown", "uncalibrated") if options.uncalibrated else
                      ("circumstances", "circumstances") if options.circumstances else
                      ("pairs", "pairs") if options.pairs else
                      ("open_set", "open_set") if options.without else
                      ("forms", "forms") if options.forms else
                      ("sequential", "design") if options.sequential else ("", "blind"))
        page.write(options.out / part, name)
        return
    if options.pairs or options.without or options.forms or options.sequential:
        name, report_ = (("pairs", pairs.report) if options.pairs else ("open_set", open_set.report) if options.without
                         else ("forms", forms.report) if options.forms else ("sequential", sequential.report))
        out = options.out / name
        out.mkdir(parents=True, exist_ok=True)
        _save(out, report_(options.count, options.seed, options.duration, options.jobs), options)
        return
    if options.circumstances or options.uncalibrated:
        _other_rigs(options, steps)
        return
    if "make" in steps:
        shutil.rmtree(options.out, ignore_errors=True)
        make(options.out, options.count, options.seed, options.duration, options.jobs)
    if "diagnose" in steps:
        folder.diagnose_all(options.out, options.jobs, options.only)
    if "peers" in steps:
        ask_peers(options.out, options.jobs, options.bic_every)
    if "score" in steps:
        labels, verdicts = folder.opened(options.out)
        asked = options.out / "peers.json"
        answers = json.loads(asked.read_text()) if asked.exists() else {}
        known = limits(options.out, labels, options.jobs) if answers else None
        report.report(labels, verdicts, answers, options.out, known,
                      conditions=page.conditions(len(verdicts), options.seed))


if __name__ == "__main__":
    main()
