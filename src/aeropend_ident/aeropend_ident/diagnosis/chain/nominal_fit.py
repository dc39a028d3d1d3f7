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

from aeropend_ident.diagnosis.chain.cached_chain import CachedChains
from aeropend_ident.diagnosis.chain.chain import CutChain, CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.chain.values import STAGES, of_rig, with_values
from aeropend_ident.diagnosis.document import Lift
from aeropend_ident.diagnosis.policy import Policy, angle_only, policy_of
from aeropend_ident.estimation.map_fit import Fit, fit, largest_ess
from aeropend_ident.estimation.parameter import Parameter, key
from aeropend_ident.signals.free_decay import turning_points
from aeropend_ident.signals.noise import resolution
from aeropend_ident.signals.signals import Signals
from aeropend_ident.signals.smoothing import block_mean
from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

HORIZONS = (0.15, 0.35, 1.0)
"""Parts of the training data over which a fit is made one after the other (choice)."""

SHORTEST_HORIZON = 3.0
"""[s] Shortest horizon: some swings of the arm (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

ROUNDS = 4
"""Rounds of the fits over each horizon; the last fit of a search has more (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

COARSE = 0.01
"""[s] Sample period of the data that a search starts with (choice: far below the arm's time constants).

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

TEST_FUNCTIONS = (0.25, 0.5)
"""[s] Half-widths of the test functions of the weak form: a quarter and a half of a usual period of the arm."""

LAGS = (0.04, 0.12, 0.4, 1.0)
"""[s] Lags of the rotor that searches start from; each starts with the static curve that fits best with it (choice)."""

DEAD_ZONES, BENDS, LOADS = (0.0, 0.04, 0.12), (0.003, 0.08, 0.6), (0.02, 1.0, 4.0)
"""Static curves that searches start from: dead zone of the duty, k3/k2, and voltage of load over back-EMF (choice)."""

WIDER = 2.0
"""Factor on the standard deviations of the priors while a nominal model is searched (choice)."""

WINDING_SETTLES = 0.1
"""[s] Blocks over which voltage, current and speed are averaged for a start.

Choice: longer than any winding's L_a/R_a."""

SCATTER, MINIMUM_FREEDOM = 1.3, 30
"""Ratio of the scatter around a smooth swing to a reading's noise above which it counts as the noise, and the degrees
of freedom needed (choice).

Measured: at ±30 % no verdict of 2 recordings changes (docs/results/thresholds.md)."""

SIZES = {"command_delay.delay": (0.01, 0.03, 0.09), "thrust_lag.tau": (0.03, 0.1, 0.3),
         "thrust_exponent.n": (1.3, 1.65, 2.35, 2.7)}
"""Sizes that searches start from, for effects that a curve and a lag absorb in part."""

FOLLOWED = 2
"""Number of these sizes from which a search is made (choice)."""

HANGS = 0.1
"""[rad] An arm that starts nearer to hanging than this is taken to start with a rotor that stands (choice).

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

CURVE = 11
"""Points of the static curve from duty to lift that is reported (choice).

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

FULL = 2.3
"""[V] Voltage at full duty of a rig without a measured voltage.

Choice: only its product with other parameters acts.

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""


def fit_nominal_model(model: Model, recordings: Sequence[Signals]) -> tuple[Model, list[Signals]]:
    """Identify the nominal model, with as many free parameters as the channels allow.

    Args:
        model: gives what the recordings cannot determine.
        recordings: of one rig.

    Returns:
        The model, and the recordings with their noise as estimated from the fit.
    """
    name = f"{model.name}, identified"
    policy = policy_of(recordings, fit_nominal=True)
    if not policy.driven:
        found, f = _over_growing_horizons(_start_of_decay(model, recordings), recordings)
        chains = CutChains(found, recordings, policy)
        noisier = [_with_local_noise(chain, chains.values_of(f.values, k)) for k, chain in enumerate(chains.each)]
        return replace(found, name=name), noisier
    if angle_only(recordings):
        coarse = [_downsampled(s) for s in recordings]
        begun = [_over_growing_horizons(m, coarse) for m in _starts_of_driven(model, coarse)]
        ess = largest_ess(f for _, f in begun)
        best = max(begun, key=lambda b: b[1].log_evidence(ess))[0]
        return replace(_fitted(best, recordings)[0], name=name), list(recordings)
    return replace(_stage_by_stage(model, recordings, policy), name=name), list(recordings)


def _stage_by_stage(model: Model, recordings: Sequence[Signals], policy: Policy) -> Model:
    """The nominal model of a rig with more channels than the angle: each stage from its measured input."""
    chains = CutChains(model, recordings, policy)
    for stage in STAGES:
        if stage == "motor":
            chains = _cut_again(chains, _start_of_motor(chains))
        elif stage == "arm":
            chains = _cut_again(chains, _start_of_arm(chains))
        parameters = nominal_parameters(chains, stage)
        f = fit(chains.residuals(stage), [replace(p, sd=WIDER * p.sd) for p in parameters])
        if f.residuals:
            chains = _cut_again(chains, chains.each[0].valued(of_rig(f.values)))
    return chains.model


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
        numbers = _curve(n, dead, bend, load, lag)
        squares, scale = 0.0, []
        for s in recordings:
            w, seen = np.sqrt(_lift(replace(model, model=numbers), s)), s.true_speed
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
            dynamics.run_motor(v, dynamics.State(omega=float(np.nan_to_num(s.omega[0]))),
                               *dynamics.prepare(replace(model, model=n, effects={}), s.period), out)
            squares += float(np.nansum((s.true_speed - out[1]) ** 2))
        tried.append((squares, n["J_m"]))
    return min(tried)[1]


def _start_of_arm(chains: CutChains) -> Model:
    """Start values of the arm's parameters, from a regression on the measured speed."""
    model = chains.model
    coarse = [replace(_downsampled(chain.signals), duty=chain.signals.duty[:0]) for chain in chains.each]
    lifts = []
    for chain, s in zip(chains.each, coarse):
        every = max(1, round(s.period / chain.signals.period))
        speed = chain.speed if chain.signals.has("omega") or chain.signals.has("i_a") else chain.motor({})[1]
        lifts.append(np.maximum(speed[::every][:len(s.theta)], 0.0) ** 2)
    tests = [_WeakForm(replace(s, duty=np.zeros(len(s.theta)))) for s in coarse]
    _, (gravity, damping, gain) = _regress(tests, lifts)
    if gravity <= 0.5 or gain <= 0.0:
        return model
    return replace(model, model={**model.model, "mgd_over_J": float(gravity), "c_over_J": max(float(damping), 0.05),
                                 "L_over_J": float(gain) / model.model["k_thrust"]})


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


def _over_growing_horizons(model: Model, recordings: Sequence[Signals], *effect: Parameter) -> tuple[Model, Fit]:
    """Fit over the beginning, then over more and more of the recordings, with the parameters of an effect if given."""
    for share in HORIZONS:
        least = round(SHORTEST_HORIZON / recordings[0].period)
        part = [replace(s, train=min(max(round(share * s.train), least), s.train)) for s in recordings]
        model, f = _fitted(model, part, ROUNDS, *effect)
    return model, f


def _fitted(model: Model, recordings: Sequence[Signals], rounds: int = 10, *effect: Parameter) -> tuple[Model, Fit]:
    chains = CachedChains(model, recordings, policy_of(recordings, fit_nominal=True))
    along = [replace(p, start=model.effects[key(p.name).owner][key(p.name).name]) for p in effect]
    f = fit(chains.residuals("arm"), [*nominal_parameters(chains, "arm"), *along], rounds)
    return chains.each[0].valued(of_rig(f.values)), f


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


def _downsampled(s: Signals) -> Signals:
    """The recording with block means in place of samples; angle and duty only."""
    every = max(1, math.floor(COARSE / s.period))
    if every == 1:
        return s
    n = len(s) // every
    empty = np.full(n, np.nan)
    return replace(s, period=every * s.period, duty=block_mean(s.duty, every), theta=block_mean(s.theta, every),
                   omega=empty, i_a=empty, v_a=empty, pulses=None, false_speed=np.zeros(n, dtype=bool),
                   train=max(1, s.train // every))


def _starts_of_driven(model: Model, recordings: Sequence[Signals]) -> list[Model]:
    """The likeliest start of each lag, for a rig with command and angle alone.

    A fast rotor with a slow arm resembles a slow rotor with a fast arm; so a search starts from each lag.
    """
    found = _likeliest(model, recordings, [_WeakForm(s) for s in recordings])
    first = {lag: next((m for _, own, m in found if own == lag), None) for lag in LAGS}
    return [m for m in first.values() if m is not None] or [model]


def fit_with_effect(model: Model, recordings: Sequence[Signals], effect: Parameter) -> dict[str, float]:
    """Identify the nominal model together with the size of an effect: parameters found without it are biased.

    Args:
        model: as identified without the effect.
        recordings: with command and angle alone.
        effect: size of an effect of `SIZES`.

    Returns:
        Parameters, initial states and the size, by name; empty if no start is possible.
    """
    coarse = [_downsampled(s) for s in recordings]
    tests = [_WeakForm(s) for s in coarse]
    likely = [found[0] for size in SIZES[effect.name]
              if (found := _likeliest(with_values(model, {effect.name: size}), coarse, tests))]
    likely.sort(key=lambda item: item[0])
    fits = [_over_growing_horizons(m, coarse, effect)[1] for *_, m in likely[:FOLLOWED]]
    if not fits:
        return {}
    ess = largest_ess(fits)
    return max(fits, key=lambda f: f.log_evidence(ess)).values


def _likeliest(model: Model, recordings: Sequence[Signals], tests: Sequence[_WeakForm]
               ) -> list[tuple[float, float, Model]]:
    """Static curves and lags, the likeliest first: sum of squares left, lag, model."""
    found = []
    for dead, bend, load, lag in product(DEAD_ZONES, BENDS, LOADS, LAGS):
        numbers = _curve(model.model, dead, bend, load, lag)
        m = replace(model, model=numbers)
        left, solution = _regress(tests, [_lift(m, s) for s in recordings])
        gravity, damping, gain = map(float, solution)
        if gravity <= 0.5 or gain <= 0.0:
            continue
        numbers = {**numbers, "mgd_over_J": min(gravity, 5e3), "c_over_J": min(max(damping, 0.05), 100.0),
                   "L_over_J": min(gain / numbers["k_thrust"], 1e5)}
        found.append((left, lag, replace(m, model=numbers)))
    return sorted(found, key=lambda item: item[0])


def lift(model: Model, recordings: Sequence[Signals]) -> Lift:
    """The static lift of a duty and its lag: all that command and angle alone show of map, motor and thrust.

    Args:
        model: the identified model.
        recordings: give the largest duty.
    """
    n = model.numbers()
    duty = np.linspace(0.0, max(float(s.duty.max()) for s in recordings), CURVE)
    speed = actuator.speed_at(n, actuator.voltage(n, duty))
    middle = float(speed[CURVE // 2])
    return Lift(duty=tuple(duty.tolist()), rad_per_s2=tuple((n["L_over_J"] * actuator.thrust(n, speed)).tolist()),
                dead_zone=max(((n["k0"] / n["k1"]) ** 2 - n["k3"]) / n["k2"], 0.0) if n["k0"] < 0.0 else 0.0,
                lag_s=n["J_m"] / (n["K_t"] * n["K_e"] / n["R_a"] + 2.0 * n["k_load"] * middle))


def _curve(numbers: Mapping[str, float], dead: float, bend: float, load: float, lag: float) -> dict[str, float]:
    """Parameters of a map and motor with a given static curve and lag.

    Args:
        numbers: the rest.
        dead: duty below which the rotor stands.
        bend: k3/k2; small: a root of the duty; large: a straight line.
        load: ratio of the voltages for load and back-EMF at full duty.
        lag: [s] of the rotor at full duty.
    """
    n = dict(numbers)
    root = FULL / (math.sqrt(1.0 + bend) - math.sqrt(dead + bend))
    n["k1"] = root / math.sqrt(n["k2"])
    n["k3"] = bend * n["k2"]
    n["k0"] = -root * math.sqrt(dead + bend)
    top = FULL / n["K_e"] / (1.0 + load)
    n["k_load"] = load * n["K_e"] * n["K_t"] / (n["R_a"] * top)
    n["J_m"] = lag * (1.0 + 2.0 * load) * n["K_t"] * n["K_e"] / n["R_a"]
    return n


def _lift(model: Model, s: Signals) -> Array:
    """Thrust (N,) over k_thrust for a duty: the speed squared, unless an effect of `SIZES` changes that."""
    from scipy.signal import lfilter  # its import is slow

    n = model.numbers()
    hangs = abs(float(np.mean(s.theta[np.isfinite(s.theta)][:3]))) < HANGS
    before = 0.0 if hangs else float(s.duty[0])
    v = actuator.acting_voltage(n, s.duty, model.effects, s.period, before=before)
    state = dynamics.State(omega=0.0 if hangs else float(actuator.speed_at(n, v[0])))
    out = np.empty((3, len(v)))
    dynamics.run_motor(v, state, *dynamics.prepare(model.with_effects({}), s.period), out)
    pivot = dynamics.THRUST_PIVOT_SPEED
    u = pivot**2 * (np.maximum(out[1], 0.0) / pivot) ** model.effect("thrust_exponent", "n")
    tau = model.effect("thrust_lag", "tau")
    keep = math.exp(-s.period / tau) if tau > 0.0 else 0.0
    return lfilter([1.0 - keep], [1.0, -keep], u, zi=[keep * u[0]])[0] if keep else u


class _WeakForm:
    """The weak form of θ̈ = -G sin θ - c θ̇ + g u, for a linear regression of G, c and g.

    With test functions φ: ∫ θ φ'' = ∫ (-G sin θ + g u) φ + c ∫ θ φ' (D. Messenger and D. Bortz, Multiscale Modeling &
    Simulation 19, 2021). `identification.weak` does the same for a library of terms; here the input u is replaced for
    each curve that is tried while the other columns stay.

    Args:
        s: angle and duty of a recording.
    """

    def __init__(self, s: Signals) -> None:
        known = np.flatnonzero(np.isfinite(s.theta))
        theta = np.interp(np.arange(len(s)), known, s.theta[known])[:s.train]
        self.rows, self.kernels, left = [], [], []
        columns: list[list[Array]] = [[], [], []]
        for half in TEST_FUNCTIONS:
            width = max(round(half / s.period), 3)
            z = np.arange(-width, width + 1) / width
            bump = (1.0 - z * z) ** 4
            first = -8.0 * z * (1.0 - z * z) ** 3
            second = -8.0 * (1.0 - z * z) ** 3 + 48.0 * z * z * (1.0 - z * z) ** 2
            h = width * s.period
            rows = np.arange(width, len(theta) - width, max(width // 2, 1))
            self.rows.append(rows)
            self.kernels.append(bump)
            mean = np.convolve(theta, np.ones(2 * width + 1) / (2 * width + 1), "same")[rows]  # φ'' integrates to 0
            left.append(np.convolve(theta, second[::-1], "same")[rows] / h**2 - mean * float(second.sum()) / h**2)
            columns[0].append(-np.convolve(np.sin(theta), bump[::-1], "same")[rows])
            columns[1].append(np.convolve(theta, first[::-1], "same")[rows] / h - mean * float(first.sum()) / h)
            columns[2].append(np.full(len(rows), float(bump.sum())))
        self.left = np.concatenate(left)
        self.columns = [np.concatenate(c) for c in columns]

    def of(self, u: Array) -> Array:
        """∫ u φ for each test function (M,)."""
        return np.concatenate([np.convolve(u, k[::-1], "same")[r] for r, k in zip(self.rows, self.kernels)])


def _regress(tests: Sequence[_WeakForm], lifts: Sequence[Array]) -> tuple[float, Array]:
    """Sum of squares left, and gravity, damping, gain; a constant stands for the zero of the angle."""
    a = np.concatenate([np.column_stack([*w.columns[:2], w.of(u), w.columns[2]]) for w, u in zip(tests, lifts)])
    b = np.concatenate([w.left for w in tests])
    scale = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    x, *_ = np.linalg.lstsq(a / scale, b, rcond=1e-10)
    return float(np.sum((b - (a / scale) @ x) ** 2)), (x / scale)[:3]
