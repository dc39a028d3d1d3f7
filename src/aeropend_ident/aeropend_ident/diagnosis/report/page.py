# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as one self-contained HTML page; each section has a module and a template of its own."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib import metadata

from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.document import DiagnosisDocument
from aeropend_ident.diagnosis.report import (
    candidates,
    care,
    changes,
    curves,
    gap,
    location,
    parameters,
    residuals,
    traces,
    verdict,
)
from aeropend_ident.diagnosis.report.drawing import HEIGHT, WIDTH
from aeropend_ident.diagnosis.report.environment import environment
from aeropend_ident.signals.signals import Signals


@dataclass(frozen=True)
class RecordingText:
    """A recording.

    Attributes:
        bag: its name.
        notes: what is unusual in it.
        seconds: [s] length.
        samples: number of samples.
        train: [s] length of the part that was fitted to.
    """

    bag: str
    notes: Sequence[str]
    seconds: float
    samples: int
    train: float


@dataclass(frozen=True)
class Origin:
    """How the page was made.

    Attributes:
        command: the command line.
        bags: the recordings.
        nominal: the nominal model, in a few words.
        start: where it comes from.
        seconds: [s] time taken.
        versions: of the software.
        date: of the page.
    """

    command: str
    bags: Sequence[str]
    nominal: str
    start: str
    seconds: float
    versions: Sequence[str]
    date: str


def render(diagnosis: Diagnosis, document: DiagnosisDocument, command: str) -> str:
    """Write the report.

    Args:
        diagnosis: the diagnosis.
        document: its document.
        command: the command line that led here.

    Returns:
        One HTML file that needs nothing else, neither network nor fonts.
    """
    rows, table = candidates.rows(document), parameters.section(document)
    origin = Origin(command, document.bags, *_nominal(document), document.seconds, _versions(),
                    datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %z"))
    return environment().get_template("page.html.j2").render(
        width=WIDTH, height=HEIGHT, origin=origin, verdict=verdict.section(document, rows),
        care=care.reasons(document, diagnosis.signals, rows, table.rows), gap=gap.section(document),
        location=location.section(document, diagnosis.misfit, rows), unknown=curves.section(diagnosis, document),
        candidates=candidates.section(document, rows), would_show=document.which.would_show,
        parameters=table, changes=changes.section(document),
        traces=traces.section(diagnosis, document), residuals=residuals.section(diagnosis, document),
        recordings=_recordings(document, diagnosis.signals))


def _recordings(document: DiagnosisDocument, recordings: Sequence[Signals]) -> list[RecordingText]:
    return [RecordingText(bag, s.notes, len(s) * s.period, s.samples, s.train * s.period)
            for bag, s in zip(document.bags, recordings, strict=False)]


def _nominal(document: DiagnosisDocument) -> tuple[str, str]:
    """The nominal model in a few words, and where it comes from."""
    if document.identified is None:
        return f"model {document.model}", document.model
    basis = f"identified from {'these recordings' if len(document.bags) > 1 else 'this recording'}"
    return f"model {basis}", f"{basis}, starting at {document.model}"


def _versions() -> list[str]:
    return [f"aeropend {_version('aeropend_ident')}", f"Python {platform.python_version()}",
            *(f"{name} {_version(name)}" for name in ("numpy", "scipy", "numba"))]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "(version unknown)"
