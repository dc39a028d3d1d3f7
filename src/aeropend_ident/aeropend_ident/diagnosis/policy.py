# SPDX-License-Identifier: Apache-2.0
"""How each kind of rig is diagnosed: the thresholds, the search effort, and what is trusted.

A calibrated rig has a model file whose parameters are within 5 % and whose measurement chain is known. An uncalibrated
rig has neither: its nominal model is identified from the recordings first. If its arm is never driven, only the free
decay of the arm can be diagnosed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from aeropend_ident.signals.signals import Signals

GOOD_ENOUGH = 1.3
"""RMS of a residual, in units of a reading's noise, up to which the model explains a channel (choice).

Noise estimates are good to some ten percent; an excess of 30 % is surely more than that.

Measured: ×0.7 changes 3 of 25 verdicts, ×1.3 none (docs/results/thresholds.md)."""

NOTICEABLE = 1.05
"""Mean square residual, in units of a reading's noise, above which a misfit counts, if it is not chance (choice).

Measured: ×0.7 changes 4 of 24 verdicts, ×1.3 1 (docs/results/thresholds.md)."""


CERTAIN = 15.0
"""Log evidence above which an effect is there, however uncertain its size is and whatever else is there.

Choice: odds of 3·10⁶.

Measured: at ±30 % no verdict of 14 recordings changes (docs/results/thresholds.md)."""

MATERIAL = 0.3
"""RMS, in units of a reading's noise, that an effect must explain in some channel to be reported (choice).

It raises a residual of pure noise by 4 %, which some thousand samples show clearly.

Measured: ×0.7 and ×1.3 each change 1 of 25 verdicts (docs/results/thresholds.md)."""


MATERIAL_SHARE = 0.03
"""Share of the gap from which an effect is claimed, unless a person sets another; a misfit below counts as noise.

Choice: without an effect of this share the gap (RMS) grows by 1.5 %, which changes nothing that a model is used for."""


@dataclass(frozen=True)
class UnknownLimits:
    """When what effects of the catalogue leave counts as an unknown effect.

    Attributes:
        form: share of the misfit that an effect may leave because the true one has another form.
        form_elsewhere: share as `form`, if a missing term at another place explains more.
        form_of_several: share as `form`, if one missing term explains more than effects at several places.
        kept: share of a channel's own misfit that may stay.
        instead: share of the misfit above which effects that leave it may only approximate the unknown one.
        noticeable: mean square residual, in units of a reading's noise, above which a misfit counts.
    """

    form: float
    form_elsewhere: float
    form_of_several: float
    kept: float
    instead: float
    noticeable: float


@dataclass(frozen=True)
class Policy:
    """How one kind of rig is diagnosed.

    Attributes:
        name: of the kind.
        calibrated: the model's parameters are within 5 %, and its measurement chain is known.
        driven: a duty acts at some time. A calibrated rig counts as driven.
        screening_rounds: rounds of the fits after the screening (choice).
        steps: Levenberg-Marquardt steps in a round (choice).
        least_ess: effective sample size that the angle counts for at least during a search (choice).
        budget: simulations after which no further effect is searched (choice); None: unlimited.
        noise_margin: as `MATERIAL`, for a residual that follows neither inputs nor states: the noise may be
            underestimated by as much (choice).
        undecided: probability above which a rival is not ruled out (choice).
        unknown: when the rest counts as an unknown effect.
    """

    name: str
    calibrated: bool
    driven: bool
    screening_rounds: int
    steps: int
    least_ess: float
    budget: int | None
    noise_margin: float
    undecided: float
    unknown: UnknownLimits

    @property
    def wide_search(self) -> bool:
        """Whether the arm is driven and its parameters are only a guess: searches then need good starts."""
        return self.driven and not self.calibrated


CALIBRATED = Policy(
    "calibrated rig", calibrated=True, driven=True, screening_rounds=2, steps=4, least_ess=100.0, budget=None,
    noise_margin=MATERIAL, undecided=0.05, unknown=UnknownLimits(0.12, 0.025, 0.01, 0.25, MATERIAL_SHARE, NOTICEABLE))
"""Limits for an unknown effect (measured: simulated rigs whose effects have another form than the catalogue's).

±30 % of `noticeable` changes up to 4 of 20 verdicts, and one screening round instead of two changes 1 of 18. The other
numbers change none (docs/results/thresholds.md)."""

UNCALIBRATED = Policy(
    "uncalibrated rig", calibrated=False, driven=True, screening_rounds=1, steps=12, least_ess=100.0, budget=1500,
    noise_margin=0.75, undecided=0.01, unknown=UnknownLimits(0.2, 0.08, 0.08, 0.25, 0.2, GOOD_ENOUGH**2))
"""Wider limits (choice): parameters in long valleys need more steps.

The noise is estimated, and may be a seventh too small. ±30 % of one of its numbers changes no verdict of 3 recordings
(docs/results/thresholds.md)."""

FREE_DECAY = Policy(
    "free decay", calibrated=False, driven=False, screening_rounds=2, steps=4, least_ess=0.0, budget=None,
    noise_margin=0.75, undecided=0.01, unknown=UnknownLimits(0.6, 0.6, 0.6, 0.6, 0.6, GOOD_ENOUGH**2))
"""Widest limits (choice): the noise holds unsteady stamps too, and few swings show little of an effect's form.

±30 % of one of its numbers changes no verdict of 2 recordings (docs/results/thresholds.md)."""


def free_swinging(recordings: Sequence[Signals]) -> bool:
    """Whether the arm is never driven in any of the recordings."""
    return all(not s.driven for s in recordings)


def angle_only(recordings: Sequence[Signals]) -> bool:
    """Whether one of the recordings holds only the angle, and perhaps the command."""
    return any(not (s.has("omega") or s.has("i_a") or s.has("v_a")) for s in recordings)


def policy_of(recordings: Sequence[Signals], *, fit_nominal: bool) -> Policy:
    """The policy for recordings of one rig.

    Args:
        recordings: of one rig.
        fit_nominal: whether the rig is uncalibrated.
    """
    if not fit_nominal:
        return CALIBRATED
    return FREE_DECAY if free_swinging(recordings) else UNCALIBRATED
