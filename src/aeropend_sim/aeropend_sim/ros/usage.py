# SPDX-License-Identifier: Apache-2.0
"""The help of a node's program, and the completions that a shell offers for its command line."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aeropend_sim.cli.command import Parser, asked_to_complete
from aeropend_sim.errors import UserError
from aeropend_sim.ros.settings import Setting

EXIT_CODES = "exit codes: 0 ended, by Ctrl-C too; 2 the command line or a parameter cannot be used (one line says why)"


@dataclass(frozen=True)
class Usage:
    """The help of a node's program.

    Attributes:
        text: output of `--help`.
        settings: the parameters, by full name, for completion.
        word: placeholder of the argument before `--ros-args`; "" if the program has none.
    """

    text: str
    settings: Mapping[str, Setting]
    word: str = ""

    def show(self) -> None:
        """Print the help. If a shell asks for completions, print these and exit."""
        if asked_to_complete():
            self._complete()
        print(self.text)

    def _complete(self) -> None:
        parser = Parser()
        if self.word:
            parser.add_argument("word", nargs="?", metavar=self.word)
        parser.add_argument("--ros-args", action="store_true", help="the arguments after it are for ROS")
        parser.add_argument("--params-file", action="append", metavar="FILE", help="file of parameters")
        for option, meaning, completer in (
            ("-p", "parameter", self._parameters),
            ("-r", "other name", lambda **_: ("__ns:=/", "__node:=")),
        ):
            action = parser.add_argument(option, action="append", help=meaning)
            action.completer = completer  # type: ignore[attr-defined]
        parser.complete()

    def _parameters(self, prefix: str, **_: Any) -> Mapping[str, str]:
        """The completions of the value of `-p`, with their meaning."""
        name, given, value = prefix.partition(":=")
        if not given:
            return {f"{name}:=": setting.description for name, setting in self.settings.items()}
        setting = self.settings.get(name)
        return {f"{name}:={one}": "" for one in setting.values(value)} if setting else {}


def usage(
    summary: str,
    table: Mapping[str, Setting],
    examples: Sequence[str],
    more: str = "",
    word: str = "",
    further: Mapping[str, Setting] | None = None,
) -> Usage:
    """Describe a node's program.

    Args:
        summary: name and purpose of the program.
        table: its parameters.
        examples: command lines.
        more: text below the parameters.
        word: placeholder of the argument before `--ros-args`.
        further: parameters that `more` describes; they are completed but not listed.
    """
    lines = [summary, "", "usage: " + examples[0]]
    lines += ["       " + example for example in examples[1:]]
    lines += ["", "parameters (-p name:=value, or a ROS parameter file):"] if table else []
    for name, setting in table.items():
        limits = ", ".join((*setting.choices, *["FILE"] * setting.path))
        if math.isfinite(setting.low) and math.isfinite(setting.high):
            limits = f"{setting.low:.12g}..{setting.high:.12g}"
        unit = f" {setting.unit}" if setting.unit else ""
        default = str(setting.default).lower() if isinstance(setting.default, bool) else setting.default
        default = "none" if default == "" else default
        limits = f"{limits}{unit}; " if limits else ""
        lines.append(f"  {name:<18} {setting.description}; {limits}default {default}")
    lines += ["", more] if more else []
    return Usage("\n".join([*lines, "", EXIT_CODES]), {**table, **(further or {})}, word)


def no_options(words: Sequence[str]) -> None:
    """Refuse options before `--ros-args`.

    Args:
        words: the arguments before `--ros-args`.

    Raises:
        UserError: one of them is an option.
    """
    no_words([word for word in words if word.startswith("-")])


def no_words(words: Sequence[str]) -> None:
    """Refuse every argument before `--ros-args`.

    Args:
        words: the arguments before `--ros-args`.

    Raises:
        UserError: there is one.
    """
    if words:
        raise UserError(f"unknown argument '{words[0]}': set parameters with --ros-args -p name:=value, see --help")
