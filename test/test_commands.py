# SPDX-License-Identifier: Apache-2.0
"""Every command explains itself, and the shell completes it."""

import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from aeropend_sim.cli import aeropend
from aeropend_sim.cli.completion import commands
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import load, to_flat

COMMANDS = {entry.name: entry for entry in commands()}
MODEL = to_flat(load("bench").with_effects({effect.id: {name: p.default for name, p in effect.parameters.items()}
                                            for effect in CATALOGUE.values()}))
ROOT = Path(__file__).parents[1]
DOCUMENTS = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("src/*/README.md")]

BASH = """
eval "$({python} -m aeropend_sim.cli.completion)"
COMP_LINE=$1 COMP_POINT=${{#1}} COMP_TYPE=9
read -ra words <<<"$COMP_LINE"
complete -p "${{words[0]##*/}}" >&2
_python_argcomplete "${{words[0]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
"""What bash does on TAB: it calls the function that is registered for the command, which sets COMPREPLY."""

ZSH = """
autoload -U compinit && compinit -u -D
eval "$({python} -m aeropend_sim.cli.completion)"
show() {{ print -r -- "<$BUFFER>" }}
zle -N show
bindkey '^X' show
print ready
"""
"""Ctrl-X shows the line as it stands."""


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


@pytest.mark.promise("Commands", "`--help` of each command shows examples and exit codes")
@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_examples_and_exit_codes(name, capsys):
    text = shown(COMMANDS[name], capsys)
    lines = [line.removeprefix("usage:").strip() for line in text.splitlines()]
    examples = [line for line in lines if line.split(" ")[0] == name or line.startswith(f"aeropend {name} ")]
    examples = [line for line in examples if "[-h]" not in line]
    assert len(examples) >= 2, text
    (codes,) = [line for line in lines if line.startswith("exit codes: 0 ")]
    assert "2 " in codes


@pytest.mark.parametrize("name", ["demo", "design", "excitation_quality", "isolate", "live"])
def test_a_seed_that_cannot_be_is_one_line_before_anything_is_made(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        COMMANDS[name].load()(["--seed", "-1"])
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.promise("Commands", "Command lines in documents that begin with `.venv/bin/` name commands, options and "
                     "parameters that exist")
@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_command_lines_of_a_document_are_understood(path, capsys):
    """By their help: names of commands, options and parameters; and effects by formula that the document defines."""
    text = path.read_text(encoding="utf-8")
    formulas = re.findall(r"^    (\w+):\n((?: {6}.+\n)+)", text, re.MULTILINE)
    defined = {f"effects.{effect}.{name}" for effect, lines in formulas
               for name in re.findall(r"^ {8}(\w+): \{unit", lines, re.MULTILINE)}
    for line in re.findall(r"^    (?:eval \"\$\()?\.venv/bin/(.+?)\)?\"?$|`\.venv/bin/([^`]+)`", text, re.MULTILINE):
        name, *words = shlex.split("".join(line), comments=True)
        if name == "python":
            module = f"{words[1].replace('.', '/')}.py"
            assert (ROOT / module).is_file() or (ROOT / "src" / module.partition("/")[0] / module).is_file(), line
            continue
        told = set(re.findall(r"[\w.-]+", shown(COMMANDS[name], capsys)))
        parameters = [word.partition(":=")[0] for word in words if ":=" in word]
        options = [word for word in words if word.startswith("--") and word not in ("--ros-args", "--params-file")]
        assert [one for one in [*options, *parameters] if one not in {*told, *MODEL, *defined}] == [], line


@pytest.mark.promise("Commands", "`aeropend` lists all commands and runs them")
def test_aeropend_lists_every_command_once(capsys):
    assert aeropend.main([]) == 0
    listed = re.findall(r"^  (\w+)  ", capsys.readouterr().out, re.MULTILINE)
    assert sorted([*listed, "aeropend"]) == sorted(COMMANDS)


@pytest.mark.promise("Commands", "`aeropend` lists all commands and runs them")
def test_aeropend_runs_a_command_as_its_own_program_does(tmp_path):
    folder = Path(sys.executable).parent
    alone, through = (
        subprocess.run([*command, "no_such_bag"], capture_output=True, text=True, check=False, cwd=tmp_path, timeout=60)
        for command in ([folder / "step_response"], [folder / "aeropend", "step_response"]))
    assert (through.returncode, through.stdout, through.stderr) == (2, "", alone.stderr)
    assert alone.stderr.startswith("step_response: no_such_bag")


@pytest.mark.parametrize(("typed", "hint"), [
    ("diagnos", "did you mean diagnose?"),
    ("xyz", "aeropend lists the commands"),
])
def test_aeropend_hints_at_a_mistyped_command(typed, hint, capsys):
    assert aeropend.main([typed]) == 2
    assert capsys.readouterr().err == f"aeropend: there is no command '{typed}'; {hint}\n"


def test_aeropend_lists_the_commands_without_importing_them():
    code = "from aeropend_sim.cli.aeropend import main; import sys; main([]); sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False).returncode == 0


def completions(line: str) -> list[str]:
    script = BASH.format(python=sys.executable)
    done = subprocess.run(["bash", "-c", script, "bash", line], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.split()


@pytest.mark.promise("Commands", "TAB completes commands, options, parameters and effects in bash and zsh")
@pytest.mark.parametrize(("line", "expected"), [
    ("plant --ros-args -p preset:=", ["bench", "thesis"]),
    ("plant --ros-args -p effects.coulomb_", ["effects.coulomb_friction.accel:="]),
    ("demo --effect coulomb", ["coulomb_friction"]),
    ("cascade --ros-args -p model:=CO", ["CONTRIBUTING.md"]),
    ("cascade --ros-args -p model:=t", ["thesis", "test/", "tools/"]),
    ("tune feedback_linearization --mo", ["--model"]),
    ("aeropend diag", ["diagnose"]),
    ("aeropend tune feedback_linearization --mo", ["--model"]),
    ("aeropend plant --ros-args -p preset:=", ["bench", "thesis"]),
    ("aeropend no_command --mo", []),
])
def test_bash_completes_what_a_command_takes(line, expected):
    assert completions(str(Path(sys.executable).parent / line)) == expected


@pytest.fixture(scope="module")
def zsh_completes(tmp_path_factory):
    """What a zsh on a terminal makes of a line and TAB."""
    file = tmp_path_factory.mktemp("zsh") / "rc"
    file.write_text(ZSH.format(python=sys.executable))
    terminal, end = pty.openpty()
    said = ""

    def type_in(text: str, until: str) -> str:
        nonlocal said
        before = len(said)
        os.write(terminal, text.encode())
        while until not in said[before:]:
            assert select.select([terminal], [], [], 30.0)[0], said
            said += os.read(terminal, 4096).decode()
        return said[before:]

    with subprocess.Popen(["zsh", "-f", "-i"], stdin=end, stdout=end, stderr=end, start_new_session=True,
                          env={**os.environ, "TERM": "dumb"}) as shell:
        os.close(end)
        type_in(f"source {file}\n", "\nready")
        yield lambda line: type_in(f"\x15{line}\t\x18", ">\r\n").rpartition("<")[2].partition(">")[0].rstrip()
        shell.kill()
    os.close(terminal)


@pytest.mark.promise("Commands", "TAB completes commands, options, parameters and effects in bash and zsh")
@pytest.mark.parametrize(("line", "completed"), [
    ("plant --ros-args -p preset:=th", "plant --ros-args -p preset:=thesis"),
    ("plant --ros-args -p effects.coulomb_friction.a", "plant --ros-args -p effects.coulomb_friction.accel:="),
    ("cascade --ros-args -p model:=CO", "cascade --ros-args -p model:=CONTRIBUTING.md"),
    ("tune feedback_linearization --mo", "tune feedback_linearization --model"),
    ("aeropend diag", "aeropend diagnose"),
    ("aeropend tune feedback_linearization --mo", "aeropend tune feedback_linearization --model"),
])
def test_zsh_completes_it_too(zsh_completes, line, completed):
    folder = f"{Path(sys.executable).parent}/"
    assert zsh_completes(folder + line) == folder + completed


def test_help_leaves_the_process_as_it_was(capsys):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    for name in ("plant", "step_test"):
        shown(COMMANDS[name], capsys)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_command_whose_reader_is_gone_ends_in_silence():
    code = ("from aeropend_sim.cli.command import entry_point; "
            "exit(entry_point('list')(lambda: [print(k) for k in range(10**5)][0])())")
    command = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert command.stdout.readline() == "0\n"
    command.stdout.close()
    assert command.wait() == 128 + signal.SIGPIPE
    assert command.stderr.read() == ""
