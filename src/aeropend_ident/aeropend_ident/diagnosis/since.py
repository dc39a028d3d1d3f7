# SPDX-License-Identifier: Apache-2.0
"""What has changed since earlier verdicts of a rig, whose model and covariance are the nominal ones."""

from __future__ import annotations

import math
from collections.abc import Collection, Container, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from aeropend_ident.diagnosis import document
from aeropend_ident.diagnosis.chain.known import Known, is_parameter, pooled
from aeropend_ident.diagnosis.chain.values import limits, neutral, with_values
from aeropend_ident.diagnosis.document import Change, DiagnosisDocument, DocumentError, Estimates, Since, interval
from aeropend_ident.diagnosis.joint_fit import SURE, WIDER, JointFit
from aeropend_ident.diagnosis.measured import Statistical
from aeropend_ident.estimation.map_fit import covariance_of
from aeropend_ident.estimation.parameter import key
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.parameters import Model, load
from aeropend_sim.untrusted import one_line

Array = NDArray[np.float64]

FREE_SD = 0.5
"""Relative standard deviation of a parameter that an earlier verdict says nothing of (choice: nearly free)."""

ALIKE = 3.0
"""Greatest ratio, either way, of a change to that which an effect that was not seen explains (choice: another motion
shows the effect more, or less, but in the same direction)."""

SHOWN = 0.25
"""Standard deviation of a change, over the value, above which a recording does not show whether it changed (choice)."""


def read(folders: Sequence[Path]) -> tuple[Model, Known, list[DiagnosisDocument]]:
    """The model of earlier verdicts of one rig.

    Args:
        folders: with the results of `diagnose`, one of each verdict; the last gives what is not estimated.

    Returns:
        The model with the mean estimates, what is known of it, and the documents.

    Raises:
        DocumentError, ModelError: a verdict cannot be used; one line says why.
    """
    documents = [document.read(folder / "diagnosis.json") for folder in folders]
    models = [load(folder / "augmented.yaml") for folder in folders]
    known = pooled([_known(d, folder) for d, folder in zip(documents, folders, strict=True)])
    model = models[-1]
    for other in models[:-1]:
        missing = {e: p for e, p in other.effects.items() if e not in model.effects}
        model = model.with_effects({**model.effects, **missing})
    found = with_values(model, dict(zip(known.names, known.values.tolist(), strict=True)))
    return Model(f"{known.verdicts[-1]}, augmented", found.model, found.sensing, found.effects), known, documents


def _known(verdict: DiagnosisDocument, folder: Path) -> Known:
    """The estimates of a verdict; the file may come from anywhere."""
    e, path = verdict.estimates, folder / "diagnosis.json"
    if e is None:
        raise DocumentError(f"{path}: holds no estimates to compare with: the report says why the model could not be "
                            "identified (or an older version wrote it: diagnose the recording again)")
    odd = [name for name in e.names if not is_parameter(name)]
    if odd:
        raise DocumentError(f"{path}: estimates: '{one_line(odd[0])}' is no parameter of model or effect; diagnose the "
                            "recording again")
    values = np.array(e.values)
    square = all(len(row) == len(e.names) for row in e.covariance) and len(e.covariance) == len(e.names) == len(values)
    covariance = np.array(e.covariance if square else [[np.nan]])
    if not (square and len(set(e.names)) == len(e.names) and np.isfinite(values).all() and np.isfinite(covariance).all()
            and np.allclose(covariance, covariance.T) and (np.diag(covariance) >= 0.0).all()):
        raise DocumentError(f"{path}: estimates: names, values and covariance do not belong together; diagnose the "
                            "recording again")
    return Known(e.names, values, covariance, (folder.name,))


def estimates(joint: JointFit, statistical: Statistical) -> Estimates:
    """The estimates of a diagnosis with their covariance.

    Those that each recording has of its own count as their mean.

    Args:
        joint: the joint fit.
        statistical: effects that were detected by their statistics.
    """
    names = [n for n in joint.values_of_rig if not key(n).is_initial]
    of_fit = list(joint.fit.values)
    at = [of_fit.index(n) for n in names]
    covariance = covariance_of(joint.fit.information(joint.fit.ess))[np.ix_(at, at)]
    scale = np.array([joint.sd[n] for n in names]) / np.sqrt(np.diag(covariance))
    covariance *= np.outer(scale, scale)
    plain = list(dict.fromkeys(key(n).plain for n in names))
    mean = np.array([[float(key(n).plain == p) for n in names] for p in plain])
    mean /= mean.sum(axis=1, keepdims=True)
    values = np.array([joint.values[n] for n in names])
    spread = mean @ covariance @ mean.T
    for j, weights in enumerate(mean):
        runs = values[weights > 0.0]
        if len(runs) > 1:  # a further recording differs from the mean by the scatter between recordings
            spread[j, j] += max(float(np.var(runs, ddof=1)) - spread[j, j], 0.0)
    random = {n: (v, s.fit.sd[n]) for s in statistical.found for n, v in s.fit.values.items()}
    spread = block_diag(spread, np.diag([sd**2 for _, sd in random.values()]))
    spread = 0.5 * (spread + spread.T)  # the inverse of an ill-conditioned matrix is symmetric only to a few digits
    return Estimates((*plain, *random), (*(mean @ values).tolist(), *(v for v, _ in random.values())),
                     tuple(tuple(row) for row in spread.tolist()))


def changes(known: Known, joint: JointFit, statistical: Statistical, claimed: Container[str]) -> Since:
    """What has changed, and what has not.

    Args:
        known: what the earlier verdicts know.
        joint: the joint fit.
        statistical: effects that were detected by their statistics.
        claimed: names of the hypotheses that are part of the verdict.
    """
    model = joint.chains.model
    compared = _Compared.of(joint, known)
    found = {p.name: h.name in claimed for f in joint.findings.values() for h in f.effects for p in h.own}
    changed = []
    for name, material in found.items():
        before, after = neutral(model, name), joint.values[name]
        new = key(name).owner in DEFINED and key(name).owner not in model.effects
        _, sd = compared.change(name, found)
        sd = math.hypot(sd, _from_form(joint, name))
        changed.append(Change(name, limits(name).unit, None if new else interval(before, known.sd(name)),
                              interval(after, joint.sd[name]), interval(after - before, sd), material))
    for s in statistical.found:
        size = f"{s.hypothesis.effect}.{DEFINED[s.hypothesis.effect].size}"
        before, after, sd = neutral(model, size), s.fit.values[size], float(np.hypot(known.sd(size), s.fit.sd[size]))
        if s.hypothesis.effect not in model.effects or abs(after - before) > SURE * sd:
            was = interval(before, known.sd(size)) if s.hypothesis.effect in model.effects else None
            changed.append(Change(size, limits(size).unit, was, interval(after, s.fit.sd[size]),
                                  interval(after - before, sd), s.hypothesis.name in claimed))
    same, open_ = {}, []
    for name in known.names:
        if name in compared.names and name not in found:
            before = abs(neutral(model, name))
            off, sd = compared.change(name, [*found, name])
            if sd > SHOWN * before or before == 0.0:
                open_.append(name)
            else:
                same[name] = interval(off / before, sd / before)
    hidden = _perhaps_before(joint, changed)
    changed = [replace(c, claimed=False) if c.name in hidden else c for c in changed]
    return Since(known.verdicts, tuple(changed), same, tuple(open_), tuple(hidden))


def _perhaps_before(joint: JointFit, changed: Sequence[Change]) -> list[str]:
    """Changes that an effect explains which was there before, and not seen.

    Such an effect has appeared, and parameters have changed as they do in a fit without it: they took its place.
    """
    appeared = [h for f in joint.findings.values() for h in f.effects if h.own[0].name in {
        c.name for c in changed if c.before is None and c.claimed}]
    if not appeared:
        return []
    without = joint.expected_without(appeared)
    stand_ins = [c.name for c in changed if c.before is not None and
                 1.0 / ALIKE <= (without[c.name] - c.after.value) / (c.before.value - c.after.value) <= ALIKE]
    return [*(p.name for h in appeared for p in h.own), *stand_ins] if stand_ins else []


def _from_form(joint: JointFit, name: str) -> float:
    """The part of a standard deviation that comes from the form of an effect, and from how recordings differ."""
    return math.sqrt(max(joint.sd[name] ** 2 - (WIDER * joint.fit.sd[name]) ** 2, 0.0))


@dataclass(frozen=True)
class _Compared:
    """The joint fit beside the earlier verdicts, made linear at its end, in standard units.

    Attributes:
        known: what the earlier verdicts know.
        names: (P,) parameters of the fit.
        unit: (P,) the standard unit of each.
        wide: (P,) standard deviation, in standard units, of a parameter that may have changed.
        data: (P, P) what the data alone say of them: information matrix.
        pull: (P,) gradient of the prior: what the data pull against.
        deviation: (Q,) standard deviations of what is known.
        before: (Q, Q) what the earlier verdicts say, in units of these: information matrix.
    """

    known: Known
    names: list[str]
    unit: Array
    wide: Array
    data: Array
    pull: Array
    deviation: Array
    before: Array

    @classmethod
    def of(cls, joint: JointFit, known: Known) -> _Compared:
        """From a joint fit."""
        names, parameters = list(joint.fit.values), joint.parameters
        z = np.array([parameters[n].to_standard(joint.values[n]) for n in names])
        unit = np.array([abs(parameters[n].slope(x)) for n, x in zip(names, z, strict=True)])
        values = np.abs([joint.values[n] for n in names])
        deviation = np.array([max(known.sd(n), 1e-300) for n in known.names])
        correlation = known.covariance / np.outer(deviation, deviation)
        before = np.asarray(np.linalg.pinv(correlation, hermitian=True), dtype=np.float64)
        return cls(known, names, unit, np.maximum(FREE_SD * values / unit, 1.0),
                   joint.fit.information(joint.fit.ess) - joint.fit.prior, joint.fit.prior @ z, deviation, before)

    def change(self, name: str, free: Collection[str]) -> tuple[float, float]:
        """Change of a parameter and its standard deviation if some parameters, and no others, have changed.

        Value before and value after are two variables of a parameter that may have changed. All others are one each,
        and correlate with the values before: so a change may be sharp of which only products with others are known.

        Args:
            name: of the parameter.
            free: those that may have changed, this one among them.
        """
        before, count = list(self.known.names), len(self.known.names)
        after = [n for n in self.names if n not in before or n in free]
        at = np.array([count + after.index(n) if n in after else before.index(n) for n in self.names])
        own = [self.names.index(n) for n in after]
        unit = np.r_[self.deviation, self.unit[own]]
        scale = unit[at] / self.unit
        information = np.zeros((len(unit), len(unit)))
        information[:count, :count] = self.before
        information[np.ix_(at, at)] += self.data * np.outer(scale, scale)
        spread = np.where([n in before for n in after], self.wide[own], 1.0)
        information[range(count, len(unit)), range(count, len(unit))] += spread**-2.0
        difference = np.zeros(len(unit))
        difference[count + after.index(name)] = unit[count + after.index(name)]
        pull = 0.0
        if name in before:
            j = before.index(name)
            difference[j] = -unit[j]
            pull = float(self.pull[self.names.index(name)] / self.unit[self.names.index(name)])
        variance = float(difference @ np.linalg.solve(information, difference))
        return pull * variance, WIDER * math.sqrt(max(variance, 0.0))
