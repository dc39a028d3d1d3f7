# SPDX-License-Identifier: Apache-2.0
"""Rigs that might lie on a desk, drawn: angle and command alone, and none of the equations of the package.

Each draws how the lift follows from the command (a power with a dead zone, one that saturates, one that falls again
near full command), how it lags (evenly, unlike in rise and fall, faster at speed), a transport delay, friction of the
pivot (Coulomb, Stribeck, growing with the load), air drag, turbulence, the zero and resolution of the angle, the sample
rate, and how it is driven (steps, staircases, sines, a controller).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]

INNER = 0.001
"""[s] Step of the integration (choice: a hundredth of the fastest motion)."""

LIFTS = ("power", "saturating", "falling")
LAGS = ("even", "uneven", "faster at speed")
FRICTIONS = ("none", "coulomb", "stribeck", "load")
DRIVES = ("steps", "staircase", "sines", "controller")

TOP = 1.5
"""[rad] Largest static angle (choice: a person does not let the arm turn over)."""


@dataclass(frozen=True)
class Drawn:
    """A recording of a drawn rig.

    Attributes:
        about: what was drawn, by name.
        period: [s] between samples.
        duty: (N,) command, 0 to 1.
        theta: [rad] (N,) angle as read.
    """

    about: dict[str, Any]
    period: float
    duty: Array
    theta: Array


@njit(cache=True)
def _run(gravity: float, damping: float, drag: float, lifts: Array, lag: Array, friction: Array, command: Array,
         gust: Array, every: int, goal: Array, gains: Array) -> tuple[Array, Array]:
    """Angle and command (N,) at the samples.

    Args:
        gravity: [1/s²] over inertia.
        damping: [1/s] viscous, over inertia.
        drag: [1/rad] of the air, over inertia.
        lifts: (101,) [rad/s²] static lift at evenly spaced commands from 0 to 1.
        lag: [s] in rise, its ratio in fall, how much faster at full lift.
        friction: [rad/s²] Coulomb, further at rest, its speed [rad/s], and per lift [-].
        command: (N,) of the open loop.
        gust: (N, every) [rad/s²] turbulence.
        every: steps between samples.
        goal: (N,) [rad] reference; empty: open loop.
        gains: of a PID controller.
    """
    n = len(command)
    theta, speed, lift, total, before = 0.0, 0.0, 0.0, 0.0, 0.0
    angles, applied = np.empty(n), np.empty(n)
    period = every * INNER
    u = command[0]
    for k in range(n):
        angles[k] = theta
        u = command[k]
        if len(goal) > 0:
            error = goal[k] - theta
            total = min(max(total + gains[1] * period * error, 0.0), 1.0)
            u = min(max(gains[0] * error + total - gains[2] * (theta - before) / period, 0.0), 0.95)
            before = theta
        applied[k] = u
        place = 100.0 * min(max(u, 0.0), 1.0)
        j = min(int(place), 99)
        target = lifts[j] + (place - j) * (lifts[j + 1] - lifts[j])
        for m in range(every):
            tau = lag[0] if target > lift else lag[0] * lag[1]
            tau = tau / (1.0 + lag[2] * lift / lifts.max())
            lift += INNER / tau * (target - lift)
            torque = lift - gravity * math.sin(theta) + gust[k, m]
            dry = friction[0] + friction[1] * math.exp(-(speed / friction[2]) ** 2) + friction[3] * lift
            torque -= damping * speed + drag * speed * abs(speed)
            if dry > 0.0:  # exact to the step: friction stops the arm, or takes its whole size
                free = speed + INNER * torque
                speed = math.copysign(max(abs(free) - INNER * dry, 0.0), free)
            else:
                speed += INNER * torque
            theta += INNER * speed
    return angles, applied


def draw(rng: np.random.Generator) -> Drawn:
    """A recording of a rig.

    Args:
        rng: of all that is drawn.
    """
    gravity = math.exp(rng.uniform(*np.log((2.0, 70.0))))
    swing = math.sqrt(gravity)
    rate = float(rng.choice([20.0, 50.0, 100.0, 200.0]))
    every = round(1.0 / rate / INNER)
    seconds = float(rng.uniform(15.0, 40.0)) * 2.0 * math.pi / swing
    n = round(min(max(seconds, 30.0), 120.0) * rate)
    kind, lags, dry, drive = (str(rng.choice(x)) for x in (LIFTS, LAGS, FRICTIONS, DRIVES))
    u = np.linspace(0.0, 1.0, 101)
    dead = float(rng.choice([0.0, rng.uniform(0.05, 0.35)]))
    over = np.clip(u - dead, 0.0, None) / (1.0 - dead)
    shape = {"power": over ** rng.uniform(0.8, 2.2), "saturating": np.tanh(rng.uniform(1.0, 2.5) * over),
             "falling": over**1.5 * (1.0 - rng.uniform(0.3, 0.5) * over**3)}[kind]
    lift = shape / shape.max() * gravity * rng.uniform(0.7, 1.3)
    tau = float(np.clip(rng.uniform(0.1, 0.8) / swing, 0.02, 0.6))
    lag = np.array([tau, rng.uniform(1.5, 4.0) if lags == "uneven" else 1.0,
                    rng.uniform(0.5, 2.0) if lags == "faster at speed" else 0.0])
    coulomb = gravity * rng.uniform(0.005, 0.05)
    at_rest = coulomb * rng.uniform(0.3, 1.0) if dry == "stribeck" else 0.0
    friction = np.array([coulomb if dry != "none" else 0.0, at_rest, 0.05 * swing,
                         rng.uniform(0.01, 0.05) if dry == "load" else 0.0])
    damping = 2.0 * math.exp(rng.uniform(*np.log((0.02, 0.3)))) * swing
    drag = float(rng.choice([0.0, rng.uniform(0.1, 0.6)]))
    most = float(np.interp(math.sin(TOP) * gravity, np.maximum.accumulate(lift), u)) if lift.max() > gravity else 1.0
    goal, gains = np.zeros(0), np.zeros(3)
    command = _command(drive, rng, n, rate, swing, dead, most)
    if drive == "controller":
        goal = 0.9 * _command("steps", rng, n, rate, 0.5 * swing, 0.0, 1.0)
        gains = np.array([0.4, 0.4 * swing / 3.0, 0.5 / swing])
    turbulence = gravity * rng.uniform(0.0, 0.01)
    keep = math.exp(-INNER / 0.2)
    kicks = turbulence * math.sqrt(1.0 - keep**2) * rng.standard_normal(n * every)
    gust = lfilter([1.0], [1.0, -keep], kicks).reshape(n, every)
    late = round(float(rng.choice([0.0, rng.uniform(0.02, 0.15)])) * rate)
    if late and not len(goal):
        theta, _ = _run(gravity, damping, drag, lift, lag, friction, np.r_[np.zeros(late), command[:-late]], gust,
                        every, goal, gains)
    else:
        theta, command = _run(gravity, damping, drag, lift, lag, friction, command, gust, every, goal, gains)
        late = 0
    zero = float(rng.choice([0.0, rng.uniform(-0.08, 0.08)]))
    lsb, noise = float(rng.choice([0.0015, 0.006, 0.0175])), float(rng.choice([0.0005, 0.002, 0.005]))
    read = lsb * np.round((theta + zero + noise * rng.standard_normal(n)) / lsb)
    about = {"gravity": gravity, "rate": rate, "lift": kind, "dead": dead, "lag": lags, "tau": tau, "friction": dry,
             "coulomb": float(friction[0]), "drive": drive, "delay": late / rate, "zero": zero, "lsb": lsb,
             "noise": noise, "turbulence": turbulence, "drag": drag, "damping": damping}
    return Drawn(about, 1.0 / rate, command, read)


def _command(drive: str, rng: np.random.Generator, n: int, rate: float, swing: float, dead: float, most: float
             ) -> Array:
    """A command (n,) of an open loop between the dead zone and the largest one."""
    t = np.arange(n) / rate
    low, high = dead, max(most, dead + 0.05)
    start = round(rng.uniform(0.0, 2.0) * rate)
    if drive == "sines":
        waves = np.sum([rng.uniform(0.3, 1.0) * np.sin(swing * f * t + rng.uniform(0.0, 6.28))
                        for f in rng.uniform(0.1, 1.2, 5)], axis=0)
        command = low + (high - low) * np.clip(0.5 + 0.25 * waves, 0.0, 1.0)
    elif drive == "staircase":
        levels = np.r_[np.linspace(low, high, 6), np.linspace(high, low, 6)[1:]]
        each = max(round(6.0 / swing * 2.0 * rate), n // (2 * len(levels)))
        command = np.resize(np.repeat(levels, each), n)
    else:
        command, k = np.zeros(n), 0
        while k < n:
            held = round(rng.uniform(2.0, 12.0) / swing * rate)
            command[k:k + held] = rng.choice([0.0, 1.0], p=[0.15, 0.85]) * rng.uniform(low, high)
            k += held
    command[:start] = 0.0
    return command
