# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can cause end a command with one line."""

import ast
import builtins
from pathlib import Path

import pytest

from aeropend_sim.cli.command import entry_point
from aeropend_sim.errors import UserError

SOURCES = sorted(Path(__file__).parents[1].glob("src/*/aeropend_*/**/*.py"))
BUILTIN = {name for name, value in vars(builtins).items() if isinstance(value, type) and issubclass(value, Exception)}
INTERNAL = {"JsonError"}
"""A caller in the same package turns it into a DocumentError."""


def test_every_error_of_the_packages_is_a_user_error():
    classes = [node for path in SOURCES for node in ast.walk(ast.parse(path.read_bytes()))
               if isinstance(node, ast.ClassDef)]
    own_base = {node.name for node in classes
                if any(isinstance(base, ast.Name) and base.id in BUILTIN for base in node.bases)}
    assert own_base == {"UserError", *INTERNAL}


@pytest.mark.promise("Commands", "An input that cannot be used ends a command with one line and exit code 2")
def test_a_user_error_is_one_line_and_exit_code_2(capsys):
    @entry_point("my_command")
    def main() -> int:
        raise UserError("my_bag\n: \x1b[2Jnot a bag")

    assert main() == 2
    assert capsys.readouterr() == ("", "my_command: my_bag\\n: \\x1b[2Jnot a bag\n")


@pytest.mark.parametrize(("raised", "line"), [("", "interrupted, nothing written"), ("3 of 5 done", "3 of 5 done")])
def test_ctrl_c_is_one_line_and_exit_code_130(raised, line, capsys):
    @entry_point("my_command", "interrupted, nothing written")
    def main() -> int:
        raise KeyboardInterrupt(*[raised] * bool(raised))

    assert main() == 130
    assert capsys.readouterr() == ("", f"my_command: {line}\n")
