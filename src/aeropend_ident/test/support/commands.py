# SPDX-License-Identifier: Apache-2.0
"""Commands as a person runs them: exit code and what they say, in a process of their own or in this one."""

import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module


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

    def here(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        """Run it in this process: a new one takes 2 s until it begins."""
        said, error = io.StringIO(), io.StringIO()
        with redirect_stdout(said), redirect_stderr(error):
            try:
                code = import_module(self._module).main([str(word) for word in arguments])
            except SystemExit as end:
                code = end.code
        return subprocess.CompletedProcess(arguments, code, said.getvalue(), error.getvalue())

    def refused(self, *arguments: object) -> str:
        """Run it in this process on what it cannot use, and return the one line that it says."""
        done = self.here(*arguments)
        assert (done.returncode, done.stdout) == (2, "")
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
        return done.stderr
