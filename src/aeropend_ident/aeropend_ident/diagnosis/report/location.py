# SPDX-License-Identifier: Apache-2.0
"""The section on the place: the chain with the share of each place, and the ranges in which the misfit concentrates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeropend_ident.diagnosis.document import CANNOT_TELL, DiagnosisDocument, Region
from aeropend_ident.diagnosis.regions import Misfit
from aeropend_ident.diagnosis.report.binned import AGAINST, Binned, Cell, binned, cell, varies
from aeropend_ident.diagnosis.report.candidates import CandidateRow
from aeropend_ident.diagnosis.report.drawing import WIDTH, position
from aeropend_ident.diagnosis.report.number_format import ends, with_unit
from aeropend_ident.diagnosis.report.variables import VARIABLES, Variable
from aeropend_sim.model.effects import PLACES

OUTPUT_OF = dict(zip(PLACES, ("v_a", "i_a", "ω", "f", "θ", ""), strict=True))
"""Place -> symbol of its output; the last is the reading."""


@dataclass(frozen=True)
class Place:
    """A place of the chain.

    Attributes:
        name: its name.
        share: [0..1] of the gap.
        filled: [%] of the box that shows it.
        output: symbol of what it hands on.
        main: whether it is the place of the verdict.
        found: names of what was found there.
    """

    name: str
    share: float
    filled: float
    output: str
    main: bool
    found: list[str]


@dataclass(frozen=True)
class RegionText:
    """A range in which the misfit concentrates.

    Attributes:
        variable: the variable.
        low: lower end, as text.
        high: upper end with the unit, as text.
        share: [0..1] of the squared misfit.
        time: [0..1] share of the time.
    """

    variable: Variable
    low: str
    high: str
    share: float
    time: float


@dataclass(frozen=True)
class Location:
    """The content of the section.

    Attributes:
        found: whether the verdict is more than "none".
        places: the chain.
        regions: ranges in which the misfit concentrates.
        cells: the misfit of the nominal model against each variable.
    """

    found: bool
    places: list[Place]
    regions: list[RegionText]
    cells: list[Cell]


def section(document: DiagnosisDocument, misfit: Misfit, candidates: Sequence[CandidateRow]) -> Location:
    """The content of the section.

    Args:
        document: of the diagnosis.
        misfit: of the nominal structure where it is largest.
        candidates: all rows.
    """
    where = document.where
    share = {name: where.share.get(name, 0.0) for name in PLACES}
    places = [Place(name, share[name], position(share[name]), OUTPUT_OF[name], name == where.place,
                    [c.name for c in candidates if c.found and c.place == name]) for name in PLACES]
    found = document.which.verdict not in ("none", CANNOT_TELL)
    return Location(found, places, [_text(r) for r in where.regions],
                    _cells(misfit, where.regions) if found or where.regions else [])


def _text(r: Region) -> RegionText:
    variable = VARIABLES[r.variable]
    low, high = ends(r.low, r.high)
    return RegionText(variable, low, with_unit(high, variable.unit), r.share, r.time)


def _cells(misfit: Misfit, regions: Sequence[Region]) -> list[Cell]:
    each = {name: binned(misfit.variables[name], misfit.signal, misfit.signal)
            for name in AGAINST if varies(misfit.variables[name])}
    largest = [x for errors in each.values() if (x := errors.largest()) is not None]
    return [_cell(name, errors, 1.1 * max(largest), regions) for name, errors in each.items()] if largest else []


def _cell(name: str, errors: Binned, reach: float, regions: Sequence[Region]) -> Cell:
    mine = [r for r in regions if r.variable == name and math.isfinite(r.high - r.low)]
    start, width = errors.edges[0], float(errors.edges[-1] - errors.edges[0])
    marked = [np.clip([(x - start) / width for x in (r.low, r.high)], 0.0, 1.0) for r in mine]
    named = "".join(f"; the range from {' to '.join(ends(r.low, r.high))} stands out" for r in mine)
    return replace(cell(name, errors, reach, Variable("", "", "")),
                   label=f"Misfit of the nominal model against {VARIABLES[name].name}{named}",
                   ranges=tuple((WIDTH * a, WIDTH * (b - a)) for a, b in marked))
