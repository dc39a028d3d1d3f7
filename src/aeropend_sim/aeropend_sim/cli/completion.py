# SPDX-License-Identifier: Apache-2.0
"""Completion of all commands with TAB, in bash and zsh: `eval "$(python -m aeropend_sim.cli.completion)"`."""

from importlib.metadata import EntryPoint, entry_points

PROGRAM = "aeropend"
"""The command that runs all others."""


WORDS_OF_THE_SHELL = ("export",)
"""Commands whose bare name is a word of the shell, which completes it itself; `aeropend export` is completed."""


def commands() -> list[EntryPoint]:
    """All commands of the installed packages, by name."""
    ours = {e.name: e for e in entry_points(group="console_scripts") if e.value.startswith("aeropend_")}
    return [ours[name] for name in sorted(ours)]


def main() -> None:
    """Print the code for the shell to evaluate."""
    from argcomplete.shell_integration import shellcode

    print(shellcode([c.name for c in commands() if c.name not in WORDS_OF_THE_SHELL], use_defaults=False))


if __name__ == "__main__":
    main()
