# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM end every node with exit code 0 and without a traceback, whenever they come, once or twice."""

import signal
import subprocess
import sys
import time

import pytest

BATCH = 5
READY = {"plant": "effects: none", "excite": "no subscriber"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("name", "times"), [("plant", 10), ("excite", 5)])
def test_a_signal_ends_it_with_exit_code_0(start, name, times, number):
    codes = []
    for first in range(0, times, BATCH):
        processes = [start(name) for _ in range(BATCH)]
        for at, process in enumerate(processes):
            process.wait_for(READY[name])
            time.sleep(0.03 * at)  # another moment of its life each time
            process.send(number)
            if (first + at) % 2:
                process.send(number)
        for process in processes:
            codes.append(process.wait())
            assert "Traceback" not in process.output
    assert codes == [0] * times


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_start_up_ends_the_plant(start, number):
    """From the moment the handlers stand, which is before compiling and before the node exists."""
    processes = [start("plant") for _ in range(4)]
    for at, process in enumerate(processes):
        process.wait_for_handlers()
        time.sleep(0.1 * at)
        process.send(number)
    assert [process.wait() for process in processes] == [0] * 4
    assert all("Traceback" not in process.output for process in processes)


HANGING = """
import sys, threading, time
from rclpy.node import Node
from aeropend_sim.ros import program

class Hanging(Node):
    def close(self):
        print("closed", flush=True)

    def destroy_node(self):
        time.sleep(1000.0)

program.LEAVE_S = 0.5
threading.Timer(0.5, lambda: signal.raise_signal(signal.SIGINT)).start()
sys.exit(program.run(lambda: Hanging("hanging")))
"""


def test_a_middleware_that_hangs_at_the_end_does_not_keep_a_program_that_has_done_its_part():
    done = subprocess.run([sys.executable, "-c", "import signal" + HANGING], capture_output=True, text=True,
                          check=False, timeout=60)  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "closed\n"), done.stderr
