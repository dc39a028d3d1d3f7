# SPDX-License-Identifier: Apache-2.0
"""Meanings of the names of columns, in many languages and habits."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

from aeropend_ident.tables.units import RPM, UNITS, known, split_name

STRONG, WEAK = 4.0, 2.0
"""[nats] Log odds of a name that means one thing, and of one that often means it (choices: 50 and 7 to 1)."""

WORDS: dict[str, tuple[str, str]] = {
    "error": ((
        "error err errore erro erreur ecart fehler regelabweichung abweichung regeldifferenz uchyb blad hata "
        "fout afwijking fel hiba virhe chyba odchylka ошибка 误差 偏差 誤差 오차 deviation"), "e"),
    "reference": ((
        "reference ref setpoint sp soll sollwert sollwinkel fuhrungsgrosse target consigna consigne consegna "
        "desired des referencia riferimento referentie borve bor zadana zadany zadane уставка задание goal "
        "hedef referans referinta desejado deseado wanted demand 目标 设定 設定 목표"), "r d rk yr soll"),
    "filtered": ((
        "filtered filt filtre filtrado filtrato gefiltert filtr lp lowpass smooth smoothed smoothing kalman "
        "avg average ema"), "f"),
    "angle rate": ((
        "dot dtheta dphi dalpha dangle dy dq qd thetad thetadot rate gyro gyrox gyroy gyroz gyr "
        "angularvelocity winkelgeschwindigkeit winkelgeschw vel velocity geschwindigkeit predkosc hiz "
        "velocidade velocidad velocita vitesse snelheid rychlost скорость 速度 角速度"), "dt"),
    "acceleration": ((
        "acc accel acceleration accelerometer beschleunigung aceleracion accelerazione aceleracao "
        "przyspieszenie ivme ax ay az accx accy accz ddot thetaddot qdd ускорение"), "a"),
    "other axis": ("yaw azimuth azimut gier gierwinkel lacet guinada imbardata odchylenie sapma psi heading", ""),
    "supply": ((
        "supply battery bat vbat vbus vdc vcc vin vb vs batterie bateria batteria batarya akku versorgung "
        "alimentation alimentacion"), ""),
    "temperature": ("temp temperature temperatur temperatura sicaklik tmp температура 温度", ""),
    "state": ((
        "state mode flag status modus zustand estado etat stato stan durum button trigger led comment note "
        "bemerkung aux spare"), ""),
    "control term": ("pterm iterm dterm integral integrator proportional derivative kp ki kd", "p"),
    "index": ((
        "index idx sample samples row nr no num number numero zeile muestra amostra numer probka sira "
        "campione count cnt counter line id #"), ""),
    "time": ((
        "time zeit zeitpunkt zeitstempel uhrzeit tiempo temps tempo tid tijd czas cas aika ido vreme zaman "
        "sure timestamp stamp millis micros hora heure seconds sec sekunden segundos secondes clock date "
        "datum fecha tiempos ts время 时间 時間 시간"), "t ms us s"),
    "omega": ((
        "rpm drehzahl rotor giri umdrehungen otacky hastighet varvtal toerental obroty devir rotacao rotacion "
        "motorspeed propspeed speed обороты 转速 回転数"), "w omega ω tach n"),
    "duty": ((
        "duty pwm dc throttle tastgrad tastverhaltnis stellgrosse stellgroesse stellwert steuergrosse ciclo "
        "control ctrl cmd command comando commande kommando esc steuer sterowanie controle kontrol mando "
        "estimulo stimulus actuation controlsignal controloutput acelerador gashebel скважность шим "
        "управление 占空比 控制 制御 제어 dutycycle pwmout"), (
        "u input in eingang entrada entree ingresso wejscie giris ingang vstup motor gas power effort tau "
        "delta co op mv drive torque pid вход 输入 入力 입력")),
    "current": ((
        "current strom motorstrom corriente courant corrente stroom prad proud amps strøm akim ток 电流 電流 전류"),
        "i ia im"),
    "voltage": ((
        "voltage spannung motorspannung voltaje tension tensione tensao spanning spenning napiecie napeti "
        "volt volts gerilim напряжение 电压 電圧 전압"), "v va vm"),
    "theta": ((
        "theta th θ ϑ angle angolo angulo ang winkel vinkel hoek kat uhel kut aci pitch tilt elevation phi φ "
        "alpha istwert istwinkel pendel pendulo pendulum pendolo wahadlo beam armangle degrees угол 角度 각도 "
        "theta1"), (
        "y output out ausgang salida saida sortie uscita wyjscie cikis uitgang vystup pv position posicion "
        "posicao posizione pozycja konum poloha lage pos ist actual measured measurement q roll arm arma deg "
        "rad encoder enc pot potentiometer adc sensor x выход 输出 出力 출력 yk α")),
}  # fmt: skip
"""Quantity -> words that mean it, and words that often do, in lower case without accents. The first quantity counts."""

OF_SIMULINK = ("scope", "data", "values", "signals")
"""Parts of the names of fields that say nothing of the signal."""

_LONG = sorted({word for texts in WORDS.values() for text in texts for word in text.split() if len(word) > 3})

_SPLIT = re.compile(r"[^\w°#]+|_|(?<=[a-zäöüа-я])(?=\d)|(?<=[a-z])(?=[A-Z])")
_ARGUMENT = re.compile(r"\s*[(\[]\s*(?:t|k|n|i|:|\d*|:\s*,\s*\d+)\s*[)\]]$")


@dataclass(frozen=True)
class Meaning:
    """What a name means: a key of `WORDS`, "" for nothing, and the log odds [nats]."""

    quantity: str = ""
    odds: float = 0.0


def words(text: str) -> list[str]:
    """The words of a name, in lower case and without accents."""
    plain = unicodedata.normalize("NFKD", _ARGUMENT.sub("", text))
    plain = "".join(letter for letter in plain if not unicodedata.combining(letter))
    plain = plain.replace("ß", "ss").replace("ı", "i").replace("ł", "l")
    return [word.casefold() for word in _SPLIT.split(plain) if word]


def whole_words(text: str) -> list[str]:
    """The words of a name, or the one word that it was before it lost its letters with accents."""
    parts = words(text)
    lost = _without_lost_letters([part for part in parts if part not in OF_SIMULINK])
    return [lost] if lost else parts


def meaning(name: str, unit: str = "") -> Meaning:
    """The meaning of a column's name.

    Args:
        name: as in the file.
        unit: the unit in the file, which is no part of the name.
    """
    if unit and split_name(name)[0] != unit:
        name = split_name(name)[0]
    parts = whole_words(name)
    joined = "".join(parts)
    found = [Meaning(quantity, odds) for quantity, texts in WORDS.items()
             for odds, text in zip((STRONG, WEAK), texts) if _has(parts, joined, text.split())]
    strong = [one for one in found if one.odds == STRONG]
    letters = [one for one in found if one.odds == WEAK and one.quantity not in ("theta", "index", "time")]
    by_unit = _of_unit(unit)
    possible = (by_unit, "duty", "supply") if by_unit == "voltage" else (by_unit,)
    if by_unit and not any(one.quantity in possible for one in found):
        return Meaning(by_unit, STRONG)  # the letter of E_PITCH in V does not mean an error
    if len(strong) == 1 and strong[0].quantity == "theta" and letters and len(parts) > 1:
        return Meaning(letters[0].quantity, WEAK)  # U_PITCH, theta_d: a letter says what of the angle
    if not strong and len(found) > 1:
        return min(found, key=lambda one: _place(parts, WORDS[one.quantity][1].split()))  # u_t, V_p
    return (strong or found or [Meaning()])[0]


def _place(parts: list[str], known_words: list[str]) -> int:
    """Which part of a name is the first that is a known word; their number if only all together are."""
    return next((k for k, part in enumerate(parts) if part in known_words), len(parts))


def _of_unit(unit: str) -> str:
    """The quantity that alone has a unit; "" if several have it, or none."""
    if speed := known("omega", unit):
        return "omega" if UNITS["omega"][speed] == RPM else ""
    return next((quantity for quantity in ("voltage", "current") if known(quantity, unit)), "")


def _without_lost_letters(parts: list[str]) -> str:
    """The word of a name that lost its letters with accents, as in variables of MATLAB (posici_n); "" for others."""
    if len(parts) < 2 or max(map(len, parts)) == 1:
        return ""
    pattern = re.compile(".".join(map(re.escape, parts)))
    return next((word for word in _LONG if pattern.fullmatch(word)), "")


def _has(parts: list[str], joined: str, known_words: list[str]) -> bool:
    return bool({*parts, joined} & set(known_words))
