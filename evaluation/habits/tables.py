# SPDX-License-Identifier: Apache-2.0
"""Tables in the habits of other people: names, units, clocks, extra columns. `layouts` writes them as files."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evaluation.habits import rigs
from evaluation.habits.rigs import Array

LANGUAGES: dict[str, dict[str, tuple[str, ...]]] = {
    "English": {"t": ("time", "Time", "timestamp", "t"), "y": ("angle", "theta", "position", "Angle"),
                "u": ("duty", "command", "control", "throttle"), "r": ("reference", "setpoint", "target", "desired"),
                "e": ("error", "err"), "v": ("angular velocity", "rate", "gyro"), "b": ("battery", "supply"),
                "n": ("index", "sample", "n", "row"), "w": ("motor speed", "rpm"), "yaw": ("yaw", "azimuth")},
    "German": {"t": ("Zeit", "zeit"), "y": ("Winkel", "Istwert", "Lage"), "u": ("Stellgröße", "Tastgrad", "Stellwert"),
               "r": ("Sollwert", "Führungsgröße"), "e": ("Regelabweichung", "Fehler"),
               "v": ("Winkelgeschwindigkeit",), "b": ("Versorgung", "Akku"), "n": ("Nr", "Zeile"),
               "w": ("Drehzahl",), "yaw": ("Gierwinkel",)},
    "Spanish": {"t": ("Tiempo", "tiempo"), "y": ("ANGULO", "Ángulo", "posición"), "u": ("CONTROL", "ESTIMULO", "mando"),
                "r": ("REFERENCIA", "Consigna"), "e": ("ERROR",), "v": ("VELOCIDAD",), "b": ("batería",),
                "n": ("muestra",), "w": ("velocidad motor",), "yaw": ("guiñada",)},
    "Portuguese": {"t": ("tempo", "Tempo"), "y": ("ângulo", "posição", "saida"), "u": ("controle", "entrada"),
                   "r": ("referência",), "e": ("erro",), "v": ("velocidade",), "b": ("bateria",), "n": ("amostra",),
                   "w": ("rotação",), "yaw": ("guinada",)},
    "French": {"t": ("temps", "Temps"), "y": ("angle", "sortie", "Position"), "u": ("commande", "entrée"),
               "r": ("consigne",), "e": ("erreur", "écart"), "v": ("vitesse",), "b": ("batterie",), "n": ("numéro",),
               "w": ("vitesse moteur",), "yaw": ("lacet",)},
    "Italian": {"t": ("tempo",), "y": ("angolo", "uscita", "posizione"), "u": ("comando", "ingresso"),
                "r": ("riferimento",), "e": ("errore",), "v": ("velocità",), "b": ("batteria",), "n": ("campione",),
                "w": ("giri motore",), "yaw": ("imbardata",)},
    "Polish": {"t": ("czas",), "y": ("kąt", "wyjście"), "u": ("sterowanie", "wejście"), "r": ("wartość zadana",),
               "e": ("uchyb",), "v": ("prędkość",), "b": ("bateria",), "n": ("próbka",), "w": ("obroty",),
               "yaw": ("odchylenie",)},
    "Turkish": {"t": ("zaman", "süre"), "y": ("açı", "konum", "çıkış"), "u": ("kontrol", "giriş"), "r": ("hedef",),
                "e": ("hata",), "v": ("hız",), "b": ("batarya",), "n": ("sıra",), "w": ("devir",), "yaw": ("sapma",)},
    "course": {"t": ("t", "T", "k*Ts"), "y": ("y", "y(t)", "y_meas", "y1"), "u": ("u", "u(t)", "u1"),
               "r": ("r", "w", "r(t)", "y_ref"), "e": ("e", "e(t)"), "v": ("dy", "v"), "b": ("vb",), "n": ("k",),
               "w": ("n",), "yaw": ("y2",)},
    "input/output": {"t": ("time", "t"), "y": ("output", "Output 1", "out"), "u": ("input", "Input 1", "in"),
                     "r": ("ref", "SP"), "e": ("error",), "v": ("rate",), "b": ("VDC",), "n": ("#",), "w": ("rpm",),
                     "yaw": ("output 2",)},
    "helicopter": {"t": ("Tiempo", "time", "t"), "y": ("PITCH", "pitch", "Elevation"), "u": ("U_PITCH", "V_p",
                   "E_PITCH"), "r": ("PITCH_REF", "pitch_d"), "e": ("ERR_PITCH", "pitch error"),
                   "v": ("W_PITCH", "pitch_rate"), "b": ("VBUS",), "n": ("N",), "w": ("motor_rpm",),
                   "yaw": ("YAW", "yaw")},
    "maker": {"t": ("millis", "time_ms", "ms"), "y": ("angle", "roll", "pot", "ang", "deg", "encoder"),
              "u": ("PWM", "pwm", "DC", "esc", "motor", "pwmOut"), "r": ("SP", "Setpoint", "target"),
              "e": ("err", "error"), "v": ("gyro", "gyroX"), "b": ("vbat", "Vin"), "n": ("i", "cnt"), "w": ("RPM",),
              "yaw": ("yaw",)},
    "thesis": {"t": ("t",), "y": ("theta", "phi", "alpha", "θ", "q"), "u": ("tau", "u_cmd", "delta"),
               "r": ("theta_ref", "theta_d", "phi_des"), "e": ("e_theta", "theta_err"),
               "v": ("theta_dot", "dtheta", "qd"),
               "b": ("V_s",), "n": ("k",), "w": ("omega_m",), "yaw": ("psi",)},
}
"""Language or habit -> role -> names of its column."""

UNHELPFUL = ("ch", "Column", "Var", "x", "Data", "Signal ", "CH")
"""Beginnings of names that say nothing."""

EXTRAS = ("e", "r", "v", "b", "n", "w", "yaw", "filtered", "terms", "acceleration", "flag", "zero", "text", "current",
          "temperature", "accelerometer")
"""Columns that nobody needs here."""


WHOLE = 30.0
"""Range of whole numbers above which they may be counts of a turn (choice: 10 degrees with 1024 counts a turn)."""

STEPS = {"deg": ((360.0 / 1024.0, 3), (360.0 / 4096.0, 3), (0.1, 1), (0.01, 2), (1.0, 0), (360.0 / 2000.0, 2)),
         "rad": ((2.0 * math.pi / 4096.0, 5), (0.001, 3), (1e-4, 4), (0.01, 2)), "counts": ((1.0, 0),)}
"""Unit of the angle -> resolutions, and digits after the point."""


@dataclass
class Cells:
    """A column as it is written.

    Attributes:
        role: "t", "y", "u" or what else it is.
        name: "" for none.
        values: (N,) as written; text otherwise.
        digits: after the point; None for `texts`.
        unit: written beside the name; "" for none.
    """

    role: str
    name: str
    values: Array
    digits: int | None
    unit: str = ""
    texts: tuple[str, ...] = ()


@dataclass
class Truth:
    """What a table holds: times [s] and angle [rad] (N,), and the duty (N,), all as far as the digits tell.

    Attributes:
        asks: why nobody could know without asking; "" if it can be known.
        volts: [V] (N,) of a command in volts, which is as good as the duty.
    """

    t: Array
    theta: Array
    duty: Array | None
    asks: str = ""
    volts: Array | None = None


@dataclass
class Drawn:
    """A table to write, with the truth and the habits that were drawn."""

    columns: list[Cells]
    truth: Truth
    habits: dict[str, str] = field(default_factory=dict)


def draw(rng: np.random.Generator) -> Drawn:
    """Draw a rig, its recording and the habits of somebody who writes it down."""
    run = rigs.draw(rng)
    names = str(rng.choice([*LANGUAGES, "unhelpful", "none"], p=_shares(len(LANGUAGES))))
    said = bool(rng.random() < 0.5)  # units are written beside the names
    made = Drawn([], Truth(run.t, run.theta, None), {"kind": run.kind, "names": names})
    t = _clock(rng, run, made, names)
    y, size = _angle(rng, run, made, names)
    u = _command(rng, run, made, names)
    rest = ([u, y] if rng.random() < 0.5 else [y, u]) + _extras(rng, run, names, y, size, u)
    if rng.random() < 0.15:
        rest = [rest[k] for k in rng.permutation(len(rest))]
    columns = [column for column in [t, *rest] if column is not None]
    if names == "unhelpful":
        start, first = str(rng.choice(UNHELPFUL)), int(rng.integers(0, 2))
        for k, column in enumerate(columns):
            column.name = f"{start}{k + first}"
    elif names == "none":
        for column in columns:
            column.name = column.unit = ""
    if not said or names == "none":
        for column in columns:
            column.unit = ""
    made.habits["units"] = "written" if said and names != "none" else "not written"
    made.columns = columns
    return made


def without_units(made: Drawn) -> str:
    """What is not clear from names and numbers where no units are written; "" if all is."""
    t, y, u = (next((column for column in made.columns if column.role == role), None) for role in "tyu")
    assert y is not None
    if made.truth.volts is not None:
        return "that the command is in volts is in no file"
    if t is not None and made.habits["clock"] == "ms" and t.values[0] < 2.0 and set(np.diff(t.values)) == {1.0}:
        return "ms, or a counter of rows?"
    if made.habits["angle"] == "deg whole" and np.ptp(y.values) > WHOLE:
        return "degrees, or counts of a turn?"
    if u is not None and not u.digits and made.habits["command"] in ("%", "255") and u.values.max() < 100.0:
        return "%, or counts of 255?"
    return ""


def _shares(count: int) -> NDArray[np.float64]:
    return np.array([*[0.86 / count] * count, 0.07, 0.07])


def _name(rng: np.random.Generator, names: str, role: str) -> str:
    return str(rng.choice(LANGUAGES[names][role])) if names in LANGUAGES else role


def _clock(rng: np.random.Generator, run: rigs.Run, made: Drawn, names: str) -> Cells | None:
    period = run.t[1]
    kinds = ("s", "ms", "us", "clock", "iso", "unix", "days", "index", "nothing", "wrapped")
    kind = str(rng.choice(kinds, p=(0.43, 0.25, 0.08, 0.06, 0.03, 0.05, 0.02, 0.02, 0.01, 0.05)))
    if names == "maker" and rng.random() < 0.7:
        kind = "ms"
    if kind == "wrapped" and run.t[-1] < 20.0:
        kind = "ms"
    late = run.t.copy()
    if rng.random() < 0.2 and kind not in ("index", "nothing"):
        late = late + period * rng.uniform(0.0, 0.15, len(late))  # each stamp is a little late
    start = float(rng.choice([0.0, 0.0, 0.0, -0.4, 3.217, 512.4]))
    made.habits["clock"] = kind
    name = _name(rng, names, "t")
    if name in ("millis", "time_ms", "ms") and kind not in ("ms", "wrapped"):
        name = "t"
    if kind == "nothing" or kind == "index":
        made.truth.asks = "the rate is in no file"
        return Cells("t", _name(rng, names, "n"), np.arange(len(late)) + float(rng.integers(0, 2)), 0
                     ) if kind == "index" else None
    if kind in ("clock", "iso"):
        begin = rng.uniform(0.0, 80000.0)
        stamps = begin + late
        made.truth.t = np.round(stamps, 3) - begin
        return Cells("t", name, np.round(stamps, 3), None, texts=tuple(map(_iso if kind == "iso" else _of_day, stamps)))
    if kind == "wrapped":
        ticks = np.rint(1e3 * late + rng.uniform(40e3, 60e3)) % 65536.0
        return Cells("t", name, ticks, 0, "ms")
    factor, unit, add, digits = {
        "s": (1.0, "s", start, max(3, round(-math.log10(period)) + 2)),
        "ms": (1e3, "ms", abs(1e3 * start), 0 if period >= 2e-3 or rng.random() < 0.5 else 2),
        "us": (1e6, "us", abs(1e6 * start), 0), "unix": (1.0, "s", 1.7e9 + rng.uniform(0.0, 1e7), 4),
        "days": (1.0 / 86400.0, "days", 739000.25, 10)}[kind]
    if kind == "s" and period * 100.0 % 1.0 < 1e-9 and rng.random() < 0.6:
        digits = 2
    values = np.round(factor * late + add, digits)
    if kind in ("ms", "us", "s") and (np.diff(values) <= 0.0).any():  # too coarse for these rows
        digits += 2
        values = np.round(factor * late + add, digits)
    made.truth.t = (values - values[0]) / factor
    return Cells("t", name, values, digits, unit)


def _of_day(s: float) -> str:
    ms = round(1e3 * s)
    return f"{ms // 3600000:02d}:{ms // 60000 % 60:02d}:{ms // 1000 % 60:02d}.{ms % 1000:03d}"


def _iso(s: float) -> str:
    return "2025-03-14T" + _of_day(s)


def _angle(rng: np.random.Generator, run: rigs.Run, made: Drawn, names: str) -> tuple[Cells, float]:
    kind = str(rng.choice(["deg", "rad", "counts"], p=[0.57, 0.4, 0.03]))
    name = _name(rng, names, "y")
    if name in ("deg", "roll", "ang"):
        kind = "deg"
    elif name in ("pot", "encoder"):
        kind = "counts"
    turn = float(rng.choice([1024, 2000, 2400, 4096]))
    size = {"deg": math.radians(1.0), "rad": 1.0, "counts": 2.0 * math.pi / turn}[kind]
    lsb, digits = STEPS[kind][int(rng.integers(len(STEPS[kind])))]
    if lsb == 1.0 and rng.random() < 0.5:
        lsb, digits = STEPS[kind][0]  # whole degrees are rarer than the others
    zero = float(rng.choice([0.0, 0.0, 0.0, -math.radians(83.0), math.pi, 0.4]))
    sign = float(rng.choice([1.0, 1.0, 1.0, -1.0]))
    x = (sign * run.theta + zero) / size
    if kind == "counts":
        x += turn / 2.0
        made.truth.asks = made.truth.asks or "the counts of a turn are in no file"
    x = np.round(x + lsb * rng.uniform(0.1, 0.6) * rng.standard_normal(len(x)), 12)
    x = np.round(np.rint(x / lsb) * lsb, digits)
    made.habits["angle"] = kind + (" whole" if lsb == 1.0 and kind == "deg" else "")
    made.truth.theta = size * x
    return Cells("y", name, x, digits, {"deg": str(rng.choice(["deg", "°", "degrees"])), "rad": "rad", "counts":
                                        str(rng.choice(["", "counts"]))}[kind]), size


def _command(rng: np.random.Generator, run: rigs.Run, made: Drawn, names: str) -> Cells | None:
    if run.kind == "free" or (run.kind == "loop" and rng.random() < 0.06):
        made.habits["command"] = "none" if run.kind == "free" else "not written down"
        if run.kind != "free":
            made.truth.asks = "the command is in no file"
        return None
    both = rng.random() < 0.03
    name = _name(rng, names, "u")
    kind = str(rng.choice(["%", "1", "255", "1023", "4095", "1000", "us", "V"],
                          p=[0.28, 0.3, 0.27, 0.02, 0.02, 0.02, 0.06, 0.03]))
    if name in ("E_PITCH", "V_p"):
        kind = "V"
    elif name == "esc":
        kind = "us"
    elif name in ("PWM", "pwm", "pwmOut") and kind in ("V", "1"):
        kind = "255"
    elif name in ("throttle", "duty", "DC", "Tastgrad") and kind not in ("%", "1"):
        kind = "%"
    made.habits["command"] = kind
    digits = int({"%": rng.choice([0, 1, 2], p=[0.2, 0.4, 0.4]), "1": rng.choice([2, 3, 4]), "V": 2}.get(kind, 0))
    supply = float(rng.choice([5.0, 11.1, 12.0, 24.0]))
    low, high, unit = {"%": (0.0, 100.0, "%"), "1": (0.0, 1.0, ""), "us": (1000.0, 2000.0, "us"),
                       "V": (0.0, supply, "V")}.get(kind) or (0.0, float(kind), "")
    x = np.round(low + (high - low) * run.u, digits)
    if both and kind in ("%", "1", "V"):
        x[: len(x) // 20] = np.round(-0.3 * high, digits)  # it brakes at first
        made.truth.asks = made.truth.asks or "the motor is driven both ways"
    if kind in ("1000", "1023", "4095") and x.max() < high:
        made.truth.asks = made.truth.asks or "the counts of full duty are in no file"
    if kind == "V":
        made.truth.volts = x
    made.truth.duty = np.clip((x - low) / (high - low), 0.0, 1.0)
    return Cells("u", name, x, digits, unit)


def _extras(rng: np.random.Generator, run: rigs.Run, names: str, y: Cells, size: float, u: Cells | None) -> list[Cells]:
    n, digits = len(run.t), max(y.digits or 0, 2)
    found: list[Cells] = []
    sign = 1.0 if np.corrcoef(y.values, run.theta)[0, 1] > 0.0 else -1.0
    offset = float(np.mean(y.values - run.theta / size)) if sign > 0.0 else None
    chosen = [x for x in EXTRAS if rng.random() < (0.6 if x in ("r", "e") else 0.12)]
    noise = rng.standard_normal
    for extra in chosen:
        name = _name(rng, names, extra) if extra in LANGUAGES["course"] else ""
        if extra in ("r", "e", "terms") and run.reference is None:
            continue
        if extra == "r" and offset is not None:
            found.append(Cells(extra, name, np.round(run.reference / size + offset, digits), digits, y.unit))
        elif extra == "e" and offset is not None:
            found.append(Cells(extra, name, np.round(run.reference / size + offset - y.values, digits), digits, y.unit))
        elif extra == "terms":
            scale = float(np.ptp(u.values)) / max(float(np.ptp(run.u)), 1e-9) if u else 1.0
            found += [Cells(extra, key, np.round(scale * x, 3), 3) for key, x in run.terms.items()]
        elif extra == "v":
            found.append(Cells(extra, name, np.round(sign * run.rate / size * (1 + 0.02 * noise(n)), 3), 3))
        elif extra == "acceleration":
            found.append(Cells(extra, "acc", np.round(sign * np.gradient(run.rate, run.t) / size, 3), 3))
        elif extra == "b":
            found.append(Cells(extra, name, np.round(11.8 - 0.4 * run.w + 0.02 * noise(n), 2), 2, "V"))
        elif extra == "n":
            found.append(Cells(extra, name, np.arange(n) + float(rng.integers(0, 2)), 0))
        elif extra == "w":
            found.append(Cells(extra, name, np.round(8000.0 * run.w + 20.0 * noise(n)), 0))
        elif extra == "yaw":
            found.append(Cells(extra, name, np.round(run.yaw / size, digits), digits, y.unit))
        elif extra == "filtered":
            found.append(Cells(extra, y.name + str(rng.choice(["_f", " filt", "_filtered", "_lp"])),
                               np.round(_lowpass(y.values, 0.15), digits + 1), digits + 1, y.unit))
        elif extra == "accelerometer":
            found.append(Cells(extra, "ax", np.round(9.81 * np.sin(run.theta) + 0.3 * noise(n), 3), 3))
        elif extra == "current":
            found.append(Cells(extra, str(rng.choice(["current", "I", "i_a"])),
                               np.round(3.0 * np.abs(run.u - 0.8 * run.w) + 0.03 * noise(n), 3), 3, "A"))
        elif extra == "temperature":
            found.append(Cells(extra, "temp", np.round(24.0 + 0.02 * run.t, 1), 1))
        elif extra == "flag":
            found.append(Cells(extra, "state", (run.t > 0.1 * run.t[-1]).astype(float), 0))
        elif extra == "zero":
            found.append(Cells(extra, "aux", np.zeros(n), 0))
        elif extra == "text":
            found.append(Cells(extra, "mode", np.zeros(n), None, texts=("OK",) * n))
    return found


def _lowpass(x: Array, keep: float) -> Array:
    out, y = np.empty_like(x), float(x[0])
    for k, value in enumerate(x):
        y += keep * (value - y)
        out[k] = y
    return out
