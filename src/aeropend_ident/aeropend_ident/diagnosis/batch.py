# SPDX-License-Identifier: Apache-2.0
"""A batch of recordings, each of another rig, diagnosed in parallel: by processes here, or by a Dask cluster.

The recordings are read here and the results come back here, so that workers on other machines need no files.
"""

from __future__ import annotations

import csv
import signal
import time
import warnings
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.diagnosis import dask_cluster
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.policy import MATERIAL_SHARE
from aeropend_ident.diagnosis.results import Results, document
from aeropend_ident.interrupt import on_interrupt
from aeropend_ident.result_folder import OutputError
from aeropend_ident.signals.from_bag import signals_of
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model import effect_file
from aeropend_sim.model.parameters import Model
from aeropend_sim.untrusted import one_line, printable

SUMMARY = "summary.csv"
"""The table of a batch."""

COLUMNS = ("recording", "folder", "verdict", "place", "effects", "gap", "gap_after", "closed", "closed_low",
           "closed_high", "seconds", "error")

@dataclass(frozen=True)
class Settings:
    """The settings of all diagnoses.

    Attributes:
        model: the nominal model.
        name: of the model, as the user gave it.
        namespace: of the rig, if a bag holds several.
        held_out: share of each recording that nothing is fitted to.
        fit_nominal: whether the rigs are uncalibrated.
        material: share of the gap from which an effect is claimed.
        seconds: [s] that each search may take; None: a budget of simulations bounds it where it may be long.
        further: ids of effects of effect files that are tried too.
        definitions: of all effects by formula, which the processes have to know.
    """

    model: Model
    name: str
    namespace: str | None = None
    held_out: float = 0.3
    fit_nominal: bool = False
    material: float = MATERIAL_SHARE
    seconds: float | None = None
    further: tuple[str, ...] = ()
    definitions: Mapping[str, Mapping[str, object]] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """The results of one recording, or one line that says why there are none."""

    bag: str
    results: Results | None = None
    error: str = ""


def diagnose_each(bags: Sequence[str], commands: Sequence[str], settings: Settings, jobs: int = 1,
                  client: Any = None) -> Generator[Outcome, None, None]:
    """Diagnose recordings, each of another rig.

    A recording that cannot be used does not stop the others. The results depend neither on `jobs` nor on the cluster.

    Args:
        bags: the recordings.
        commands: the command line that the report of each names.
        settings: of all.
        jobs: processes; 1: this one.
        client: a `distributed.Client` (see `dask_cluster`) whose workers do the work instead; None: processes.

    Yields:
        One outcome a bag, in their order, each as soon as it and those before it are there. A caller that stops early
        closes the generator: garbage collection in a thread that waits for the processes would never end.
    """
    tasks = _tasks(bags, commands, settings)
    if client is not None:
        for task, outcome in dask_cluster.results(client, _examine, tasks):
            yield outcome if isinstance(outcome, Outcome) else Outcome(task.bag, None,
                                                                       f"{task.bag}: not diagnosed: {outcome}")
        return
    from joblib import Parallel, delayed  # type: ignore[import-untyped]  # takes long to import

    warnings.filterwarnings("ignore", r".*tasks which (were|had)", UserWarning)  # joblib on being interrupted
    done = 0
    try:
        # each is read shortly before a worker takes it, so that few are in memory at once
        with Parallel(jobs, return_as="generator", batch_size=1, max_nbytes=None) as parallel:
            with on_interrupt(signal.SIG_IGN):  # the processes ignore Ctrl-C; this one ends them
                list(parallel([delayed(int)()]))
            for outcome in parallel(delayed(_examine)(task) for task in tasks):
                done += 1
                yield outcome
    except BrokenProcessPool:
        for bag in bags[done:]:
            yield Outcome(bag, None, f"{bag}: not diagnosed: {dask_cluster.KILLED}; try fewer --jobs")


@dataclass(frozen=True)
class _Task:
    """One recording that was read, or the reason why not.

    Attributes:
        bag: the recording.
        command: that its report names.
        settings: of all.
        signals: the recording; None if it cannot be used.
        error: why it cannot be used.
        reading: [s] time that reading took.
    """

    bag: str
    command: str
    settings: Settings
    signals: Signals | None = None
    error: str = ""
    reading: float = 0.0


def _tasks(bags: Sequence[str], commands: Sequence[str], settings: Settings) -> Iterator[_Task]:
    for bag, command in zip(bags, commands):
        started = time.monotonic()
        try:
            signals = signals_of(bag, settings.namespace, settings.model, settings.held_out,
                                 fit_nominal=settings.fit_nominal)
        except Exception as error:
            yield _Task(bag, command, settings, error=_why(bag, error))
        else:
            yield _Task(bag, command, settings, signals, reading=time.monotonic() - started)


def _examine(task: _Task) -> Outcome:
    """Diagnose one recording on one thread."""
    if task.signals is None:
        return Outcome(task.bag, None, task.error)
    started = time.monotonic()
    # never lifted: threads of one worker share the limit
    threadpool_limits(1)
    settings = task.settings
    try:
        if settings.definitions:
            effect_file.define(settings.definitions, task.bag)
        found = diagnose(settings.model, [task.signals], 1, fit_nominal=settings.fit_nominal,
                         material=settings.material, seconds=settings.seconds, further=settings.further)
        made = document(found, [task.bag], settings.name, task.reading + time.monotonic() - started)
        return Outcome(task.bag, Results.of(found, made, task.command))
    except Exception as error:
        return Outcome(task.bag, None, _why(task.bag, error))


def _why(bag: str, error: Exception) -> str:
    """One line that says why a recording has no results."""
    if isinstance(error, RecordingError):
        return str(error)
    text = " ".join(str(error).split())
    return one_line(f"{bag}: cannot be diagnosed, which is a fault of this program: {type(error).__name__}: {text}")


def row(outcome: Outcome, folder: str) -> dict[str, Any]:
    """A row of the summary by `COLUMNS`.

    Args:
        outcome: of a recording.
        folder: with its results.
    """
    if outcome.results is None:
        return {**dict.fromkeys(COLUMNS, ""), "recording": outcome.bag, "error": outcome.error}
    found = outcome.results.document
    which, closure = found.which, found.closure
    values = (outcome.bag, folder, which.verdict, found.where.place, " ".join(which.effects), closure.gap,
              closure.gap_after, closure.closed, closure.low, closure.high, found.seconds, "")
    return {name: "" if value is None else value for name, value in zip(COLUMNS, values)}


def _no_formula(value: object) -> object:
    """A cell that no spreadsheet takes for a formula: a path that begins like one gets ./ in front."""
    text = printable(value) if isinstance(value, str) else value
    return f"./{text}" if isinstance(text, str) and text.startswith(("=", "+", "-", "@")) else text


def write_summary(out: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write the rows as CSV to `out`/summary.csv, in one step.

    Raises:
        OutputError: it cannot be written.
    """
    part = out / f".{SUMMARY}.part"
    try:
        out.mkdir(parents=True, exist_ok=True)
        with part.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows({name: _no_formula(value) for name, value in row.items()} for row in rows)
        part.replace(out / SUMMARY)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(f"{out / SUMMARY}: cannot be written: {error.strerror}; make room and run again with "
                          "--overwrite") from None
