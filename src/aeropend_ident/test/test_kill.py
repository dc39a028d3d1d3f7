# SPDX-License-Identifier: Apache-2.0
"""record when it is stopped, killed, or runs out of disk, with a plant beside it."""

import os
import resource
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from aeropend_ident.bags.container import Bag
from aeropend_ident.bags.recording import read
from aeropend_ident.commands.recover import recover

UNFINISHED = "the recording was not closed (killed, or still running): it may end up to a second early"


@pytest.fixture
def plant(processes):
    """Run a simulated rig."""
    running = processes.start(module="aeropend_sim.nodes.plant")
    yield running
    assert running.poll() is None
    assert processes.end(running)[0] == 0


def start(processes, out, *parameters, **options):
    arguments = [word for one in parameters for word in ("-p", one)]
    return processes.start(str(out), "--ros-args", *arguments, module="aeropend_ident.nodes.record", **options)


def messages(path):
    """Return the messages on disk, as rosbags finds them."""
    with Reader(path) as reader:
        return [(connection.topic, time, data) for connection, time, data in reader.messages()]


def wait_for(processes, path, recorder, number):
    """Wait until so many messages of the plant are safe on disk: /diagnostics come from recorders too, and earlier."""

    def safe():
        return sum(1 for _ in Bag(path).messages(lambda topic, _: topic != "/diagnostics"))

    deadline = time.monotonic() + 120
    while not (path / "metadata.yaml").exists() or safe() < number:
        assert recorder.poll() is None, recorder.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.promise("Recordings", "A recording that was killed loses at most the last second, and opens as it is")
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("wait", [0.0, 0.17, 0.31])
def test_kill_9_loses_at_most_the_last_second(processes, plant, storage, wait):
    path = processes.folder / "bag"
    recorder = start(processes, path, f"storage:={storage}")
    wait_for(processes, path, recorder, 2000)
    time.sleep(wait)
    killed = time.time_ns()
    recorder.send_signal(signal.SIGKILL)
    assert recorder.wait() == -signal.SIGKILL
    there = {file.name: file.read_bytes() for file in path.iterdir()}

    recording = read(path)
    assert recording.notes[0] == UNFINISHED
    assert not recording.complete
    assert recording.received_ns[-1] >= killed - 1_000_000_000
    if storage == "mcap":  # any tool opens it as it is
        found = messages(path)
        assert len(found) >= 2000
        assert found[-1][1] >= killed - 1_000_000_000

    done = recover(path)
    assert read(done.out).complete
    np.testing.assert_array_equal(read(done.out).stamp_ns, recording.stamp_ns)
    assert sum(done.counts.values()) == len(messages(done.out))
    assert {file.name: file.read_bytes() for file in path.iterdir()} == there


@pytest.mark.promise("Recordings", "A recording that was killed loses at most the last second, and opens as it is")
def test_the_bag_opens_at_any_moment(processes, plant):
    """Copies taken while it is written, as a kill or a reader would find it."""
    path = processes.folder / "bag"
    recorder = start(processes, path)
    wait_for(processes, path, recorder, 100)
    before = 0
    for _ in range(200):
        found = list(Bag(path).messages())
        assert len(found) >= before
        before = len(found)
        time.sleep(0.01)
    assert before > 100
    assert processes.end(recorder)[0] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_well_every_time(processes, plant, number):
    """Five at a time, at three moments from the first message on, every other one signalled twice."""
    for turn in range(3):
        recorders = [start(processes, processes.folder / f"{turn}_{one}") for one in range(5)]
        for one, recorder in enumerate(recorders):
            wait_for(processes, processes.folder / f"{turn}_{one}", recorder, 10)
        time.sleep(turn * 0.2)
        for one, recorder in enumerate(recorders):
            recorder.send_signal(number)
            if one % 2:
                recorder.send_signal(number)
        for one, recorder in enumerate(recorders):
            status, said = processes.wait(recorder)
            assert status == 0, said
            assert "Traceback" not in said
            path = processes.folder / f"{turn}_{one}"
            assert read(path).complete
            assert len(messages(path)) >= 10


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_before_the_first_message(processes, number):
    path = processes.folder / "bag"
    recorder = start(processes, path)
    while not (path / "metadata.yaml").exists():
        assert recorder.poll() is None
        time.sleep(0.01)
    status, said = processes.end(recorder, number)
    assert status == 0, said
    assert Bag(path).problems == []


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_disk_full_ends_it_in_one_line_and_keeps_what_was_written(processes, plant, storage):
    def small_disk():
        # what writes past it fails with EFBIG, as a full disk does with ENOSPC
        resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))

    path = processes.folder / "bag"
    recorder = start(processes, path, f"storage:={storage}", preexec_fn=small_disk)
    status, said = processes.wait(recorder, timeout=120)
    assert status == 2
    lines = [line for line in said.splitlines() if not line.startswith("[")]
    assert len(lines) == 1
    assert lines[0].startswith("record")
    what = "the disk is full" if storage == "mcap" else "the disk is full or fails"
    assert f"{path}: {what}: the recording ends here" in lines[0]
    stored = int(lines[0].split("ends here, ")[1].split()[0])
    assert len(messages(path)) == stored > 100
    recording = read(path)
    assert recording.notes[0] == UNFINISHED


def test_disk_full_from_the_start_leaves_nothing(processes):
    def no_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))

    path = processes.folder / "bag"
    status, said = processes.wait(start(processes, path, preexec_fn=no_disk))
    assert status == 2
    assert said.splitlines()[-1].startswith("record")
    assert f"{path}: cannot be written: the disk is full" in said
    assert not path.exists()


ROOM = int(Path("/proc/sys/net/core/rmem_max").read_text())


@pytest.mark.parametrize("pause", [1.0 if ROOM >= 2**22 else 0.15, 10.0])
def test_what_a_pause_loses_is_counted(processes, plant, pause):
    """A recorder stopped for a while (SIGSTOP) catches up as far as its sockets hold what was sent meanwhile."""
    path = processes.folder / "bag"
    recorder = start(processes, path)
    wait_for(processes, path, recorder, 3000)  # it and the plant have found each other
    os.kill(recorder.pid, signal.SIGSTOP)
    time.sleep(pause)
    os.kill(recorder.pid, signal.SIGCONT)
    wait_for(processes, path, recorder, 4000 + 2 * 490)
    status, said = processes.end(recorder)
    assert status == 0
    missing = 0
    for topic in ("/joint_states", "/armature"):
        stamps = [int.from_bytes(data[4:8], "little") * 10**9 + int.from_bytes(data[8:12], "little")
                  for name, _, data in messages(path) if name == topic]  # fmt: skip
        missing += (stamps[-1] - stamps[0]) // 2_040_000 + 1 - len(stamps)
    lost = said.rsplit("; ", 1)[1].split()[0]
    if pause <= 1.0:
        assert lost == "none"
    else:
        assert 0 < int(lost) <= missing
