# SPDX-License-Identifier: Apache-2.0
"""One case in a process of its own: it is forked, so that a crash ends nothing else, and modules are loaded once."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from evaluation.fuzz import recordings
from evaluation.fuzz.command_lines import COMMANDS
from evaluation.fuzz.draw import Draw
from evaluation.fuzz.outcome import Outcome

SILENT = (ResourceWarning, DeprecationWarning, PendingDeprecationWarning)
"""Warnings that nobody sees without asking for them."""
STOP_S = 4.0
"""Time after which a replay is ended by Ctrl-C, s."""


def run(command: str, seed: int, folder: Path, files: Path, patience: float) -> tuple[Outcome, list[str], list[str]]:
    """Draw a case and run it.

    Args:
        command: a key of COMMANDS.
        seed: of all that is drawn.
        folder: a new folder: the command runs in it.
        files: what `prepare` wrote.
        patience: [s] after which it is killed.

    Returns:
        How it ended, its arguments, and what the recordings hold.
    """
    context = get_context("fork")
    there, here = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(here, command, seed, folder, files))
    process.start()
    here.close()
    words: list[str] = []
    story: list[str] = []
    faults: list[str] = []
    end = time.monotonic() + patience
    with suppress(EOFError):  # it has ended
        while there.poll(max(end - time.monotonic(), 0.0)):
            what, value = there.recv()
            if what == "case":
                words, story = value
            else:
                faults.append(value)
        faults.append(f"it did not end in {patience:g} s")
        process.kill()
    process.join()
    code = process.exitcode or 0
    if code < 0 and not faults:
        faults.append(f"it was ended by {signal.Signals(-code).name}")
    return Outcome(code, _text(folder / ".stdout"), _text(folder / ".stderr"), faults), words, story


def _child(pipe: Connection, command: str, seed: int, folder: Path, files: Path) -> None:
    """Draw and run; tell the parent."""
    os.chdir(folder)
    try:
        words, story = draw(command, seed, files)
    except BaseException:
        pipe.send(("fault", f"the case could not be drawn: {traceback.format_exc()}"))
        os._exit(3)
    pipe.send(("case", (words, story)))
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(f".{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        setattr(sys, name, os.fdopen(number, "w"))
    sys.argv = [command]
    warnings.resetwarnings()
    warnings.simplefilter("always")
    for category in SILENT:
        warnings.simplefilter("ignore", category)
    warnings.showwarning = _showing(pipe)
    if command == "replay":
        stop = threading.Timer(STOP_S, os.kill, (os.getpid(), signal.SIGINT))
        stop.daemon = True
        stop.start()
    code = 3
    try:
        code = COMMANDS[command].run(words)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 0 if error.code is None else 1
    except BaseException:
        pipe.send(("fault", traceback.format_exc()))
    with suppress(Exception):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


def draw(command: str, seed: int, files: Path) -> tuple[list[str], list[str]]:
    """The arguments of a case and what its recordings hold; the recordings are written into this folder."""
    chance, of = Draw(seed, len(command)), COMMANDS[command]
    longest = of.longest if chance.chance(0.2) else min(of.longest, 40.0)
    bags, story = [], []
    for number in range(3 if chance.chance(of.several) else 1):
        bags.append(Path(f"bag{number}"))
        story += recordings.write(chance, bags[-1], longest, of.mildness, of.references, of.kinds)
    return of.words(chance, bags, files), story


def _showing(pipe: Connection) -> Callable[..., None]:
    def show(message: Any, category: type[Warning], file: str, line: int, *_: object) -> None:
        where = "".join(traceback.format_stack(limit=14)[:-1])
        pipe.send(("fault", f"{category.__name__}: {message} ({file}:{line})\n{where}"))

    return show


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
