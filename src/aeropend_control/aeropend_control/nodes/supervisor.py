# SPDX-License-Identifier: Apache-2.0
"""What stands between a control law and the rig: samples in order, references in range, and duty 0 when in doubt."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable

from aeropend_control.laws.law import Law
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.model.rig import Sample

LOST = Sample(math.nan, math.nan, math.nan, math.nan)
"""What a law is given for a sample that never came."""

LEAST_DUTY = 0.01
"""A rig that applies none of a duty below this may have rounded it to 0."""


class Supervisor:
    """Feeds a law and decides whether its duty goes out.

    A law that has been out of control of the rig for longer than `timeout` starts anew, since neither its memory of
    the arm nor its integral mean anything by then; what is shorter it bridges by its own prediction.

    Attributes:
        reference: what the law is asked for; NaN before the first.
        duty: the last one sent.
        fault: why the duty is 0, or has no effect, in one line; "" while all is well.
        refusal: why the last reference was refused; "" when it was not.
        counts: how often each kind of fault began, and `samples`, `lost`, `repeated`, `refused`.
    """

    def __init__(self, law: Law, *, angle_limit: float, low: float, high: float, unit: str = "rad",
                 measures: Iterable[str] = ("theta",), period: float = SAMPLE_PERIOD, timeout: float = 0.05) -> None:
        """Take a law in its care.

        Args:
            law: gets one sample after the other.
            angle_limit: rad; an arm further up than this, to either side, is let down.
            low: least reference.
            high: greatest reference.
            unit: of both, for people.
            measures: the readings, by the names of `Sample`, that the law cannot do without.
            period: of the samples, s.
            timeout: s without a reading, or without effect on the rig, after which the law starts anew.
        """
        self.law, self.angle_limit, self.low, self.high, self.unit = law, angle_limit, low, high, unit
        self.period, self.timeout = period, timeout
        self._measures = [Sample._fields.index(name) for name in dict.fromkeys(["theta", *measures])]
        self.reference, self.duty, self.fault, self.refusal = math.nan, 0.0, "", ""
        self.counts = Counter(dict.fromkeys(("samples", "lost", "repeated", "refused"), 0))
        self._fault_kind = ""
        self._stamp: int | None = None
        self._applied = 0.0
        self._unusable = 0  # samples in a row that could not be used
        self._without_effect = 0  # samples in a row to which the rig had applied nothing of a duty
        self._tripped = False
        self.law.reset()

    def set_reference(self, reference: float) -> bool:
        """Take a new reference; False when it is refused, which leaves the one before."""
        if not self.low <= reference <= self.high:  # NaN neither
            self.refusal = f"reference {reference:g} refused: give {self.low:g} to {self.high:g} {self.unit}"
            self.counts["refused"] += 1
            return False
        if math.isnan(self.reference) or self._tripped:
            self.law.reset()
        self.reference, self.refusal, self._tripped = reference, "", False
        return True

    def note_applied(self, duty: float) -> None:
        """Note what the rig says it applies; called for each sample that says so."""
        self._applied = duty if math.isfinite(duty) else 0.0
        if duty > 0.0:
            self._without_effect = 0
        elif self.duty > LEAST_DUTY:
            self._without_effect += 1

    def on_timeout(self) -> None:
        """Note that no sample has come for `timeout`: the duty is 0, and the law starts anew."""
        self.duty, self._unusable, self._without_effect = 0.0, 0, 0
        self.law.reset()
        self._set_fault("silent", f"no sample for {self.timeout:g} s: duty 0")

    def step(self, stamp_ns: int, sample: Sample) -> float | None:
        """Take a sample and return the duty to send; None for a sample that was there before.

        Args:
            stamp_ns: instant of sampling, ns.
            sample: NaN where there is no reading.
        """
        if not self._is_new(stamp_ns):
            return None
        self.counts["samples"] += 1
        self.duty = self._duty_for(sample)
        return self.duty

    def _is_new(self, stamp_ns: int) -> bool:
        """Whether this sample is news; the law is told of those lost before it."""
        before, self._stamp = self._stamp, stamp_ns
        if before is None:
            return True
        passed = 1e-9 * (stamp_ns - before)
        if 0.5 * self.period < passed < 1.5 * self.period:
            return True
        if abs(passed) > self.timeout:  # a gap, or time was set
            self.counts["lost"] += max(0, round(passed / self.period) - 1)
            self.law.reset(None, self._applied)  # which the rig has held meanwhile
            return True
        if passed < 0.5 * self.period:
            self.counts["repeated"] += 1
            self._stamp = max(before, stamp_ns)
            return False
        for _ in range(round(passed / self.period) - 1):
            self.counts["lost"] += 1
            if not math.isnan(self.reference):
                self.law.step(LOST, self.reference)
        return True

    def _duty_for(self, sample: Sample) -> float:
        missing = [Sample._fields[at] for at in self._measures if not math.isfinite(sample[at])]
        if missing:
            self._set_fault("unusable", f"{' and '.join(missing)} of a sample is NaN: duty 0")
            self._unusable += 1
            if not self._tripped and not math.isnan(self.reference):
                if self._unusable * self.period > self.timeout:
                    self.law.reset()
                else:
                    self.law.step(LOST, self.reference)
            return 0.0
        self._unusable = 0
        if abs(sample.theta) > self.angle_limit:
            self._tripped = True
        if self._tripped:
            self._set_fault("angle limit", f"the angle went beyond the limit of {self.angle_limit:g} rad: duty 0 "
                            "until the next reference")
            return 0.0
        if math.isnan(self.reference):
            self._set_fault("no reference", "no reference yet: duty 0")
            return 0.0
        off = self._without_effect * self.period > self.timeout
        if off:
            self.law.reset()
        duty = self.law.step(sample, self.reference)
        if not math.isfinite(duty):
            self.law.reset()
            self._set_fault("law", "the law has no duty for this sample: duty 0")
            return 0.0
        if off:
            self._set_fault("off", "the rig applies duty 0: it is off (service enable), or somebody else commands it")
        else:
            self._set_fault("", "")
        return min(max(duty, 0.0), 1.0)

    def _set_fault(self, kind: str, fault: str) -> None:
        if kind and kind != self._fault_kind:
            self.counts[kind] += 1
        self._fault_kind, self.fault = kind, fault
