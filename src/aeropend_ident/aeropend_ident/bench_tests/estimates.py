# SPDX-License-Identifier: Apache-2.0
"""Parameters of the motor and the propeller from bench tests: steady states, and a step of the current.

Each test takes `Rows`, a table of readings that was typed in or made from the plateaus of a recording, and returns
`Estimate`s. If the rows have no standard deviations, the scatter of the rows gives the uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

from aeropend_ident.bags.recording import Recording, holds
from aeropend_ident.identification.terms import Array
from aeropend_ident.tables.units import RPM
from aeropend_sim.cli.command import called
from aeropend_sim.errors import UserError
from aeropend_sim.model import actuator
from aeropend_sim.model.parameters import PARAMETERS
from aeropend_sim.wording import counted

GEAR = 55.0 / 9.0
"""Gear ratio N1/N2 of the thesis. Its K_q refers to the propeller's side: k_thrust = K_q (55/9)² (3.3, 3.4)."""

SURE = 3.0
"""Number of standard deviations above which a deviation is reported. Convention: the three-sigma rule."""

SETTLED = 0.01
"""Change within a plateau, as a share of the channel's range, up to which a reading counts as steady. Choice."""

HOLD = 1.0
"""[s] Least length of a plateau of the duty; its last half is used. Choice."""


FEWEST = 30
"""Samples of a recording below which the winding is not fitted (choice: ten for each parameter)."""

FAR = 100.0
"""Logarithm beyond which no resistance or time constant lies (choice: its exponential is a number)."""


class BenchTestError(UserError):
    """A table or a recording that a bench test cannot use; the message is one line for the user."""


@dataclass(frozen=True)
class Rows:
    """Readings, row by row, in SI units.

    Attributes:
        name: of the source, for messages.
        columns: quantity -> (N,) readings: t, v_a, i_a, omega, duty, thrust, theta.
        sigma: quantity -> (N,) standard deviations, where they are known.
        notes: remarks from reading the source.
    """

    name: str
    columns: Mapping[str, Array]
    sigma: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def where(self, keep: NDArray[np.intp]) -> Rows:
        """The rows with these indices."""
        return Rows(self.name, {k: x[keep] for k, x in self.columns.items()},
                    {k: x[keep] for k, x in self.sigma.items()})

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def take(self, *names: str, least: int = 3) -> list[Array]:
        """Columns, then their standard deviations (0: unknown), without rows in which a value is missing.

        Args:
            *names: of the columns.
            least: number of rows that are needed.

        Raises:
            BenchTestError: a column is missing, or fewer than `least` rows are complete.
        """
        for name in names:
            if name not in self.columns:
                raise BenchTestError(f"{self.name}: there is no column {name}; it has {', '.join(self.columns)}")
        table = np.column_stack([self.columns[name] for name in names]
                                + [self.sigma.get(name, np.zeros(len(self))) for name in names])
        table = table[np.isfinite(table).all(axis=1)]
        if len(table) < least:
            raise BenchTestError(f"{self.name}: {len(table)} rows hold {' and '.join(names)}; give at least {least}, "
                                 "or of a recording that many duties, each held for some seconds (excite --ros-args "
                                 "-p kind:=staircase)")
        return list(table.T)


@dataclass(frozen=True)
class Estimate:
    """An estimate of a parameter.

    Attributes:
        value: in `unit`.
        sigma: its standard deviation.
        unit: SI unit; "-" for none.
        how: the estimator, in words.
        scatter: standard deviation of a single row; NaN if there is none.
    """

    value: float
    sigma: float
    unit: str
    how: str
    scatter: float = math.nan


@dataclass(frozen=True)
class Panel:
    """Readings and the fitted curve, for a plot.

    Attributes:
        title: of the panel.
        x_label: label of the horizontal axis.
        y_label: label of the vertical axis.
        x: (N,) readings.
        y: (N,) readings.
        curve: fitted y for given x.
    """

    title: str
    x_label: str
    y_label: str
    x: Array
    y: Array
    curve: Callable[[Array], Array]


@dataclass(frozen=True)
class Found:
    """The result of a bench test.

    Attributes:
        source: name of the table or recording.
        rows: number of rows that were used.
        numbers: parameter of the model file -> estimate.
        others: other quantities -> estimate.
        notes: remarks for the user.
        panels: for the plot.
    """

    source: str
    rows: int
    numbers: Mapping[str, Estimate]
    others: Mapping[str, Estimate] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    panels: tuple[Panel, ...] = ()


def mean_of(values: Array, unit: str, how: str, sigma: Array | None = None) -> Estimate:
    """The mean of rows, its standard deviation, and the scatter of the rows.

    With standard deviations the mean is weighted. Scatter beyond them is a variance that all rows have in common
    (DerSimonian and Laird, Controlled Clinical Trials 7, 1986).

    Args:
        values: (N,) a value for each row.
        unit: of the values.
        how: the estimator, in words.
        sigma: (N,) standard deviations of the rows; None or 0: unknown.
    """
    scatter = float(np.std(values, ddof=1))
    weights = np.ones(len(values)) / scatter**2 if scatter > 0.0 else np.ones(len(values))
    if sigma is not None and (sigma > 0.0).all():
        w = sigma**-2.0
        excess = float(np.sum(w * (values - np.average(values, weights=w)) ** 2)) - (len(values) - 1)
        weights = 1.0 / (sigma**2 + max(excess, 0.0) / float(w.sum() - np.sum(w * w) / w.sum()))
    spread = 1.0 / math.sqrt(float(weights.sum())) if scatter > 0.0 else 0.0
    return Estimate(float(np.average(values, weights=weights)), spread, unit, how, scatter)


def blocked_rotor(rows: Rows) -> Found:
    """R_a from pairs of armature voltage and current with the rotor blocked (thesis 4.4.1, Table 4.1): the mean of v/i.

    Raises:
        BenchTestError: columns or rows are missing, no current flows, or the rotor turned.
    """
    v, i, dv, di = rows.take("v_a", "i_a")
    if "omega" in rows.columns and np.nanmax(np.abs(rows.columns["omega"])) > 0.0:
        raise BenchTestError(f"{rows.name}: the rotor turned, so v_a is not R_a i_a; block it, or use --steady")
    _positive(rows, i_a=i, v_a=v)
    found = mean_of(v / i, "Ω", "mean of v_a/i_a", np.hypot(dv, v / i * di) / i)
    notes = []
    (slope, offset), covariance = np.polyfit(i, v, 1, cov=True) if len(v) > 3 else ((found.value, 0.0), np.eye(2))
    if abs(offset) > SURE * math.sqrt(covariance[1, 1]):
        notes.append(f"v_a is {offset:.2g} V ± {math.sqrt(covariance[1, 1]):.1g} where i_a is 0: a reading is offset, "
                     f"or the brushes drop it; the slope alone gives R_a = {slope:.4g} Ω")
    return Found(rows.name, len(v), {"R_a": found}, notes=tuple(notes), panels=(
        Panel("blocked rotor", "i_a / A", "v_a / V", i, v, lambda x: found.value * x),))


def current_step(rows: Rows, resistance: Estimate) -> Found:
    """L_a from the current after a step of the voltage, rotor blocked (thesis 4.4.2): i = i_end (1 - exp(-(t - t0)/τ)).

    The table starts at the step or before it. The time of the step is fitted. L_a = τ R_a.

    Args:
        rows: t and i_a.
        resistance: R_a.

    Raises:
        BenchTestError: columns or rows are missing, or the current does not rise.
    """
    t, i, _, _ = rows.take("t", "i_a", least=6)
    order = np.argsort(t, kind="stable")
    t, i = t[order], i[order]
    end = float(np.median(i[-max(3, len(i) // 4):]))
    noise = float(np.std(i[-max(3, len(i) // 4):]))
    if end <= SURE * noise or end <= 0.0:
        raise BenchTestError(f"{rows.name}: the current does not rise above its noise; give the readings around a step "
                             "of the voltage with the rotor blocked")
    over = np.flatnonzero(i > 0.632 * end)[0]
    start = t[max(int(over) - 1, 0)]

    def left(p: Array) -> Array:
        return np.asarray(p[0] * -np.expm1(-np.maximum(t - p[2], 0.0) / math.exp(p[1])) - i)

    span = max(float(t[over] - t[0]), float(np.median(np.diff(t))))
    fit = least_squares(left, [end, math.log(0.5 * span), start], x_scale=[end, 1.0, span])
    freedom = max(len(t) - 3, 1)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * 2.0 * fit.cost / freedom
    tau, spread = math.exp(fit.x[1]), math.sqrt(covariance[1, 1])
    during = int(np.sum((t > fit.x[2]) & (t < fit.x[2] + 3.0 * tau)))
    notes = []
    if during < 3:
        notes.append(f"only {during} readings fall within 3 τ of the step: sample faster for a reliable τ")
    time_constant = Estimate(tau, tau * spread, "s", "exponential fit")
    inductance = Estimate(tau * resistance.value, tau * resistance.value
                          * math.hypot(spread, resistance.sigma / resistance.value), "H", "τ_e R_a")
    a, t0 = float(fit.x[0]), float(fit.x[2])
    return Found(rows.name, len(t), {"L_a": inductance}, {"τ_e": time_constant}, tuple(notes), (
        Panel("current step", "t / s", "i_a / A", t, i, lambda x: a * -np.expm1(-np.maximum(x - t0, 0.0) / tau)),))


def blocked_recording(recording: Recording, name: str) -> Found:
    """R_a and L_a from a recording of duty steps with the rotor blocked, by a fit of the current to the voltage.

    The model of the winding is L_a di/dt = v_a - R_a i_a (thesis 3.5 at ω = 0).

    Args:
        recording: the recording.
        name: of it, for messages.

    Raises:
        BenchTestError: channels are missing, no current flows, or the rotor turned.
    """
    v, i, t = recording.v_a, recording.i_a, recording.t
    for channel in ("v_a", "i_a"):
        if channel not in recording.channels:
            raise BenchTestError(f"{name}: {channel} was not measured: record it too (armature)")
    if "omega" in recording.channels and np.nanmax(np.abs(recording.omega)) > 0.0:
        raise BenchTestError(f"{name}: the rotor turned, so v_a is not R_a i_a; block it, or use --steady")
    if len(recording.gaps) or not np.isfinite(np.column_stack([v, i])).all():
        raise BenchTestError(f"{name}: samples or readings are missing; record again")
    if len(t) < FEWEST:
        raise BenchTestError(f"{name}: {counted(len(t), 'sample')}; give {FEWEST} or more")
    starts, sizes = holds(recording.duty)
    held = np.repeat(np.add.reduceat(v, starts) / sizes, sizes)  # the voltage over each hold, without its noise
    before = np.append(held[0], held[:-1])
    if np.ptp(np.add.reduceat(i, starts) / sizes) < SURE * float(np.std(np.diff(i))):
        raise BenchTestError(f"{name}: no current flows above its noise; record steps of the duty")

    power = float(held @ i)
    if not power > 0.0:
        raise BenchTestError(f"{name}: the current flows against the voltage; turn one of them over")

    def current(p: Array) -> Array:
        """p: log R_a, log τ, and the share of a period by which a new voltage acts before the sample that shows it."""
        tau, share = math.exp(p[1]), float(p[2])
        decay, late = math.exp(-recording.period / tau), math.exp(-share * recording.period / tau)
        driven = math.exp(-p[0]) * ((1.0 - late) * held + (late - decay) * before)
        driven[0] = i[0]
        return np.asarray(lfilter([1.0], [1.0, -decay], driven))

    start = [math.log(power / float(i @ i)), math.log(recording.period), 0.25]
    fit = least_squares(lambda p: current(p) - i, start, bounds=([-FAR, -FAR, 0.0], [FAR, FAR, 1.0]),
                        diff_step=1e-4, x_scale=[0.01, 0.1, 0.1])
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * 2.0 * fit.cost / (len(t) - 3)
    r, tau = math.exp(fit.x[0]), math.exp(fit.x[1])
    spread = np.sqrt(np.diag(covariance))
    inductance = Estimate(r * tau, r * tau * math.sqrt(max(float(covariance[:2, :2].sum()), 0.0)),
                          "H", "τ_e R_a")
    resistance = Estimate(r, r * float(spread[0]), "Ω", "fit of the winding")
    time_constant = Estimate(tau, tau * float(spread[1]), "s", "fit of the winding")
    run = current(fit.x)
    return Found(name, len(t), {"R_a": resistance, "L_a": inductance}, {"τ_e": time_constant}, (), (
        Panel("blocked rotor: the current", "t / s", "i_a / A", t, i, lambda x: np.interp(x, t, run)),))


def steady(rows: Rows, resistance: Estimate) -> Found:
    """K_e from steady states (thesis 4.4.3, Table 4.2), and the load torque: K_e = (v_a - R_a i_a)/ω, K_t = K_e.

    The electrical power K_e i_a ω reaches the shaft without loss, so both constants are equal in SI units.
    The load is k_load ω², plus a viscous part B_m ω if the rows show one.

    Args:
        rows: v_a, i_a and omega.
        resistance: R_a.

    Raises:
        BenchTestError: columns or rows are missing, or the rotor stood.
    """
    v, i, w, dv, di, dw = rows.take("v_a", "i_a", "omega")
    _positive(rows, v_a=v, i_a=i, omega=w)
    emf = v - resistance.value * i
    constant = mean_of(emf / w, "V·s/rad", "mean of (v_a - R_a i_a)/ω",
                       np.sqrt(dv**2 + (resistance.value * di) ** 2 + (emf / w * dw) ** 2) / w)
    by_resistance = resistance.sigma * float(np.mean(i / w))
    constant = Estimate(constant.value, math.hypot(constant.sigma, by_resistance), constant.unit, constant.how,
                        constant.scatter)
    if constant.value <= 0.0:
        raise BenchTestError(f"{rows.name}: R_a i_a exceeds v_a, so R_a = {resistance.value:g} Ω is too high; check it")
    torque = constant.value * i
    load = mean_of(torque / w**2, "N·m·s²/rad²", "mean of K_t i_a/ω²",
                   constant.value * np.hypot(di, 2.0 * i / w * dw) / w**2)
    numbers = {"K_e": constant, "K_t": constant}
    viscous = Estimate(0.0, 0.0, "N·m·s/rad", "not seen")
    if np.unique(w).size > 3:
        # without their own uncertainty, rows have equal relative weight
        weight = 1.0 / (constant.value * np.hypot(di, 2.0 * i / w * dw) if (di > 0.0).all() else torque)
        (b, k), covariance = _lines(weight[:, None] * np.column_stack([w, w * w]), weight * torque)
        sd = np.sqrt(np.diag(covariance))
        if b > SURE * sd[0] and k > 0.0:
            viscous = Estimate(float(b), float(sd[0]), "N·m·s/rad", "fit of K_t i_a = B_m ω + k_load ω²")
            load = Estimate(float(k), float(sd[1]), load.unit, viscous.how)
    numbers |= {"k_load": load, "B_m": viscous}
    others = {"K_e in V/RPM": Estimate(constant.value * RPM, constant.sigma * RPM, "V/RPM", "K_e 2π/60",
                                       constant.scatter * RPM)}
    return Found(rows.name, len(v), numbers, others, (), (
        Panel("back-EMF", "ω / rad/s", "v_a - R_a i_a / V", w, emf, lambda x: constant.value * x),
        Panel("load", "ω / rad/s", "K_t i_a / N·m", w, torque, lambda x: viscous.value * x + load.value * x * x)))


def duty_map(rows: Rows, base: Mapping[str, float]) -> Found:
    """The duty map v = k0 + k1 sqrt(k2 τ + k3) (thesis 4.3), by least squares over the rows above its dead zone.

    Only two of k1, k2 and k3 can be determined: k1 keeps its value in `base`.

    Args:
        rows: duty and v_a.
        base: parameters of the base model.

    Raises:
        BenchTestError: columns or rows are missing, or no such map fits them.
    """
    duty, v, _, dv = rows.take("duty", "v_a", least=4)
    if duty.min() < 0.0 or duty.max() > 1.0:
        raise BenchTestError(f"{rows.name}: duty goes from {duty.min():g} to {duty.max():g}; give it as 0..1, or in %")
    alive = v > SURE * dv
    if np.unique(duty[alive]).size < 4:
        raise BenchTestError(f"{rows.name}: {np.unique(duty[alive]).size} duties give a voltage; the map has three "
                             "parameters, give at least 4")
    k1 = base["k1"] or float(PARAMETERS["model.k1"].high) * 1e-4
    x, y = duty[alive], v[alive]

    def left(p: Array) -> Array:
        return np.asarray(p[0] + np.sqrt(np.exp(p[1]) * x + np.exp(p[2])) - y)

    starts = [(float(y.min()) - lift, math.log(max(float(np.ptp(y) + lift) ** 2, 1e-6)), math.log(max(lift**2, 1e-8)))
              for lift in (0.03, 0.3, 3.0)]
    fit = min((least_squares(left, s) for s in starts), key=lambda one: float(one.cost))
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * 2.0 * fit.cost / max(len(x) - 3, 1)
    sd = np.sqrt(np.diag(covariance))
    k2, k3 = math.exp(fit.x[1]) / k1**2, math.exp(fit.x[2]) / k1**2
    how = "least squares, k1 kept"
    numbers = {"k0": Estimate(float(fit.x[0]), float(sd[0]), "V", how), "k1": Estimate(k1, 0.0, "V", "kept: a scale"),
               "k2": Estimate(k2, k2 * float(sd[1]), "-", how), "k3": Estimate(k3, k3 * float(sd[2]), "-", how)}
    for name, one in numbers.items():
        p = PARAMETERS[f"model.{name}"]
        if not p.low <= one.value <= p.high:
            raise BenchTestError(f"{rows.name}: no map of the form k0 + k1 sqrt(k2 τ + k3) fits its rows "
                                 f"({name} = {one.value:.3g})")
    values = {name: one.value for name, one in numbers.items()}
    mse = Estimate(float(np.mean((actuator.voltage(values, x) - y) ** 2)), 0.0, "V²", "mean squared error")
    dead = int((~alive).sum())
    notes = (f"{dead} rows with no voltage were left out: the dead zone",) if dead else ()
    return Found(rows.name, len(x), numbers, {"MSE": mse}, notes, (
        Panel("duty map", "duty", "v_a / V", duty, v, lambda x: actuator.voltage(values, x)),))


def thrust_curve(rows: Rows, numbers: Mapping[str, float]) -> Found:
    """Thrust over the voltage (thesis 4.4), its inverse (4.5), and k_thrust = f/ω² with the exponent that fits best.

    Args:
        rows: thrust, or theta (the arm is the scale: f = (mgd/L) sin θ); and omega, v_a or duty.
        numbers: parameters of the model and of other tests; they give the speed where it was not read.

    Raises:
        BenchTestError: columns or rows are missing, or there is no thrust.
    """
    notes: list[str] = []
    columns, sigma = dict(rows.columns), dict(rows.sigma)
    if "thrust" not in columns:
        if "theta" not in columns:
            raise BenchTestError(f"{rows.name}: there is neither thrust nor theta; it has {', '.join(columns)}")
        weight = numbers["mgd_over_J"] / numbers["L_over_J"]
        columns["thrust"] = weight * np.sin(columns["theta"])
        if "theta" in sigma:
            sigma["thrust"] = weight * np.abs(np.cos(columns["theta"])) * sigma["theta"]
        notes.append("the thrust is computed from the angle of the arm: it is as accurate as the model's "
                     f"mgd_over_J/L_over_J = {weight:.4g} N")
    if "v_a" not in columns and "duty" in columns:
        columns["v_a"] = actuator.voltage(numbers, columns["duty"])
        notes.append("the voltage is computed by the model's duty map")
    if "omega" not in columns and "v_a" in columns:
        columns["omega"] = actuator.speed_at(numbers, columns["v_a"])
        notes.append("the speed is computed by the model's motor from the voltage")
    every = Rows(rows.name, columns, sigma)
    made = every.where(np.flatnonzero((columns["thrust"] > 0.0) & (columns.get("omega", columns["thrust"]) > 0.0)))
    w, f, dw, df = made.take("omega", "thrust", least=4)
    relative = np.hypot(df / f, 2.0 * dw / w)
    k = mean_of(f / w**2, "N·s²/rad²", "mean of f/ω²", f / w**2 * relative)
    x = np.log(w / np.exp(np.mean(np.log(w))))
    weight_ = 1.0 / relative if (relative > 0.0).all() else np.ones(len(w))
    (_, n), covariance = _lines(weight_[:, None] * np.column_stack([np.ones(len(x)), x]), weight_ * np.log(f),
                                least=1.0 if (relative > 0.0).all() else 0.0)
    exponent = Estimate(float(n), math.sqrt(covariance[1, 1]), "-", "slope of log f over log ω")
    others = {"exponent of ω": exponent,
              "K_q": Estimate(k.value / GEAR**2, k.sigma / GEAR**2, "N·s²/rad²", "k_thrust/(55/9)²: thesis (3.3)")}
    if abs(exponent.value - 2.0) > SURE * exponent.sigma:
        notes.append(f"the thrust grows with ω^{exponent.value:.3f} ± {exponent.sigma:.2g} rather than ω²")
    panels = [Panel("thrust over speed", "ω / rad/s", "f / N", w, f, lambda x: k.value * x * x)]
    if "v_a" in columns:
        v, f, _, _ = every.take("v_a", "thrust", least=4)
        p, spread = _lines(np.column_stack([v * v, v, np.ones(len(v))]), f)
        for name, value, sd, unit in zip("abc", p.tolist(), np.sqrt(np.diag(spread)).tolist(), ("N/V²", "N/V", "N")):
            others[f"{name} of f = a v² + b v + c"] = Estimate(value, sd, unit, "least squares")
        panels.append(Panel("thrust over voltage", "v_a / V", "f / N", v, f, lambda x: np.asarray(np.polyval(p, x))))
    return Found(rows.name, len(w), {"k_thrust": k}, others, tuple(notes), tuple(panels))


def thrust_to_voltage(a: float, b: float, c: float) -> tuple[float, float, float, float]:
    """The inverse of f = a v² + b v + c (thesis 4.4) as v = p + q sqrt(r + s f) (4.5): p, q, r, s.

    Args:
        a: [N/V²] coefficient of v².
        b: [N/V] coefficient of v.
        c: [N] constant.

    Raises:
        ValueError: a is not positive; there is no such inverse.
    """
    if not a > 0.0:
        raise ValueError(f"a = {a:g} N/V²: the inverse needs a positive a")
    return -b / (2.0 * a), 1.0 / (2.0 * a), b * b - 4.0 * a * c, 4.0 * a


def plateaus(recording: Recording, channels: Sequence[str], name: str) -> Rows:
    """The steady states of a recording: the mean of each channel over the last half of each hold of the duty.

    A hold counts if it lasts `HOLD` and the two quarters of its last half agree within their noise or `SETTLED`.

    Args:
        recording: the recording.
        channels: that are averaged.
        name: of the recording, for messages.

    Raises:
        BenchTestError: a channel was not measured, or fewer than three holds settled.
    """
    missing = [c for c in channels if c not in recording.channels]
    if missing:
        raise BenchTestError(f"{name}: {', '.join(missing)} was not measured: record it too")
    starts, sizes = holds(recording.duty)
    resolution = {c: _step(getattr(recording, c)) / math.sqrt(12.0) for c in channels}
    rows: list[list[float]] = []
    sigmas: list[list[float]] = []
    unsettled = 0
    for start, end in zip(starts.tolist(), (starts + sizes).tolist()):
        if recording.t[end - 1] - recording.t[start] < HOLD:
            continue
        half = slice((start + end) // 2, end)
        quarters = [part for c in channels for part in np.array_split(getattr(recording, c)[half], 2)]
        if not all(np.isfinite(part).any() for part in quarters):
            unsettled += 1
            continue
        means, spreads, steady_ = [], [], True
        for c in channels:
            x = getattr(recording, c)
            first, second = np.array_split(x[half], 2)
            noise = math.hypot(float(np.nanstd(first)) / math.sqrt(len(first)), resolution[c])
            close = max(SURE * math.sqrt(2.0) * noise, SETTLED * float(np.nanmax(x) - np.nanmin(x)))
            steady_ &= bool(abs(np.nanmean(first) - np.nanmean(second)) <= close)
            means.append(float(np.nanmean(x[half])))
            spreads.append(math.hypot(float(np.nanstd(x[half])) / math.sqrt(end - half.start), resolution[c]))
        unsettled += not steady_
        if steady_:
            rows.append(means)
            sigmas.append(spreads)
    if len(rows) < 3:
        raise BenchTestError(f"{name}: {', '.join(channels)} settle in {len(rows)} holds of the duty, and do not in "
                             f"{unsettled}; hold at least 3 duties for longer: `{called('excite', 'aeropend_control')} "
                             "--ros-args -p kind:=staircase -p duration:=120.0`")
    table, spread = np.array(rows), np.array(sigmas)
    return Rows(name, dict(zip(channels, table.T)), dict(zip(channels, spread.T)))


def _step(x: Array) -> float:
    """Resolution of readings: the least difference between two of them."""
    values = np.unique(x[np.isfinite(x)])
    return float(np.diff(values).min()) if len(values) > 1 else 0.0


def _lines(terms: Array, y: Array, least: float = 0.0) -> tuple[Array, Array]:
    """Linear least squares, and the covariance of the coefficients.

    Args:
        terms: (N, P).
        y: (N,).
        least: lower limit of the variance of a row, which is estimated from the residuals.
    """
    p = np.asarray(np.linalg.lstsq(terms, y, rcond=None)[0])
    left = y - terms @ p
    variance = max(float(left @ left) / max(len(y) - len(p), 1), least)
    return p, np.linalg.inv(terms.T @ terms) * variance


def _positive(rows: Rows, **columns: Array) -> None:
    for name, x in columns.items():
        if not (x > 0.0).all():
            at = int(np.flatnonzero(~(x > 0.0))[0])
            raise BenchTestError(f"{rows.name}: {name} = {x[at]:g} in row {at + 1}; leave out rows without a reading")
