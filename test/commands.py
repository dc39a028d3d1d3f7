# SPDX-License-Identifier: Apache-2.0
"""Commands as a person runs them: a process, its exit code and what it says."""

import subprocess
import sys


class Command:
    """A module that is run as a command."""

    def __init__(self, module: str) -> None:
        self._module = module

    def line(self, *arguments: object) -> list[str]:
        """Its command line."""
        return [sys.executable, "-m", self._module, *map(str, arguments)]

    def run(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        """Run it to its end."""
        return subprocess.run(self.line(*arguments), capture_output=True, text=True, check=False, timeout=280)

    def refused(self, *arguments: object) -> str:
        """Run it on what it cannot use, and return the one line that it says."""
        result = self.run(*arguments)
        assert (result.returncode, result.stdout) == (2, "")
        assert len(result.stderr.strip().splitlines()) == 1, result.stderr
        return result.stderr
