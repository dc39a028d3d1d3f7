# SPDX-License-Identifier: Apache-2.0
"""The strength of an effect: the RMS of its term over what was fitted.

The parameters of two forms of an effect are no measure of each other. The term is: a friction torque at the speeds that
occurred is the same quantity in every form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain import free_run
from aeropend_ident.diagnosis.chain.priors import model_parameters
from aeropend_ident.diagnosis.chain.values import STAGES
from aeropend_ident.diagnosis.document import Interval
from aeropend_ident.diagnosis.joint_fit import WIDER, JointFit
from aeropend_ident.diagnosis.search.findings import RankedHypothesis
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis
from aeropend_ident.diagnosis.search.selection import plausible
from aeropend_ident.estimation.map_fit import Fit, covariance_of
from aeropend_ident.estimation.parameter import key
from aeropend_ident.signals.statistics import Z95, rms
from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.effects import DEFINED, Effect
from aeropend_sim.model.parameters import Model
from aeropend_sim.model.terms import along

Array = NDArray[np.float64]

MOVES = 0.02
"""Share of the largest speed above which a part counts as moving (choice): dry friction at rest is what holds it."""

THROUGH = ("k0", "k1", "k2", "k3", "k_thrust")
"""Parameters of the model through which a term takes voltage or thrust."""

NUDGE = 0.1
"""Standard deviations by which a parameter is moved for a derivative (choice)."""


class Strengths:
    """The strengths of the effects of an augmented model.

    Args:
        joint: the joint fit; the quantities that terms take are those of its free run over the first recording.
    """

    def __init__(self, joint: JointFit) -> None:
        self.joint = joint
        self.signals = joint.chains.recordings[0].head(joint.chains.recordings[0].train)

    @cached_property
    def motion(self) -> tuple[dynamics.Trajectory, Model]:
        """The free run of the augmented model, and that model."""
        chains = self.joint.chains
        return free_run.motion(chains.model, self.signals, chains.values_of(self.joint.values, 0))

    def strength(self, effect: Effect, own: Mapping[str, float], numbers: Mapping[str, float]) -> float:
        """RMS of the term of an effect, in the unit of its place; of a dry friction where it moves."""
        parameters = {name: own.get(name, p.neutral) for name, p in effect.parameters.items()}
        run, model = self.motion
        n = {**model.numbers(), **numbers}
        term = along(effect.formula, parameters, len(self.signals), self.signals.period, effect.memory, effect.rate,
                     theta=run.theta, theta_dot=run.theta_dot, omega=run.omega, i_a=run.i_a,
                     v=np.asarray(actuator.voltage(n, self.signals.duty)),
                     thrust=np.asarray(actuator.thrust(n, run.omega)))
        if effect.sticks:
            speed = np.abs(run.omega if effect.place == "rotor" else run.theta_dot)
            term = term[speed > MOVES * speed.max()]
        return rms(term) if len(term) else 0.0

    def estimate(self, h: Hypothesis, f: Fit, values: Mapping[str, float], form: float) -> tuple[float, float]:
        """The strength of an effect, and its standard deviation.

        Args:
            h: the effect.
            f: fit that has its parameters.
            values: estimates of its parameters by name.
            form: relative error from another form.
        """
        effect, by = DEFINED[h.effect], {p.name: p for p in h.own}
        names = list(f.values)
        # thrust and voltage depend on parameters of the model; the motion is known from the readings
        by |= {p.name: p for stage in STAGES for p in model_parameters(self.joint.chains, stage)
               if p.name in THROUGH and p.name in f.values}
        covariance = covariance_of(f.information(f.ess))
        at = [names.index(name) for name in by]
        z = np.array([by[name].to_standard(values[name]) for name in by])

        def of(z: Array) -> float:
            now = {n: p.value(x) for (n, p), x in zip(by.items(), z, strict=True)}
            return self.strength(effect, {key(n).name: x for n, x in now.items() if n not in THROUGH},
                                 {n: x for n, x in now.items() if n in THROUGH})

        value, slope = of(z), np.zeros(len(z))
        for j in range(len(z)):
            step = NUDGE * math.sqrt(covariance[at[j], at[j]])
            moved = z.copy()
            moved[j] += step
            slope[j] = (of(moved) - value) / max(step, 1e-12)
        variance = float(slope @ covariance[np.ix_(at, at)] @ slope)
        return value, math.hypot(WIDER * math.sqrt(max(variance, 0.0)), form * value)

    def interval(self, ranked: RankedHypothesis, stage: str, form: float) -> Interval | None:
        """The strength of an effect found with a 95 % interval over all its forms that explain the recording.

        None if one of these is no formula.

        Args:
            ranked: the effect, with its forms.
            stage: in which it was found.
            form: relative error from another form that none of these is.
        """
        h = ranked.hypothesis
        others = plausible(ranked, stage)
        if h.parameter or not all(DEFINED[one.effect].formula for one in (h, *(r.hypothesis for r in others))):
            return None
        value, sd = self.estimate(h, self.joint.fit, self.joint.values, form)
        low, high = value - Z95 * sd, value + Z95 * sd
        for r in others:
            x, sd = self.estimate(r.hypothesis, r.fit, r.fit.values, form)
            low, high = min(low, x - Z95 * sd), max(high, x + Z95 * sd)
        return Interval(value, max(low, 0.0), high)

