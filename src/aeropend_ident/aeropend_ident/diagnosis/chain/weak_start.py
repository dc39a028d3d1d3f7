# SPDX-License-Identifier: Apache-2.0
"""Start values of a nominal model from a linear regression of the weak form.

The equation of motion times a test function is integrated by parts, so that no reading is differentiated. There is one
regression for each static curve and lag of a grid.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.signals import smoothing
from aeropend_ident.signals.signals import Signals
from aeropend_ident.signals.smoothing import block_mean
from aeropend_sim.compiled import njit
from aeropend_sim.model import actuator
from aeropend_sim.model.effects import CATALOGUE, THRUST_PIVOT_SPEED
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

COARSE = 0.01
"""[s] Sample period of the data that a search starts with (choice: far below the arm's time constants).

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

TEST_FUNCTIONS = (0.25, 0.5)
"""[s] Half-widths of the test functions of the weak form: a quarter and a half of a usual period of the arm."""

LAGS = (0.04, 0.12, 0.4, 1.0)
"""[s] Lags of the rotor that searches start from; each starts with the static curve that fits best with it (choice)."""

DEAD_ZONES, BENDS, LOADS = (0.0, 0.08, 0.25), (0.003, 0.08, 0.6), (0.02, 1.0, 4.0)
"""Static curves that searches start from: dead zone of the duty, k3/k2, and voltage of load over back-EMF (choice)."""

MOVES = 0.8
"""Share of a test function in which the arm must move to show its dry friction (choice)."""

CLEAR, SLOW = 4.0, 0.02
"""Rate of the arm that is motion: in standard deviations of its noise, and over that of fast motion (choice)."""

HANGS = 0.1
"""[rad] An arm that starts nearer to hanging than this is taken to start with a rotor that stands (choice).

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""

FULL = 2.3
"""[V] Voltage at full duty of a rig without a measured voltage.

Choice: only its product with other parameters acts.

Measured: at ±30 % no verdict of 3 recordings changes (docs/results/thresholds.md)."""


def downsampled(s: Signals, period: float = COARSE) -> Signals:
    """The recording with block means in place of samples, at most so long a period [s] apart; angle and duty only."""
    every = max(1, math.floor(period / s.period))
    if every == 1:
        return s
    n = len(s) // every
    empty = np.full(n, np.nan)
    return replace(s, period=every * s.period, duty=block_mean(s.duty, every), theta=block_mean(s.theta, every),
                   omega=empty, i_a=empty, v_a=empty, pulses=None, false_speed=np.zeros(n, dtype=bool),
                   train=max(1, s.train // every))


@dataclass(frozen=True)
class Start:
    """A start of a search: how much its regression leaves, the lag of its rotor [s], and the model."""

    left: float
    lag: float
    model: Model


def likeliest(model: Model, recordings: Sequence[Signals], tests: Sequence[WeakForm], *, few: bool = False,
              kinds: Sequence[bool] = (False, True)) -> list[list[Start]]:
    """Static curves and lags, the likeliest first: a list for each kind.

    Args:
        model: gives the rest.
        recordings: duty and angle.
        tests: of the recordings.
        few: only the first and last dead zone and bend, and the first load.
        kinds: whether with dry friction and the zero of the angle, from the stretches in which the arm moves.
    """
    found: list[list[Start]] = [[] for _ in kinds]
    grid = (DEAD_ZONES[::2], BENDS[::2], LOADS[:1], LAGS) if few else (DEAD_ZONES, BENDS, LOADS, LAGS)
    for dead, bend, load, lag in product(*grid):
        m = replace(model, model=curve(model.model, dead, bend, load, lag))
        lifts = [unit_lift(m, s) for s in recordings]
        for of_kind, friction in zip(found, kinds, strict=True):
            r = regress(tests, lifts, friction=friction)
            if r.gravity > 0.5 and r.gain > 0.0 and (r.friction > 0.0 or not friction):
                of_kind.append(Start(r.left, lag, _regressed(m, r, friction=friction)))
    return [sorted(of_kind, key=lambda start: start.left) for of_kind in found]


def _regressed(m: Model, r: Regression, *, friction: bool) -> Model:
    """A model with the numbers of a regression, within the ranges that a search may start from."""
    numbers = {**m.model, "mgd_over_J": min(r.gravity, 5e3), "c_over_J": min(max(r.damping, 0.05), 100.0),
               "L_over_J": min(r.gain / m.model["k_thrust"], 1e5)}
    if not friction:
        return replace(m, model=numbers)
    bias = CATALOGUE["angle_offset"].parameters["bias"]
    effects = {"coulomb_friction": {"accel": r.friction},
               "angle_offset": {"bias": min(max(r.zero, 0.5 * bias.low), 0.5 * bias.high)}, **m.effects}
    return replace(m, model=numbers, effects=effects)


def curve(numbers: Mapping[str, float], dead: float, bend: float, load: float, lag: float) -> dict[str, float]:
    """Parameters of a map and motor with a given static curve and lag.

    Args:
        numbers: the rest.
        dead: duty below which the rotor stands.
        bend: k3/k2; small: a root of the duty; large: a straight line.
        load: ratio of the voltages for load and back-EMF at full duty.
        lag: [s] of the rotor at full duty.
    """
    n = {**numbers, "v_full": 0.0, "k2": numbers["k2"] or 1.0}  # a bridge without losses has no map: any k2 will do
    root = FULL / (math.sqrt(1.0 + bend) - math.sqrt(dead + bend))
    n["k1"] = root / math.sqrt(n["k2"])
    n["k3"] = bend * n["k2"]
    n["k0"] = -root * math.sqrt(dead + bend)
    top = FULL / n["K_e"] / (1.0 + load)
    n["k_load"] = load * n["K_e"] * n["K_t"] / (n["R_a"] * top)
    n["J_m"] = lag * (1.0 + 2.0 * load) * n["K_t"] * n["K_e"] / n["R_a"]
    return n


def unit_lift(model: Model, s: Signals) -> Array:
    """Thrust (N,) over k_thrust for a duty: the speed squared, unless an effect of the thrust changes that."""
    w = rotor_speed(model, s)
    pivot = THRUST_PIVOT_SPEED
    u = np.sign(w) * pivot**2 * (np.abs(w) / pivot) ** model.effect("thrust_exponent", "n")
    tau = model.effect("thrust_lag", "tau")
    return smoothing.lag(u, tau, s.period, model.effect("thrust_lag", "fall")) if tau > 0.0 else u


def rotor_speed(model: Model, s: Signals) -> Array:
    """[rad/s] Speed (N,) of the rotor for a duty, near enough for a start.

    The winding is far faster than the rotor: it is taken as a lag of the voltage, whose mean over a sample turns it.
    """
    n = model.numbers()
    hangs = abs(float(np.mean(s.theta[np.isfinite(s.theta)][:3]))) < HANGS
    v = actuator.acting_voltage(n, s.duty, model.effects, s.period, before=0.0 if hangs else float(s.duty[0]))
    first = 0.0 if hangs else float(actuator.speed_at(n, v[0]))
    tau = n["L_a"] / n["R_a"] / s.period
    v = v + tau * math.expm1(-1.0 / tau) * np.diff(v, prepend=v[0])
    torque = n["K_t"] / (n["R_a"] * n["J_m"])
    damping, load = torque * n["K_e"] + n["B_m"] / n["J_m"], n["k_load"] / n["J_m"]
    return np.asarray(_turned(torque * v, first, damping, load, s.period, math.ceil(s.period / COARSE)))


@njit(nogil=True)
def _turned(drive: Array, speed: float, damping: float, load: float, period: float, steps: int) -> Array:
    """[rad/s] ω (N,) of ω̇ = drive - damping ω - load ω|ω|, by the exponential Rosenbrock-Euler method; drive held."""
    out = np.empty_like(drive)
    for k in range(len(drive)):
        out[k] = speed
        for _ in range(steps):
            slope = damping + 2.0 * load * abs(speed)
            weight = -np.expm1(-slope * period / steps) / slope
            speed += weight * (drive[k] - damping * speed - load * speed * abs(speed))
    return out


class WeakForm:
    """The weak form of θ̈ = -G sin(θ - θ0) - c θ̇ - f sign θ̇ + g u, for a linear regression of its coefficients.

    With test functions φ: ∫ θ φ'' = ∫ (-G sin θ + G θ0 cos θ - f sign θ̇ + g u) φ + c ∫ θ φ' (D. Messenger and
    D. Bortz, Multiscale Modeling & Simulation 19, 2021). `identification.weak` does the same for a library of terms;
    here the input u is replaced for each curve that is tried while the other columns stay.

    Args:
        s: angle and duty of a recording.
    """

    def __init__(self, s: Signals) -> None:
        known = np.flatnonzero(np.isfinite(s.theta))
        theta = np.interp(np.arange(len(s)), known, s.theta[known])[:s.train]
        sign = _direction(theta, s)
        self.rows, self.kernels, left, moves = [], [], [], []
        columns: list[list[Array]] = [[], [], [], []]
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

            def of(x: Array, kernel: Array, rows: NDArray[np.intp] = rows) -> Array:
                return np.asarray(np.convolve(x, kernel[::-1], "same")[rows])

            mean = of(theta, np.ones(2 * width + 1) / (2 * width + 1))  # φ'' integrates to 0
            left.append(of(theta, second) / h**2 - mean * float(second.sum()) / h**2)
            columns[0].append(-of(np.sin(theta), bump))
            columns[1].append(of(theta, first) / h - mean * float(first.sum()) / h)
            columns[2].append(of(np.cos(theta), bump))
            columns[3].append(-of(sign, bump))
            moves.append(of(np.abs(sign), bump) > MOVES * float(bump.sum()))
        self.left = np.concatenate(left)
        self.columns = [np.concatenate(c) for c in columns]
        self.moves = np.concatenate(moves)

    def of(self, u: Array) -> Array:
        """∫ u φ for each test function (M,)."""
        return np.concatenate([np.convolve(u, k[::-1], "same")[r] for r, k in zip(self.rows, self.kernels)])


def _direction(theta: Array, s: Signals) -> Array:
    """Direction (N,) in which the arm moves: 1, -1, or 0 where noise or rest hides it."""
    from scipy.signal import savgol_filter  # its import is slow

    width = 2 * max(round(TEST_FUNCTIONS[0] / 4.0 / s.period), 2) + 1
    if len(theta) <= width:
        return np.zeros(len(theta))
    rate = savgol_filter(theta, width, 2, deriv=1, delta=s.period)
    noise = s.sigma["theta"] * math.sqrt(12.0 / width) / (width * s.period)  # of the slope of a straight line
    least = max(CLEAR * noise, SLOW * float(np.quantile(np.abs(rate), 0.95)))
    return np.where(np.abs(rate) > least, np.sign(rate), 0.0)


@dataclass(frozen=True)
class Regression:
    """What a regression of the weak form leaves (sum of squares), and its coefficients.

    Attributes:
        left: sum of squares.
        gravity: G cos θ0.
        damping: c.
        gain: g.
        bias: G sin θ0.
        friction: f.
    """

    left: float
    gravity: float
    damping: float
    gain: float
    bias: float
    friction: float

    @property
    def zero(self) -> float:
        """[rad] θ0, if it is small."""
        return self.bias / self.gravity if self.gravity > 0.0 else 0.0

    @property
    def hangs_at(self) -> float:
        """[rad] θ0, anywhere on the circle."""
        return math.atan2(self.bias, self.gravity)


def regress(tests: Sequence[WeakForm], lifts: Sequence[Array], *, friction: bool = False, zero: bool = True
            ) -> Regression:
    """Regress the weak form of several recordings; each has a gain and a zero of its own, of which the means count.

    Args:
        tests: of the recordings.
        lifts: (N,) each, the input.
        friction: with dry friction, from the stretches in which the arm moves.
        zero: whether the zero of the angle is unknown.
    """
    many, every = len(tests), range(len(tests))
    shared = 2 + friction
    parts, left = [], []
    for j, (w, u) in enumerate(zip(tests, lifts)):
        kept = w.moves if friction else np.ones(len(w.left), dtype=bool)
        nothing = np.zeros(len(w.left))
        own = [x if k == j else nothing for x in (w.of(u), w.columns[2] if zero else nothing) for k in every]
        parts.append(np.column_stack([*w.columns[:2], *w.columns[3:3 + friction], *own])[kept])
        left.append(w.left[kept])
    a, b = np.concatenate(parts), np.concatenate(left)
    scale = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    if len(b) < 2 * len(scale):
        return Regression(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    x, *_ = np.linalg.lstsq(a / scale, b, rcond=1e-10)
    x = x / scale
    gravity, damping, gain, bias = float(x[0]), float(x[1]), float(np.mean(x[shared:-many])), float(np.mean(x[-many:]))
    return Regression(float(np.sum((b - a @ x) ** 2)), gravity, damping, gain,
                      bias, float(x[2]) if friction else 0.0)
