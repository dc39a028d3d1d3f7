# SPDX-License-Identifier: Apache-2.0
"""A rig with its controller and its recorder as processes, ears on all their topics, and what was promised of them."""

import math
import os
import random
import re
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from aeropend_control.nodes import wire
from aeropend_ident.bags import recording
from aeropend_ident.bags.container import Bag
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.ros import interface
from evaluation.soak.ear import Ear
from evaluation.support.graph import PATIENCE_S, Graph, Process
from evaluation.swap import emulated_board

PERIOD_NS = round(SAMPLE_PERIOD * 1e9)
LAW = "feedback_linearization"
LOW, HIGH = 0.2, 0.6
"""References are drawn between, rad."""
RECORDING = 100_000
"""Bytes of a bag that has samples in it, not descriptions of topics alone."""
NEAR = 0.05
"""An arm this near to its reference follows it, rad."""
LINES = 10
"""Of each node's output that are kept of a promise that was broken."""
RIGS = ("plant", "bridge")

Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Promise:
    """Something that was promised, and whether it was kept.

    Attributes:
        part: the fault, or the half of the soak.
        rig: "plant" or "bridge".
        what: was promised.
        held: whether it was so.
        found: the figure, or what was there in its place.
        said: when it was broken, the last lines of each node.
    """

    part: str
    rig: str
    what: str
    held: bool
    found: str
    said: dict[str, list[str]] = field(default_factory=dict)


class BrokenError(Exception):
    """A promise that the rest of a fault stands on was broken."""


class Clock:
    """A system clock of the processes that are started within `shared`, which can be set."""

    def __init__(self, folder: Path) -> None:
        self._offset, self._library = folder / "clock", folder / "clock.so"
        self.set(0.0)
        source = Path(__file__).with_name("clock.c")
        subprocess.run(["gcc", "-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", source, "-o",
                        self._library], check=True)  # fmt: skip

    def set(self, seconds: float) -> None:
        """Set it to that much ahead of the machine's."""
        with self._offset.open("r+b" if self._offset.exists() else "xb", buffering=0) as file:
            file.write(struct.pack("<q", round(seconds * 1e9)))

    @contextmanager
    def shared(self) -> Iterator[None]:
        """What is started meanwhile has this clock."""
        os.environ |= {"LD_PRELOAD": str(self._library), "SOAK_CLOCK": str(self._offset)}
        try:
            yield
        finally:
            del os.environ["LD_PRELOAD"], os.environ["SOAK_CLOCK"]


class Stand:
    """A rig in a loop that is recorded.

    Attributes:
        ear: hears it all.
        nodes: the processes, by "rig", "controller" and "recorder".
        bag: what is recorded into.
        promises: what was checked.
        part: what the promises are about.
    """

    def __init__(self, graph: Graph, rig: str, folder: Path, seed: int, clock: Clock | None = None) -> None:
        """Prepare a stand.

        Args:
            graph: calls services, and sends references.
            rig: "plant" or "bridge", which has the emulated board.
            folder: for its bags.
            seed: of its references, and of what else is drawn.
            clock: of its nodes; the machine's when left out. With it, what was on the board is written to `truth`.
        """
        self.graph, self.rig, self.clock = graph, rig, clock
        self.random = random.Random(seed)
        self.namespace = f"/soak_{os.getpid()}_{rig}"
        self.nodes: dict[str, Process] = {}
        self.promises: list[Promise] = []
        self.part = ""
        self._folder = folder
        self._bags = 0
        self._rigs: list[tuple[int, int]] = []  # what had been heard when each was started
        self._names = {"rig": rig, "controller": LAW, "recorder": "record"}
        self._stack = ExitStack()

    def __enter__(self) -> "Stand":
        """Start it.

        Raises:
            BrokenError: it did not start.
        """
        try:
            self._start_all()
        except AssertionError as error:  # of who waits for what never comes
            self.check("all starts", False, " ".join(str(error).split())[-300:])
            raise BrokenError("start") from error
        return self

    def _start_all(self) -> None:
        with ExitStack() as stack:
            stack.callback(self.graph.node.destroy_publisher, self._publisher())
            self.ear = Ear(self.namespace)
            stack.callback(self.ear.close)
            if self.rig == "bridge":
                self.truth = self._folder / "truth"
                truth = ("--truth", str(self.truth)) if self.clock else ()
                self.board = stack.enter_context(emulated_board(*truth))
            self._stack = stack
            for role in self._names:
                self.start(role)
            self._stack = stack.pop_all()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        """End all processes. An error at the end goes into `promises` and is not raised."""
        try:
            self._stack.close()
        except subprocess.TimeoutExpired as late:
            self.check("processes end by Ctrl-C", False, late)
        if isinstance(error, (AssertionError, subprocess.TimeoutExpired)):  # of who waits for what never comes
            self.check("all that is waited for comes", False, " ".join(str(error).split())[-300:])
        return isinstance(error, (AssertionError, BrokenError, subprocess.TimeoutExpired))

    def _publisher(self) -> object:
        self._reference = self.graph.node.create_publisher(
            Float64, f"{self.namespace}/{interface.REFERENCE}", interface.QOS)
        return self._reference

    # ---- processes -------------------------------------------------------------------------------------------------

    def start(self, role: str) -> Process:
        """Start a node; "recorder" records into a new bag."""
        args: list[str] = []
        if role == "recorder":
            self._bags += 1
            self.bag = self._folder / f"bag_{self._bags}"
            args = [str(self.bag)]
            self._first = self.ear.position()
        elif role == "rig":
            self._rigs.append(self.ear.position())
        args += ["--ros-args"]
        if role == "watch":
            args += ["-p", f"bags:={self._folder / 'alarms'}"]
        if role == "rig" and self.rig == "bridge":
            args += ["-p", f"port:={self.board.port}"]
        self.nodes[role] = self.another(self._names.get(role, role), *args)
        if role == "recorder":
            self.wait("record records", lambda: sum(
                file.stat().st_size for file in self._folder.glob(f"{self.bag.name}/*.mcap")) > RECORDING)
        return self.nodes[role]

    def another(self, name: str, *args: str, namespace: str = "") -> Process:
        """Start one more node, of any kind, which is stopped at the end at the latest."""
        with self.clock.shared() if self.clock else ExitStack():
            process = Process(name, *args, "-r", f"__ns:={namespace or self.namespace}")
        self._stack.callback(process.stop)
        return process

    def send(self, role: str, number: signal.Signals) -> int:
        """Send a signal to a node; returns when, ns."""
        self.nodes[role].send(number)
        return time.time_ns()

    def memory_mib(self, process: Process | subprocess.Popen[bytes]) -> float:
        """What a process holds (resident)."""
        popen = process.popen if isinstance(process, Process) else process
        pages = int(Path(f"/proc/{popen.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20

    # ---- promises --------------------------------------------------------------------------------------------------

    def check(self, what: str, held: bool, found: object = "") -> bool:
        """Note whether a promise was kept."""
        said = {} if held else {role: node.output.splitlines()[-LINES:] for role, node in self.nodes.items()}
        self.promises.append(Promise(self.part, self.rig, what, bool(held), str(found), said))
        return bool(held)

    def wait(self, what: str, condition: Callable[[], object]) -> float:
        """Wait until a condition holds; returns the time that took, s.

        Raises:
            BrokenError: it never did. That is noted as a promise broken.
        """
        begun = time.monotonic()
        while True:
            self.ear.drain()
            if condition():
                return time.monotonic() - begun
            if time.monotonic() > begun + PATIENCE_S:
                self.check(what, False, f"not within {PATIENCE_S:.0f} s")
                raise BrokenError(what)
            time.sleep(0.005)

    def promise(self, what: str, condition: Callable[[], object]) -> None:
        """Wait until a condition holds, which was promised."""
        self.check(what, True, f"after {self.wait(what, condition):.2f} s")

    def told(self, role: str, text: str) -> bool:
        """Whether a node's diagnostics have said this since `ear.forget_said`; "" : anything."""
        return any(text in one for one in self.ear.said.get(self._names.get(role, role), ()))

    def counters(self, role: str) -> dict[str, float]:
        """The numeric counters in the last `/diagnostics` of a node."""
        told = self.ear.counters.get(self._names.get(role, role), {})
        return {name: float(value) for name, value in told.items() if value.replace(".", "", 1).isdigit()}

    def counted(self, role: str) -> dict[str, float]:
        """The same, as they are now."""
        self.ear.forget_said()
        self.wait(f"{role} publishes its counters", lambda: self.told(role, ""))
        return self.counters(role)

    def samples(self, count: int, what: str = "samples go on") -> int:
        """Wait for this many more samples; returns how many there were before."""
        before = self.ear.position()
        self.promise(what, lambda: min(len(self.ear.joints) - before[0], len(self.ear.armature) - before[1]) >= count)
        return before[0]

    def follows(self, what: str = "the arm follows a new reference") -> None:
        """Wait until the arm is at a new reference, which is repeated: who listens may only just have come."""
        level, sent = self.random.uniform(LOW, HIGH), -math.inf
        seen, _ = self.ear.position()

        def there() -> bool:
            nonlocal sent
            if time.monotonic() > sent + 1.0:
                sent = time.monotonic()
                self._reference.publish(Float64(data=level))
            last = self.ear.joints.values[max(seen, len(self.ear.joints) - 100):]
            return len(last) == 100 and all(abs(theta - level) < NEAR for theta in last)

        self.promise(what, there)

    def refer(self) -> None:
        """Send a new reference."""
        self._reference.publish(Float64(data=self.random.uniform(LOW, HIGH)))

    def duty_is_0(self, what: str = "duty 0", count: int = 50) -> None:
        """Wait until the rig has applied no duty for some samples."""
        seen = self.ear.position()[1] + count
        self.promise(what, lambda: len(self.ear.armature) > seen and not any(self.ear.armature.values[-count:]))

    def enable(self, on: bool) -> None:
        """Switch the rig on or off, which it always answers."""
        try:
            done = self.graph.call(SetBool, f"{self.namespace}/{interface.ENABLE}", SetBool.Request(data=on)).success
        except AssertionError as error:
            self.check("the service enable answers", False, error)
            raise BrokenError("enable") from error
        self.check("the service enable answers", done)

    def none_lost(self, since: int) -> None:
        """Check that the stamps have no hole after so many samples."""
        gone, on_the_way = self.gone(since)
        self.check("no sample is lost meanwhile", gone == 0,
                   f"{gone} of {len(self.ear.joints) - since + gone}, {on_the_way} of them on the way here")

    def gone(self, since: int) -> tuple[int, int]:
        """How many samples are missing after so many, of one publisher; and how many of them had been published."""
        since = max(0, since - 1)
        numbers = np.array(self.ear.joints.numbers[since:])
        return holes(np.array(self.ear.joints.stamps[since:])), int((np.diff(numbers) - 1).clip(0).sum())

    def board_rows(self, since_ns: int, until_ns: int) -> Stamps:
        """What was on the board in a span of time, (N, 3): sampling (ns), duty register, when it last changed (ns)."""

        def rows() -> Stamps:
            with self.truth.open("rb") as file:
                file.seek(max(0, self.truth.stat().st_size - 200_000))
                lines = [line.split() for line in file.read().splitlines()[1:]]
            found = np.array([(line[0], line[2], line[3]) for line in lines if len(line) == 9], dtype=np.int64)
            return found.reshape(-1, 3)

        self.wait("the board goes on", lambda: len(there := rows()) and there[-1, 0] > until_ns)
        found = rows()
        return found[(found[:, 0] > since_ns) & (found[:, 0] <= until_ns)]

    def board_stopped(self, since_ns: int) -> None:
        """Check that the board, hearing nothing any more, took the duty away within its 100 ms."""
        rows = self.board_rows(since_ns, since_ns + 300_000_000)
        off = np.flatnonzero(rows[:, 1] == 0)
        after_ms = (rows[off[0], 2] - since_ns) * 1e-6 if len(off) else math.inf
        self.check("the board stops the motor within 100 ms", after_ms < 100.0, f"{after_ms:.0f} ms")
        self.check("and it stays off", len(off) and not rows[off[0]:, 1].any())

    # ---- recordings ------------------------------------------------------------------------------------------------

    def end_recording(self, *, lossy: bool = False) -> None:
        """End a recording by Ctrl-C and hold it against what was heard.

        Args:
            lossy: whether messages may be missing, if they were counted.
        """
        recorder = self.nodes["recorder"]
        code = recorder.stop()
        self.check("record ends with exit code 0", code == 0, code)
        said = recorder.output.rpartition(" recorded: ")[2]
        counts = {name: int(count) for name, count in re.findall(r"(\w+) (\d+)", said.partition(";")[0])}
        own = re.search(r"; (\w+) lost(?: \((.*)\))?(?:, (\d+) of them in the first second)?", said)
        lost, joining = (-1, 0) if own is None else (int(own[1].replace("none", "0")), int(own[3] or 0))
        try:
            read = recording.read(self.bag)
        except recording.RecordingError as error:
            self.check("the bag can be read", False, error)
            return
        self.check("the bag is whole", read.complete, "; ".join(read.notes[:1]))
        there = self.in_bag(self.bag)
        same = all(counts.get(name) == len(stamps) for name, stamps in there.items())
        self.check("the bag holds what record says", same, counts)
        gone = self.missing(there)
        which = f" ({own[2]})" if own and own[2] else ""
        counted = f"{gone} missing, {lost} counted{which}, {joining} of them in the first second of a publisher"
        if lossy:
            self.check("all that was heard is in the bag, or counted as lost", gone <= lost, counted)
        else:
            self.check("all that was heard after a publisher's first second is in the bag", gone <= joining, counted)
            self.check("record says that none is lost after that", lost == joining, counted)

    def in_bag(self, bag: Path) -> dict[str, Stamps]:
        """The stamps of joint_states and armature in a bag, in its order."""
        topics = {f"{self.namespace}/{name}": name for name in (interface.JOINT_STATES, interface.ARMATURE)}
        stamps: dict[str, list[int]] = {name: [] for name in topics.values()}
        for connection, _, message in Bag(bag).messages(lambda topic, _: topic in topics):
            stamps[topics[connection.topic]].append(wire.stamp_ns(message))
        return {name: np.array(values, dtype=np.int64) for name, values in stamps.items()}

    def missing(self, there: dict[str, Stamps]) -> int:
        """How many of the samples heard up to the last of a bag are not in it."""
        self.ear.drain()
        count = 0
        for at, (track, stamps) in enumerate(zip((self.ear.joints, self.ear.armature), there.values(), strict=True)):
            heard = np.array(track.stamps[self._first[at]:])
            starts = [start[at] - self._first[at] for start in self._rigs]
            turns = np.searchsorted(starts, np.arange(len(heard)), "right")
            count += missing(heard, heard % PERIOD_NS if self.rig == "plant" else turns, stamps)
        return count

    def close(self) -> None:
        """End all nodes as a person does, and check that."""
        self.part = "end"
        controller = self.nodes["controller"].stop()
        self.check("the controller ends with exit code 0", controller == 0, controller)
        self.duty_is_0("duty 0 is its last command")
        self.end_recording()
        rig = self.nodes["rig"].stop()
        self.check("the rig's node ends with exit code 0", rig == 0, rig)


def holes(stamps: Stamps) -> int:
    """Samples missing between the first and the last."""
    return int((np.round(np.diff(stamps) / PERIOD_NS) - 1).clip(0).sum()) if len(stamps) else 0


def missing(heard: Stamps, publisher: Stamps, there: Stamps) -> int:
    """Samples heard up to the last of a bag that are not in it.

    What came before the bag's first sample of a publisher does not count: the recorder did not know it yet. Nor does
    what came after its last: a publisher that ends does not wait until everybody has what it said.

    Args:
        heard: (N,) stamps.
        publisher: (N,) a number of who sent them.
        there: (M,) stamps of the bag.
    """
    last = np.flatnonzero(heard == there[-1]) if len(there) else ()
    end = int(last[-1]) + 1 if len(last) else len(heard)
    known, publisher = np.isin(heard[:end], there), publisher[:end]
    count = 0
    for one in np.unique(publisher):
        mine = known[publisher == one]
        if one != publisher[-1]:  # it has ended
            mine = mine[: len(mine) - mine[::-1].argmax()]
        count += int((~mine[mine.argmax():]).sum())
    return count
