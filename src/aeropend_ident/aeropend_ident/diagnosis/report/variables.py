# SPDX-License-Identifier: Apache-2.0
"""Symbols, names and units of the variables that the report draws."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Variable:
    """A variable as the report shows it.

    Attributes:
        symbol: what follows _ is an index; "" for none.
        name: plain name.
        unit: "" for none.
        article: whether the name has an article in a sentence.
    """

    symbol: str
    name: str
    unit: str
    article: bool = True

    @property
    def phrase(self) -> str:
        """The name inside a sentence."""
        return f"the {self.name}" if self.article else self.name


VARIABLES = {
    "theta": Variable("θ", "arm angle", "rad"),
    "theta_dot": Variable("θ̇", "arm rate", "rad/s"),
    "omega": Variable("ω", "rotor speed", "rad/s"),
    "i_a": Variable("i_a", "armature current", "A"),
    "v_a": Variable("v_a", "armature voltage", "V"),
    "duty": Variable("τ", "duty", ""),
    "v": Variable("", "voltage of the bridge", "V"),
    "z": Variable("z", "memory of the term", ""),
    "omega - z": Variable("", "rotor speed minus the memory of the term", "rad/s"),
    "t": Variable("t", "time", "s", article=False),
    "omega, slowly": Variable("", "rotor speed of the last seconds", "rad/s"),
    "slope of omega": Variable("", "slope of the rotor speed", "rad/s²"),
    "steps": Variable("", "samples after a step of the duty", "", article=False),
}
"""Variable of a document -> how it is shown; the last three occur in free curves only."""
