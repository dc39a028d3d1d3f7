# SPDX-License-Identifier: Apache-2.0
"""The recordings that are diagnosed again and again, by the generator of the blind check, and their verdicts."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from aeropend_ident.bags import recording
from aeropend_ident.diagnosis import diagnosis
from aeropend_ident.diagnosis.document import to_json
from aeropend_ident.diagnosis.results import document
from aeropend_ident.signals.from_bag import from_recording, signals_of
from aeropend_ident.signals.signals import Signals
from aeropend_ident.testing import bags
from aeropend_sim.model.parameters import Model, load
from evaluation.blind import cases, plant, score, uncalibrated

SEED = 4_711_000
"""Seed of the first recording; no constant was tuned on these recordings."""

DURATION = 25.0
"""[s] Duration of a driven recording."""

FAINT = (0.15, 0.6)
"""[floors] Range of the sizes of faint effects: around `MATERIAL`. The others are drawn from 1.5 to 10."""

RECORDINGS: tuple[tuple[str, str, tuple[str, ...], str], ...] = (
    ("calibrated", "none", (), "table"), ("calibrated", "none", (), "table"),
    ("calibrated", "single", ("coulomb_friction",), "other"), ("calibrated", "single", ("thrust_lag",), "table"),
    ("calibrated", "single", ("brush_drop",), "table"), ("calibrated", "single", ("encoder_eccentricity",), "table"),
    ("calibrated", "single", ("gust",), "table"), ("calibrated", "single", ("speed_spikes",), "table"),
    ("calibrated", "single", ("parameter_mismatch",), "table"),
    ("calibrated", "two", ("quadratic_drag", "supply_sag"), "table"),
    ("calibrated", "outside", ("duty_ripple",), "table"), ("calibrated", "outside", ("current_clip",), "table"),
    ("driven", "none", (), "table"), ("driven", "single", ("command_delay",), "table"),
    ("driven", "single", ("quadratic_drag",), "table"),
    ("decay", "none", ("viscous",), "table"), ("decay", "single", ("coulomb_friction",), "table"),
    ("calibrated", "single", ("ground_effect",), "other"),
    ("calibrated", "two", ("winding_heating", "cable_torque"), "other"),
    ("faint", "single", ("thrust_exponent",), "other"), ("faint", "single", ("supply_sag",), "table"),
    ("faint", "single", ("rotor_friction",), "table"), ("faint", "single", ("gust",), "table"),
    ("faint", "two", ("quadratic_drag", "encoder_lag"), "table"), ("faint", "outside", ("blade_stall",), "table"),
)
"""Kind of rig, kind of label, effects, and form of each.

Kinds of rig: calibrated; calibrated with faint effects; driven with angle and command alone; free decay.
Names count them. `make blind` holds many more; this set shows which thresholds matter."""

Verdict = Mapping[str, Any]
"""What a diagnosis decided: "answer" (effects found, verdict, place), "besides" (other decisions), "right"."""

NAMES = tuple(f"s{k:02d}" for k in range(len(RECORDINGS)))
"""Names of the recordings."""


def make(folder: Path, name: str) -> None:
    """Write one recording and its label, in place of an older one."""
    k = NAMES.index(name)
    rig, kind, effects, form = RECORDINGS[k]
    nominal = load("bench")
    period = plant.PERIOD
    if is_calibrated(name):
        with mock.patch.object(cases, "FLOORS", FAINT if rig == "faint" else cases.FLOORS):
            case, columns = cases.draw(name, kind, list(effects), form, nominal.model, nominal.sensing, SEED + k,
                                       DURATION)
        label = case.label()
    elif rig == "driven":
        label, columns, period = uncalibrated.driven(name, effects[0] if effects else "", form, nominal.model,
                                                     nominal.sensing["angle_filter_tau"], SEED + k, DURATION)
    else:
        label, columns, period = uncalibrated.decay(name, effects[0], nominal.model, SEED + k)
    shutil.rmtree(folder / name, ignore_errors=True)
    bags.write(folder / name, columns, round(period * 1e9))
    (folder / f"{name}.json").write_text(json.dumps(label), encoding="utf-8")


def is_calibrated(name: str) -> bool:
    """Whether the recording is of a calibrated rig."""
    return RECORDINGS[NAMES.index(name)][0] in ("calibrated", "faint")


def is_faint(name: str) -> bool:
    """Whether its effects are at the limit of what is visible."""
    return RECORDINGS[NAMES.index(name)][0] == "faint"


def diagnosed(folder: Path, name: str, *, keep: bool = False, kept: bool = False) -> Verdict:
    """The verdict on one recording.

    Args:
        folder: of the recordings.
        name: of the recording.
        keep: whether to keep the identified nominal model of an uncalibrated rig beside the recording.
        kept: whether to use the nominal model that was kept: no step up to it depends on the threshold.
    """
    model, store = load("bench"), folder / f"{name}.nominal.pickle"
    fit = not is_calibrated(name)
    try:
        with ExitStack() as stack:
            if fit and kept:
                nominal = pickle.loads(store.read_bytes())
                stack.enter_context(mock.patch.object(diagnosis, "fit_nominal_model", return_value=nominal))
                signals = nominal[1]
            else:
                signals = [_read(folder / name, model, fit)]
            if fit and keep:
                stack.enter_context(mock.patch.object(diagnosis, "fit_nominal_model", _kept_in(store)))
            found = diagnosis.diagnose(model, signals, 1, fit_nominal=fit)
            body = json.loads(json.dumps(to_json(document(found, [name], "bench", 0.0))))
    except (ValueError, ArithmeticError, LookupError, np.linalg.LinAlgError) as error:
        body = {"error": str(error), "seconds": 0.0}
    return _verdict(json.loads((folder / f"{name}.json").read_text(encoding="utf-8")), body)


def _read(path: Path, model: Model, fit: bool) -> Signals:
    if fit:
        return signals_of(path, None, model, fit_nominal=True)
    return from_recording(recording.read(str(path)), model.sensing)


def _kept_in(store: Path) -> Any:
    identify = diagnosis.fit_nominal_model

    def fit_and_keep(*arguments: Any) -> Any:
        result = identify(*arguments)
        store.write_bytes(pickle.dumps(result))
        return result

    return fit_and_keep


def _verdict(label: Mapping[str, Any], body: Mapping[str, Any]) -> Verdict:
    truth, answer = score.Label.read(label), score.answer_of_diagnosis(body)
    besides: Any = body.get("error")
    if besides is None:
        which = body["which"]
        besides = [[r["variable"] for r in body["where"]["regions"]], which["not_separable"],
                   len(which["unexplained"]), [n for n, p in which["numbers"].items() if p.get("determined")]]
    return {"answer": [answer.first, sorted(answer.found), answer.place], "besides": besides,
            "right": right(truth, answer)}


def right(truth: score.Label, answer: score.Answer) -> bool:
    """Whether a verdict names all effects and no other, and the place of one of them."""
    if truth.kind == "none":
        return answer.first == "none" and not answer.found
    if truth.kind == "outside":
        return answer.first == "unknown" and score.right_place(truth, answer)
    return set(answer.found) == truth.keys and answer.first in truth.keys and score.right_place(truth, answer)
