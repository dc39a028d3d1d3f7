# SPDX-License-Identifier: Apache-2.0
"""Programs of ours that a command starts, watches and stops."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from aeropend_sim.errors import UserError
from aeropend_sim.wording import enumerated

STARTUP = 30.0
"""[s] Time that programs may take to find each other (choice: a loaded machine takes some seconds)."""

START = """
import ctypes, runpy, signal, sys
if sys.platform == "linux":  # interrupted when the parent ends, even if that is killed: the motor then stops
    ctypes.CDLL(None).prctl(1, signal.SIGINT)  # PR_SET_PDEATHSIG
del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
"""How a program starts."""

MODULES = {"plant": "aeropend_sim.nodes.plant", "excite": "aeropend_control.nodes.excite",
           "record": "aeropend_ident.nodes.record", "diagnose": "aeropend_ident.commands.diagnose",
           "controller": "aeropend_control.nodes.controller", "reference": "aeropend_control.nodes.reference",
           "watch": "aeropend_ident.nodes.watch"}


class ProgramError(UserError):
    """A command cannot go on, since a program of it failed; the message is one line for a person."""


@contextmanager
def process(name: str, *arguments: str, environment: dict[str, str], log: Path) -> Iterator[subprocess.Popen[str]]:
    """A program of ours, its output in a file; stopped when the block is left, whatever happens."""
    with log.open("w", encoding="utf-8") as file:
        child = subprocess.Popen([sys.executable, "-c", START, MODULES[name], *arguments], env=environment,
                                 stdout=file, stderr=subprocess.STDOUT, text=True, start_new_session=True)
        try:
            yield child
        finally:
            for number, patience in ((signal.SIGINT, 10.0), (signal.SIGKILL, 5.0)):
                if child.poll() is None:
                    child.send_signal(number)
                    try:
                        child.wait(patience)
                    except subprocess.TimeoutExpired:
                        continue


def check(name: str, child: subprocess.Popen[str], log: Path) -> None:
    """Raise a ProgramError if a program has ended with an error."""
    if child.poll() not in (None, 0):
        lines = log.read_text(encoding="utf-8").strip().splitlines()
        raise ProgramError(f"{name} ended with {child.returncode}: {lines[-1] if lines else 'no output'} (see {log})")


def made(folder: Path) -> None:
    """Make the folder for everything, which must be new."""
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise ProgramError(f"{folder}: {error.strerror}; give a new folder with --out") from None


def environment() -> dict[str, str]:
    """Environment of the programs: a graph of their own on this machine, unless the caller has chosen one."""
    own = {**os.environ, "PYTHONUNBUFFERED": "1"}
    own.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    own.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
    return own


def record_excited(bag: Path, signal_options: Sequence[str], seconds: float, *, environment: dict[str, str],
                   console: Console, others: Mapping[str, subprocess.Popen[str]] | None = None,
                   namespace: Sequence[str] = ()) -> None:
    """Record a rig that runs while it is excited, until the excitation ends.

    Args:
        bag: the recording; the logs of the programs lie beside it.
        signal_options: ROS arguments of `excite`.
        seconds: [s] length of the signal.
        environment: of the programs.
        console: shows the progress.
        others: name -> program that must run meanwhile; its log lies beside the bag too.
        namespace: ROS arguments that name the rig.

    Raises:
        ProgramError: a program ended with an error, or the recording does not end.
    """
    def start(name: str, *arguments: str) -> AbstractContextManager[subprocess.Popen[str]]:
        return process(name, *arguments, environment=environment, log=bag.parent / f"{name}.log")

    with (
        Progress(TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=console) as bar,
        start("record", str(bag), "--ros-args", "-p", "while_published:=duty_command", *namespace) as record,
        start("excite", "--ros-args", *signal_options, *namespace) as excite,
    ):
        running = {**(others or {}), "record": record, "excite": excite}
        task = bar.add_task(f"{enumerated([*running])} are running", total=seconds)
        begun = time.monotonic()
        while record.poll() is None:
            for name, child in running.items():
                check(name, child, bag.parent / f"{name}.log")
            passed = time.monotonic() - begun
            if passed > seconds + STARTUP:
                raise ProgramError(f"the recording did not end {STARTUP:g} s after it should have (see "
                                   f"{bag.parent / 'record.log'})")
            bar.update(task, completed=min(passed, seconds))
            time.sleep(0.1)
        bar.update(task, completed=seconds)
        for name, child in running.items():
            check(name, child, bag.parent / f"{name}.log")
