# SPDX-License-Identifier: Apache-2.0
"""The nominal model of a driven rig whose angle and command alone were recorded.

It holds what a careful person tries first: a static curve from duty to lift with a dead zone, the lag of the rotor,
viscous damping and the zero of the angle; and, where the log evidence is larger with them, dry friction, a transport
delay, a second lag, whose rise and fall may differ, and the exponent of the thrust. Duty and time are first brought to
units in which every rig resembles the same one, so that neither the scale of the duty nor that of time matters.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import (
    CHOSEN,
    FINDINGS,
    POWERS,
    REFERENCE_GRAVITY,
    held,
    nominal_parameters,
    refines,
    usual_size,
)
from aeropend_ident.diagnosis.chain.values import FILTER, absent_at, of_rig, states, with_values
from aeropend_ident.diagnosis.chain.weak_start import WeakForm, downsampled, likeliest
from aeropend_ident.diagnosis.document import Lift
from aeropend_ident.diagnosis.policy import UNCALIBRATED
from aeropend_ident.estimation.deadline import passed
from aeropend_ident.estimation.map_fit import POORER, Fit, fit
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import key
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model import actuator
from aeropend_sim.model.effects import DEFINED, THRUST_PIVOT_SPEED
from aeropend_sim.model.parameters import LONGEST_STEP, Model

Array = NDArray[np.float64]

OCTAVES = range(5, -6, -1)
"""Powers of 2 of the time scales that are tried (choice: arms that swing with periods of 0.03 to 35 s)."""

RESEMBLES = 1.0 / 3.0
"""Gravity, over that of the bench, from which a rig resembles the bench in a time scale (choice: within an octave)."""

HIDDEN = 2.0
"""Ratio of the gravity of a regression with dry friction to that of one without, above which the friction hid it.

Choice: below, both give about the same time scale, 1.4 times at most."""

LONGEST, SHORTEST = 16000, 200
"""Samples of a recording in a time scale that is tried, at most and at least (choice: time, and some swings)."""

NOTHING = 0.01
"""Size of a term, in default sizes, below which it is absent (choice: far below what matters)."""

FIRST_SIZE = 0.2
"""Size, in default sizes, of the other terms from which their fit starts (choice)."""

HORIZONS, FOLLOWED = (0.15, 0.3, 0.6, 1.0), (3, 3, 3, 1)
"""Parts of the fitted data over which a fit is made one after the other, and fits that are followed after each.

Choice: over a long horizon a poor start leads into a local minimum."""

SHORTEST_HORIZON = 3.0
"""[s] Shortest horizon for the arm of the bench (choice: some swings)."""

STEPS, ROUNDS = 8, 3
"""Steps and rounds of the fits (choice)."""

LAST_STEPS, LAST_ROUNDS = 4, 10
"""The same of the last fit, which goes on to its end (choice)."""

CURVE = 11
"""Points of the static curve from duty to lift that is reported (choice).

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

PLAIN = ("the nominal model was identified without dry friction, delay, second lag and the exponent of the thrust, to "
         "bound the time: with more --seconds they are tried")

LAGS = {"command_delay": "delay", "thrust_lag": "tau"}
"""Effects of `CHOSEN` that put the lift off, and their sizes: each may stand in for the other."""

POWER_OF = {"mgd_over_J": -2, "c_over_J": -1, "L_over_J": -2, "J_m": 1, "L_a": 1}
"""Parameter of the model -> power of time in its effect; those left out have none.

Derived: the motor's time constants are J_m R_a / (K_e K_t) and L_a / R_a."""


@dataclass(frozen=True)
class Units:
    """Factors on times and duties that make a rig resemble the bench's: period of the arm, largest duty 1."""

    time: float
    duty: float

    def of(self, s: Signals) -> Signals:
        """A recording in these units."""
        return replace(s, period=self.time * s.period, duty=self.duty * s.duty)

    def model(self, m: Model, *, back: bool = False) -> Model:
        """A model in these units, or back in SI units."""
        t, u = (1.0 / self.time, 1.0 / self.duty) if back else (self.time, self.duty)
        numbers = {n: v * t ** POWER_OF.get(n, 0) for n, v in m.model.items()}
        numbers["k2"] = m.model["k2"] / u
        tau = key(FILTER).name
        effects = {e: {n: v * t ** POWERS.get(DEFINED[e].parameters[n].unit, 0) for n, v in p.items()}
                   if e in DEFINED else dict(p) for e, p in m.effects.items()}
        return Model(m.name, numbers, {**m.sensing, tau: m.sensing[tau] * t}, effects)

    def state_back(self, values: Mapping[str, float]) -> dict[str, float]:
        """The initial states among values in these units, in SI units."""
        return {n: v * self.time if key(n).name == "theta_dot" else v for n, v in states(values).items()}


class Fitted(NamedTuple):
    """A nominal model with the fit in which its parameters ended."""

    model: Model
    fit: Fit


@dataclass(frozen=True)
class DrivenRig:
    """The nominal model of a rig.

    Attributes:
        model: as identified.
        plain: the best one without any of the terms of `CHOSEN`.
        state: initial states of the recordings, by name.
        notes: what the recordings do not tell.
    """

    model: Model
    plain: Model
    state: Mapping[str, float]
    notes: tuple[str, ...] = ()


def fit_driven_rig(model: Model, recordings: Sequence[Signals], deadline: float | None = None, jobs: int = 1
                   ) -> DrivenRig:
    """Identify the nominal model from angle and command.

    Args:
        model: gives what the recordings cannot determine.
        recordings: of one rig.
        deadline: [s] of `time.monotonic` after which no further term is looked for.
        jobs: processes.
    """
    units = units_of(model, recordings)
    begun = units.model(model)
    scaled = [downsampled(units.of(s), LONGEST_STEP) for s in recordings]
    search = _TermSearch(scaled, frozenset(model.effects), deadline, jobs)
    full, plain = search.with_every_term(begun)
    chosen = None if full is None else search.simplified(full)
    best = chosen or plain
    begun = units.model(best.model, back=True)
    found, f = _fitted(begun, recordings, LAST_ROUNDS, LAST_STEPS, deadline)
    if f.mean_square > POORER * best.fit.mean_square and not passed(deadline):  # an arm that sticks at once stays so
        state = units.state_back(best.fit.values)
        found, f = min((found, f), _fitted(begun, recordings, LAST_ROUNDS, LAST_STEPS, deadline, state),
                       key=lambda one: one[1].mean_square)
    if chosen is None:
        return DrivenRig(found, found, states(f.values), (PLAIN,))
    notes = () if passed(deadline) else search.delay_or_lag(chosen)
    return DrivenRig(found, _rescaled(units.model(plain.model, back=True), found), states(f.values), notes)


def _rescaled(plain: Model, found: Model) -> Model:
    """A model with the voltage scale of another: only products of that scale with other parameters act."""
    a = found.model["k1"] / plain.model["k1"]
    n = plain.model
    return replace(plain, model={**n, "k1": a * n["k1"], "k0": a * n["k0"], "k_load": n["k_load"] / a,
                                 "L_over_J": n["L_over_J"] / a**2})


def without_findings(rig: DrivenRig, given: Model, recordings: Sequence[Signals], material: float
                     ) -> tuple[Model, dict[str, float]]:
    """The nominal model without dry friction, which is a finding as it is in a free decay, and the size that it has.

    Dry friction that does not bring the model closer to the unseen part is no finding, but stays part of the model.

    Args:
        rig: as identified.
        given: the model before; what it holds is known to be there.
        recordings: of the rig.
        material: share of the squared gap from which an effect is a finding.
    """
    model = rig.model
    names = [e for e in FINDINGS if e in model.effects and e not in given.effects]
    fewer = model.with_effects({e: p for e, p in model.effects.items() if e not in names})
    if not names or _unseen(model, recordings, rig.state) > (1.0 - material) * _unseen(fewer, recordings, rig.state):
        return model, {}
    return fewer, {f"{e}.{n}": v for e in names for n, v in model.effects[e].items()}


def _unseen(model: Model, recordings: Sequence[Signals], state: Mapping[str, float]) -> float:
    """Sum of squares, in units of a reading's noise, of free runs over the parts that nothing was fitted to."""
    values = fit_own(model, recordings, state=state).values
    chains = CutChains(model, recordings, UNCALIBRATED)
    total = 0.0
    for k, (chain, s) in enumerate(zip(chains.each, recordings, strict=True)):
        off = (chain.arm(chains.values_of(values, k)) - s.theta)[s.train:] / s.sigma["theta"]
        total += float(np.nansum(off**2))
    return total


def units_of(model: Model, recordings: Sequence[Signals]) -> Units:
    """The units of a rig, from gravity by the weak form at the fastest time scale that resembles the bench's.

    On a faster scale noise hides gravity, and it is found too small; on a slower one the arm only follows its duty. Dry
    friction hides it too: a regression with friction counts if it gives `HIDDEN` times as much.
    """
    duty = 1.0 / max(s.largest_duty for s in recordings)
    found = []
    for octave in OCTAVES:
        units = Units(2.0**octave, duty)
        tried = [downsampled(units.of(s)) for s in recordings]
        if not SHORTEST <= sum(map(len, tried)) <= LONGEST:
            continue
        smooth, rubbing = (starts[0].model.model["mgd_over_J"] if starts else 0.0
                           for starts in likeliest(model, tried, [WeakForm(s) for s in tried], few=True))
        gravity = (rubbing if rubbing > HIDDEN * smooth else smooth) / REFERENCE_GRAVITY
        if gravity > 0.0:
            units = replace(units, time=units.time * math.sqrt(gravity))
            if gravity >= RESEMBLES:
                return units
            found.append((-gravity, units.time))
    return Units(min(found)[1] if found else 1.0, duty)


def _usual(name: str, m: Model) -> float:
    """By how much a term usually differs from the value at which it is absent."""
    return 1.0 if refines(name) else usual_size(key(name).owner, m) - absent_at(name)


@dataclass(frozen=True)
class _TermSearch:
    """The search for the terms of the nominal model.

    Attributes:
        recordings: of one rig, in its `Units`.
        keep: ids of effects that the model holds in any case.
        deadline: [s] of `time.monotonic` after which no further term is looked for.
        jobs: processes.
    """

    recordings: Sequence[Signals]
    keep: frozenset[str]
    deadline: float | None
    jobs: int

    def with_every_term(self, model: Model) -> tuple[Fitted | None, Fitted]:
        """The best fit with every term, None if there is no time for it; and the best one without any.

        Fits start from each lag, with and without dry friction, and hold every term from the shortest horizon on: for a
        term that comes later the static curve already stands in.
        """
        coarse = [downsampled(s) for s in self.recordings]
        tests = [WeakForm(s) for s in coarse]
        kinds = (False, True) if "coulomb_friction" not in self.keep else (False,)
        best = [list({s.lag: s.model for s in reversed(found)}.values())
                for found in likeliest(model, coarse, tests, kinds=kinds)]
        begun = self._over_growing_horizons(best[0]).model if best[0] else model
        plain = self._fitted(begun)
        if passed(self.deadline):
            return None, plain
        grown = self._over_growing_horizons([self._completed(m) for m in itertools.chain([begun], *best)]).model
        starts = [grown, self._completed(plain.model, NOTHING)]  # the second one does not end worse than without terms
        most = min(parallel(self.jobs, self._fitted, starts), key=lambda one: one.fit.mean_square)
        return None if passed(self.deadline) else most, plain

    def _completed(self, m: Model, size: float = FIRST_SIZE) -> Model:
        """A model with the terms that it lacks, at a size in default sizes."""
        there = held(m)
        lacking = [n for n in CHOSEN if n not in there and key(n).owner not in self.keep]
        return with_values(m, {n: absent_at(n) + size * _usual(n, m) for n in lacking})

    def _over_growing_horizons(self, models: Sequence[Model]) -> Fitted:
        """The best of some starts after fits over the beginning, then over more and more, while there is time."""
        least = round(SHORTEST_HORIZON / self.recordings[0].period)
        fits: list[Fitted] = []
        for share, many in zip(HORIZONS, FOLLOWED, strict=True):
            if fits and passed(self.deadline):
                break
            part = [replace(s, train=min(max(round(share * s.train), least), s.train)) for s in self.recordings]
            fitted = partial(_fitted, recordings=part, rounds=2, steps=STEPS, deadline=self.deadline)
            fits = sorted(parallel(self.jobs, fitted, models), key=lambda one: one.fit.mean_square)
            models = [one.model for one in fits[:many]]
        return fits[0]

    def simplified(self, best: Fitted) -> Fitted | None:
        """Take out the terms without which the log evidence is larger, the least needed first; None: no time."""
        while not passed(self.deadline):
            terms = [name for name in held(best.model) if key(name).owner not in self.keep]
            gone = [name for name in terms if _absent(best, name)]
            fewer = parallel(self.jobs, partial(self._without, best), gone[:1] or terms)
            simpler = max(fewer, key=lambda one: one.fit.evidence_over(best.fit), default=None)
            if simpler is None or (simpler.fit.evidence_over(best.fit) < 0.0 and not gone):
                return best
            best = simpler
        return None

    def delay_or_lag(self, best: Fitted) -> tuple[str, ...]:
        """A note if the recordings do not tell whether a transport delay or a second lag puts the lift off."""
        here = [e for e in LAGS if e in best.model.effects]
        if len(here) != 1 or here[0] in self.keep:
            return ()
        (other,) = (e for e in LAGS if e not in here)
        effects = {e: p for e, p in best.model.effects.items() if e not in here}
        as_long = {LAGS[other]: best.model.effect(here[0], LAGS[here[0]])}
        f = fit_own(best.model.with_effects({**effects, other: as_long}), self.recordings, ROUNDS, STEPS)
        if expit(f.evidence_over(best.fit)) < UNCALIBRATED.undecided:
            return ()
        said = (f"the recordings do not tell {here[0]}, which the identified model holds, from {other}: in its place "
                "that explains the angle about as well; steps of the command tell them apart best")
        return (said,)

    def _without(self, one: Fitted, name: str) -> Fitted:
        k = key(name)
        effects = {e: p for e, p in one.model.effects.items() if e != k.owner or DEFINED[e].size != k.name}
        if k.owner in effects:
            effects[k.owner] = {**effects[k.owner], k.name: absent_at(name)}
        return self._fitted(one.model.with_effects(effects))

    def _fitted(self, model: Model) -> Fitted:
        return _fitted(model, self.recordings, ROUNDS, STEPS, self.deadline)


def _absent(one: Fitted, name: str) -> bool:
    """Whether a term has ended at the size at which it is absent."""
    size = one.model.effect(key(name).owner, key(name).name)
    return abs(size - absent_at(name)) < NOTHING * abs(_usual(name, one.model))


def _fitted(model: Model, recordings: Sequence[Signals], rounds: int, steps: int, deadline: float | None = None,
            state: Mapping[str, float] | None = None) -> Fitted:
    f = fit_own(model, recordings, rounds, steps, deadline, state)
    return Fitted(with_values(model, of_rig(f.values)), f)


def fit_own(model: Model, recordings: Sequence[Signals], rounds: int = LAST_ROUNDS, steps: int = LAST_STEPS,
            deadline: float | None = None, state: Mapping[str, float] | None = None) -> Fit:
    """Fit the parameters of a nominal model, with those of the effects that it holds, from initial states."""
    chains = CutChains(model, recordings, UNCALIBRATED)
    chains.state = state or {}
    return fit(chains.residuals("arm"), nominal_parameters(chains, "arm"), rounds, steps, UNCALIBRATED.least_ess,
               deadline)


def lift(model: Model, recordings: Sequence[Signals]) -> Lift:
    """The static lift of a duty and its lag: all that command and angle alone show of map, motor and thrust.

    Args:
        model: the identified model.
        recordings: give the largest duty.
    """
    n = model.numbers()
    duty = np.linspace(0.0, max(s.largest_duty for s in recordings), CURVE)
    speed = actuator.speed_at(n, actuator.voltage(n, duty))
    middle = float(speed[CURVE // 2])
    pivot = THRUST_PIVOT_SPEED
    thrust = n["k_thrust"] * pivot**2 * (np.maximum(speed, 0.0) / pivot) ** model.effect("thrust_exponent", "n")
    return Lift(duty=tuple(duty.tolist()), rad_per_s2=tuple((n["L_over_J"] * thrust).tolist()),
                dead_zone=max(((n["k0"] / n["k1"]) ** 2 - n["k3"]) / n["k2"], 0.0) if n["k0"] < 0.0 else 0.0,
                lag_s=n["J_m"] / (n["K_t"] * n["K_e"] / n["R_a"] + 2.0 * n["k_load"] * middle))
