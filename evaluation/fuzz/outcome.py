# SPDX-License-Identifier: Apache-2.0
"""What a command may leave behind: a result without NaN, or one line that says what is wrong."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.bags.recording import read

NAN = re.compile(r"(?<![\w./%-])[-+]?(nan|inf|infinity|Infinity)(?![\w/-])")
"""A number that is none, as Python shows it; messages that speak of it write NaN."""
REPEATED = re.compile(r"'[^']*'|is not a|is infinity|give (a number|.* <=)|no possible number")
"""Lines that repeat what was given."""
NODE_SAYS = re.compile(r"\[(INFO|WARN)\]")
TOLD = "was identified by a diagnosis"
"""A line on standard error that is no error."""
SHORTEST, LONGEST = 15, 1200
"""Characters of a line that says what, where and what to do (choice)."""


@dataclass
class Outcome:
    """How a command ended.

    Attributes:
        code: exit code; negative: the number of the signal that ended it.
        stdout, stderr: what it printed.
        faults: what it may not do, found while it ran: an exception, a warning.
    """

    code: int
    stdout: str = ""
    stderr: str = ""
    faults: list[str] = field(default_factory=list)

    @property
    def errors(self) -> list[str]:
        """The lines that it printed on standard error, without those that are no error."""
        return [line for line in self.stderr.splitlines()
                if line.strip() and TOLD not in line and not NODE_SAYS.match(line)]

    @property
    def first(self) -> str:
        """The line that says how it ended."""
        return next(iter(self.errors or self.stdout.splitlines()), "")


def judge(command: str, outcome: Outcome, folder: Path) -> list[str]:
    """What is wrong with how a command ended; nothing, if all is well.

    Args:
        command: its name.
        outcome: how it ended.
        folder: where it ran; its results are `out` or `out.svg` there.
    """
    return [*outcome.faults, *_lines(command, outcome), *_results(command, outcome, folder)]


def _lines(command: str, outcome: Outcome) -> Iterator[str]:
    if outcome.code not in (0, 2) and not outcome.faults:
        yield f"exit code {outcome.code}: {outcome.stderr[-2000:]}"
    if "Traceback" in outcome.stdout + outcome.stderr:
        yield f"a traceback: {(outcome.stdout + outcome.stderr)[-2000:]}"
    errors = outcome.errors
    if outcome.code == 0 and errors:
        yield f"an error is said, but the exit code is 0: {errors[0][:300]}"
    if outcome.code == 2 and command != "doctor":  # doctor says errors among its findings
        if len(errors) != 1:
            yield f"{len(errors)} lines of error: {errors[:3]}"
        elif not errors[0].startswith(f"{command}: ") or not len(errors[0].removeprefix(f"{command}: ")) > SHORTEST:
            yield f"a line that does not say what is wrong: {errors[0]}"
        elif len(errors[0]) > LONGEST:
            yield f"a line of {len(errors[0])} characters: {errors[0][:300]}"
    shown = outcome.stdout if command not in ("import", "replay") else ""  # import shows rows of the table
    for line in (shown + outcome.stderr).splitlines():
        if NAN.search(line) and not REPEATED.search(line):
            yield f"NaN is shown: {line[:300]}"
            break


def _results(command: str, outcome: Outcome, folder: Path) -> Iterator[str]:
    out = folder / "out"
    if command == "import" and outcome.code == 0 and out.exists():
        try:
            read(out)
        except RecordingError as error:
            if "duty goes" not in str(error):  # import takes the duty of a rig whose model is not given
                yield f"what was imported cannot be read: {error}"
    elif command in ("diagnose", "identify", "bench_test"):
        if outcome.code == 2 and (out / "diagnosis.json").exists():
            yield "results are left, but the exit code is 2"
        yield from _files(out)
    elif (plot := folder / "out.svg").exists():
        yield from _file(plot)


def _files(folder: Path) -> Iterator[str]:
    for path in sorted(folder.rglob("*")):
        yield from _file(path)


def _file(path: Path) -> Iterator[str]:
    if path.suffix == ".json":
        try:
            json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_json)
        except ValueError as error:
            yield f"{path.name} is no JSON: {error}"
    elif path.suffix in (".html", ".svg"):
        for line in _seen(path.read_text(encoding="utf-8")):
            if NAN.search(line) and not REPEATED.search(line):
                yield f"{path.name} shows NaN: {line[:200]}"
                break
    elif path.suffix == ".yaml":
        for line in path.read_text(encoding="utf-8").splitlines():
            if re.search(r"\.nan|\.inf|\bnan\b", line.partition("#")[0]):
                yield f"{path.name} holds NaN: {line}"
                break


def _seen(html: str) -> list[str]:
    """The text and the shapes of a page, in lines."""
    html = re.sub(r"<(script|style)\b.*?</\1>", " ", html, flags=re.DOTALL)
    shapes = re.findall(r'\b(?:d|points|x|y|x1|x2|y1|y2|width|height|transform|viewBox|cx|cy)="([^"]*)"', html)
    return re.sub(r"<[^>]*>", "\n", html).splitlines() + [shape for shape in shapes if NAN.search(shape)]


def _no_json(constant: str) -> NoReturn:
    raise ValueError(f"{constant} in it")
