# SPDX-License-Identifier: Apache-2.0
"""Free curves: the shape of a missing term at each place of the chain, without an effect of the catalogue.

At each place the missing term is a sum of piecewise linear curves, one of each variable: a voltage in the winding, a
torque on the rotor, a force of the air, a torque on the arm, an error of a reading (a semi-parametric discrepancy). Its
effect on the readings is linear to first order. So each place is judged by one least-squares solve, with the
parameters of the model refitted along. The place whose curves explain most is the likeliest one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChain, CutChains
from aeropend_ident.diagnosis.search.linear_response import arm_response, motor_response
from aeropend_ident.estimation.levenberg_marquardt import Search
from aeropend_ident.estimation.map_fit import Fit
from aeropend_ident.estimation.parameter import Parameter, key, started
from aeropend_ident.estimation.residuals import finite
from aeropend_ident.signals.pulses import mean_speed
from aeropend_ident.signals.smoothing import lag
from aeropend_ident.signals.statistics import effective_sample_size
from aeropend_sim.model import sensing

Array = NDArray[np.float64]

KNOTS = 9
"""Knots of a curve, at quantiles of its variable (choice: more draw noise, fewer miss a dead zone).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

STIFF = 1e-3
"""Weight of the prior on each value of a curve, per thousand samples.

Choice: it holds a curve where there are no data.

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

MOMENT = 0.2
"""[s] Distance of the knots of a term that is free in time (choice: shorter than the arm's period).

Measured: at ±30 % no verdict of 2 recordings changes (docs/results/thresholds.md)."""

FREE_IN_TIME = "any time"
"""Name of the variable of a term that is free in time."""

MEMORY = 2.0
"""[s] Time over which the air may remember what the rotor did (choice).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

SLOPE_OVER = 0.02
"""[s] Lag over which slopes of speed and angle are taken: ten samples (choice).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

LATEST = 4
"""Samples after a step of the duty that the voltage is given a value for (choice).

Measured: at ±30 % no verdict of 20 recordings changes (docs/results/thresholds.md)."""

CHANCE = 3.0
"""Ratio of the share that curves explain of a residual to that of white noise above which it counts (choice).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

FOLLOWS = 0.01
"""Share of a mean square that free curves must explain, beyond chance, for a residual to follow inputs and states.

Choice: so little does not change a verdict, and is far above chance with some thousand samples.

Measured: at ±30 % no verdict of 2 recordings changes (docs/results/thresholds.md)."""

LARGEST = 1e30
"""Largest response (choice: one beyond it is of a model that diverges, and products of it are still numbers)."""

FOLDS = 5
"""Blocks of time of a cross-validation (convention)."""

STIFFNESSES = (1e-3, 1e-2, 0.1, 1.0, 10.0)
"""Weights of the prior on curves, per row, of which cross-validation chooses one (choice: from free to held)."""

MOST_SAMPLES = 100_000
"""Samples of training data in which missing terms are sought.

Choice: all curves have to fit into memory at once.

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

MOST_SAMPLES_FREE_IN_TIME = 25_000
"""The same for a term that is free in time (choice: its knots grow in number with the time).

Measured: at ±30 % no verdict of 2 recordings changes (docs/results/thresholds.md)."""


@dataclass(frozen=True)
class Curve:
    """A free curve.

    Attributes:
        variable: that it depends on.
        unit: of its values.
        knot: (K,) values of the variable.
        value: (K,) values of the curve.
    """

    variable: str
    unit: str
    knot: Array
    value: Array


@dataclass(frozen=True)
class MissingTerm:
    """A missing term at a place of the chain.

    Attributes:
        place: of the chain.
        curves: their sum is the term.
        left: mean square residual with the term, in units of a reading's noise.
        before: the same without it.
        samples: number of readings in which it was sought.
        ess: effective sample size of what it leaves.
        left_of_random: share of the mean square of random torques on the arm that it would leave; NaN if not computed.
    """

    place: str
    curves: list[Curve]
    left: float
    before: float
    samples: int
    ess: float
    left_of_random: float = math.nan

    @property
    def explained(self) -> float:
        """Mean square that the curves explain beyond what they would explain of white noise."""
        chance = CHANCE * sum(len(c.value) for c in self.curves) / self.samples
        return max(self.before - self.left - chance * self.before, 0.0)

    @property
    def follows(self) -> bool:
        """Whether the residual follows inputs and states."""
        return self.explained > FOLLOWS * self.before


def knots_of(x: Array, count: int = KNOTS) -> Array:
    """Knots at quantiles of a variable.

    Args:
        x: (N,) values, NaN where missing.
        count: of knots at most.

    Returns:
        (K,) increasing knots; empty if the variable takes too few values.
    """
    known = x[np.isfinite(x)]
    knots = np.unique(np.quantile(known, np.linspace(0.002, 0.998, count))) if len(known) else np.zeros(0)
    if len(knots) < 3:
        return np.zeros(0)
    knots = knots[np.append(True, np.diff(knots) > 1e-3 * float(np.ptp(knots)))]
    return knots if len(knots) >= 3 else np.zeros(0)


def hats(x: Array, knots: Array) -> Array:
    """Piecewise linear basis (K, N) of a variable x (N,) at knots (K,); constant beyond the ends."""
    out = np.zeros((len(knots), len(x)))
    if len(knots):
        filled = np.nan_to_num(x, nan=float(knots[0]))
        left = np.clip(np.searchsorted(knots, filled, side="right") - 1, 0, len(knots) - 2)
        right = np.clip((filled - knots[left]) / np.diff(knots)[left], 0.0, 1.0)
        each = np.arange(len(x))
        out[left, each], out[left + 1, each] = 1.0 - right, right
    return out


Columns = list[tuple[str, str, Array, Array]]
"""Curves at a place before they are fitted: variable, unit, knots (K,), columns (K, N)."""

Places = dict[str, tuple[Columns, dict[str, Array]]]
"""Place -> its curves, and the response (K, N) of each channel to all of them."""

Variables = Mapping[str, Array]
"""Variable of curves -> (N,)."""


@dataclass(frozen=True)
class _Stage:
    """The curves in a stage of the chain of one recording.

    Attributes:
        chain: of the recording.
        values: of the fit that the curves are added to.
        variables: (N,) by name.
        knots: (K,) by name; the same for all recordings.
        any_time: whether to add a term that is free in time.
    """

    chain: CutChain
    values: Mapping[str, float]
    variables: Variables
    knots: Mapping[str, Array]
    any_time: bool

    def curves(self, names: Sequence[str], unit: str, factor: Array | float = 1.0, said: str = "") -> Columns:
        """Curves of some variables, times a factor; `said` is added to their names."""
        return [(name + said, unit, self.knots[name],
                 hats(self.variables[name], self.knots[name]) * (factor * self.acts)) for name in names]

    @cached_property
    def acts(self) -> Array:
        """(N,) 1 where effects act that the model lacks, 0 elsewhere."""
        return np.concatenate([np.full(p.stop - p.start, float(on)) for p, on in self.chain.signals.acting()])

    def free_in_time(self, unit: str) -> Columns:
        """A term that is free in time: it shows which place fits, whatever the term depends on."""
        s = self.chain.signals
        t = s.time
        knots = np.arange(0.0, s.train * s.period + MOMENT, MOMENT)
        first = np.searchsorted(t, knots - MOMENT)
        last = np.searchsorted(t, knots + MOMENT)
        columns = np.zeros((len(knots), len(s)))
        for j, (a, b) in enumerate(zip(first, last, strict=True)):
            columns[j, a:b] = np.maximum(1.0 - np.abs(t[a:b] - knots[j]) / MOMENT, 0.0)
        return [(FREE_IN_TIME, unit, knots, columns)]


def _stacked(columns: Columns) -> Array:
    return np.concatenate([c for *_, c in columns])


def angle_response(chain: CutChain, values: Mapping[str, float], drive: Array) -> dict[str, Array]:
    """Response (K, N) of the angle to torques over inertia (K, N), by channel."""
    model = chain.valued(values)
    n = model.numbers()
    tau = fmean(sensing.filter_stages(model))
    stiffness = n["mgd_over_J"] * np.cos(chain.arm_motion(values)[0])
    return {"theta": arm_response(drive, stiffness, n["c_over_J"], tau, chain.signals.period)}


def _arm_variables(chain: CutChain, values: Mapping[str, float]) -> Variables:
    s = chain.signals
    theta, rate = chain.arm_motion(values)
    return {"omega": chain.speed, "theta": theta, "theta_dot": rate, "t": s.time,
            "omega, slowly": lag(chain.speed, MEMORY, s.period),
            "slope of omega": np.gradient(lag(chain.speed, SLOPE_OVER, s.period), s.period)}


def _arm(stage: _Stage) -> Places:
    chain, s = stage.chain, stage.chain.signals
    model = chain.valued(stage.values)
    n = model.numbers()
    rate = stage.variables["theta_dot"]
    force = n["L_over_J"] * n["k_thrust"] * chain.speed**2
    share = " (share of the thrust)"
    thrust = [*stage.curves(["omega"], "rad/s²"), *stage.curves(["theta"], "-", force, share),
              *stage.curves(["theta_dot"], "-", force, share), *stage.curves(["omega, slowly"], "-", force, share),
              *stage.curves(["slope of omega"], "rad/s²")]
    arm = [*stage.curves(["theta", "theta_dot", "t"], "rad/s²"), *stage.curves(["theta"], "1/s", rate, " (damping)")]
    shown = stage.curves(["theta", "theta_dot", "t"], "rad")
    reading = sensing.prepare(model.with_effects({}), s.period)
    columns = np.array([sensing.angle_reading(np.ascontiguousarray(c), np.gradient(c, s.period), reading)
                        for c in _stacked(shown)])
    return {"thrust": (thrust, angle_response(chain, stage.values, _stacked(thrust))),
            "arm": (arm, angle_response(chain, stage.values, _stacked(arm))), "sensing": (shown, {"theta": columns})}


def _motor_variables(chain: CutChain, values: Mapping[str, float]) -> Variables:
    s = chain.signals
    i, omega, _ = chain.motor(values)
    return {"i_a": i, "omega": omega, "t": s.time,
            "theta": np.nan_to_num(lag(np.nan_to_num(s.theta), SLOPE_OVER, s.period))}


def _motor(stage: _Stage) -> Places:
    n = stage.chain.valued(stage.values).numbers()
    i, omega = stage.variables["i_a"], stage.variables["omega"]

    def response(columns: Columns, *, volts: bool) -> dict[str, Array]:
        drive = _stacked(columns)
        nothing = np.zeros_like(drive)
        out = motor_response(*((drive, nothing) if volts else (nothing, drive)), omega, n["R_a"], n["L_a"], n["K_e"],
                             n["K_t"], n["J_m"], n["B_m"], n["k_load"], stage.chain.signals.period)
        return dict(zip(("i_a", "omega", "angle"), out, strict=True))

    electrical = [*stage.curves(["i_a", "omega", "t"], "V"),
                  *stage.curves(["omega", "t"], "Ω", i, " (resistance)")]
    rotor = stage.curves(["omega", "theta", "t", "i_a"], "N·m")
    shown = stage.curves(["i_a", "t", "omega"], "A")
    if stage.any_time:
        electrical += stage.free_in_time("V")
        rotor += stage.free_in_time("N·m")
        shown += stage.free_in_time("A")
    return {"electrical": (electrical, response(electrical, volts=True)),
            "rotor": (rotor, response(rotor, volts=False)), "sensing": (shown, {"i_a": _stacked(shown)})}


def _actuator_variables(chain: CutChain, values: Mapping[str, float]) -> Variables:  # noqa: ARG001
    s = chain.signals
    return {"duty": s.duty, "i_a": np.nan_to_num(s.i_a), "t": s.time}


def _actuator(stage: _Stage) -> Places:
    s = stage.chain.signals
    late = {f"step of the duty, {k} samples ago": np.roll(np.diff(s.duty, prepend=s.duty[0]), k) for k in range(LATEST)}
    columns = [*stage.curves(["duty", "i_a", "t"], "V"),
               *[(name, "V", np.array([1.0]), x[None, :]) for name, x in late.items()]]
    return {"actuator": (columns, {"v_a": _stacked(columns)})}


_OF_STAGE: dict[str, tuple[Callable[[CutChain, Mapping[str, float]], Variables], Callable[[_Stage], Places]]] = {
    "actuator": (_actuator_variables, _actuator), "motor": (_motor_variables, _motor), "arm": (_arm_variables, _arm)}
"""Stage -> the variables of its curves, and the curves at its places."""


def _rows(chain: CutChain, channel: str, response: Mapping[str, Array], count: int) -> Array:
    """Response (K, M) in the rows of a channel's residual, in units of its noise; zero where it does not act."""
    s = chain.signals
    if channel == "omega" and s.pulses is not None:
        p = s.pulses
        use = (p.index < s.train) & ~p.false
        if "angle" not in response:
            return np.zeros((count, int(use.sum())))
        return np.array([(mean_speed(a, p.time, p.period, s.period) / p.sigma)[use]
                         for a in finite(response["angle"], LARGEST)])
    start = s.after_unseen if channel == "v_a" else 0
    measured = s.true_speed if channel == "omega" else s.channel(channel)
    known = np.isfinite(measured[start:s.train])
    if channel not in response:
        return np.zeros((count, int(known.sum())))
    rows = response[channel][:, start:s.train]
    return finite(rows if known.all() else rows[:, known], LARGEST) / s.sigma[channel]


@dataclass(frozen=True)
class _System:
    """The linear system of a stage: how its residual changes with its parameters and with curves at each place.

    Attributes:
        residual: (N,) in units of a reading's noise, over all channels.
        z: (P,) parameters in standard units.
        jacobian: (P, N) sensitivities to them.
        blocks: rows of each of `FOLDS` blocks of time, one slice a channel.
        curves: place -> its curves.
        basis: place -> (K, N) the change by each value of its curves.
        random: (D, N) the same by random torques on the arm, if they were asked for.
    """

    residual: Array
    z: Array
    jacobian: Array
    blocks: Sequence[Sequence[slice]]
    curves: Mapping[str, Columns]
    basis: Mapping[str, Array]
    random: Array | None

    def solved(self, place: str, spared: Array) -> tuple[MissingTerm, Array]:
        """The missing term at a place, and what it leaves of rows (D, N) beside the residual."""
        jacobian, basis, r = self.jacobian, self.basis[place], self.residual
        count = len(jacobian)
        information, size = self._normal(place)

        def explained(rows: Array, prior: Array | float = 0.0) -> tuple[Array, Array]:
            """Values (P + K, D) with which the columns explain rows (D, N), and what they explain."""
            products = np.concatenate([jacobian @ rows.T, basis @ rows.T]) + prior
            values = np.linalg.solve(information, products / size[:, None]) / size[:, None]
            return values, values[:count].T @ jacobian + values[count:].T @ basis

        values, changes = explained(r[None, :], np.concatenate([self.z, np.zeros(len(basis))])[:, None])
        rest = r - changes[0]
        term = MissingTerm(place, _curves(self.curves[place], -values[count:, 0]), float(np.mean(rest**2)),
                           float(np.mean(r * r)), len(r), effective_sample_size(rest))
        return term, spared - explained(spared)[1]

    def _normal(self, place: str) -> tuple[Array, Array]:
        """Normal equations (P + K, P + K) of parameters and curves, with each curve in units of its RMS; these."""
        jacobian, basis = self.jacobian, self.basis[place]
        mixed, own = jacobian @ basis.T, basis @ basis.T
        size = np.concatenate([np.ones(len(jacobian)), _rms_of_rows(own, len(self.residual))])
        stiff = np.full(len(basis), STIFF * len(self.residual) / 1e3)
        products = np.block([[jacobian @ jacobian.T, mixed], [mixed.T, own]]) / np.outer(size, size)
        return products + np.diag(np.concatenate([np.ones(len(jacobian)), stiff])), size

    def predicted(self, place: str, stiffnesses: Sequence[float]) -> list[float]:
        """Mean square that curves at a place leave of each block of time if they are fitted to all others.

        The normal equations of each block are formed once.

        Args:
            place: of the curves.
            stiffnesses: weights of the prior on the curves, per row.

        Returns:
            The mean square with each of them.
        """
        basis, r = self.basis[place], self.residual
        products = [(sum(basis[:, rows] @ basis[:, rows].T for rows in block),
                     sum(basis[:, rows] @ r[rows] for rows in block), sum(float(r[rows] @ r[rows]) for rows in block))
                    for block in self.blocks]
        size = _rms_of_rows(sum(own for own, *_ in products), len(r))
        products = [(own / np.outer(size, size), mixed / size, square) for own, mixed, square in products]
        gram, moment = sum(own for own, *_ in products), sum(mixed for _, mixed, _ in products)
        left = []
        for stiffness in stiffnesses:
            prior = stiffness * len(r) * np.eye(len(size))
            squares = 0.0
            for own, mixed, square in products:
                values = np.linalg.solve(gram - own + prior, moment - mixed)
                squares += square - 2.0 * float(values @ mixed) + float(values @ own @ values)
            left.append(squares / len(r))
        return left


def _rms_of_rows(gram: Array, count: int) -> Array:
    """RMS of rows by their products (K, K) over `count` columns."""
    return np.maximum(np.sqrt(np.diag(gram) / count), 1e-12)


def _system(chains: CutChains, stage: str, base: Mapping[str, float], known: Sequence[Parameter], *,
            any_time: bool = False, torques: Callable[[int], Array] | None = None) -> _System:
    """The system of a stage around the values of a fit; arguments as for `missing_terms`."""
    here = [p for p in known if key(p.name).recording < len(chains.each)]
    residuals = chains.residuals(stage)
    search = Search(lambda values: residuals({**base, **values}), started(here, base))
    jacobian = search.stacked(search.jacobian())
    channels = [key(k) for k in search.weight]
    counts = [len(search.current[k]) for k in search.weight]
    weight = np.repeat(list(search.weight.values()), counts)
    ends = [[end - n + math.ceil(k * n / FOLDS) for k in range(FOLDS + 1)]
            for end, n in zip(accumulate(counts), counts, strict=True)]
    blocks = [[slice(e[k], e[k + 1]) for e in ends] for k in range(FOLDS)]
    values = [chains.values_of(base, k) for k in range(len(chains.each))]
    variables_of, places_of = _OF_STAGE[stage]
    variables = [variables_of(chain, own) for chain, own in zip(chains.each, values, strict=True)]
    knots = {name: knots_of(np.concatenate([v[name][:chain.signals.train]
                                            for v, chain in zip(variables, chains.each, strict=True)]))
             for name in variables[0]}
    made = [places_of(_Stage(chain, own, v, knots, any_time))
            for chain, own, v in zip(chains.each, values, variables, strict=True)]

    def rows(responses: Sequence[Mapping[str, Array]], count: int) -> Array:
        return np.concatenate([_rows(chains.each[k.recording], k.name, responses[k.recording], count)
                               for k in channels], axis=1)

    random = None
    if torques is not None:
        moved = [angle_response(chain, own, torques(len(chain.signals)))
                 for chain, own in zip(chains.each, values, strict=True)]
        random = rows(moved, len(moved[0]["theta"]))
    curves = {place: columns for place, (columns, _) in made[0].items()}
    basis = {place: -rows([m[place][1] for m in made], sum(len(c) for *_, c in columns))
             for place, columns in curves.items()}
    return _System(np.concatenate([search.current[k] for k in search.weight]), search.z, jacobian / weight, blocks,
                   curves, basis, random)


def missing_terms(chains: CutChains, stage: str, base: Fit, known: Sequence[Parameter], *, any_time: bool = False,
                  torques: Callable[[int], Array] | None = None) -> list[MissingTerm]:
    """The missing term at each place of a stage, the place that explains most first.

    Args:
        chains: cut.
        stage: of the chain.
        base: a fit of the stage.
        known: the parameters of that fit that are refitted along.
        any_time: add a term that is free in time at each place of the motor; of the first recording only, as such a
            term has nothing in common between recordings.
        torques: makes random torques over inertia (D, N), [rad/s²], of N samples; the share of them that the curves of
            each place would leave is computed.
    """
    if any_time:
        chains = chains.head(min(MOST_SAMPLES_FREE_IN_TIME, chains.each[0].signals.train))
    else:
        chains = chains.head(MOST_SAMPLES)
    system = _system(chains, stage, base.values, known, any_time=any_time, torques=torques)
    random = np.zeros((0, len(system.residual))) if system.random is None else system.random
    found = []
    for place in system.curves:
        term, left = system.solved(place, random)
        of_random = float(np.mean(left**2) / np.mean(random**2)) if len(random) else math.nan
        found.append(replace(term, left_of_random=of_random))
    return sorted(found, key=lambda term: term.left)


@dataclass(frozen=True)
class Repeatable:
    """How much of a stage's rest repeats: a function of inputs and states predicts it where it was not fitted.

    Attributes:
        place: whose curves predict most of it.
        share: of the mean square above the noise.
    """

    place: str
    share: float


def repeatable(chains: CutChains, stage: str, values: Mapping[str, float]) -> Repeatable:
    """The share of a stage's rest that repeats, by cross-validation over blocks of time.

    Free curves at each place are added to the model, fitted to all blocks but one, and judged on that one. The whole
    recordings count.

    Args:
        chains: cut.
        stage: of the chain.
        values: of the model whose rest is judged.
    """
    whole = copy(chains)
    whole.each = [replace(c, signals=replace(c.signals, train=len(c.signals))) for c in chains.each]
    system = _system(whole.head(MOST_SAMPLES), stage, values, [])
    before = float(np.mean(system.residual**2))
    found = [(left, place) for place in system.curves for left in system.predicted(place, STIFFNESSES)]
    left, place = min(found)
    return Repeatable(place, min(max((before - left) / max(before - 1.0, 1e-12), 0.0), 1.0))


def _curves(columns: Columns, values: Array) -> list[Curve]:
    """The fitted curves of a place, without a term that is free in time."""
    drawn, at = [], 0
    for variable, unit, knots, c in columns:
        if variable != FREE_IN_TIME:
            drawn.append(Curve(variable, unit, knots, values[at:at + len(c)]))
        at += len(c)
    return drawn
