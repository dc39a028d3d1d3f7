# SPDX-License-Identifier: Apache-2.0
"""The model beside the rig without ROS: samples in; what the model says, and the state of each place, out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from aeropend_ident.diagnosis.chain.values import PLACE_OF_CHANNEL
from aeropend_ident.live.bank import columns
from aeropend_ident.live.companion_model import CHANNELS, Companion, Residuals
from aeropend_ident.live.detector import LEARNS, Detector, Finding
from aeropend_ident.live.false_alarms import limit
from aeropend_ident.live.intake import Batch
from aeropend_sim.model.effects import PLACES
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

JUDGED = 2
"""Ticks between two judgements (choice: 0.2 s, a tenth of what a detection may take)."""

OUT_OF_RANGE = 3.0
"""Standard deviations of its prior beyond which a number that is tracked is material (convention: as in the
diagnosis)."""

MOVES, MOVES_S = 0.01, 5.0
"""Spread of the duty over about so many seconds above which the rig counts as moving (choice: 1 % of its range)."""

OK, NOT_EXCITED, EXPLAINED = "ok", "not excited enough to say", "explained by the alarm"
DRIFTED, PARTED, STALE = "drifted", "parted", "stale"
"""States of a place."""


@dataclass(frozen=True)
class Place:
    """State of one place of the chain.

    Attributes:
        state: one of the states above.
        gap: [floors] that the likeliest change at this place makes now.
        limit: [floors] at which it is an alarm; inf: none would show.
        residual: [floors] RMS of measured minus model in the channel that shows the place first.
        effect: the likeliest effect, "" if none is likely.
        probability: of this effect among all changes.
        size: of this effect, SI; NaN of an effect of chance.
        since_ns: stamp of the begin; 0 if nothing has begun.
    """

    state: str
    gap: float = 0.0
    limit: float = math.inf
    residual: float = 0.0
    effect: str = ""
    probability: float = 0.0
    size: float = math.nan
    since_ns: int = 0


class Watcher:
    """Companion and detector of one rig.

    Args:
        model: the nominal model.
        mean_hours: [h] mean time between two false alarms.

    Attributes:
        alarm: the change that was found, until `clear`.
        places: state of each place.
        free_gap: [floors] RMS of measured minus free-running model by channel, over about the last second.
        fault: why the samples cannot be judged; "" if they can.
        alarms: number of alarms so far; that of the alarm that stands.
    """

    def __init__(self, model: Model, mean_hours: float = 24.0, period: float = SAMPLE_PERIOD) -> None:
        self.model, self.period = model, period
        bank = columns(model)
        self.companion = Companion(model, bank, period)
        self.detector = Detector(bank, limit(mean_hours))
        self.places = {place: Place(STALE) for place in PLACES}
        self.free_gap = dict.fromkeys(CHANNELS, 0.0)
        self.fault = "no sample yet"
        self.breaks = self.alarms = 0
        self._duty = self._spread = 0.0
        self._epoch_ns = 0  # stamp at time 0 of the detector, by its last tick
        self._alarm_epoch_ns = 0  # the same by the tick of the alarm: the detector's time stands still in a break

    @property
    def to_learn(self) -> float:
        """[s] Motion that is needed before anything is judged."""
        return max(LEARNS - self.detector.learned, 0.0)

    @property
    def note(self) -> str:
        """Why nothing is judged at present; "" if it is."""
        return self.fault or (f"learning the rig: {self.to_learn:.0f} s of motion left" if self.to_learn else "")

    @property
    def alarm(self) -> Finding | None:
        """The change that was found, until `clear`."""
        return self.detector.alarm

    @property
    def now_ns(self) -> int:
        """[ns] Stamp of the last tick."""
        return self._epoch_ns + round(self.detector.time * 1e9)

    @property
    def since_ns(self) -> int:
        """[ns] Stamp of the instant at which what the alarm tells has begun; 0 without an alarm."""
        return self._alarm_epoch_ns + round(self.alarm.since * 1e9) if self.alarm is not None else 0

    @property
    def alarm_ns(self) -> int:
        """[ns] Stamp of the alarm; 0 without one."""
        return self._alarm_epoch_ns + round(self.detector.alarm_at * 1e9) if self.alarm is not None else 0

    def step(self, batch: Batch, *, frozen: bool = False) -> tuple[Residuals, Finding | None]:
        """Take some samples.

        Args:
            batch: consecutive samples.
            frozen: whether the readings do not change: then nothing is judged.

        Returns:
            What the model says of them, and the change that was found with them, if it is new.
        """
        if batch.broken or not self.companion.running:
            self.breaks += self.companion.running
            self.companion.restart()
            self.detector.restart()
        residuals = self.companion.step(batch.samples)
        if not all(np.isfinite(rows).all() for rows in residuals.rows.values()) or not np.isfinite(
                np.concatenate(residuals.said)).all():
            self.companion.restart()  # impossible readings have driven a model out of all range
            self.detector.restart()
            self._stale("the readings are impossible")
            return residuals, None
        self._compare(batch, residuals)
        if frozen:
            self.detector.restart()
            self._stale("the readings do not change: the sensors are frozen")
            return residuals, None
        self.fault, found = "", None
        d = self.detector
        if d.step(residuals, len(batch.stamps) * self.period, self._moves(batch)):
            self._epoch_ns = int(batch.stamps[-1]) - round(d.time * 1e9)
            if d.tick % JUDGED == 0:
                found = d.judge()
                if found is not None:
                    self.alarms += 1
                    self._alarm_epoch_ns = self._epoch_ns
                self._look()
        return residuals, found

    def silent(self, why: str) -> None:
        """Say that no samples come, and why."""
        self.companion.restart()
        self.detector.restart()
        self._stale(why)

    def clear(self) -> None:
        """Take the rig as it is now."""
        self.detector.clear()
        self._look()

    def changed(self, effect: str) -> bool:
        """Whether the residuals speak for a change of an effect at the instant of the alarm.

        Args:
            effect: its id.
        """
        return any(f.hypothesis == effect and f.evidence > 0.0 for f in self.detector.findings)

    def _stale(self, why: str) -> None:
        self.fault = why
        for name, place in self.places.items():
            if place.state != PARTED:
                self.places[name] = Place(STALE)

    def _moves(self, batch: Batch) -> bool:
        """Whether the duty has changed within about the last seconds."""
        share = 1.0 - math.exp(-len(batch.stamps) * self.period / MOVES_S)
        duty = batch.samples.duty[np.isfinite(batch.samples.duty)]
        if len(duty):
            self._duty += share * (float(duty.mean()) - self._duty)
            self._spread += share * (float(np.mean((duty - self._duty) ** 2)) - self._spread)
        return self._spread > MOVES**2

    def _compare(self, batch: Batch, residuals: Residuals) -> None:
        share = 1.0 - math.exp(-len(batch.stamps) * self.period)
        floors = self.companion.floors
        for channel in CHANNELS:
            e = (getattr(batch.samples, channel) - getattr(residuals.said, channel)) / floors[channel]
            e = e[np.isfinite(e)]
            if len(e):
                before = self.free_gap[channel] ** 2
                self.free_gap[channel] = math.sqrt(before + share * (float(e @ e) / len(e) - before))

    def _look(self) -> None:
        """Renew the state of each place."""
        d = self.detector
        residual = dict.fromkeys(PLACES, 0.0)
        for channel, gap in zip(CHANNELS, d.gaps, strict=True):
            residual[PLACE_OF_CHANNEL[channel]] = float(gap)
        residual["thrust"] = residual["arm"]
        residual["sensing"] = float(d.gaps.max())
        drifted = d.drifted(OUT_OF_RANGE)
        for name in PLACES:
            here = [f for f in d.findings if f.place == name]
            seen = d.shows(name)
            state = NOT_EXCITED if not seen.excited else OK
            if d.alarm is not None and seen.gap > seen.limit:
                state = EXPLAINED
            finding = max(here, key=lambda f: f.evidence, default=None)
            since, effect, probability, size = 0, "", 0.0, math.nan
            if d.alarm is not None and d.alarm.place == name:
                state, finding = PARTED, d.alarm
            elif name in drifted:
                state = DRIFTED
                effect, size = drifted[name]
            if finding is not None and (state == PARTED or finding.evidence > 0.0):
                effect, probability, size = finding.hypothesis, finding.probability, finding.size
                since = self.since_ns if state == PARTED else self._epoch_ns + round(finding.since * 1e9)
            self.places[name] = Place(state, seen.gap, seen.limit, residual[name], effect, probability, size, since)
