# SPDX-License-Identifier: Apache-2.0
"""What the blind check draws: rigs, effects and their sizes, duty signals. The label of a recording is made here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from evaluation.blind import plant
from evaluation.blind.plant import EFFECTS, NUMBERS, OUTSIDE, PERIOD

Array = NDArray[np.float64]

OFF = 0.05
"""Each nominal number is off by up to this share."""

FORMS = ("table", "other", "third")
"""The forms of effects: that of docs/effects.md, one that its other forms resemble, and one that is in no catalogue."""

FLOORS = (1.5, 10.0)
"""RMS, in floors, of what no refit of the numbers absorbs, in the channel where it is largest."""

ROUNDED = 1e-9
"""Room of a number beyond its tolerance, relative: a number at its end is not outside by rounding (choice)."""

PLACES = {
    "bridge_drop": "actuator", "supply_sag": "actuator", "supply_drift": "actuator", "command_delay": "actuator",
    "brush_drop": "electrical", "winding_heating": "electrical", "rotor_friction": "rotor", "thrust_lag": "thrust",
    "thrust_exponent": "thrust", "axial_inflow": "thrust", "ground_effect": "thrust", "coulomb_friction": "arm",
    "quadratic_drag": "arm", "cable_torque": "arm", "mast_flex": "arm", "gust": "arm", "angle_offset": "sensing",
    "encoder_lag": "sensing", "encoder_eccentricity": "sensing", "current_gain": "sensing",
    "current_offset": "sensing", "voltage_offset": "sensing", "speed_spikes": "sensing",
}
MISMATCHES = {
    "k1": "actuator", "R_a": "electrical", "K_e": "electrical", "K_t": "rotor", "J_m": "rotor", "k_load": "rotor",
    "k_thrust": "thrust", "L_over_J": "thrust", "mgd_over_J": "arm", "c_over_J": "arm",
}

SIZES: dict[str, float] = {
    "v_drop": 0.2, "r_supply": 0.15, "rate": 2e-3, "delay": 0.03, "v_brush": 0.12, "gain": 0.02, "torque": 5e-4,
    "n": -0.2, "accel": 0.8, "coupling": 0.3, "sigma": 1.5, "bias": 0.06, "amplitude": 0.06,
}
"""Where the search for a size starts, by name of the parameter."""
OWN_SIZES = {"thrust_lag": 0.08, "encoder_lag": 0.03, "axial_inflow": 1e-4, "quadratic_drag": 0.6, "cable_torque": 4.0,
             "ground_effect": 0.25, "current_gain": 0.3, "speed_spikes": 2.0}
MOST = {"current_gain": 2.0, "thrust_exponent": 4.0, "mast_flex": 2.5, "bridge_drop": 5.0, "quadratic_drag": 20.0}
"""How far above its start a size may go and still be a rig that somebody might have; 30 times otherwise."""

SIGNED = ("angle_offset", "current_offset", "voltage_offset", "current_gain", "thrust_exponent")
"""Effects whose size is as often negative as positive (choice)."""


@dataclass(frozen=True)
class Case:
    """One recording to be made, and its label.

    Attributes:
        name: of the recording. kind: single, none, two or outside. form: table or other.
        numbers: the rig's true numbers. effects: id, place and parameters of each. size: floors, of each effect.
        seed: of chance in the recording. closed_loop: the duty came from a controller. shares: of two effects, the
            share of the squared gap that a rig without it would not have, by id.
    """

    name: str
    kind: str
    form: str
    numbers: dict[str, float]
    effects: list[dict[str, object]]
    size: float
    sizes: list[float]
    seed: int
    closed_loop: bool = False
    shares: dict[str, float] = field(default_factory=dict)
    extra: dict[str, object] = field(default_factory=dict)

    def label(self) -> dict[str, object]:
        """As written to the sealed file."""
        return asdict(self)


def duty_signal(rng: np.random.Generator, duration: float) -> Array:
    """Duty (N,): random holds, a Latin hypercube of them, or a sum of sines on holds."""
    n = round(duration / PERIOD)
    high = rng.uniform(0.45, 0.65)
    kind = rng.choice(["hypercube", "holds", "sines"], p=[0.6, 0.25, 0.15])
    duty = np.zeros(n)
    if kind == "sines":
        t = np.arange(n) * PERIOD
        waves = sum(np.sin(2.0 * math.pi * f * t + rng.uniform(0.0, 6.3)) for f in (0.07, 0.19, 0.43, 0.9, 1.7, 2.9))
        waves = (waves - waves.min()) / np.ptp(waves)
        steps = round(0.1 / PERIOD)
        return np.repeat(high * waves[::steps], steps)[:n]
    k = 0
    while k < n:
        levels = 10
        if kind == "hypercube":
            duties = (rng.permutation(levels) + rng.random(levels)) / levels * high
            holds = 0.2 + (rng.permutation(levels) + rng.random(levels)) / levels * 1.8
        else:
            duties = np.where(rng.random(levels) < 0.2, 0.0, rng.uniform(0.0, high, levels))
            holds = rng.uniform(0.3, 3.5, levels)
        for u, hold in zip(np.append(duties, 0.0), np.append(holds, rng.uniform(1.5, 3.5)), strict=True):
            m = round(hold / PERIOD)
            duty[k:k + m] = u
            k += m
    return duty


def pid(rng: np.random.Generator) -> Callable[[float, float], float]:
    """A controller of the angle as a student would tune it, following random steps of its reference."""
    memory = {"sum": 0.0, "last": 0.0, "rate": 0.0, "goal": 0.0, "until": 0.0}
    kp, ki, kd = rng.uniform(0.3, 0.6), rng.uniform(0.4, 0.9), rng.uniform(0.05, 0.12)

    def law(t: float, theta: float) -> float:
        if t >= memory["until"]:
            memory["goal"], memory["until"] = rng.uniform(0.05, 0.7), t + rng.uniform(2.0, 5.0)
        theta = round(theta / 6.136e-3) * 6.136e-3
        memory["rate"] += 0.05 * ((theta - memory["last"]) / PERIOD - memory["rate"])
        memory["last"] = theta
        error = memory["goal"] - theta
        u = 0.12 + kp * error + memory["sum"] - kd * memory["rate"]
        if 0.0 < u < 0.7:
            memory["sum"] += ki * error * PERIOD
        return min(max(u, 0.0), 0.7)

    return law


class Sizer:
    """Finds the size of an effect at which what no refit of the numbers absorbs is so many floors."""

    room: tuple[float | Array, float | Array] = -OFF, OFF
    """Least and greatest change of each number by a refit, relative."""

    ridge = 0.0
    """Added to the diagonal of the refit's matrix, where the readings do not determine all numbers."""

    def __init__(self, numbers: Mapping[str, float], sensing: Mapping[str, float], duty: Array) -> None:
        self.numbers, self.tau, self.duty = dict(numbers), sensing["angle_filter_tau"], duty
        rng = np.random.default_rng(0)
        p = self.packed({}, {}, other=False)
        y, v, _ = plant.states(p, duty, np.zeros(0))
        ideal, real = plant.shown(p, y, v), plant.measured(p, y, v, sensing, rng)
        self.floor = {c: float(np.sqrt(np.mean((real[c] - ideal[c]) ** 2))) for c in ideal}
        self.absorb(NUMBERS)

    def absorb(self, names: Sequence[str]) -> None:
        """Find what the rig reads without effects, and which way a refit of these numbers moves it."""
        def read(numbers: Mapping[str, float]) -> Array:
            p = self.packed({}, {}, other=False, numbers=numbers)
            y, v, _ = plant.states(p, self.duty, np.zeros(0))
            return self.stack(plant.shown(p, y, v))

        self.base = read(self.numbers)
        columns = [(read({**self.numbers, name: 1.01 * self.numbers[name]}) - self.base) / 0.01
                   for name in names if self.numbers[name] != 0.0]
        self.q, self.r = np.linalg.qr(np.array(columns).T)

    def packed(self, effects: Mapping[str, Mapping[str, float]], outside: Mapping[str, float], *, other: int,
               numbers: Mapping[str, float] | None = None) -> Array:
        """Parameters of this rig with these effects."""
        return plant.packed(numbers or self.numbers, self.tau, effects, outside, other)

    def stack(self, readings: Mapping[str, Array]) -> Array:
        """All channels in floors as one vector."""
        return np.concatenate([readings[c] / self.floor[c] for c in self.floor])

    def moved(self, p: Array, gusts: Array) -> Array:
        """What effects change of the readings, all channels as one vector, in floors."""
        y, v, _ = plant.states(p, self.duty, gusts)
        return self.stack(plant.shown(p, y, v)) - self.base

    def rest(self, moved: Array) -> Array:
        """What no refit of the numbers absorbs, (4, N), each channel in floors."""
        refit = lsq_linear(self.r + self.ridge * np.eye(len(self.r)), self.q.T @ moved, self.room).x
        return (moved - self.q @ (self.r @ refit)).reshape(len(self.floor), -1)

    def left(self, moved: Array) -> float:
        """Floors RMS, in the worst channel, that a refit of the numbers leaves of the gap."""
        return float(np.sqrt(np.mean(self.rest(moved) ** 2, axis=1)).max())

    def size(self, make: Callable[[float], tuple[Array, Array]], start: float, goal: float, most: float = 30.0
             ) -> tuple[float, float]:
        """The size that leaves `goal` floors, within a factor of `start`, and the floors that it leaves.

        `make` gives parameters and gusts of a size.
        """
        x, step = math.log(start), 1.0  # in logarithms
        known: list[tuple[float, float]] = []
        for _ in range(9):
            y = math.log(max(self.left(self.moved(*make(math.exp(x)))), 1e-9) / goal)
            known.append((x, y))
            if abs(y) < 0.1:
                break
            if len(known) > 1 and known[-1][0] != known[-2][0]:
                step = (known[-1][1] - known[-2][1]) / (known[-1][0] - known[-2][0])
            x -= min(max(y / min(max(step, 0.4), 2.5), -1.5), 1.5)
            x = min(max(x, math.log(start / 30.0)), math.log(start * most))
        best, error = min(known, key=lambda k: abs(k[1]))
        return math.exp(best), goal * math.exp(error)


class Weighed(Sizer):
    """A rig whose effects are weighed by the gap that they leave after a refit of the numbers of the model file.

    Each number stays within `OFF` of that in the model file, from which the rig's own may differ as much.
    """

    def __init__(self, numbers: Mapping[str, float], nominal: Mapping[str, float], sensing: Mapping[str, float],
                 duty: Array) -> None:
        super().__init__(numbers, sensing, duty)
        off = np.array([nominal[n] / numbers[n] for n in NUMBERS if numbers[n] != 0.0])
        self.room = off * (1.0 - OFF) - 1.0 - ROUNDED, off * (1.0 + OFF) - 1.0 + ROUNDED

    def gap(self, moved: Array) -> float:
        """The mean square of that over the spread of each channel, of all channels: the squared gap."""
        spread = np.std(self.base.reshape(len(self.floor), -1), axis=1)
        return float(np.mean((self.rest(moved) / spread[:, None]) ** 2))

    def shares(self, moved: Mapping[str, Array]) -> dict[str, float]:
        """Effect -> share of the squared gap that a rig without it would not have.

        Args:
            moved: effect -> what it alone changes of the readings.
        """
        total = np.sum(list(moved.values()), axis=0)
        return {effect: 1.0 - self.gap(total - own) / self.gap(total) for effect, own in moved.items()}


def others(id_: str, rng: np.random.Generator) -> dict[str, float]:
    """The parameters of an effect besides its size."""
    return {
        "winding_heating": lambda: {"tau": rng.uniform(10.0, 60.0)},
        "ground_effect": lambda: {"width": rng.uniform(0.12, 0.5)},
        "cable_torque": lambda: {"theta0": rng.uniform(-0.2, 0.6)},
        "mast_flex": lambda: {"omega": rng.uniform(8.0, 30.0), "zeta": rng.uniform(0.01, 0.08)},
        "gust": lambda: {"tau": rng.uniform(0.1, 0.8)},
        "encoder_eccentricity": lambda: {"phase": rng.uniform(-math.pi, math.pi)},
    }.get(id_, dict)()


def scale(id_: str) -> tuple[str, float, float]:
    """The parameter that holds the size of an effect, where its search starts, and its value without the effect."""
    if id_ in OUTSIDE:
        return "size", OUTSIDE[id_][1], 0.0
    head = EFFECTS[id_][0]
    return head, OWN_SIZES.get(id_, SIZES.get(head, 1.0)), 2.0 if head == "n" else 0.0


def parameters_of(id_: str, rng: np.random.Generator) -> Callable[[float], dict[str, float]]:
    """The parameters of an effect as a function of its size; those besides the size, and the sign, are drawn."""
    head, _, neutral = scale(id_)
    rest = others(id_, rng)
    sign = float(rng.choice([-1.0, 1.0])) if id_ in SIGNED else 1.0
    return lambda size: {head: neutral + sign * size, **rest}


def gusts_of(entry: Mapping[str, Any], samples: int, *, other: bool) -> Array:
    """Random torque (samples + 2,) of an effect that was drawn with its seed "draw"; (0,) if it is no gust."""
    if entry["effect"] != "gust":
        return np.zeros(0)
    own = entry["parameters"]
    return plant.turbulence(own["sigma"], own["tau"], samples, other, np.random.default_rng(entry["draw"]))


def search(id_: str, sizer: Sizer, goal: float, of_size: Callable[[float], dict[str, float]], draw: int, *,
           other: int, most: float) -> tuple[dict[str, Any], float]:
    """An effect at the size that leaves `goal` floors; and its size in floors.

    Args:
        id_: of an effect of the catalogue.
        sizer: of the rig.
        goal: floors.
        of_size: parameters as a function of the size.
        draw: seed of the effect's chance.
        other: number of the effect's form.
        most: largest size, in sizes that the search starts from.
    """
    def entry(size: float) -> dict[str, Any]:
        return {"effect": id_, "place": PLACES[id_], "parameters": of_size(size), "draw": draw}

    def make(size: float) -> tuple[Array, Array]:
        return (sizer.packed({id_: of_size(size)}, {}, other=other),
                gusts_of(entry(size), len(sizer.duty), other=other > 0))

    size, left = sizer.size(make, abs(scale(id_)[1]), goal, most)
    return entry(size), left


def sized(id_: str, sizer: Sizer, goal: float, form: str, nominal: Mapping[str, float],
          rng: np.random.Generator) -> tuple[dict[str, object], float]:
    """An effect with its parameters, drawn, sized to leave `goal` floors; and its size in floors."""
    other = FORMS.index(form)
    if id_ in OUTSIDE:
        place, start = OUTSIDE[id_]
        if id_ == "current_clip":  # the lower, the larger: sized by what it cuts off
            size, left = sizer.size(lambda s: (sizer.packed({}, {id_: 1.0 / s}, other=False), np.zeros(0)),
                                    1.0 / start, goal)
            return {"effect": id_, "place": place, "parameters": {"size": 1.0 / size}}, left
        size, left = sizer.size(lambda s: (sizer.packed({}, {id_: s}, other=False), np.zeros(0)), start, goal)
        return {"effect": id_, "place": place, "parameters": {"size": size}}, left
    if id_ == "parameter_mismatch":
        name = str(rng.choice(list(MISMATCHES)))
        value = nominal[name] * (1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.4))
        return {"effect": id_, "place": MISMATCHES[name], "parameters": {name: value}}, 0.0
    of_size = parameters_of(id_, rng)
    shape = np.random.default_rng(int(rng.integers(2**31)))
    draw = int(shape.integers(2**31))
    if id_ == "command_delay":  # the least delay shows in full where a step is sampled: not a matter of floors
        return {"effect": id_, "place": PLACES[id_],
                "parameters": {"delay": math.exp(rng.uniform(*np.log((4e-3, 6e-2))))}, "draw": draw}, 0.0
    if id_ == "speed_spikes":
        rate = math.exp(rng.uniform(*np.log((0.2, 4.0))))
        return {"effect": id_, "place": "sensing", "parameters": {"rate": rate}, "draw": draw}, 0.0

    return search(id_, sizer, goal, of_size, draw, other=other, most=MOST.get(id_, 30.0))


def draw(name: str, kind: str, effects: list[str], form: str, nominal: Mapping[str, float],
         sensing: Mapping[str, float], seed: int, duration: float = 70.0, *, closed_loop: bool = False
         ) -> tuple[Case, dict[str, Array]]:
    """Draw a rig with these effects, size them, and record it.

    Returns:
        The case, and the channels and the duty (N,) of its recording.
    """
    rng = np.random.default_rng(seed)
    numbers = {k: nominal[k] * (1.0 + rng.uniform(-OFF, OFF)) for k in plant.NUMBERS}
    duty = duty_signal(rng, duration)
    sizer = Sizer(numbers, sensing, duty) if effects else None
    drawn, sizes = [], []
    for id_ in effects:
        assert sizer is not None
        goal = math.exp(rng.uniform(*np.log(FLOORS)))
        entry, size = sized(id_, sizer, goal, form, nominal, rng)
        drawn.append(entry)
        sizes.append(size)
    inside = {str(e["effect"]): e["parameters"] for e in drawn if e["effect"] in EFFECTS}
    outside = {str(e["effect"]): e["parameters"]["size"] for e in drawn if e["effect"] in OUTSIDE}  # type: ignore[index]
    for e in drawn:
        if e["effect"] == "parameter_mismatch":
            numbers = {**numbers, **e["parameters"]}  # type: ignore[dict-item]
    p = plant.packed(numbers, sensing["angle_filter_tau"], inside, outside, FORMS.index(form))  # type: ignore[arg-type]
    gusts = np.zeros(0)
    for e in drawn:
        if e["effect"] == "gust":
            gusts = gusts_of(e, len(duty), other=FORMS.index(form) > 0)
        e.pop("draw", None)
    shares = {}
    if kind == "two":
        rig, calm, form_ = Weighed(numbers, nominal, sensing, duty), np.zeros(0), FORMS.index(form)
        shares = rig.shares({id_: rig.moved(rig.packed({id_: own}, {}, other=form_), gusts if id_ == "gust" else calm)
                             for id_, own in inside.items()})  # type: ignore[dict-item]
    y, v, applied = plant.states(p, duty, gusts, pid(rng) if closed_loop else None)
    columns = plant.measured(p, y, v, sensing, rng)
    columns["duty"] = applied
    case = Case(name, kind, form, numbers, drawn, min(sizes, default=0.0), sizes, seed, closed_loop, shares)
    return case, columns
