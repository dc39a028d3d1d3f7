# SPDX-License-Identifier: Apache-2.0
"""The experiment that would separate hypotheses that a recording cannot.

Hypotheses separate on an excitation signal if their readings still differ after everything has been refitted: the
parameters of the model within their uncertainty, and the hypotheses' own parameters (optimal design for model
discrimination: A. Atkinson and V. Fedorov, Biometrika 62, 1975). Some signals are tried.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.free_run import StagedRun
from aeropend_ident.diagnosis.chain.priors import NOMINAL_SD
from aeropend_ident.diagnosis.chain.values import clipped
from aeropend_ident.diagnosis.document import NextExperiment
from aeropend_ident.estimation.levenberg_marquardt import DAMPING, DAMPING_DOWN
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import key
from aeropend_ident.estimation.residuals import finite
from aeropend_ident.signals.signals import CHANNELS, Signals
from aeropend_sim.model.effects import DEFINED, PARAMETER_MISMATCH
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import MODEL_NAMES, PARAMETERS, SAMPLE_PERIOD, Model

Array = NDArray[np.float64]
Named = tuple[str, Mapping[str, float]]
"""A hypothesis: its name (`thrust_lag`, `parameter_mismatch:K_t`), and its fitted parameters and effects."""

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
"""The signals that are tried, as `excite` plays them: each kind, fast and slow, low and high (choice)."""

SEPARATE = 10.0
"""Standard deviations by which two hypotheses must differ on a recording to separate on it.

Choice: far above chance, since noise of a rig is never quite white."""

LONGEST = 300.0
"""[s] Longest experiment (choice)."""

REFITS = 10
"""Steps of a refit (choice: it stops earlier when it gains little)."""

STEP = 0.01
"""Standard deviations of its prior by which a parameter is varied for a derivative (choice)."""

REJECTED = 30.0
"""Factor on the damping after a step that fails.

Choice: the slopes are approximate, so a far shorter step is tried."""

ENOUGH, ENOUGH_OF_COST = 0.1, 0.05
"""Decrease of the squared distance below which a refit stops: absolute, and relative.

Choice: the result is rounded to 1."""

Distance = tuple[float, str]
"""Standard deviations by which two hypotheses differ, and the channel that shows most of it."""


def experiments_within(top: float) -> tuple[Excitation, ...]:
    """One signal of each kind for a rig if only the largest duty so far is known.

    Args:
        top: largest duty that the rig has been given.
    """
    top = max(math.floor(100.0 * top), 2) / 100.0
    return (Excitation("latin_hypercube", 60.0, duty_max=top),
            Excitation("steps", 60.0, hold_max=5.0, sequence=(0.0, round(0.7 * top, 3))),
            Excitation("multisine", 60.0, duty_max=top, frequencies=(0.13, 0.47, 1.09, 2.3, 4.7, 9.1)),
            Excitation("free_decay", 60.0, duty=top, hold_max=4.0, rest=8.0))


def advise(model: Model, signals: Signals, first: Named, rivals: Sequence[Named],
           experiments: Sequence[Excitation] = EXPERIMENTS, jobs: int = 1) -> NextExperiment:
    """Choose the signal on which a hypothesis differs most from each of its rivals after a refit.

    Args:
        model: the nominal model.
        signals: the recording that does not separate them; gives the channels and their noise.
        first: the hypothesis.
        rivals: at least one. An effect at its neutral size is no part of a hypothesis.
        experiments: the signals that are tried.
        jobs: processes.
    """
    found = parallel(jobs, lambda e: distances(model, signals, first, rivals, e), experiments)
    tried = dict(zip(experiments, found, strict=True))
    # a difference grows with the square root of the time
    grown = {e: [d * math.sqrt(LONGEST / e.duration) for d, _ in tried[e]] for e in experiments}
    helped = [k for k in range(len(rivals)) if max(grown[e][k] for e in experiments) > SEPARATE]
    alike = "; ".join(f"{first[0]} and {rivals[k][0]} give the same readings under every signal tried: to separate "
                      f"them, {_directly(model, first, rivals[k])}" for k in range(len(rivals)) if k not in helped)
    if not helped:
        return NextExperiment(alike, {})
    best = max(experiments, key=lambda e: min(tried[e][k][0] for k in helped))
    shortfall = SEPARATE / max(min(tried[best][k][0] for k in helped), 1e-9)
    if shortfall > 1.0:
        best = replace(best, duration=min(math.ceil(best.duration * shortfall**2 / 30.0) * 30.0, LONGEST))
        tried[best] = distances(model, signals, first, rivals, best)
    default = asdict(Excitation(best.kind))
    chosen = {k: v for k, v in asdict(best).items() if k in ("kind", "duration") or v != default[k]}
    texts = [f"from {rivals[k][0]} by {tried[best][k][0]:.0f} standard deviations, most in {tried[best][k][1]}"
             for k in helped]
    why = f"with this signal {first[0]} differs {', '.join(texts)}, after the parameters are refitted"
    return NextExperiment(f"{why}; {alike}" if alike else why, chosen)


def next_experiment(model: Model, signals: Signals, first: Mapping[str, float], second: Mapping[str, float],
                    names: tuple[str, str], experiments: Sequence[Excitation] = EXPERIMENTS, jobs: int = 1
                    ) -> NextExperiment:
    """As `advise`, for two hypotheses.

    Args:
        model: the nominal model.
        signals: the recording that does not separate them.
        first: values of the one hypothesis.
        second: values of the other.
        names: of both.
        experiments: the signals that are tried.
        jobs: processes.
    """
    return advise(model, signals, (names[0], first), [(names[1], second)], experiments, jobs)


def distances(model: Model, signals: Signals, first: Named, rivals: Sequence[Named], excitation: Excitation
              ) -> list[Distance]:
    """Distance of each rival from a hypothesis on a signal.

    Either may be the truth to which the other is refitted; the smaller distance counts.

    Args:
        model: the nominal model.
        signals: a recording that gives the channels and their noise.
        first: the hypothesis.
        rivals: of it.
        excitation: the signal.
    """
    planned = PlannedReadings.under(model, signals, excitation.series(), first[1])
    nominal = {n: NOMINAL_SD * abs(model.model[n]) for n in MODEL_NAMES if n in first[1] and model.model[n] != 0.0}
    at_first = planned.readings(first[1])
    slope_of = dict(zip(nominal, planned.slopes(first[1], at_first, nominal), strict=True))

    def refittable(values: Mapping[str, float], here: Array) -> _Refit:
        own = _free(model, values)
        new = {n: sd for n, sd in own.items() if n not in nominal}
        rows = [x * own.get(n, sd) / sd for (n, sd), x in zip(nominal.items(), slope_of.values(), strict=True)]
        return _Refit(planned, values, here, np.vstack([*rows, planned.slopes(values, here, new)]), {**nominal, **own})

    of_first = refittable(first[1], at_first)
    found = []
    for _, values in rivals:
        here = planned.readings(values)
        found.append(min(refittable(values, here).distance(at_first), of_first.distance(here)))
    return found


def unread(signals: Signals, duty: Array) -> Signals:
    """A recording of a duty signal (N,) without readings.

    Args:
        signals: a recording of the rig.
        duty: held for one `SAMPLE_PERIOD` each.
    """
    nothing = np.full(len(duty), np.nan)
    return replace(signals, period=SAMPLE_PERIOD, duty=duty, theta=nothing, omega=nothing, i_a=nothing, v_a=nothing,
                   pulses=None, false_speed=np.zeros(len(duty), dtype=bool), train=len(duty))


@dataclass(frozen=True)
class PlannedReadings:
    """The readings of a recording that a duty signal would give.

    Attributes:
        model: the nominal model.
        signals: with the duty and without readings.
        shown: channel -> samples that are read.
        noise: channel -> standard deviation of a reading.
    """

    model: Model
    signals: Signals
    shown: Mapping[str, NDArray[np.int64]]
    noise: Mapping[str, float]

    @classmethod
    def under(cls, model: Model, signals: Signals, duty: Array, values: Mapping[str, float] | None = None
              ) -> PlannedReadings:
        """Plan a recording.

        Args:
            model: the nominal model.
            signals: gives the channels and the noise.
            duty: (N,) held for one `SAMPLE_PERIOD` each.
            values: give the pulses of the speed.
        """
        shown = {c: np.arange(len(duty)) for c in CHANNELS if signals.has(c)}
        planned = cls(model, unread(signals, duty), shown, _noise(signals))
        if signals.pulses is not None:  # the speed is read once a pulse
            turn = 2.0 * math.pi / model.sensing["speed_pulses_per_rev"]
            angle = np.cumsum(planned.run(values or {})["omega"]) * SAMPLE_PERIOD
            shown["omega"] = np.flatnonzero(np.diff(np.floor(angle / turn)))
        return planned

    def run(self, values: Mapping[str, float]) -> dict[str, Array]:
        """Channel -> (N,) readings of a free run from rest."""
        return self._staged.readings({k: v for k, v in values.items() if not key(k).is_initial})

    @cached_property
    def _staged(self) -> StagedRun:
        return StagedRun(self.model, self.signals)

    def readings(self, values: Mapping[str, float]) -> Array:
        """(M,) All readings in units of their noise."""
        return self.stacked(self.run(values))

    def stacked(self, run: Mapping[str, Array]) -> Array:
        """(M,) All readings of a run, which may be longer, in units of their noise."""
        return finite(np.concatenate([run[c][at] / self.noise[c] for c, at in self.shown.items()]))

    def slopes(self, values: Mapping[str, float], here: Array, scales: Mapping[str, float]) -> Array:
        """(P, M) Change of the readings (M,) by a standard deviation of each of P values."""
        rows = [(self.readings({**values, n: values[n] + STEP * sd}) - here) / STEP for n, sd in scales.items()]
        return np.array(rows).reshape(len(rows), len(here))


@dataclass(frozen=True)
class _Refit:
    """A hypothesis that is refitted to the readings of another.

    Attributes:
        planned: the recording.
        values: of the hypothesis.
        here: (M,) its readings.
        rows: (P, M) their slopes with respect to what may be refitted.
        scales: standard deviations of the P values.
    """

    planned: PlannedReadings
    values: Mapping[str, float]
    here: Array
    rows: Array
    scales: Mapping[str, float]

    def distance(self, truth: Array) -> Distance:
        """Distance from the readings (M,) of another hypothesis after the refit.

        Levenberg-Marquardt steps; Broyden's rank-one updates of the slopes spare most simulations.
        """
        z, damping, rows, here = np.zeros(len(self.rows)), DAMPING, self.rows.copy(), self.here
        cost = float((truth - here) @ (truth - here))
        for _ in range(REFITS):
            information = rows @ rows.T + np.eye(len(rows))
            step = np.linalg.solve(information + damping * np.diag(np.diag(information)), rows @ (truth - here) - z)
            trial = self.planned.readings({**self.values, **{
                n: clipped(n, self.values[n] + sd * x)
                for (n, sd), x in zip(self.scales.items(), z + step, strict=True)}})
            if not step.any():
                break
            rows += np.outer(step, trial - here - step @ rows) / float(step @ step)
            new = float((truth - trial) @ (truth - trial) + (z + step) @ (z + step))
            gained = cost - new
            if gained < 0.0:
                damping *= REJECTED
                continue
            z, here, cost, damping = z + step, trial, new, DAMPING_DOWN * damping
            if gained < ENOUGH_OF_COST * cost + ENOUGH:
                break
        channels = list(self.planned.shown)
        ends = np.cumsum([len(at) for at in self.planned.shown.values()])[:-1]
        parts = [float(x @ x) for x in np.split(truth - here, ends)]
        return math.sqrt(cost), channels[int(np.argmax(parts))]


def _noise(signals: Signals) -> dict[str, float]:
    """Channel -> standard deviation of a reading; for pulses that of a typical interval."""
    noise = dict(signals.sigma)
    if signals.pulses is not None and len(signals.pulses.sigma):
        noise["omega"] = float(np.median(signals.pulses.sigma))
    return noise


def _free(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Values that a hypothesis itself may refit, with their range: its effects, a parameter far off its nominal."""
    free = {}
    for name, value in values.items():
        k = key(name)
        if k.owner in DEFINED:
            effect, size = DEFINED[k.owner].parameters, DEFINED[k.owner].size
            if values[f"{k.owner}.{size}"] != effect[size].neutral:
                p = effect[k.name]
                free[name] = 3.0 * abs(p.default - p.neutral) or abs(p.default) or 1.0
        elif name in MODEL_NAMES and abs(value - model.model[name]) > 3.0 * NOMINAL_SD * abs(model.model[name]):
            free[name] = abs(value - model.model[name])
    return free


def _directly(model: Model, first: Named, second: Named) -> str:
    """What to measure directly where no signal helps."""
    texts = []
    for name, values in (first, second):
        effect, _, parameters = name.partition(":")
        parameter = parameters.partition("+")[0]
        if parameter:
            p, nominal = PARAMETERS[f"model.{parameter}"], model.model[parameter]
            unit = "" if p.unit == "-" else f" {p.unit}"
            near = abs(values[parameter] - nominal) / 3.0
            texts.append(f"measure {parameter} ({p.description}) directly to within {near:.2g}{unit}")
        elif effect != PARAMETER_MISMATCH:
            texts.append(f"look for {effect} directly ({DEFINED[effect].physics})")
    return " or ".join(texts) or "measure the parameters of the model directly"
