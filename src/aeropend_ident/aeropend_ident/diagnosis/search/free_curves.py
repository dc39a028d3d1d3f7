# SPDX-License-Identifier: Apache-2.0
"""What something outside the catalogue looks like: at which place it acts, and its shape against each variable.

At each place of the chain the missing term is taken as a sum of free curves, one a variable, drawn between knots: a
voltage in the winding, a torque on the rotor, a force of the air, a torque on the arm, an error of a reading. Their
effect on the readings is linear to first order, so each place is judged by one least-squares solve, with the numbers of
the model refitted along. The place whose curves explain most is where the effect lives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import Chain, Chains, mean_speed, of_recording
from aeropend_ident.diagnosis.search.gauss_markov import transition
from aeropend_ident.estimation.map_fit import Fit, Search, Unknown, independent_samples
from aeropend_ident.signals.signals import Signals
from aeropend_sim.compiled import njit
from aeropend_sim.model import sensing

Array = NDArray[np.float64]

KNOTS = 9
"""Knots of a curve, at quantiles of its variable."""

STIFF = 1e-3
"""Weight that keeps a curve from running off where no data holds it, in noise of a reading."""

MOMENT = 0.2
"""s between knots of a term free in time."""

AT_ANY_TIME = "any time"

MEMORY = 2.0
"""s over which what the rotor did may still matter to the air."""


MOST_SAMPLES = 100_000
"""Samples of training data in which shapes are sought: all their curves at once have to fit into memory."""

MOST_AT_ANY_TIME = 25_000
"""The same with a term free in time, whose knots grow with the time."""


@dataclass(frozen=True)
class Curve:
    """A free curve: `value` (K,), in `unit`, at `knot` (K,) of a variable."""

    variable: str
    unit: str
    knot: Array
    value: Array


@dataclass(frozen=True)
class Shape:
    """A missing term at a place.

    Attributes:
        place: of the chain. curves: the term, as their sum.
        left: mean square of what it leaves, in units of a reading's noise. before: the same without it.
        samples: of all channels, that it was sought in. independent: how many independent ones that is worth.
        left_of_chance: share of the mean square that it would leave of random torques on the arm, if it was asked.
    """

    place: str
    curves: list[Curve]
    left: float
    before: float
    samples: int
    independent: float
    left_of_chance: float = math.nan

    @property
    def explained(self) -> float:
        """Mean square that the curves explain beyond what chance would let them."""
        chance = 3.0 * sum(len(c.value) for c in self.curves) / self.samples
        return max(self.before - self.left - chance * self.before, 0.0)


def hats(x: Array, count: int = KNOTS, train: int | None = None) -> tuple[Array, Array]:
    """Piecewise linear basis (N, K) of a variable (N,), and its knots (K,) at quantiles of its first `train` values."""
    known = x[:train][np.isfinite(x[:train])]
    knots = np.unique(np.quantile(known, np.linspace(0.002, 0.998, count))) if len(known) else np.zeros(0)
    if len(knots) < 3:
        return np.zeros((len(x), 0)), np.zeros(0)
    knots = knots[np.append(True, np.diff(knots) > 1e-3 * float(np.ptp(knots)))]
    if len(knots) < 3:
        return np.zeros((len(x), 0)), np.zeros(0)
    filled = np.nan_to_num(x, nan=float(knots[0]))
    return np.column_stack([np.interp(filled, knots, row) for row in np.eye(len(knots))]), knots


@njit(nogil=True)
def arm_response(drive: Array, stiffness: Array, damping: float, tau: float, h: float) -> Array:
    """Change of the angle read (K, N) for torques over inertia (K, N), to first order.

    Args:
        drive: 1/s². stiffness: (N,) 1/s², of the arm where it is. damping: 1/s. tau: s, of each stage of the filter.
        h: s.
    """
    out = np.empty_like(drive)
    keep = math.exp(-h / tau) if tau > 0.0 else 0.0
    for j in range(drive.shape[0]):
        x = v = s1 = s2 = 0.0
        for k in range(drive.shape[1]):
            out[j, k] = s2
            a, b, c, d, e, f = transition(stiffness[k], damping, h)
            u = drive[j, k]
            x, v = a * x + b * v + c * u, d * x + e * v + f * u
            s1 = keep * s1 + (1.0 - keep) * x
            s2 = keep * s2 + (1.0 - keep) * s1
    return out


@njit(nogil=True)
def motor_response(voltage: Array, torque: Array, omega: Array, R_a: float, L_a: float, K_e: float, K_t: float,
                   J_m: float, B_m: float, k_load: float, h: float) -> tuple[Array, Array, Array]:
    """Change of current, speed and rotor angle (K, N) for voltages (V) and torques (N·m) (K, N), to first order."""
    i_out, w_out, angle_out = np.empty_like(voltage), np.empty_like(voltage), np.empty_like(voltage)
    decay = math.exp(-h * R_a / L_a)
    for j in range(voltage.shape[0]):
        i = w = angle = 0.0
        for k in range(voltage.shape[1]):
            i_out[j, k], w_out[j, k], angle_out[j, k] = i, w, angle
            load = (B_m + 2.0 * k_load * abs(omega[k])) / J_m
            goal = (voltage[j, k] - K_e * w) / R_a
            mean = goal + (i - goal) * (1.0 - decay) * L_a / (R_a * h)
            i = goal + (i - goal) * decay
            w1 = (w + h * (K_t * mean + torque[j, k]) / J_m) / (1.0 + h * load)
            angle += 0.5 * h * (w + w1)
            w = w1
    return i_out, w_out, angle_out


def _slow(x: Array, tau: float, h: float) -> Array:
    """First-order lag (N,) of a series."""
    return _lagged(np.ascontiguousarray(x), math.exp(-h / tau))


@njit(nogil=True)
def _lagged(x: Array, keep: float) -> Array:
    out = np.empty_like(x)
    s = x[0]
    for k in range(len(x)):
        s = keep * s + (1.0 - keep) * x[k]
        out[k] = s
    return out


Block = list[tuple[str, str, Array, Array]]
"""Curves at a place before they are weighed: variable, unit, knots (K,), columns (K, N)."""


Places = dict[str, list[tuple[Block, dict[str, Array]]]]
"""Place -> its curves and the response of each channel to them."""


def _curves(train: int, variables: Mapping[str, NDArray[Any]], unit: str, factor: Array | float = 1.0, said: str = ""
            ) -> Block:
    found: Block = []
    for name, x in variables.items():
        basis, knots = hats(x, train=train)
        found.append((name + said, unit, knots, np.ascontiguousarray(basis.T * factor)))
    return found


def _driven(chain: Chain, values: Mapping[str, float], drive: Array) -> dict[str, Array]:
    """Response of the angle (K, N) to torques over inertia (K, N)."""
    model = chain.valued(values)
    n = model.numbers()
    tau = model.sensing["angle_filter_tau"] + model.effects.get("encoder_lag", {}).get("tau", 0.0)
    stiffness = n["mgd_over_J"] * np.cos(chain.arm_motion(values)[0])
    return {"theta": arm_response(drive, stiffness, n["c_over_J"], tau, chain.signals.period)}


def _arm(chain: Chain, values: Mapping[str, float], any_time: bool) -> Places:  # noqa: ARG001
    s = chain.signals
    model = chain.valued(values)
    n = model.numbers()
    theta, rate = chain.arm_motion(values)
    speed = chain.speed
    force = n["L_over_J"] * n["k_thrust"] * speed**2
    t = np.arange(len(s)) * s.period

    def respond(block: Block) -> tuple[Block, dict[str, Array]]:
        return block, _driven(chain, values, np.concatenate([columns for *_, columns in block]))

    thrust = [*_curves(s.train, {"omega": speed}, "rad/s²"),
              *_curves(s.train, {"theta": theta}, "-", force, " (share of the thrust)"),
              *_curves(s.train, {"theta_dot": rate}, "-", force, " (share of the thrust)"),
              *_curves(s.train, {"omega, slowly": _slow(speed, MEMORY, s.period)}, "-", force,
                       " (share of the thrust)"),
              *_curves(s.train, {"slope of omega": np.gradient(_slow(speed, 0.02, s.period), s.period)}, "rad/s²")]
    arm = [*_curves(s.train, {"theta": theta, "theta_dot": rate, "t": t}, "rad/s²"),
           *_curves(s.train, {"theta": theta}, "1/s", rate, " (damping)")]
    shown = [*_curves(s.train, {"theta": theta}, "rad"), *_curves(s.train, {"theta_dot": rate}, "rad")]
    reading = sensing.prepare(model.with_effects({}), s.period)
    columns = np.array([sensing.angle_reading(np.ascontiguousarray(c), np.gradient(c, s.period), reading)
                        for *_, block in shown for c in block])
    return {"thrust": [respond(thrust)], "arm": [respond(arm)], "sensing": [(shown, {"theta": columns})]}


def _motor(chain: Chain, values: Mapping[str, float], any_time: bool) -> Places:
    s = chain.signals
    n = chain.valued(values).numbers()
    i, omega, _ = chain.motor(values)
    t = np.arange(len(s)) * s.period
    theta = np.nan_to_num(_slow(np.nan_to_num(s.theta), 0.02, s.period))

    def respond(block: Block, volts: bool) -> tuple[Block, dict[str, Array]]:
        drive = np.concatenate([columns for *_, columns in block])
        nothing = np.zeros_like(drive)
        out = motor_response(*((drive, nothing) if volts else (nothing, drive)), omega, n["R_a"], n["L_a"], n["K_e"],
                             n["K_t"], n["J_m"], n["B_m"], n["k_load"], s.period)
        return block, dict(zip(("i_a", "omega", "angle"), out, strict=True))

    electrical = [*_curves(s.train, {"i_a": i, "omega": omega, "t": t}, "V"),
                  *_curves(s.train, {"omega": omega, "t": t}, "Ω", i, " (resistance)")]
    rotor = [*_curves(s.train, {"omega": omega, "theta": theta, "t": t}, "N·m"), *_curves(s.train, {"i_a": i}, "N·m")]
    shown = [*_curves(s.train, {"i_a": i, "t": t, "omega": omega}, "A")]
    if any_time:
        electrical += _any_time(s, "V")
        rotor += _any_time(s, "N·m")
        shown += _any_time(s, "A")
    columns = np.concatenate([c for *_, c in shown])
    return {"electrical": [respond(electrical, volts=True)], "rotor": [respond(rotor, volts=False)],
            "sensing": [(shown, {"i_a": columns})]}


def _any_time(s: Signals, unit: str) -> Block:
    """A term free in time, between knots `MOMENT` apart: it asks which place fits, whatever the term depends on."""
    t = np.arange(len(s)) * s.period
    knots = np.arange(0.0, s.train * s.period + MOMENT, MOMENT)
    first = np.searchsorted(t, knots - MOMENT)
    last = np.searchsorted(t, knots + MOMENT)
    columns = np.zeros((len(knots), len(s)))
    for j, (a, b) in enumerate(zip(first, last, strict=True)):
        columns[j, a:b] = np.maximum(1.0 - np.abs(t[a:b] - knots[j]) / MOMENT, 0.0)
    return [(AT_ANY_TIME, unit, knots, columns)]


def _actuator(chain: Chain, values: Mapping[str, float], any_time: bool) -> Places:  # noqa: ARG001
    s = chain.signals
    t = np.arange(len(s)) * s.period
    i = np.nan_to_num(s.i_a)
    late = {f"step of the duty, {k} samples ago": np.roll(np.diff(s.duty, prepend=s.duty[0]), k) for k in range(4)}
    block = [*_curves(s.train, {"duty": s.duty, "i_a": i, "t": t}, "V"),
             *[(name, "V", np.array([1.0]), x[None, :]) for name, x in late.items()]]
    return {"actuator": [(block, {"v_a": np.concatenate([c for *_, c in block])})]}


def _rows(chain: Chain, channel: str, response: Mapping[str, Array], count: int) -> Array:
    """Response (K, M) in the rows of a channel's residual, in units of its noise; zero where it does not show."""
    s = chain.signals
    if channel == "omega" and s.pulses is not None:
        p = s.pulses
        use = (p.index < s.train) & ~p.false
        if "angle" not in response:
            return np.zeros((count, int(use.sum())))
        return np.array([(mean_speed(a, p.time, p.period, s.period) / p.sigma)[use] for a in response["angle"]])
    start = s.after_unseen if channel == "v_a" else 0
    measured = s.true_speed if channel == "omega" else s.channel(channel)
    known = np.isfinite(measured[start:s.train])
    if channel not in response:
        return np.zeros((count, int(known.sum())))
    return response[channel][:, start:s.train][:, known] / s.sigma[channel]


def shapes(chains: Chains, block: str, base: Fit, known: Sequence[Unknown], *, any_time: bool = False,
           torques: Callable[[int], Array] | None = None) -> list[Shape]:
    """The missing term at each place of a part of the chain, the place that explains most first.

    Args:
        chains: cut. block: the part. base: a fit of it. known: the unknowns of that fit that are refitted along.
        any_time: weigh the places of the motor with a term free in time besides (a second or two).
        torques: makes random torques on the arm (D, N), rad/s², of N samples: what of them each place would leave.
    """
    chains = chains.head(MOST_AT_ANY_TIME if any_time else MOST_SAMPLES)
    begun = [Unknown(u.name, u.mean, u.sd, u.low, u.high, base.values[u.name], u.log) for u in known
             if of_recording(u.name)[1] < len(chains.each)]
    residuals = chains.residuals(block)
    search = Search(lambda values: residuals({**base.values, **values}), begun)
    jacobian = search.stacked(search.jacobian())
    weight = np.concatenate([np.full(len(r), w) for r, w in ((search.current[k], search.weight[k])
                                                             for k in search.weight)])
    jacobian = jacobian / weight
    r = np.concatenate([search.current[k] for k in search.weight])
    before = float(np.mean(r * r))
    makers: dict[str, Callable[[Chain, Mapping[str, float], bool], Places]] = {
        "arm": _arm, "motor": _motor, "actuator": _actuator}
    made = [makers[block](chain, chains.own(base.values, k), any_time) for k, chain in enumerate(chains.each)]
    chance = None
    if torques is not None:
        moved = [_driven(chain, chains.own(base.values, k), torques(len(chain.signals)))
                 for k, chain in enumerate(chains.each)]
        chance = np.concatenate([_rows(chains.each[k], channel, moved[k], len(moved[k]["theta"]))
                                 for channel, k in map(of_recording, search.weight)], axis=1)
    found = []
    for place in made[0]:
        curves = made[0][place][0][0]
        count = sum(len(c) for *_, c in curves)
        if any(sum(len(c) for *_, c in own[place][0][0]) != count for own in made):
            made = made[:1]
        columns = []
        for name in search.weight:
            channel, k = of_recording(name)
            columns.append(-_rows(chains.each[k], channel, made[k][place][0][1], count) if k < len(made)
                           else np.zeros((count, len(search.current[name]))))
        basis = np.concatenate(columns, axis=1)
        size = np.maximum(np.sqrt(np.mean(basis**2, axis=1)), 1e-12)
        rows = np.vstack([jacobian, basis / size[:, None]])
        information = rows @ rows.T + np.diag([*np.ones(len(jacobian)), *np.full(count, STIFF * len(r) / 1e3)])
        pull = rows @ r + np.concatenate([search.z, np.zeros(count)])
        solution = -np.linalg.solve(information, pull)
        rest = r + rows.T @ solution
        left = float(np.mean(rest * rest))
        values, drawn = solution[len(jacobian):] / size, []
        at = 0
        for variable, unit, knots, c in curves:
            if variable != AT_ANY_TIME:
                drawn.append(Curve(variable, unit, knots, values[at:at + len(c)]))
            at += len(c)
        of_chance = math.nan
        if chance is not None:
            spared = chance.T - rows.T @ np.linalg.solve(information, rows @ chance.T)
            of_chance = float(np.mean(spared**2) / np.mean(chance**2))
        found.append(Shape(place, drawn, left, before, len(r), independent_samples(rest), of_chance))
    return sorted(found, key=lambda shape: shape.left)
