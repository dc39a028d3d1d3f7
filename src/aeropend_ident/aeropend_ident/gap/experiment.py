# SPDX-License-Identifier: Apache-2.0
"""Which experiment would tell two hypotheses apart that a recording cannot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from aeropend_ident.gap.shrink import free_run
from aeropend_ident.gap.signals import CHANNELS, Signals
from aeropend_sim.excitation import Excitation
from aeropend_sim.parameters import SAMPLE_PERIOD, Model

EXPERIMENTS = (
    Excitation("latin_hypercube", 60.0, duty_max=0.6),
    Excitation("latin_hypercube", 60.0, duty_max=0.25),
    Excitation("staircase", 60.0, duty_max=0.6),
    Excitation("steps", 60.0, hold_max=5.0),
    Excitation("multisine", 60.0, duty_max=0.5),
    Excitation("free_decay", 60.0, duty=0.55, hold_max=4.0, rest=8.0),
    Excitation("hold", 60.0, duty=0.45),
)
"""What is tried, as `excite` would run it."""

VISIBLE = 0.5
"""RMS difference, in units of a reading's noise, from which on a minute of data tells two hypotheses apart."""


def next_experiment(model: Model, signals: Signals, first: Mapping[str, float], second: Mapping[str, float],
                    names: tuple[str, str]) -> dict[str, object]:
    """Choose the duty signal on which two fitted hypotheses differ most.

    Args:
        model: the nominal model. signals: the recording that does not tell them apart (its noise is taken).
        first, second: the numbers and effects of each, fitted to the recording.
        names: what they are called.

    Returns:
        `why` in words, and `excite`: parameters of that node, empty where nothing helps (contract section 5).
    """
    scored = [(_difference(model, signals, first, second, e), e) for e in EXPERIMENTS]
    (difference, channel), best = max(scored, key=lambda s: s[0][0])
    pair = f"{names[0]} and {names[1]}"
    if difference < VISIBLE:
        return {"why": f"{pair} give the same readings under every signal tried; "
                       "measure one of them directly, or state the numbers of the model more precisely", "excite": {}}
    default = asdict(Excitation(best.kind))
    chosen = {k: v for k, v in asdict(best).items() if k in ("kind", "duration") or v != default[k]}
    return {"why": f"{pair} differ there by {difference:.1f} times the noise of {channel}", "excite": chosen}


def _difference(model: Model, signals: Signals, first: Mapping[str, float], second: Mapping[str, float],
                excitation: Excitation) -> tuple[float, str]:
    duty = excitation.series()
    nothing = np.full(len(duty), np.nan)
    planned = replace(signals, period=SAMPLE_PERIOD, duty=duty, theta=nothing, omega=nothing, i_a=nothing, v_a=nothing,
                      pulses=None, false_speed=np.zeros(len(duty), dtype=bool), train=len(duty))
    a, b = (free_run(model, planned, {k: v for k, v in values.items() if not k.startswith("initial.")})
            for values in (first, second))
    noise = {**signals.sigma, "omega": max(signals.sigma["omega"], 0.1)}
    return max((float(np.sqrt(np.mean((a[c] - b[c]) ** 2))) / noise[c], c) for c in CHANNELS if signals.has(c))
