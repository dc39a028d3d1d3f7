# SPDX-License-Identifier: Apache-2.0
"""Which experiment would tell hypotheses apart that a recording cannot.

What counts is not how far their readings differ, but how far they still differ after everything that may be refitted
has been: on each signal tried, the difference is projected off the slopes of the readings with respect to the numbers
of the model, within their uncertainty, and to the hypotheses' own parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.priors import NUMBER_SD
from aeropend_ident.diagnosis.free_run_gap import free_run
from aeropend_ident.signals.signals import CHANNELS, Signals
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import MODEL_NAMES, PARAMETERS, SAMPLE_PERIOD, Model

Array = NDArray[np.float64]
Named = tuple[str, Mapping[str, float]]
"""A hypothesis: what it is called (`thrust_lag`, `parameter_mismatch:K_t`), and its fitted numbers and effects."""

EXPERIMENTS = (
    Excitation("latin_hypercube", 60.0, duty_max=0.6),
    Excitation("latin_hypercube", 60.0, duty_max=0.25),
    Excitation("staircase", 60.0, duty_max=0.6),
    Excitation("steps", 60.0, hold_max=5.0),
    Excitation("steps", 60.0, hold_max=1.0, sequence=(0.1, 0.5, 0.2, 0.6, 0.0)),
    Excitation("multisine", 60.0, duty_max=0.5),
    Excitation("multisine", 60.0, duty_max=0.6, frequencies=(0.13, 0.47, 1.09, 2.3, 4.7, 9.1)),
    Excitation("free_decay", 60.0, duty=0.55, hold_max=4.0, rest=8.0),
    Excitation("free_decay", 60.0, duty=0.3, hold_max=4.0, rest=6.0),
    Excitation("hold", 60.0, duty=0.45),
)
"""What is tried, as `excite` would run it."""

APART = 10.0
"""Standard deviations by which two hypotheses must differ on a new recording to be told apart on it."""

LONGEST = 300.0
"""s that an experiment may last."""

REFITS = 10
"""Steps of a refit."""

STEP = 0.01
"""Standard deviations of its prior by which a parameter is varied to see what it does."""


def within(top: float) -> tuple[Excitation, ...]:
    """Experiments for a rig of which it is only known that it bears a duty of `top`: one of each kind."""
    top = max(math.floor(100.0 * top), 2) / 100.0
    return (Excitation("latin_hypercube", 60.0, duty_max=top),
            Excitation("steps", 60.0, hold_max=5.0, sequence=(0.0, round(0.7 * top, 3))),
            Excitation("multisine", 60.0, duty_max=top, frequencies=(0.13, 0.47, 1.09, 2.3, 4.7, 9.1)),
            Excitation("free_decay", 60.0, duty=top, hold_max=4.0, rest=8.0))


def advise(model: Model, signals: Signals, first: Named, rivals: Sequence[Named],
           experiments: Sequence[Excitation] = EXPERIMENTS) -> dict[str, object]:
    """Choose the duty signal on which a hypothesis differs most from each of its rivals, whatever is refitted.

    Args:
        model: the nominal model. signals: the recording that does not tell them apart; its channels and their noise
            are taken.
        first: the hypothesis. rivals: at least one. An effect at its neutral size is no part of a hypothesis.
        experiments: what is tried.

    Returns:
        `why` in words, and `excite`: parameters of that node, empty where no signal helps (contract section 5).
    """
    tried = {e: _distances(model, signals, first, rivals, e) for e in experiments}
    # a difference grows with the square root of the time
    grown = {e: [d * math.sqrt(LONGEST / e.duration) for d, _ in tried[e]] for e in experiments}
    helped = [k for k in range(len(rivals)) if max(grown[e][k] for e in experiments) > APART]
    alike = "; ".join(f"{first[0]} and {rivals[k][0]} give the same readings under every signal tried: to tell them "
                      f"apart, {_directly(model, first, rivals[k])}" for k in range(len(rivals)) if k not in helped)
    if not helped:
        return {"why": alike, "excite": {}}
    best = max(experiments, key=lambda e: min(tried[e][k][0] for k in helped))
    shortfall = APART / max(min(tried[best][k][0] for k in helped), 1e-9)
    if shortfall > 1.0:
        best = replace(best, duration=min(math.ceil(best.duration * shortfall**2 / 30.0) * 30.0, LONGEST))
        tried[best] = _distances(model, signals, first, rivals, best)
    default = asdict(Excitation(best.kind))
    chosen = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(best).items()
              if k in ("kind", "duration") or v != default[k]}
    texts = [f"from {rivals[k][0]} by {tried[best][k][0]:.0f} standard deviations, most in {tried[best][k][1]}"
             for k in helped]
    why = f"{first[0]} still differs there {', '.join(texts)}, after the numbers are refitted"
    return {"why": f"{why}; {alike}" if alike else why, "excite": chosen}


def next_experiment(model: Model, signals: Signals, first: Mapping[str, float], second: Mapping[str, float],
                    names: tuple[str, str], experiments: Sequence[Excitation] = EXPERIMENTS) -> dict[str, object]:
    """As `advise`, for two hypotheses."""
    return advise(model, signals, (names[0], first), [(names[1], second)], experiments)


def _distances(model: Model, signals: Signals, first: Named, rivals: Sequence[Named], excitation: Excitation
               ) -> list[tuple[float, str]]:
    """How many standard deviations each rival stays away from a hypothesis, and the channel that shows most.

    Either may be the truth that the other is refitted to; the smaller distance counts.
    """
    duty = excitation.series()
    nothing = np.full(len(duty), np.nan)
    planned = replace(signals, period=SAMPLE_PERIOD, duty=duty, theta=nothing, omega=nothing, i_a=nothing, v_a=nothing,
                      pulses=None, false_speed=np.zeros(len(duty), dtype=bool), train=len(duty))
    channels = [c for c in CHANNELS if signals.has(c)]
    noise = _noise(signals)

    def run(values: Mapping[str, float]) -> dict[str, Array]:
        return free_run(model, planned, {k: v for k, v in values.items() if not k.startswith("initial.")})

    shown = dict.fromkeys(channels, np.arange(len(duty)))
    readings = run(first[1])
    if signals.pulses is not None:  # the speed is read once a pulse
        turn = 2.0 * math.pi / model.sensing["speed_pulses_per_rev"]
        shown["omega"] = np.flatnonzero(np.diff(np.floor(np.cumsum(readings["omega"]) * SAMPLE_PERIOD / turn)))

    def stacked(readings: Mapping[str, Array]) -> Array:
        return np.concatenate([readings[c][shown[c]] / noise[c] for c in channels])

    def slopes(values: Mapping[str, float], here: Array, scales: Mapping[str, float]) -> Array:
        """What a standard deviation of each parameter does to the readings, (P, M)."""
        rows = [(stacked(run({**values, n: values[n] + STEP * sd})) - here) / STEP for n, sd in scales.items()]
        return np.array(rows).reshape(len(rows), len(here))

    def apart(truth: Array, values: Mapping[str, float], here: Array, rows: Array, scales: Mapping[str, float]
              ) -> tuple[float, str]:
        """How far readings (M,) stay from a hypothesis that is refitted to them: Gauss-Newton, slopes by Broyden."""
        z, damping, rows = np.zeros(len(rows)), 1e-3, rows.copy()
        cost = float((truth - here) @ (truth - here))
        for _ in range(REFITS):
            information = rows @ rows.T + np.eye(len(rows))
            step = np.linalg.solve(information + damping * np.diag(np.diag(information)), rows @ (truth - here) - z)
            trial = stacked(run({**values, **{n: _within(n, values[n] + sd * x)
                                              for (n, sd), x in zip(scales.items(), z + step, strict=True)}}))
            if not step.any():
                break
            rows += np.outer(step, trial - here - step @ rows) / float(step @ step)
            new = float((truth - trial) @ (truth - trial) + (z + step) @ (z + step))
            gained = cost - new
            if gained < 0.0:
                damping *= 30.0
                continue
            z, here, cost, damping = z + step, trial, new, 0.2 * damping
            if gained < 0.05 * cost + 0.1:
                break
        ends = np.cumsum([len(shown[c]) for c in channels])[:-1]
        parts = [float(x @ x) for x in np.split(truth - here, ends)]
        return math.sqrt(cost), channels[int(np.argmax(parts))]

    at_first = stacked(readings)
    numbers = {n: NUMBER_SD * abs(model.model[n]) for n in MODEL_NAMES if n in first[1] and model.model[n] != 0.0}
    slope_of = dict(zip(numbers, slopes(first[1], at_first, numbers), strict=True))

    def refittable(values: Mapping[str, float], here: Array) -> tuple[Array, dict[str, float]]:
        """Slopes (P, M) of all that a hypothesis may refit, numbers and its own, and their standard deviations."""
        own = _free(model, values)
        new = {n: sd for n, sd in own.items() if n not in numbers}
        rows = [x * own.get(n, sd) / sd for (n, sd), x in zip(numbers.items(), slope_of.values(), strict=True)]
        return np.vstack([*rows, slopes(values, here, new)]), {**numbers, **own}

    of_first = refittable(first[1], at_first)
    distances = []
    for _, values in rivals:
        here = stacked(run(values))
        distances.append(min(apart(at_first, values, here, *refittable(values, here)),
                             apart(here, first[1], at_first, *of_first)))
    return distances


def _within(name: str, value: float) -> float:
    """The value, or the end of its range."""
    owner, _, parameter = name.partition(".")
    p = CATALOGUE[owner].parameters[parameter] if parameter else PARAMETERS[f"model.{name}"]
    return min(max(value, p.low), p.high)


def _noise(signals: Signals) -> dict[str, float]:
    """Channel -> standard deviation of a reading; of the speed that of a typical interval between pulses."""
    noise = dict(signals.sigma)
    if signals.pulses is not None and len(signals.pulses.sigma):
        noise["omega"] = float(np.median(signals.pulses.sigma))
    return noise


def _free(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """What a hypothesis itself may refit, and how widely: its effects' parameters, a number far off its nominal."""
    free = {}
    for name, value in values.items():
        owner, _, parameter = name.partition(".")
        if owner in CATALOGUE:
            effect, size = CATALOGUE[owner].parameters, CATALOGUE[owner].size
            if values[f"{owner}.{size}"] != effect[size].neutral:
                p = effect[parameter]
                free[name] = 3.0 * abs(p.default - p.neutral) or abs(p.default) or 1.0
        elif owner in MODEL_NAMES and abs(value - model.model[owner]) > 3.0 * NUMBER_SD * abs(model.model[owner]):
            free[name] = abs(value - model.model[owner])
    return free


def _directly(model: Model, first: Named, second: Named) -> str:
    """What to measure by itself where no signal helps."""
    texts = []
    for name, values in (first, second):
        effect, _, number = name.partition(":")
        if number:
            p, nominal = PARAMETERS[f"model.{number}"], model.model[number]
            unit = "" if p.unit == "-" else f" {p.unit}"
            near = abs(values[number] - nominal) / 3.0
            texts.append(f"measure {number} ({p.description}) by itself to within {near:.2g}{unit}")
        elif effect != PARAMETER_MISMATCH:
            texts.append(f"look for {effect} by itself ({CATALOGUE[effect].physics})")
    return " or ".join(texts) or "measure the numbers of the model by themselves"
