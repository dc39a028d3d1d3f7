# SPDX-License-Identifier: Apache-2.0
"""Rigs unlike the preset, each with a model file of its own: slow and fast ones, at low rates, with clean encoders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.blind import cases, plant
from evaluation.blind.plant import PERIOD

Array = NDArray[np.float64]

GRAVITY = (1.0, 100.0)
"""[1/s²] Gravity over inertia."""

DAMPING = (0.01, 0.15)
"""Damping ratio of the arm."""

LIFTS = (0.7, 1.4)
"""Lift over gravity, relative to the preset."""

HIGHEST = 1.6
"""[rad] Largest angle; the duty is lowered until the arm stays below it (a person would not let it spin)."""

EVERY = (1, 2, 5, 10, 24)
"""Samples of the plant between two of the recording: 490 to 20 Hz."""

ENCODERS = ((0.0, 0.0061), (0.0, 0.0015), (0.002, 0.0061))
"""[rad] Noise and resolution of the angle; without noise an arm at rest reads exactly 0."""

EFFECTS = ("none", "none", "bridge_drop", "supply_sag", "brush_drop", "rotor_friction", "thrust_lag", "thrust_exponent",
           "coulomb_friction", "quadratic_drag", "cable_torque", "angle_offset", "encoder_eccentricity", "current_gain")
"""What is drawn in turn (choice: effects that show at 20 Hz too)."""

PULSED = 0.3
"""Share of the recordings in which short pulses of the duty are followed by free decays."""


@dataclass(frozen=True)
class Recorded:
    """A recording of another rig.

    Attributes:
        label: the effect, if there is one, and what the rig is like.
        columns: the channels and the duty (N,).
        period: [s] between samples.
        model: numbers of its model file, each off by up to `cases.OFF`.
        sensing: of its model file.
    """

    label: dict[str, Any]
    columns: dict[str, Array]
    period: float
    model: dict[str, float]
    sensing: dict[str, float]


def make(effect: str, preset: Mapping[str, float], sensing: Mapping[str, float], duration: float,
         rng: np.random.Generator) -> Recorded:
    """A recording of a rig unlike the preset.

    Args:
        effect: its id, or "none".
        preset: numbers of the preset.
        sensing: of the preset.
        duration: [s] of the recording.
        rng: of all that is drawn.
    """
    gravity = math.exp(rng.uniform(*np.log(GRAVITY)))
    slower = math.sqrt(preset["mgd_over_J"] / gravity)
    numbers = {**preset, "mgd_over_J": gravity,
               "c_over_J": 2.0 * math.exp(rng.uniform(*np.log(DAMPING))) * math.sqrt(gravity),
               "L_over_J": preset["L_over_J"] * gravity / preset["mgd_over_J"] * rng.uniform(*LIFTS),
               "J_m": preset["J_m"] * rng.uniform(0.5, 2.0)}
    noise, lsb = ENCODERS[rng.integers(len(ENCODERS))]
    own = {**sensing, "angle_noise": noise, "angle_lsb": lsb}
    every = int(rng.choice(EVERY))
    duty = pulses(rng, duration, slower) if rng.random() < PULSED else driven(rng, duration, slower)
    duty = np.repeat(duty[::every], every)[:len(duty)]
    bare = plant.packed(numbers, own["angle_filter_tau"], {}, {}, other=False)
    while np.abs(plant.states(bare, duty, np.zeros(0))[0][:, plant.S.theta]).max() > HIGHEST:
        duty = 0.8 * duty
    label: dict[str, Any] = {"effects": [], "gravity": gravity, "rate": 1.0 / (every * PERIOD)}
    inside: dict[str, Mapping[str, float]] = {}
    other = bool(rng.random() < 0.5)
    if effect != "none":
        rig = cases.Sizer(numbers, own, duty)
        goal = math.exp(rng.uniform(*np.log(cases.FLOORS)))
        entry, _ = cases.sized(effect, rig, goal, "other" if other else "table", numbers, rng)
        entry.pop("draw", None)
        label["effects"], inside = [entry], {effect: entry["parameters"]}  # type: ignore[dict-item]
    p = plant.packed(numbers, own["angle_filter_tau"], inside, {}, other)
    y, v, _ = plant.states(p, duty, np.zeros(0))
    columns = {**plant.measured(p, y, v, own, rng), "duty": duty}
    model = {k: x / (1.0 + rng.uniform(-cases.OFF, cases.OFF)) for k, x in numbers.items()}
    return Recorded(label, {c: x[::every] for c, x in columns.items()}, every * PERIOD, model, own)


def driven(rng: np.random.Generator, duration: float, slower: float) -> Array:
    """Duty (N,) as for the preset, held longer for a slower arm; it may step at the first sample."""
    n = round(duration / PERIOD)
    return cases.duty_signal(rng, duration / min(slower, 1.0))[(np.arange(n) / max(slower, 1.0)).astype(int)]


def pulses(rng: np.random.Generator, duration: float, slower: float) -> Array:
    """Duty (N,): short pulses, each followed by a decay."""
    duty, t = np.zeros(round(duration / PERIOD)), rng.uniform(0.0, 2.0)
    while t < duration:
        length = rng.uniform(0.4, 1.2) * max(slower, 0.5)
        duty[round(t / PERIOD):round((t + length) / PERIOD)] = rng.uniform(0.25, 0.6)
        t += length + rng.uniform(3.0, 7.0) * max(slower, 0.5)
    return duty
