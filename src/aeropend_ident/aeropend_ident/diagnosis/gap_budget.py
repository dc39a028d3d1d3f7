# SPDX-License-Identifier: Apache-2.0
"""What could be closed of the gap at all: what the effects found close, what repeats, and what does not repeat."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cache

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.values import CHANNELS_OF, STAGES
from aeropend_ident.diagnosis.document import GapBudget
from aeropend_ident.diagnosis.free_run_gap import NOTHING_OPEN, Gap
from aeropend_ident.diagnosis.search import free_curves
from aeropend_ident.diagnosis.search.free_curves import Repeatable
from aeropend_ident.estimation.parallel import parallel

SHOWN = 0.005
"""Share of the squared gap up to which what a channel leaves is not judged (derived: the report has whole per cent)."""


class Repeats:
    """How much of what each stage leaves repeats; each stage is judged when it is first asked for.

    Args:
        chains: cut.
        values: of the augmented model.
    """

    def __init__(self, chains: CutChains, values: Mapping[str, float]) -> None:
        self.of_stage = cache(lambda stage: free_curves.repeatable(chains, stage, values))

    def of_channels(self, channels: Collection[str], jobs: int) -> dict[str, Repeatable]:
        """The same for the stage whose misfit each channel shows first; stages are judged in processes."""
        stages = {c: next(stage for stage in STAGES if c in CHANNELS_OF[stage]) for c in channels}
        each = sorted(set(stages.values()))
        found = dict(zip(each, parallel(jobs, self.of_stage, each), strict=True))
        return {c: found[stage] for c, stage in stages.items()}


def budget(before: Gap, after: Gap, floors: Mapping[str, float], repeats: Repeats, *, gust: bool,
           jobs: int = 1) -> GapBudget | None:
    """The parts of the squared gap above the floor; None where nothing is open.

    Args:
        before: gap of the nominal model.
        after: gap of the augmented model.
        floors: channel -> floor.
        repeats: how much of the rest repeats.
        gust: whether `gust` was detected: the rest of the angle is then random.
        jobs: processes.
    """
    bottom = before.total_floor(floors)
    if before.total <= (1.0 + NOTHING_OPEN) * bottom:
        return None
    amount = {c: max(rms**2 - floors[c] ** 2, 0.0) / after.spread[c] ** 2 / len(after.rms)
              for c, rms in after.rms.items()}
    found, rest = max(before.total**2 - after.total**2, 0.0), sum(amount.values())
    total = found + rest
    shown = [c for c, x in amount.items() if x > SHOWN * total and not (gust and c == "theta")]
    repeatable = 0.0
    places: dict[str, float] = {}
    for channel, one in repeats.of_channels(shown, jobs).items():
        places[one.place] = places.get(one.place, 0.0) + one.share * amount[channel]
        repeatable += one.share * amount[channel]
    return GapBudget(found / total, repeatable / total, (rest - repeatable) / total,
                     max(places, key=lambda p: places[p]) if repeatable > 0.0 else None)
