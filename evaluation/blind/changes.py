# SPDX-License-Identifier: Apache-2.0
"""Rigs that change while they are recorded: an effect begins or ends at an instant, or a reading or a force drifts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.blind import cases, plant
from evaluation.blind.plant import EFFECTS, PERIOD

Array = NDArray[np.float64]

WITHIN = (0.15, 0.85)
"""Part of the recording in which an effect begins or ends."""

FLOORS = (3.0, 10.0)
"""Size, in floors, of an effect that begins or ends, if it acted all the time.

Choice: a smaller one shows when it acts, but not to half a second."""

NEAR = 0.5
"""[s] Distance from the true instant, or from one that nothing tells from it, within which it is found."""

DRIFT = (0.02, 0.08)
"""[rad] Range over which the angle drifts in a recording, or a force turns the hanging arm."""

NO_INSTANT = ("command_delay", "speed_spikes", "gust", "supply_drift", "winding_heating")
"""Effects without an instant that a recording shows: random ones, a delay of the command, and what grows from zero."""

WITHOUT = {"thrust_lag_tau": 1e-3}
"""Numbers of an effect's absence that let its states go on: [s] a lag that no sample shows."""

BEGINNING = tuple(e for e in EFFECTS if e not in NO_INSTANT)
"""Effects that may begin or end."""

DRIFTING = ("sensing", "arm")
"""Places at which something may drift: the reading of the angle, or a torque on the arm."""

ROWS = {"onset": BEGINNING, "slow drift": DRIFTING}
"""Circumstance -> what is drawn in turn."""


def make(what: str, numbers: Mapping[str, float], nominal: Mapping[str, float], sensing: Mapping[str, float],
         duty: Array, rng: np.random.Generator) -> tuple[dict[str, Any], dict[str, Array]]:
    """The effect of a recording, and its channels (N,); see `onset` and `drift`."""
    if what in DRIFTING:
        return drift(what, numbers, sensing, duty, rng)
    return onset(what, numbers, nominal, sensing, duty, rng)


def onset(effect: str, numbers: Mapping[str, float], nominal: Mapping[str, float], sensing: Mapping[str, float],
          duty: Array, rng: np.random.Generator) -> tuple[dict[str, Any], dict[str, Array]]:
    """An effect that begins or ends at a random instant.

    Args:
        effect: its id, one of `BEGINNING`.
        numbers: of the rig.
        nominal: of the model file.
        sensing: of the model file.
        duty: (N,) of the recording.
        rng: of all that is drawn.

    Returns:
        The effect with its instant, "since" or "until" [s], and the earliest and the latest instant that would change
        no reading by a floor, "hidden" [s]; and the channels (N,).
    """
    other = bool(rng.random() < 0.5)
    rig = cases.Sizer(numbers, sensing, duty)
    goal = math.exp(rng.uniform(*np.log(FLOORS)))
    entry, _ = cases.sized(effect, rig, goal, "other" if other else "table", nominal, rng)
    entry.pop("draw", None)
    own: Mapping[str, float] = entry["parameters"]  # type: ignore[assignment]
    with_ = rig.packed({effect: own}, {}, other=other)
    without = rig.packed({}, {}, other=other)
    for name, value in WITHOUT.items():
        if name.startswith(effect):
            without[plant.PARAMETERS.index(name)] = value
    k = round(rng.uniform(*WITHIN) * len(duty))
    begins = bool(rng.random() < 0.5)
    before, after = (without, with_) if begins else (with_, without)
    y, v, _ = plant.states(before, duty, np.zeros(0), later=(k, after))
    columns = plant.measured(before, y, v, sensing, rng, later=(k, after))

    def read(at: int) -> dict[str, Array]:
        y, v, _ = plant.states(before, duty, np.zeros(0), later=(at, after))
        return plant.ideal(before, y, v, (at, after))

    def hides(at: int) -> bool:
        other = read(at) if 0 < at < len(duty) else None
        return other is not None and all(np.abs(other[c] - mine[c]).max() < rig.floor[c] for c in mine)

    mine, step = read(k), round(NEAR / PERIOD)
    hidden = [k, k]
    for side, way in enumerate((-step, step)):
        while hides(hidden[side] + way):
            hidden[side] += way
    return {**entry, "since" if begins else "until": k * PERIOD, "hidden": [h * PERIOD for h in hidden]}, columns


def in_time(effect: Mapping[str, Any], which: str, at: float) -> bool:
    """Whether a begin ("since") or end ("until") at an instant [s] is that of an effect, as far as it shows.

    A rig that rests does not show that its supply sags: no recording tells then when that began.
    """
    return which in effect and effect["hidden"][0] - NEAR < at < effect["hidden"][1] + NEAR


def drift(place: str, numbers: Mapping[str, float], sensing: Mapping[str, float], duty: Array,
          rng: np.random.Generator) -> tuple[dict[str, Any], dict[str, Array]]:
    """A slow drift of the angle's reading (place "sensing"), or of a torque on the arm (place "arm").

    Returns:
        The drift as an effect outside of the catalogue, and the channels (N,).
    """
    t = np.arange(len(duty) + 2) / len(duty)
    shapes = (t, 1.0 - np.exp(-3.0 * t), np.sin(2.0 * math.pi * (rng.uniform(0.4, 1.5) * t + rng.random())))
    shape = shapes[rng.integers(len(shapes))]
    size = rng.choice([-1.0, 1.0]) * math.exp(rng.uniform(*np.log(DRIFT)))
    moved = size * shape / np.ptp(shape)
    p = plant.packed(numbers, sensing["angle_filter_tau"], {}, {}, other=False)
    y, v, _ = plant.states(p, duty, numbers["mgd_over_J"] * moved if place == "arm" else np.zeros(0))
    if place == "sensing":
        y[:, plant.S.stage2] += moved[:len(duty)]
    return {"effect": "drift", "place": place, "parameters": {"size": size}}, plant.measured(p, y, v, sensing, rng)
