# SPDX-License-Identifier: Apache-2.0
"""The folder of a blind check: recordings, sealed labels, and verdicts. The labels open after the last verdict."""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed
from rich.progress import Progress

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.document import to_json
from aeropend_ident.diagnosis.results import document
from aeropend_ident.signals.from_bag import signals_of
from aeropend_sim.model.parameters import Model, load

MODEL = "bench"
"""Model file whose numbers the rigs are drawn around (choice)."""

SEALED = "labels.sealed"
"""File of the labels, compressed: no search for the name of an effect finds it there (choice)."""


def names(out: Path) -> list[str]:
    """Names of the recordings."""
    return sorted(p.name for p in (out / "recordings").iterdir())


def make_all(out: Path, rows: Sequence[Any], one: Callable[[int, Any], dict[str, Any]], jobs: int) -> None:
    """Make the recordings, and seal their labels; `one` writes the recording of a row and returns its label."""
    (out / "recordings").mkdir(parents=True)
    labels = each("making recordings", rows, one, jobs)
    (out / SEALED).write_bytes(zlib.compress(json.dumps(labels).encode()))


def write_model(out: Path, name: str, model: Model) -> None:
    """Write the model file of a recording whose rig is not drawn around `MODEL`; it is no secret."""
    (out / "models").mkdir(exist_ok=True)
    (out / "models" / f"{name}.json").write_text(json.dumps({"model": model.model, "sensing": model.sensing}))


def model_of(out: Path, name: str) -> Model:
    """The model file of a recording."""
    own = out / "models" / f"{name}.json"
    return Model(name, **json.loads(own.read_text())) if own.exists() else load(MODEL)


def diagnose_all(out: Path, jobs: int, only: Sequence[str] = (), *, fit_nominal: bool = False) -> None:
    """Write a verdict for each recording; the labels stay sealed.

    Args:
        out: the folder.
        jobs: processes.
        only: names of the recordings to diagnose; all without it.
        fit_nominal: whether the rigs are uncalibrated, as for `diagnose --fit-nominal`.
    """
    (out / "verdicts").mkdir(exist_ok=True)

    def one(_: int, name: str) -> None:
        started, model = time.perf_counter(), model_of(out, name)
        try:
            signals = signals_of(out / "recordings" / name, None, model, fit_nominal=fit_nominal)
            result = diagnose(model, [signals], 1, fit_nominal=fit_nominal)
            body = to_json(document(result, [name], MODEL, time.perf_counter() - started))
        except RecordingError as error:
            body = {"error": str(error), "seconds": time.perf_counter() - started}
        (out / "verdicts" / f"{name}.json").write_text(json.dumps(body))

    each("diagnosing", [n for n in names(out) if not only or n in only], one, jobs)


def opened(out: Path) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """Labels, and verdicts by name.

    Raises:
        SystemExit: a verdict is missing; the labels stay sealed until all are written.
    """
    all_ = names(out)
    missing = [n for n in all_ if not (out / "verdicts" / f"{n}.json").exists()]
    if missing:
        raise SystemExit(f"{len(missing)} of {len(all_)} verdicts are missing ({missing[0]} ...): diagnose first")
    verdicts = {n: json.loads((out / "verdicts" / f"{n}.json").read_text()) for n in all_}
    return json.loads(zlib.decompress((out / SEALED).read_bytes())), verdicts


def each(what: str, rows: Sequence[Any], one: Callable[[int, Any], Any], jobs: int) -> list[Any]:
    """Run one(k, row) for each row on `jobs` processes, with a bar."""
    with Progress() as bar:
        return list(bar.track(Parallel(jobs, return_as="generator")(delayed(one)(k, r) for k, r in enumerate(rows)),
                              len(rows), description=what))
