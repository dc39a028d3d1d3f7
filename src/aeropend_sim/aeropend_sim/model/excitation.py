# SPDX-License-Identifier: Apache-2.0
"""Duty signals that excite a rig for identification. Pure functions: settings in, one array out."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import LARGEST_SEED, SAMPLE_PERIOD

Array = NDArray[np.float64]

LONGEST = 3600.0
"""[s] Longest signal (choice; it bounds the memory)."""

MOST_LEVELS = 1000
"""Most levels of a signal (choice: more than a duty has steps that can be told apart; it bounds the memory)."""


@dataclass(frozen=True)
class Excitation:
    """One duty signal. Each kind uses only the fields that it names. Below 0 a bridge reverses or brakes the motor.

    Attributes:
        kind: one of `KINDS`.
        duration: [s] length of the signal.
        seed: the same seed gives the same signal; 0 to `LARGEST_SEED`.
        duty_min: smallest duty of latin_hypercube, staircase and multisine, -1..1.
        duty_max: greatest duty of these, -1..1.
        hold_min: [s] shortest hold of latin_hypercube.
        hold_max: [s] longest hold of latin_hypercube, hold of steps, lift of free_decay.
        levels: intervals of the Latin hypercube; stairs of staircase; 2 to `MOST_LEVELS`.
        rest: [s] time with duty 0 after each Latin hypercube and after each lift of free_decay.
        duty: duty of hold and free_decay, -1..1.
        sequence: duties of steps and holds, repeated, -1..1.
        holds: [s] time of each duty of holds.
        frequencies: [Hz] frequencies of multisine.
        duty_rate: [1/s] greatest rate of the duty, of every kind; 0 = it may jump.

    Raises:
        UserError: the fields contradict each other.
    """

    kind: str = "latin_hypercube"
    duration: float = 60.0
    seed: int = 0
    duty_min: float = 0.0
    duty_max: float = 0.6
    hold_min: float = 0.2
    hold_max: float = 2.0
    levels: int = 10
    rest: float = 3.0
    duty: float = 0.45
    sequence: tuple[float, ...] = (0.0, 0.4314)
    holds: tuple[float, ...] = (2.0, 2.0)
    frequencies: tuple[float, ...] = (0.11, 0.23, 0.37, 0.61, 0.97, 1.57, 2.51, 4.07)
    duty_rate: float = 0.0

    def __post_init__(self) -> None:
        nyquist = 0.5 / SAMPLE_PERIOD
        numbers = [(f.name, x) for f in fields(self) if isinstance(x := getattr(self, f.name), float)]
        odd = [(name, x) for name, x in numbers if not math.isfinite(x)]
        for wrong, message in (
            (bool(odd), "; ".join(f"{name} is {x:g}: give a number" for name, x in odd)),
            (self.kind not in KINDS, f"kind is '{self.kind}': give one of {', '.join(KINDS)}"),
            (self.duration < SAMPLE_PERIOD, f"duration is {self.duration:g} s: give at least one sample, 0.00204 s"),
            (self.duration > LONGEST, f"duration is {self.duration:g} s: give at most {LONGEST:g}"),
            (
                not -1.0 <= self.duty_min < self.duty_max <= 1.0,
                f"duty_min {self.duty_min:g} and duty_max {self.duty_max:g}: give -1 <= duty_min < duty_max <= 1",
            ),
            (
                not SAMPLE_PERIOD <= self.hold_min <= self.hold_max,
                f"hold_min {self.hold_min:g} s and hold_max {self.hold_max:g} s: give 0.00204 <= hold_min <= hold_max",
            ),
            (not 0 <= self.seed <= LARGEST_SEED, f"seed is {self.seed}: give 0 to {LARGEST_SEED}"),
            (not 2 <= self.levels <= MOST_LEVELS, f"levels is {self.levels}: give 2 to {MOST_LEVELS}"),
            (self.rest < 0.0, f"rest is {self.rest:g} s: give 0 or more"),
            (not -1.0 <= self.duty <= 1.0, f"duty is {self.duty:g}: give -1 to 1"),
            (
                not self.sequence or not all(-1.0 <= duty <= 1.0 for duty in self.sequence),
                "sequence: give at least one duty, each -1 to 1",
            ),
            (
                not self.holds or not all(SAMPLE_PERIOD <= hold <= LONGEST for hold in self.holds),
                f"holds: give at least one time, each 0.00204 to {LONGEST:g} s",
            ),
            (
                self.kind == "holds" and len(self.holds) != len(self.sequence),
                f"sequence has {len(self.sequence)} duties and holds {len(self.holds)} times: give as many of each",
            ),
            (not self.duty_rate >= 0.0, f"duty_rate is {self.duty_rate:g}: give 0 or more"),
            (
                not self.frequencies or not all(0.0 < frequency < nyquist for frequency in self.frequencies),
                f"frequencies: give at least one, each above 0 and below {nyquist:.0f} Hz",
            ),
        ):
            if wrong:
                raise UserError(message)

    def series(self) -> Array:
        """The duty (N,) at each sample, -1..1, held for one `SAMPLE_PERIOD`."""
        series = KINDS[self.kind](self)
        return _limited(series, self.duty_rate * SAMPLE_PERIOD) if self.duty_rate > 0.0 else series

    @property
    def samples(self) -> int:
        """N, the number of samples."""
        return max(1, round(self.duration / SAMPLE_PERIOD))


def _held(holds: list[tuple[float, float]], samples: int) -> Array:
    """Sample a list of holds (duty, seconds); the last one is prolonged."""
    duties = np.array([duty for duty, _ in holds])
    ends = np.cumsum([seconds for _, seconds in holds])
    at = np.searchsorted(ends, (np.arange(samples) + 0.5) * SAMPLE_PERIOD)
    return duties[np.minimum(at, len(duties) - 1)]


def _limited(series: Array, step: float) -> Array:
    """A series that starts at 0 and changes by no more than a step from sample to sample."""
    at, out = 0.0, []
    for wanted in series.tolist():
        at = min(max(wanted, at - step), at + step)
        out.append(at)
    return np.array(out)


def latin_hypercube(x: Excitation) -> Array:
    """Holds drawn from a Latin hypercube over (duty, hold time), thesis section 5.1.

    Both ranges are cut into `levels` intervals. Each interval is used once, in random pairs and order. Then the duty is
    0 for `rest` seconds, so that the arm also swings freely. Further hypercubes follow until the end of the signal.
    """
    rng = np.random.default_rng(x.seed)
    holds: list[tuple[float, float]] = []
    total = 0.0
    while total < x.duration:
        strata = np.stack([rng.permutation(x.levels), rng.permutation(x.levels)])
        share = (strata + rng.random((2, x.levels))) / x.levels
        duties = x.duty_min + share[0] * (x.duty_max - x.duty_min)
        seconds = x.hold_min + share[1] * (x.hold_max - x.hold_min)
        holds += [*zip(duties.tolist(), seconds.tolist(), strict=True), (0.0, x.rest)]
        total += float(seconds.sum()) + x.rest
    return _held(holds, x.samples)


def steps(x: Excitation) -> Array:
    """The duties of `sequence`, each for `hold_max` seconds, repeated."""
    repeats = math.ceil(x.duration / (x.hold_max * len(x.sequence)))
    return _held([(duty, x.hold_max) for duty in x.sequence] * repeats, x.samples)


def holds(x: Excitation) -> Array:
    """Each duty of `sequence` for its time of `holds`, repeated: what `design` writes."""
    both = list(zip(x.sequence, x.holds, strict=True))
    return _held(both * math.ceil(x.duration / sum(x.holds)), x.samples)


def staircase(x: Excitation) -> Array:
    """From `duty_min` to `duty_max` and back in equal stairs over the whole duration; `levels` different duties."""
    up = np.linspace(x.duty_min, x.duty_max, x.levels).tolist()
    stairs = up + up[-2::-1]
    return _held([(duty, x.duration / len(stairs)) for duty in stairs], x.samples)


def multisine(x: Excitation) -> Array:
    """Sum of sines of equal amplitude, scaled to `duty_min`..`duty_max`.

    Of 100 sets of random phases, the one with the smallest peak-to-peak value is taken.
    """
    rng = np.random.default_rng(x.seed)
    t = np.arange(x.samples) * SAMPLE_PERIOD
    angles = 2.0 * np.pi * np.outer(x.frequencies, t)
    cosines, sines = np.cos(angles), np.sin(angles)
    best = np.zeros(x.samples)
    for phases in rng.uniform(0.0, 2.0 * np.pi, (100, len(x.frequencies))):
        signal = np.cos(phases) @ sines + np.sin(phases) @ cosines
        if not best.any() or np.ptp(signal) < np.ptp(best):
            best = signal
    best = best - best.min()
    return x.duty_min + best * ((x.duty_max - x.duty_min) / max(best.max(), np.finfo(float).tiny))


def free_decay(x: Excitation) -> Array:
    """Lift with `duty` for `hold_max` seconds, then duty 0 for `rest` seconds, repeated."""
    repeats = math.ceil(x.duration / (x.hold_max + x.rest))
    return _held([(x.duty, x.hold_max), (0.0, x.rest)] * repeats, x.samples)


def hold(x: Excitation) -> Array:
    """A constant `duty`."""
    return np.full(x.samples, x.duty)


KINDS: dict[str, Callable[[Excitation], Array]] = {
    function.__name__: function for function in (latin_hypercube, steps, holds, staircase, multisine, free_decay, hold)
}
"""All kinds of signal by name."""
