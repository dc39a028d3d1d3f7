# SPDX-License-Identifier: Apache-2.0
"""The blind check of uncalibrated rigs: recordings of angle and command only, and of an arm that swings freely.

The rigs are those of `plant` with every parameter drawn over a factor of three. They are sampled at 20 to 490 Hz, and
the angle has a resolution of up to a degree. The size of an effect counts what no refit of the parameters absorbs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import odeint

from aeropend_ident.testing import bags
from aeropend_sim.model.parameters import load
from evaluation.blind import cases, folder, page, plant, score
from evaluation.blind.plant import NUMBERS, PERIOD, S

Array = NDArray[np.float64]

FACTOR = 3.0
"""Largest over smallest value of a number among the rigs."""

EVERY = (1, 5, 10, 24)
"""Every how many samples of 2.04 ms one is kept: 490, 98, 49 and 20 Hz."""

STEPS = (math.radians(360.0 / 1024.0), math.radians(0.1), math.radians(1.0))
"""Resolutions of the angle, rad."""

TOP = 0.9
"""rad that a rig lifts its arm to at most, about."""

SHOWS = ("supply_drift", "command_delay", "winding_heating", "thrust_lag", "thrust_exponent", "axial_inflow",
         "ground_effect", "coulomb_friction", "quadratic_drag", "cable_torque", "mast_flex", "gust", "angle_offset",
         "encoder_lag", "encoder_eccentricity")
"""Effects that the angle may show; the others change what is not measured, or only the static curve."""

DAMPING = ("viscous", "coulomb_friction", "quadratic_drag")


def rig(nominal: Mapping[str, float], rng: np.random.Generator) -> tuple[dict[str, float], float]:
    """Numbers of a rig that lifts its arm, and the duty that lifts it as far as is sensible."""
    while True:
        n = {k: v * FACTOR ** rng.uniform(-0.5, 0.5) for k, v in nominal.items()}
        duty = np.linspace(0.0, 1.0, 101)
        lift = n["L_over_J"] * n["k_thrust"] * _speed(n, duty) ** 2 / n["mgd_over_J"]
        high = float(duty[np.searchsorted(lift, math.sin(TOP)) - 1]) if lift[-1] > math.sin(TOP) else 1.0
        if high > 0.2 and lift[int(100 * high)] > 0.4:
            return n, high


def _speed(n: Mapping[str, float], duty: Array) -> Array:
    """Steady speed of a duty: v = R_a k_load ω² / K_t + K_e ω."""
    v = np.maximum(n["k0"] + n["k1"] * np.sqrt(n["k2"] * duty + n["k3"]), 0.0)
    a = n["R_a"] * n["k_load"] / n["K_t"]
    return (np.sqrt(n["K_e"] ** 2 + 4.0 * a * v) - n["K_e"]) / (2.0 * a)


class AngleSizer(cases.Sizer):
    """Finds the size of an effect at which what no refit of the numbers absorbs of the angle is so many floors."""

    room, ridge = (-0.5, 0.5), 1e-9

    def __init__(self, numbers: Mapping[str, float], tau: float, duty: Array, floor: float) -> None:
        self.numbers, self.tau, self.duty, self.floor = dict(numbers), tau, duty, {"theta": floor}
        self.absorb(NUMBERS)


def driven(name: str, effect: str, form: str, nominal: Mapping[str, float], tau: float, seed: int,
           duration: float) -> tuple[dict[str, Any], dict[str, Array], float]:
    """A recording of angle and command alone, with one effect or none ("").

    Returns:
        Its label, its channels (N,), and its sample period in s.
    """
    rng = np.random.default_rng([seed, 7])
    every, lsb = int(rng.choice(EVERY)), float(rng.choice(STEPS))
    noise = rng.uniform(0.2, 0.6) * lsb
    floor = math.hypot(noise, lsb / math.sqrt(12.0))
    other = form == "other"
    while True:
        numbers, high = rig(nominal, rng)
        duty = cases.duty_signal(rng, duration)
        duty = np.repeat((duty * (0.95 * high / duty.max()))[::every], every)[:len(duty)]
        effects: list[dict[str, Any]] = []
        size, gusts = 0.0, np.zeros(0)
        if effect:
            sizer = AngleSizer(numbers, tau, duty, floor)
            goal = math.exp(rng.uniform(*np.log(cases.FLOORS)))
            entry, size = _sized(effect, sizer, goal, other, rng)
            if not 0.7 * cases.FLOORS[0] < size < 1.4 * cases.FLOORS[1]:
                continue  # this rig cannot show it at a size that a rig might have
            effects, gusts = [entry], cases.gusts_of(entry, len(duty), other=other)
            del entry["draw"]
        inside = {e["effect"]: e["parameters"] for e in effects}
        p = plant.packed(numbers, tau, inside, {}, other)
        y, v, _ = plant.states(p, duty, gusts)
        if np.abs(y[:, S.theta]).max() < 2.5:
            break
    theta = plant.shown(p, y, v)["theta"]
    theta = np.round((theta + noise * rng.standard_normal(len(theta))) / lsb) * lsb
    nothing = np.full(len(duty[::every]), np.nan)
    label = {"name": name, "kind": "single" if effect else "none", "form": form, "numbers": numbers,
             "effects": effects, "size": size, "every": every, "lsb": lsb, "closed_loop": False}
    return label, {"theta": theta[::every], "omega": nothing, "i_a": nothing, "v_a": nothing,
                   "duty": duty[::every]}, every * PERIOD


def _sized(effect: str, sizer: AngleSizer, goal: float, other: bool, rng: np.random.Generator
           ) -> tuple[dict[str, Any], float]:
    of_size = cases.parameters_of(effect, rng)
    draw = int(rng.integers(2**31))
    return cases.search(effect, sizer, goal, of_size, draw, other=other, most=cases.MOST.get(effect, 10.0))


def decay(name: str, damping: str, nominal: Mapping[str, float], seed: int, rate: float = 20.0,
          lsb: float = math.radians(1.0), swings: int = 10) -> tuple[dict[str, Any], dict[str, Array], float]:
    """A free decay of an arm that is held and let go, over so many swings from side to side; as `driven`.

    What brakes it is viscous, or mostly dry friction or drag; the amplitude that is left is 10 to 60 %.
    """
    rng = np.random.default_rng([seed, 8])
    gravity = nominal["mgd_over_J"] * FACTOR ** rng.uniform(-0.5, 0.5)
    first, left = math.radians(rng.uniform(40.0, 100.0)), rng.uniform(0.1, 0.6)
    lasts = swings * math.pi / math.sqrt(gravity)
    share = 0.0 if damping == "viscous" else rng.uniform(0.6, 1.0)
    mine = left ** share  # what the effect alone would leave
    effects: dict[str, dict[str, float]] = {}
    if damping == "coulomb_friction":  # takes 2 accel / gravity of the amplitude a swing
        effects = {damping: {"accel": first * (1.0 - mine) / swings * gravity / 2.0}}
    elif damping == "quadratic_drag":  # takes 4/3 k amplitude² a swing
        effects = {damping: {"k": (1.0 / mine - 1.0) / (first * swings * 4.0 / 3.0)}}
    numbers = {**nominal, "mgd_over_J": gravity, "c_over_J": 2.0 * (1.0 - share) * math.log(1.0 / left) / lasts}
    p = plant.packed(numbers, 1e-3, effects, {}, other=False)
    held, y = rng.uniform(0.3, 1.0), np.zeros(len(S))
    y[[S.theta, S.stage1, S.stage2]] = first
    t = np.arange(0.0, held + 1.02 * lasts, 1.0 / rate)
    since, back = np.unique(np.maximum(t - held, 0.0), return_inverse=True)
    path = odeint(plant.derivative, y, since, (0.0, p, np.zeros(0), np.zeros(16)), rtol=1e-8, atol=1e-9, mxstep=50000)
    theta = path[back, S.theta] + rng.uniform(0.0, 0.3) * lsb * rng.standard_normal(len(t))
    nothing = np.full(len(t), np.nan)
    entry = [{"effect": e, "place": "arm", "parameters": q} for e, q in effects.items()]
    label = {"name": name, "kind": "single" if entry else "none", "form": "table", "numbers": numbers,
             "effects": entry, "size": 0.0, "closed_loop": False}
    return label, {"theta": np.round(theta / lsb) * lsb if lsb > 0.0 else theta, "omega": nothing, "i_a": nothing,
                   "v_a": nothing, "duty": nothing}, 1.0 / rate


def plan(count: int, seed: int) -> list[tuple[str, str, str]]:
    """What ("driven" or "decay"), which effect ("" for none, or what brakes) and form of each recording."""
    rng = np.random.default_rng([seed, 9])
    decays = [("decay", DAMPING[k % len(DAMPING)], "table") for k in range(count // 2)]
    empty = max((count - len(decays)) // 4, 1)
    order = [str(e) for _ in range(count // len(SHOWS) + 1) for e in rng.permutation(SHOWS)]
    rest = [("driven", e, str(rng.choice(["table", "other"]))) for e in order[:count - len(decays) - empty]]
    return [*decays, *rest, *[("driven", "", "table")] * empty]


def make(out: Path, count: int, seed: int, duration: float, jobs: int) -> None:
    """Make the recordings, and seal their labels."""
    nominal = load(folder.MODEL)

    def one(k: int, row: tuple[str, str, str]) -> dict[str, Any]:
        what, effect, form = row
        name, own = f"u{k:03d}", seed * 100_003 + k
        if what == "decay":
            label, columns, period = decay(name, effect, nominal.model, own)
        else:
            label, columns, period = driven(name, effect, form, nominal.model, nominal.sensing["angle_filter_tau"],
                                            own, duration)
        bags.write(out / "recordings" / name, columns, round(period * 1e9))
        return {**label, "what": what}

    folder.make_all(out, plan(count, seed), one, jobs)


def left(body: Mapping[str, Any] | None) -> float:
    """Floors RMS that the identified nominal model leaves of the angle, noise taken off."""
    if body is None or "error" in body:
        return 0.0
    c = body["channels"]["theta"]
    return math.sqrt(max(c["gap"] ** 2 - c["floor"] ** 2, 0.0)) / max(c["floor"], 1e-12)


def figures(labels: Sequence[Mapping[str, Any]], verdicts: Mapping[str, Mapping[str, Any]]) -> list[score.Figure]:
    """The figures of uncalibrated rigs."""
    what = {label["name"]: label["what"] for label in labels}
    pairs = score.pair(labels, verdicts, score.answer_of_diagnosis)
    driven_, decays = ([(t, a) for t, a in pairs if what[t.name] == w] for w in ("driven", "decay"))
    shown = [(t, a) for t, a in score.of_kind(driven_, "single") if left(verdicts.get(t.name)) >= cases.FLOORS[0]]
    hidden = [(t, a) for t, a in score.of_kind(driven_, "single") if left(verdicts.get(t.name)) < cases.FLOORS[0]]
    none = [(t, a) for t, a in pairs if t.kind == "none"]
    seconds = [a.seconds for _, a in pairs if a.seconds is not None]
    return [
        score.share("angle and command: right effect first, where a refit leaves 1.5 floors or more",
                    [score.right_first(t, a) for t, a in shown], at_least=0.75),
        score.share("the same, first or named with the first", [score.right_named(t, a) for t, a in shown],
                    at_least=0.95),
        score.share("no effect in it, one claimed", [a.claims for _, a in none], at_most=0.05),
        score.share("free decays: right effect or none", [score.right_first(t, a) if t.keys else a.first == "none"
                                                              for t, a in decays], at_least=0.95),
        score.share("right first or none, where a refit leaves less",
                    [score.right_first(t, a) or a.first == "none" for t, a in hidden]),
        score.share("95 % intervals that hold the truth", score.intervals_held([*shown, *decays], "table")),
        score.median("seconds, median", seconds),
        score.Figure("seconds, longest", max(seconds, default=None), count=len(seconds), share=False),
    ]


def report(out: Path) -> list[score.Figure]:
    """Open the labels, once every verdict is written, and print the figures.

    Raises:
        SystemExit: a verdict is missing.
    """
    return page.printed(figures(*folder.opened(out)))
