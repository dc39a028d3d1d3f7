# SPDX-License-Identifier: Apache-2.0
"""The first half: nothing happens but work, for long, beside another program that wants a core."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.stats import linregress, t

from evaluation.soak.stand import Stand
from evaluation.support.sleeper import Sleeper

REFERENCE_S = 5.0
"""Between references."""
MEMORY_S = 0.5
"""Between looks at the memory."""
WARM_UP_S = 90.0
"""In which memory may settle: bridge and board fill what they remember of the past."""
LEAST_S = 120.0
"""Of memory after that from which on its growth is judged."""
BLOCKS = 12
"""Blocks of the run. Each gives the fit of the memory one point: neighbouring readings are not independent."""
LATE, AS_LATE = 1e-3, 2.0
"""Limits of late samples: their share, and their ratio to the late wake-ups of a program that only sleeps. One of them
must hold, because on a busy machine every program is late."""
GROWTH_MIB_H = {"rig": 2.0, "controller": 2.0, "recorder": 10.0, "board": 2.0, "watch": 2.0}
"""MiB/h that may surely be exceeded by none. `record` keeps an index of its bag."""


@dataclass(frozen=True)
class Growth:
    """How the memory of a process grows: at the end MiB; MiB/h with the bounds of a 95 % interval."""

    mib: float
    rate: float
    low: float
    high: float

    @classmethod
    def of(cls, seconds: list[float], mib: list[float]) -> "Growth":
        """Fit a line to the means of blocks after the warm-up, or of the last half of less than that."""
        keep = np.array(seconds) >= seconds[0] + min(WARM_UP_S, 0.5 * (seconds[-1] - seconds[0]))
        blocks = np.array_split(np.column_stack([seconds, mib])[keep], BLOCKS)
        at, mean = np.array([block.mean(axis=0) for block in blocks if len(block)]).T
        fit = linregress(at / 3600.0, mean)
        half = float(t.ppf(0.975, len(at) - 2) * np.nan_to_num(fit.stderr))  # NaN: all means are the same
        return cls(mib[-1], float(fit.slope), float(fit.slope) - half, float(fit.slope) + half)


@contextmanager
def busy() -> Iterator[None]:
    """Another program that wants a whole core, and is nice about it."""
    program = subprocess.Popen(["nice", "-n", "10", sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        program.kill()
        program.wait()


def steady(stand: Stand, seconds: float, show: Callable[[str], None]) -> dict[str, Growth]:
    """Let a stand work, and check what it promises; returns how its processes grow."""
    stand.part = "steady"
    ear = stand.ear
    stand.start("watch")
    stand.follows()
    bad = ("lost samples", "bad frames", "gaps") if stand.rig == "bridge" else ("lost ticks", "late ticks")
    rig, controller = stand.counted("rig"), stand.counted("controller")
    since, _ = ear.position()
    commands = len(ear.commands)
    joined = stand.counted("watch")["lost"]
    processes = dict(stand.nodes) | ({"board": stand.board.process} if stand.rig == "bridge" else {})
    times: list[float] = []
    memory: dict[str, list[float]] = {name: [] for name in processes}
    with Sleeper() as sleeper:
        start = refer = look = time.monotonic()
        while (now := time.monotonic()) < start + seconds:
            ear.drain()
            if now >= refer:
                stand.refer()
                refer += REFERENCE_S
            if now >= look:
                times.append(now)
                for name, process in processes.items():
                    memory[name].append(stand.memory_mib(process))
                look += MEMORY_S
                show(f"{stand.rig}, steady: {now - start:.0f} of {seconds:.0f} s, {len(ear.joints) - since} samples")
            time.sleep(0.01)
        slept = sleeper.ended()
    ear.drain()
    stamps = np.array(ear.joints.stamps[since:])
    commands = len(ear.commands) - commands
    stand.none_lost(since)
    after = stand.counted("rig")
    for name in bad:
        count = after[name] - rig[name]
        limit = max(LATE * len(stamps), AS_LATE * slept[name]) if name == "late ticks" else 0.0
        stand.check(f"{name}: at most {LATE:g} of all, or {AS_LATE:g} times a sleeping program's" if limit else
                    f"{name}: none", count <= limit,
                    f"{count:.0f} of {after['samples'] - rig['samples']:.0f}"
                    + (f"; of a program that only sleeps: {slept[name]}" if name in slept else ""))
    told = stand.counted("watch")
    stand.check("watch gives no alarm", told["alarms"] == 0.0, f"{told['alarms']:.0f}")
    stand.check("watch misses no sample", told["lost"] == joined, f"{told['lost'] - joined:.0f}")
    count = stand.counted("controller")["lost"] - controller["lost"]
    stand.check("the controller misses no sample", count == 0.0, f"{count:.0f}")
    short = len(stamps) - commands
    stand.check("each sample has its command", abs(short) <= 1 + LATE * len(stamps), f"{commands} of {len(stamps)}")
    growth = {name: Growth.of(times, values) for name, values in memory.items()}
    for name, one in growth.items():
        limit = GROWTH_MIB_H[name]
        judged = seconds >= WARM_UP_S + LEAST_S
        stand.check(f"{name}: memory grows by at most {limit:g} MiB/h" + " (too short to judge)" * (not judged),
                    not judged or one.low <= limit,
                    f"{one.rate:+.2f} ({one.low:+.2f} to {one.high:+.2f}) MiB/h, {one.mib:.0f} MiB")
    return growth
