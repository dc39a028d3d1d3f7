# SPDX-License-Identifier: Apache-2.0
"""Many recordings, each of a rig of its own, diagnosed side by side: by processes here, or by a Dask cluster.

The recordings are read here and the results come back here, so that workers on other machines need none of the files.
"""

from __future__ import annotations

import asyncio
import csv
import logging
import signal
import time
import warnings
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.results import Results, document
from aeropend_ident.result_folder import OutputError, on_interrupt
from aeropend_ident.signals.from_bag import signals_of
from aeropend_ident.signals.signals import Signals
from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import Model
from aeropend_sim.untrusted import one_line, printable

SUMMARY = "summary.csv"
COLUMNS = ("recording", "folder", "verdict", "place", "effects", "gap", "gap_after", "closed", "closed_low",
           "closed_high", "seconds", "error")

ANSWER_WITHIN = 5.0
"""[s] Time within which a Dask scheduler and a first worker must answer (choice)."""


KILLED = "the process at work on it was killed, most likely for want of memory"


class ClusterError(UserError):
    """The Dask cluster cannot be used; the message is one line for a person."""


@dataclass(frozen=True)
class Settings:
    """What the diagnoses have in common.

    Attributes:
        model: the nominal model. name: as it was asked for.
        namespace, held_out, fit_nominal: as in the options of the command.
    """

    model: Model
    name: str
    namespace: str | None = None
    held_out: float = 0.3
    fit_nominal: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of one recording: results, or one line that says why there are none."""

    bag: str
    results: Results | None = None
    error: str = ""


def diagnose_each(bags: Sequence[str], commands: Sequence[str], settings: Settings, jobs: int = 1,
                  client: Any = None) -> Generator[Outcome, None, None]:
    """Diagnose recordings of rigs that have nothing to do with each other.

    A recording that cannot be used stops no other one. What is found depends neither on `jobs` nor on the cluster.

    Args:
        bags: the recordings.
        commands: for each the command line that its report names.
        settings: what they have in common.
        jobs: processes; 1: this one.
        client: a `distributed.Client` (see `cluster`) whose workers do the work instead; None: processes.

    Yields:
        One outcome a bag, in their order, each as soon as it and those before it are there. Who stops early closes it:
        left to garbage collection, which may come in a thread that waits for the processes, they would never end.
    """
    tasks = _tasks(bags, commands, settings)
    if client is not None:
        yield from _on_cluster(client, tasks)
        return
    from joblib import Parallel, delayed  # type: ignore[import-untyped]  # takes long to import

    warnings.filterwarnings("ignore", r".*tasks which (were|had)", UserWarning)  # joblib on being interrupted
    done = 0
    try:
        # each is read when a worker is about to want it: hundreds need not be in memory at once
        with Parallel(jobs, return_as="generator", batch_size=1, max_nbytes=None) as parallel:
            with on_interrupt(signal.SIG_IGN):  # they never hear of Ctrl-C, which goes to all: this one ends them
                list(parallel([delayed(int)()]))
            for outcome in parallel(delayed(_examine)(task) for task in tasks):
                done += 1
                yield outcome
    except BrokenProcessPool:
        for bag in bags[done:]:
            yield Outcome(bag, None, f"{bag}: not diagnosed: {KILLED}; try fewer --jobs")


def _on_cluster(client: Any, tasks: Iterator[_Task]) -> Iterator[Outcome]:
    """Have the workers of a cluster do the tasks; their outcomes in the same order.

    Not by way of joblib, whose Dask backend waits for ever for a worker that was killed.
    """
    waiting: deque[tuple[str, Any]] = deque()

    def first() -> Outcome:
        bag, future = waiting.popleft()
        try:
            outcome: Outcome = future.result()
        except Exception as error:
            why = KILLED if type(error).__name__ == "KilledWorker" else " ".join(str(error).split())
            return Outcome(bag, None, f"{bag}: not diagnosed: {why}")
        return outcome

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sending large graph")  # a recording is large
        for task in tasks:
            waiting.append((task.bag, client.submit(_examine, task, pure=False)))
            if len(waiting) > 2 * sum(client.ncores().values()):
                yield first()
        while waiting:
            yield first()


@dataclass(frozen=True)
class _Task:
    """One recording, read; or what is wrong with it. `reading`: s that took."""

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
            signals = signals_of(bag, settings.namespace, settings.model.sensing, settings.held_out,
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
    # for good: where threads of one worker share the limit, the first to end must not lift it for the others
    threadpool_limits(1)
    try:
        found = diagnose(task.settings.model, [task.signals], 1, fit_nominal=task.settings.fit_nominal)
        made = document(found, [task.bag], task.settings.name, task.reading + time.monotonic() - started)
        return Outcome(task.bag, Results.of(found, made, task.command))
    except Exception as error:
        return Outcome(task.bag, None, _why(task.bag, error))


def _why(bag: str, error: Exception) -> str:
    """One line on what is wrong with a recording."""
    if isinstance(error, RecordingError):
        return str(error)
    text = " ".join(str(error).split())
    return one_line(f"{bag}: cannot be diagnosed, which is a fault of this program: {type(error).__name__}: {text}")


def names(bags: Sequence[str]) -> list[str]:
    """A folder name for each recording, all different: its own name, with those of the folders above as far as needed.

    A recording given twice gets a number.
    """
    paths = [p.absolute() if p.name not in {"", ".."} else p.resolve() for p in map(Path, bags)]
    parts = [(*p.parts[1:-1], p.stem if p.suffix in {".mcap", ".db3"} else p.name) for p in paths]
    depth = dict.fromkeys(parts, 1)
    while True:
        count = Counter("_".join(p[-d:]) for p, d in depth.items())
        longer = [p for p, d in depth.items() if count["_".join(p[-d:])] > 1 and d < len(p)]
        if not longer:
            break
        for p in longer:
            depth[p] += 1
    found = ["_".join(p[-depth[p]:]) for p in parts]
    taken = {SUMMARY}
    for j, name in enumerate(found):
        k = 1
        while found[j] in taken:
            k += 1
            found[j] = f"{name}_{k}"
        taken.add(found[j])
    return found


def row(outcome: Outcome, folder: str) -> dict[str, Any]:
    """An outcome as a row of the summary, by `COLUMNS`; `folder`: where its results are."""
    if outcome.results is None:
        return {**dict.fromkeys(COLUMNS, ""), "recording": outcome.bag, "error": outcome.error}
    found = outcome.results.document
    which, closure = found.which, found.closure
    values = (outcome.bag, folder, which.verdict, found.where.place, " ".join(which.effects), closure.gap,
              closure.gap_after, closure.closed, closure.low, closure.high, found.seconds, "")
    return {name: "" if value is None else value for name, value in zip(COLUMNS, values)}


def _no_formula(value: object) -> object:
    """What a spreadsheet shows and does not work out: a path that begins like a formula begins with ./ instead."""
    text = printable(value) if isinstance(value, str) else value
    return f"./{text}" if isinstance(text, str) and text.startswith(("=", "+", "-", "@")) else text


def write_summary(out: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write the rows as CSV to `out`/summary.csv, in one step.

    Raises:
        OutputError: that is not possible.
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


@contextmanager
def cluster(address: str | None) -> Iterator[Any]:
    """Connect to a Dask cluster whose workers can do the work.

    Args:
        address: of its scheduler, "tcp://host:8786"; None: there is no cluster.

    Yields:
        A `distributed.Client`, or None.

    Raises:
        ClusterError: Dask is not installed, nothing answers there, or the workers lack this package.
    """
    if address is None:
        yield None
        return
    try:
        import distributed
    except ImportError:
        raise ClusterError("--dask needs Dask, which is not installed: pip install 'aeropend_ident[dask]'") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # every failure comes back as an exception
    untyped: Any = distributed

    async def knock() -> None:
        security = untyped.Security().get_connection_args("client")
        comm = await untyped.comm.connect(address, timeout=ANSWER_WITHIN, **security)
        await comm.close()

    try:
        asyncio.run(knock())  # a client that cannot connect leaves tracebacks behind
        client = untyped.Client(address, timeout=ANSWER_WITHIN, set_as_default=False)
    except Exception as error:
        silent = isinstance(error, (OSError, distributed.TimeoutError))
        why = "nothing answers there" if silent else " ".join(str(error).split())
        raise ClusterError(f"--dask {address}: {why}; give the address that the scheduler prints when it starts, "
                           "such as tcp://host:8786") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_WITHIN)
        except distributed.TimeoutError:
            raise ClusterError(f"--dask {address}: the cluster has no worker; start some with: dask worker {address}"
                               ) from None
        package = __name__.partition(".")[0]

        def has() -> bool:  # no module level function: that could not be sent to a worker that lacks the module
            import importlib.util
            return importlib.util.find_spec(package) is not None

        there = {"the scheduler": client.run_on_scheduler(has), **client.run(has)}
        if lacking := [where for where in there if not there[where]]:
            raise ClusterError(f"--dask {address}: {package} is not installed for {' and '.join(lacking[:3])}; "
                               "the scheduler and every worker need it")
        yield client
