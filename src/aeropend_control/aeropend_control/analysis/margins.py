# SPDX-License-Identifier: Apache-2.0
"""Stability margins of a law with a model, measured in a simulation of the code that runs.

A small multisine is added to the duty while the law holds an operating point. The ratio of the law's output to the
applied duty is the loop gain at the frequencies of the multisine. So it includes the observer, the sampling and the
delay of one sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_control.laws.registry import LAWS
from aeropend_sim.errors import UserError
from aeropend_sim.model.effects import RANDOM
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.rig import Rig

Array = NDArray[np.float64]

SETTLE, PERIOD = 5.0, 8.0
"""[s] Time to reach the operating point, and period of the multisine (choices). The second of two periods is used."""

LINES = 48
"""Number of frequencies, spaced logarithmically from 1/`PERIOD` to `HIGHEST` (choice); equal ones count once."""

HIGHEST = 40.0
"""[Hz] Highest frequency (choice; far above the crossover of every tuned law)."""

AMPLITUDE = 2e-4
"""Amplitude of each sine, as a duty (choice; small, so that the loop stays linear)."""

EXACT = ("angle_lsb", "angle_noise", "current_lsb", "current_noise", "voltage_lsb", "voltage_noise", "speed_tick",
         "speed_noise")
"""Noise and quantisation of the sensors; the loop gain is measured without them."""

TURNS = range(-5, 5)
"""Multiples of 2π at which the phase may cross -π (choice; more than any loop here has)."""

RESTLESS = (0.1, 0.2)
"""Shares of the reference by which a loop may still move before and during the measurement (choices)."""


class Margins(NamedTuple):
    """Stability margins of a loop.

    Attributes:
        gain: gain margin, a factor; inf if the loop is stable for every higher gain.
        phase: [rad] phase margin.
        delay: [s] delay margin.
        crossover: [rad/s] frequency at which the magnitude of the loop gain is 1.
        frequency: [rad/s] (F,).
        loop: (F,) complex loop gain.
    """

    gain: float
    phase: float
    delay: float
    crossover: float
    frequency: Array
    loop: NDArray[np.complex128]


class MarginError(UserError):
    """The loop does not come to rest, so it has no margins; the message is one line for the user."""


def margins(model: Model, law: str, gains: Mapping[str, float] | None = None, at: float = 0.4,
            on: Model | None = None) -> Margins:
    """Margins of a law around an operating point.

    Args:
        model: the model that the law uses.
        law: its name in `LAWS`.
        gains: by name; None: the tuned gains.
        at: [rad, or rad/s for the cascade] reference at the operating point.
        on: the model of the rig; None: `model`.

    Raises:
        MarginError: the loop does not come to rest there.
        GainError: a gain cannot be used.
    """
    rig_model = on or model
    quiet = {id_: p for id_, p in rig_model.effects.items() if id_ not in RANDOM}
    rig = Rig(replace(rig_model, sensing={**rig_model.sensing, **dict.fromkeys(EXACT, 0.0)}, effects=quiet))
    kind = LAWS[law]
    controller = kind.make(model, gains)
    controller.reset()
    settle, n = round(SETTLE / SAMPLE_PERIOD), round(PERIOD / SAMPLE_PERIOD)
    lines = np.unique(np.round(np.geomspace(1.0, HIGHEST * PERIOD, LINES)).astype(int))
    phases = math.pi * np.arange(len(lines)) ** 2 / len(lines)  # Schroeder phases: a low crest factor
    added = AMPLITUDE * np.cos(2.0 * math.pi * np.outer(np.arange(n) / n, lines) + phases).sum(axis=1)
    given = np.zeros(settle + 2 * n)
    seen = np.zeros(len(given))
    duty = 0.0
    for k in range(len(given)):
        given[k] = duty
        applied = duty + (added[(k - settle) % n] if k >= settle else 0.0)
        sample, truth = rig.sample(min(max(applied, 0.0), 1.0))
        seen[k] = getattr(truth, kind.measures)
        duty = controller.step(sample, at)
    if np.ptp(seen[-n:]) > RESTLESS[1] * at or np.ptp(seen[settle - n // 4:settle]) > RESTLESS[0] * at:
        raise MarginError(f"{law} does not come to rest at {at:g} {kind.reference_unit}: there are no margins")
    back = np.fft.rfft(given[-n:])[lines]
    loop = -back / (back + np.fft.rfft(added)[lines])
    return from_response(2.0 * math.pi * lines / PERIOD, loop)


def from_response(frequency: Array, loop: NDArray[np.complex128]) -> Margins:
    """Margins from a frequency response.

    Args:
        frequency: [rad/s] (F,) rising.
        loop: (F,) complex loop gain.
    """
    size, phase, log_f = np.log(np.abs(loop)), np.unwrap(np.angle(loop)), np.log(frequency)
    gain, least, delay, crossover = math.inf, math.inf, math.inf, math.nan
    for k in range(len(frequency) - 1):
        if (size[k] > 0.0) != (size[k + 1] > 0.0):
            s = size[k] / (size[k] - size[k + 1])
            omega = math.exp(log_f[k] + s * (log_f[k + 1] - log_f[k]))
            left = (phase[k] + s * (phase[k + 1] - phase[k]) + math.pi) % (2.0 * math.pi)
            short = min(left, 2.0 * math.pi - left)
            if short < least:
                least, crossover = short, omega
            delay = min(delay, left / omega)
        for turn in TURNS:
            a, b = phase[k] - math.pi * (2 * turn + 1), phase[k + 1] - math.pi * (2 * turn + 1)
            if a * b < 0.0:
                at = size[k] + a / (a - b) * (size[k + 1] - size[k])
                if at < 0.0:
                    gain = min(gain, math.exp(-at))
    return Margins(gain, least, delay, crossover, frequency, loop)
