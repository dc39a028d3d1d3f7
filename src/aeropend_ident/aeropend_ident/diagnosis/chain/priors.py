# SPDX-License-Identifier: Apache-2.0
"""What is fitted of the nominal model, with priors: numbers within their uncertainty, or as wide as rigs differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aeropend_ident.diagnosis.chain.chain import BLOCKS, Chains
from aeropend_ident.estimation.map_fit import Unknown
from aeropend_ident.signals.signals import STILL, Signals
from aeropend_sim.model import actuator
from aeropend_sim.model.parameters import PARAMETERS, Model

NUMBER_SD = 0.03
"""Relative standard deviation of a nominal number that is off by up to 5 %: the uniform distribution's."""

GUESS_SD = 0.55
"""Standard deviation of the logarithm of a number that is only a guess: a factor of three either way is two of it."""

ZERO = "angle_offset.bias"
"""The angle that is read where the arm hangs: of an arm that swings freely a number like any other."""

FILTER = "sensing.angle_filter_tau"

ARM = ("mgd_over_J", "c_over_J")
"""The numbers that an angle alone can fix."""

VARIES = ("mgd_over_J", "c_over_J", "L_over_J", ZERO)
"""What may differ between runs of one unknown rig: each run has its own, lest an effect stands in for the spread."""

SLOWEST = 0.015
"""s of each stage that an angle's filter may have without a word."""

HEAVIEST = 8.0
"""Voltage that the load takes over that of the back-EMF, at full duty, at most."""

QUICKEST = 0.015
"""s: a rotor that is quicker without load than this looks like one without inertia."""

STRAIGHT = 2.0
"""k3/k2 at most: the map from duty to voltage is as good as straight then."""

FIRST_LOOK = 0.08
"""s at the beginning that the arm's state is read from."""


def number_unknowns(chains: Chains, block: str) -> list[Unknown]:
    """The numbers of a block, and of those before it that nothing was measured behind, with their priors.

    A number that is nominally 0 stays 0.
    """
    if chains.fit_nominal and angle_only(chains.recordings):
        of_angle = _of_angle(chains.model, chains.recordings)
        return _of_each(of_angle, len(chains.each)) if block == "arm" else []
    unknowns = []
    blocks = [block]
    if block == "arm" and any(not s.has("omega") and not s.has("i_a") for _, s in chains.named()):
        blocks.append("motor")
    if "motor" in blocks and any(not s.has("v_a") for _, s in chains.named()):
        blocks.append("actuator")
    for name in (n for b in blocks for n in BLOCKS[b]):
        nominal, p = chains.model.model[name], PARAMETERS[f"model.{name}"]
        if nominal > 0.0 and chains.fit_nominal:
            unknowns.append(Unknown(name, nominal, GUESS_SD, max(p.low, 1e-12), p.high, log=True))
        elif nominal != 0.0:
            sd = (GUESS_SD if chains.fit_nominal else NUMBER_SD) * abs(nominal)
            unknowns.append(Unknown(name, nominal, sd, p.low, p.high))
    if not chains.fit_nominal:
        return unknowns
    if block == "arm":
        unknowns.append(_filter(chains.model))
    return _of_each(unknowns, len(chains.each))


def _filter(model: Model) -> Unknown:
    """The angle's filter, which nobody knows of an unknown rig; one that is slower than usual is an effect."""
    return Unknown(FILTER, model.sensing["angle_filter_tau"], 0.3 * SLOWEST, 0.0, SLOWEST)


def _of_each(unknowns: Sequence[Unknown], runs: int) -> list[Unknown]:
    """The unknowns, and those that may differ from run to run once for each run."""
    own = [replace(u, name=f"{u.name}@{k}") for u in unknowns if u.name in VARIES for k in range(1, runs)]
    return [*unknowns, *own]


def initial_unknowns(chains: Chains, block: str) -> list[Unknown]:
    """The state at the first sample of each recording, as far as a block needs it."""
    unknowns = []
    for suffix, s in chains.named():
        if block == "motor" and s.has("omega"):
            first = float(s.omega[np.isfinite(s.omega)][0])
            unknowns.append(Unknown(f"initial.omega{suffix}", first, 10.0, 0.0, 2000.0))
        if block == "arm" and chains.fit_nominal:
            unknowns += state_of_arm(chains.model, s, suffix)
        elif block == "arm":
            start = float(np.mean(s.theta[np.isfinite(s.theta)][:10]))
            unknowns += [Unknown(f"initial.theta{suffix}", start, 0.1), Unknown(f"initial.theta_dot{suffix}", 0.0, 1.0)]
    return unknowns


def nominal_unknowns(chains: Chains, block: str) -> list[Unknown]:
    """All that is fitted of the nominal model in a block: the states that it starts from, and its numbers."""
    return [*initial_unknowns(chains, block), *number_unknowns(chains, block)]


def free_swinging(recordings: Sequence[Signals]) -> bool:
    """Whether the arm is never driven in any of them."""
    return all(not s.driven for s in recordings)


def angle_only(recordings: Sequence[Signals]) -> bool:
    """Whether nothing but the angle, and perhaps the command, was measured in one of them."""
    return any(not (s.has("omega") or s.has("i_a") or s.has("v_a")) for s in recordings)


def basis(recordings: Sequence[Signals]) -> str:
    """What a nominal model can be identified from."""
    if free_swinging(recordings):
        return "the angle of an arm that swings freely"
    return "the angle and the command" if angle_only(recordings) else "the command and all that was measured"


def _of_angle(model: Model, recordings: Sequence[Signals]) -> list[Unknown]:
    """What the angle, with the command or without, can fix of the model; priors as wide as rigs differ."""
    m = model.model

    def log(name: str, sd: float) -> Unknown:
        p = PARAMETERS[f"model.{name}"]
        return Unknown(name, m[name], sd, max(p.low, 1e-12), p.high, log=True)

    arm = [log("mgd_over_J", 0.7), Unknown("c_over_J", m["c_over_J"], max(m["c_over_J"], 0.3), 0.0, 1e3)]
    if free_swinging(recordings):
        return [*arm, Unknown(ZERO, model.effects.get("angle_offset", {}).get("bias", 0.0), 0.3)]
    full = float(actuator.voltage(m, 1.0))
    heaviest = HEAVIEST * (1.0 + HEAVIEST) * m["K_e"] ** 2 * m["K_t"] / (m["R_a"] * full)
    quickest = max(QUICKEST, 0.6 * max(s.period for s in recordings)) * m["K_t"] * m["K_e"] / m["R_a"]
    return [*arm, log("L_over_J", 0.7), Unknown("k0", m["k0"], 0.5, -10.0, 10.0),
            replace(log("k3", 1.5), high=STRAIGHT * m["k2"]), replace(log("k_load", 1.0), high=heaviest),
            replace(log("J_m", 0.7), low=quickest), _filter(model)]


def state_of_arm(model: Model, s: Signals, suffix: str) -> list[Unknown]:
    """The state of the arm at the first sample, from a parabola through the first readings, and that of the rotor."""
    known = np.flatnonzero(np.isfinite(s.theta))
    first = known[:max(6, int(np.searchsorted(known, known[0] + FIRST_LOOK / s.period)))]
    t = first * s.period
    _, rate, angle = np.polyfit(t, s.theta[first], 2) if len(first) > 3 else (0.0, 0.0, float(s.theta[first[0]]))
    zero = model.effects.get("angle_offset", {}).get("bias", 0.0)
    found = [Unknown(f"initial.theta{suffix}", float(angle) - zero, 0.3),
             Unknown(f"initial.theta_dot{suffix}", float(rate), 5.0)]
    if s.driven and not s.has("omega") and float(s.duty[0]) >= STILL:
        n = model.numbers()  # an arm that hangs still when the record begins has a rotor that is about to start
        held = max(n["mgd_over_J"] * math.sin(float(angle) - zero), 0.0) / n["L_over_J"]
        speed = float(actuator.speed(n, held))
        found.append(Unknown(f"initial.omega{suffix}", speed, 50.0, 0.0, 5000.0))
    return found
