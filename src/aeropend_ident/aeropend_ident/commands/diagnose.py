# SPDX-License-Identifier: Apache-2.0
"""The command `diagnose`: recordings in, verdict out.

Exit code 0 with a verdict, 1 if it breaks a rule of `--fail-on`, 2 with one line on standard error when the input
cannot be used.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.diagnosis import batch, checks, dask_cluster, since
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.document import Across, DocumentError, Identified
from aeropend_ident.diagnosis.document import read as read_document
from aeropend_ident.diagnosis.policy import MATERIAL_SHARE
from aeropend_ident.diagnosis.results import FILES, Results, document, with_would_show
from aeropend_ident.diagnosis.validation import validate
from aeropend_ident.interrupt import interrupts_wait
from aeropend_ident.result_folder import ensure_free, folder_names
from aeropend_ident.signals.from_bag import signals_of
from aeropend_ident.signals.signals import Mounting
from aeropend_ident.signals.variants import SAME, Variant, VariantError
from aeropend_ident.signals.variants import read as read_variants
from aeropend_sim.cli import browser
from aeropend_sim.cli.command import Parser, between, entry_point, own
from aeropend_sim.cli.progress import progress
from aeropend_sim.errors import UserError
from aeropend_sim.model import effect_file
from aeropend_sim.model.parameters import PRESETS, load
from aeropend_sim.untrusted import printable

BROKEN = 1
"""Exit code if the verdict breaks a rule of `--fail-on` (convention: 1 is the answer no)."""

EXAMPLES = """examples:
  diagnose my_bag                                compare a recording with the preset 'bench'
  diagnose monday tuesday --model rig.yaml       several recordings of one rig, fitted together
  diagnose monday --test tuesday                 fit one recording, and test on another how far the gap closes
  diagnose empty loaded --variants variants.yaml known variants of a rig, as with a payload
  diagnose tuesday --since diagnosis_monday      what has changed since an earlier verdict of the rig (or several)
  diagnose --each rigs/* --out verdicts          recordings of different rigs: a verdict each, and a table
  diagnose --each rigs/* --dask tcp://host:8786  the same on a Dask cluster (pip install 'aeropend_ident[dask]')
  diagnose let_go --uncalibrated                 a rig without a model file; a free decay needs no command
  diagnose my_bag --effects my_effects.yaml      try effects by formula too (docs/guide/effects.md)
  diagnose my_bag --open                         show the report in the browser
  diagnose my_bag --out verdict --jobs 2         choose the folder and the number of processes
  diagnose my_bag --fail-on "gap>5%" --fail-on unknown --junit verdict.xml       for a machine that decides
  plant --ros-args --params-file verdict/augmented.yaml      simulate the augmented model

rules of --fail-on:
  gap>5%                 the gap on held-out data is larger than this share of the signals' spread; so gap_after, and
                         closed<90% of the share that closes
  coulomb_friction>10%   this effect is claimed with a larger share of the squared gap; share>10%: any effect
  coulomb_friction       it is claimed at all
  effect, unknown, cannot_tell, not_separable, not_determined       the verdict is so

exit codes: 0 a verdict was written, 1 it breaks a rule of --fail-on, 2 the input cannot be used (one line says why),
130 interrupted"""


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line if it is wrong."""
    parser = Parser(
        prog="diagnose", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Compare recordings of a rig with its model: where they differ, which effect the model lacks, and "
                    "how far the gap closes with that effect.")
    parser.add_argument("bags", nargs="+", metavar="BAG",
                        help="a recording (folder, .mcap or .db3); several are of one rig, unless --each is given")
    parser.add_argument("--each", action="store_true",
                        help="the recordings are of different rigs: a verdict each in DIR/<name of the bag>, "
                             f"and a table in DIR/{batch.SUMMARY}")
    parser.add_argument("--model", metavar="PRESET|FILE",
                        help=f"nominal model: {' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--out", metavar="DIR",
                        help="folder for the results (default: diagnosis_<name of the bag>; with --each: diagnoses)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if a bag holds several")
    parser.add_argument("--held-out", type=between(0.05, 0.8, "a share"), default=0.3, metavar="SHARE",
                        help="share at the end of each recording that nothing is fitted to (default: 0.3)")
    parser.add_argument("--test", action="append", default=[], metavar="BAG",
                        help="a further recording of the rig, on which the gap is measured but nothing is fitted; may "
                             "be given several times")
    parser.add_argument("--jobs", type=_jobs, metavar="N",
                        help="processes (default: one a core); verdicts do not depend on it")
    parser.add_argument("--dask", metavar="ADDRESS",
                        help="with --each: address of the scheduler of a Dask cluster whose workers diagnose")
    parser.add_argument("--fit-nominal", "--uncalibrated", action="store_true",
                        help="the parameters of the rig are not known: identify its nominal model from the recordings "
                             "first; the command may be missing if the arm swings freely")
    parser.add_argument("--since", action="append", default=[], metavar="DIR",
                        help="folder of an earlier verdict of the rig, whose model is the nominal one: the verdict is "
                             "what has changed; several show how far the rig differs from run to run")
    parser.add_argument("--variants", metavar="FILE",
                        help="file that says which parameters of the model differ in which recordings, as with a "
                             "payload or another propeller")
    parser.add_argument("--material", type=between(0.0, 1.0, "a share"), default=MATERIAL_SHARE, metavar="SHARE",
                        help="share of the squared gap from which an effect is claimed; smaller ones are listed as "
                             f"small (default: {MATERIAL_SHARE:g})")
    parser.add_argument("--seconds", type=between(0.0, 1e6, "a time", "s"), metavar="S",
                        help="how long identification and search may take; what has begun is brought to an end, and a "
                             "note tells if more time could change the verdict (default: a number of simulations "
                             "bounds the search for uncalibrated rigs)")
    parser.add_argument("--effects", action="append", default=[], metavar="FILE",
                        help="effect file: effects by formula that are tried beside those of the catalogue; may be "
                             "given several times")
    parser.add_argument("--fail-on", action="append", default=[], metavar="RULE",
                        help="end with exit code 1 if the verdict is so, see below; may be given several times")
    parser.add_argument("--junit", metavar="FILE",
                        help="write what each rule of --fail-on says as JUnit XML; the file is replaced")
    parser.add_argument("--overwrite", action="store_true", help="replace results in the folder")
    parser.add_argument("--open", action="store_true", help="show the report in the browser")
    options = parser.parse_args(arguments)
    if options.dask is not None and not options.each:
        parser.error("--dask needs --each: it distributes recordings of different rigs")
    if options.dask is not None and options.jobs is not None:
        parser.error("--dask uses all workers of the cluster: leave --jobs out")
    for other in ("model", "fit_nominal", "each"):
        if options.since and getattr(options, other):
            parser.error(f"--since and --{other.replace('_', '-')} contradict each other: leave the second out"
                         + (", the earlier verdict has the model of the rig" if other != "each" else ""))
    for other in ("fit_nominal", "each", "since"):
        if options.variants and getattr(options, other):
            parser.error(f"--variants and --{other.replace('_', '-')} contradict each other: leave one out")
    options.model = options.model or "bench"
    if options.open and options.each:
        parser.error("--open shows one report: leave --each out")
    if options.test and options.each:
        parser.error("--test needs recordings of one rig: leave --each out")
    if options.junit and not options.fail_on:
        parser.error("--junit writes what rules say: give at least one --fail-on")
    for option, paths in (("", [] if options.each else options.bags), ("--test ", options.test),
                          ("--since ", options.since)):
        if twice := [path for k, path in enumerate(paths) if any(_same(path, other) for other in paths[:k])]:
            parser.error(f"{option}{twice[0]} is given twice, and would count twice: give it once")
    for bag in options.test:
        if any(_same(bag, fitted) for fitted in options.bags):
            parser.error(f"--test {bag}: nothing may be fitted to a test recording; give it once")
    options.jobs = options.jobs or os.cpu_count() or 1
    return options


def _same(one: str, other: str) -> bool:
    """Whether two paths are of one recording or verdict: the same place, or a bag's folder and a file of it."""
    both = {Path(os.path.realpath(one)), Path(os.path.realpath(other))}
    return len(both) == 1 or any(path.is_file() and path.parent in both for path in both)


def _jobs(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of processes from 1 on")
    return int(text)


def identified_with(model: Path) -> Identified | None:
    """How a model file was identified, if it is that of a verdict on an uncalibrated rig."""
    verdict = model.parent / "diagnosis.json"
    if model.name != "augmented.yaml" or not verdict.is_file():
        return None
    try:
        return read_document(verdict).identified
    except DocumentError:
        return None


def run(options: argparse.Namespace, command: str, rules: Sequence[checks.Rule]) -> list[checks.Outcome]:
    """Diagnose recordings of one rig together and write the results.

    Returns:
        What rules say of the verdict.

    Raises:
        RecordingError, ModelError, OutputError: the input or the output cannot be used.
    """
    started = time.monotonic()
    out = Path(options.out or f"diagnosis_{folder_names(options.bags[:1], [batch.SUMMARY])[0]}")
    ensure_free(out, FILES, overwrite=options.overwrite)
    known, uncalibrated, further = None, options.fit_nominal, effect_file.load_all(options.effects)
    if options.since:
        model, known, verdicts = since.read([Path(folder) for folder in options.since])
        of_rig = verdicts[-1].identified
        uncalibrated = of_rig is not None
    else:
        model = load(options.model)
        if of_rig := identified_with(Path(options.model)):
            print(printable(f"diagnose: {options.model} was identified by a diagnosis, and --since "
                            f"{Path(options.model).parent} knows how surely; with --model every parameter counts as "
                            "known to 5 %"), file=sys.stderr)
    variants: dict[str, Variant] = {}
    if options.variants:
        variants = read_variants(options.variants, [*options.bags, *options.test], model)
        if wrong := [bag for bag in options.test if variants.get(bag, SAME).unknown]:
            raise VariantError(f"--test {wrong[0]}: {variants[wrong[0]].unknown[0]} is unknown there, so that no model "
                               "can be tested on it; fit it along, or give the number")
        options.bags = sorted(options.bags, key=variants.__contains__)  # the rig as the model states it comes first
    with progress("reading") as show:
        mounting = of_rig.mounting if of_rig else None
        signals, tests = ([signals_of(bag, options.namespace, variants.get(bag, SAME).of(model), options.held_out,
                                      fit_nominal=uncalibrated, mounting=mounting) for bag in bags]
                          for bags in (options.bags, options.test))
        if of_rig is not None:
            signals = [(of_rig.mounting or Mounting()).of(s) for s in signals]
        signals = [replace(s, variant=variants.get(bag, SAME)) for bag, s in zip(options.bags, signals, strict=True)]
        with interrupts_wait():
            found = diagnose(model, signals, options.jobs, fit_nominal=options.fit_nominal, material=options.material,
                             seconds=options.seconds, known=known, further=further,
                             progress=lambda what, share: show(share, what))
        alike = found.signals[0].mounting or Mounting()
        tests = [alike.of(s) for s in tests]
        its = [variants.get(bag, SAME) for bag in options.test]
        shown = [Across(bag, **vars(validate(v.of(found.model), v.of(found.augmented), s)))
                 for bag, v, s in zip(options.test, its, tests, strict=True)]
        nominal = " and ".join(options.since) or options.model
        made = document(found, options.bags, nominal, time.monotonic() - started, shown)
        if made.which.verdict == "none" and of_rig is None and not uncalibrated and not options.since:
            show(1.0, "what would have shown")
            made = with_would_show(made, found, further, options.material, options.jobs)
            made = replace(made, seconds=round(time.monotonic() - started, 2))
        results = Results.of(found, made, command)
    results.write(out, overwrite=options.overwrite)
    print("\n".join(results.lines))
    print(printable(f"{out / 'report.html'}   {out / 'augmented.yaml'}   {results.document.seconds} s"))
    if options.open and (why_not := browser.show(out / "report.html")):
        print(printable(f"diagnose: {why_not}"), file=sys.stderr)
    return checks.check(results.document, rules)


def run_each(options: argparse.Namespace, rules: Sequence[checks.Rule]) -> list[checks.Outcome]:
    """Diagnose recordings of different rigs; write each result as it comes, and a table of all.

    Returns:
        What rules say of each verdict.

    Raises:
        RecordingError, ModelError, OutputError, ClusterError: none can be diagnosed.
    """
    started = time.monotonic()
    out = Path(options.out or "diagnoses")
    names = folder_names(options.bags, [batch.SUMMARY])
    ensure_free(out, (batch.SUMMARY,), overwrite=options.overwrite)
    for name in names:
        ensure_free(out / name, FILES, overwrite=options.overwrite)
    further, model = effect_file.load_all(options.effects), load(options.model)
    settings = batch.Settings(model, options.model, options.namespace, options.held_out, options.fit_nominal,
                              options.material, options.seconds, further,
                              effect_file.definitions([*further, *model.effects]))
    files = [out / name / "diagnosis.json" for name in names]
    before = [_version(file) for file in files]
    commands = [_alone(options, bag, out / name) for bag, name in zip(options.bags, names)]
    rows, said = [], []
    try:
        with (dask_cluster.cluster(options.dask) as client,
              progress(f"0 of {len(names)} recordings", len(names)) as show,
              closing(batch.diagnose_each(options.bags, commands, settings, options.jobs, client)) as outcomes):
            for name, outcome in zip(names, outcomes):
                if outcome.results is not None:
                    outcome.results.write(out / name, overwrite=options.overwrite)
                    said += checks.check(outcome.results.document, rules)
                else:
                    said += [checks.Outcome(outcome.bag, rule.text, error=outcome.error) for rule in rules]
                rows.append(batch.row(outcome, name))
                show(len(rows), f"{len(rows)} of {len(names)} recordings")
    except KeyboardInterrupt:
        done = sum(_version(file) not in (None, was) for file, was in zip(files, before))
        if not done:
            raise
        raise KeyboardInterrupt(printable(f"interrupted; {done} of {len(names)} verdicts are in {out}")) from None
    batch.write_summary(out, rows)
    print_table(rows)
    refused = sum(bool(row["error"]) for row in rows)
    if refused == len(rows) == 1:
        raise RecordingError(str(rows[0]["error"]))
    if refused == len(rows):
        raise RecordingError(f"none of the {refused} recordings can be used; {out / batch.SUMMARY} says why")
    print(printable(f"{len(rows) - refused} of {len(rows)} diagnosed   {out / batch.SUMMARY}   "
                    f"{time.monotonic() - started:.1f} s"))
    return said


def _version(file: Path) -> tuple[int, int] | None:
    """What tells a file from one that took its place; None if there is none."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def _alone(options: argparse.Namespace, bag: str, out: Path) -> str:
    """The command that gives the verdict of one recording of a batch."""
    words = ["diagnose", bag, "--out", str(out), "--model", options.model, "--held-out", f"{options.held_out:g}"]
    words += ["--namespace", options.namespace] if options.namespace is not None else []
    words += ["--material", f"{options.material:g}"] if options.material != MATERIAL_SHARE else []
    words += ["--seconds", f"{options.seconds:g}"] if options.seconds is not None else []
    words += [word for file in options.effects for word in ("--effects", file)]
    return shlex.join(words + ["--fit-nominal"] * options.fit_nominal)


def print_table(rows: Sequence[dict[str, object]]) -> None:
    """Print the summary; without a terminal it is as wide as it needs to be."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=10_000)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("recording", "verdict", "place", "effects", "gap closed"):
        table.add_column(heading, overflow="fold")
    table.add_column("s", justify="right")
    for row in rows:
        if row["error"]:
            table.add_row(_cell(row["recording"]), "cannot tell", "", _cell(row["error"]))
        else:
            closed = "nothing to close" if row["closed"] == "" else f"{100.0 * float(str(row['closed'])):.0f} %"
            table.add_row(_cell(row["recording"]), str(row["verdict"]), str(row["place"]), str(row["effects"]), closed,
                          f"{row['seconds']:.1f}")
    console.print(table)


def _cell(text: object) -> str:
    """A cell that rich does not take for markup."""
    return escape(printable(str(text)))


@entry_point("diagnose", "interrupted, nothing was written")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = own(arguments)
    options = parse(arguments)
    effect_file.load_all(options.effects)
    rules = [checks.parse(text) for text in options.fail_on]
    junit = Path(options.junit) if options.junit else None
    try:
        said = run_each(options, rules) if options.each else run(options, shlex.join(["diagnose", *arguments]), rules)
    except UserError as error:
        if junit is not None:
            name = ", ".join(options.bags)
            checks.write_junit(junit, [checks.Outcome(name, rule, error=str(error)) for rule in options.fail_on])
        raise
    if junit is not None:
        checks.write_junit(junit, said)
    if rules:
        print(checks.summary(said))
    return BROKEN if any(one.broken or one.error for one in said) else 0


if __name__ == "__main__":
    sys.exit(main())
