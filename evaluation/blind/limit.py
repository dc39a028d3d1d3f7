# SPDX-License-Identifier: Apache-2.0
"""The limit: how often a likelihood ratio test that knows both hypotheses exactly names the right effect.

Two hypotheses whose noise-free readings lie a distance d apart, in standard deviations over all samples, are separated
with probability Φ(d/2). Every other effect is a rival; it may choose the model's numbers within their uncertainty and
its own parameters freely to imitate the truth. The one that comes closest sets the limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.special import ndtr
from threadpoolctl import threadpool_limits

from aeropend_ident.signals.pulses import mean_speed
from aeropend_sim.model import dynamics, sensing
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH, RANDOM, EffectParameter
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load

Array = NDArray[np.float64]

OFF = 0.05
"""Share by which each number may be off."""

STRAYED = 0.5
"""Share by which the number may be off that a rival `parameter_mismatch` blames."""

THIN = 6
"""Every so many samples are compared, and weighed as so many: without noise the readings are smooth."""

SCREENED, REFINED = 4, 12
"""Steps of the search for every rival with the numbers' derivatives at the truth, and for the closest with its own."""

CLOSEST = 4
"""How many rivals are refined."""


@dataclass(frozen=True)
class Coordinate:
    """A number that a hypothesis may choose, on a scale on which 1 is a lot.

    Attributes:
        name: `R_a`, or `effect.parameter`. origin, scale: value = origin + scale x, or origin exp(scale x) if `log`.
        low, high: bounds of x. start: of x.
    """

    name: str
    origin: float
    scale: float
    low: float
    high: float
    start: float = 0.0
    log: bool = False

    def value(self, x: float) -> float:
        """The number at x."""
        return float(self.origin * math.exp(self.scale * x) if self.log else self.origin + self.scale * x)


@dataclass(frozen=True)
class Descent:
    """Where a search ended: x (P,), the residual there, and its sum of squares."""

    x: Array
    residual: Array
    cost: float


def numbers_within(model: Model, off: float, free: str = "") -> list[Coordinate]:
    """The model's numbers, each within a share `off` of nominal; `free` within `STRAYED`."""
    coordinates = []
    for name, value in model.model.items():
        if value != 0.0:
            share = STRAYED if name == free else off
            coordinates.append(Coordinate(name, value, abs(value), -share, share))
    return coordinates


def starts_of(effect: str) -> Iterator[list[Coordinate]]:
    """The parameters of an effect, at each place from which a search should begin."""
    parameters = CATALOGUE[effect].parameters
    size, others = CATALOGUE[effect].size, [n for n in parameters if n != CATALOGUE[effect].size]
    p = parameters[size]
    step = abs(p.default - p.neutral)
    low, high = (p.low - p.neutral) / step, (p.high - p.neutral) / step
    heads = [Coordinate(f"{effect}.{size}", p.neutral, step, low, high, x) for x in (0.2, -0.2) if low < x < high]
    grids = [list(_places(f"{effect}.{n}", parameters[n], few=k > 0)) for k, n in enumerate(others)]
    for head, *rest in product(heads[:1] if grids else heads, *grids):
        yield [head, *rest]


def _places(name: str, p: EffectParameter, few: bool) -> Iterator[Coordinate]:
    if p.low > 0.0:
        spread = math.log(p.high / p.low)
        low, high = math.log(p.low / p.default), math.log(p.high / p.default)
        for f in (0.0,) if few else (-0.3, -0.12, 0.0, 0.12, 0.3):
            yield Coordinate(name, p.default, 1.0, low, high, min(max(f * spread, low), high), log=True)
    else:
        half = 0.5 * (p.high - p.low)
        for f in (0.0,) if few else (-0.65, 0.0, 0.65):
            yield Coordinate(name, 0.5 * (p.high + p.low), half, -1.0, 1.0, f)


def descend(residual: Callable[[Array], Array], coordinates: Sequence[Coordinate], start: Array, steps: int,
            frozen: Array | None = None, tolerance: float = 1e-3) -> Descent:
    """Gauss-Newton steps within bounds.

    Args:
        residual: x (P,) -> (N,).
        coordinates: P of them.
        start: (P,).
        steps: at most.
        frozen: (N, Q) derivative by the first Q coordinates, taken as constant; the others' are renewed each step.
        tolerance: share of the cost that a step must gain to be followed by another.
    """
    low, high = np.array([c.low for c in coordinates]), np.array([c.high for c in coordinates])
    x = np.clip(start, low, high)
    r = residual(x)
    cost = float(r @ r)
    known = 0 if frozen is None else frozen.shape[1]
    for _ in range(steps):
        jacobian = np.column_stack([*([] if frozen is None else [frozen]),
                                    *(_column(residual, r, x, j, high) for j in range(known, len(x)))])
        step = _step(jacobian, r, low - x, high - x)
        for _ in range(6):
            trial = np.clip(x + step, low, high)
            new = residual(trial)
            reached = float(new @ new)
            if reached < cost:
                break
            step = 0.35 * step
        else:
            break
        gained, x, r, cost = cost - reached, trial, new, reached
        if gained < tolerance * cost:
            break
    return Descent(x, r, cost)


def derivative(residual: Callable[[Array], Array], coordinates: Sequence[Coordinate], x: Array) -> Array:
    """Derivative (N, P) of a residual at x (P,), by differences towards the inside of the bounds."""
    r, high = residual(x), np.array([c.high for c in coordinates])
    return np.column_stack([_column(residual, r, x, j, high) for j in range(len(x))])


def _step(jacobian: Array, r: Array, low: Array, high: Array) -> Array:
    """The step (P,) within bounds that solves the linearised problem; a little ridge where two columns are one."""
    norm = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    unit = jacobian / norm
    factor = np.linalg.cholesky(unit.T @ unit + 1e-9 * np.eye(len(norm))).T
    target = np.linalg.solve(factor.T, -(unit.T @ r))
    scaled = lsq_linear(factor, target, ((low - 1e-12) * norm, (high + 1e-12) * norm)).x
    return np.asarray(scaled / norm)


def _column(residual: Callable[[Array], Array], r: Array, x: Array, j: int, high: Array) -> Array:
    step = 1e-3 if x[j] + 1e-3 <= high[j] else -1e-3
    moved = x.copy()
    moved[j] += step
    return (residual(moved) - r) / step


class Readings:
    """Noise-free readings of hypotheses about one rig for one duty, in standard deviations."""

    def __init__(self, truth: Model, duty: Array, sigma: Mapping[str, float]) -> None:
        """Take the truth's revolutions, over which the speed is compared.

        Args:
            truth: the rig.
            duty: (N,) from rest.
            sigma: channel -> of one reading; `omega`: besides its timing.
        """
        self.truth, self.duty, self.sigma = truth, duty, sigma
        run = dynamics.simulate(truth, duty)
        turn = 2.0 * math.pi / max(truth.sensing["speed_pulses_per_rev"], 1.0)
        rising = np.maximum.accumulate(run.rotor_angle)
        marks = turn * np.arange(1.0, math.floor(rising[-1] / turn) + 1.0)
        at = np.interp(marks, rising, SAMPLE_PERIOD * np.arange(len(duty)))
        length = np.diff(at)
        use = (length > 0.0) & (length < sensing.SPEED_TIMEOUT)
        self.end, self.length = at[1:][use], length[use]
        self.speed_sigma = np.hypot(sigma["omega"], truth.sensing["speed_tick"] * turn / self.length**2)

    def of(self, model: Model) -> Array:
        """All channels as one vector (M,)."""
        run = dynamics.simulate(model, self.duty)
        theta = sensing.read_angle(model, run.theta, run.theta_dot)
        i_a = sensing.read_current(model, run.i_a)
        v_a = sensing.read_voltage(model, run.v_a)
        speed = mean_speed(run.rotor_angle, self.end, self.length, SAMPLE_PERIOD)
        weight = math.sqrt(THIN)
        vector = np.concatenate([weight / self.sigma["theta"] * theta[::THIN], weight / self.sigma["i_a"] * i_a[::THIN],
                                 weight / self.sigma["v_a"] * v_a[::THIN], speed / self.speed_sigma])
        return np.nan_to_num(vector, nan=1e9, posinf=1e9, neginf=-1e9)


def hypothesis(model: Model, coordinates: Sequence[Coordinate], x: Array) -> Model:
    """The model with the values that x (P,) stands for."""
    numbers = dict(model.model)
    effects: dict[str, dict[str, float]] = {}
    for c, z in zip(coordinates, x):
        owner, _, parameter = c.name.partition(".")
        if parameter:
            effects.setdefault(owner, {})[parameter] = c.value(z)
        else:
            numbers[owner] = c.value(z)
    return Model(model.name, numbers, model.sensing, effects)


def rivals_of(truth: str, nominal: Model) -> Iterator[tuple[str, list[Coordinate], list[Coordinate]]]:
    """Key, numbers and own parameters of every hypothesis but the truth, once for each start."""
    inside = numbers_within(nominal, OFF)
    yield "none", inside, []
    for effect in CATALOGUE:
        if effect != truth and effect not in RANDOM:
            for own in starts_of(effect):
                yield effect, inside, own
    for c in inside:
        key = f"{PARAMETER_MISMATCH}:{c.name}"
        if key != truth:
            yield key, numbers_within(nominal, OFF, c.name), []


def limit(numbers_true: Mapping[str, float], effects_true: Mapping[str, Mapping[str, float]], duty: Array,
          sigma: Mapping[str, float], nominal: Model | None = None) -> dict[str, Any]:
    """The accuracy of a likelihood test that knows both hypotheses exactly, against its hardest rival.

    Args:
        numbers_true: the rig's numbers.
        effects_true: its one effect, with all parameters (of a form that the table lists); for `parameter_mismatch` the
            number and its value, which is in `numbers_true` too.
        duty: (N,) 0..1, from rest.
        sigma: channel -> standard deviation of a reading, as in `Signals.sigma`.
        nominal: the model whose numbers are off by up to `OFF`; `bench` by default.

    Returns:
        accuracy: Φ(distance/2). hardest: key of the rival that comes closest. distance: in standard deviations.
        rivals: key -> distance, as far as the search followed each.

    Raises:
        ValueError: not exactly one effect, or one of chance.
    """
    if len(effects_true) != 1 or next(iter(effects_true)) in RANDOM:
        raise ValueError(f"the limit is known for a single effect that is not of chance, not for {list(effects_true)}")
    with threadpool_limits(1):  # the matrices are narrow
        return _limit(numbers_true, effects_true, duty, sigma, nominal or load("bench"))


def _limit(numbers_true: Mapping[str, float], effects_true: Mapping[str, Mapping[str, float]], duty: Array,
           sigma: Mapping[str, float], nominal: Model) -> dict[str, Any]:
    (effect, parameters), = effects_true.items()
    key = f"{effect}:{next(iter(parameters))}" if effect == PARAMETER_MISMATCH else effect
    truth = Model("truth", dict(numbers_true), nominal.sensing,
                  {} if effect == PARAMETER_MISMATCH else {effect: dict(parameters)})
    readings = Readings(truth, duty, sigma)
    goal = readings.of(truth)

    def search(numbers: Sequence[Coordinate], own: Sequence[Coordinate], start: Array, steps: int,
               frozen: Array | None, tolerance: float) -> Descent:
        all_ = [*numbers, *own]
        return descend(lambda x: readings.of(hypothesis(nominal, all_, x)) - goal, all_, start, steps, frozen,
                       tolerance)

    inside = numbers_within(nominal, OFF)
    derivatives = _number_derivatives(readings, truth, inside, goal)
    at_truth = np.array([min(max((numbers_true[c.name] - c.origin) / c.scale, c.low), c.high) for c in inside])
    best: dict[str, tuple[Descent, Sequence[Coordinate], Sequence[Coordinate]]] = {}
    for rival, numbers, own in rivals_of(key, nominal):
        start = np.concatenate([at_truth, [c.start for c in own]])
        reached = search(numbers, own, start, SCREENED, derivatives, 0.03)
        if rival not in best or reached.cost < best[rival][0].cost:
            best[rival] = (reached, numbers, own)
    closest = sorted(best, key=lambda k: best[k][0].cost)[:CLOSEST]
    for rival in closest:
        screened, known, free = best[rival]
        best[rival] = (search(known, free, screened.x, REFINED, None, 1e-3), known, free)
    distances = {k: math.sqrt(b[0].cost) for k, b in best.items()}
    hardest = min(distances, key=lambda k: distances[k])
    return {"accuracy": float(ndtr(0.5 * distances[hardest])), "hardest": hardest, "distance": distances[hardest],
            "rivals": dict(sorted(distances.items(), key=lambda item: item[1]))}


def _number_derivatives(readings: Readings, truth: Model, inside: Sequence[Coordinate], goal: Array) -> Array:
    """Derivative (M, P) of the readings by the numbers, on their coordinates, at the truth."""
    columns = []
    for c in inside:
        moved = {**truth.model, c.name: truth.model[c.name] + 1e-3 * c.scale}
        columns.append((readings.of(Model("moved", moved, truth.sensing, truth.effects)) - goal) / 1e-3)
    return np.array(columns).T
