# SPDX-License-Identifier: Apache-2.0
"""The nominal model of a rig whose numbers nobody knows, identified from its recordings.

Which numbers can be free depends on what was measured. A search needs to begin near enough: an arm that swings freely
tells its numbers by its turning points; one that is driven, by linear regression of its weak form (the equation of
motion times a bump, integrated by parts, so that no reading is differentiated) for each of a few curves and lags from
the duty to the lift. Then the readings are fitted, first over the beginning, then over more and more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.cached_chain import ThriftyChains
from aeropend_ident.diagnosis.chain.chain import BLOCKS, Chain, Chains, of_recording, with_values
from aeropend_ident.diagnosis.chain.priors import angle_only, free_swinging, nominal_unknowns
from aeropend_ident.estimation.map_fit import Fit, Unknown, fit
from aeropend_ident.signals.signals import Signals
from aeropend_ident.signals.uncalibrated import resolution, turning_points
from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

SHARES = (0.15, 0.35, 1.0)
"""Parts of the fitted data over which a fit is drawn out."""

ROUNDS = 4
"""Rounds of a fit on the way."""

COARSE = 0.01
"""s between samples that a search begins with."""

BUMPS = (0.25, 0.5)
"""Half-widths of the test functions of the weak form, s."""

LAGS = (0.04, 0.12, 0.4, 1.0)
"""Lags, s, of which each is followed up with the static curve that goes best with it."""

WIDE = 2.0
"""Factor on the priors of numbers while a nominal model is looked for."""

SETTLES = 0.1
"""s over which voltage, current and speed are averaged to begin with."""

SCATTER, MINIMUM_FREEDOM = 1.3, 30
"""Factor by which a local scatter must exceed the noise of a reading to replace it, and degrees of freedom to tell."""

SIZES = {"command_delay.delay": (0.01, 0.03, 0.09), "thrust_lag.tau": (0.03, 0.1, 0.3),
         "thrust_exponent.n": (1.3, 1.65, 2.35, 2.7)}
"""Sizes that the search begins with for effects which a curve and a lag from duty to lift take for other ones."""

FOLLOWED = 2
"""Of these sizes, how many are followed up."""

HANGS = 0.1
"""rad: an arm that begins no farther from hanging than this is taken to begin with a rotor that stands."""

CURVE = 11
"""Points of the static curve from duty to lift."""

FULL = 2.3
"""V at full duty that the map of a rig without voltage is given: only its product with other numbers shows."""


def identify(model: Model, recordings: Sequence[Signals]) -> tuple[Model, list[Signals]]:
    """The nominal model that fits the recordings best, as rich as their channels allow.

    Args:
        model: gives what the recordings cannot fix. recordings: of one rig.

    Returns:
        The model, and the recordings, with the noise that they turned out to have.
    """
    name = f"{model.name}, identified"
    if free_swinging(recordings):
        found, f = _drawn_out(_swinging(model, recordings), recordings)
        chains = Chains(found, recordings, fit_nominal=True)
        noisier = [_with_local_noise(chain, chains.own(f.values, k)) for k, chain in enumerate(chains.each)]
        return replace(found, name=name), noisier
    if angle_only(recordings):
        coarse = [_coarser(s) for s in recordings]
        begun = [_drawn_out(m, coarse) for m in _driven(model, coarse)]
        counts = {k: max(f.independent[k] for _, f in begun) for k in begun[0][1].independent}
        best = max(begun, key=lambda b: b[1].evidence(counts))[0]
        return replace(_fitted(best, recordings)[0], name=name), list(recordings)
    return replace(_measured(model, recordings), name=name), list(recordings)


def _measured(model: Model, recordings: Sequence[Signals]) -> Model:
    """The nominal model of a rig with more than angle and command: part by part, each from what feeds it."""
    chains = Chains(model, recordings, fit_nominal=True)
    for block in BLOCKS:
        if block == "motor":
            chains = _again(chains, _motor_begun(chains))
        elif block == "arm":
            chains = _again(chains, _arm_begun(chains))
        unknowns = nominal_unknowns(chains, block)
        f = fit(chains.residuals(block), [replace(u, sd=WIDE * u.sd) for u in unknowns])
        if f.residuals:
            chains = _again(chains, chains.each[0].valued(shared(f.values)))
    return chains.model


def _again(chains: Chains, model: Model) -> Chains:
    """The chains cut anew under another model, each part fed as the one before explains it."""
    again = Chains(model, chains.recordings, fit_nominal=True)
    again.feed_next("actuator", {})
    again.feed_next("motor", {})
    return again


def _motor_begun(chains: Chains) -> Model:
    """Where the search for the motor's numbers begins."""
    model, recordings = chains.model, chains.recordings
    n = dict(model.model)
    if all(s.has("v_a") and s.has("i_a") and s.has("omega") for s in recordings):
        # v = R i + K_e ω, but for what the winding stores, which averages out
        rows = [np.column_stack([_calm(x, s.period) for x in (s.v_a, s.i_a, s.true_speed)]) for s in recordings]
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
    for dead, bend, load, lag in product((0.0, 0.04, 0.12), (0.003, 0.08, 0.6), (0.02, 1.0, 4.0), (0.04, 0.12, 0.4)):
        numbers = _curve(n, dead, bend, load, lag)
        squares, scale = 0.0, []
        for s in recordings:
            w, seen = np.sqrt(_lift(replace(model, model=numbers), s)), s.true_speed
            known = np.isfinite(seen)
            scale.append(float(w[known] @ seen[known]) / max(float(w[known] @ w[known]), 1e-12))
            squares += float(np.sum((seen[known] - scale[-1] * w[known]) ** 2))
        size = float(np.mean(scale))
        if size > 0.0:  # a speed in other units is a motor of another constant
            found.append((squares, {**numbers, "K_e": numbers["K_e"] / size, "K_t": numbers["K_t"] / size,
                                    "k_load": numbers["k_load"] / size**3, "J_m": numbers["J_m"] / size**2}))
    return replace(model, model=min(found, key=lambda item: item[0])[1]) if found else model


def _best_inertia(model: Model, recordings: Sequence[Signals]) -> float:
    """The rotor's inertia, of a few, with which the speed follows the measured voltage best."""
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


def _arm_begun(chains: Chains) -> Model:
    """Where the search for the arm's numbers begins, with the speed as measured."""
    model = chains.model
    coarse = [replace(_coarser(chain.signals), duty=chain.signals.duty[:0]) for chain in chains.each]
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


def _calm(x: Array, period: float) -> Array:
    """Means (M,) of x (N,) over pieces in which a winding settles."""
    width = max(1, round(SETTLES / period))
    n = len(x) // width
    rows = x[:n * width].reshape(n, width)
    count = np.isfinite(rows).sum(axis=1)
    return np.where(count > 0, np.nansum(rows, axis=1) / np.maximum(count, 1), np.nan)


def _with_local_noise(chain: Chain, values: Mapping[str, float]) -> Signals:
    """The recording with the scatter that even a swing of free amplitude, phase and shape leaves as its noise.

    Unsteady stamps make an angle scatter more than its sensor does, and no model of the arm can explain that.
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
    if seen < SCATTER * s.sigma["theta"]:  # differences take some motion for noise, where samples are far apart
        least = min(max(seen, resolution(s.theta) / math.sqrt(12.0)), s.sigma["theta"])
        return replace(s, sigma={**s.sigma, "theta": least}) if freedom > MINIMUM_FREEDOM else s
    said = (f"the angle scatters by {math.degrees(seen):.2g} degrees around any smooth swing, more than its sensor "
            "does: unsteady stamps would do that; it counts as noise")
    return replace(s, sigma={**s.sigma, "theta": seen}, notes=(*s.notes, said))


def _drawn_out(model: Model, recordings: Sequence[Signals], *effect: Unknown) -> tuple[Model, Fit]:
    """Fit over the beginning, then over more and more of the recordings; an effect's unknown along."""
    for share in SHARES:
        least = round(3.0 / recordings[0].period)
        part = [replace(s, train=min(max(round(share * s.train), least), s.train)) for s in recordings]
        model, f = _fitted(model, part, ROUNDS, *effect)
    return model, f


def _fitted(model: Model, recordings: Sequence[Signals], rounds: int = 10, *effect: Unknown) -> tuple[Model, Fit]:
    chains = ThriftyChains(model, recordings)
    along = [replace(u, start=_value(model, u.name)) for u in effect]
    f = fit(chains.residuals("arm"), [*nominal_unknowns(chains, "arm"), *along], rounds)
    return chains.each[0].valued(shared(f.values)), f


def _value(model: Model, name: str) -> float:
    effect, _, parameter = name.partition(".")
    return model.effects[effect][parameter]


def shared(values: Mapping[str, float]) -> dict[str, float]:
    """The values that hold for the rig: without initial states, and with what differs from run to run averaged."""
    out: dict[str, list[float]] = {}
    for name, value in values.items():
        if not name.startswith("initial."):
            out.setdefault(of_recording(name)[0], []).append(value)
    return {name: float(np.mean(all_)) for name, all_ in out.items()}


def _swinging(model: Model, recordings: Sequence[Signals]) -> Model:
    """Gravity, damping and zero from the turning points of the longest free swinging."""
    s = max(recordings, key=len)
    known = np.flatnonzero(np.isfinite(s.theta))
    x, t = s.theta[known], known * s.period
    points = turning_points(x, max(4.0 * s.sigma["theta"], 0.015 * float(np.ptp(x))))[1:]
    at, size = t[points], np.abs(np.diff(x[points]))
    middle = float(np.mean(0.5 * (x[points][-3:-1] + x[points][-2:]))) if len(points) > 3 else float(np.median(x))
    half = np.diff(at)
    a = 0.5 * size
    # period of a pendulum that swings by a: T = T0 (1 + a²/16 + 11 a⁴/3072)
    half = half / (1.0 + a**2 / 16.0 + 11.0 * a**4 / 3072.0)
    gravity = (math.pi / float(np.median(half))) ** 2
    slope = float(np.polyfit(0.5 * (at[1:] + at[:-1]), np.log(np.maximum(size, 1e-9)), 1)[0]) if len(size) > 1 else -0.5
    numbers = {**model.model, "mgd_over_J": gravity, "c_over_J": min(max(-2.0 * slope, 0.02), 50.0)}
    return replace(model, model=numbers, effects={**model.effects, "angle_offset": {"bias": middle}},
                   sensing={**model.sensing, "angle_filter_tau": 0.0})


def _coarser(s: Signals) -> Signals:
    """The recording with means over some samples in place of each."""
    every = max(1, math.floor(COARSE / s.period))
    if every == 1:
        return s
    n = len(s) // every

    def mean(x: Array) -> Array:
        rows = x[:n * every].reshape(n, every)
        count = np.isfinite(rows).sum(axis=1)
        return np.where(count > 0, np.nansum(rows, axis=1) / np.maximum(count, 1), np.nan)

    theta = mean(s.theta)
    empty = np.full(n, np.nan)
    return replace(s, period=every * s.period, duty=mean(s.duty), theta=theta, omega=empty, i_a=empty, v_a=empty,
                   pulses=None, false_speed=np.zeros(n, dtype=bool), train=max(1, s.train // every))


def _driven(model: Model, recordings: Sequence[Signals]) -> list[Model]:
    """The likeliest beginnings for a rig with command and angle alone."""
    found = _likely(model, recordings, [_WeakForm(s) for s in recordings])
    # a quick rotor with a sluggish arm looks much like a sluggish rotor with a quick arm: each lag has its say
    first = {lag: next((m for _, own, m in found if own == lag), None) for lag in LAGS}
    return [m for m in first.values() if m is not None] or [model]


def with_effect(model: Model, recordings: Sequence[Signals], effect: Unknown) -> dict[str, float]:
    """Numbers, states and the size of an effect of `SIZES`, identified together: numbers found without it mislead.

    Args:
        model: as identified without the effect. recordings: with command and angle alone. effect: its unknown.
    """
    coarse = [_coarser(s) for s in recordings]
    tests = [_WeakForm(s) for s in coarse]
    likely = [found[0] for size in SIZES[effect.name]
              if (found := _likely(with_values(model, {effect.name: size}), coarse, tests))]
    likely.sort(key=lambda item: item[0])
    fits = [_drawn_out(m, coarse, effect)[1] for *_, m in likely[:FOLLOWED]]
    if not fits:
        return {}
    counts = {k: max(f.independent[k] for f in fits) for k in fits[0].independent}
    return max(fits, key=lambda f: f.evidence(counts)).values


def _likely(model: Model, recordings: Sequence[Signals], tests: Sequence[_WeakForm]
            ) -> list[tuple[float, float, Model]]:
    """Curves and lags, the likeliest first: sum of squares left, lag, model."""
    found = []
    for dead, bend, load, lag in product((0.0, 0.04, 0.12), (0.003, 0.08, 0.6), (0.02, 1.0, 4.0), LAGS):
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


def lift(model: Model, recordings: Sequence[Signals]) -> dict[str, object]:
    """What of map, motor and thrust a rig with command and angle alone shows: the static lift of a duty, and its lag.

    Returns:
        `duty` (K,) up to the largest there was; `rad_per_s2` (K,) the lift over the arm's inertia; `dead_zone`, the
        duty below which there is none; `lag_s`, the rotor's time constant at half of the largest duty.
    """
    n = model.numbers()
    duty = np.linspace(0.0, max(float(s.duty.max()) for s in recordings), CURVE)
    speed = actuator.speed_at(n, actuator.voltage(n, duty))
    middle = float(speed[CURVE // 2])
    return {"duty": duty.tolist(), "rad_per_s2": (n["L_over_J"] * actuator.thrust(n, speed)).tolist(),
            "dead_zone": max(((n["k0"] / n["k1"]) ** 2 - n["k3"]) / n["k2"], 0.0) if n["k0"] < 0.0 else 0.0,
            "lag_s": n["J_m"] / (n["K_t"] * n["K_e"] / n["R_a"] + 2.0 * n["k_load"] * middle)}


def _curve(numbers: Mapping[str, float], dead: float, bend: float, load: float, lag: float) -> dict[str, float]:
    """Numbers of a map and motor.

    Args:
        numbers: give the rest. dead: duty below which nothing turns.
        bend: k3/k2; the map is a root of the duty if it is small, straight if it is large.
        load: voltage that the load takes over that of the back-EMF, at full duty.
        lag: s, of the rotor at full duty.
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
    """Thrust (N,) that the duty gives, over k_thrust: the speed squared, unless an effect of `SIZES` changes that."""
    from scipy.signal import lfilter  # takes long to import

    n = model.numbers()
    hangs = abs(float(np.mean(s.theta[np.isfinite(s.theta)][:3]))) < HANGS
    before = 0.0 if hangs else float(s.duty[0])
    v = actuator.acting_voltage(n, s.duty, model.effects, s.period, before=before)
    state = dynamics.State(omega=0.0 if hangs else float(actuator.speed_at(n, v[0])))
    out = np.empty((3, len(v)))
    dynamics.run_motor(v, state, *dynamics.prepare(model.with_effects({}), s.period), out)
    pivot = dynamics.THRUST_PIVOT_SPEED
    u = pivot**2 * (np.maximum(out[1], 0.0) / pivot) ** model.effects.get("thrust_exponent", {}).get("n", 2.0)
    tau = model.effects.get("thrust_lag", {}).get("tau", 0.0)
    keep = math.exp(-s.period / tau) if tau > 0.0 else 0.0
    return lfilter([1.0 - keep], [1.0, -keep], u, zi=[keep * u[0]])[0] if keep else u


class _WeakForm:
    """θ̈ = -G sin θ - c θ̇ + g u times bumps φ, integrated by parts: ∫ θ φ'' = ∫ (-G sin θ + g u) φ + c ∫ θ φ'."""

    def __init__(self, s: Signals) -> None:
        known = np.flatnonzero(np.isfinite(s.theta))
        theta = np.interp(np.arange(len(s)), known, s.theta[known])[:s.train]
        self.rows, self.kernels, left = [], [], []
        columns: list[list[Array]] = [[], [], []]
        for half in BUMPS:
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
        """∫ u φ for each bump (M,)."""
        return np.concatenate([np.convolve(u, k[::-1], "same")[r] for r, k in zip(self.rows, self.kernels)])


def _regress(tests: Sequence[_WeakForm], lifts: Sequence[Array]) -> tuple[float, Array]:
    """Sum of squares left, and gravity, damping, gain; a constant takes what an angle that hangs elsewhere adds."""
    a = np.concatenate([np.column_stack([*w.columns[:2], w.of(u), w.columns[2]]) for w, u in zip(tests, lifts)])
    b = np.concatenate([w.left for w in tests])
    scale = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    x, *_ = np.linalg.lstsq(a / scale, b, rcond=1e-10)
    return float(np.sum((b - (a / scale) @ x) ** 2)), (x / scale)[:3]
