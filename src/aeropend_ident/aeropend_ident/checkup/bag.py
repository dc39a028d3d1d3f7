# SPDX-License-Identifier: Apache-2.0
"""The check-up of a recording: whether it can be read, what it holds, and whether a diagnosis can use it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence

import numpy as np

from aeropend_ident.bags import recording
from aeropend_ident.bags.mending import mend, named
from aeropend_ident.bags.recording import Recording, RecordingError
from aeropend_ident.checkup.check import Check, error, ok, warning
from aeropend_ident.identification import dataset
from aeropend_ident.identification.excitation_quality import planned, quality
from aeropend_ident.signals import mistakes
from aeropend_ident.signals.from_bag import as_signals, check_stamps, likely_mistakes, no_angle
from aeropend_ident.signals.mistakes import Mistake
from aeropend_ident.signals.signals import MINIMUM_DURATION, STILL
from aeropend_ident.signals.smoothing import lag
from aeropend_sim.cli.command import called
from aeropend_sim.model.parameters import Model
from aeropend_sim.untrusted import printable
from aeropend_sim.wording import counted

FEW_LOST = 0.01
"""Share of lost samples up to which nothing is said but their number (choice)."""

SMALL = 0.02
"""[rad] Range of the angle below which it shows nothing, or has another unit (choice)."""

OFF_ZERO = 0.1
"""[rad] Angle at rest without duty from which the zero is called wrong (choice)."""

AT_REST = 1.0
"""[s] Time at the beginning without duty in which the arm shows its zero (choice)."""

LAG = 0.3
"""[s] Lag of the arm behind the duty (choice: that of propeller and arm of a small rig)."""

FOLLOWS = 0.5
"""Correlation of the angle with the lagged duty from which the arm surely follows it.

Choice: 10 simulated and 13 real rigs have 0.7 to 0.99."""

SHORT = 30.0
"""[s] Length below which a recording is called short (choice)."""

PAUSE = 1.0
"""[s] Length of a gap from which on it is a pause and no loss (choice)."""

BAD = ("left out", "mended copy", recording.NO_DUTY, recording.NO_JOINTS, recording.NO_POSITION, recording.OFF)
"""What a note says of data that is not used, or that may be wrong."""


def checks(path: str, model: Model, namespace: str | None = None) -> Iterator[Check]:
    """All findings.

    Args:
        path: the recording.
        model: the nominal model, whose measurement chain counts.
        namespace: of the rig, if the bag holds several.
    """
    try:
        read = recording.read(path, namespace)
    except RecordingError as refused:
        yield error(path, str(refused).removeprefix(f"{path}: "))
        return
    rate = f", {1.0 / read.period:.4g} samples/s" if read.period > 0.0 else ""
    yield ok(path, f"{counted(len(read), 'sample')}, {read.duration:.1f} s{rate}, "
             f"with {', '.join(read.channels) or 'no channel'}")
    for note in read.notes:
        yield (warning if any(words in note for words in BAD) else ok)(path, note)
    if not read.complete:
        command = printable(f"{called('recover', 'aeropend_ident')} {shlex.quote(path)}")
        yield warning(path, f"it was broken off or damaged: `{command}` writes what can be read to a new recording and "
                      "says where")
    try:
        check_stamps(read)
    except RecordingError as refused:  # without times nothing else can be judged
        yield error(path, str(refused).removeprefix(f"{path}: "))
        return
    likely = likely_mistakes(read, model) if read.duration >= MINIMUM_DURATION else []
    if likely:
        yield warning(path, named(mistakes.said(likely), path))
    yield from contents(path, read, likely)
    if sure := [one for one in likely if one.sure]:
        if any(one.options for one in sure):
            yield error(path, "diagnose refuses it until this is mended; diagnose --uncalibrated needs no model")
        else:
            yield error(path, f"diagnose refuses it: {mistakes.said(sure)}")
    elif np.isfinite(read.theta).any():
        yield from _use(path, read, model)


def contents(path: str, read: Recording, likely: Sequence[Mistake] = ()) -> Iterator[Check]:
    """What is wrong with the samples, the duty and the angle of a recording.

    Args:
        path: of the recording.
        read: the recording.
        likely: mistakes that the model shows; the angle is then judged no further.
    """
    yield from _samples(path, read)
    yield from _duty(path, read)
    if not likely or not np.isfinite(read.theta).any():
        yield from _angle(path, read)


def _samples(path: str, read: Recording) -> Iterator[Check]:
    """Length and lost samples."""
    if read.duration < SHORT - 0.5:  # as the number that is printed is rounded
        yield warning(path, f"only {read.duration:.0f} s long: record {SHORT:.0f} s or more")
    pauses = read.gaps[:, 1] * read.period > PAUSE
    lost = read.lost - int(read.gaps[pauses, 1].sum())
    if pauses.any():
        row, missing = read.gaps[pauses][0]
        often = "once" if pauses.sum() == 1 else f"{int(pauses.sum())} times"
        yield warning(path, f"the recording pauses {often}, first at {read.t[row]:.1f} s for "
                      f"{missing * read.period:.3g} s: if the rig ran on, look for a program or a clock that stood "
                      "still")
    share = lost / max(lost + len(read), 1)
    if share > FEW_LOST:
        yield warning(path, f"{100.0 * share:.1f} % of the samples are lost: record with less load, or by cable")
    elif lost:
        yield ok(path, f"{counted(lost, 'sample')} lost")


def _duty(path: str, read: Recording) -> Iterator[Check]:
    """The duty: there, moving."""
    known = read.duty[np.isfinite(read.duty)]
    if not len(known) and np.isfinite(read.v_a).any():
        yield ok(path, "no duty: the voltage takes its place (diagnose --uncalibrated, or a model with v_full)")
        return
    if not len(known):
        yield warning(path, "no duty: only a free decay of the arm can be diagnosed (diagnose --uncalibrated); "
                      "record armature or duty_command too")
        return
    low, high = float(known.min()), float(known.max())
    if high - low < STILL:
        yield warning(path, f"the duty stays at {high:.2g}: record while `excite` runs")


def _angle(path: str, read: Recording) -> Iterator[Check]:
    """The angle: there, in rad, from hanging, positive where the arm is lifted."""
    known = read.theta[np.isfinite(read.theta)]
    if not len(known):
        yield error(path, f"{no_angle(read)}; nothing can be diagnosed")
        return
    for one in mistakes.without_model(read.theta, read.duty, read.i_a, read.v_a):
        yield warning(path, named(mistakes.said([one]), path))
    if (span := float(np.ptp(known))) < SMALL:
        yield warning(path, f"the angle spans only {span:.2g} rad: the arm hardly moves, or it has another unit")
    rest = resting_angle(read)
    if rest is not None and abs(rest) > OFF_ZERO:
        yield warning(path, f"at rest without duty the angle is {rest:.2g} rad, where it should be 0: set the zero "
                      f"(calibrate); {named(mend('--zero start'), path)}")
    follows = following(read)
    if follows < -FOLLOWS:
        yield warning(path, "the angle falls where the duty rises: if its sign is wrong, "
                      f"{named(mend('--flip'), path)}")
    elif abs(follows) < FOLLOWS:
        yield warning(path, "the angle hardly follows the duty: check that this duty drove the motor")


def resting_angle(read: Recording) -> float | None:
    """[rad] The angle while the recording begins without duty; None if it does not, or if the arm moves."""
    angle, duty = (x[(read.t < AT_REST) & np.isfinite(x)] for x in (read.theta, read.duty))
    if len(angle) < 2 or not len(duty) or np.abs(duty).max() > STILL or np.ptp(angle) > OFF_ZERO:
        return None
    return float(np.median(angle))


def following(read: Recording) -> float:
    """Correlation of the angle with the lagged duty, -1 to 1; NaN where one of them is constant or missing."""
    known = np.isfinite(read.theta) & np.isfinite(read.duty)
    theta, duty = read.theta[known], read.duty[known]
    if len(theta) < 2 or np.ptp(duty) < STILL or np.ptp(theta) == 0.0:
        return math.nan
    return float(np.corrcoef(lag(duty, LAG, read.period), theta)[0, 1])


def _use(path: str, read: Recording, model: Model) -> Iterator[Check]:
    """Whether a diagnosis can use it, and what its duty excites.

    The model is simulated under this duty: in the readings, an effect that the model lacks looks as if a term were not
    excited.
    """
    try:
        used = as_signals(read, model)
    except RecordingError as refused:
        reason = str(refused).removeprefix(f"{path}: ")
        try:
            as_signals(read, model, fit_nominal=True)
        except RecordingError as other:
            yield error(path, f"no diagnosis can use it: {str(other).removeprefix(f'{path}: ')}")
        else:
            yield error(path, f"{reason}; only diagnose --uncalibrated can use it")
        return
    for note in used.notes:
        if note not in read.notes:
            yield (warning if any(words in note for words in BAD) else ok)(path, note)
    try:
        data = dataset.from_bag(read, model.sensing, inputs=("duty",), held_out=0.0)
        bare = model.with_effects({})
        excited = quality(bare, planned(bare, data.held[:, 0], data.period))
    except RecordingError:  # it needs every channel without gaps; a diagnosis does not
        yield ok(path, "diagnose can use it")
        return
    poor = [e for e in excited if e.poor]
    if poor:
        named = ", ".join(f"{e.term} in d({e.equation})/dt" for e in poor)
        yield warning(path, f"diagnose can use it, but it hardly excites {named}: record with steps over the whole "
                      "range of the duty")
    else:
        yield ok(path, "diagnose can use it; every term of the model is excited")
