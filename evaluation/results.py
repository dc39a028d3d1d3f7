# SPDX-License-Identifier: Apache-2.0
"""Results of long runs: on which machine, as JSON in a folder that stays out of git, and as a table in docs/results."""

import argparse
import json
import os
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

Document = Mapping[str, Any]
"""What a run wrote."""


def machine(packages: Sequence[str] = ()) -> dict[str, object]:
    """What results depend on."""

    def installed(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return "unknown"

    cpu = [line.partition(":")[2].strip() for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
           if line.startswith("model name")]
    return {"cpu": cpu[0] if cpu else platform.machine(), "cores": os.cpu_count(), "kernel": platform.release(),
            "python": platform.python_version(), **{package: installed(package) for package in packages},
            "commit": first_line("git", "describe", "--always", "--dirty")}


def first_line(*command: str) -> str:
    """The first line that a command prints, if it runs."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout.partition("\n")[0]
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def write(document: Mapping[str, object], folder: Path) -> Path:
    """Write results twice, under their date and as latest.json; returns the former."""
    folder.mkdir(exist_ok=True)
    (folder / ".gitignore").write_text("*\n", encoding="utf-8")
    path = folder / f"{datetime.now().astimezone():%Y-%m-%d-%H-%M-%S}.json"
    for one in path, folder / "latest.json":
        one.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


def read(path: Path) -> Document | None:
    """A run's results; None where the file holds no such thing."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return document if isinstance(document, dict) and document.get("format") == 1 else None


def full(folder: Path, like: Mapping[str, object] | None = None) -> Document | None:
    """The latest full run, of the same processor with the same Python as `like` if given; None: there is none."""
    for path in sorted(folder.glob("[0-9]*.json"), reverse=True):
        document = read(path)
        if document and document.get("full") and (like is None or on_same(document, like)):
            return document
    return None


def on_same(document: Document, machine: Mapping[str, object]) -> bool:
    """Whether a run was made by the same processor with the same Python."""
    return all(document["machine"][k] == machine[k] for k in ("cpu", "python"))


def marks(target: str) -> tuple[str, str]:
    """The two lines of a page between which the table of a `make` target stands."""
    return f"<!-- make {target}: begin -->", f"<!-- make {target}: end -->"


def offer_page(parser: argparse.ArgumentParser, target: str) -> None:
    """Let a command line ask for the table of the last full run in place of a new one.

    Args:
        parser: of the command line.
        target: "bench" or "soak"; its page is docs/results/<target>.md.
    """
    page = ROOT / "docs" / "results" / f"{target}.md"
    parser.add_argument("--docs", "--readme", nargs="?", type=Path, const=page, metavar="FILE", dest="page",
                        help="run nothing, write the table of the last full run into FILE "
                             f"(default: docs/results/{page.name})")


def show(file: Path, target: str, document: Document | None, table: Callable[[Document], str]) -> None:
    """Write the table of the last full run of a `make` target into a file that has its marks.

    Args:
        file: a page with the marks of the target.
        target: "bench" or "soak".
        document: its results, if there are any.
        table: makes Markdown of them.

    Raises:
        ValueError: there is no such run, no place for the table, or it cannot be read or written; one line.
    """
    if document is None:
        raise ValueError(f"{target}-results/ holds no full run: run make {target}, without ARGS, first")
    try:
        file.write_text(put(file.read_text(encoding="utf-8"), target, table(document)), encoding="utf-8")
    except OSError as error:
        raise ValueError(f"{file}: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def put(text: str, target: str, table: str) -> str:
    """A text with something else between the marks of a `make` target.

    Raises:
        ValueError: the two are not there, once each and in this order.
    """
    begins, ends = marks(target)
    head, begin, rest = text.partition(begins)
    _, end, tail = rest.partition(ends)
    if not begin or not end or begins in rest or ends in head + tail:
        raise ValueError(f"the lines '{begins}' and '{ends}' must be in it, once each and in this order")
    return f"{head}{begins}\n{table}\n{ends}{tail}"
