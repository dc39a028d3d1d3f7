# SPDX-License-Identifier: Apache-2.0
"""Supervision of a control law: samples in order, references in range, and duty 0 after a fault."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable

from aeropend_control.laws.law import Law
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.model.rig import Sample
from aeropend_sim.readings import is_possible

LOST = Sample(math.nan, math.nan, math.nan, math.nan)
"""The sample that a law gets for a lost one."""

LEAST_DUTY = 0.01
"""Least commanded duty at which an applied duty of 0 is a fault: a rig may round smaller duties to 0 (choice)."""


class Supervisor:
    """Passes samples to a law and decides whether its duty is sent.

    The law restarts if it did not control the rig for longer than `timeout`, because its state and its integral are
    then no longer valid. It bridges shorter gaps by prediction.

    Attributes:
        reference: current reference; NaN before the first.
        duty: the last duty sent.
        fault: why the duty is 0 or has no effect, in one line; "" without a fault.
        doubt: which reading of the last sample is no possible number, in one line; "" without one.
        refusal: why the last reference was refused; "" if it was accepted.
        counts: number of faults of each kind, and of `samples`, `lost`, `repeated`, `refused` and `impossible`.
    """

    def __init__(self, law: Law, *, angle_limit: float, low: float, high: float, unit: str = "rad",
                 measures: Iterable[str] = ("theta",), period: float = SAMPLE_PERIOD, timeout: float = 0.05) -> None:
        """Prepare the supervision of a law; the law is reset.

        Args:
            law: gets one sample after the other.
            angle_limit: [rad] beyond this angle, to either side, the duty is 0.
            low: least reference.
            high: greatest reference.
            unit: of the references, for messages.
            measures: the readings, fields of `Sample`, that the law needs.
            period: [s] between samples.
            timeout: [s] without a reading, or without effect on the rig, after which the law restarts.
        """
        self.law, self.angle_limit, self.low, self.high, self.unit = law, angle_limit, low, high, unit
        self.period, self.timeout = period, timeout
        self._measures = [Sample._fields.index(name) for name in dict.fromkeys(["theta", *measures])]
        self.reference, self.duty, self.fault, self.refusal, self.doubt = math.nan, 0.0, "", "", ""
        self.counts = Counter(dict.fromkeys(("samples", "lost", "repeated", "refused", "impossible"), 0))
        self._fault_kind = ""
        self._stamp: int | None = None
        self._applied = 0.0
        self._unusable = 0  # number of unusable samples in a row
        self._without_effect = 0  # number of samples in a row at which the rig applied duty 0 instead of the command
        self._tripped = False
        self.law.reset()

    def set_reference(self, reference: float) -> bool:
        """Set a new reference. Returns False if it is refused; then the previous one stays."""
        if not self.low <= reference <= self.high:  # false for NaN too
            self.refusal = f"reference {reference:g} refused: give {self.low:g} to {self.high:g} {self.unit}"
            self.counts["refused"] += 1
            return False
        if math.isnan(self.reference) or self._tripped:
            self.law.reset()
        self.reference, self.refusal, self._tripped = reference, "", False
        return True

    def note_applied(self, duty: float) -> None:
        """Process the duty [0..1] that the rig reports as applied; call it for each sample that reports one."""
        self._applied = duty if is_possible("duty", duty) else 0.0
        if duty > 0.0:
            self._without_effect = 0
        elif self.duty > LEAST_DUTY:
            self._without_effect += 1

    def on_timeout(self) -> None:
        """Handle the absence of samples for `timeout`: the duty is 0, and the law restarts."""
        self.duty, self._unusable, self._without_effect = 0.0, 0, 0
        self.law.reset()
        self._set_fault("silent", f"no sample for {self.timeout:g} s: duty 0")

    def step(self, stamp_ns: int, sample: Sample) -> float | None:
        """Process a sample.

        Args:
            stamp_ns: [ns] time of sampling.
            sample: the readings; NaN where a reading is missing.

        Returns:
            [0..1] The duty to send; None for a repeated sample.
        """
        if not self._is_new(stamp_ns):
            return None
        self.counts["samples"] += 1
        self.duty = self._duty_for(self._possible(sample))
        return self.duty

    def _possible(self, sample: Sample) -> Sample:
        """A sample with NaN where a reading is no possible number: the law bridges it as a missing one."""
        wrong = [name for name, x in zip(Sample._fields, sample) if not (math.isnan(x) or is_possible(name, x))]
        self.doubt = f"{' and '.join(wrong)} of a sample is no possible number: left out" if wrong else ""
        if not wrong:
            return sample
        self.counts["impossible"] += 1
        return sample._replace(**dict.fromkeys(wrong, math.nan))

    def _is_new(self, stamp_ns: int) -> bool:
        """Whether this sample is new. The law gets `LOST` for each sample lost before it."""
        before, self._stamp = self._stamp, stamp_ns
        if before is None:
            return True
        passed = 1e-9 * (stamp_ns - before)
        if 0.5 * self.period < passed < 1.5 * self.period:
            return True
        if abs(passed) > self.timeout:  # a gap, or the clock was set
            self.counts["lost"] += max(0, round(passed / self.period) - 1)
            self.law.reset(None, self._applied)  # the duty that the rig held in the gap
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
        """Duty for a new sample; 0 and a fault if the law cannot or must not act."""
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
