# SPDX-License-Identifier: Apache-2.0
"""The command `aeropend`: it lists all commands by their purpose and runs them.

It imports no command before it runs one, so that the list comes at once.
"""

import difflib
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from aeropend_sim.cli.completion import PROGRAM, commands

PURPOSES = {
    "Diagnose the gap between model and rig": {
        "demo": "simulate a rig with a hidden effect, record it and diagnose it",
        "diagnose": "find the effects that a model lacks, from recordings",
        "live": "simulate a rig that changes while it runs, and watch it",
        "watch": "run the model beside a rig and tell when they part",
        "doctor": "check the installation, recordings and model files",
        "isolate": "say before a recording which effects it would show",
        "design": "find the signal that shows most, within limits",
        "investigate": "run experiments on a rig until the verdict is sure",
        "excitation_quality": "check how well an input excites each term of the model",
        "precompile": "compile now what the first diagnosis would wait for",
    },
    "Record and convert": {
        "record": "write the topics of a rig into a bag",
        "replay": "publish the messages of a bag again",
        "recover": "repair a bag whose recording was interrupted",
        "import": "convert a table (CSV, Excel, MATLAB, NumPy) to a bag",
    },
    "Simulate": {
        "plant": "simulate the rig as a node, with chosen effects",
        "pose": "publish the pose of the rig for a 3D view",
        "export": "write a model for MuJoCo, Simulink, Gazebo, C or Python",
        "import_model": "make a model file from a description (MJCF or URDF)",
    },
    "Use a real rig": {
        "bridge": "connect the board of a rig to ROS",
        "calibrate": "measure the zeros of the sensors at rest",
        "bench_test": "calculate parameters from bench measurements",
    },
    "Excite and control": {
        "excite": "publish an excitation signal",
        "reference": "send a reference to a controller",
        "small_signal": "control the angle by a gain-scheduled PID",
        "feedback_linearization": "control the angle by feedback linearization",
        "cascade": "control the rotor speed by cascaded loops",
        "feedback_linearization_cascade": "control the angle by feedback linearization over a speed loop",
        "tune": "calculate the gains of a controller and its margins",
        "step_test": "run steps with a controller and measure the responses",
        "step_response": "measure the step responses in a bag",
    },
    "Identify": {
        "identify": "estimate the equations of a rig from recordings",
    },
}
"""Purpose -> command -> its task."""

USAGE = f"""usage: {PROGRAM} COMMAND [ARGUMENT ...]

Run a command of aeropend. The name {PROGRAM} may be left out; `ros2 run PACKAGE COMMAND` runs the same."""

EXAMPLES = f"""examples:
  {PROGRAM} diagnose my_bag
  {PROGRAM} diagnose --help

exit codes: 0 done, 2 there is no such command; else that of the command"""


def overview() -> str:
    """The installed commands by purpose, with a line each."""
    packages = {command.name: command.value.partition(".")[0] for command in commands()}
    width = max(map(len, packages))
    lines = [USAGE]
    for purpose, tasks in PURPOSES.items():
        lines += ["", f"{purpose}:"]
        lines += [f"  {name:{width}}  {task}" for name, task in tasks.items() if name in packages]
    return "\n".join([*lines, "", EXAMPLES])


def _first_argument() -> str:
    """The first argument of a command line that a shell completes; "" if the cursor is on it."""
    from argcomplete.lexers import split_line

    *_, before, _ = split_line(os.environ["COMP_LINE"], int(os.environ["COMP_POINT"]))
    return "".join(before[int(os.environ["_ARGCOMPLETE"]):][:1])


def _complete_name(names: Sequence[str]) -> None:
    """Print the completions of the name of a command for the shell, and exit."""
    from argparse import ArgumentParser

    from argcomplete import autocomplete

    parser = ArgumentParser()
    parser.add_argument("command", choices=names)
    autocomplete(parser, always_complete_options=False, exit_method=sys.exit)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that the first argument names.

    Args:
        arguments: the command line; None for that of the process.

    Returns:
        The exit code: that of the command, or 2 if there is no such command.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    known = {command.name: command for command in commands() if command.name != PROGRAM}
    if "_ARGCOMPLETE" in os.environ:
        given = [_first_argument()]
        if given[0] not in known:
            _complete_name(list(known))
        os.environ["_ARGCOMPLETE"] = str(int(os.environ["_ARGCOMPLETE"]) + 1)  # the command's words begin one later
    if not given or given[0] in ("-h", "--help", "--ros-args"):
        print(overview())
        return 0
    name, *rest = given
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"{PROGRAM} lists the commands"
        print(f"{PROGRAM}: there is no command {name!r}; {hint}", file=sys.stderr)
        return 2
    sys.argv = [str(Path(sys.argv[0]).with_name(name)), *rest]
    code: int = known[name].load()()
    return code


if __name__ == "__main__":
    sys.exit(main())
