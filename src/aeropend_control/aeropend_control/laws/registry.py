# SPDX-License-Identifier: Apache-2.0
"""The table of control laws: how each is made, tuned and parametrised, for nodes, commands and tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from aeropend_control.laws import cascade, feedback_linearization, small_signal
from aeropend_control.laws.cascade import Cascade, FeedbackLinearizationCascade
from aeropend_control.laws.feedback_linearization import FeedbackLinearization
from aeropend_control.laws.gains import Gain, GainError
from aeropend_control.laws.law import Law
from aeropend_control.laws.small_signal import SmallSignal
from aeropend_control.laws.tuning import TABLE_6_1, Requirements, TuningError
from aeropend_sim.model.parameters import Model

__all__ = ["LAWS", "TABLE_6_1", "Gain", "GainError", "Law", "LawKind", "Requirements", "TuningError"]


@dataclass(frozen=True)
class LawKind:
    """A kind of law.

    Attributes:
        summary: one line for a person.
        measures: what the reference is of, by the names of `Sample`: `theta` or `omega`.
        reference_unit: its unit. reference_limits: least and greatest that makes sense.
        parameters: its gains by name.
        requirements: what it is tuned for if nobody says.
        presets: complete sets of gains by name; `thesis`: the thesis' own.
    """

    summary: str
    measures: str
    reference_unit: str
    reference_limits: tuple[float, float]
    parameters: Mapping[str, Gain]
    _make: Callable[..., Law]
    _tune: Callable[[Model, Requirements], dict[str, float]]
    presets: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    requirements: Requirements = TABLE_6_1

    def make(self, model: Model, gains: Mapping[str, float] | None = None, **options: Any) -> Law:
        """A law for a model.

        Args:
            model: the model file's.
            gains: by name; those that are not given are the defaults, or what `tune` gives.
            options: `period` (s), and for `small_signal` `schedule`.

        Raises:
            GainError: a gain that cannot be used.
            TuningError: no gains can be found for this model.
        """
        return self._make(model, gains, **options)

    def tune(self, model: Model, requirements: Requirements | None = None) -> dict[str, float]:
        """Every gain, for a model and requirements on the step response, by default its own; met with a reserve.

        Raises:
            TuningError: one line that says which requirement cannot be met.
        """
        defaults = {name: p.default for name, p in self.parameters.items() if p.default is not None}
        return {**defaults, **self._tune(model, requirements or self.requirements)}


ANGLE = ("theta", "rad", (0.0, 1.2))
"""What the laws of the angle control. More than 1.2 rad leaves no thrust to spare on `bench`."""

LAWS: dict[str, LawKind] = {
    "small_signal": LawKind("PID around an operating point, with a schedule", *ANGLE, SmallSignal.parameters,
                            SmallSignal, SmallSignal.tune, {"thesis": small_signal.THESIS_GAINS}),
    "feedback_linearization": LawKind("PID behind feedback linearization", *ANGLE, FeedbackLinearization.parameters,
                                      FeedbackLinearization, FeedbackLinearization.tune,
                                      {"thesis": {**feedback_linearization.THESIS_GAINS, "thrust_time": 0.0}}),
    "cascade": LawKind("speed PI over current PI, for the rotor's speed", "omega", "rad/s", (0.0, 200.0),
                       Cascade.parameters, Cascade, Cascade.tune, {"thesis": cascade.THESIS_GAINS},
                       cascade.REQUIREMENTS),
    "feedback_linearization_cascade": LawKind(
        "PID behind feedback linearization, the thrust held by the cascade", *ANGLE,
        FeedbackLinearizationCascade.parameters, FeedbackLinearizationCascade, FeedbackLinearizationCascade.tune,
        {"thesis": {**feedback_linearization.THESIS_GAINS, **cascade.THESIS_GAINS, "reference_time": 0.0,
                    "thrust_time": 0.0}}),
}
"""Every law by its name, which is also its node's."""
