# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis hands out: `diagnosis.json`, `report.html`, `augmented.yaml`, and the verdict in a few lines."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.report import page
from aeropend_ident.result_folder import check, whole
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH
from aeropend_sim.model.parameters import PARAMETERS, Model, save
from aeropend_sim.untrusted import printable

FORMAT = 1
FILES = ("diagnosis.json", "report.html", "augmented.yaml")


@dataclass(frozen=True)
class Results:
    """One diagnosis, ready to be written.

    Attributes:
        body: the content of `diagnosis.json`. lines: the verdict for a terminal.
        page: the content of `report.html`. augmented: the model with what was found. command: what led here.
    """

    body: dict[str, Any]
    lines: list[str]
    page: str
    augmented: Model
    command: str

    @classmethod
    def of(cls, diagnosis: Diagnosis, body: dict[str, Any], command: str) -> Results:
        """Render a diagnosis; `body` is its `document`, `command` the command line that led here."""
        lines = [f"note: {note}" for s in diagnosis.signals for note in s.notes] + verdict_lines(body)
        lines = [printable(line) for line in lines]
        return cls(body, lines, page.render(diagnosis, body, command), diagnosis.augmented, command)

    def write(self, out: Path, *, overwrite: bool) -> None:
        """Write all files, or none.

        Raises:
            OutputError: the folder cannot be made or written, or holds results already.
        """
        check(out, FILES, overwrite=overwrite)
        with whole(out, FILES) as place:
            text = json.dumps(self.body, indent=1, allow_nan=False) + "\n"
            (place / "diagnosis.json").write_text(text, encoding="utf-8")
            (place / "report.html").write_text(self.page, encoding="utf-8", errors="backslashreplace")
            save(self.augmented, place / "augmented.yaml", f"{self.command}\n" + "\n".join(self.lines))


def document(diagnosis: Diagnosis, bags: Sequence[str], model: str, seconds: float,
             across: Sequence[Mapping[str, object]] = ()) -> dict[str, object]:
    """The content of `diagnosis.json` (contract section 5); `across`: the gap on recordings that were not fitted to."""
    signals = diagnosis.signals
    duration = sum(len(s) * s.period for s in signals)
    train = sum(s.train * s.period for s in signals)
    shrink = diagnosis.body["shrink"]
    assert isinstance(shrink, dict)
    if across:
        shrink = {**shrink, "across": list(across)}
    return {"format": FORMAT, "bags": list(bags), "model": model, "duration_s": round(duration, 3),
            "samples": sum(s.samples for s in signals), "train_s": [0.0, round(train, 3)],
            "held_out_s": [round(train, 3), round(duration, 3)], **diagnosis.body, "shrink": shrink,
            "notes": [note for s in signals for note in s.notes], "seconds": round(seconds, 2)}


def verdict_lines(body: Mapping[str, object]) -> list[str]:
    """The verdict in a few lines for the terminal."""
    which, where, shrink = body["which"], body["where"], body["shrink"]
    assert isinstance(which, dict)
    assert isinstance(where, dict)
    assert isinstance(shrink, dict)
    lines = []
    if which["verdict"] == "none":
        lines.append("verdict: none. The model explains the recording once its numbers are refitted.")
    elif which["verdict"] == "unknown":
        why = f": {'; '.join(which['unexplained'])}" if which["unexplained"] else ""
        lines.append(f"verdict: unknown. Something in the {where['place']} that the catalogue does not explain{why}.")
    else:
        lines.append(f"verdict: {' and '.join(which['effects'])} ({where['place']})")
    found = {c["effect"]: c for c in reversed(which["candidates"])}
    lines += [f"  {effect}: {describe(found[effect])}" for effect in which["effects"]]
    lines += [f"  not separable from this recording: {' and '.join(pair)}" for pair in which["not_separable"]]
    if which["next_experiment"]:
        lines.append(f"  next: {experiment(which['next_experiment'])}")
    if "identified" in body:
        lines.append(f"  {numbers(body)}")
    lines.append(gap_line("gap on held-out data", shrink))
    lines += [gap_line(f"gap on {across['bag']}, not fitted to", across) for across in shrink.get("across", [])]
    return lines


def numbers(body: Mapping[str, Any]) -> str:
    """The numbers of an unknown rig in one line, and how many of them stay open."""
    known = {n: row for n, row in body["which"]["numbers"].items() if row["determined"]}
    texts = [f"{n} = {row['value']:.4g} ({row['low']:.4g} to {row['high']:.4g}"
             + (f", run to run {row['run_to_run']:.2g})" if row.get("run_to_run") else ")") for n, row in known.items()]
    if hangs := body["identified"].get("hangs_at"):
        texts.append(f"hangs at {hangs['value']:.3g} rad"
                     + (f" (run to run {hangs['run_to_run']:.2g})" if hangs.get("run_to_run") else ""))
    if lift := body["identified"].get("lift"):
        texts.append(f"lift up to {lift['rad_per_s2'][-1]:.3g} rad/s² at a duty of {lift['duty'][-1]:.2g}, none below "
                     f"{lift['dead_zone']:.2g}, behind a lag of {lift['lag_s']:.2g} s")
    left = ", ".join(body["identified"]["not_determined"])
    return (f"identified from {body['identified']['from']}: {', '.join(texts) or 'nothing'}"
            + (f"; not determined: {left}" if left else ""))


def gap_line(name: str, shrink: Mapping[str, Any]) -> str:
    """How far a gap closes, in one line."""
    gap, after, bottom = (100.0 * shrink[k] for k in ("gap", "gap_after", "floor"))
    line = f"{name}: {gap:.1f} % of the signals' spread, {after:.1f} % with the augmented model, floor {bottom:.1f} %"
    if shrink["closed"] is None:
        return f"{line}: nothing to close"
    interval = "" if shrink["low"] is None else f" ({100 * shrink['low']:.0f} to {100 * shrink['high']:.0f} %)"
    return f"{line}: {100 * shrink['closed']:.0f} %{interval} of what can close"


def experiment(advice: Mapping[str, object]) -> str:
    """The advised experiment as a command."""
    parameters = advice["excite"]
    assert isinstance(parameters, dict)
    command = "excite --ros-args " + " ".join(f"-p {shlex.quote(f'{k}:={v}')}" for k, v in parameters.items())
    return f"{command} ({advice['why']})" if parameters else str(advice["why"])


def describe(candidate: Mapping[str, object]) -> str:
    """A candidate's parameters with units and 95 % intervals."""
    parameters = candidate["parameters"]
    assert isinstance(parameters, dict)
    texts = []
    for name, p in parameters.items():
        if candidate["effect"] == PARAMETER_MISMATCH:
            unit = PARAMETERS[f"model.{name}"].unit
        else:
            unit = CATALOGUE[str(candidate["effect"])].parameters[name].unit
        texts.append(f"{name} = {p['value']:.4g} ({p['low']:.4g} to {p['high']:.4g}) {unit}")
    return ", ".join(texts)
