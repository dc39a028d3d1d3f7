# SPDX-License-Identifier: Apache-2.0
"""Experiments one after another, until the verdict is sure or more would not help.

Pure: a caller plays each signal, on a rig or on a simulated one, and gives the recording back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from aeropend_ident.design.design import LENGTH, Designed, design, prolonged
from aeropend_ident.design.goals import any_effect, between
from aeropend_ident.design.limits import Limits
from aeropend_ident.design.responses import Rows, asked
from aeropend_ident.diagnosis.diagnosis import Diagnosis, diagnose
from aeropend_ident.diagnosis.document import CANNOT_TELL, DiagnosisDocument
from aeropend_ident.diagnosis.left_open import Open, as_refitted, left_open
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.parameters import Model

Progress = Callable[[str, float], None]
"""Called with the present step and the share (0 to 1) of the work that is done."""

CHANGED = 0.7
"""Factor on a rival's probability above which an experiment for it has changed nothing (choice)."""

LEAST_HELP = 0.1
"""Share of what is wanted below which all the time that is left does not help (choice)."""


@dataclass(frozen=True)
class Proposal:
    """The next experiment.

    Attributes:
        designed: the signal, and what it shows.
        rows: of the rig for which it was designed.
        why: what it is for, in a few words.
    """

    designed: Designed
    rows: Rows
    why: str


class Investigation:
    """Experiments on one rig, and what they have shown so far.

    Args:
        model: the nominal model.
        signals: a planned recording that gives channels and noise.
        limits: that every experiment keeps, for every rig within the uncertainty.
        most: [s] motion in all.
        further: ids of effects of effect files.
        tries: signals that are tried for one experiment; None: the usual number.
        first: the first experiment, if it is designed already.
        jobs: processes.
    """

    def __init__(self, model: Model, signals: Signals, limits: Limits, most: float, *, further: Sequence[str] = (),
                 tries: int | None = None, first: Designed | None = None, jobs: int = 1) -> None:
        self.model, self.signals, self.limits, self.most = model, signals, limits, most
        self.further, self.tries, self.first, self.jobs = tuple(further), tries, first, jobs
        self.recordings: list[Signals] = []
        self.moved = 0.0
        self.ended = ""
        """Why there is no further experiment, in a sentence; "" as long as there may be one."""
        self.sure = False
        self._length = 0.0
        self._open = Open((), {}, 0.0)
        self._found: DiagnosisDocument | None = None

    def next(self, progress: Progress = lambda *_: None) -> Proposal | None:
        """Design the next experiment; None if the verdict is sure, or more would not help (`ended`).

        Args:
            progress: of the search.
        """
        left = self.most - self.moved
        if self.ended or left < LENGTH:
            self.ended = self.ended or f"The verdict is not sure after {self.moved:.0f} s of motion."
            return None
        names = self._open.names
        model = self.model if self._found is None else as_refitted(self.model, self._found)
        effects = asked(model, self.further, self._open.sizes)
        rows = Rows(model, self.signals, effects)
        goal = between(rows, names) if names else any_effect(rows, list(rows.effects))
        best = self.first if self.first is not None and not self.recordings else design(
            rows, goal, self.limits, LENGTH, tries=self.tries, seed=len(self.recordings), jobs=self.jobs,
            progress=progress)
        self._length = best.excitation.duration
        if not names:
            return Proposal(best, rows, "show any effect, and tell it from the others")
        reached = min(a.reached for a in best.answers)
        if reached * math.sqrt(left / LENGTH) < LEAST_HELP:
            self.ended = (f"No motion of {left:.0f} s tells {' and '.join(names)} apart with these sensors and within "
                          "these limits.")
            return None
        times = math.ceil(min(max(reached, 1e-3) ** -2, left // LENGTH))
        if times > 1:
            best = prolonged(rows, goal, best, times)
            self._length = best.excitation.duration
        return Proposal(best, rows, f"tell {' and '.join(names)} apart")

    def add(self, recording: Signals, diagnosed: Callable[[Diagnosis], DiagnosisDocument],
            progress: Progress = lambda *_: None) -> Diagnosis:
        """Diagnose all recordings so far.

        Args:
            recording: of the experiment that was proposed.
            diagnosed: diagnosis -> its document.
            progress: of the diagnosis.
        """
        self.recordings.append(recording)
        self.moved += self._length
        found = diagnose(self.model, self.recordings, self.jobs, progress, further=self.further)
        self._found = diagnosed(found)
        before, self._open = self._open, left_open(self._found)
        self.sure = not self._open.names and self._found.which.verdict != CANNOT_TELL
        if self.sure:
            self.ended = "The verdict is sure: no rival is left."
        elif set(before.names) == set(self._open.names) != set() and self._open.rival > CHANGED * before.rival:
            self.ended = (f"An experiment for it did not tell {' and '.join(before.names)} apart: more of the same "
                          "would not help.")
        return found
