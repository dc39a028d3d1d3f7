# SPDX-License-Identifier: Apache-2.0
"""Rigs in a closed loop whose effect begins at a sealed instant, simulated by the independent plant.

The loop is one of the controllers of the package or of the blind check, with a reference that jumps. The controller
sees the readings without the timing of pulses; the recording has all of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import odeint

from aeropend_control.laws.registry import LAWS
from aeropend_ident.live.companion_model import Samples
from aeropend_sim.model.parameters import Model, load
from aeropend_sim.model.rig import Rig, Sample
from evaluation.blind import cases, circumstances, controllers, plant
from evaluation.blind.plant import EFFECTS, PERIOD, I, S

Array = NDArray[np.float64]
Law = Callable[[float, Sample], float]

FLOORS = (2.0, 10.0)
"""Size of an effect, in floors, if it acted all the time."""

QUIET = (80.0, 110.0)
"""[s] In which the effect begins."""

AFTER = 25.0
"""[s] Of the recording after that."""

HOLDS, RESTS = (2.0, 5.0), (5.0, 40.0)
"""[s] Between two references of a loop that moves, and of one that rests for long."""

SPEEDS = (60.0, 130.0)
"""[rad/s] References of the speed."""

ANGLES = (0.08, 0.6)
"""[rad] References of the angle."""

GROWING = ("supply_drift", "winding_heating")
"""Effects that grow from zero: they have no instant."""

BEGINNING = tuple(e for e in EFFECTS if e not in GROWING)
"""Effects that are switched on."""

SHOWN = 20.0
"""[s] After the begin in which the effect must show to count as excited."""

SIZED_ON = 30.0
"""[s] Duty signal on which an effect is sized."""


@dataclass(frozen=True)
class Case:
    """One recording and its label.

    Attributes:
        name: of the case.
        effect: its id.
        place: of the chain.
        since: [s] when it begins.
        controller: name of the law.
        floors: that it would make on the signal on which it was sized.
        shown: floors that it makes in the loop within `SHOWN` after it has begun.
        parameters: of the effect.
        samples: of the recording, (N,) each.
    """

    name: str
    effect: str
    place: str
    since: float
    controller: str
    floors: float
    shown: float
    parameters: dict[str, float]
    samples: Samples


def references(rng: np.random.Generator, n: int, low: float, high: float, holds: tuple[float, float]) -> Array:
    """References (n,) that jump after some seconds."""
    out, k = np.zeros(n), 0
    while k < n:
        hold = round(rng.uniform(*holds) / PERIOD)
        out[k:k + hold] = rng.uniform(low, high)
        k += hold
    return out


def law_of(name: str, model: Model, rng: np.random.Generator, n: int, holds: tuple[float, float] = HOLDS) -> Law:
    """A controller in its loop: one of `LAWS`, with a reference that jumps, or of `controllers.ALL`, by name."""
    if name in LAWS:
        kind = LAWS[name]
        law = kind.make(model, kind.tune(model))
        goal = references(rng, n, *(SPEEDS if kind.reference_unit == "rad/s" else ANGLES), holds)
        return lambda t, s: law.step(s, float(goal[min(round(t / PERIOD), n - 1)]))
    other = {f.__name__: f for f in controllers.ALL}[name](rng)
    return lambda t, s: other(t, s.theta)


LOOPS = tuple(LAWS)
"""Names of the controllers whose references may rest."""

CONTROLLERS = (*LAWS, *(f.__name__ for f in controllers.ALL))
"""Names of all controllers."""


def closed_loop(p: Array, later: tuple[int, Array] | None, gusts: Array, law: Law, n: int, sensing: Mapping[str, float],
                rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Integrate the independent plant in a loop.

    Args:
        p: parameters.
        later: sample from which on other parameters hold, and these.
        gusts: (N + 2,) random torque, or (0,).
        law: of the loop.
        n: number of samples.
        sensing: of the readings.
        rng: of the readings that the law sees.

    Returns:
        States (N, 16), terminal voltage (N,), duty (N,).
    """
    y, room = np.zeros(16), np.zeros(16)
    out, v, applied = np.empty((n, 16)), np.empty(n), np.zeros(n)
    options: dict[str, Any] = {"rtol": 1e-6, "atol": 1e-7, "mxstep": 20000}
    change = n if later is None else later[0]
    noise = rng.standard_normal((n, 3))
    duty = 0.0
    for k in range(n):
        begun = later is not None and k >= change
        q = later[1] if later is not None and begun else p
        torque = gusts if begun or later is None else gusts[:0]
        applied[k], out[k] = duty, y
        late = round(q[I.command_delay_delay] / PERIOD)
        acting = applied[k - late] if k >= late else 0.0
        v[k] = plant.terminal_voltage(acting, k * PERIOD, y, q)
        lsb = sensing["angle_lsb"]
        theta = y[S.stage2] + sensing["angle_noise"] * noise[k, 0]
        theta = round(theta / lsb) * lsb if lsb > 0.0 else theta
        seen = Sample(theta, float(y[S.omega]), float(y[S.i]) + sensing["current_noise"] * noise[k, 1],
                      float(v[k]) + sensing["voltage_noise"] * noise[k, 2])
        duty = min(max(law(k * PERIOD, seen), 0.0), 1.0)
        span = np.array([k * PERIOD, (k + 1) * PERIOD])
        y = odeint(plant.derivative, y, span, (acting, q, torque, room), tcrit=span[1:], **options)[-1]
    return out, v, applied


_SIZERS: dict[int, cases.Sizer] = {}


def sizer(seed: int) -> cases.Sizer:
    """The nominal rig on which effects are sized."""
    if seed not in _SIZERS:
        model = load("bench")
        _SIZERS[seed] = cases.Sizer(model.model, model.sensing,
                                    cases.duty_signal(np.random.default_rng(seed), SIZED_ON))
    return _SIZERS[seed]


def draw(effect: str, controller: str, seed: int, *, imperfect: bool = False, holds: tuple[float, float] = HOLDS
         ) -> Case:
    """A recording of a rig in whose loop an effect begins.

    Args:
        effect: its id.
        controller: name.
        seed: of all that is drawn.
        imperfect: with many small imperfections besides, from the start.
        holds: [s] between two references.
    """
    rng = np.random.default_rng(seed)
    model = load("bench")
    numbers = {k: model.model[k] * (1.0 + rng.uniform(-cases.OFF, cases.OFF)) for k in plant.NUMBERS}
    other = int(rng.random() < 0.5)
    goal = math.exp(rng.uniform(*np.log(FLOORS)))
    entry, floors = cases.sized(effect, sizer(0), goal, cases.FORMS[other], model.model, rng)
    background = imperfections(seed) if imperfect else {}
    inside = {e: own for e, own in background.items() if e in EFFECTS and e != effect}
    outside = {e: own["size"] for e, own in background.items() if e not in EFFECTS}
    without = plant.packed(numbers, model.sensing["angle_filter_tau"], inside, outside, other)
    own = entry["parameters"]
    with_ = plant.packed(numbers, model.sensing["angle_filter_tau"], {**inside, effect: own}, outside, other)  # type: ignore[dict-item]
    if effect == "thrust_lag":
        without[plant.PARAMETERS.index("thrust_lag_tau")] = 1e-3
    change = round(rng.uniform(*QUIET) / PERIOD)
    n = change + round(AFTER / PERIOD)
    gusts = cases.gusts_of(entry, n, other=other > 0) if effect == "gust" else np.zeros(0)
    law = law_of(controller, model, rng, n, holds)
    y, v, applied = closed_loop(without, (change, with_), gusts, law, n, model.sensing, rng)
    columns = measured(without, y, v, model.sensing, rng, (change, with_))
    shown = shown_in_loop(without, with_, applied, change, gusts)
    if effect == "speed_spikes":
        shown = math.inf
    return Case(f"{effect}-{controller}-{seed}", effect, str(entry["place"]), change * PERIOD, controller, floors,
                shown, dict(own), Samples(columns["theta"], columns["omega"], columns["i_a"], columns["v_a"], applied))  # type: ignore[call-overload]


def shown_in_loop(without: Array, with_: Array, duty: Array, change: int, gusts: Array) -> float:
    """Floors that an effect makes in a loop: RMS, in the worst channel, over what the same duty gives without it."""
    begin = max(change - round(10.0 / PERIOD), 0)
    end = min(change + round(SHOWN / PERIOD), len(duty))
    part, floor = np.array(duty[begin:end]), sizer(0).floor
    torque = gusts[begin:end + 2] if len(gusts) else gusts
    quiet = plant.states(without, part, np.zeros(0))
    delayed = with_[I.command_delay_delay] > 0.0
    loud = plant.states(with_, part, torque) if delayed else plant.states(
        without, part, np.zeros(0) if not len(torque) else torque, later=(change - begin, with_))
    a, b = plant.shown(without, *quiet[:2]), plant.shown(with_, *loud[:2])
    return max(float(np.sqrt(np.mean((a[c][change - begin:] - b[c][change - begin:]) ** 2))) / floor[c] for c in a)


def measured(p: Array, y: Array, v: Array, sensing: Mapping[str, float], rng: np.random.Generator,
             later: tuple[int, Array] | None) -> dict[str, Array]:
    """Readings as the rig reports them; false captures begin with the effect."""
    whole = plant.measured(p, y, v, sensing, rng, later)
    if later is not None and later[1][I.speed_spikes_rate] > 0.0:
        false = plant.speed_from_pulses(y[:, S.turned], y[:, S.omega], rng.uniform(0.0, 2.0 * math.pi),
                                        sensing["speed_tick"], later[1][I.speed_spikes_rate],
                                        bool(later[1][I.other_form]), rng)
        whole["omega"][later[0]:] = false[later[0]:]
    return whole


def imperfections(seed: int) -> dict[str, dict[str, float]]:
    """The imperfections of a messy rig: effects outside of the catalogue and in it, each of about a floor."""
    rng = np.random.default_rng([seed, 1])
    model = load("bench")
    rig = cases.Weighed(model.model, model.model, model.sensing, cases.duty_signal(rng, SIZED_ON))
    kinds = [e for e in (*EFFECTS, *plant.OUTSIDE)
             if e not in circumstances.RANDOM_OR_STEPPED and e not in (*GROWING, "gust")]
    count = int(rng.integers(*circumstances.BACKGROUND, endpoint=True))
    drawn = [circumstances.small(str(e), rig, rng) for e in rng.choice(kinds, count, replace=False)]
    return {d.effect: dict(d.parameters) for d in drawn}


def quiet(controller: str, seed: int, seconds: float, *, off: float) -> Samples:
    """A recording without a change of a rig simulated by the package's own plant, which is fast enough for a day.

    Args:
        controller: name.
        seed: of all that is drawn.
        seconds: [s] length.
        off: share by which its numbers may differ from the model's.
    """
    rng = np.random.default_rng(seed)
    model = load("bench")
    numbers = {k: x * (1.0 + rng.uniform(-off, off)) for k, x in model.model.items()}
    rig = Rig(Model("rig", numbers, model.sensing, {}), seed)
    n = round(seconds / PERIOD)
    law = law_of(controller, model, rng, n)
    read, applied, duty = np.empty((n, 4)), np.zeros(n), 0.0
    for k in range(n):
        applied[k] = duty
        read[k] = sample = rig.sample(duty)[0]
        duty = min(max(law(k * PERIOD, sample), 0.0), 1.0)
    return Samples(*np.ascontiguousarray(read.T), applied)


def messy(controller: str, seed: int, seconds: float) -> Samples:
    """A recording without a change of a messy rig, simulated by the independent plant."""
    rng = np.random.default_rng(seed)
    model = load("bench")
    numbers = {k: model.model[k] * (1.0 + rng.uniform(-cases.OFF, cases.OFF)) for k in plant.NUMBERS}
    background = imperfections(seed)
    p = plant.packed(numbers, model.sensing["angle_filter_tau"],
                     {e: own for e, own in background.items() if e in EFFECTS},
                     {e: own["size"] for e, own in background.items() if e not in EFFECTS}, 1)
    n = round(seconds / PERIOD)
    y, v, applied = closed_loop(p, None, np.zeros(0), law_of(controller, model, rng, n), n, model.sensing, rng)
    columns = plant.measured(p, y, v, model.sensing, rng)
    return Samples(columns["theta"], columns["omega"], columns["i_a"], columns["v_a"], applied)
