# SPDX-License-Identifier: Apache-2.0
"""The nominal model of an uncalibrated rig, identified from its recordings.

The channels decide which parameters are free:

- Angle alone, of an arm that swings freely: gravity, viscous damping and the zero of the angle. The search starts from
  the turning points.
- Angle and command: a static curve from duty to lift, with a dead zone and a curvature, behind one lag. The map
  and the motor of the model file express it; only the parameters that the angle can determine are free. The search
  starts from a linear regression of the weak form: the equation of motion times a test function, integrated by parts,
  so that no reading is differentiated. There is one regression for each curve and lag of a grid.
- Speed, current or voltage too: every parameter of the model file, stage by stage.

Then the readings are fitted, first over the beginning of the recordings, then over growing horizons.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.diagnosis.chain.chain import SHORTEST_STEP, CutChain, CutChains
from aeropend_ident.diagnosis.chain.driven_rig import fit_driven_rig
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.chain.values import STAGES, of_rig
from aeropend_ident.diagnosis.chain.weak_start import (
    BENDS,
    DEAD_ZONES,
    LAGS,
    LOADS,
    WeakForm,
    curve,
    downsampled,
    regress,
    rotor_speed,
)
from aeropend_ident.diagnosis.policy import Policy, angle_only, policy_of
from aeropend_ident.estimation.map_fit import Fit, fit
from aeropend_ident.signals.free_decay import turning_points
from aeropend_ident.signals.noise import resolution
from aeropend_ident.signals.signals import Signals
from aeropend_ident.signals.smoothing import block_mean
from aeropend_sim.model import dynamics
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.parameters import DUTY_MAP, Model
from aeropend_sim.model.state import State

Array = NDArray[np.float64]

HORIZONS = (0.15, 0.35, 1.0)
"""Parts of the training data over which a fit is made one after the other (choice)."""

SHORTEST_HORIZON = 3.0
"""[s] Shortest horizon: some swings of the arm (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

ROUNDS = 4
"""Rounds of the fits over each horizon; the last fit of a search has more (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

WIDER = 2.0
"""Factor on the standard deviations of the priors while a nominal model is searched (choice)."""

WINDING_SETTLES = 0.1
"""[s] Blocks over which voltage, current and speed are averaged for a start.

Choice: longer than any winding's L_a/R_a."""

SCATTER, MINIMUM_FREEDOM = 1.3, 30
"""Ratio of the scatter around a smooth swing to a reading's noise above which it counts as the noise, and the degrees
of freedom needed (choice).

Measured: at ±30 % no verdict of 2 recordings changes (docs/results/thresholds.md)."""

def fit_nominal_model(model: Model, recordings: Sequence[Signals], deadline: float | None = None
                      ) -> tuple[Model, list[Signals]]:
    """Identify the nominal model, with as many free parameters as the channels allow.

    Args:
        model: gives what the recordings cannot determine.
        recordings: of one rig.
        deadline: [s] of `time.monotonic` after which fits end with their next step.

    Returns:
        The model, and the recordings with their noise as estimated from the fit.
    """
    name = f"{model.name}, identified"
    policy = policy_of(recordings, fit_nominal=True)
    if not policy.driven:
        found, f = _over_growing_horizons(_start_of_decay(model, recordings), recordings, deadline)
        chains = CutChains(found, recordings, policy)
        noisier = [_with_local_noise(chain, chains.values_of(f.values, k)) for k, chain in enumerate(chains.each)]
        return replace(found, name=name), noisier
    if angle_only(recordings):
        rig = fit_driven_rig(model, recordings, deadline)
        return replace(rig.model, name=name), [s.noted(*rig.notes) for s in recordings]
    return replace(_stage_by_stage(model, recordings, policy, deadline), name=name), list(recordings)


def _stage_by_stage(model: Model, recordings: Sequence[Signals], policy: Policy, deadline: float | None) -> Model:
    """The nominal model of a rig with more channels than the angle: each stage from its measured input."""
    chains = CutChains(model, recordings, policy)
    for stage in STAGES:
        if stage == "motor":
            chains = _cut_again(chains, _possible(_start_of_motor(chains), chains.recordings))
        elif stage == "arm":
            chains = _cut_again(chains, _start_of_arm(chains))
        chains, f = _likelier([chains, *_without_losses(chains)] if stage == "actuator" else [chains], stage,
                             deadline)
        if f.residuals:
            chains = _cut_again(chains, _possible(chains.each[0].valued(of_rig(f.values)), chains.recordings))
    return chains.model


def _possible(model: Model, recordings: Sequence[Signals]) -> Model:
    """The model, if it is that of a motor.

    Raises:
        RecordingError: no motor is so fast.
    """
    if any(prepare(model, s.period)[0].h < SHORTEST_STEP for s in recordings):
        raise RecordingError("no motor has the speed, current and voltage that were read: check their units, and that "
                             "no column stands for another (doctor); no verdict is possible")
    return model


def _likelier(tried: Sequence[CutChains], stage: str, deadline: float | None) -> tuple[CutChains, Fit]:
    """The chains with the largest evidence in a stage, and their fit."""
    fits = [fit(c.residuals(stage), [replace(p, sd=WIDER * p.sd) for p in nominal_parameters(c, stage)],
                deadline=deadline) for c in tried]
    return max(zip(tried, fits, strict=True), key=lambda pair: pair[1].log_evidence(fits[0].ess))


def _without_losses(chains: CutChains) -> list[CutChains]:
    """The same with a bridge without losses, if the voltage was measured."""
    known = [np.isfinite(s.v_a) for s in chains.recordings]
    duty = np.concatenate([np.abs(s.duty[k]) for s, k in zip(chains.recordings, known, strict=True)])
    v = np.concatenate([np.abs(s.v_a[k]) for s, k in zip(chains.recordings, known, strict=True)])
    full = float(duty @ v) / max(float(duty @ duty), 1e-12)
    if full <= 0.0:
        return []
    numbers = {**chains.model.model, **dict.fromkeys(DUTY_MAP, 0.0), "v_full": full}
    return [_cut_again(chains, replace(chains.model, model=numbers))]


def _cut_again(chains: CutChains, model: Model) -> CutChains:
    """The chains cut again under another model."""
    again = CutChains(model, chains.recordings, chains.policy)
    again.set_next_input("actuator", {})
    again.set_next_input("motor", {})
    return again


def _start_of_motor(chains: CutChains) -> Model:
    """Start values of the motor's parameters."""
    model, recordings = chains.model, chains.recordings
    n = dict(model.model)
    if all(s.has("v_a") and s.has("i_a") and s.has("omega") for s in recordings):
        # v = R i + K_e ω; the voltage of the inductance averages out
        rows = [np.column_stack([block_mean(x, max(1, round(WINDING_SETTLES / s.period)))
                                 for x in (s.v_a, s.i_a, s.true_speed)]) for s in recordings]
        v, i, w = np.concatenate(rows).T
        known = np.isfinite(v) & np.isfinite(i) & np.isfinite(w) & (w > 0.0)
        if known.sum() > 20:
            a = np.column_stack([i[known], w[known]])
            (resistance, back), *_ = np.linalg.lstsq(a, v[known], rcond=None)
            if resistance > 0.0 and back > 0.0:
                n["R_a"], n["K_e"], n["K_t"] = float(resistance), float(back), float(back)
                n["k_load"] = max(float(back * (i[known] @ w[known] ** 2) / np.sum(w[known] ** 4)), 1e-12)
                n["J_m"] = _best_inertia(replace(model, model=n), recordings)
        return replace(model, model=n)
    if any(s.has("v_a") for s in recordings) or not all(s.has("omega") for s in recordings):
        return model
    found = []
    for dead, bend, load, lag in product(DEAD_ZONES, BENDS, LOADS, LAGS[:3]):
        numbers = curve(n, dead, bend, load, lag)
        squares, scale = 0.0, []
        for s in recordings:
            w, seen = rotor_speed(replace(model, model=numbers), s), s.true_speed
            known = np.isfinite(seen)
            scale.append(float(w[known] @ seen[known]) / max(float(w[known] @ w[known]), 1e-12))
            squares += float(np.sum((seen[known] - scale[-1] * w[known]) ** 2))
        size = float(np.mean(scale))
        if size > 0.0:  # another speed at the same voltage is a motor of another constant
            found.append((squares, {**numbers, "K_e": numbers["K_e"] / size, "K_t": numbers["K_t"] / size,
                                    "k_load": numbers["k_load"] / size**3, "J_m": numbers["J_m"] / size**2}))
    return replace(model, model=min(found, key=lambda item: item[0])[1]) if found else model


def _best_inertia(model: Model, recordings: Sequence[Signals]) -> float:
    """[kg·m²] The rotor inertia, of some, with which the speed follows the measured voltage best."""
    tried = []
    for lag in (0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.28):
        n = {**model.model, "J_m": lag * model.model["K_t"] * model.model["K_e"] / model.model["R_a"]}
        squares = 0.0
        for s in recordings:
            v = np.interp(np.arange(len(s)), np.flatnonzero(np.isfinite(s.v_a)), s.v_a[np.isfinite(s.v_a)])
            out = np.empty((3, len(v)))
            dynamics.run_motor(v, State(omega=float(np.nan_to_num(s.omega[0]))),
                               *prepare(replace(model, model=n, effects={}), s.period), out)
            squares += float(np.nansum((s.true_speed - out[1]) ** 2))
        tried.append((squares, n["J_m"]))
    return min(tried)[1]


def _start_of_arm(chains: CutChains) -> Model:
    """Start values of the arm's parameters, from a regression on the measured speed."""
    model = chains.model
    coarse = [replace(downsampled(chain.signals), duty=chain.signals.duty[:0]) for chain in chains.each]
    lifts = []
    for chain, s in zip(chains.each, coarse):
        every = max(1, round(s.period / chain.signals.period))
        speed = chain.speed if chain.signals.has("omega") or chain.signals.has("i_a") else chain.motor({})[1]
        turning = chain.signals.turning(speed)
        lifts.append((turning * np.abs(turning))[::every][:len(s.theta)])
    tests = [WeakForm(replace(s, duty=np.zeros(len(s.theta)))) for s in coarse]
    r = regress(tests, lifts)
    if r.gravity <= 0.5 or r.gain <= 0.0:
        return model
    return replace(model, model={**model.model, "mgd_over_J": r.gravity, "c_over_J": max(r.damping, 0.05),
                                 "L_over_J": r.gain / model.model["k_thrust"]})


def _with_local_noise(chain: CutChain, values: Mapping[str, float]) -> Signals:
    """The recording with the scatter around any smooth swing as the noise of its angle.

    Irregular stamps make the angle scatter more than its sensor does; no model of the arm explains that. In each
    window of two periods the residual is regressed on the angle, its rate, and low powers of both.
    """
    s = chain.signals
    theta, rate = chain.arm_motion(values, s.train)
    gravity = chain.model.model["mgd_over_J"]
    width = max(round(2.0 * 2.0 * math.pi / math.sqrt(gravity) / s.period), 1)
    r = s.theta[:s.train] - chain.arm(values, s.train)
    squares, freedom = 0.0, 0
    for start in range(0, s.train - width + 1, width):
        at = start + np.flatnonzero(np.isfinite(r[start:start + width]))
        y, v = theta[at], rate[at] / math.sqrt(gravity)
        columns = np.column_stack([np.ones(len(at)), y, v, y * y, y * v, y**3, v * np.abs(v), np.sign(v)])
        if len(at) < 2 * columns.shape[1]:
            continue
        x, _, rank, _ = np.linalg.lstsq(columns, r[at], rcond=1e-8)
        squares += float(np.sum((r[at] - columns @ x) ** 2))
        freedom += len(at) - int(rank)
    seen = math.sqrt(squares / freedom) if freedom > MINIMUM_FREEDOM else 0.0
    if seen < SCATTER * s.sigma["theta"]:  # where samples are far apart, differences take some motion for noise
        least = min(max(seen, resolution(s.theta) / math.sqrt(12.0)), s.sigma["theta"])
        return replace(s, sigma={**s.sigma, "theta": least}) if freedom > MINIMUM_FREEDOM else s
    said = (f"the angle scatters by {math.degrees(seen):.2g} degrees around any smooth swing, more than its sensor "
            "does; irregular stamps have this effect; the scatter counts as noise")
    return replace(s, sigma={**s.sigma, "theta": seen}).noted(said)


def _over_growing_horizons(model: Model, recordings: Sequence[Signals], deadline: float | None) -> tuple[Model, Fit]:
    """Fit over the beginning, then over more and more of the recordings."""
    for share in HORIZONS:
        least = round(SHORTEST_HORIZON / recordings[0].period)
        part = [replace(s, train=min(max(round(share * s.train), least), s.train)) for s in recordings]
        chains = CutChains(model, part, policy_of(part, fit_nominal=True))
        f = fit(chains.residuals("arm"), nominal_parameters(chains, "arm"), ROUNDS, deadline=deadline)
        model = chains.each[0].valued(of_rig(f.values))
    return model, f


def _start_of_decay(model: Model, recordings: Sequence[Signals]) -> Model:
    """Gravity, damping and zero from the turning points of the longest decay.

    The period of a pendulum of amplitude a is T0 (1 + a²/16 + 11 a⁴/3072).
    """
    s = max(recordings, key=len)
    known = np.flatnonzero(np.isfinite(s.theta))
    x, t = s.theta[known], known * s.period
    points = turning_points(x, max(4.0 * s.sigma["theta"], 0.015 * float(np.ptp(x))))[1:]
    at, size = t[points], np.abs(np.diff(x[points]))
    middle = float(np.mean(0.5 * (x[points][-3:-1] + x[points][-2:]))) if len(points) > 3 else float(np.median(x))
    half = np.diff(at)
    a = 0.5 * size
    half = half / (1.0 + a**2 / 16.0 + 11.0 * a**4 / 3072.0)
    gravity = (math.pi / float(np.median(half))) ** 2
    slope = float(np.polyfit(0.5 * (at[1:] + at[:-1]), np.log(np.maximum(size, 1e-9)), 1)[0]) if len(size) > 1 else -0.5
    numbers = {**model.model, "mgd_over_J": gravity, "c_over_J": min(max(-2.0 * slope, 0.02), 50.0)}
    return replace(model, model=numbers, effects={**model.effects, "angle_offset": {"bias": middle}},
                   sensing={**model.sensing, "angle_filter_tau": 0.0})
