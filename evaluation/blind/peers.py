# SPDX-License-Identifier: Apache-2.0
"""What a peer gives on the same recordings: sparse regression of the discrepancy, and stepwise BIC on output error.

Both are done as well as their idea allows: they get the catalogue, the measurement chain, the false speed periods
already found, and the model's numbers free within their uncertainty. Neither can say `unknown`, and neither has a term
for chance (`gust`, `speed_spikes`).

Each returns {"effects": [keys, strongest first], "place": .., "seconds": ..}, as `report.report` takes it.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter
from threadpoolctl import threadpool_limits

from aeropend_ident.diagnosis.chain.free_run import free_run
from aeropend_ident.diagnosis.chain.values import PLACE_OF_PARAMETER
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model import actuator
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH, RANDOM
from aeropend_sim.model.parameters import Model, load
from evaluation.blind.limit import OFF, Coordinate, Descent, derivative, descend, numbers_within, starts_of

Array = NDArray[np.float64]


def place_of(key: str) -> str:
    """Where in the chain a hypothesis lives; "none" for none."""
    effect, _, number = key.partition(":")
    if effect == PARAMETER_MISMATCH:
        return PLACE_OF_PARAMETER[number]
    return CATALOGUE[effect].place if effect in CATALOGUE else "none"


def _answer(effects: Sequence[str], started: float, **more: Any) -> dict[str, Any]:
    place = place_of(effects[0]) if effects else "none"
    return {"effects": list(effects), "place": place, "seconds": time.perf_counter() - started, **more}


# --- sparse regression of the discrepancy

LIGHT, WIDE = 0.008, 0.035
"""s: widths of the Gaussians that signals pass before a nonlinear function, and that every term passes after it."""

EVERY = 0.03
"""s between the rows of the regression."""

NOMINAL_SD = 0.03
"""Relative standard deviation that the model's numbers keep in the regression: that of ±5 % at random."""

FAST = 80.0
"""rad/s below which pulses are too rare for the derivative of the speed."""

THRESHOLDS = 16
MOST_TERMS = 4
SE = 1.0
"""Standard errors by which a sparser support may predict worse than the best."""

BLOCKS = 60
"""Parts of the held-out rows, whose differences say how sure a comparison of two supports is."""


@dataclass
class Library:
    """Rows of the model's four equations, each the residual of measured signals, and what each hypothesis adds.

    Attributes:
        rows: equation -> (N,) residual. numbers: name -> equation -> (N,) for 100 % of the number.
        terms: key -> its variants -> equation -> (N,); a variant is a list of columns that belong together.
        use: equation -> (N,) rows in which its signals are known.
    """

    rows: dict[str, Array] = field(default_factory=dict)
    numbers: dict[str, dict[str, Array]] = field(default_factory=dict)
    terms: dict[str, list[list[dict[str, Array]]]] = field(default_factory=dict)
    use: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    def add(self, key: str, *columns: dict[str, Array]) -> None:
        """A variant of a hypothesis."""
        self.terms.setdefault(key, []).append(list(columns))


def library(signals: Signals, model: Model) -> Library:
    """The regression of one recording: equation errors of the nominal model, filtered alike, and candidate terms."""
    n, h = model.numbers(), signals.period
    lib = Library()
    t = np.arange(len(signals)) * h

    def wide(x: Array, order: int = 0) -> Array:
        return np.asarray(gaussian_filter1d(x, WIDE / h, order=order, mode="nearest")) / h**order

    def light(x: Array) -> Array:
        return np.asarray(gaussian_filter1d(x, LIGHT / h, mode="nearest"))

    v, i = _filled(signals.v_a), _filled(signals.i_a)
    omega, turning = _speed(signals)

    # duty to voltage
    mapped = actuator.voltage(n, signals.duty)
    lib.rows["voltage"] = wide(v - mapped)
    for name in ("k0", "k1", "k2", "k3"):
        moved = actuator.voltage({**n, name: 1.001 * n[name]}, signals.duty)
        lib.numbers[name] = {"voltage": wide(moved - mapped) / 0.001}
    lib.add("bridge_drop", {"voltage": -wide((mapped > 0.0).astype(float))})
    lib.add("supply_sag", {"voltage": -wide(i)})
    lib.add("supply_drift", {"voltage": -wide(t * mapped)})
    for delay in (0.004, 0.01, 0.025, 0.06):
        lib.add("command_delay", {"voltage": wide(np.interp(t - delay, t, mapped) - mapped)})

    # voltage to current; a held voltage acts half a period later than it is read
    v_mid = 0.5 * (v + np.append(v[0], v[:-1]))
    slope = wide(i, 1)
    lib.rows["winding"] = wide(v_mid) - n["R_a"] * wide(i) - n["K_e"] * wide(omega) - n["L_a"] * slope
    lib.numbers["R_a"] = {"winding": n["R_a"] * wide(i)}
    lib.numbers["K_e"] = {"winding": n["K_e"] * wide(omega)}
    lib.numbers["L_a"] = {"winding": n["L_a"] * slope}
    one = np.ones(len(t))
    lib.add("brush_drop", {"winding": wide(np.tanh(light(i) / 0.02))})
    for tau in (3.0, 10.0, 30.0, 90.0):
        keep = math.exp(-h / tau)
        heat = lfilter([tau * (1.0 - keep)], [1.0, -keep], light(i) ** 2)
        lib.add("winding_heating", {"winding": n["R_a"] * wide(heat * i)})
    lib.add("voltage_offset", {"voltage": one, "winding": one})

    # current to speed
    lib.rows["rotor"] = wide(omega, 1) - (n["K_t"] * wide(i) - n["B_m"] * wide(omega)
                                          - n["k_load"] * wide(omega**2)) / n["J_m"]
    torque, load_ = n["K_t"] / n["J_m"] * wide(i), n["k_load"] / n["J_m"] * wide(omega**2)
    lib.numbers["K_t"] = {"rotor": torque}
    lib.numbers["k_load"] = {"rotor": -load_}
    lib.numbers["J_m"] = {"rotor": -(torque - load_)}
    lib.add("rotor_friction", {"rotor": -wide((omega > 0.0).astype(float)) / n["J_m"]})
    lib.add("current_offset", {"winding": -n["R_a"] * one, "rotor": -n["K_t"] / n["J_m"] * one})
    lib.add("current_gain", {"winding": -n["R_a"] * wide(i) - n["L_a"] * slope, "rotor": -torque})

    _arm(lib, signals, model, omega, wide, light)
    known = {"voltage": np.isfinite(signals.v_a) & (np.arange(len(t)) >= signals.after_unseen),
             "winding": np.isfinite(signals.v_a) & np.isfinite(signals.i_a) & turning,
             "rotor": np.isfinite(signals.i_a) & turning, "arm": np.isfinite(signals.theta)}
    lib.use = {k: np.asarray(wide(u.astype(float)) > 0.9999) for k, u in known.items()}
    return lib


def _arm(lib: Library, signals: Signals, model: Model, omega: Array, wide: Callable[..., Array],
         light: Callable[[Array], Array]) -> None:
    """Speed to angle."""
    n, h = model.numbers(), signals.period
    t = np.arange(len(signals)) * h
    g, c, lever = n["mgd_over_J"], n["c_over_J"], n["L_over_J"]
    # the angle's filter makes it late by two time constants
    theta = np.interp(t + 2.0 * model.sensing["angle_filter_tau"], t, light(_filled(signals.theta)))
    rate = np.gradient(light(theta), h)
    f = actuator.thrust(n, omega)

    def lagged(x: Array, tau: float) -> Array:
        keep = math.exp(-h / tau)
        return np.asarray(lfilter([1.0 - keep], [1.0, -keep], x))

    lib.rows["arm"] = wide(theta, 2) + c * wide(theta, 1) + g * wide(np.sin(theta)) - lever * wide(f)
    lib.numbers["mgd_over_J"] = {"arm": -g * wide(np.sin(theta))}
    lib.numbers["c_over_J"] = {"arm": -c * wide(theta, 1)}
    lib.numbers["L_over_J"] = {"arm": lever * wide(f)}
    lib.numbers["k_thrust"] = {"arm": lever * wide(f)}
    for tau in (0.015, 0.03, 0.06, 0.12, 0.24):
        lib.add("thrust_lag", {"arm": lever * wide(lagged(f, tau) - f)})
    for tau in (0.004, 0.01, 0.02, 0.04, 0.08):
        lib.add("encoder_lag", {"arm": lever * wide(lagged(lagged(f, tau), tau) - f)})
    lib.add("thrust_exponent", {"arm": lever * wide(f * np.log(np.maximum(omega, 1.0) / 150.0))})
    lib.add("axial_inflow", {"arm": -lever * wide(omega * rate)})
    for width in (0.1, 0.2, 0.4, 0.8):
        lib.add("ground_effect", {"arm": lever * wide(f * np.exp(-np.abs(theta) / width))})
    lib.add("coulomb_friction", {"arm": -wide(np.tanh(rate / 0.05))})
    lib.add("quadratic_drag", {"arm": -wide(rate * np.abs(rate))})
    one = np.ones(len(t))
    lib.add("cable_torque", {"arm": -wide(theta)}, {"arm": one})
    # the model's acceleration in place of the measured one: that one's noise is in the residual as well
    push = lever * f
    acceleration = wide(push - g * np.sin(theta) - c * rate)
    for frequency in (5.0, 7.0, 9.0, 12.0, 15.0, 19.0, 24.0, 30.0):
        # q̈ = -(s²/(s² + 2ζω s + ω²)) θ̈, by the bilinear transform
        k, z = 2.0 / h, 0.03
        a = np.array([k * k + 2.0 * z * frequency * k + frequency**2, 2.0 * (frequency**2 - k * k),
                      k * k - 2.0 * z * frequency * k + frequency**2])
        lib.add("mast_flex", {"arm": lfilter(np.array([1.0, -2.0, 1.0]) * k * k / a[0], a / a[0], acceleration)})
    lib.add("angle_offset", {"arm": wide(g * np.cos(theta))})
    lib.add("encoder_eccentricity", {"arm": wide(push * np.cos(theta) - np.sin(theta) * rate**2)},
            {"arm": g - wide(push * np.sin(theta) + np.cos(theta) * rate**2)})


def _filled(x: Array) -> Array:
    known = np.flatnonzero(np.isfinite(x))
    return np.interp(np.arange(len(x)), known, x[known]) if len(known) else np.zeros(len(x))


def _speed(signals: Signals) -> tuple[Array, NDArray[np.bool_]]:
    """The speed (N,) through the middles of the intervals between pulses, and where it is known."""
    p = signals.pulses
    if p is None or (~p.false).sum() < 10:
        return _filled(signals.true_speed), np.isfinite(signals.true_speed)
    good = ~p.false
    middle = (p.time - 0.5 * p.period)[good]
    middle, first = np.unique(middle, return_index=True)
    omega = PchipInterpolator(middle, p.omega[good][first], extrapolate=False)(np.arange(len(signals)) * signals.period)
    omega = np.where(np.isfinite(omega) & (signals.omega > 0.0), omega, 0.0)
    return omega, omega > FAST


@dataclass(frozen=True)
class Regression:
    """The library as one linear problem with white noise, the numbers projected out.

    Attributes:
        y: (R,) residual. x: key -> (R,) column of unit length. test: (R,) rows held out.
        prior: (R,) rows that are no data but what the numbers cost.
    """

    y: Array
    x: dict[str, Array]
    test: NDArray[np.bool_]
    prior: NDArray[np.bool_]


def regression(lib: Library, signals: Signals) -> Regression:
    """Stack the equations, weigh them by what the whole library leaves, choose each hypothesis' best variant."""
    stride = max(1, round(EVERY / signals.period))
    chosen = {e: np.flatnonzero(lib.use[e])[::stride] for e in lib.rows}
    chosen = {e: k for e, k in chosen.items() if len(k) > 50}
    weight = dict.fromkeys(chosen, 1.0)

    def stack(parts: Mapping[str, Array]) -> Array:
        return np.concatenate([weight[e] * parts[e][k] if e in parts else np.zeros(len(k)) for e, k in chosen.items()])

    for _ in range(3):
        for e, k in chosen.items():
            columns = [part[e][k] for part in lib.numbers.values() if e in part]
            columns += [part[e][k] for variants in lib.terms.values() for v in variants for part in v if e in part]
            scaled = np.array(columns).T / np.linalg.norm(columns, axis=1)
            rest = lib.rows[e][k] - scaled @ np.linalg.lstsq(scaled, lib.rows[e][k], rcond=1e-6)[0]
            weight[e] = 1.0 / max(1.4826 * float(np.median(np.abs(rest))), 1e-12)
    numbers = np.array([stack(part) for part in lib.numbers.values()]).T
    # the inductance shows in derivatives only, which filtering spoils: it is left free
    prior = np.diag([0.0 if name == "L_a" else 1.0 / NOMINAL_SD for name in lib.numbers])
    basis = np.linalg.qr(np.vstack([numbers, prior]))[0]

    def free(x: Array) -> Array:
        """What of a column the numbers within their uncertainty cannot do."""
        padded = np.concatenate([x, np.zeros(len(prior))])
        return padded - basis @ (basis.T @ padded)

    y = free(stack(lib.rows))
    columns_of: dict[str, Array] = {}
    for key, variants in lib.terms.items():
        best = -1.0
        for variant in variants:
            group = np.array([free(stack(part)) for part in variant]).T
            fitted = group @ np.linalg.lstsq(group, y, rcond=None)[0]
            if float(fitted @ fitted) > best:
                best = float(fitted @ fitted)
                columns_of[key] = fitted if len(variant) > 1 else group[:, 0]
    for name, part in lib.numbers.items():
        if name not in ("L_a", "k_thrust"):  # k_thrust is L_over_J in other words
            columns_of[f"{PARAMETER_MISMATCH}:{name}"] = free(stack(part))
    columns_of = {k: x / np.linalg.norm(x) for k, x in columns_of.items() if np.linalg.norm(x) > 1e-9}
    when = np.concatenate([*chosen.values(), np.full(len(prior), -1)])
    return Regression(y, columns_of, when >= signals.train, when < 0)


def sparse_regression(signals: Signals, model: Model | None = None, optimizer: str = "frols") -> dict[str, Any]:
    """Sparse regression of the discrepancy on the catalogue's terms (pysindy).

    The residual of each nominal equation is regressed on one term a hypothesis; the sparsity is the one that predicts
    the held-out rows best with the least strain on the numbers, within one standard error of the difference.

    Args:
        signals: a recording.
        model: nominal; `bench` by default.
        optimizer: "frols" (forward selection, the best of the three here), "stlsq" or "sr3".
    """
    started = time.perf_counter()
    with threadpool_limits(1):
        return _sparse_regression(regression(library(signals, model or load("bench")), signals), optimizer, started)


def _sparse_regression(r: Regression, optimizer: str, started: float) -> dict[str, Any]:
    keys = list(r.x)
    x = np.array([r.x[k] for k in keys]).T
    train, held = ~r.test, r.test
    supports = {tuple(s) for s in _supports(x[train], r.y[train], optimizer)} | {()}
    blocks = np.array_split(np.flatnonzero(held), BLOCKS)
    errors: dict[tuple[int, ...], Array] = {}
    costs: dict[tuple[int, ...], float] = {}
    for s in supports:
        terms = x[:, list(s)]
        rest = r.y - terms @ np.linalg.lstsq(terms[train], r.y[train], rcond=None)[0] if s else r.y
        errors[s] = np.array([np.sum(rest[b] ** 2) for b in blocks])
        costs[s] = float(errors[s].sum() + np.sum(rest[r.prior] ** 2))
    best = min(costs, key=lambda s: costs[s])
    sd = {s: math.sqrt(len(blocks)) * float((e - errors[best]).std()) for s, e in errors.items()}
    support = min((s for s in costs if costs[s] <= costs[best] + SE * sd[s]), key=lambda s: (len(s), costs[s]))
    return _answer([keys[j] for j in _strongest(x, r.y, support)], started)


def _supports(x: Array, y: Array, optimizer: str) -> list[list[int]]:
    """Supports along a path of sparsity."""
    import pysindy  # type: ignore[import-untyped]

    scale = float(np.abs(x.T @ y).max())
    supports = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if optimizer == "frols":
            for terms in range(1, MOST_TERMS + 1):
                found = pysindy.FROLS(max_iter=terms, alpha=1e-9).fit(x, y[:, None]).coef_[0]
                supports.append(np.flatnonzero(found).tolist())
            return supports
        for level in np.geomspace(0.9 * scale, 0.003 * scale, THRESHOLDS):
            if optimizer == "sr3":
                fitted = pysindy.SR3(reg_weight_lam=0.5 * level**2, relax_coeff_nu=1.0, max_iter=500)
            else:
                fitted = pysindy.STLSQ(threshold=level, alpha=0.02)
            supports.append(np.flatnonzero(fitted.fit(x, y[:, None]).coef_[0]).tolist())
    return supports


def _strongest(x: Array, y: Array, support: Sequence[int]) -> list[int]:
    """The support, the term first whose loss costs most."""

    def left(columns: Sequence[int]) -> float:
        rest = y - x[:, columns] @ np.linalg.lstsq(x[:, columns], y, rcond=None)[0] if columns else y
        return float(rest @ rest)

    return sorted(support, key=lambda j: -left([k for k in support if k != j]))


# --- stepwise BIC on output error

AVERAGED = 6
"""Samples averaged to one in the residual: no information is lost, the algebra is lighter."""

MOST_EFFECTS = 3
SCREENED, REFINED = 3, 12
"""Steps of the search for every effect with the numbers' derivatives held, and for the best ones in full."""

BEST = 5
"""How many effects are fitted in full in each round."""


@dataclass(frozen=True)
class OutputError:
    """The free-run output error of one recording under a hypothesis, channel by channel."""

    signals: Signals
    model: Model

    def channels(self, coordinates: Sequence[Coordinate], x: Array) -> list[Array]:
        """Residuals in units of their noise: three averaged channels, and the speed where its pulses show."""
        s = self.signals
        values = {c.name: c.value(z) for c, z in zip(coordinates, x)}
        simulated = free_run(self.model, s, values)
        out = []
        for name in ("v_a", "i_a", "theta"):
            error = np.nan_to_num((s.channel(name) - simulated[name]) / s.sigma[name], posinf=1e9, neginf=-1e9)
            if name == "v_a":
                error[:s.after_unseen] = 0.0
            error = error[:len(error) // AVERAGED * AVERAGED].reshape(-1, AVERAGED)
            out.append(error.sum(axis=1) / math.sqrt(AVERAGED))
        if s.pulses is not None:
            at, sigma = s.pulses.index[~s.pulses.false], s.pulses.sigma[~s.pulses.false]
            out.append(np.nan_to_num((s.omega[at] - simulated["omega"][at]) / sigma, posinf=1e9, neginf=-1e9))
        else:
            out.append(np.nan_to_num(s.true_speed - simulated["omega"]) / s.sigma["omega"])
        return out

    def weighted(self, coordinates: Sequence[Coordinate], scale: Sequence[float]) -> Callable[[Array], Array]:
        """The residual function of a search, each channel divided by its scale."""
        return lambda x: np.concatenate([r / k for r, k in zip(self.channels(coordinates, x), scale)])


@dataclass(frozen=True)
class Hypothesis:
    """Numbers and effects with their best values so far; `cost` is the BIC."""

    keys: tuple[str, ...]
    numbers: list[Coordinate]
    own: list[Coordinate]
    x: Array
    cost: float


def stepwise_bic(signals: Signals, model: Model | None = None, budget: float = 120.0) -> dict[str, Any]:
    """Forward selection of effects by BIC on the output error of the free run from the duty to all channels.

    Every number is free within its uncertainty. In each round every effect is screened from several starts, the best
    are fitted in full, and the one with the lowest BIC is kept if that is below the BIC without it.

    Args:
        signals: a recording from rest.
        model: nominal; `bench` by default.
        budget: s after which no further fit begins; `in_time` is false if it was not enough.
    """
    started = time.perf_counter()
    with threadpool_limits(1):
        keys, in_time = _stepwise(OutputError(signals, model or load("bench")), started + budget)
    return _answer(keys, started, in_time=in_time)


def _stepwise(error: OutputError, deadline: float) -> tuple[list[str], bool]:
    numbers = numbers_within(error.model, OFF)
    current = _fitted(error, (), numbers, [], np.zeros(len(numbers)), [1.0] * 4, 2 * REFINED)
    current = _fitted(error, (), numbers, [], current.x, _scale(error, current), REFINED)
    while len(current.keys) < MOST_EFFECTS:
        scale = _scale(error, current)
        fixed = [*current.numbers, *current.own]
        frozen = derivative(error.weighted(fixed, scale), fixed, current.x)
        screened: dict[str, tuple[float, list[Coordinate], list[Coordinate], Array]] = {}
        for key, trial_numbers, own in _candidates(error.model, current):
            if time.perf_counter() > deadline:
                return list(current.keys), False
            all_ = [*trial_numbers, *current.own, *own]
            start = np.concatenate([current.x, [c.start for c in own]])
            reached = descend(error.weighted(all_, scale), all_, start, SCREENED, frozen, 0.01)
            cost = _bic(error, all_, reached)
            if key not in screened or cost < screened[key][0]:
                screened[key] = cost, trial_numbers, own, reached.x
        tried = []
        for key in sorted(screened, key=lambda k: screened[k][0])[:BEST]:
            if time.perf_counter() > deadline:
                return list(current.keys), False
            _, trial_numbers, own, x = screened[key]
            tried.append(_fitted(error, (*current.keys, key), trial_numbers, [*current.own, *own], x, scale, REFINED))
        best = min(tried, key=lambda h: h.cost, default=current)
        if best.cost >= current.cost:
            break
        current = best
    return list(current.keys), True


def _candidates(model: Model, current: Hypothesis) -> list[tuple[str, list[Coordinate], list[Coordinate]]]:
    """Key, numbers and own parameters of every effect that could come next, and of every number at its bound."""
    rows = [(effect, current.numbers, own) for effect in CATALOGUE
            if effect not in RANDOM and effect not in current.keys for own in starts_of(effect)]
    for k, c in enumerate(current.numbers):
        if min(current.x[k] - c.low, c.high - current.x[k]) < 1e-3 and c.high == OFF:
            free = numbers_within(model, OFF, c.name)[k]
            rows.append((f"{PARAMETER_MISMATCH}:{c.name}",
                         [*current.numbers[:k], free, *current.numbers[k + 1:]], []))
    return rows


def _fitted(error: OutputError, keys: tuple[str, ...], numbers: list[Coordinate], own: list[Coordinate], start: Array,
            scale: Sequence[float], steps: int) -> Hypothesis:
    all_ = [*numbers, *own]
    reached = descend(error.weighted(all_, scale), all_, start, steps)
    return Hypothesis(keys, numbers, own, reached.x, _bic(error, all_, reached))


def _scale(error: OutputError, h: Hypothesis) -> list[float]:
    """RMS of each channel's residual, at least 1."""
    return [max(1.0, float(np.sqrt(np.mean(r * r)))) for r in error.channels([*h.numbers, *h.own], h.x)]


def _bic(error: OutputError, coordinates: Sequence[Coordinate], reached: Descent) -> float:
    """BIC of independent normal residuals with a variance of its own for each channel; a freed number counts twice."""
    channels = error.channels(coordinates, reached.x)
    count = sum(map(len, channels))
    fit = sum(len(r) * math.log(max(float(np.mean(r * r)), 1e-12)) for r in channels)
    freed = sum("." not in c.name and c.high > OFF for c in coordinates)
    return fit + (len(coordinates) + freed) * math.log(count)
