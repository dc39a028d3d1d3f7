# SPDX-License-Identifier: Apache-2.0
"""The section on the parameters of the model: refitted values, shifts, and what an uncalibrated rig was fitted to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from aeropend_ident.diagnosis.document import DiagnosisDocument, Lift, VariantFound
from aeropend_ident.diagnosis.report.number_format import exact, interval, quantity
from aeropend_sim.model.parameters import parameter

OFF = 0.05
"""Relative shift above which a parameter is marked.

Derived: the tolerance that the priors of calibrated rigs assume."""

NO_DEAD_ZONE = 0.005
"""Duty below which a dead zone is none (choice: half of the change that counts as no excitation)."""


@dataclass(frozen=True)
class ParameterRowText:
    """A row of the table.

    Attributes:
        name: of the parameter.
        unit: "" for none.
        description: what it is.
        nominal: nominal value, as text.
        value: estimate, as text.
        between: its interval, as text.
        shift: of the estimate, relative to the nominal value.
        low: the same of the lower end.
        high: the same of the upper end.
        off: whether the shift is marked.
    """

    name: str
    unit: str
    description: str
    nominal: str
    value: str
    between: str
    shift: float
    low: float
    high: float
    off: bool


@dataclass(frozen=True)
class IdentifiedText:
    """What the nominal model of an uncalibrated rig was identified from.

    Attributes:
        basis: the signals.
        not_determined: parameters that the recordings do not determine.
        spread: what differs between recordings, or "".
        hangs: angle at which the arm hangs, or "".
        lift: lift of the duty, or "".
    """

    basis: str
    not_determined: tuple[str, ...]
    spread: str
    hangs: str
    lift: str


@dataclass(frozen=True)
class VariantText:
    """A variant of the rig.

    Attributes:
        name: of the variant.
        bags: its recordings.
        numbers: in which it differs, each with its value.
    """

    name: str
    bags: list[str]
    numbers: list[tuple[str, str]]


@dataclass(frozen=True)
class Parameters:
    """The content of the section.

    Attributes:
        rows: of the table.
        reach: shift at the edges of the pictures.
        off: [%] shift above which a parameter is marked.
        identified: of an uncalibrated rig.
        variants: of the rig, each with the numbers in which it differs.
    """

    rows: list[ParameterRowText]
    reach: float
    off: str
    identified: IdentifiedText | None
    variants: list[VariantText]

    def at(self, shift: float) -> float:
        """[%] Position of a shift in the picture; in the middle if it is not known."""
        return 50.0 if math.isnan(shift) else 50.0 + 50.0 * min(max(shift / self.reach, -1.0), 1.0)

    @property
    def band(self) -> float:
        """[%] Half of the width of the band in which no shift is marked."""
        return 50.0 * OFF / self.reach


def section(document: DiagnosisDocument) -> Parameters:
    """The content of the section."""
    rows = []
    for name, n in document.which.numbers.items():
        if n.determined is False:
            continue
        p = parameter(name)
        value, between = interval(n.value, n.low, n.high)
        if n.run_to_run and document.identified is None:
            between += f"; run to run {quantity(n.run_to_run, digits=2)}"
        scale = abs(n.nominal) or 1.0
        shift, low, high = ((x - n.nominal) / scale for x in (n.value, n.low, n.high))
        rows.append(ParameterRowText(name, "" if p.unit == "-" else p.unit, p.description, exact(n.nominal), value,
                                     between, shift, low, high, abs(shift) > OFF))
    shifts = [x for r in rows for x in (r.shift, r.low, r.high) if math.isfinite(x)]
    reach = max([2.0 * OFF, *(1.05 * min(abs(x), 1.0) for x in shifts)])
    return Parameters(rows, reach, f"{100.0 * OFF:g}", _identified(document),
                      [_variant(v, document.bags) for v in document.variants or ()])


def _variant(variant: VariantFound, bags: Sequence[str]) -> VariantText:
    numbers = []
    for name, x in variant.numbers.items():
        value, between = interval(x.value, x.low, x.high)
        unit = parameter(name).unit
        numbers.append((name, f"{value}{'' if unit == '-' else f' {unit}'} ({between})"))
    return VariantText(variant.name, [bags[k] for k in variant.recordings], numbers)


def lift_text(lift: Lift, duration: float) -> str:
    """The lift of the duty, in words.

    Args:
        lift: the curve.
        duration: [s] of the recordings; they do not show a longer lag.
    """
    dead = f", none below {quantity(lift.dead_zone, digits=2)}" if lift.dead_zone >= NO_DEAD_ZONE else ""
    lag = f"of {quantity(lift.lag_s, 's', 2)}" if lift.lag_s < duration else "longer than the recording"
    return f"up to {quantity(lift.rad_per_s2[-1], 'rad/s²')} at a duty of {lift.duty[-1]:.2f}{dead}, with a lag {lag}"


def _identified(document: DiagnosisDocument) -> IdentifiedText | None:
    identified = document.identified
    if identified is None:
        return None
    spread = [f"{name} by {quantity(n.run_to_run, parameter(name).unit.replace('-', ''), 2)}"
              for name, n in document.which.numbers.items() if n.run_to_run]
    hangs, lift = identified.hangs_at, identified.lift
    if hangs and hangs.run_to_run:
        spread.append(f"the angle where the arm hangs by {quantity(hangs.run_to_run, 'rad', 2)}")
    curve = lift_text(lift, document.duration_s) if lift else ""
    return IdentifiedText(identified.basis, identified.not_determined, ", ".join(spread),
                          quantity(hangs.value, "rad", 2) if hangs else "", curve)
