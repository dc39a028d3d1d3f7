# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as one self-contained HTML page: verdict, gap, place, candidates, numbers, traces, residuals."""

from __future__ import annotations

import base64
import math
import platform
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from importlib import metadata
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray

from aeropend_ident.gap.chain import smooth
from aeropend_ident.gap.diagnosis import Diagnosis
from aeropend_ident.gap.signals import CHANNELS, Signals
from aeropend_sim.effects import CATALOGUE, PARAMETER_MISMATCH, PLACES
from aeropend_sim.parameters import PARAMETERS

Array = NDArray[np.float64]

VARIABLES = {
    "theta": ("θ", "arm angle", "rad"), "theta_dot": ("θ̇", "arm rate", "rad/s"),
    "omega": ("ω", "rotor speed", "rad/s"), "i_a": ("i_a", "armature current", "A"),
    "v_a": ("v_a", "armature voltage", "V"), "duty": ("τ", "duty", ""), "t": ("t", "time", "s"),
}
"""Symbol (what follows _ stands lower), plain name and unit of what is plotted."""

SIGNAL_AFTER = dict(zip(PLACES, ("v_a", "i_a", "omega", "f", "theta", "reading"), strict=True))
"""What each part of the chain hands on."""

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
WIDTH, HEIGHT = 1600, 400
"""Units of a drawing, stretched to whatever size the page gives it."""


def render(diagnosis: Diagnosis, document: Mapping[str, object], command: str) -> str:
    """Write the report.

    Args:
        diagnosis: what was found.
        document: the content of `diagnosis.json` (contract of `diagnose`).
        command: the command line that led here.

    Returns:
        One HTML file that needs nothing else, neither network nor fonts.
    """
    doc: Any = document
    environment = Environment(loader=PackageLoader("aeropend_ident", "gap"), autoescape=True, trim_blocks=True,
                              lstrip_blocks=True, undefined=StrictUndefined)
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
        numbers=numbers, reach=reach, off=f"{100.0 * OFF:g}",
        traces=_traces(diagnosis, doc), residuals=_residuals(diagnosis, doc))


# --- numbers as a person reads them

def quantity(value: float | None, unit: str = "", digits: int = 3) -> str:
    """A number to some significant digits with its unit: `0.0320 rad`, `1.78 × 10⁻⁵ kg·m²`, or a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    exponent = _exponent(value)
    text = _fixed(value, exponent, digits - 1 - _magnitude(value) + exponent)
    return _with_unit(text + _power(exponent), unit)


def exact(value: float) -> str:
    """A number as it was given, to six digits: `43629`, `6.8 × 10⁻⁴`."""
    if not math.isfinite(value):
        return "–"
    exponent = _exponent(value)
    return f"{value / 10.0**exponent:.6g}".replace("-", "−") + _power(exponent)


def interval(value: float, low: float, high: float) -> tuple[str, str]:
    """A value and its interval to the digits that the interval leaves certain: `0.799`, `0.798 to 0.801`."""
    if not all(map(math.isfinite, (value, low, high))):
        return quantity(value), f"{quantity(low)} to {quantity(high)}"
    exponent = _exponent(max((value, low, high), key=abs))
    half = 0.5 * (high - low)
    decimals = exponent - _magnitude(half) + 1 if half > 0.0 else exponent - _magnitude(value) + 3
    decimals = min(decimals, exponent - _magnitude(max(value, low, high, key=abs)) + 6)
    texts = [_fixed(x, exponent, decimals) for x in (value, low, high)]
    return texts[0] + _power(exponent), f"{texts[1]} to {texts[2]}{_power(exponent)}"


def percent(share: float | None, sign: bool = False) -> str:
    """A share (0..1) in percent; never rounded to 0 or 100 from outside, unless it is a change (`sign`)."""
    if share is None or not math.isfinite(share):
        return "–"
    x = 100.0 * share
    if not sign and 0.0 < x < 0.1:
        return _with_unit("<\N{NO-BREAK SPACE}0.1", "%")
    if not sign and 99.9 < x < 100.0:
        return _with_unit(">\N{NO-BREAK SPACE}99.9", "%")
    text = f"{x:.{int(x != 0.0 and (abs(x) < 10.0 or 99.0 < abs(x) < 100.0))}f}"
    if sign and float(text) == 0.0:
        text = "0"
    elif sign and x > 0.0:
        text = f"+{text}"
    return _with_unit(text, "%").replace("-", "−")


def probability(p: float) -> str:
    """A probability in percent; never certain."""
    return percent(min(max(p, 1e-6), 1.0 - 1e-6))


def _magnitude(x: float) -> int:
    return math.floor(math.log10(abs(x))) if x != 0.0 else 0


def _exponent(x: float) -> int:
    magnitude = _magnitude(x)
    return magnitude if magnitude < -3 or magnitude > 4 else 0


def _fixed(x: float, exponent: int, decimals: int) -> str:
    return f"{round(x / 10.0**exponent, decimals) + 0.0:.{max(decimals, 0)}f}".replace("-", "−")


def _power(exponent: int) -> str:
    digits = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10{digits}" if exponent else ""


def _with_unit(text: str, unit: str) -> str:
    return f"{text}\N{NO-BREAK SPACE}{unit}" if unit not in ("", "-") else text


def _minus(formula: str) -> str:
    """A formula with its hyphens as minus signs; those between letters stay."""
    return re.sub(r"(?<![A-Za-z])-", "−", formula)


def _ends(low: float, high: float) -> list[str]:
    """The ends of a range to two digits of its width."""
    decimals = 1 - _magnitude(high - low)
    return [_fixed(x, 0, decimals) for x in (low, high)]


# --- what the page says

def _candidate(row: Any) -> dict[str, Any]:
    effect = row["effect"]
    number = next(iter(row["parameters"]), "") if effect == PARAMETER_MISMATCH else ""
    parameters = []
    for name, q in row["parameters"].items():
        value, between = interval(q["value"], q["low"], q["high"])
        unit = PARAMETERS[f"model.{name}"].unit if number else CATALOGUE[effect].parameters[name].unit
        parameters.append({"name": name, "value": _with_unit(value, unit), "between": between})
    return {
        "effect": effect, "number": number, "place": row["place"],
        "physics": _minus(f"{PARAMETERS[f'model.{number}'].description}; its value is off" if number
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
        judged = (f"closes {percent(share) if share > 0.0 else 'none'} of the gap"
                  f"{f' (95 % interval {between})' if between else ''} on {held}, to which nothing was fitted")
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
    if share is not None and share < 0.5 and which["effects"] and which["verdict"] != "unknown":
        then += " What is random in it can be named and sized, but not predicted: that part of the gap stays open."
    return {"sentence": sentence, "then": then, "lines": lines, "between": between,
            "unexplained": which.get("unexplained", [])}


def _line(candidate: dict[str, Any], doc: Any) -> dict[str, Any]:
    nominal = doc["which"]["numbers"].get(candidate["number"], {}).get("nominal", math.nan)
    unit = PARAMETERS[f"model.{candidate['number']}"].unit if candidate["number"] else ""
    return {**candidate, "nominal": _with_unit(exact(nominal), unit) if candidate["number"] else ""}


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
    low, high = _ends(r["low"], r["high"])
    return {"symbol": symbol, "plain": plain, "low": low, "high": _with_unit(high, unit), "share": r["share"],
            "time": r.get("time")}


def _numbers(doc: Any) -> tuple[list[dict[str, Any]], float]:
    """The rows of the table of numbers, and the shift at the edge of their pictures."""
    rows = []
    for name, n in doc["which"]["numbers"].items():
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
    return [{"bag": str(bag), "notes": s.notes, "seconds": len(s) * s.period, "samples": len(s),
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
    return {"strips": drawn, "start": start, "stop": stop, "ticks": _marks(start, stop, 8),
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
    marks = [{"at": 100.0 - m["at"], "text": m["text"]} for m in _marks(low, high, 5 if kind == "error" else 4)]
    return {"what": what, "kind": kind, "said": said, "paths": paths, "ticks": marks,
            "grid": "".join(f"M0 {HEIGHT * m['at'] / 100.0:.0f}h{WIDTH}" for m in marks)}


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


def _marks(low: float, high: float, about: int) -> list[dict[str, Any]]:
    """Round values within low..high: where (percent of the way) and as text."""
    raw = (high - low) / about
    base = 10.0 ** math.floor(math.log10(raw))
    step = next(m * base for m in (1.0, 2.0, 5.0, 10.0) if m * base >= raw * 0.999)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [{"at": 100.0 * (k * step - low) / (high - low), "text": _fixed(k * step, 0, decimals)}
            for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _residuals(diagnosis: Diagnosis, doc: Any) -> list[dict[str, Any]]:
    """For each channel its error on held-out data against each variable, in bins."""
    parts = [_held_out(s) for s in diagnosis.signals]
    against = {name: np.concatenate([_variable(s, name)[p] for s, p in zip(diagnosis.signals, parts, strict=True)])
               for name in ("theta", "theta_dot", "omega", "i_a", "duty", "t")}
    against = {name: x for name, x in against.items()
               if np.isfinite(x).sum() > 10 * BINS and np.nanmax(x) > np.nanmin(x)}
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


def _variable(s: Signals, name: str) -> Array:
    if name == "t":
        return np.asarray(np.arange(len(s)) * s.period)
    if name == "duty":
        return s.duty
    if name == "theta_dot":
        width = round(0.03 / s.period)
        return np.gradient(smooth(smooth(s.theta, width), width), s.period)
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
    return {"symbol": symbol, "unit": against_unit, "ends": _ends(float(edges[0]), float(edges[-1])), "band": band,
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
