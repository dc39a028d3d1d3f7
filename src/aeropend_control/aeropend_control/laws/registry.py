# SPDX-License-Identifier: Apache-2.0
"""The table of control laws, `LAWS`: constructor, tuning and gains of each, for nodes, commands and tests."""

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
        summary: one line for the user.
        measures: the controlled variable, a field of `Sample`: `theta` or `omega`.
        reference_unit: unit of the reference.
        reference_limits: least and greatest reference.
        parameters: the gains by name.
        presets: complete sets of gains by name; `thesis`: those of the thesis.
        requirements: default of the requirements for tuning.
        uses: names of the requirements on which the tuned gains depend.
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
    uses: tuple[str, ...] = Requirements._fields

    def make(self, model: Model, gains: Mapping[str, float] | None = None, **options: Any) -> Law:
        """Make a law for a model.

        Args:
            model: the model of the rig.
            gains: by name; missing ones are the defaults or come from `tune`.
            options: `period` [s], and for `small_signal` also `schedule`.

        Raises:
            GainError: a gain cannot be used.
            TuningError: there are no gains for this model.
        """
        return self._make(model, gains, **options)

    def tune(self, model: Model, requirements: Requirements | None = None) -> dict[str, float]:
        """All gains, for a model and requirements on the step response, which are met with a reserve.

        Args:
            model: the model of the rig.
            requirements: on the step response; None: the law's own.

        Raises:
            TuningError: a requirement cannot be met; one line that names it.
        """
        defaults = {name: p.default for name, p in self.parameters.items() if p.default is not None}
        return {**defaults, **self._tune(model, requirements or self.requirements)}


ANGLE = ("theta", "rad", (0.0, 1.2))
"""Controlled variable, unit and limits [rad] of the laws of the angle. Above 1.2 rad the model `bench` has no thrust
reserve."""

LAWS: dict[str, LawKind] = {
    "small_signal": LawKind("PID around an operating point, with gain scheduling", *ANGLE, SmallSignal.parameters,
                            SmallSignal, SmallSignal.tune, {"thesis": small_signal.THESIS_GAINS}),
    "feedback_linearization": LawKind("PID with feedback linearization", *ANGLE, FeedbackLinearization.parameters,
                                      FeedbackLinearization, FeedbackLinearization.tune,
                                      {"thesis": {**feedback_linearization.THESIS_GAINS, "thrust_time": 0.0}}),
    "cascade": LawKind("speed PI and current PI in cascade, for the rotor's speed", "omega", "rad/s", (0.0, 200.0),
                       Cascade.parameters, Cascade, Cascade.tune, {"thesis": cascade.THESIS_GAINS},
                       cascade.REQUIREMENTS, ("t_r", "t_s")),
    "feedback_linearization_cascade": LawKind(
        "PID with feedback linearization, its thrust controlled by the cascade", *ANGLE,
        FeedbackLinearizationCascade.parameters, FeedbackLinearizationCascade, FeedbackLinearizationCascade.tune,
        {"thesis": {**feedback_linearization.THESIS_GAINS, **cascade.THESIS_GAINS, "reference_time": 0.0,
                    "thrust_time": 0.0}}, uses=("t_r", "t_p", "t_s")),
}
"""All laws by name, which is also the name of the node."""
