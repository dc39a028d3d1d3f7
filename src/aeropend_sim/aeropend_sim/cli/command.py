# SPDX-License-Identifier: Apache-2.0
"""What all commands share: usage errors in one line, exit codes, and completion by the shell.

A shell asks for completions by running the command with `_ARGCOMPLETE` set (argcomplete's protocol); see `completion`.
"""

import argparse
import math
import os
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, NoReturn, ParamSpec

EXIT_CODES = "exit codes: 0 done, 2 the input cannot be used (one line says why), 130 interrupted"

Completer = Callable[..., Iterable[str]]


def asked_to_complete() -> bool:
    """Whether it is a shell that runs this program, to learn what may come next on the command line."""
    return "_ARGCOMPLETE" in os.environ


class Parser(argparse.ArgumentParser):
    """Says what is wrong with a command line in one line, and completes what begins well.

    What is offered for an argument are its choices, or, by its metavar: BAG, DIR, FILE, OUT and PRESET|FILE.
    """

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Read a command line, but for what is ROS's; exits with 2 and one line where it is wrong."""
        if asked_to_complete():
            self.complete()
        return super().parse_args(own(args), namespace)

    def complete(self) -> None:
        """Tell the shell what may come next, and end."""
        from argcomplete import autocomplete

        for action in self._actions:
            if action.choices is None and not hasattr(action, "completer"):
                action.completer = _completer(action)  # type: ignore[attr-defined]
        only_options = all(action.option_strings for action in self._actions)
        autocomplete(self, always_complete_options="long" if only_options else False, exit_method=sys.exit)


def own(arguments: Sequence[str] | None) -> list[str]:
    """A command line (default: the process's) without the ROS arguments that `ros2 run` may pass on."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    return given[: given.index("--ros-args")] if "--ros-args" in given else given


def between(low: float, high: float, what: str, unit: str = "") -> Callable[[str], float]:
    """A type of argument: a number of a range. `what` names it, as in "a share"."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            limits = f"between {low:,.12g} and {high:,.12g} {unit}".rstrip()
            raise argparse.ArgumentTypeError(f"'{text}' is not {what} {limits}")
        return value

    return read


P = ParamSpec("P")


def interruptible(main: Callable[P, int]) -> Callable[P, int]:
    """Let an entry point end with one line and code 130 on Ctrl-C, and in silence when nobody reads it any more."""

    @wraps(main)
    def interruptible_main(*args: P.args, **kwargs: P.kwargs) -> int:
        try:
            code = main(*args, **kwargs)
            sys.stdout.flush()
            return code
        except KeyboardInterrupt:
            print(f"{Path(sys.argv[0]).stem}: interrupted", file=sys.stderr)
            return 130
        except BrokenPipeError:  # as in `identify my_bag | head -1`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left has somewhere to go
            return 128 + signal.SIGPIPE

    return interruptible_main


def files(prefix: str, **_: Any) -> Iterable[str]:
    """Paths that begin like this."""
    from argcomplete.completers import FilesCompleter

    return FilesCompleter()(prefix)


def _completer(action: argparse.Action) -> Completer:
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    from aeropend_sim.model.parameters import PRESETS

    by_metavar: dict[Any, Completer] = {
        "BAG": FilesCompleter((".mcap", ".db3")),  # and folders
        "DIR": DirectoriesCompleter(),
        "FILE": files,
        "OUT": DirectoriesCompleter(),
        "PRESET|FILE": lambda prefix, **_: [*PRESETS, *files(prefix)],
    }
    return by_metavar.get(action.metavar, files if action.type is Path else lambda **_: ())
