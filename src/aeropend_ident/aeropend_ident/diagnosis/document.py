# SPDX-License-Identifier: Apache-2.0
"""The content of `diagnosis.json` as types, with its one writer and its one reader.

    python -m aeropend_ident.diagnosis.document      print the JSON schema

The field `closure` is the key "shrink", `basis` the key "from"; all other keys have the names of the fields.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from aeropend_ident.diagnosis import typed_json
from aeropend_ident.diagnosis.typed_json import JsonError
from aeropend_ident.signals.signals import Mounting
from aeropend_ident.signals.statistics import Z95
from aeropend_sim.errors import UserError

CANNOT_TELL = "cannot_tell"
"""Verdict if the nominal model could not be identified."""

FORMAT = 1
"""Number of the format that this version writes and reads (format)."""


class DocumentError(UserError):
    """A file or an object is no diagnosis document."""


@dataclass(frozen=True)
class Channel:
    """The gap of one channel on held-out data: RMS of simulated minus measured.

    Attributes:
        unit: unit of the channel and of the three values below.
        gap: of the nominal model.
        floor: what the measurement chain alone leaves: noise, resolution, pulse timing.
        gap_after: of the augmented model.
        fit_fitted: 1 - RMS/spread of the augmented model's free run on the part that was fitted.
        fit_unseen: the same on held-out data.
    """

    unit: str
    gap: float
    floor: float
    gap_after: float
    fit_fitted: float
    fit_unseen: float


@dataclass(frozen=True)
class Region:
    """A range of a variable in which the misfit concentrates.

    Attributes:
        variable: name of the variable.
        low: lower end, in the unit of the variable.
        high: upper end, in the unit of the variable.
        share: [0..1] share of the squared misfit.
        time: [0..1] share of the time.
    """

    variable: str
    low: float
    high: float
    share: float
    time: float


@dataclass(frozen=True)
class Where:
    """Where the gap arises.

    Attributes:
        place: place of the verdict, or "none".
        share: [0..1] place -> share of the gap.
        regions: ranges of operation in which the misfit concentrates.
    """

    place: str
    share: Mapping[str, float]
    regions: tuple[Region, ...]


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval.

    Attributes:
        value: the estimate.
        low: lower end of the interval.
        high: upper end of the interval.
    """

    value: float
    low: float
    high: float


def interval(value: float, sd: float, low: float = -math.inf, high: float = math.inf) -> Interval:
    """An estimate with its 95 % interval, which ends where the range of the value does."""
    return Interval(value, max(value - Z95 * sd, low), min(value + Z95 * sd, high))


@dataclass(frozen=True)
class Candidate:
    """A hypothesis that was ranked.

    Attributes:
        effect: id of the effect, or "parameter_mismatch".
        place: where it acts.
        probability: [0..1] its posterior probability among its rivals.
        parameters: name -> estimate of each of its parameters.
        found: whether it is part of the verdict.
        gap_after: [share of the spread] total gap with it; null if it diverges.
        share: [0..1] its share of the gap, which comes back without it; null if it is not in the augmented model.
        since: [s] when it begins, if that is not at the start of the recording.
        until: [s] when it ends, if that is not at the end of the recording.
        evidence: log evidence over no further effect, from the fitted part; null if it was not compared.
        behind: the hypothesis that was found in its place, "parameter_mismatch:NAME" for a parameter; null if none was.
        form: id of the form of the effect that its parameters are of; "" for the effect itself.
        forms: [0..1] form -> probability among the forms of the effect; null if no other form was tried.
        strength: RMS of its term over the fitted part, in the unit of a term at its place, of a dry friction where it
            moves; the interval is over all forms that explain the recording. Null if the term is no formula.
        run_to_run: name -> standard deviation of a parameter between recordings, beyond the uncertainty of the
            estimates; null of a single recording.
    """

    effect: str
    place: str
    probability: float
    parameters: Mapping[str, Interval]
    found: bool
    gap_after: float | None
    share: Interval | None = None
    since: Interval | None = None
    until: Interval | None = None
    evidence: float | None = None
    behind: str | None = None
    form: str = ""
    forms: Mapping[str, float] | None = None
    strength: Interval | None = None
    run_to_run: Mapping[str, float] | None = None

    @property
    def law(self) -> str:
        """Id of what its parameters belong to: the form, or the effect."""
        return self.form or self.effect


@dataclass(frozen=True)
class ParameterRow:
    """A refitted parameter of the model.

    Attributes:
        nominal: value in the nominal model.
        value: the estimate; the mean over the recordings if each has its own.
        low: lower end of the 95 % interval.
        high: upper end of the 95 % interval.
        determined: whether the recordings determine it; uncalibrated rigs only.
        runs: estimate of each recording in its variant, if there are several; of a calibrated rig with each recording
            fitted alone.
        run_to_run: standard deviation between recordings, beyond the uncertainty of the estimates; null of a number
            that differs by an unknown amount in a variant.
    """

    nominal: float
    value: float
    low: float
    high: float
    determined: bool | None = None
    runs: tuple[Interval, ...] | None = None
    run_to_run: float | None = None


@dataclass(frozen=True)
class VariantFound:
    """A variant of the rig, as with a payload.

    Attributes:
        name: of the variant.
        recordings: numbers of its recordings, in the order of `bags`, from 0.
        numbers: name -> value in the variant, of each number in which it differs; of one that is unknown, that of the
            first of these recordings.
    """

    name: str
    recordings: tuple[int, ...]
    numbers: Mapping[str, Interval]


@dataclass(frozen=True)
class Residual:
    """Tests of what the final fit of a channel leaves.

    Attributes:
        rms: RMS in units of a reading's noise.
        white: [0..1] effective sample size over the number of readings; 1 for white noise.
        dependence: [0..1] share of the mean square that free curves over inputs and states explain.
    """

    rms: float
    white: float
    dependence: float


@dataclass(frozen=True)
class Curve:
    """A free curve, linear between its knots.

    Attributes:
        variable: what it is drawn over, and in brackets what multiplies it.
        unit: unit of the values.
        at: positions of the knots, in the unit of the variable.
        value: value at each knot.
    """

    variable: str
    unit: str
    at: tuple[float, ...]
    value: tuple[float, ...]


@dataclass(frozen=True)
class Formula:
    """A formula that may stand in place of a learned term.

    Attributes:
        id: of the effect in `proposed.yaml`.
        term: the formula.
        parameters: estimates by name.
        gap_after: [share of the spread] gap on held-out data with it; null if the model then diverges.
    """

    id: str
    term: str
    parameters: Mapping[str, float]
    gap_after: float | None


@dataclass(frozen=True)
class UnknownEffect:
    """An effect that the catalogue does not hold.

    Attributes:
        place: where it acts.
        curves: the missing term is their sum.
        id: of the effect by formula in the augmented model that was learned in its place; "" if none helps.
        closes: share of the gap that this closes.
        formulas: that may stand in its place, the one that leaves least of the fitted part first, of alike ones the
            shortest.
    """

    place: str
    curves: tuple[Curve, ...]
    id: str = ""
    closes: Interval | None = None
    formulas: tuple[Formula, ...] = ()


Setting = bool | int | float | str | tuple[float, ...]
"""Value of a parameter of the node `excite`."""


@dataclass(frozen=True)
class NextExperiment:
    """The experiment that separates the closest pair of hypotheses.

    Attributes:
        why: the reason, as a sentence.
        excite: parameters of the node `excite`; empty where no signal helps.
    """

    why: str
    excite: Mapping[str, Setting]

    @property
    def command(self) -> str:
        """The command that runs it; "" if there is none."""
        settings = [f"-p {shlex.quote(f'{name}:={_ros_text(value)}')}" for name, value in self.excite.items()]
        return " ".join(["excite --ros-args", *settings]) if settings else ""


def _ros_text(value: Setting) -> str:
    """A value as a ROS parameter on the command line."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"[{', '.join(map(_ros_text, value))}]" if isinstance(value, tuple) else str(value)


@dataclass(frozen=True)
class EffectSet:
    """A set of effects that explains a stage of the chain.

    Attributes:
        stage: of the chain: "actuator", "motor" or "arm".
        effects: ids of the effects; a parameter that is far off as "parameter_mismatch:PARAMETER".
        probability: [0..1] among sets that differ by one effect.
    """

    stage: str
    effects: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class WouldShow:
    """The smallest size of an effect that a recording would show.

    Attributes:
        effect: its id.
        place: of the chain.
        unit: of the size.
        usual: size that matters on a rig like this one, as a distance from the neutral one.
        smallest: smallest distance with which the verdict would not be "none", with a probability of one half; null: it
            would not show up to ten usual sizes.
    """

    effect: str
    place: str
    unit: str
    usual: float
    smallest: float | None


@dataclass(frozen=True)
class Which:
    """Which effect causes the gap.

    Attributes:
        verdict: id of the effect with the largest share, "parameter_mismatch", "none", "unknown" or "cannot_tell".
        effects: ids of all effects claimed, the largest share first.
        small: ids of effects in the augmented model whose share of the gap is too small to be claimed.
        candidates: the ranked hypotheses, the most probable first.
        numbers: name -> refitted parameter of the model.
        residuals: channel -> tests of its residuals.
        unexplained: reasons for the verdict "unknown" or "cannot_tell", as sentences.
        unknown: an effect that the catalogue does not hold; null if there is none.
        not_separable: pairs of hypotheses that the recordings cannot separate.
        next_experiment: what to record next; null if nothing is open.
        sets: sets of effects that are likely, where more than one set of a stage is; the likeliest of a stage first.
        would_show: what would have shown, for the verdict "none" of a calibrated rig.
    """

    verdict: str
    effects: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    numbers: Mapping[str, ParameterRow]
    residuals: Mapping[str, Residual]
    unexplained: tuple[str, ...]
    unknown: UnknownEffect | None
    not_separable: tuple[tuple[str, str], ...]
    next_experiment: NextExperiment | None
    small: tuple[str, ...] = ()
    sets: tuple[EffectSet, ...] = ()
    would_show: tuple[WouldShow, ...] = ()


@dataclass(frozen=True)
class ClosedGap:
    """How far the gap closes. A total gap is the RMS over the channels, each in units of its own spread.

    Attributes:
        gap: [share of the spread] total gap of the nominal model.
        gap_after: [share of the spread] total gap of the augmented model.
        floor: [share of the spread] total gap of a perfect model.
        closed: share of the closable gap that is closed, at most 1; null if there is nothing to close.
        low: lower end of its 95 % interval; null if there is too little data.
        high: upper end of its 95 % interval; null if there is too little data.
    """

    gap: float
    gap_after: float
    floor: float
    closed: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class _OfBag:
    """A base class whose field comes before those of the other bases."""

    bag: str


@dataclass(frozen=True)
class Across(ClosedGap, _OfBag):
    """How far the gap closes on a recording that nothing was fitted to.

    Attributes:
        bag: the recording.
        gap: [share of the spread] total gap of the nominal model.
        gap_after: [share of the spread] total gap of the augmented model.
        floor: [share of the spread] total gap of a perfect model.
        closed: share of the closable gap that is closed, at most 1; null if there is nothing to close.
        low: lower end of its 95 % interval; null if there is too little data.
        high: upper end of its 95 % interval; null if there is too little data.
    """


@dataclass(frozen=True)
class GapBudget:
    """What could be closed of the squared gap above the floor; the three shares sum to 1.

    Attributes:
        found: share that the effects found and the refitted parameters close.
        repeatable: share that a function of duty and state would close beyond that, by cross-validation over time.
        not_repeatable: share that no such function predicts: random, or different each time.
        place: whose function closes most of the repeatable share; null if there is none.
    """

    found: float
    repeatable: float
    not_repeatable: float
    place: str | None


@dataclass(frozen=True)
class Closure(ClosedGap):
    """How far the gap closes on held-out data. A total gap is the RMS over the channels, each in units of its spread.

    Attributes:
        gap: [share of the spread] total gap of the nominal model.
        gap_after: [share of the spread] total gap of the augmented model.
        floor: [share of the spread] total gap of a perfect model.
        closed: share of the closable gap that is closed, at most 1; null if there is nothing to close.
        low: lower end of its 95 % interval; null if there is too little data.
        high: upper end of its 95 % interval; null if there is too little data.
        across: the same on further recordings, if there are any.
        budget: what could be closed at all; null if there is nothing to close.
    """

    across: tuple[Across, ...] = ()
    budget: GapBudget | None = None


@dataclass(frozen=True)
class Lift:
    """The static lift of a duty and its lag: all that duty and angle show of bridge, motor and propeller.

    Attributes:
        duty: (K,) [0..1] duties up to the largest of the recordings.
        rad_per_s2: (K,) [rad/s^2] lift over the inertia of the arm.
        dead_zone: [0..1] duty below which there is no lift.
        lag_s: [s] time constant of the rotor at half of the largest duty.
    """

    duty: tuple[float, ...]
    rad_per_s2: tuple[float, ...]
    dead_zone: float
    lag_s: float


@dataclass(frozen=True)
class HangingAngle:
    """The angle that is read where the arm hangs.

    Attributes:
        value: [rad] the estimate; the mean over the recordings if each has its own.
        low: [rad] lower end of the 95 % interval.
        high: [rad] upper end of the 95 % interval.
        runs: [rad] estimate of each recording, if each has its own.
        run_to_run: [rad] standard deviation between recordings, beyond the uncertainty of the estimates.
    """

    value: float
    low: float
    high: float
    runs: tuple[Interval, ...] | None = None
    run_to_run: float | None = None


@dataclass(frozen=True)
class Identified:
    """What the nominal model of an uncalibrated rig was identified from.

    Attributes:
        basis: the signals, in words.
        not_determined: parameters that the recordings do not determine.
        lift: only where duty and angle are all that was measured.
        hangs_at: only where it was fitted.
        mounting: of the angle's sensor, only where its zero or its sign was found from the motion.
        own: effects that the nominal model holds since the log evidence is larger with them: name -> size.
    """

    basis: str = field(metadata={"key": "from"})
    not_determined: tuple[str, ...]
    lift: Lift | None = None
    hangs_at: HangingAngle | None = None
    mounting: Mounting | None = None
    own: Mapping[str, Interval] = field(default_factory=dict)


@dataclass(frozen=True)
class Estimates:
    """Estimates of the augmented model, for a later comparison (`diagnose --since`).

    Attributes:
        names: (P,) parameters of the model, of the measurement chain and of effects.
        values: (P,) estimates, SI units.
        covariance: (P, P) of the estimates.
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Change:
    """A parameter, of the model or of an effect, that has changed since earlier verdicts.

    Attributes:
        name: of the parameter; `effect.parameter` if it is that of an effect.
        unit: of the values.
        before: estimate of the earlier verdicts; null if the effect was not there.
        after: estimate.
        change: after minus before.
        claimed: whether it makes a material share of the gap.
    """

    name: str
    unit: str
    before: Interval | None
    after: Interval
    change: Interval
    claimed: bool


@dataclass(frozen=True)
class Since:
    """What has changed since earlier verdicts.

    Attributes:
        verdicts: the earlier verdicts.
        changes: what has changed.
        unchanged: name -> change, over the value before, of a parameter that the recording shows to be as before.
        not_shown: parameters of which this recording does not show whether they have changed.
        perhaps_before: changes that nothing but an effect explains that was there before, and not seen: the effect, and
            the parameters that then took its place. None of them is claimed.
    """

    verdicts: tuple[str, ...]
    changes: tuple[Change, ...]
    unchanged: Mapping[str, Interval]
    not_shown: tuple[str, ...]
    perhaps_before: tuple[str, ...] = ()

    @property
    def named(self) -> str:
        """The earlier verdicts in words."""
        return " and ".join(self.verdicts)

    @property
    def claimed(self) -> list[str]:
        """The parameters that are claimed to have changed."""
        return [c.name for c in self.changes if c.claimed]

    @property
    def by_weight(self) -> list[Change]:
        """The changes, what is claimed first."""
        return sorted(self.changes, key=lambda c: not c.claimed)


@dataclass(frozen=True, kw_only=True)
class Conclusions:
    """What a diagnosis shows.

    Attributes:
        channels: channel -> its gap.
        where: where the gap arises.
        which: which effect causes it.
        closure: how far it closes.
        identified: uncalibrated rigs only.
        since: only where earlier verdicts were given.
        estimates: of the augmented model; left out if no verdict could be found.
        variants: of the rig, if some were given.
    """

    channels: Mapping[str, Channel]
    where: Where
    which: Which
    closure: Closure = field(metadata={"key": "shrink"})
    identified: Identified | None = None
    since: Since | None = None
    estimates: Estimates | None = None
    variants: tuple[VariantFound, ...] | None = None


@dataclass(frozen=True, kw_only=True)
class DiagnosisDocument:
    """The content of `diagnosis.json`.

    Attributes:
        format: number of this format.
        bags: the recordings.
        model: the nominal model: a preset or a file.
        duration_s: [s] length of all recordings.
        samples: number of samples of all recordings.
        train_s: [s] begin and end of the part that was fitted to.
        held_out_s: [s] begin and end of the part that gaps are measured on.
        channels: channel -> its gap.
        where: where the gap arises.
        which: which effect causes it.
        closure: how far it closes.
        identified: uncalibrated rigs only.
        since: what has changed, only where earlier verdicts were given.
        estimates: of the augmented model; left out if no verdict could be found.
        variants: of the rig, if some were given.
        notes: what is unusual in the data, as sentences.
        seconds: [s] time taken.
    """

    format: int
    bags: tuple[str, ...]
    model: str
    duration_s: float
    samples: int
    train_s: tuple[float, float]
    held_out_s: tuple[float, float]
    channels: Mapping[str, Channel]
    where: Where
    which: Which
    closure: Closure = field(metadata={"key": "shrink"})
    identified: Identified | None = None
    since: Since | None = None
    estimates: Estimates | None = None
    variants: tuple[VariantFound, ...] | None = None
    notes: tuple[str, ...]
    seconds: float


def to_json(document: DiagnosisDocument) -> dict[str, object]:
    """The document as dicts, lists and scalars, in the order of the file."""
    body: dict[str, object] = typed_json.to_json(document)
    return body


def from_json(data: object) -> DiagnosisDocument:
    """Read a document from what `json.loads` returns.

    Raises:
        DocumentError: it is no document, or one of another format.
    """
    number = data.get("format") if isinstance(data, Mapping) else None
    if not isinstance(number, int):
        raise DocumentError("no diagnosis document: it has no format number; give a diagnosis.json of 'diagnose'")
    if number != FORMAT:
        advice = "update aeropend_ident" if number > FORMAT else "diagnose the recording again"
        raise DocumentError(f"diagnosis document of format {number}, this version reads format {FORMAT}: {advice}")
    try:
        return typed_json.from_json(DiagnosisDocument, data)
    except JsonError as error:
        raise DocumentError(f"no valid diagnosis document: {error}; diagnose the recording again") from None


def read(path: Path) -> DiagnosisDocument:
    """Read a `diagnosis.json`.

    Raises:
        DocumentError: it cannot be read, or is no document.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DocumentError(f"{path}: cannot be read: {error.strerror}; name a diagnosis.json") from None
    except (ValueError, RecursionError):
        raise DocumentError(f"{path}: is no JSON; give a diagnosis.json of 'diagnose'") from None
    try:
        return from_json(data)
    except DocumentError as error:
        raise DocumentError(f"{path}: {error}") from None


def schema() -> dict[str, object]:
    """The JSON schema of `diagnosis.json`."""
    return typed_json.schema(DiagnosisDocument)


if __name__ == "__main__":
    print(json.dumps(schema(), indent=1, ensure_ascii=False))
