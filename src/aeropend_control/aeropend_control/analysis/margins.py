# SPDX-License-Identifier: Apache-2.0
"""Stability margins of a law on a model, with the delay of the loop: measured on the very code that runs.

The loop is opened, in thought, at the duty. A small sum of sines is added to the duty while the law holds an operating
point; the ratio of what the law gives back to what is applied is the loop's gain at these frequencies. So observer,
sampling and the sample of delay are in it, and nothing has to be derived twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_control.laws.registry import LAWS
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.rig import Rig

Array = NDArray[np.float64]

SETTLE, PERIOD = 5.0, 8.0
"""s to reach the operating point, and the period of the sum of sines; two are run, the second is used."""

LINES = 48
"""Frequencies, spaced evenly in their logarithms from one per `PERIOD` to `HIGHEST`."""

HIGHEST = 40.0
"""Hz."""

AMPLITUDE = 2e-4
"""Duty of each sine."""


class Margins(NamedTuple):
    """How far a loop is from instability.

    Attributes:
        gain: factor by which the loop's gain may rise; inf if by any. phase: rad of lag that it bears.
        delay: s of further delay that it bears. crossover: rad/s at which the loop's gain passes 1.
        frequency: (F,) rad/s, and loop: (F,) complex gain there.
    """

    gain: float
    phase: float
    delay: float
    crossover: float
    frequency: Array
    loop: NDArray[np.complex128]


class MarginError(ValueError):
    """A loop without margins, since it does not come to rest; the message is one line for a person."""


def margins(model: Model, law: str, gains: Mapping[str, float] | None = None, at: float = 0.4,
            on: Model | None = None) -> Margins:
    """Margins of a law around an operating point.

    Args:
        model: what the law knows.
        law: its name in `LAWS`.
        gains: by name; the tuned ones by default.
        at: rad, or rad/s for the cascade.
        on: the model of the rig, if that is another.

    Raises:
        MarginError: the loop does not come to rest there.
        GainError: a gain that cannot be used.
    """
    exact = ("angle_lsb", "angle_noise", "current_lsb", "current_noise", "voltage_lsb", "voltage_noise", "speed_tick",
             "speed_noise")
    rig_model = on or model
    quiet = {id_: p for id_, p in rig_model.effects.items() if id_ not in CHANCE}
    rig = Rig(replace(rig_model, sensing={**rig_model.sensing, **dict.fromkeys(exact, 0.0)}, effects=quiet))
    kind = LAWS[law]
    controller = kind.make(model, gains)
    controller.reset()
    settle, n = round(SETTLE / SAMPLE_PERIOD), round(PERIOD / SAMPLE_PERIOD)
    lines = np.unique(np.round(np.geomspace(1.0, HIGHEST * PERIOD, LINES)).astype(int))
    phases = math.pi * np.arange(len(lines)) ** 2 / len(lines)  # Schroeder's: a low crest
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
    if np.ptp(seen[-n:]) > 0.2 * at or np.ptp(seen[settle - n // 4:settle]) > 0.1 * at:
        raise MarginError(f"{law} does not come to rest at {at:g} {kind.reference_unit}: there are no margins")
    back = np.fft.rfft(given[-n:])[lines]
    loop = -back / (back + np.fft.rfft(added)[lines])
    return from_response(2.0 * math.pi * lines / PERIOD, loop)


CHANCE = tuple(id_ for id_ in CATALOGUE if id_ in ("gust", "speed_spikes"))
"""Effects that are noise."""


def from_response(frequency: Array, loop: NDArray[np.complex128]) -> Margins:
    """Margins of a loop's gain, complex (F,), at rising frequencies (F,), rad/s."""
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
        for turn in range(-5, 5):
            a, b = phase[k] - math.pi * (2 * turn + 1), phase[k + 1] - math.pi * (2 * turn + 1)
            if a * b < 0.0:
                at = size[k] + a / (a - b) * (size[k + 1] - size[k])
                if at < 0.0:
                    gain = min(gain, math.exp(-at))
    return Margins(gain, least, delay, crossover, frequency, loop)
