# SPDX-License-Identifier: Apache-2.0
"""The command line of all commands: usage errors in one line, exit codes, completion by the shell.

A shell asks for completions by running the command with `_ARGCOMPLETE` set (argcomplete's protocol); see `completion`.
"""

import argparse
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, NoReturn, ParamSpec

from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import LARGEST_SEED, PRESETS

EXIT_CODES = "exit codes: 0 done, 2 the input cannot be used (one line says why), 130 interrupted"

Completer = Callable[..., Iterable[str]]


def asked_to_complete() -> bool:
    """Whether a shell runs this program to get completions."""
    return "_ARGCOMPLETE" in os.environ


class Parser(argparse.ArgumentParser):
    """A parser that reports an error of the command line in one line, and gives completions to the shell.

    The completions of an argument are its choices. Without choices its metavar decides: BAG, DIR, FILE, OUT or
    PRESET|FILE.
    """

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Read a command line without its ROS arguments; on an error, exit with code 2 and one line.

        Args:
            args: the arguments; None for those of the process.
            namespace: takes the values.
        """
        if asked_to_complete():
            self.complete()
        return super().parse_args(own(args), namespace)

    def complete(self) -> None:
        """Print the completions for the shell, and exit."""
        from argcomplete import autocomplete

        for action in self._actions:
            if action.choices is None and not hasattr(action, "completer"):
                action.completer = _completer(action)  # type: ignore[attr-defined]
        only_options = all(action.option_strings for action in self._actions)
        autocomplete(self, always_complete_options="long" if only_options else False, exit_method=sys.exit)


def own(arguments: Sequence[str] | None) -> list[str]:
    """A command line without the ROS arguments that `ros2 run` may add.

    Args:
        arguments: the command line; None for that of the process.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    return given[: given.index("--ros-args")] if "--ros-args" in given else given


def called(name: str, package: str) -> str:
    """A command as a shell finds it, also where its folder is not in PATH.

    It lies beside the command that runs, or beside the interpreter of this environment; else ROS 2 finds it. A path
    below the current folder is relative, as in the README.

    Args:
        name: of the command.
        package: that has it.
    """
    places = [Path(sys.argv[0]).parent, *([Path(sys.executable).parent] if sys.prefix != sys.base_prefix else [])]
    for place in places:
        if os.access(place / name, os.X_OK) and (place / name).is_file():
            path = Path(os.path.abspath(place / name))  # noqa: PTH100 - a link to the environment stays as it is
            below = path.relative_to(Path.cwd()) if Path.cwd() in path.parents else path
            return shlex.quote(str(below) if below != Path(name) else f"./{name}")
    return f"ros2 run {package} {name}"


def between(low: float, high: float, what: str, unit: str = "") -> Callable[[str], float]:
    """The type of an argument that is a number in a range.

    Args:
        low: smallest value.
        high: greatest value.
        what: name for the error message, with its article, as in "a share".
        unit: unit of the range.
    """

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


def given(options: argparse.Namespace, names: Iterable[str]) -> list[str]:
    """The options of a command line that were given, as a person writes them: `--duty-max`.

    Args:
        options: what the parser returned; None is the default of each option.
        names: of the options, as attributes: `duty_max`.
    """
    return [f"--{name.lower().replace('_', '-')}" for name in names if getattr(options, name) is not None]


def as_seed(text: str) -> int:
    """The type of an argument that pins what is drawn.

    Args:
        text: the argument: a whole number, 0 to `LARGEST_SEED`.
    """
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value <= LARGEST_SEED:
        raise argparse.ArgumentTypeError(f"'{text}' is not a seed: give a whole number, 0 to {LARGEST_SEED}")
    return value


P = ParamSpec("P")


def entry_point(name: str, interrupted: str = "interrupted") -> Callable[[Callable[P, int]], Callable[P, int]]:
    """A decorator that makes a function the entry point of a command.

    A `UserError` ends the command with one line and exit code 2, Ctrl-C with one line and code 130, a closed output
    silently.

    Args:
        name: of the command.
        interrupted: line after Ctrl-C, if the KeyboardInterrupt has no text of its own.
    """

    def decorate(main: Callable[P, int]) -> Callable[P, int]:
        @wraps(main)
        def run(*args: P.args, **kwargs: P.kwargs) -> int:
            try:
                code = main(*args, **kwargs)
                sys.stdout.flush()
                return code
            except UserError as error:
                print(f"{name}: {error}", file=sys.stderr)
                return 2
            except KeyboardInterrupt as stop:
                print(f"{name}: {stop}" if str(stop) else f"{name}: {interrupted}", file=sys.stderr)
                return 130
            except BrokenPipeError:  # as in `identify my_bag | head -1`
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the rest of the output goes there
                return 128 + signal.SIGPIPE

        return run

    return decorate


def files(prefix: str, **_: Any) -> Iterable[str]:
    """The paths that start with a prefix."""
    from argcomplete.completers import FilesCompleter

    return FilesCompleter()(prefix)


def _completer(action: argparse.Action) -> Completer:
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    by_metavar: dict[Any, Completer] = {
        "BAG": FilesCompleter((".mcap", ".db3")),  # and folders
        "DIR": DirectoriesCompleter(),
        "FILE": files,
        "OUT": DirectoriesCompleter(),
        "PRESET|FILE": lambda prefix, **_: [*PRESETS, *files(prefix)],
    }
    return by_metavar.get(action.metavar, files if action.type is Path else lambda **_: ())
