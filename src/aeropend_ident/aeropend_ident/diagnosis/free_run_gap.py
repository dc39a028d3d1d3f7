# SPDX-License-Identifier: Apache-2.0
"""The gap: the difference between rig and model in a free run, on held-out data."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.free_run import free_run
from aeropend_ident.signals.signals import CHANNELS, FEWEST, Signals
from aeropend_sim.model.parameters import Model
from aeropend_sim.readings import MOST

Array = NDArray[np.float64]

WINDOW = 2.0
"""[s] Block of the bootstrap.

Choice: several time constants of the arm, so that blocks are nearly independent."""

RESAMPLES = 2000
"""Resamples of the bootstrap (choice: the ends of a 95 % interval then vary by about 2 % of its width)."""

AT_REST = 0.05
"""Share of its spread over the whole recording below which a channel rests on held-out data (choice)."""

STILL_ARM = 0.3
"""Share of its standard deviation over the recording below which the arm rests on held-out data (choice)."""

NOTHING_OPEN = 0.1
"""Gap above the floor, in floors, below which nothing is left to close (choice)."""


Part = Literal["held out", "fitted", "whole"]
"""Part of the recordings on which a gap is measured."""


@dataclass(frozen=True)
class Gap:
    """Difference between a model and a recording.

    Attributes:
        rms: channel -> RMS of simulated minus measured, in SI units.
        spread: channel -> standard deviation of the measured channel; of the whole recording where the channel rests.
        windows: (W, C) mean square over each bootstrap window, over spread squared.
        diverges: whether a simulated channel leaves all that a reading can be; its error is limited to twice that.
    """

    rms: dict[str, float]
    spread: dict[str, float]
    windows: Array
    diverges: bool = False

    @property
    def total(self) -> float:
        """RMS over the channels, each over its spread."""
        return float(np.sqrt(np.mean([(self.rms[c] / self.spread[c]) ** 2 for c in self.rms])))

    def total_floor(self, floors: Mapping[str, float]) -> float:
        """The same of floors by channel: the total gap of a perfect model."""
        return float(np.sqrt(np.mean([(floors[c] / self.spread[c]) ** 2 for c in self.rms])))

    def within(self, floors: Mapping[str, float], channels: Collection[str]) -> bool:
        """Whether none of some channels has a gap above its floor that could be closed."""
        return all(self.rms[c] <= (1.0 + NOTHING_OPEN) * floors[c] for c in self.rms if c in channels)


def gap(readings: Mapping[str, Array], signals: Signals, start: int, stop: int,
        left_out: NDArray[np.bool_] | None = None) -> Gap:
    """The gap between readings of a model and a recording.

    Args:
        readings: channel -> (N,).
        signals: the recording.
        start: first sample.
        stop: first sample after the last.
        left_out: (N,) samples at which the speed read is known to be false.
    """
    rms, spread, squares, diverges = {}, {}, [], False
    for channel in CHANNELS:
        measured = signals.channel(channel)[start:stop]
        known = np.isfinite(measured)
        if channel == "omega" and left_out is not None:
            known = known & ~left_out[start:stop]
        if known.sum() < FEWEST:
            continue
        error = np.where(known, readings[channel][start:stop] - measured, np.nan)
        most = 2.0 * MOST[channel]
        if not (np.abs(error[known]) <= most).all():
            diverges = True
            error[known] = np.clip(np.nan_to_num(error[known], nan=most), -most, most)
        rms[channel] = float(np.sqrt(np.mean(error[known] ** 2)))
        everywhere = float(np.nanstd(signals.channel(channel)))
        here = float(np.std(measured[known]))
        spread[channel] = max(here if here > AT_REST * everywhere else everywhere, signals.sigma[channel], 1e-12)
        squares.append(error**2 / spread[channel] ** 2)
    width = max(1, round(WINDOW / signals.period))
    edges = np.arange(0, max(stop - start - width, 0) + 1, width)
    with np.errstate(all="ignore"):
        windows = np.array([[np.nanmean(s[a:a + width]) if np.isfinite(s[a:a + width]).any() else 0.0
                             for s in squares] for a in edges]).reshape(len(edges), len(squares))
    return Gap(rms, spread, windows, diverges)


def floor(signals: Signals, start: int, stop: int) -> dict[str, float]:
    """The gap that the measurement chain alone leaves: noise, quantisation, and the timing of pulses.

    Args:
        signals: the recording.
        start: first sample.
        stop: first sample after the last.

    Returns:
        Channel -> RMS in SI units.
    """
    floors = {c: signals.sigma[c] for c in CHANNELS}
    p = signals.pulses
    if p is not None:
        mine = (p.index >= start) & (p.index < stop) & p.sure
        if mine.any():
            floors["omega"] = float(np.sqrt(np.average(p.sigma[mine] ** 2, weights=p.period[mine])))
    return floors


def closure(before: Gap, after: Gap, floors: Mapping[str, float], seed: int = 0
            ) -> tuple[float | None, float | None, float | None]:
    """Share of the closable gap that is closed, with a 95 % interval by a block bootstrap (H. Künsch, 1989).

    Args:
        before: gap of the nominal model.
        after: gap of the augmented model, of the same samples.
        floors: channel -> floor.
        seed: of the bootstrap.

    Returns:
        Share, low and high end; None where nothing is open, or for the ends if there are too few windows.
    """
    bottom = before.total_floor(floors)
    open_ = before.total - bottom
    if open_ <= NOTHING_OPEN * bottom:
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


class HeldOut:
    """Measures gaps on the held-out part of every recording.

    Args:
        chains: give the values of each recording.
        model: the nominal model.
        recordings: of one rig.
        spikes: whether `speed_spikes` was detected: the gap of the nominal model then counts false captures.
        part: of each recording on which is measured.
    """

    def __init__(self, chains: CutChains, model: Model, recordings: Sequence[Signals], *, spikes: bool,
                 part: Part = "held out") -> None:
        self.chains, self.model, self.recordings, self.spikes = chains, model, recordings, spikes
        self.part = part

    def in_motion(self) -> HeldOut:
        """The same, on the whole recordings if an arm rests in its held-out part, where no effect would show."""
        rests = any(np.nanstd(s.theta[s.train:]) < STILL_ARM * np.nanstd(s.theta) for s in self.recordings)
        return self.everywhere() if rests else self

    def for_shares(self) -> HeldOut:
        """The same where the parts of effects are measured.

        An effect may act in a part of the recording alone. The parameters of a calibrated rig are known within
        tolerances, and few beside its samples: the fitted part shows as well what comes back without an effect. Those
        of an uncalibrated rig follow what they were fitted to, so that only held-out data tell.
        """
        return self.everywhere() if self.chains.policy.calibrated else self.in_motion()

    def everywhere(self) -> HeldOut:
        """The same on the whole recordings."""
        return HeldOut(self.chains, self.model, self.recordings, spikes=self.spikes, part="whole")

    def fitted(self) -> HeldOut:
        """The same on the fitted parts."""
        return HeldOut(self.chains, self.model, self.recordings, spikes=self.spikes, part="fitted")

    def runs(self, values: Mapping[str, float]) -> list[dict[str, Array]]:
        """Free runs of the model with these values, one a recording."""
        return [free_run(self.model, s, self.chains.values_of(values, k)) for k, s in enumerate(self.recordings)]

    def gap(self, readings: Sequence[Mapping[str, Array]], *, known: bool = True) -> Gap:
        """The gap over all recordings.

        Args:
            readings: of a model, one a recording.
            known: whether false captures are left out that make the effect `speed_spikes`; too few for it always are.
        """
        gaps = [gap(r, s, s.train if self.part == "held out" else 0, s.train if self.part == "fitted" else len(s),
                    s.false_speed if known or not self.spikes else None)
                for r, s in zip(readings, self.recordings, strict=True)]
        if len(gaps) == 1:
            return gaps[0]
        channels = [c for c in CHANNELS if all(c in g.rms for g in gaps)]
        rms = {c: math.sqrt(float(np.mean([g.rms[c] ** 2 for g in gaps]))) for c in channels}
        spread = {c: math.sqrt(float(np.mean([g.spread[c] ** 2 for g in gaps]))) for c in channels}
        columns = [[list(g.rms).index(c) for c in channels] for g in gaps]
        windows = np.concatenate([g.windows[:, i] for g, i in zip(gaps, columns, strict=True)])
        return Gap(rms, spread, windows, any(g.diverges for g in gaps))

    def gap_of(self, values: Mapping[str, float]) -> Gap:
        """The gap of the model with these values."""
        return self.gap(self.runs(values))

    def floors(self) -> dict[str, float]:
        """The floor by channel over all recordings."""
        each = [floor(s, s.train, len(s)) for s in self.recordings]
        return {c: math.sqrt(float(np.mean([f[c] ** 2 for f in each]))) for c in CHANNELS}
