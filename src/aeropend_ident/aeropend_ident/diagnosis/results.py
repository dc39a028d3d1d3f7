# SPDX-License-Identifier: Apache-2.0
"""The results of a diagnosis: `diagnosis.json`, `report.html`, `augmented.yaml`, and the verdict in a few lines."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.diagnosis.chain.values import limits
from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.document import (
    CANNOT_TELL,
    FORMAT,
    Across,
    Candidate,
    ClosedGap,
    DiagnosisDocument,
    GapBudget,
    Identified,
    Interval,
    NextExperiment,
    ParameterRow,
    VariantFound,
    to_json,
)
from aeropend_ident.diagnosis.isolation.isolate import would_show
from aeropend_ident.diagnosis.left_open import design_command
from aeropend_ident.diagnosis.policy import MATERIAL_SHARE
from aeropend_ident.diagnosis.report import changes, page, sentence
from aeropend_ident.diagnosis.report.candidates import form_text, open_pairs, strength_text, unit_of
from aeropend_ident.diagnosis.report.number_format import fit_text, plain, plain_percent, plain_quantity, plain_time
from aeropend_ident.diagnosis.report.parameters import lift_text
from aeropend_ident.result_folder import atomic_folder, ensure_free
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model import effect_file
from aeropend_sim.model.parameters import Model, save
from aeropend_sim.untrusted import printable
from aeropend_sim.wording import counted, enumerated

FILES = ("diagnosis.json", "report.html", "augmented.yaml")
"""Names of the files that a diagnosis writes."""

HARDEST = 3
"""Effects whose smallest sizes the terminal shows (layout)."""

PROPOSED = "proposed.yaml"
"""Name of the effect file of the formulas that are proposed for an unknown effect, if there are any."""


@dataclass(frozen=True)
class Results:
    """One diagnosis, ready to be written.

    Attributes:
        document: the content of `diagnosis.json`.
        lines: the verdict for a terminal.
        page: the content of `report.html`.
        augmented: the model with what was found.
        command: the command line that led here.
        definitions: of its effects by formula, and of those proposed; another process may write the results.
    """

    document: DiagnosisDocument
    lines: list[str]
    page: str
    augmented: Model
    command: str
    definitions: Mapping[str, Mapping[str, object]] = field(default_factory=dict)

    @classmethod
    def of(cls, diagnosis: Diagnosis, document: DiagnosisDocument, command: str) -> Results:
        """Render a diagnosis.

        Args:
            diagnosis: the diagnosis.
            document: its document.
            command: the command line that led here.
        """
        lines = [f"note: {note}" for note in document.notes] + verdict_lines(document)
        lines = [printable(line) for line in lines]
        ids = [*diagnosis.augmented.effects, *_proposed(document)]
        return cls(document, lines, page.render(diagnosis, document, command), diagnosis.augmented, command,
                   effect_file.definitions(ids))

    def write(self, out: Path, *, overwrite: bool) -> None:
        """Write all files, or none.

        Args:
            out: the folder.
            overwrite: whether results that are in the folder are replaced.

        Raises:
            OutputError: the folder cannot be made or written, or holds results already.
        """
        ensure_free(out, FILES, overwrite=overwrite)
        if self.definitions:
            effect_file.define(self.definitions, str(out))
        proposed = {id_: self.definitions[id_] for id_ in _proposed(self.document)}
        with atomic_folder(out, [*FILES, *[PROPOSED] * bool(proposed)]) as place:
            if proposed:
                effect_file.save(proposed, place / PROPOSED, self.command)
            text = json.dumps(to_json(self.document), indent=1, allow_nan=False) + "\n"
            (place / "diagnosis.json").write_text(text, encoding="utf-8")
            (place / "report.html").write_text(self.page, encoding="utf-8", errors="backslashreplace")
            save(self.augmented, place / "augmented.yaml", f"{self.command}\n" + "\n".join(self.lines))
        if not proposed:
            (out / PROPOSED).unlink(missing_ok=True)


def _proposed(document: DiagnosisDocument) -> list[str]:
    """Ids of the formulas that are proposed for an unknown effect."""
    return [f.id for f in document.which.unknown.formulas] if document.which.unknown is not None else []


def document(diagnosis: Diagnosis, bags: Sequence[str], model: str, seconds: float,
             across: Sequence[Across] = ()) -> DiagnosisDocument:
    """The document of a diagnosis.

    Args:
        diagnosis: the diagnosis.
        bags: the recordings, as they were named.
        model: the nominal model, as it was named.
        seconds: [s] time taken.
        across: the gap on further recordings that nothing was fitted to.
    """
    signals = diagnosis.signals
    duration = sum(len(s) * s.period for s in signals)
    train = sum(s.train * s.period for s in signals)
    c = diagnosis.conclusions
    return DiagnosisDocument(
        format=FORMAT, bags=tuple(bags), model=model, duration_s=round(duration, 3),
        samples=sum(s.samples for s in signals), train_s=(0.0, round(train, 3)),
        held_out_s=(round(train, 3), round(duration, 3)), channels=c.channels, where=c.where, which=c.which,
        closure=replace(c.closure, across=tuple(across)), identified=c.identified,
        since=c.since, estimates=c.estimates, variants=c.variants,
        notes=tuple(_notes(signals, bags)), seconds=round(seconds, 2))


def with_would_show(document: DiagnosisDocument, diagnosis: Diagnosis, further: Sequence[str], material: float,
                    jobs: int) -> DiagnosisDocument:
    """The document of a calibrated rig in which nothing was found, with what would have shown.

    Args:
        document: of the diagnosis.
        diagnosis: the diagnosis.
        further: ids of effects of effect files.
        material: share of the gap from which an effect is claimed.
        jobs: processes.
    """
    try:
        found = would_show(diagnosis.model, diagnosis.signals, further, material, jobs)
    except RecordingError:  # too little moves for a plan
        return document
    return replace(document, which=replace(document.which, would_show=found))


def _notes(recordings: Sequence[Signals], bags: Sequence[str]) -> Iterator[str]:
    """The notes of all recordings; of several, each with the name of its recording."""
    for s, bag in zip(recordings, bags, strict=False):
        yield from (f"{bag}: {note}" if len(bags) > 1 else note for note in s.notes)


def verdict_lines(document: DiagnosisDocument, *, advice: bool = True) -> list[str]:
    """The verdict in a few lines for the terminal.

    Args:
        document: of the diagnosis.
        advice: whether to say what to record next.
    """
    which, closure = document.which, document.closure
    headline = "".join(part.text for part in sentence.verdict(document))
    why = "; ".join(which.unexplained)
    lines = []
    if document.since is not None and which.verdict not in ("unknown", CANNOT_TELL):
        lines.append(changes.verdict_line(document.since, document.where.place))
    elif which.verdict == "none":
        lines.append(f"verdict: none. {_spaced(headline)}")
        lines += would_show_lines(document)
    elif which.verdict == CANNOT_TELL:
        lines.append(f"verdict: cannot tell. {why[:1].upper()}{why[1:]}.")
    elif which.verdict == "unknown":
        lines.append(f"verdict: unknown ({document.where.place}). No effect of the catalogue explains the misfit"
                     f"{f': {why}' if why else ''}.")
        if which.unknown is not None and which.unknown.closes is not None:
            lines.append(f"  learned in its place: {which.unknown.id} in augmented.yaml, a function of "
                         f"{enumerated([c.variable for c in which.unknown.curves])}; it closes "
                         f"{of_the_gap(which.unknown.closes)}")
            lines += [f"  perhaps: {f.term} ({', '.join(f'{n} = {plain(x)}' for n, x in f.parameters.items())}), "
                      f"gap {plain_percent(f.gap_after, 1)} %; try --effects {PROPOSED}"
                      for f in which.unknown.formulas[:1] if f.gap_after is not None]
    else:
        left = {"part": f"; {_spaced(sentence.open_part(closure))} stays open",
                "none": "; none of the gap closes on held-out data"}.get(sentence.closing(closure), "")
        lines.append(f"verdict: {enumerated(which.effects)} ({document.where.place}){left}")
    if which.verdict != CANNOT_TELL and (failed := sentence.failed(document)):
        lines.append(f"warning: {failed}")
    lines += [f"  {c.effect}: {describe(c)}" for effect in which.effects for c in which.candidates
              if c.found and c.effect == effect]
    small = [f"{c.effect}, {of_the_gap(c.share)}" for c in which.candidates if c.share and not c.found]
    if small:
        lines.append(f"  not claimed: {'; '.join(small)}")
    pairs = open_pairs(document)
    lines += [f"  not separable by this recording, either explains it: {' and '.join(pair)}" for pair in pairs]
    if advice and pairs and which.next_experiment:
        lines.append(f"  next: {experiment(which.next_experiment)}")
    if advice and pairs and (command := design_command(document)):
        lines.append(f"  an experiment within your limits that shows most of it: {command}")
    if document.identified is not None:
        lines.append(f"  {identified_line(document.identified, which.numbers, document.duration_s)}")
    lines += [variant_line(v) for v in document.variants or ()]
    if document.since is not None:
        lines += changes.lines(document.since)
    lines.append(gap_line("gap on held-out data", closure))
    if (angle := document.channels.get("theta")) is not None:
        lines.append(f"  fit of the angle in a free run: {fit_text(angle.fit_fitted)} on the fitted part, "
                     f"{fit_text(angle.fit_unseen)} on the unseen one")
    if closure.budget is not None:
        lines.append(budget_line(closure.budget))
    lines += [gap_line(f"gap on {across.bag}, not fitted to", across) for across in closure.across]
    return lines


def would_show_lines(document: DiagnosisDocument) -> list[str]:
    """What would have shown, where nothing did: the effects that are the hardest to see."""
    shown = document.which.would_show
    lines = []
    if unseen := [w.effect for w in shown if w.smallest is None]:
        lines.append(f"  would not have shown: {enumerated(unseen)}")
    seen = [(w.smallest / w.usual, w, w.smallest) for w in shown if w.smallest is not None]
    hardest = sorted(seen, key=lambda x: -x[0])[:HARDEST]
    if hardest:
        texts = [f"{w.effect} from {plain_quantity(size, w.unit, 2)} ({plain_percent(share)} % of its usual size)"
                 for share, w, size in hardest]
        lines.append(f"  would have shown, the hardest first: {', '.join(texts)}, ...; the report lists all")
    return lines


def identified_line(identified: Identified, rows: Mapping[str, ParameterRow], duration: float = math.inf) -> str:
    """The parameters of an uncalibrated rig in one line, and those that are not determined.

    Args:
        identified: what they were identified from.
        rows: name -> parameter.
        duration: [s] of the recordings.
    """
    texts = [f"{n} = {plain(row.value)} ({plain(row.low)} to {plain(row.high)}"
             + (f", run to run {plain(row.run_to_run, 2)})" if row.run_to_run else ")") + _unit(n)
             for n, row in rows.items() if row.determined]
    if hangs := identified.hangs_at:
        texts.append(f"hangs at a reading of {plain(hangs.value, 3)} rad"
                     + (f" (run to run {plain(hangs.run_to_run, 2)})" if hangs.run_to_run else ""))
    texts += [f"its own {n} = {plain(size.value, 3)} ({plain(size.low, 3)} to {plain(size.high, 3)}){_unit(n)}"
              for n, size in identified.own.items()]
    if identified.lift:
        texts.append(f"lift {_spaced(lift_text(identified.lift, duration))}")
    left = ", ".join(identified.not_determined)
    return (f"identified from {identified.basis}: {', '.join(texts) or 'nothing'}"
            + (f"; not determined: {left}" if left else ""))


def variant_line(variant: VariantFound) -> str:
    """A variant of the rig in one line."""
    texts = [f"{n} = {plain(x.value)} ({plain(x.low)} to {plain(x.high)}){_unit(n)}"
             for n, x in variant.numbers.items()]
    return f"  variant {variant.name} ({counted(len(variant.recordings), 'recording')}): {', '.join(texts)}"


def _unit(name: str) -> str:
    unit = limits(name).unit
    return "" if unit == "-" else f" {unit}"


def gap_line(name: str, closed: ClosedGap) -> str:
    """How far a gap closes, in one line.

    Args:
        name: of the data, the beginning of the line.
        closed: the gap before and after.
    """
    gap, after, bottom = (plain_percent(x, 1) for x in (closed.gap, closed.gap_after, closed.floor))
    line = f"{name}: {gap} % of the signals' spread, {after} % with the augmented model, floor {bottom} %"
    if closed.closed is None:
        return f"{line}: nothing to close"
    interval = ""
    if closed.low is not None and closed.high is not None:
        interval = _between(closed.low, closed.high)
    return f"{line}: {plain_percent(closed.closed)} %{interval} of the gap above the floor is closed"


def budget_line(budget: GapBudget) -> str:
    """What could be closed of the gap at all."""
    at = f" ({budget.place})" if budget.place and budget.repeatable >= MATERIAL_SHARE else ""
    return (f"  of the squared gap: {plain_percent(budget.found)} % closed, {plain_percent(budget.repeatable)} % would "
            f"be closed by some function of duty and state{at}, {plain_percent(budget.not_repeatable)} % does not "
            "repeat")


def of_the_gap(share: Interval) -> str:
    """A share of the gap with its 95 % interval: `62 % (55 to 70 %) of the squared gap`."""
    return f"{plain_percent(share.value)} %{_between(share.low, share.high)} of the squared gap"


def _between(low: float, high: float) -> str:
    return f" ({plain_percent(low)} to {plain_percent(high)} %)"


def _spaced(text: str) -> str:
    """A text of the page in plain characters."""
    return text.replace("\N{NO-BREAK SPACE}", " ").replace("−", "-")


def experiment(advice: NextExperiment) -> str:
    """The advised experiment as a command, with the reason."""
    return f"{advice.command} ({advice.why})" if advice.command else advice.why


def describe(candidate: Candidate) -> str:
    """A candidate's parameters with units and 95 % intervals, and its share of the gap."""
    spread = {name: f", run to run {plain(sd, 2)}" for name, sd in (candidate.run_to_run or {}).items() if sd}
    texts = [f"{name} = {plain(p.value)} ({plain(p.low)} to {plain(p.high)}{spread.get(name, '')}) "
             f"{unit_of(candidate.law, name)}" for name, p in candidate.parameters.items()]
    when = [f"; {word} at {plain_time(t.value)} s ({plain_time(t.low)} to {plain_time(t.high)} s)"
            for word, t in (("begins", candidate.since), ("ends", candidate.until)) if t]
    more = [f"; {_spaced(text)}" for text in (form_text(candidate), strength_text(candidate)) if text]
    return ", ".join(texts) + "".join([*more, *when]) + (f"; {of_the_gap(candidate.share)}" if candidate.share else "")
