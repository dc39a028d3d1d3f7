# SPDX-License-Identifier: Apache-2.0
"""Sequential detection of effects that begin while a rig runs: when, where and which.

What the stages leave (`companion_model`) is, to first order, linear in the sizes of the parameters and effects of the
bank. A Kalman filter tracks all sizes within what a rig may have, as an Ornstein-Uhlenbeck process; so a winding that
warms up is no change. Beside it, for each instant of a window, each size is tried as if it had jumped there: the
generalised likelihood ratio of A. Willsky and H. Jones (A generalized likelihood ratio approach to the detection and
estimation of jumps in linear systems. IEEE Transactions on Automatic Control 21, 1976), see M. Basseville and
I. Nikiforov (Detection of Abrupt Changes, 1993, chapter 7). The unknown size costs its Occam factor, as in the
diagnosis.

Effects of chance change the variance, not the mean. For them there are cumulative sums of the log likelihood ratio
(CUSUM, E. Page 1954); their mean time between false alarms is at least exp(limit) blocks (G. Lorden: Procedures for
reacting to a change in distribution. Annals of Mathematical Statistics 42, 1971).

The limit follows from the mean time between false alarms that a person asks for (`false_alarms`). The residuals are
coloured: each channel is weighted by the variance of its sums over two seconds, which is learned.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.priors import SIZE_SD
from aeropend_ident.diagnosis.chain.values import PLACE_OF_CHANNEL, STAGES
from aeropend_ident.diagnosis.search.hypotheses import EFFECT_ODDS
from aeropend_ident.diagnosis.search.onset import WITHIN
from aeropend_ident.live.bank import Column, size_of
from aeropend_ident.live.companion_model import CHANNELS, Residuals
from aeropend_ident.live.false_alarms import TICK
from aeropend_sim.model.parameters import SAMPLE_PERIOD

Array = NDArray[np.float64]

WINDOW = 20.0
"""[s] Longest time back for which an instant is tried (choice: the time within which an effect must be named)."""

GUARD = 0.3
"""[s] Time after an instant that is left out.

Choice: the columns are those of effects that have long been there; observer and rotor settle in about this time."""

GROWTH = 1.25
"""Ratio of the ages of two instants that are tried (choice: a likelihood ratio loses a tenth in between at most)."""

WARMS, WARMING = ("actuator", "electrical"), 600.0
"""Places whose sizes wander within what a rig may have, and [s] the time constant.

Choice: windings warm up and batteries drain in minutes, not in seconds."""

WEARING = 86_400.0
"""[s] Time constant of all other sizes (choice: wear takes days; a screw that gets loose is a change).

Ten minutes for all sizes were too short: an effect of the arm of 5 floors passed for what a rig may have."""

BLOCK = 2.0
"""[s] Length of the blocks over which the variance of sums is measured.

Choice: what small imperfections leave lasts as long as the arm stays where it is, about the time between references."""

REMEMBERED = 300.0
"""[s] Time constant with which the variance of a channel is learned (choice: many references)."""

LEARNS = 60.0
"""[s] Time of motion after a start in which the rig is learned and no alarm is given (choice: a dozen references)."""

AGAIN = 15.0
"""[s] Time of motion in which the rig is learned after an alarm was cleared (choice: some references)."""

RAISED = 2.0
"""Multiple of the largest likelihood ratio of a stage while the rig was learned by which its evidence is lowered.

Choice: what a rig has shown once without a change it will show again, and perhaps somewhat larger."""

LEAST_GAP = 0.2
"""[floors] Lasting gap in a channel that is never material (choice: a tenth of the two floors from which an effect is
to be found; the linearised model of a rig whose numbers are 5 % off leaves a quarter of it, and more after jumps)."""

INEXACT = 0.01
"""Share of the evidence by which two instants may differ and fit as well (choice: the columns are linearised)."""

MISFIT = 0.05
"""Share of the evidence by which two hypotheses may differ and be as likely (choice: the columns are those of small and
lasting effects; an effect of twice its usual size, or one that has just begun, fits them to some percent)."""

NEAR = 3.0
"""[s] Distance from the instant of an alarm within which all instants are judged with what comes later (choice)."""

ROBUST = 9.0
"""Largest square of a sum, in variances, that is learned from (convention: three standard deviations)."""

MORE = 4.0
"""Ratio of the variances that the cumulative sum of a channel tells apart (choice: twice the floor)."""

SPIKES = (0.02, 0.3)
"""[1/s] Rates of false captures that the cumulative sum tells apart (choice: of a good rig, of a bad one)."""

SETTLES = 3.0
"""[s] Time after a start in which nothing is judged (choice: the slowest start of rotor and observer)."""


def _of_chance(channel: str) -> str:
    """The hypothesis that the variance of a channel has grown."""
    return "gust" if channel == "theta" else f"unknown:{channel}"


PULSES = "pulses"
"""Beside the stages of the chain: what only the intervals of the pulses show."""

STAGES_OF_CHANCE = {"speed_spikes": (PULSES,), **{_of_chance(c): (stage,) for c, stage in zip(
    CHANNELS, ("actuator", "motor", "motor", "arm"), strict=True)}}
"""Hypotheses on the variance -> stages whose residuals they change."""


@dataclass(frozen=True)
class Finding:
    """A hypothesis on a change.

    Attributes:
        hypothesis: effect, or `parameter_mismatch:NAME`.
        place: of the chain.
        evidence: log likelihood ratio against no change, with Occam factor and prior odds, less what its stage may show
            without a change.
        size: change of the size, SI.
        since: [s] instant, in the time of the detector: the middle of those that fit about as well.
        within: [s] the earliest and the latest of these, a 95 % interval by the profile likelihood.
        gap: [floors] RMS that the change makes in the channels of its stage.
        probability: among all hypotheses on a change.
    """

    hypothesis: str
    place: str
    evidence: float
    size: float
    since: float
    gap: float
    within: tuple[float, float]
    probability: float = 0.0


@dataclass(frozen=True)
class PlaceState:
    """What is known of one place.

    Attributes:
        gap: [floors] that the likeliest change there makes.
        limit: [floors] gap at which that change would be an alarm; inf: the rig is not excited enough to say.
        excited: whether a change of a usual size would show.
    """

    gap: float
    limit: float
    excited: bool


@dataclass
class _Snapshot:
    """State of a stage at an instant: prior information, and sums since the start."""

    time: float
    information: Array
    pull: Array
    products: Array
    cross: Array
    squares: Array
    rows: float


class _Stage:
    """Tracking of the sizes of one stage."""

    def __init__(self, columns: Sequence[Column], tick: float) -> None:
        self.columns = list(columns)
        d = len(self.columns)
        self.scale = np.array([c.sd / c.step for c in self.columns])
        self.keep = np.exp([-tick / (WARMING if c.place in WARMS else WEARING) for c in self.columns])
        self.x, self.p = np.zeros(d), np.eye(d)
        self.products, self.cross, self.squares, self.rows = np.zeros((d, d)), np.zeros(d), np.zeros((d, d)), 0.0
        self.snapshots: deque[_Snapshot] = deque(maxlen=round(WINDOW / tick) + 1)

    def linear(self, rows: Array) -> tuple[Array, Array]:
        """Residuals (R,) of the nominal model and sensitivities (R, D) to the sizes in their standard deviations."""
        r = rows[:, 0]
        return r, (r[:, None] - rows[:, 1:]) * self.scale

    def update(self, r: Array, j: Array, weight: Array) -> Array:
        """Take the rows of a tick; returns what the sizes tracked so far leave of them."""
        left = r - j @ self.x
        wj = j * weight[:, None]
        n, y = wj.T @ j, wj.T @ r
        d = len(self.x)
        p = np.outer(self.keep, self.keep) * self.p + np.diag(1.0 - self.keep**2)
        x = self.keep * self.x
        p = np.linalg.solve(np.eye(d) + p @ n, p)
        self.p = 0.5 * (p + p.T)
        self.x = x + self.p @ (y - n @ x)
        self.products = self.products + n
        self.cross = self.cross + y
        self.squares = self.squares + j.T @ j
        self.rows += len(r)
        return np.asarray(left)

    def snapshot(self, time: float) -> None:
        """Remember this instant."""
        information = np.linalg.inv(self.p)
        self.snapshots.append(_Snapshot(time, np.asarray(information), information @ self.x, self.products, self.cross,
                                        self.squares, self.rows))

    def scores(self, pairs: Sequence[tuple[_Snapshot, _Snapshot]]) -> tuple[Array, Array, Array]:
        """Score (K, D) and information (K, D, D) of jumps at each instant, and mean products of the columns (K, D, D).

        Args:
            pairs: the instant, and the end of its guard.
        """
        n = self.products - np.array([b.products for _, b in pairs])
        y = self.cross - np.array([b.cross for _, b in pairs])
        a = np.array([s.information for s, _ in pairs]) + n
        b = np.array([s.pull for s, _ in pairs]) + y
        solved = np.linalg.solve(a, np.concatenate([n, b[:, :, None]], axis=2))
        score = y - np.einsum("kij,kj->ki", n, solved[:, :, -1])
        information = n - n @ solved[:, :, :-1]
        rows = np.maximum(self.rows - np.array([b.rows for _, b in pairs]), 1.0)
        mean = (self.squares - np.array([b.squares for _, b in pairs])) / rows[:, None, None]
        return score, information, mean

    def reset(self) -> None:
        """Forget the instants, and keep the sizes."""
        self.snapshots.clear()


class _Variance:
    """Variance of the sums of a channel, learned with a delay, and the cumulative sum that tells when it grows."""

    def __init__(self) -> None:
        self.blocks, self.sum, self.unsure, self.n = 0, 0.0, 0.0, 0
        self.typical = BLOCK / SAMPLE_PERIOD
        self.value = 1.0
        self.waiting: deque[tuple[float, float]] = deque()
        self.cusum, self.since = 0.0, 0.0

    @property
    def weight(self) -> float:
        """Of a row: over the variance of a sum, which is at least that of a gap that is never material."""
        return 1.0 / (self.value + LEAST_GAP**2 * self.typical)

    def add(self, left: Array, unsure: float) -> None:
        """Take what is left of some rows, and the variance of their sum that unknown sizes make."""
        self.sum += float(np.clip(left, -1e6, 1e6).sum())
        self.unsure += math.sqrt(unsure)
        self.n += len(left)

    def close(self, time: float, learn: bool) -> None:
        """End a block."""
        if self.n == 0:
            return
        self.typical += (self.n - self.typical) / min(self.blocks + 2, 100)
        z, unsure = self.sum * self.sum / self.n, self.unsure**2 / self.n
        expected = self.value + LEAST_GAP**2 * self.n + unsure
        learn = learn and unsure < expected - unsure
        gain = 0.5 * (min(z / expected, 1e4) * (1.0 - 1.0 / MORE) - math.log(MORE))
        if self.cusum <= 0.0:
            self.since = time - BLOCK
        self.cusum = max(0.0, self.cusum + gain)
        self.waiting.append((time, z))
        while self.waiting and (time - self.waiting[0][0] > WINDOW or self.blocks < LEARNS / BLOCK):
            _, z = self.waiting.popleft()
            if learn:
                self.blocks += 1
                share = max(BLOCK / REMEMBERED, 1.0 / (self.blocks + 1))
                self.value += share * (min(z, ROBUST * max(self.value, 1.0)) - self.value)
                self.value = max(self.value, 1.0)
        self.sum, self.unsure, self.n = 0.0, 0.0, 0


class Detector:
    """Tells when a rig and its model part.

    Args:
        columns: of the bank.
        limit: of the log likelihood ratios; see `false_alarms.limit`.

    Attributes:
        peaks: stage -> largest likelihood ratio while the rig was learned.
    """

    def __init__(self, columns: Sequence[Column], limit: float) -> None:
        self.columns, self.limit = list(columns), limit
        self.learned = 0.0
        self.peaks = dict.fromkeys((*STAGES, PULSES), 0.0)
        self._stages_of = {c.hypothesis: c.stages for c in columns} | STAGES_OF_CHANCE
        self.stages = {b: _Stage([c for c in columns if b in c.stages], TICK) for b in STAGES}
        self.variance = [_Variance() for _ in CHANNELS]
        self.time = 0.0
        self.tick = 0
        self.settled_at = SETTLES
        self.spikes, self.spikes_since = 0.0, 0.0
        self.ages = sorted({round(a) for a in GUARD / TICK + 1 + GROWTH ** np.arange(0, 40)
                            if a < WINDOW / TICK})
        self.alarm: Finding | None = None
        self.alarm_at = 0.0
        self.findings: list[Finding] = []
        self.gaps = np.zeros(len(CHANNELS))
        self._frozen: dict[str, list[tuple[_Snapshot, _Snapshot]]] = {}
        self._pending: list[Residuals] = []
        self._pending_s = 0.0
        self.statistic = 0.0
        self._shown: dict[str, PlaceState] = {}

    # ---- samples

    def step(self, residuals: Residuals, seconds: float, moving: bool = True) -> bool:
        """Take what some samples leave.

        Args:
            residuals: of the companion.
            seconds: [s] their duration.
            moving: whether to learn from them.

        Returns:
            Whether a tick has ended.
        """
        self._pending.append(residuals)
        self._pending_s += seconds
        if self._pending_s < TICK - 1e-3:
            return False
        pending, self._pending = self._pending, []
        span, self._pending_s = self._pending_s, 0.0
        self.time += span
        self.tick += 1
        judged = self.time > self.settled_at
        if judged and moving:
            self.learned += span
        weights = np.array([v.weight for v in self.variance])
        square, count = np.zeros(len(CHANNELS)), np.zeros(len(CHANNELS))
        for name, stage in self.stages.items():
            rows = np.concatenate([p.rows[name] for p in pending])
            channel = np.concatenate([p.channel[name] for p in pending])
            r, j = stage.linear(np.clip(rows, -1e4, 1e4))
            for c in set(channel.tolist()):
                mine = r[channel == c]
                square[c], count[c] = float(mine @ mine), len(mine)
            if judged and len(r):
                before = stage.p
                left = stage.update(r, j, weights[channel])
                for c in set(channel.tolist()):
                    total = j[channel == c].sum(axis=0)
                    self.variance[c].add(left[channel == c], max(float(total @ before @ total), 0.0))
            stage.snapshot(self.time)
        share = 1.0 - math.exp(-span / 1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            now = np.where(count > 0, square / np.maximum(count, 1), self.gaps**2)
        self.gaps = np.sqrt(self.gaps**2 + share * (now - self.gaps**2))
        spikes = sum(p.spikes for p in pending)
        if judged:
            if self.spikes <= 0.0:
                self.spikes_since = self.time - span
            low, high = SPIKES
            self.spikes = max(0.0, self.spikes + spikes * math.log(high / low) - (high - low) * span)
        if self.tick % round(BLOCK / TICK) == 0 and judged:
            for v in self.variance:
                v.close(self.time, learn=moving)
        return True

    # ---- judgement

    def judge(self) -> Finding | None:
        """Look for a change; returns it when it is new."""
        self.findings = self.changes()
        self.statistic = max((f.evidence for f in self.findings), default=0.0)
        if self.learned < LEARNS:
            for f in self.findings:
                for stage in self._stages_of[f.hypothesis]:
                    self.peaks[stage] = max(self.peaks[stage], f.evidence)
            return None
        if self.alarm is None and self.findings and self.statistic > self.limit:
            self._freeze(*self.findings[0].within)
            self.findings = self.changes()
            self.alarm, self.alarm_at = self.findings[0], self.time
            return self.alarm
        if self.alarm is not None and self.findings and self.time < self.alarm_at + 3.0 * WINDOW:
            best = self.findings[0]
            if best.evidence > self.alarm.evidence or best.hypothesis == self.alarm.hypothesis:
                self.alarm = best
        return None

    def _shown_before(self, hypothesis: str) -> float:
        """Evidence for a hypothesis that its stages may show without a change."""
        if self.learned < LEARNS:
            return 0.0
        return RAISED * max(self.peaks[stage] for stage in self._stages_of[hypothesis])

    def _show(self, shown: dict[str, PlaceState], c: Column, information: Array, size: float, mean: Array, k: int
              ) -> None:
        """Note the least gap that a change would show, and the gap that it makes now.

        Args:
            shown: filled.
            c: a column of it.
            information: (K,) of its size at each instant.
            size: of it, in standard deviations.
            mean: (K,) mean square of its column.
            k: the likeliest instant.
        """
        at = int(np.argmax(information))
        needed = (self.limit + self._shown_before(c.hypothesis) - c.log_odds
                  + 0.5 * math.log1p(max(information[at], 0.0) * (c.wide / c.sd) ** 2))
        least = math.sqrt(2.0 * needed / max(information[at], 1e-12))  # in standard deviations of the size
        limit = max(least * math.sqrt(mean[at]), 1e-9) if information[at] > 1e-9 else math.inf
        gap = size * math.sqrt(mean[k])
        excited = least * c.sd < c.wide / SIZE_SD
        before = shown.get(c.place)
        if before is None or (excited, gap / limit) > (before.excited, before.gap / before.limit):
            shown[c.place] = PlaceState(gap, limit, excited or (before is not None and before.excited))

    def _pairs(self, stage: _Stage) -> list[tuple[_Snapshot, _Snapshot]]:
        held, guard = stage.snapshots, round(GUARD / TICK)
        oldest = len(held) - 1
        return [(held[oldest - a], held[oldest - a + guard]) for a in self.ages if a <= oldest]

    def _freeze(self, low: float, high: float) -> None:
        """Keep the instants from one to another and near them, so that they can be judged with what comes later."""
        guard = round(GUARD / TICK)
        for name, stage in self.stages.items():
            held = list(stage.snapshots)
            last = len(held) - 1 - guard
            near = [k for k in range(last) if low - NEAR < held[k].time < high + NEAR]
            self._frozen[name] = [(held[k], held[k + guard]) for k in near] or self._pairs(stage)

    def changes(self) -> list[Finding]:
        """All hypotheses on a change, the most probable first, each at its likeliest instant."""
        table: dict[tuple[object, ...], tuple[list[Column], list[tuple[Array, Array, Array]]]] = {}
        times: list[float] = []
        for name, stage in self.stages.items():
            pairs = self._frozen.get(name) or self._pairs(stage)
            if not pairs:
                return []
            times = [s.time for s, _ in pairs]
            score, information, mean = stage.scores(pairs)
            groups: dict[tuple[object, ...], list[int]] = {}
            for i, c in enumerate(stage.columns):
                groups.setdefault((c.hypothesis,) if c.joint else (c.hypothesis, c.values), []).append(i)
            for which, own in groups.items():
                together = np.ix_(range(len(times)), own, own)
                table.setdefault(which, ([stage.columns[i] for i in own], []))[1].append(
                    (score[:, own], information[together], mean[together]))
        best: dict[str, Finding] = {}
        total: dict[str, float] = {}
        shown: dict[str, PlaceState] = {}
        for columns, parts in table.values():
            c = columns[0]
            if c.wide <= 0.0:
                continue
            score, information = (np.sum([p[i] for p in parts], axis=0) for i in (0, 1))
            mean = np.max([p[2] for p in parts], axis=0)
            prior = np.diag([(c.sd / c.wide) ** 2 for c in columns])
            size = np.linalg.solve(information + prior, score[:, :, None])[:, :, 0]
            evidence = 0.5 * (score * size).sum(axis=1) - 0.5 * np.linalg.slogdet(
                np.eye(len(columns)) + np.linalg.solve(prior, information))[1] + c.log_odds
            told = np.array([size_of(columns, [x * c.sd for x, c in zip(sizes, columns, strict=True)])
                             for sizes in size.tolist()])
            if c.sign:
                evidence = np.where(told * c.sign > 0.0, evidence, -np.inf)
            k = int(np.argmax(evidence))
            far = max(float(np.linalg.norm(size[k])), 1e-12)
            u = size[k] / far
            self._show(shown, c, u @ information @ u, far, np.maximum(u @ mean @ u, 0.0), k)
            if not np.isfinite(evidence[k]):
                continue
            usual = self._shown_before(c.hypothesis)
            total[c.hypothesis] = np.logaddexp(total.get(c.hypothesis, -np.inf), np.logaddexp.reduce(evidence))
            if c.hypothesis not in best or evidence[k] - usual > best[c.hypothesis].evidence:
                near = [times[i] for i in np.flatnonzero(
                    evidence > evidence[k] - WITHIN - INEXACT * abs(evidence[k]))]
                best[c.hypothesis] = Finding(
                    c.hypothesis, c.place, float(evidence[k]) - usual, float(told[k]), 0.5 * (min(near) + max(near)),
                    far * math.sqrt(max(float(u @ mean[k] @ u), 0.0)), (min(near), max(near)))
        self._shown = shown
        for f in self._random():
            best[f.hypothesis], total[f.hypothesis] = f, f.evidence + self._shown_before(f.hypothesis)
        for name, f in best.items():
            if f.evidence <= self.limit:  # its stage may show as much without a change
                total[name] = min(total[name], f.evidence)
        top = max(total.values(), default=0.0)
        like = {name: math.exp((v - top) / (1.0 + MISFIT * max(top, 0.0))) for name, v in total.items()}
        found = [replace(f, probability=like[f.hypothesis] / sum(like.values())) for f in best.values()]
        return sorted(found, key=lambda f: -f.probability)

    def shows(self, place: str) -> PlaceState:
        """What a place shows in the window.

        Args:
            place: of the chain.
        """
        return self._shown.get(place, PlaceState(0.0, math.inf, False))

    def drifted(self, beyond: float) -> dict[str, tuple[str, float]]:
        """Places with a size that is surely further from nominal than a rig's may be: hypothesis, and size.

        Args:
            beyond: standard deviations of what a rig may have.
        """
        found: dict[str, tuple[str, float]] = {}
        for stage in self.stages.values():
            surely = np.abs(stage.x) - 2.0 * np.sqrt(np.diag(stage.p))
            for k in np.argsort(surely):
                c = stage.columns[k]
                if surely[k] > beyond and c.wide > 0.0:
                    found[c.place] = c.hypothesis, float(stage.x[k] * c.sd)
        return found

    def _random(self) -> list[Finding]:
        """The effects of chance, by their cumulative sums."""
        grown = [(_of_chance(c), PLACE_OF_CHANNEL[c], v.cusum, v.since)
                 for c, v in zip(CHANNELS, self.variance, strict=True)]
        spikes = "speed_spikes", "sensing", self.spikes, self.spikes_since
        found = [Finding(name, place, value + math.log(EFFECT_ODDS) - self._shown_before(name), math.nan, since, 0.0,
                         (since, self.time)) for name, place, value, since in (spikes, *grown) if value > 0.0]
        if any(f.hypothesis == "speed_spikes" and f.evidence > self.limit for f in found):
            return [f for f in found if f.hypothesis != _of_chance("omega")]  # the spikes make the variance grow
        return found

    def clear(self) -> None:
        """Take the rig as it is now: forget the alarm and the instants, and learn all sizes anew, whatever they are."""
        self.alarm = None
        self._frozen = {}
        self.settled_at = self.time + SETTLES
        self.learned = min(self.learned, LEARNS - AGAIN)
        for stage in self.stages.values():
            stage.reset()
            stage.p = np.diag([max(c.wide / c.sd, 1.0) ** 2 for c in stage.columns])
        for v in self.variance:
            v.cusum = 0.0
            v.waiting.clear()
        self.spikes = 0.0

    def restart(self) -> None:
        """The samples were interrupted: settle again. An alarm stays."""
        self.settled_at = self.time + SETTLES
        self._pending, self._pending_s = [], 0.0
        for stage in self.stages.values():
            stage.reset()
