# SPDX-License-Identifier: Apache-2.0
"""What a recording would show, before it is made: the smallest size of each effect, pairs, and sensors."""

from __future__ import annotations

from collections.abc import Sequence

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.isolation.judge import Judge
from aeropend_ident.diagnosis.policy import MATERIAL_SHARE
from aeropend_ident.diagnosis.search.hypotheses import hypotheses, other_forms
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.parameters import Model


def judge_of(model: Model, signals: Signals, further: Sequence[str] = (), material: float = MATERIAL_SHARE) -> Judge:
    """The judge of a planned recording.

    Args:
        model: the nominal model.
        signals: the planned recording, of a rig that is like it.
        further: ids of effects of effect files.
        material: share of the gap from which an effect is claimed.
    """
    chains = CutChains(model, [signals])
    chains.further = tuple(further)
    every = hypotheses(model, further)
    return Judge(chains, [*every, *(form for h in every for form in other_forms(h, chains))], material)
