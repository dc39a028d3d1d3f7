# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as one self-contained HTML page: verdict, gap, place, candidates, numbers, traces, residuals."""

from __future__ import annotations

import base64
import math
import platform
import shlex
from collections.abc import Iterable, Sequence
from datetime import datetime
from importlib import metadata
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray

from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.document import DiagnosisDocument, to_json
from aeropend_ident.diagnosis.report import curves
from aeropend_ident.diagnosis.report.curves import HEIGHT, WIDTH
from aeropend_ident.diagnosis.report.number_format import (
    ends,
    exact,
    interval,
    marks,
    minus,
    percent,
    probability,
    quantity,
    with_unit,
)
from aeropend_ident.signals.signals import CHANNELS, Signals
from aeropend_ident.signals.smoothing import moving_mean
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH, PLACES
from aeropend_sim.model.parameters import PARAMETERS

Array = NDArray[np.float64]

VARIABLES = {
    "theta": ("θ", "arm angle", "rad"), "theta_dot": ("θ̇", "arm rate", "rad/s"),
    "omega": ("ω", "rotor speed", "rad/s"), "i_a": ("i_a", "armature current", "A"),
    "v_a": ("v_a", "armature voltage", "V"), "duty": ("τ", "duty", ""), "t": ("t", "time", "s"),
}
"""Symbol (what follows _ stands lower), plain name and unit of what is plotted."""

SIGNAL_AFTER = dict(zip(PLACES, ("v_a", "i_a", "omega", "f", "theta", "reading"), strict=True))
"""What each part of the chain hands on."""

AGAINST = ("theta", "theta_dot", "omega", "i_a", "duty", "t")
"""What errors are drawn against: the variables of the regions."""

OFF = 0.05
"""Relative shift of a number that is worth a mark."""

PROBABLE = 0.01
"""Probability from which a candidate is listed in full view."""

MOST_TRACES = 4
"""Recordings whose traces are drawn."""

COLUMNS = 800
"""Pixel columns of a trace drawn without JavaScript; each shows least and greatest value."""

ZOOM_VALUES = 250_000
"""Values kept for zooming, over all traces (2.7 bytes each)."""

BINS = 24

RANDOM = {"gust", "speed_spikes"}
"""What is found by its statistics: no model predicts it, so its gap stays open."""

ELECTRICAL, MECHANICAL = {"electrical", "rotor"}, {"thrust", "arm", "sensing"}
"""Places that no measured signal parts."""

CLOSED = 0.9
"""Share of the gap below which a claim that something was found is to be taken with care."""

SHORT = 30.0
"""s of data below which little can have happened in it."""

CALM = {"duty": 0.25, "theta": 0.2}
"""Range of a signal (1, rad) below which most effects hardly show."""


def render(diagnosis: Diagnosis, document: DiagnosisDocument, command: str) -> str:
    """Write the report.

    Args:
        diagnosis: what was found.
        document: its document.
        command: the command line that led here.

    Returns:
        One HTML file that needs nothing else, neither network nor fonts.
    """
    doc: Any = to_json(document)
    loader = PackageLoader("aeropend_ident", "diagnosis/report/templates")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True,
                              undefined=StrictUndefined)
    environment.filters.update(quantity=quantity, percent=percent, probability=probability)
    candidates = [_candidate(c) for c in doc["which"]["candidates"]]
    shown = [c for c in candidates if c["found"] or c["probability"] >= PROBABLE]
    numbers, reach = _numbers(doc)
    return environment.get_template("report.html.j2").render(
        doc=doc, command=command, title=_title(doc), date=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %z"),
        versions=_versions(), recordings=_recordings(diagnosis, doc), variables=VARIABLES, size=(WIDTH, HEIGHT),
        verdict=_verdict(doc, candidates), channels=_channels(doc),
        missing=[VARIABLES[c][1] for c in CHANNELS if c not in doc["channels"]],
        places=_places(doc, candidates), regions=[_region(r) for r in doc["where"]["regions"]],
        shown=shown, others=[c for c in candidates if c not in shown],
        experiment=_experiment(doc["which"].get("next_experiment")),
        numbers=numbers, reach=reach, identified=_identified(doc), off=f"{100.0 * OFF:g}",
        traces=_traces(diagnosis, doc), residuals=_residuals(diagnosis, doc),
        misfit=_misfit(diagnosis, doc), unknown=_unknown(diagnosis, doc),
        care=_care(diagnosis, doc, candidates, numbers))


# --- what the page says

def _candidate(row: Any) -> dict[str, Any]:
    effect = row["effect"]
    number = next(iter(row["parameters"]), "") if effect == PARAMETER_MISMATCH else ""
    parameters = []
    for name, q in row["parameters"].items():
        value, between = interval(q["value"], q["low"], q["high"])
        unit = PARAMETERS[f"model.{name}"].unit if number else CATALOGUE[effect].parameters[name].unit
        parameters.append({"name": name, "value": with_unit(value, unit), "between": between})
    return {
        "effect": effect, "number": number, "place": row["place"],
        "physics": minus(f"{PARAMETERS[f'model.{number}'].description}; its value is off" if number
                          else CATALOGUE[effect].physics),
        "probability": row["probability"], "parameters": parameters, "gap_after": row["gap_after"],
        "found": row["found"],
    }


def _title(doc: Any) -> str:
    which = doc["which"]
    found = {"none": "nothing missing", "unknown": "unknown effect"}.get(which["verdict"], ", ".join(which["effects"]))
    return f"{found} · diagnose"


def _verdict(doc: Any, candidates: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The verdict as one sentence, what follows from it, and a line for each effect found."""
    which, shrink = doc["which"], doc["shrink"]
    found = sorted((c for c in candidates if c["found"]), key=lambda c: which["effects"].index(c["effect"]))
    lines = [_line(c, doc) for c in found]
    share = shrink["closed"]
    between = ""
    if shrink["low"] is not None and shrink["high"] - shrink["low"] > 1e-3:
        between = f"{percent(shrink['low'])} to {percent(shrink['high'])}"
    held = f"the last {quantity(doc['held_out_s'][1] - doc['held_out_s'][0], 's', 2)} of the recording"
    if len(doc["bags"]) > 1:
        held = "the last part of each recording"
    if share is None:
        judged = "has nothing to close: the gap is within the noise of the readings"
    else:
        sure = f" ({percent(0.95)} interval {between})" if between else ""
        judged = (f"closes {percent(share) if share > 0.0 else 'none'} of the gap{sure} on {held}, "
                  "to which nothing was fitted")
    numbers = [(c["number"], PARAMETERS[f"model.{c['number']}"].description.partition(":")[0])
               for c in found if c["number"]]
    effects = [c["effect"] for c in found if not c["number"]]
    are = "is off." if len(numbers) == 1 else "are off."
    if which["verdict"] == "none":
        sentence = [("", "The model lacks nothing that this recording shows.")]
        then = f"Refitting its numbers {judged}."
    elif which["verdict"] == "unknown":
        sentence = [("", "The model lacks something that the catalogue does not hold, in this part of the chain: "),
                    ("", f"{doc['where']['place']}.")]
        then = f"Everything that is known, refitted and added, {judged}."
    elif not effects:
        sentence = [("", "The structure of the model is right, but "), *_listed([n for n, _ in numbers]),
                    ("", f" ({' and '.join(dict.fromkeys(what for _, what in numbers))}) {are}")]
        then = f"Correcting {'it' if len(numbers) == 1 else 'them'}, with the other numbers refitted, {judged}."
    else:
        count = f"{len(effects)} effects: " if len(effects) > 1 else ""
        sentence = [("", f"The model lacks {count}"), *_listed(effects)]
        if numbers:
            sentence += [("", ", and "), *_listed([n for n, _ in numbers]), ("", f" {are}")]
        elif len(effects) == 1:
            sentence += [("", f": {found[0]['physics'].partition(': ')[0]}.")]
        else:
            sentence += [("", ".")]
        then = f"Adding {'it' if len(found) == 1 else 'them'}, with the numbers refitted, {judged}."
    if share is not None and share < 0.5 and RANDOM & set(which["effects"]) and which["verdict"] != "unknown":
        then += " What is random in it can be named and sized, but not predicted: that part of the gap stays open."
    unknown = which.get("unknown")
    return {"sentence": sentence, "then": then, "lines": lines, "between": between,
            "besides": unknown["place"] if unknown and which["verdict"] != "unknown" else "",
            "unexplained": which.get("unexplained", [])}


def _care(diagnosis: Diagnosis, doc: Any, candidates: Sequence[dict[str, Any]], numbers: Sequence[dict[str, Any]]
          ) -> list[str]:
    """What speaks for taking this verdict with care, one sentence each."""
    closed = doc["shrink"]["closed"]
    found = [c for c in candidates if c["found"]]
    care = []
    missing = [VARIABLES[c][1] for c in CHANNELS if c not in doc["channels"]]
    if missing:
        care.append(f"Not measured: {', '.join(missing)}. What shows there alone can be neither seen nor told apart.")
    notes = sum(not n.startswith("not measured") for s in diagnosis.signals for n in s.notes)
    if notes:
        care.append(f"{notes} {'note tells' if notes == 1 else 'notes tell'} what is odd in the data; see the end.")
    fitted = sum(s.train * s.period for s in diagnosis.signals)
    if fitted < SHORT:
        care.append(f"Only {quantity(fitted, 's', 2)} were fitted: {quantity(SHORT, 's', 2)} or more say more.")
    swings = all(not s.driven for s in diagnosis.signals)
    for name, least in CALM.items():
        if swings and name == "duty":
            continue
        spread = max(_range(s.channel(name)) for s in diagnosis.signals)
        if spread < least:
            _, plain, unit = VARIABLES[name]
            care.append(f"The {plain} varied by {quantity(spread, unit, 2)} only: most effects hardly show in that.")
    if found and closed is not None and closed < CLOSED and not RANDOM & {c["effect"] for c in found}:
        care.append(f"No more than {percent(closed)} of the gap closes: there is more to it, or it has another form "
                    "than the catalogue's.")
    unsure = [c["number"] or c["effect"] for c in found if c["probability"] < 0.95]
    if unsure:
        care.append(f"Less sure than 95 %: {', '.join(unsure)}.")
    for part in ELECTRICAL, MECHANICAL:
        together = [c["number"] or c["effect"] for c in found if c["place"] in part]
        if len(together) > 1:
            care.append(f"In the same part of the chain: {', '.join(together)}. A share of one can pass as one of "
                        "another.")
    claimed = {c["number"] for c in found}
    moved = [n["name"] for n in numbers if n["name"] not in claimed and (n["low"] > OFF or n["high"] < -OFF)]
    if moved and "identified" not in doc:
        care.append(f"Surely off by more than {100.0 * OFF:g} %, without being claimed: {', '.join(moved)}. "
                    + ("Part of what is not known may hide there." if doc["which"].get("unknown") else
                       "Check in the model file."))
    return care


def _range(x: Array) -> float:
    return float(np.nanmax(x) - np.nanmin(x))


def _line(candidate: dict[str, Any], doc: Any) -> dict[str, Any]:
    nominal = doc["which"]["numbers"].get(candidate["number"], {}).get("nominal", math.nan)
    unit = PARAMETERS[f"model.{candidate['number']}"].unit if candidate["number"] else ""
    return {**candidate, "nominal": with_unit(exact(nominal), unit) if candidate["number"] else ""}


def _listed(names: Sequence[str]) -> list[tuple[str, str]]:
    """Names as parts of a sentence: each a kind (`code` or none) and a text."""
    parts = [("code", names[0])]
    for name in names[1:-1]:
        parts += [("", ", "), ("code", name)]
    return [*parts, ("", " and "), ("code", names[-1])] if len(names) > 1 else parts


def _channels(doc: Any) -> list[dict[str, Any]]:
    rows = []
    for name, c in doc["channels"].items():
        symbol, plain, unit = VARIABLES[name]
        top = max(c["gap"], c["gap_after"], c["floor"], 1e-300)
        said = (f"{plain}: gap {quantity(c['gap'], unit)}, after {quantity(c['gap_after'], unit)}, "
                f"floor {quantity(c['floor'], unit)}")
        rows.append({"symbol": symbol, "plain": plain, "unit": unit, "said": said, **c,
                     "bars": [100.0 * c[key] / top for key in ("gap", "gap_after", "floor")]})
    return rows


def _places(doc: Any, candidates: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    share = doc["where"]["share"]
    return [{"name": place, "share": share.get(place, 0.0), "passes": SIGNAL_AFTER[place],
             "main": place == doc["where"]["place"],
             "found": [c["number"] or c["effect"] for c in candidates if c["found"] and c["place"] == place]}
            for place in PLACES]


def _region(r: Any) -> dict[str, Any]:
    symbol, plain, unit = VARIABLES[r["variable"]]
    low, high = ends(r["low"], r["high"])
    return {"symbol": symbol, "plain": plain, "low": low, "high": with_unit(high, unit), "share": r["share"],
            "time": r.get("time")}


def _identified(doc: Any) -> dict[str, Any] | None:
    """Of a rig that nobody knew: what its numbers were identified from, which stay open, how they differ by run."""
    identified = doc.get("identified")
    if not identified:
        return None
    spread = [f"{name} by {quantity(n['run_to_run'], PARAMETERS[f'model.{name}'].unit.replace('-', ''), 2)}"
              for name, n in doc["which"]["numbers"].items() if n.get("run_to_run")]
    hangs, lift = identified.get("hangs_at"), identified.get("lift")
    if hangs and hangs.get("run_to_run"):
        spread.append(f"where the arm hangs by {quantity(hangs['run_to_run'], 'rad', 2)}")
    curve = (f"up to {quantity(lift['rad_per_s2'][-1], 'rad/s²')} at a duty of {lift['duty'][-1]:.2f}, none below "
             f"{lift['dead_zone']:.2f}, behind a lag of {quantity(lift['lag_s'], 's', 2)}" if lift else "")
    return {"basis": identified["from"], "open": identified["not_determined"], "spread": ", ".join(spread),
            "hangs": quantity(hangs["value"], "rad", 2) if hangs else "", "lift": curve}


def _numbers(doc: Any) -> tuple[list[dict[str, Any]], float]:
    """The rows of the table of numbers, and the shift at the edge of their pictures."""
    rows = []
    for name, n in doc["which"]["numbers"].items():
        if not n.get("determined", True):
            continue
        p = PARAMETERS[f"model.{name}"]
        value, between = interval(n["value"], n["low"], n["high"])
        scale = abs(n["nominal"]) or 1.0
        shift, low, high = ((n[key] - n["nominal"]) / scale for key in ("value", "low", "high"))
        rows.append({"name": name, "unit": "" if p.unit == "-" else p.unit, "description": p.description,
                     "nominal": exact(n["nominal"]), "value": value, "between": between,
                     "shift": shift, "low": low, "high": high, "off": abs(shift) > OFF})
    reach = max([2.0 * OFF, *(1.05 * min(abs(r[key]), 1.0) for r in rows for key in ("shift", "low", "high"))])
    for r in rows:
        r["at"] = [50.0 + 50.0 * min(max(r[key] / reach, -1.0), 1.0) for key in ("shift", "low", "high")]
        r["band"] = 50.0 * OFF / reach
    return rows, reach


def _experiment(experiment: Any) -> dict[str, Any] | None:
    if not experiment:
        return None
    settings = [f"-p {shlex.quote(f'{name}:={_ros(value)}')}" for name, value in experiment["excite"].items()]
    return {"why": experiment["why"], "command": " ".join(["excite --ros-args", *settings]) if settings else ""}


def _ros(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"[{', '.join(map(_ros, value))}]" if isinstance(value, (list, tuple)) else str(value)


def _recordings(diagnosis: Diagnosis, doc: Any) -> list[dict[str, Any]]:
    return [{"bag": str(bag), "notes": s.notes, "seconds": len(s) * s.period, "samples": s.samples,
             "train": s.train * s.period}
            for bag, s in zip(doc["bags"], diagnosis.signals, strict=False)]


def _versions() -> list[str]:
    return [f"aeropend {_version('aeropend_ident')}", f"Python {platform.python_version()}",
            *(f"{name} {_version(name)}" for name in ("numpy", "scipy", "numba"))]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "(version unknown)"


# --- pictures

def _traces(diagnosis: Diagnosis, doc: Any) -> list[dict[str, Any]]:
    """The held-out part of each recording as strips: channel by channel the readings, and below them the errors."""
    order = sorted(range(len(diagnosis.signals)), key=lambda k: -_width(diagnosis, k, doc))[:MOST_TRACES]
    return [{"bag": str(doc["bags"][k]), **_figure(diagnosis, k, doc, len(order))} for k in sorted(order)]


def _figure(diagnosis: Diagnosis, k: int, doc: Any, figures: int) -> dict[str, Any]:
    s, before, after = diagnosis.signals[k], diagnosis.before[k], diagnosis.after[k]
    part = _held_out(s)
    start, stop = part.start * s.period, part.stop * s.period
    strips: list[tuple[str, str, str, dict[str, Array]]] = [("duty", "duty", "the duty applied", {"duty": s.duty})]
    for c in doc["channels"]:
        _, plain, unit = VARIABLES[c]
        measured = s.channel(c)
        if not np.isfinite(measured[part]).any():
            continue
        errors = {"nominal": before[c] - measured, "augmented": after[c] - measured}
        rms = [quantity(float(np.sqrt(np.nanmean(e[part] ** 2))), unit) for e in errors.values()]
        strips += [
            (c, "reading", f"{plain} measured, of the nominal model and of the augmented model",
             {"measured": measured, "nominal": before[c], "augmented": after[c]}),
            (c, "error", f"error of the {plain}, RMS {rms[0]} of the nominal model and {rms[1]} of the augmented model",
             errors)]
    series: list[Array] = []
    drawn = [_strip(strip, part, max(COLUMNS // figures, 300), series) for strip in strips]
    most = ZOOM_VALUES // figures // len(series)
    return {"strips": drawn, "start": start, "stop": stop, "ticks": marks(start, stop, 8),
            "data": {"start": start, "stop": stop, "series": [_packed(_least_and_greatest(x, most)) for x in series]}}


def _strip(strip: tuple[str, str, str, dict[str, Array]], part: slice, columns: int, series: list[Array]
           ) -> dict[str, Any]:
    """One strip as drawn without JavaScript; what it draws is added to `series`."""
    what, kind, said, lines = strip
    cut = {name: x[part] for name, x in lines.items()}
    low, high = _limits(cut.values(), around_zero=kind == "error")
    paths = [{"name": name, "index": len(series) + j, "d": _path(_least_and_greatest(x, 2 * columns), low, high)}
             for j, (name, x) in enumerate(cut.items())]
    series += cut.values()
    ticks = [{"at": 100.0 - m["at"], "text": m["text"]} for m in marks(low, high, 5 if kind == "error" else 4)]
    return {"what": what, "kind": kind, "said": said, "paths": paths, "ticks": ticks,
            "grid": "".join(f"M0 {HEIGHT * m['at'] / 100.0:.0f}h{WIDTH}" for m in ticks)}


def _held_out(s: Signals) -> slice:
    """The samples that nothing was fitted to; all, should there be none."""
    return slice(s.train if len(s) - s.train > 10 else 0, len(s))


def _width(diagnosis: Diagnosis, k: int, doc: Any) -> float:
    """How wide the gap of recording k is: mean square over the channels, each over its gap in all recordings."""
    s, before = diagnosis.signals[k], diagnosis.before[k]
    errors = [np.nanmean(((before[c] - s.channel(c)) / max(doc["channels"][c]["gap"], 1e-12)) ** 2)
              for c in doc["channels"] if s.has(c)]
    return float(np.mean(errors)) if errors else 0.0


def _limits(lines: Iterable[Array], around_zero: bool = False) -> tuple[float, float]:
    values = np.concatenate(list(lines))
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if around_zero:
        high = max(abs(low), abs(high))
        low = -high
    margin = 0.06 * (high - low) or 0.5 * abs(high) or 0.5
    return low - margin, high + margin


def _least_and_greatest(x: Array, most: int) -> Array:
    """At most `most` values of x (N,): least and greatest of each stretch, in the order in which they mostly come."""
    if len(x) <= most:
        return x
    edges = np.linspace(0, len(x), most // 2 + 1).astype(int)
    low, high = np.fmin.reduceat(x, edges[:-1]), np.fmax.reduceat(x, edges[:-1])
    falling = x[edges[:-1]] > x[edges[1:] - 1]
    return np.column_stack([np.where(falling, high, low), np.where(falling, low, high)]).ravel()


def _path(x: Array, low: float, high: float) -> str:
    """An SVG path over the whole width, in whole units relative to the point before; missing values leave gaps."""
    at = np.rint(np.linspace(0, WIDTH, len(x)) if len(x) > 1 else np.zeros(len(x))).astype(int)
    with np.errstate(invalid="ignore"):
        y = np.rint((high - x) / (high - low) * HEIGHT)
    out: list[str] = []
    last: tuple[int, int] | None = None
    for a, b in zip(at.tolist(), y.tolist(), strict=True):
        if not math.isfinite(b):
            last = None
            continue
        point = (a, int(b))
        out.append(f"M{point[0]} {point[1]}l0 0" if last is None else f" {point[0] - last[0]} {point[1] - last[1]}")
        last = point
    return "".join(out).replace(" -", "-")


def _packed(x: Array) -> dict[str, object]:
    """Values as 16-bit steps between least and greatest, base64, little endian; -32768 is a missing one."""
    known = x[np.isfinite(x)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    scale = (high - low) / 65534.0 or 1.0
    steps = np.where(np.isfinite(x), np.rint((np.nan_to_num(x) - low) / scale) - 32767.0, -32768.0)
    return {"low": low, "scale": scale, "data": base64.b64encode(steps.astype("<i2").tobytes()).decode("ascii")}


def _residuals(diagnosis: Diagnosis, doc: Any) -> list[dict[str, Any]]:
    """For each channel its error on held-out data against each variable, in bins."""
    parts = [_held_out(s) for s in diagnosis.signals]
    against = {name: np.concatenate([_variable(s, name)[p] for s, p in zip(diagnosis.signals, parts, strict=True)])
               for name in AGAINST}
    against = {name: x for name, x in against.items() if _varies(x)}
    rows = []
    for channel, c in doc["channels"].items():
        errors = [np.concatenate([r[channel][p] - s.channel(channel)[p]
                                  for r, s, p in zip(readings, diagnosis.signals, parts, strict=True)])
                  for readings in (diagnosis.before, diagnosis.after)]
        binned = {name: _binned(x, *errors) for name, x in against.items()}
        reach = 1.15 * max([2.0 * c["floor"], *(float(np.nanmax(np.abs(b[1]))) for b in binned.values()
                                                if np.isfinite(b[1]).any())])
        symbol, plain, unit = VARIABLES[channel]
        cells = [_cell(name, *binned[name], reach, plain, unit) for name in binned]
        rows.append({"symbol": symbol, "plain": plain, "unit": unit, "reach": quantity(reach, unit, 2), "cells": cells,
                     "noise": [HEIGHT * (0.5 - c["floor"] / reach), HEIGHT * 2.0 * c["floor"] / reach]})
    return rows


def _misfit(diagnosis: Diagnosis, doc: Any) -> list[dict[str, Any]]:
    """What the nominal model leaves unexplained in the cut chain against each variable, with the regions named."""
    misfit, regions = diagnosis.misfit.signal, doc["where"]["regions"]
    against = {name: diagnosis.misfit.variables[name] for name in AGAINST if _varies(diagnosis.misfit.variables[name])}
    binned = {name: _binned(x, misfit, misfit) for name, x in against.items()}
    most = [float(np.nanmax(np.abs(lines[1:]))) for _, lines in binned.values() if np.isfinite(lines).any()]
    if not most or (doc["which"]["verdict"] == "none" and not regions):
        return []
    cells = []
    for name, (edges, lines) in binned.items():
        cell = _cell(name, edges, lines, 1.1 * max(most), "", "")
        width = float(edges[-1] - edges[0])
        marked = [np.clip([(r[key] - edges[0]) / width for key in ("low", "high")], 0.0, 1.0)
                  for r in regions if r["variable"] == name]
        named = "".join(f"; the range from {' to '.join(ends(r['low'], r['high']))} stands out"
                        for r in regions if r["variable"] == name)
        cells.append({**cell, "said": f"Misfit of the nominal model against {VARIABLES[name][1]}{named}",
                      "regions": [[WIDTH * a, WIDTH * (b - a)] for a, b in marked]})
    return cells


def _unknown(diagnosis: Diagnosis, doc: Any) -> dict[str, Any] | None:
    """The curves of something outside the catalogue, where there is such."""
    unknown = doc["which"].get("unknown")
    if not unknown:
        return None
    n = diagnosis.augmented.model
    speed, current = (np.concatenate([np.asarray(r[c]) for r in diagnosis.after]) for c in ("omega", "i_a"))
    rate = np.concatenate([_variable(s, "theta_dot") for s in diagnosis.signals])
    step = np.concatenate([np.diff(s.duty) for s in diagnosis.signals])
    factors = curves.Factors(n["L_over_J"] * n["k_thrust"] * _rms(speed**2), _rms(rate), _rms(current),
                             _rms(step[np.abs(step) > 1e-3]))
    return curves.drawn(unknown, factors, max(s.train * s.period for s in diagnosis.signals))


def _rms(x: Array) -> float:
    x = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(x**2))) if len(x) else 0.0


def _varies(x: Array) -> bool:
    return bool(np.isfinite(x).sum() > 10 * BINS and np.nanmax(x) > np.nanmin(x))


def _variable(s: Signals, name: str) -> Array:
    if name == "t":
        return np.asarray(np.arange(len(s)) * s.period)
    if name == "duty":
        return s.duty
    if name == "theta_dot":
        width = round(0.03 / s.period)
        return np.gradient(moving_mean(moving_mean(s.theta, width), width), s.period)
    return s.channel(name)


def _binned(x: Array, before: Array, after: Array) -> tuple[Array, Array]:
    """Edges (B + 1,), and by bin (4, B): median before, and 5 %, median, 95 % after; NaN where there is too little."""
    known = np.isfinite(x) & np.isfinite(before) & np.isfinite(after)
    out = np.full((4, BINS), np.nan)
    if not known.any():
        return np.linspace(0.0, 1.0, BINS + 1), out
    x, before, after = x[known], before[known], after[known]
    low, high = np.percentile(x, [0.5, 99.5])
    edges = np.linspace(low, high if high > low else low + 1.0, BINS + 1)
    which = np.digitize(x, edges) - 1
    for b in range(BINS):
        mine = which == b
        if mine.sum() >= 12:
            out[0, b] = np.median(before[mine])
            out[1:, b] = np.percentile(after[mine], [5.0, 50.0, 95.0])
    return edges, out


def _cell(name: str, edges: Array, lines: Array, reach: float, plain: str, unit: str) -> dict[str, Any]:
    symbol, against, against_unit = VARIABLES[name]
    known = np.isfinite(lines[1])
    y = HEIGHT * (0.5 - 0.5 * lines / reach)
    band = "".join("M" + "L".join(_points(y[3], a, b) + _points(y[1], a, b)[::-1]) + "z" for a, b in _runs(known))
    worst = [float(np.nanmax(np.abs(lines[j]))) if known.any() else math.nan for j in (0, 2)]
    return {"symbol": symbol, "unit": against_unit, "ends": ends(float(edges[0]), float(edges[-1])), "band": band,
            "before": _joined(y[0]), "after": _joined(y[2]),
            "said": f"Error of the {plain} against {against}: its median reaches {quantity(worst[0], unit)} with the "
                    f"nominal model and {quantity(worst[1], unit)} with the augmented model"}


def _runs(known: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _joined(y: Array) -> str:
    return "".join("M" + "L".join(_points(y, a, b)) for a, b in _runs(np.isfinite(y)))


def _points(y: Array, a: int, b: int) -> list[str]:
    """Points over the middles of bins a..b, for a single one over its width."""
    width = WIDTH / BINS
    if b - a == 1:
        return [f"{width * (a + edge):.0f} {y[a]:.0f}" for edge in (0.0, 1.0)]
    return [f"{width * (k + 0.5):.0f} {y[k]:.0f}" for k in range(a, b)]
