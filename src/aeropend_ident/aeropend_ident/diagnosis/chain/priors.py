# SPDX-License-Identifier: Apache-2.0
"""The parameters of the nominal model that are fitted along, and their priors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aeropend_ident.diagnosis.chain.chain import DELAY, CutChains
from aeropend_ident.diagnosis.chain.values import AT_REST, FILTER, STAGES, absent_at, at_rest, limits
from aeropend_ident.diagnosis.policy import angle_only, free_swinging
from aeropend_ident.estimation.parameter import Parameter, key, started
from aeropend_ident.signals.signals import STILL, Signals
from aeropend_sim.model import actuator
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.parameters import PARAMETERS, Model

NOMINAL_SD = 0.03
"""Relative standard deviation of a calibrated parameter.

Derived: that of a uniform distribution over ±5 %, 0.05/√3."""

TOLERANCE = math.sqrt(3.0)
"""Standard deviations of a calibrated parameter in its tolerance (derived: a uniform distribution)."""

CHAIN_SD = 0.06
"""Relative standard deviation of the time constant of the angle's filter.

Derived: that of a uniform distribution over ±10 %, 0.1/√3. Usual resistors and capacitors have such tolerances."""

OUTSIDE = 3.0
"""Standard deviations of its prior up to which a calibrated parameter is fitted (convention: 99.7 %).

A parameter further off is an effect of its own, `parameter_mismatch`; it must not stand in for another one."""

UNCALIBRATED_SD = 0.55
"""Standard deviation of the logarithm of an uncalibrated parameter.

Derived: a factor of three is two standard deviations, ln(3)/2."""

ZERO = "angle_offset.bias"
"""The angle that is read while the arm hangs; for a free decay a parameter like any other."""

OF_THE_ARM = ("mgd_over_J", "c_over_J")
"""The parameters that an angle alone can determine."""

OWN_OF_RECORDING = ("mgd_over_J", "c_over_J", "L_over_J", ZERO)
"""Parameters that each recording of an uncalibrated rig has of its own.

A rig changes between recordings; one shared value would let an effect explain that change."""

SLOWEST = 0.015
"""[s] Longest time constant of a stage of the angle's filter that is no effect (choice: usual encoder filters).

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

HEAVIEST = 8.0
"""Largest ratio of the voltages for load and back-EMF at full duty (choice: propellers have 0.1 to 4).

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

QUICKEST = 0.015
"""[s] Shortest time constant of the rotor without load.

Choice: at 60 Hz a shorter one looks like none.

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

POWERS = {"s": 1, "1/s": -1, "rad/s": -1, "rad/s²": -2, "1/s²": -2}
"""Unit -> power of time in it (derived)."""

LEAST_VOLTAGE = 1e-3
"""[V] Voltage at the largest duty that a bound of the load is computed for at least (choice: far below any)."""

STRAIGHT = 30.0
"""Largest ratio k3/k2 (derived: the formula for the voltage is then straight to k2/(16 k3), 0.2 % of its range)."""

REFERENCE_GRAVITY = 33.8
"""[1/s²] `mgd_over_J` of the rig for which the catalogue's default sizes matter (convention: config/bench.yaml)."""

CHOSEN = (ZERO, "coulomb_friction.accel", "command_delay.delay", "thrust_lag.tau", "thrust_lag.fall",
          "thrust_exponent.n")
"""Parameters of effects that the nominal model of a rig with angle and command alone is identified with if needed."""

RATIO_SD = 0.7
"""Standard deviation of the logarithm of a ratio that refines an effect, whose neutral value is 1.

Derived: a factor of four is two standard deviations, ln(4)/2."""

FINDINGS = ("coulomb_friction",)
"""Effects that are identified with the nominal model but reported as missing in it (choice: as in a free decay)."""

DAMPING_RATIO, DAMPING_SD = 0.05, math.log(10.0) / 1.96
"""Median of the damping ratio of an arm, and standard deviation of its logarithm (choice: 95 % within a factor of ten).

No arm swings for ever. Without such a prior a disturbance that a controller answers makes the damping 0."""

REVERSE_SD = 0.3
"""Standard deviation of the share of the voltage that an uncalibrated bridge gives in reverse (choice: about alike)."""

SIZE_SD = 3.0
"""Standard deviation of an effect's size, in default sizes: rigs may show several times the default (choice).

Measured: ×0.7 changes 1 of 25 verdicts, ×1.3 none (docs/results/thresholds.md)."""

FIRST_READINGS = 0.08
"""[s] Time at the beginning from which the arm's initial state is estimated (choice)."""


def model_parameters(chains: CutChains, stage: str) -> list[Parameter]:
    """The parameters of a stage, and of the stages before it if no signal was measured between them.

    A parameter that is nominally 0 stays 0.
    """
    calibrated, recordings = chains.policy.calibrated, chains.recordings
    if not calibrated and angle_only(recordings):
        own = _of_each(_of_angle(chains.model, recordings), len(recordings)) if stage == "arm" else []
        return [_as_it_hangs(p, chains.model, recordings) for p in own]
    parameters = []
    stages = [stage]
    if stage == "arm" and any(not s.has("omega") and not s.has("i_a") for s in recordings):
        stages.append("motor")
    if "motor" in stages and any(not s.has("v_a") for s in recordings):
        stages.append("actuator")
    if chains.known is not None:
        return chains.known.parameters(stages, OUTSIDE)
    for name in (n for b in stages for n in STAGES[b]):
        nominal, p = chains.model.model[name], limits(name)
        if nominal != 0.0 and not calibrated:
            parameters.append(_unknown(name, nominal))
        elif nominal != 0.0:
            sd = NOMINAL_SD * abs(nominal)
            reach = OUTSIDE * sd
            parameters.append(Parameter(name, nominal, sd, max(p.low, nominal - reach), min(p.high, nominal + reach)))
    if calibrated:
        tau = chains.model.sensing[key(FILTER).name]
        if stage == "arm" and tau > 0.0:
            reach = OUTSIDE * CHAIN_SD * tau
            parameters.append(Parameter(FILTER, tau, CHAIN_SD * tau, tau - reach, tau + reach))
        return [own for p in parameters for own in _of_variants(p, recordings)]
    if stage == "arm":
        parameters.append(_filter(chains.model))
    return _of_each(parameters, len(recordings))


def _of_variants(p: Parameter, recordings: Sequence[Signals]) -> list[Parameter]:
    """A calibrated parameter, and one for each recording of a variant that does not know it."""
    unknown = [p.name in s.variant.unknown for s in recordings]
    if not any(unknown):
        return [p]
    own = [k for k in range(1, len(recordings)) if unknown[k] or unknown[0]]
    return [replace(_unknown(p.name, p.mean) if unknown[k] else p, name=key(p.name).of(k)) for k in (0, *own)]


def _unknown(name: str, nominal: float) -> Parameter:
    """A parameter of the model that is known to a factor of three at best."""
    p = limits(name)
    if nominal > 0.0:
        return Parameter(name, nominal, UNCALIBRATED_SD, max(p.low, 1e-12), p.high, log=True)
    return Parameter(name, nominal, UNCALIBRATED_SD * abs(nominal), p.low, p.high)


def nominal_sd(chains: CutChains, name: str) -> float:
    """Standard deviation to which a parameter of a calibrated rig is known."""
    if chains.known is not None:
        return chains.known.sd(name)
    return NOMINAL_SD * abs(chains.model.model[name]) if name in chains.model.model else 0.0


def _filter(model: Model) -> Parameter:
    """The angle's filter of an uncalibrated rig; a filter beyond its bound is an effect."""
    return Parameter(FILTER, model.sensing["angle_filter_tau"], 0.3 * SLOWEST, 0.0, SLOWEST)


def _of_each(parameters: Sequence[Parameter], recordings: int) -> list[Parameter]:
    """The parameters, and those of `OWN_OF_RECORDING` once for each further recording."""
    own = [replace(p, name=key(p.name).of(k)) for p in parameters if p.name in OWN_OF_RECORDING
           for k in range(1, recordings)]
    return [*parameters, *own]


def initial_states(chains: CutChains, stage: str) -> list[Parameter]:
    """The state at the first sample of each recording, as far as a stage needs it."""
    parameters = []
    for k, s in enumerate(chains.recordings):
        if stage == "motor" and s.has("omega"):
            first = float(s.omega[np.isfinite(s.omega)][0])
            parameters.append(Parameter(_initial("omega", k), first, 10.0, 0.0, 2000.0))
        if stage == "arm" and not chains.policy.calibrated:
            parameters += state_of_arm(chains.model, s, k)
        elif stage == "arm":
            start = float(np.mean(s.theta[np.isfinite(s.theta)][:10]))
            parameters += [Parameter(_initial("theta", k), start, 0.1), Parameter(_initial("theta_dot", k), 0.0, 1.0)]
    return started(parameters, chains.state)


def _initial(state: str, recording: int) -> str:
    return key(f"initial.{state}").of(recording)


def nominal_parameters(chains: CutChains, stage: str) -> list[Parameter]:
    """All that is fitted of the nominal model in a stage: initial states and parameters."""
    return [*initial_states(chains, stage), *model_parameters(chains, stage)]


def basis(recordings: Sequence[Signals]) -> str:
    """The signals that a nominal model can be identified from, in words."""
    if free_swinging(recordings):
        return "the angle of an arm that swings freely"
    return "the angle and the command" if angle_only(recordings) else "the command and all that was measured"


def _of_angle(model: Model, recordings: Sequence[Signals]) -> list[Parameter]:
    """The parameters that the angle can determine, with the command or without; wide priors."""
    m = model.model

    def log(name: str, sd: float) -> Parameter:
        p = PARAMETERS[f"model.{name}"]
        return Parameter(name, m[name], sd, max(p.low, 1e-12), p.high, log=True)

    slower = slowness(model)
    damping = 2.0 * DAMPING_RATIO * math.sqrt(m["mgd_over_J"])
    arm = [log("mgd_over_J", 0.7),
           Parameter("c_over_J", damping, DAMPING_SD, 1e-12, 1e3, max(m["c_over_J"], 1e-12), log=True)]
    if free_swinging(recordings):
        return [*arm, Parameter(ZERO, model.effect("angle_offset", "bias"), 0.3)]
    own = [_of_effect(name, model) for name in held(model)]
    full = max(float(actuator.voltage(m, max(s.largest_duty for s in recordings))), LEAST_VOLTAGE)
    heaviest = HEAVIEST * (1.0 + HEAVIEST) * m["K_e"] ** 2 * m["K_t"] / (m["R_a"] * full)
    quickest = max(QUICKEST * slower, 0.6 * max(s.period for s in recordings)) * m["K_t"] * m["K_e"] / m["R_a"]
    reverse = [Parameter("reverse", m["reverse"], REVERSE_SD, 0.0, 1.0)] if m["reverse"] > 0.0 else []
    return [*arm, *reverse, log("L_over_J", 0.7), Parameter(AT_REST, min(at_rest(model), 0.0), 0.5, -10.0, 0.0),
            replace(log("k3", 1.5), high=STRAIGHT * m["k2"]), replace(log("k_load", 1.0), high=heaviest),
            replace(log("J_m", 0.7), low=quickest), _filter(model), *own]


def absent(parameters: Sequence[Parameter]) -> dict[str, float]:
    """The sizes at which effects among the parameters are absent, by name."""
    return {key(p.name).plain: absent_at(p.name) for p in parameters if key(p.name).owner in DEFINED}


def held(model: Model) -> list[str]:
    """The parameters of `CHOSEN` that a nominal model holds."""
    return [name for name in CHOSEN if key(name).owner in model.effects
            and not (refines(name) and model.effect(key(name).owner, key(name).name) == absent_at(name))]


def refines(name: str) -> bool:
    """Whether a parameter of an effect refines it."""
    return DEFINED[key(name).owner].parameters[key(name).name].refines


def _of_effect(name: str, model: Model) -> Parameter:
    """The size of an effect that the nominal model holds, or what refines it; the prior draws it to its absence."""
    size, start = DEFINED[key(name).owner].parameters[key(name).name], model.effect(key(name).owner, key(name).name)
    if size.refines:
        return Parameter(name, size.neutral, RATIO_SD, size.low, size.high, start, log=True)
    spread = SIZE_SD * abs(usual_size(key(name).owner, model) - size.neutral)
    return Parameter(name, size.neutral, spread, 0.0 if name == DELAY else size.low, size.high, start)


def _as_it_hangs(p: Parameter, model: Model, recordings: Sequence[Signals]) -> Parameter:
    """The zero of the angle, with what the reading of an arm that hangs tells: dry friction may hold it beside."""
    rest = recordings[key(p.name).recording].hanging if key(p.name).plain == ZERO else None
    if rest is None:
        return p
    held = SIZE_SD * usual_size("coulomb_friction", model) / model.model["mgd_over_J"]
    return replace(p, mean=rest, sd=held, start=p.begin)


def slowness(model: Model) -> float:
    """How many times slower the arm swings than that of the bench."""
    return math.sqrt(REFERENCE_GRAVITY / max(model.model["mgd_over_J"], 1e-6))


def usual_size(id_: str, model: Model) -> float:
    """The size of an effect that matters on a rig: the catalogue's default, in the rig's own units.

    Args:
        id_: of the effect.
        model: the nominal model of the rig.
    """
    size = DEFINED[id_].parameters[DEFINED[id_].size]
    return size.neutral + (size.default - size.neutral) * slowness(model) ** POWERS.get(size.unit, 0)


def state_of_arm(model: Model, s: Signals, recording: int = 0) -> list[Parameter]:
    """The initial state of the arm, from a parabola through the first readings, and of a rotor that is not measured.

    Args:
        model: gives the zero of the angle, and the motor.
        s: the recording.
        recording: its number.
    """
    known = np.flatnonzero(np.isfinite(s.theta))
    if not len(known) or known[0] * s.period > FIRST_READINGS:  # an arm that was not read yet is taken to hang
        return [Parameter(_initial(name, recording), 0.0, sd) for name, sd in (("theta", 0.3), ("theta_dot", 5.0))]
    first = known[:max(6, int(np.searchsorted(known, known[0] + FIRST_READINGS / s.period)))]
    t = first * s.period
    _, rate, angle = np.polyfit(t, s.theta[first], 2) if len(first) > 3 else (0.0, 0.0, float(s.theta[first[0]]))
    zero = model.effect("angle_offset", "bias")
    found = [Parameter(_initial("theta", recording), float(angle) - zero, 0.3),
             Parameter(_initial("theta_dot", recording), float(rate), 5.0)]
    if s.driven and not s.has("omega") and abs(float(s.duty[0])) >= STILL:
        n = model.numbers()  # thrust holds the arm at its first angle; for an arm that hangs the rotor still stands
        held = max(n["mgd_over_J"] * math.sin(float(angle) - zero), 0.0) / n["L_over_J"]
        speed = float(actuator.speed(n, held))
        found.append(Parameter(_initial("omega", recording), speed, 50.0, 0.0, 5000.0))
    return found
