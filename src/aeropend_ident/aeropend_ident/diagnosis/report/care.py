# SPDX-License-Identifier: Apache-2.0
"""Reasons to take a verdict with care."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.document import DiagnosisDocument
from aeropend_ident.diagnosis.report import gap
from aeropend_ident.diagnosis.report.candidates import CandidateRow
from aeropend_ident.diagnosis.report.number_format import percent, quantity
from aeropend_ident.diagnosis.report.parameters import OFF, ParameterRowText
from aeropend_ident.diagnosis.report.sentence import CLOSED
from aeropend_ident.diagnosis.report.variables import VARIABLES
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.effects import RANDOM

Array = NDArray[np.float64]

NOT_SEPARATED = ({"electrical", "rotor"}, {"thrust", "arm", "sensing"})
"""Places between which no signal is measured."""

SHORT = 30.0
"""[s] Fitted data below which a recording is called short (choice)."""

CALM = {"duty": 0.25, "theta": 0.2}
"""[1, rad] Range of a signal below which most effects hardly show (choice)."""

SURE = 0.95
"""Probability below which an effect is listed as less than sure (convention: 95 %)."""


def reasons(document: DiagnosisDocument, recordings: Sequence[Signals], candidates: Sequence[CandidateRow],
            parameters: Sequence[ParameterRowText]) -> list[str]:
    """One sentence for each reason.

    Args:
        document: of the diagnosis.
        recordings: what was diagnosed.
        candidates: all rows.
        parameters: rows of the table of parameters.
    """
    found = [c for c in candidates if c.found]
    return [*_data(document, recordings), *_effects(document, found), *_shifts(document, found, parameters)]


def _data(document: DiagnosisDocument, recordings: Sequence[Signals]) -> Iterator[str]:
    """Reasons in the data."""
    missing = gap.missing(document)
    if missing:
        yield f"Not measured: {', '.join(missing)}. Effects that show only there cannot be found."
    notes = sum(not n.startswith("not measured") for s in recordings for n in s.notes)
    if notes:
        yield f"{notes} {'note describes' if notes == 1 else 'notes describe'} unusual data: see the end of the page."
    fitted = sum(s.train * s.period for s in recordings)
    if round(fitted) < SHORT:  # as the sentence rounds it
        yield (f"Only {quantity(fitted, 's', 2)} of data were fitted; {quantity(SHORT, 's', 2)} or more give a surer "
               "verdict.")
    driven = any(s.driven for s in recordings)
    for name, least in CALM.items():
        spread = max(_range(s.channel(name)) for s in recordings)
        if spread < least and (driven or name != "duty"):
            v = VARIABLES[name]
            range_ = f"varied by only {quantity(spread, v.unit, 2)}" if spread > 0.0 else "stayed the same"
            yield f"The {v.name} {range_}: most effects hardly show in this range."


def _effects(document: DiagnosisDocument, found: Sequence[CandidateRow]) -> Iterator[str]:
    """Reasons in the effects found."""
    closed = document.closure.closed
    if found and closed is not None and closed < CLOSED and not RANDOM & {c.effect for c in found}:
        yield (f"Only {percent(closed)} of the gap closes: a further effect acts, or the effect has another form than "
               "in the catalogue.")
    unsure = [c.name for c in found if c.probability < SURE]
    if unsure:
        yield f"Probability below 95 %: {', '.join(unsure)}."
    for places in NOT_SEPARATED:
        together = [c.name for c in found if c.place in places]
        if len(together) > 1:
            yield f"No signal is measured between these: {', '.join(together)}. Part of one can pass for another."


def _shifts(document: DiagnosisDocument, found: Sequence[CandidateRow], parameters: Sequence[ParameterRowText]
            ) -> Iterator[str]:
    """Parameters that are surely off and not part of the verdict."""
    claimed = {e.name for c in found for e in c.estimates}
    moved = [p.name for p in parameters if p.name not in claimed and (p.low > OFF or p.high < -OFF)]
    if moved and document.identified is None:
        advice = "Check them in the model file."
        if document.which.unknown:
            advice = "Part of the unknown effect may appear as their shift."
        yield (f"These parameters are off by more than {100.0 * OFF:g} % but not part of the verdict: "
               f"{', '.join(moved)}. {advice}")


def _range(x: Array) -> float:
    return float(np.nanmax(x) - np.nanmin(x))
