# SPDX-License-Identifier: Apache-2.0
"""Recordings of many rigs, for tables in the habits of other people.

The equations are the simplest that show what a table shows: an arm under gravity, a motor with a lag, a thrust that
goes with the square of the speed. They share no line with the model of the package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

KINDS = {"steps": 0.2, "staircase": 0.08, "binary": 0.1, "pulses": 0.07, "multisine": 0.08, "loop": 0.32, "free": 0.15}
"""How the arm was moved, and the share of the recordings."""

RATES = (20.0, 25.0, 50.0, 100.0, 125.0, 200.0, 250.0, 490.2, 500.0, 1000.0)
"""[Hz] Rates of the rows."""

INNER = 1e-3
"""[s] Greatest step of the integration."""


@dataclass(frozen=True, eq=False)
class Run:
    """What happened in a recording, one number a row.

    Attributes:
        kind: of `KINDS`.
        t: [s] (N,) from 0.
        theta: [rad] (N,) from hanging.
        rate: [rad/s] (N,) of the arm.
        u: (N,) command, 0..1; all zeros for a free swing.
        w: (N,) speed of the motor, 0..1.
        reference: [rad] (N,), or None without a loop.
        terms: of the controller (N,): "P", "I", "D".
        yaw: [rad] (N,) another axis.
    """

    kind: str
    t: Array
    theta: Array
    rate: Array
    u: Array
    w: Array
    reference: Array | None
    yaw: Array
    terms: dict[str, Array] = field(default_factory=dict)


@njit(cache=True)
def _simulate(u: Array, r: Array, gains: Array, p: Array, push: Array, period: float, first: float) -> Array:
    """States (N, 7): angle, its rate, speed, command, P, I, D. The command is u, or PID of r where gains are given."""
    n = len(u)
    out = np.empty((n, 7))
    gravity, damping, dry, lift, lag, mean, top = p
    theta, rate, w, integral, before = first, 0.0, 0.0, 0.0, first
    inner = math.ceil(period / INNER)
    dt = period / inner
    for k in range(n):
        now, a, b, c = u[k], 0.0, 0.0, 0.0
        if gains[0] > 0.0:
            error = r[k] - theta
            integral += gains[1] * error * period
            integral = min(max(integral, -top), top)
            a, b, c = gains[0] * error, integral, -gains[2] * (theta - before) / period
            now = min(max(mean + a + b + c, 0.0), top)
        before = theta
        out[k] = theta, rate, w, now, a, b, c
        for _ in range(inner):
            w += dt * (now - w) / lag
            push_ = lift * w * w + push[k]
            rate += dt * (push_ - gravity * math.sin(theta) - damping * rate - dry * math.tanh(rate / 0.01))
            theta += dt * rate
    return out


def draw(rng: np.random.Generator) -> Run:
    """A recording of a rig; both are drawn."""
    while True:
        run = _draw(rng)
        moved = float(np.ptp(run.theta))
        driven = min(float(np.ptp(run.u)), float(np.ptp(run.w))) >= 0.02
        if np.isfinite(run.theta).all() and np.abs(run.theta).max() < 2.4 and moved > 0.2 and (
                driven or run.kind == "free"):
            return run


def _draw(rng: np.random.Generator) -> Run:
    kind = str(rng.choice(list(KINDS), p=np.array(list(KINDS.values())) / sum(KINDS.values())))
    gravity = math.exp(rng.uniform(math.log(4.0), math.log(150.0)))
    natural = math.sqrt(gravity)
    rate = float(rng.choice([f for f in RATES if f > 1.5 * natural]))
    n = int(min(rng.uniform(60.0, 250.0) / natural * rate, 6000))
    n = max(n, 300)
    t = np.arange(n) / rate
    top = 1.0 if rng.random() < 0.4 else rng.uniform(0.45, 0.97)
    highest = rng.uniform(0.35, 1.2)
    damping = 2.0 * natural * math.exp(rng.uniform(math.log(0.02), math.log(0.4)))
    lag = math.exp(rng.uniform(math.log(0.03), math.log(0.3)))
    p = np.array([gravity, damping, gravity * float(rng.choice([0.0, 0.0, 0.01, 0.03])),
                  gravity * math.sin(highest) / top**2, lag, 0.0, top])
    push = gravity * rng.uniform(0.0, 0.01) * _wander(rng, n, 0.3 / natural * rate)
    u, r, gains, first = np.zeros(n), np.zeros(n), np.zeros(3), 0.0
    if kind == "free":
        first, p[1], p[2] = rng.uniform(0.5, 1.7), 0.25 * p[1], 0.3 * p[2]
    elif kind == "loop":
        gains = top / highest * np.array([rng.uniform(0.3, 1.5), natural * rng.uniform(0.05, 0.4),
                                          rng.uniform(0.0, 0.8) / natural])
        p[5] = float(rng.choice([0.0, top * math.sqrt(0.4)]))
        r = _goal(rng, t, natural, highest)
    else:
        u = _excitation(rng, kind, t, natural, top)
    rest = int(rng.choice([0.0, 0.0, 0.4, 1.5]) * rate)
    if kind != "free" and rest < n // 4:
        u[:rest], r[:rest] = 0.0, 0.0
    x = _simulate(u, r, gains, p, push, 1.0 / rate, first)
    yaw = 0.6 * np.cumsum(_wander(rng, n, 1.0 / natural * rate)) / rate * natural
    terms = {"P": x[:, 4], "I": x[:, 5], "D": x[:, 6]} if kind == "loop" else {}
    return Run(kind, t, x[:, 0], x[:, 1], x[:, 3], x[:, 2], r if kind == "loop" else None, yaw, terms)


def _wander(rng: np.random.Generator, n: int, lag: float) -> Array:
    """(N,) A random walk that comes back, of size 1."""
    keep = math.exp(-1.0 / max(lag, 1.0))
    out, x = np.empty(n), 0.0
    for k, step in enumerate(rng.standard_normal(n)):
        x = keep * x + math.sqrt(1.0 - keep * keep) * step
        out[k] = x
    return out


def _excitation(rng: np.random.Generator, kind: str, t: Array, natural: float, top: float) -> Array:
    """(N,) The command of an open loop."""
    n, hold = len(t), rng.uniform(2.0, 12.0) / natural
    cells = (t / hold).astype(int)
    if kind == "steps":
        levels = top * rng.choice([0.0, 0.3, 0.5, 0.6, 0.7, 0.85, 1.0], cells[-1] + 1)
        return np.asarray(levels[cells])
    if kind == "staircase":
        count = int(rng.integers(3, 8))
        rise = np.minimum((t / t[-1] * 2.0 * count).astype(int), 2 * count - 1)
        return np.asarray(top * np.minimum(rise, 2 * count - 1 - rise) / (count - 1.0))
    if kind == "binary":
        low = top * rng.uniform(0.0, 0.5)
        return np.where(rng.random(cells[-1] + 1)[cells] < 0.5, low, top)
    if kind == "pulses":
        return np.where((t / (3.0 * hold)) % 1.0 < rng.uniform(0.1, 0.4), top, 0.0)
    x = np.zeros(n)
    for _ in range(int(rng.integers(3, 8))):
        x += np.sin(natural * rng.uniform(0.15, 1.5) * t + rng.uniform(0.0, 6.3))
    low, high = float(x.min()), float(x.max())
    return top * (rng.uniform(0.0, 0.3) + 0.7 * (x - low) / (high - low))


def _goal(rng: np.random.Generator, t: Array, natural: float, highest: float) -> Array:
    """[rad] (N,) The reference of a loop."""
    shape, hold = str(rng.choice(["steps", "steps", "square", "sine", "constant"])), rng.uniform(10.0, 30.0) / natural
    if shape == "constant":
        return np.full(len(t), rng.uniform(0.3, 0.8) * highest)
    if shape == "sine":
        return np.asarray(highest * (0.45 + 0.3 * np.sin(2.0 * math.pi * t / (2.0 * hold))))
    if shape == "square":
        return np.where((t / hold).astype(int) % 2 == 0, 0.25, 0.7) * highest
    return np.asarray(highest * rng.uniform(0.2, 0.8, int(t[-1] / hold) + 1)[(t / hold).astype(int)])
