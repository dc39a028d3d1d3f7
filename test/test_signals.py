# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM end every node with exit code 0 and without a traceback, whenever they come, once or twice."""

import signal
import time

import pytest

BATCH = 5
READY = {"plant": "effects: none", "excite": "nobody listens"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("name", "times"), [("plant", 25), ("excite", 5)])
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
