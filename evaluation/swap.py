# SPDX-License-Identifier: Apache-2.0
"""One rig for another: the same commands against the simulated plant and against the bridge with the emulated board.

Each rig has a ROS domain of its own, so that no command needs an argument that says which one it talks to.

Run as a command, `python -m evaluation.swap`, it does with every law what the suite does with some, and compares. As
`python -m evaluation.swap record BAG SECONDS [EFFECT]` it records a board, with an effect or none, in a domain of its
own.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from evaluation.support.graph import PATIENCE_S, Process, isolate, parameters

EMULATED_BOARD = Path(__file__).parents[1] / "firmware" / "emulator" / "emulated_board"
LEVELS = {"cascade": (60.0, 99.5, 60.0, 99.5)}
"""What is stepped to, rad/s; other laws: `ANGLES`."""
ANGLES = (0.3, 0.6, 0.3, 0.6)
LAWS = ("small_signal", "feedback_linearization", "cascade", "feedback_linearization_cascade")
METRICS = ("rise_time", "peak_time", "settling_time", "peak")


@contextmanager
def domain(number: int) -> Iterator[None]:
    """What is started meanwhile is in the ROS domain `number` further on."""
    own = os.environ["ROS_DOMAIN_ID"]
    os.environ["ROS_DOMAIN_ID"] = str((int(own) + number) % 102)
    try:
        yield
    finally:
        os.environ["ROS_DOMAIN_ID"] = own


class EmulatedBoard(NamedTuple):
    """An emulated board that runs: the path of its port, and its process."""

    port: Path
    process: subprocess.Popen[bytes]

    def inject(self, fault: str) -> int:
        """Type a fault, and return the system time of it, ns."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{fault}\n".encode())
        self.process.stdin.flush()
        return time.time_ns()


class NoBoardError(Exception):
    """The emulated board did not start; the message is one line that says why."""


@contextmanager
def emulated_board(*args: str | Path) -> Iterator[EmulatedBoard]:
    """The emulated board, stopped when it is left.

    Raises:
        NoBoardError: it did not start.
    """
    with tempfile.TemporaryDirectory(prefix="aeropend_board_") as folder, tempfile.TemporaryFile() as output:
        link = Path(folder) / "tty"
        program = subprocess.Popen(
            [EMULATED_BOARD, "--link", link, *args], stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT
        )
        try:
            end = time.monotonic() + PATIENCE_S
            while not link.exists():
                if program.poll() is not None or time.monotonic() > end:
                    output.seek(0)
                    said = output.read().decode().strip().splitlines()
                    raise NoBoardError(f"emulated_board did not start: {said[-1] if said else 'no port'}")
                time.sleep(0.02)
            yield EmulatedBoard(link, program)
        finally:
            program.terminate()
            program.wait()


@contextmanager
def rig(node: str, *board: str, args: Sequence[str] = ()) -> Iterator[Process]:
    """The plant, or the bridge with an emulated board; the node's process."""
    with ExitStack() as stack:
        own = parameters(port=stack.enter_context(emulated_board(*board)).port) if node == "bridge" else []
        yield stack.enter_context(Process(node, *own, *args))


def steps(law: str, hold: float, out: Path) -> list[dict[str, float]]:
    """Let a law step the rig of this domain, and return what describes each step, by the names of `StepResponse`.

    `peak` is added: where the response went at most, in parts of the way.
    """
    with Process(law):
        levels = map(str, LEVELS.get(law, ANGLES))
        test = Process("step_test", "--law", law, "--levels", *levels, "--hold", str(hold), "--out", str(out))
        assert test.wait() == 0, test.output
    return [step | {"peak": 1.0 + step["overshoot"]} for step in json.loads((out / "steps.json").read_text())["steps"]]


def ratios(plant: Sequence[dict[str, float]], bridge: Sequence[dict[str, float]]) -> dict[str, float]:
    """What describes the steps on the bridge over the same on the plant: the median over the steps, by metric."""
    return {
        name: statistics.median(
            theirs[name] / ours[name]
            for ours, theirs in zip(plant, bridge, strict=True)
            if ours[name] is not None and theirs[name] is not None
        )
        for name in METRICS
        if any(ours[name] is not None and theirs[name] is not None for ours, theirs in zip(plant, bridge, strict=True))
    }


def record(bag: Path, seconds: float) -> None:
    """Excite the rig of this domain and record it."""
    with Process("record", str(bag), *parameters(while_published="duty_command")) as recorder:
        recorder.wait_for("joint_states 4")  # the line with the rates: it has subscribed
        excite = Process("excite", *parameters(duration=seconds))
        assert excite.wait(seconds + PATIENCE_S) == 0, excite.output
        assert recorder.wait() == 0, recorder.output


def main() -> int:
    """Record a board, or step every law on both rigs."""
    isolate()
    if sys.argv[1:2] == ["record"]:
        bag, seconds, *effect = sys.argv[2:]
        with rig("bridge", *(["--effect", *effect] if effect else [])):
            record(Path(bag), float(seconds))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        found = {}
        for number, node in enumerate(("plant", "bridge")):
            with domain(number), rig(node):
                for law in LAWS:
                    found[node, law] = steps(law, 4.0, Path(folder) / node / law)
    for law in LAWS:
        for name, ratio in ratios(found["plant", law], found["bridge", law]).items():
            print(f"{law:<31} {name:<14} bridge over plant {ratio:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
