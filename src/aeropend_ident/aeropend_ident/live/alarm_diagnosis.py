# SPDX-License-Identifier: Apache-2.0
"""`diagnose` on the bag of an alarm, as a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from aeropend_ident.diagnosis import document


class AlarmDiagnosis:
    """Starts the process.

    Args:
        bag: of the alarm.
        model: the nominal model: a preset or a file.
        alarm: number of the alarm.
        nice: of the process; 19 is the lowest priority.

    Attributes:
        alarm: number of the alarm.
        out: folder of the results, beside the bag.
    """

    def __init__(self, bag: Path, model: str, alarm: int, nice: int = 19) -> None:
        self.alarm, self.out = alarm, bag.with_name(f"{bag.name}-verdict")
        command = [sys.executable, "-m", "aeropend_ident.commands.diagnose", str(bag), "--model", model, "--out",
                   str(self.out)]
        self._process = subprocess.Popen(["nice", "-n", str(nice), *command], stdout=subprocess.DEVNULL)

    @property
    def ended(self) -> bool:
        """Whether the process has ended."""
        return self._process.poll() is not None

    @property
    def verdict(self) -> str:
        """An effect, "unknown", "none" or "cannot_tell"; "" without a result: the process has said why on stderr."""
        if self._process.poll() != 0:
            return ""
        return document.read(self.out / "diagnosis.json").which.verdict

    @property
    def report(self) -> Path:
        """The page with all that it found."""
        return self.out / "report.html"

    def close(self) -> None:
        """End the process, and wait for it."""
        self._process.terminate()
        self._process.wait()
