# SPDX-License-Identifier: Apache-2.0
"""Results of long runs: on which machine, and written as JSON into a folder that stays out of git."""

import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


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
