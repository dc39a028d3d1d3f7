# SPDX-License-Identifier: Apache-2.0
"""Every command explains itself, and the shell completes it."""

import signal
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from aeropend_sim.completion import commands

COMMANDS = {entry.name: entry for entry in commands()}

BASH = """
eval "$({python} -m aeropend_sim.completion)"
COMP_LINE=$1 COMP_POINT=${{#1}} COMP_TYPE=9
read -ra words <<<"$COMP_LINE"
complete -p "${{words[0]##*/}}" >&2
_python_argcomplete "${{words[0]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
"""What bash does on TAB: it calls the function that is registered for the command, which sets COMPREPLY."""


def shown(entry: EntryPoint, capsys: pytest.CaptureFixture[str]) -> str:
    try:
        code = entry.load()(["--help"])
    except SystemExit as end:
        code = end.code
    assert code == 0
    return capsys.readouterr().out


def test_the_commands_are_those_of_the_four_packages():
    assert {"plant", "bridge", "cascade", "diagnose"} <= COMMANDS.keys()
    assert {entry.module.split(".")[0] for entry in COMMANDS.values()} == {
        "aeropend_sim", "aeropend_bridge", "aeropend_control", "aeropend_ident"}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_examples_and_exit_codes(name, capsys):
    text = shown(COMMANDS[name], capsys)
    lines = [line.removeprefix("usage:").strip() for line in text.splitlines()]
    examples = [line for line in lines if line == name or (line.startswith(f"{name} ") and "[-h]" not in line)]
    assert len(examples) >= 2, text
    (codes,) = [line for line in lines if line.startswith("exit codes: 0 ")]
    assert "2 " in codes


def completions(line: str) -> list[str]:
    script = BASH.format(python=sys.executable)
    done = subprocess.run(["bash", "-c", script, "bash", line], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.split()


@pytest.mark.parametrize(("line", "expected"), [
    ("plant --ros-args -p preset:=", ["bench", "thesis"]),
    ("tune feedback_linearization --mo", ["--model"]),
])
def test_bash_completes_what_a_command_takes(line, expected):
    assert completions(str(Path(sys.executable).parent / line)) == expected


def test_help_leaves_the_process_as_it_was(capsys):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    for name in ("plant", "step_test"):
        shown(COMMANDS[name], capsys)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_command_whose_reader_is_gone_ends_in_silence():
    code = "from aeropend_sim.command import interruptible as i; exit(i(lambda: [print(k) for k in range(10**5)][0])())"
    command = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert command.stdout.readline() == "0\n"
    command.stdout.close()
    assert command.wait() == 128 + signal.SIGPIPE
    assert command.stderr.read() == ""
