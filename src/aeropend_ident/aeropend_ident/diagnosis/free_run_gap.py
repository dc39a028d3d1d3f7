# SPDX-License-Identifier: Apache-2.0
"""How far the gap closes: free run from the applied duty alone, on data that nothing was fitted to."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import Chains, mean_speed, with_values
from aeropend_ident.signals.signals import CHANNELS, Signals
from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

WINDOW = 2.0
"""s of one block of the bootstrap: longer than the arm remembers."""

RESAMPLES = 2000

AT_REST = 0.05
"""A channel rests where its spread is below this share of its spread over the whole recording."""


def free_run(model: Model, signals: Signals, values: Mapping[str, float] | None = None) -> dict[str, Array]:
    """Simulate from the applied duty alone and read it as the rig would, without chance.

    Args:
        model: with its effects. signals: gives the duty and the instants of the pulses.
        values: more numbers, effects and the initial state (`initial.theta`, ...).

    Returns:
        Channel -> (N,) readings before noise and quantisation.
    """
    values = values or {}
    m = with_values(model, values)
    n, omega = m.numbers(), values.get("initial.omega", 0.0)
    state = dynamics.State(i_a=float(actuator.current_at(n, omega)), omega=omega,
                           theta=values.get("initial.theta", 0.0), theta_dot=values.get("initial.theta_dot", 0.0),
                           thrust=float(actuator.thrust(n, omega)))
    run = dynamics.simulate(m, signals.duty, signals.period, state)
    e = m.effects
    return {
        "theta": sensing.angle_reading(run.theta, run.theta_dot, sensing.prepare(m, signals.period)),
        "omega": _held_speed(run, signals),
        "i_a": (run.i_a * (1.0 + e.get("current_gain", {}).get("gain", 0.0))
                + e.get("current_offset", {}).get("bias", 0.0)),
        "v_a": run.v_a + e.get("voltage_offset", {}).get("bias", 0.0),
    }


def _held_speed(run: dynamics.Trajectory, signals: Signals) -> Array:
    """The speed as the pulses of the recording would have timed it, held between them."""
    p = signals.pulses
    if p is None or not len(p.index):
        return run.omega
    speed = mean_speed(run.rotor_angle, p.time, p.period, signals.period)
    last = np.searchsorted(p.index, np.arange(len(signals)), side="right") - 1
    held = np.where(last >= 0, speed[np.maximum(last, 0)], 0.0)
    # where the rig reads no speed, the model counts as stopped too if it would have shown one pulse at most
    stopped = signals.omega == 0.0
    back = np.maximum(np.arange(len(signals)) - round(sensing.SPEED_TIMEOUT / signals.period), 0)
    slow = run.rotor_angle - run.rotor_angle[back] < p.period[0] * p.omega[0]
    return np.where(stopped, np.where(slow, 0.0, run.omega), held)


@dataclass(frozen=True)
class Gap:
    """Difference between a model and a recording on held-out data.

    Attributes:
        rms: channel -> RMS of simulated minus measured, SI.
        spread: channel -> standard deviation of the measured channel; of the whole recording where the channel rests.
        windows: (W, C) mean square over each bootstrap window, over spread squared.
    """

    rms: dict[str, float]
    spread: dict[str, float]
    windows: Array

    @property
    def total(self) -> float:
        """RMS over channels, each divided by its spread."""
        return float(np.sqrt(np.mean([(self.rms[c] / self.spread[c]) ** 2 for c in self.rms])))


def gap(readings: Mapping[str, Array], signals: Signals, start: int, stop: int,
        left_out: NDArray[np.bool_] | None = None) -> Gap:
    """The gap between readings and a recording over samples start..stop.

    Args:
        readings: channel -> (N,). signals: the recording.
        start, stop: samples. left_out: (N,) samples at which the speed read is known to be false.
    """
    rms, spread, squares = {}, {}, []
    for channel in CHANNELS:
        measured = signals.channel(channel)[start:stop]
        known = np.isfinite(measured)
        if channel == "omega" and left_out is not None:
            known = known & ~left_out[start:stop]
        if known.sum() < 10:
            continue
        error = np.where(known, readings[channel][start:stop] - measured, np.nan)
        rms[channel] = float(np.sqrt(np.nanmean(error**2)))
        everywhere = float(np.nanstd(signals.channel(channel)))
        here = float(np.std(measured[known]))
        spread[channel] = max(here if here > AT_REST * everywhere else everywhere, signals.sigma[channel], 1e-12)
        squares.append(error**2 / spread[channel] ** 2)
    width = max(1, round(WINDOW / signals.period))
    edges = np.arange(0, max(stop - start - width, 0) + 1, width)
    with np.errstate(all="ignore"):
        windows = np.array([[np.nanmean(s[a:a + width]) if np.isfinite(s[a:a + width]).any() else 0.0
                             for s in squares] for a in edges]).reshape(len(edges), len(squares))
    return Gap(rms, spread, windows)


def floor(signals: Signals, start: int, stop: int) -> dict[str, float]:
    """What the measurement chain alone leaves, RMS by channel: noise, quantisation, and the timing of pulses."""
    floors = {c: signals.sigma[c] for c in CHANNELS}
    p = signals.pulses
    if p is not None:
        mine = (p.index >= start) & (p.index < stop)
        if mine.any():
            floors["omega"] = float(np.sqrt(np.average(p.sigma[mine] ** 2, weights=p.period[mine])))
    return floors


def closed(before: Gap, after: Gap, floors: Mapping[str, float], seed: int = 0
           ) -> tuple[float | None, float | None, float | None]:
    """Share of the closable gap that closed, its 95 % interval by a block bootstrap; None where nothing was open."""
    bottom = float(np.sqrt(np.mean([(floors[c] / before.spread[c]) ** 2 for c in before.rms])))
    open_ = before.total - bottom
    if open_ <= 0.1 * bottom:
        return None, None, None
    share = min((before.total - after.total) / open_, 1.0)
    rng = np.random.default_rng(seed)
    n = min(len(before.windows), len(after.windows))
    if n < 2:
        return share, None, None
    picks = rng.integers(0, n, (RESAMPLES, n))
    b = np.sqrt(before.windows[picks].mean(axis=(1, 2)))
    a = np.sqrt(after.windows[picks].mean(axis=(1, 2)))
    shares = np.minimum((b - a) / np.maximum(b - bottom, 1e-3 * bottom), 1.0)
    low, high = np.percentile(shares, [2.5, 97.5])
    return share, float(min(low, share)), float(max(high, share))


class Scorer:
    """Measures the gap of models on the held-out part of every recording."""

    def __init__(self, chains: Chains, model: Model, recordings: Sequence[Signals], spikes: bool) -> None:
        self.chains, self.model, self.recordings, self.spikes = chains, model, recordings, spikes

    def gap(self, readings: Sequence[Mapping[str, Array]], known: bool = True) -> Gap:
        """The gap over all recordings; `known`: false periods of the speed are told apart if they were found."""
        gaps = [gap(r, s, s.train, len(s), s.false_speed if known and self.spikes else None)
                for r, s in zip(readings, self.recordings, strict=True)]
        if len(gaps) == 1:
            return gaps[0]
        channels = [c for c in CHANNELS if all(c in g.rms for g in gaps)]
        rms = {c: math.sqrt(float(np.mean([g.rms[c] ** 2 for g in gaps]))) for c in channels}
        spread = {c: math.sqrt(float(np.mean([g.spread[c] ** 2 for g in gaps]))) for c in channels}
        columns = [[list(g.rms).index(c) for c in channels] for g in gaps]
        windows = np.concatenate([g.windows[:, i] for g, i in zip(gaps, columns, strict=True)])
        return Gap(rms, spread, windows)

    def of(self, values: Mapping[str, float]) -> Gap:
        """The gap of the model with these values."""
        return self.gap([free_run(self.model, s, self.chains.own(values, k))
                         for k, s in enumerate(self.recordings)])

    def squared(self, values: Mapping[str, float]) -> float:
        """The squared total gap of the model with these values."""
        return self.of(values).total ** 2

    def floors(self) -> dict[str, float]:
        """The floor by channel over all recordings."""
        each = [floor(s, s.train, len(s)) for s in self.recordings]
        return {c: math.sqrt(float(np.mean([f[c] ** 2 for f in each]))) for c in CHANNELS}

    @staticmethod
    def bottom(gap: Gap, floors: Mapping[str, float]) -> float:
        """The floor of the total gap."""
        return math.sqrt(float(np.mean([(floors[c] / gap.spread[c]) ** 2 for c in gap.rms])))
