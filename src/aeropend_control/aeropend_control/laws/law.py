# SPDX-License-Identifier: Apache-2.0
"""The interface of a control law."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from aeropend_sim.model.rig import Sample


class Law(Protocol):
    """A control law: samples in, duties out."""

    def reset(self, sample: Sample | None = None, duty: float = 0.0) -> None:
        """Restart the law. It continues without a bump from a duty that was constant for a long time.

        Args:
            sample: a recent sample, whose angle is the initial angle; None: the angle of the next sample is.
            duty: [0..1] the constant duty.
        """

    def step(self, sample: Sample, reference: float) -> float:
        """Process a sample.

        Args:
            sample: the readings; NaN where a reading is missing.
            reference: [rad, or rad/s for the rotor's speed] finite.

        Returns:
            [0..1] The duty to apply from the next sample on.
        """
        ...

    def retune(self, gains: Mapping[str, float]) -> None:
        """Change some or all gains without a bump.

        Args:
            gains: new values by name.

        Raises:
            GainError: a gain cannot be used; all gains keep their values.
        """
