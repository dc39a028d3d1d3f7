# SPDX-License-Identifier: Apache-2.0
"""The second half: what may go wrong, one thing after the other, and what is promised of each.

Each fault finds a loop in order, and ends when it is in order again: `Stand.follows`.
"""

import math
import re
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64

from aeropend_ident.bags import recording
from aeropend_ident.commands.recover import recover
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import load, save
from aeropend_sim.ros import interface
from evaluation.soak.stand import LAW, PERIOD_NS, RIGS, Stand
from evaluation.support.graph import Process

PAUSE_S = 1.0
STEP_S = 7.0
LATE_NS = 50_000_000
"""Age of a sample that comes at once, on a machine that has other things to do."""
SILENT_NS = 300_000_000
"""The least for which a bridge that has lost its board is silent: its clock must settle again."""
SAFE_NS = 1_000_000_000
"""What a recorder that is killed has had for longer is on disk."""
ROOM = 150_000
"""Bytes that are left on a disk that becomes full."""
FLOOD = 20_000
JUNK_MIB = 50.0
"""What a process may hold more after a flood."""


class Fault(NamedTuple):
    """A fault: what happens, on which rigs, and in one line what is promised."""

    run: Callable[[Stand], None]
    rigs: tuple[str, ...]

    @property
    def promise(self) -> str:
        """What is promised."""
        return (self.run.__doc__ or "").partition("\n")[0]


FAULTS: dict[str, Fault] = {}


def fault(*rigs: str) -> Callable[[Callable[[Stand], None]], Callable[[Stand], None]]:
    """Enter a fault under its function's name."""

    def enter(run: Callable[[Stand], None]) -> Callable[[Stand], None]:
        FAULTS[run.__name__] = Fault(run, rigs)
        return run

    return enter


# ---- a process is killed, or stands still ----------------------------------------------------------------------------


@fault(*RIGS)
def kill_rig(stand: Stand) -> None:
    """The controller sends duty 0, the board stops the motor by itself within 100 ms; a new node takes over."""
    stand.ear.forget_said()
    killed = stand.send("rig", signal.SIGKILL)
    _silent(stand)
    if stand.rig == "bridge":
        stand.board_stopped(killed)
    stand.start("rig")
    stand.samples(100, "a new node's samples")


@fault(*RIGS)
def stop_rig(stand: Stand) -> None:
    """As when killed, for as long as it stands still; then it is back on ROS time, and has counted what is missing."""
    ear = stand.ear.joints
    _one_publisher(stand)
    before = stand.counted("rig")
    since, _ = stand.ear.position()
    stopped = stand.send("rig", signal.SIGSTOP)
    _silent(stand)
    if stand.rig == "bridge":
        stand.board_stopped(stopped)
    _wait(stand, stopped, PAUSE_S)
    stand.send("rig", signal.SIGCONT)
    stand.samples(300, "samples again")
    stand.promise("they are ROS time again", lambda: ear.received[-1] - ear.stamps[-1] < LATE_NS)
    after = stand.counted("rig")
    steps = np.diff(np.array(ear.stamps[since - 1:]))
    stand.check("stamps rise", bool((steps > 0).all()))
    if stand.rig == "plant":
        stand.check("they stay on their grid", not (steps % PERIOD_NS).any())
    counter = "lost ticks" if stand.rig == "plant" else "lost samples"
    counted = after[counter] - before[counter]
    gone, on_the_way = stand.gone(since)
    if _board_went_on(before, after):
        stand.check("what is missing was counted", counted == gone - on_the_way,
                    f"{gone} missing, {counted:.0f} counted, {on_the_way} published but lost on the way")
    # of what a bridge finds waiting at its port, no more than the queue of its publisher holds gets through for sure
    stand.end_recording(lossy=True)
    stand.start("recorder")


@fault(*RIGS)
def kill_controller(stand: Stand) -> None:
    """The rig holds the last duty; `enable` (false) makes it 0, until a new controller has a reference."""
    since, _ = stand.ear.position()
    stand.send("controller", signal.SIGKILL)
    _without_controller(stand)
    stand.start("controller")
    stand.none_lost(since)


@fault(*RIGS)
def stop_controller(stand: Stand) -> None:
    """The same, until it goes on."""
    since, _ = stand.ear.position()
    stand.send("controller", signal.SIGSTOP)
    _without_controller(stand)
    stand.send("controller", signal.SIGCONT)
    stand.none_lost(since)


@fault("plant")
def kill_recorder(stand: Stand) -> None:
    """Its bag can be read and ends at most a second early, `recover` makes it whole; no other process is affected."""
    since, _ = stand.ear.position()
    killed = stand.send("recorder", signal.SIGKILL)
    stand.nodes["recorder"].wait()
    _broken_off(stand, killed)
    stand.start("recorder")
    stand.samples(300)
    stand.none_lost(since)


@fault("plant")
def stop_recorder(stand: Stand) -> None:
    """Messages that the middleware cannot hold are counted as lost; no other process is affected."""
    _one_publisher(stand)
    since, _ = stand.ear.position()
    stopped = stand.send("recorder", signal.SIGSTOP)
    _wait(stand, stopped, PAUSE_S)
    stand.send("recorder", signal.SIGCONT)
    stand.samples(700)
    stand.none_lost(since)
    stand.end_recording(lossy=True)
    stand.start("recorder")


def _silent(stand: Stand) -> None:
    stand.promise("controller: duty 0", lambda: stand.told("controller", "no sample for")
                  and stand.ear.commands.values[-1] == 0.0)


def _one_publisher(stand: Stand) -> None:
    """Wait until nodes that were killed are forgotten, 20 s: who counts what is lost must know who sends."""
    topic = f"{stand.namespace}/{interface.JOINT_STATES}"
    stand.wait("the graph forgets the killed", lambda: stand.graph.node.count_publishers(topic) == 1)
    stand.samples(500)  # by now everybody has


def _wait(stand: Stand, since_ns: int, seconds: float) -> None:
    stand.wait(f"{seconds:g} s pass", lambda: time.time_ns() > since_ns + 1e9 * seconds)


def _without_controller(stand: Stand) -> None:
    """Nobody commands the rig: it holds the duty until it is switched off, and then has none."""
    duties = stand.ear.armature.values
    stand.samples(100)  # what was on its way
    _, at = stand.ear.position()
    stand.samples(300)
    held = set(duties[at:])
    stand.check("the rig holds the last duty", len(held) == 1 and held != {0.0}, sorted(held)[:3])
    stand.enable(False)
    stand.duty_is_0("off: duty 0")
    stand.enable(True)
    _, at = stand.ear.position()
    stand.samples(100)
    stand.check("on again: duty 0 until the next command", not any(duties[at:]))


def _broken_off(stand: Stand, killed_ns: int | None = None) -> None:
    """Check the bag of a recorder that was killed, or that had no disk left."""
    try:
        read = recording.read(stand.bag, stand.namespace)
    except recording.RecordingError as error:
        stand.check("the bag opens", False, error)
        return
    if killed_ns is not None:
        heard = stand.ear.joints
        at = int(np.searchsorted(heard.received, killed_ns - SAFE_NS)) - 1  # the rig itself may have been silent
        early = (heard.stamps[at] - int(read.stamp_ns[-1])) * 1e-9
        stand.check("what came a second before and earlier is in the bag", early <= 0.0, f"{early:+.2f} s")
    there = stand.in_bag(stand.bag)
    missing = stand.missing(there)
    stand.check("what was heard until then is in it", missing == 0, f"{missing} missing of {len(read)}")
    done = recover(stand.bag)
    whole = done.out is not None and recording.read(done.out, stand.namespace).complete
    stand.check("recover makes it whole", whole and sum(map(len, there.values())) == sum(
        done.counts[f"{stand.namespace}/{name}"] for name in there))


# ---- disk, cable, clock ----------------------------------------------------------------------------------------------


@fault("plant")
def full_disk(stand: Stand) -> None:
    """The recorder ends with one line and exit code 2, its bag has what it reports as saved; no other is affected."""
    since, _ = stand.ear.position()
    recorder = stand.nodes["recorder"]
    size = max(file.stat().st_size for file in stand.bag.iterdir())
    # what writes past it fails with EFBIG, as a full disk does with ENOSPC
    resource.prlimit(recorder.popen.pid, resource.RLIMIT_FSIZE, (size + ROOM, size + ROOM))
    stand.promise("it ends", lambda: recorder.popen.poll() is not None)
    stand.check("with exit code 2", recorder.popen.returncode == 2, recorder.popen.returncode)
    lines = [line for line in recorder.output.splitlines() if not line.startswith("[")]
    stand.check("and one line", len(lines) == 1 and "the disk is full: the recording ends here" in lines[0],
                " ".join(lines)[-200:])
    safe = re.search(r"ends here, (\d+) messages", recorder.output)
    stored = sum(1 for _ in recording.Bag(stand.bag).messages())
    stand.check("what it says is safe is in the bag", safe and stored == int(safe[1]), stored)
    _broken_off(stand)
    stand.start("recorder")
    stand.samples(300)
    stand.none_lost(since)


@fault("bridge")
def unplug(stand: Stand) -> None:
    """The controller sends duty 0; a second after the board is back samples come, with duty 0 until a new command."""
    _board(stand, f"unplug+{PAUSE_S:g}", "reconnects", PAUSE_S)


@fault("bridge")
def reset_board(stand: Stand) -> None:
    """The board's clock restarts, the ROS stamps go on; samples come within a second, with duty 0."""
    _board(stand, "reset", "board resets", 0.0)


def _board(stand: Stand, name: str, counter: str, away_s: float) -> None:
    before = stand.counted("rig")[counter]
    since = stand.ear.position()[1] - 1
    at = stand.board.inject(name)
    track = stand.ear.armature
    stand.promise("a gap, and samples again", lambda: len(track) > since + 300 and max(
        np.diff(track.stamps[since:])) > 0.1e9)
    stamps, duty = np.array(track.stamps[since:]), track.values[since:]
    first = int(np.argmax(np.diff(stamps))) + 1
    heard = stand.ear.commands
    before_return = np.searchsorted(heard.received, at + SILENT_NS)
    stand.check("the controller sends duty 0", heard.values[before_return - 1] == 0.0, heard.values[before_return - 1])
    late = (stamps[first] - at) * 1e-9 - away_s
    stand.check("within a second", late < 1.0, f"{late:.2f} s")
    stand.check("the first with duty 0", duty[first] == 0.0, duty[first])
    stand.check("stamps rise", bool((np.diff(stamps) > 0).all()))
    counted = stand.counted("rig")[counter] - before
    stand.check(f"{counter}: 1", counted == 1.0, f"{counted:.0f}")


@fault(*RIGS)
def clock_step(stand: Stand) -> None:
    """The system clock of all nodes is set ahead and back: stamps follow it within two seconds, and none is lost."""
    assert stand.clock is not None
    before = stand.counted("rig")["clock steps"]
    ear = stand.ear
    since, _ = ear.position()
    for number, ahead in enumerate((STEP_S, 0.0), 1):
        stand.clock.set(ahead)
        stand.promise("the rig's node notices", lambda number=number: stand.counters("rig").get(
            "clock steps") == before + number)
        stand.samples(500)
        stand.promise("stamps are on the clock", lambda ahead=ahead: abs(
            time.time_ns() + 1e9 * ahead - ear.joints.stamps[-1]) < LATE_NS)
        stand.follows("the loop goes on")
    steps = np.diff(np.array(ear.joints.stamps[since - 1:]))
    moved = np.abs(steps - PERIOD_NS) > 1e9
    stand.check("stamps move twice", moved.sum() == 2, int(moved.sum()))
    lost = int((np.round(steps[~moved] / PERIOD_NS) - 1).sum())
    stand.check("no sample is lost meanwhile", lost == 0, lost)
    if stand.rig == "plant":
        stand.check("they stay on their grid", not (steps % PERIOD_NS).any())
    stand.end_recording()
    stand.start("recorder")


# ---- what others do --------------------------------------------------------------------------------------------------


@fault("plant")
def bad_parameters(stand: Stand) -> None:
    """A node with a damaged parameter file ends with one line and exit code 2, or runs; no other is affected."""
    since, _ = stand.ear.position()
    folder = stand.bag.parent
    started: list[tuple[bytes, Process]] = []
    for number in range(4):
        data = _damaged(stand, folder)
        file = folder / f"damaged_{number}.yaml"
        file.write_bytes(data)
        args = ["--params-file", str(file)] if number else ["-p", f"model:={file}"]
        started.append((data, stand.another("plant" if number else LAW, "--ros-args", *args, namespace="/damaged")))
    for data, process in started:
        stand.wait("it ends, or runs", lambda process=process: process.popen.poll() is not None
                      or "[INFO]" in process.output)
        ran = process.popen.poll() is None
        code = process.stop()
        lines = process.output.splitlines()
        good = code == 0 if ran else code == 2 and len(lines) == 1
        stand.check("with one line and exit code 2, or well", good and "Traceback" not in process.output,
                    "runs" if ran else f"{code}: {lines[-1:]}" if good else f"{code}: {lines} of {data!r}")
    stand.none_lost(since)


def _damaged(stand: Stand, folder: Path) -> bytes:
    """A parameter file with damage as of a disk, a cable or a person."""
    chance = stand.random
    effect = chance.choice(list(CATALOGUE))
    numbers = {key: one.default for key, one in CATALOGUE[effect].parameters.items()}
    good = folder / "good.yaml"
    save(load(chance.choice(("bench", "thesis"))).with_effects({effect: numbers}), good)
    data = bytearray(good.read_bytes())
    good.unlink()
    at, length = chance.randrange(len(data)), chance.randrange(1, 200)
    kind = chance.choice(("cut", "flip", "zeros", "twice", "noise"))
    if kind == "cut":
        del data[at:]
    elif kind == "flip":
        for _ in range(length // 10 + 1):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif kind == "zeros":
        data[at : at + length] = bytes(length)
    elif kind == "twice":
        data[at:at] = data[at : at + length]
    else:
        data[at : at + length] = chance.randbytes(length)
    return bytes(data)


@fault("plant")
def two_plants(stand: Stand) -> None:
    """The controller reports two publishers, the bag has the samples of both; with one again the loop goes on."""
    ear = stand.ear
    ear.forget_said()
    text = f"2 publishers of {interface.JOINT_STATES}"
    with stand.another("plant", "--ros-args") as second:
        stand.promise("the controller reports it", lambda: stand.told("controller", text))
        since, _ = stand.ear.position()
        stand.samples(700, "samples of both")
        grids = {stamp % PERIOD_NS for stamp in ear.joints.stamps[since:]}
        stand.check("samples of both", len(grids) == 2, len(grids))
        code = second.stop()
    stand.check("the second ends with exit code 0", code == 0, code)
    ear.forget_said()
    stand.promise("the controller knows of one again", lambda: ear.said.get(LAW) and text not in ear.said[LAW][-1])
    stand.follows("the loop goes on")
    stand.end_recording()
    stand.start("recorder")


@fault(*RIGS)
def junk_flood(stand: Stand) -> None:
    """NaN is refused and counted, `enable` (false) is heard: duty 0; all samples are published, no memory taken."""
    ear = stand.ear
    before = stand.counted("rig")
    since, _ = ear.position()
    mib = {role: stand.memory_mib(process) for role, process in stand.nodes.items()}
    good = serialize_message(Float64(data=0.2))
    junk: list[Float64 | bytes] = [Float64(data=value) for value in (math.nan, 7.0, -math.inf, -3.0)]
    junk += [good[:6], b"\0\1\0\0\1\2", b"\xff" * len(good)]
    with _flooding(stand, junk) as flood:
        flood(FLOOD)
        stand.enable(False)
        flood(FLOOD // 10)
        stand.duty_is_0("off: duty 0")
        flood(FLOOD // 10)
        stand.duty_is_0("and it stays 0")
        stand.enable(True)
    after = stand.counted("rig")
    counted = after["refused commands"] - before["refused commands"]
    stand.check("NaN and infinity were refused and counted", counted > 0, f"{counted:.0f}")
    if _board_went_on(before, after):
        gone, on_the_way = stand.gone(since)
        stand.check("all samples are published", gone == on_the_way, f"{gone - on_the_way} are not")
    for role, process in stand.nodes.items():
        grown = stand.memory_mib(process) - mib[role]
        stand.check(f"{role}: its memory stays", grown < JUNK_MIB, f"{grown:+.1f} MiB")
    stand.end_recording(lossy=True)  # of the junk, and of what was published beside it
    stand.start("recorder")


def _board_went_on(before: dict[str, float], after: dict[str, float]) -> bool:
    """Whether the emulated board kept real time: when it did not, it took no samples that could be missing."""
    return after.get("clock stops") == before.get("clock stops")


@contextmanager
def _flooding(stand: Stand, junk: list[Float64 | bytes]) -> Iterator[Callable[[int], None]]:
    """Gives what sends so many of them as fast as it goes."""
    node = stand.graph.node
    publisher = node.create_publisher(Float64, f"{stand.namespace}/{interface.DUTY_COMMAND}", interface.QOS)

    def flood(count: int) -> None:
        for k in range(count):
            publisher.publish(junk[stand.random.randrange(len(junk))])
            if k % 500 == 0:
                stand.ear.drain()

    try:
        stand.wait("the rig hears the stranger", lambda: publisher.get_subscription_count() >= 2)
        yield flood
    finally:
        node.destroy_publisher(publisher)
