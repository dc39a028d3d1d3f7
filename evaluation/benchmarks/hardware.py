# SPDX-License-Identifier: Apache-2.0
"""The bridge with the emulated board through a pty, and what errors on the wire get past the frames."""

import math
import random
import struct
import subprocess
import tempfile
import time
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
from cobs import cobs
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from std_msgs.msg import Float64

from aeropend_bridge import protocol
from aeropend_sim.ros import interface
from evaluation.benchmarks import measure
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, Target, interleaved
from evaluation.benchmarks.nodes import NAMESPACE, SETTLE_S, Listener, Process, Stamps
from evaluation.support import boards
from evaluation.support.graph import PATIENCE_S, parameters
from evaluation.swap import NoBoardError, emulated_board

RATE_HZ = 16e6 / (64 * 510)
TRIALS = 1_000_000
SHORTEST_S, LONGEST_S = 0.006, 0.02
"""Between commands: never in step with the samples, each well before the next."""


class Commander(Listener):
    """Listens, and sends commands; knows the bridge's counters."""

    def __init__(self) -> None:
        super().__init__()
        self._publisher = self._node.create_publisher(Float64, interface.DUTY_COMMAND, interface.QOS)
        self._diagnostics = self._node.create_subscription(
            DiagnosticArray, interface.DIAGNOSTICS, print, interface.QOS)

    def command(self, process: Process, seconds: float) -> tuple[Stamps, list[tuple[int, int]]]:
        """Send a new duty every now and then for some seconds; stamps heard, and (ns sent, register value)."""
        rng = random.Random(0)
        end = time.monotonic() + PATIENCE_S
        while not self._publisher.get_subscription_count():
            if time.monotonic() > end:
                raise NotMeasuredError("the bridge does not listen to commands")
            time.sleep(0.05)
        due, sent = [], []
        end, value = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            value = 20 + (value + 37) % 100
            sent.append((time.time_ns(), value))
            self._publisher.publish(Float64(data=value / 255.0))
            due.append(self.listen(process, rng.uniform(SHORTEST_S, LONGEST_S))[0])
        self._publisher.publish(Float64(data=0.0))
        return np.concatenate(due), sent

    def counters(self, process: Process) -> dict[str, str]:
        """The next counters that the bridge publishes."""
        end = time.monotonic() + PATIENCE_S
        handle = self._diagnostics.handle
        with handle:
            while handle.take_message(DiagnosticArray, False) is not None:
                pass  # older ones
            while time.monotonic() < end:
                process.check()
                taken = handle.take_message(DiagnosticArray, False)
                for status in taken[0].status if taken else ():
                    if status.name == f"{NAMESPACE[1:]}/bridge":
                        return {value.key: value.value for value in status.values}
                time.sleep(0.02)
        raise NotMeasuredError("the bridge publishes no counters")


def _latency_ms(sent: list[tuple[int, int]], register: Stamps, written: Stamps) -> tuple[NDArray[np.float64], int]:
    """From sending each command to the register's change to its value, ms; and how many never got there."""
    changes = np.flatnonzero(np.diff(register)) + 1
    values, times = register[changes], written[changes]
    found = []
    for at, value in sent:
        first = np.searchsorted(times, at)
        hits = np.flatnonzero(values[first : first + 6] == value)
        if len(hits):
            found.append(1e-6 * (times[first + hits[0]] - at))
    return np.array(found), len(sent) - len(found)


def bridge(quick: bool) -> list[Figure]:
    """The bridge in real time: loss, stamps, latency, CPU."""
    seconds = 20.0 if quick else 300.0
    about = measure.load()
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        truth = Path(folder) / "truth"
        listener = Commander()
        try:
            with (emulated_board("--truth", truth) as board,
                  Process("bridge", *parameters(port=board.port)) as process):
                listener.wait(process)
                listener.listen(process, SETTLE_S)
                cpu, start = process.cpu_s(), time.monotonic()
                stamps, sent = listener.command(process, seconds)
                cpu, wall = process.cpu_s() - cpu, time.monotonic() - start
                counters = listener.counters(process)
        except NoBoardError as error:
            raise NotMeasuredError(str(error)) from None
        finally:
            listener.close()
        rows = np.array([line.split()[:4] for line in truth.read_text().splitlines()
                         if len(line.split()) == 9], dtype=np.int64)
    instants, _, register, written = rows.T
    nearest = np.searchsorted(0.5 * (instants[1:] + instants[:-1]), stamps)
    error_us = 1e-3 * (stamps - instants[nearest])
    latency, unanswered = _latency_ms(sent, register, written)
    missing = int(nearest[-1] - nearest[0]) + 1 - len(np.unique(nearest))
    details = {"seconds": seconds, "samples": len(stamps), "mean_error_us": float(error_us.mean()),
               "worst_error_us": float(np.abs(error_us).max()), "commands": len(sent), "unanswered": unanswered,
               "rate_hz": (len(stamps) - 1) / (1e-9 * float(stamps[-1] - stamps[0])), "counters": counters}

    def figure(name: str, unit: str, value: float, limit: float, note: str = "") -> Figure:
        return Figure(f"bridge, {seconds:.0f} s: {name}", unit, Spread.of(value), Target(limit), details=details,
                      note=note, load=about, main=not name.startswith("frames"))

    return [
        figure("samples lost or late to the listener", f"of {len(stamps) + missing}", missing, 0.0,
               f"{details['rate_hz']:.2f} Hz; lost by the bridge's own count: {counters['lost samples']}"),
        figure("frames corrupt", "", float(counters["bad frames"]), 0.0),
        figure("stamp against true instant, 1 σ", "µs", float(error_us.std()), 100.0,
               f"mean {error_us.mean():+.0f} µs, worst {np.abs(error_us).max():.0f} µs"),
        figure("command to register, p50", "ms", float(np.percentile(latency, 50)), 2.0),
        figure("command to register, p99", "ms", float(np.percentile(latency, 99)), 6.0,
               f"{unanswered} of {len(sent)} commands never showed in the register by themselves"),
        figure("CPU of a core", "%", 100.0 * cpu / wall, 30.0),
    ]


def emulator(quick: bool) -> list[Figure]:
    """The emulated board in simulated time: its speed, what interrupts take with SSI, and how speeds are timed."""
    about = measure.load()
    try:
        boards.build()
    except (OSError, subprocess.CalledProcessError):
        said = "the board's program was not built: tools/setup firmware installs what it needs"
        raise NotMeasuredError(said) from None
    program = boards.FIRMWARE / "build" / "aeropend.elf"
    periods, captures = 500, 6_000 if quick else 100_000
    board, bench = boards.Board(boards.quiet()), boards.Bench(program)

    def with_plant() -> None:
        for _ in range(periods):
            board.step()

    real = periods * boards.PERIOD_CYCLES / 16e6
    ours, peer = (real / s for s in interleaved(3 if quick else 15, with_plant,
                                                lambda: [bench.run() for _ in range(periods)]))
    bench = boards.Bench(program)
    bench.answer(boards.SCHEME, "B", 1)
    bench.enable()
    for k in range(periods):
        bench.host.duty(0.5)
        bench.run(1, [163 * k % boards.PERIOD_CYCLES])
    load = bench.chip.load
    try:
        checked, near = boards.check_speed(program, captures)
        wrong, note = 0.0, f"{near} of {checked} steered to within 45 µs of a timer overflow"
    except AssertionError as error:
        checked, wrong, note = captures, math.inf, str(error).partition("\n")[0]
    return [Figure("emulated board with plant", "x real time", Spread.of(ours), Target(15.0, at_least=True),
                   "simavr, the processor alone", Spread.of(peer), Spread.of(ours / peer), load=about, main=True),
            Figure("interrupts of the board with SSI, a command and a pulse each period", "% of the time",
                   Spread.of(100.0 * load.cycles / bench.chip.cycle), Target(40.0),
                   note=f"the longest {load.longest / 16.0:.1f} µs, stack {load.stack} bytes", load=about, main=True),
            Figure("speeds timed wrong by more than a tick", f"of {checked:,}", Spread.of(wrong), Target(0.0),
                   note=note, load=about)]


def _sample(rng: random.Random) -> bytes:
    return struct.pack("<BBIBHHhIH", protocol.Type.SAMPLE, rng.randrange(256), rng.getrandbits(32), rng.randrange(256),
                       rng.randrange(1024), rng.randrange(1024), rng.randrange(-512, 512), rng.getrandbits(20), 1)


def _errors(kind: str, size: int, rng: random.Random) -> Iterator[int]:
    """Error patterns on `size` bits: every one of 1, 2, 3 bits, or TRIALS bursts of up to 16."""
    if kind != "burst":
        for bits in combinations([1 << bit for bit in range(size)], int(kind)):
            yield sum(bits)
        return
    for _ in range(TRIALS):
        length = rng.randint(2, 16)
        yield (rng.getrandbits(length) | 1 | 1 << (length - 1)) << rng.randrange(size - length + 1)


def _accepted(kind: str, rng: random.Random) -> tuple[int, int, int]:
    """Trials, wrong messages accepted, and trials that cost more than the frame that was hit (or joined with it)."""
    payloads = [_sample(rng) for _ in range(3)]
    before, hit, after = map(protocol.frame, payloads)
    sent = {protocol.parse(payload) for payload in payloads}
    last = protocol.parse(payloads[2])
    size, whole = 8 * len(hit), int.from_bytes(hit, "little")
    ending = 0xFF << size - 8
    trials = wrong = costly = 0
    for error in _errors(kind, size, rng):
        receiver = protocol.Receiver()
        # two frames follow: an error in the closing zero takes the first with it
        got = receiver.feed(b"\0" + before + (whole ^ error).to_bytes(len(hit), "little") + after + after)
        trials += 1
        wrong += not sent.issuperset(got)
        costly += got.count(last) < (1 if error & ending else 2)
    return trials, wrong, costly


def frames(quick: bool) -> list[Figure]:
    """Errors on the wire and garbage, against the receiver that the bridge has."""
    rng = random.Random(5)
    figures = []
    about = measure.load()
    for kind, name in (("1", "1-bit errors"), ("2", "2-bit errors"), ("3", "3-bit errors"),
                       ("burst", "bursts up to 16 bits")):
        if quick and kind in ("3", "burst"):
            continue
        trials, wrong, costly = _accepted(kind, rng)
        note = f"{costly} cost more than the frame that was hit"
        figures.append(Figure(f"frames: {name} accepted", f"of {trials:,}", Spread.of(float(wrong)), Target(0.0),
                              details={"trials": trials, "costly": costly}, note=note, load=about))
    candidates = TRIALS // 10 if quick else 5 * TRIALS
    passed = accepted = 0
    for _ in range(candidates):  # of a sample's length, and right as COBS, which most garbage is not
        payload = protocol.unframe(cobs.encode(rng.randbytes(21)))
        if payload is not None:
            passed += 1
            accepted += protocol.parse(payload) is not None
    note = f"2^-16 of them; {passed} had a right CRC"
    figures.append(Figure("frames: random garbage accepted", f"of {candidates:,}", Spread.of(float(accepted)),
                          Target(candidates / 65536.0), note=note, load=about))
    return figures
