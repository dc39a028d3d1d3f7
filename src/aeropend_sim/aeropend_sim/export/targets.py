# SPDX-License-Identifier: Apache-2.0
"""A model as a Python module and as C files."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from aeropend_sim.export import c_source, python_source
from aeropend_sim.export.plant_step import FUNCTIONS, Outputs
from aeropend_sim.export.program import build, in_comment
from aeropend_sim.export.specialise import fields
from aeropend_sim.model import actuator
from aeropend_sim.model.effects import DEFINED, PARAMETER_MISMATCH
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

MODULE = "aeropend_model"
"""Name of the files of each target."""

UNITS = {"theta": "rad", "theta_dot": "rad/s", "omega": "rad/s", "i_a": "A", "v_a": "V", "thrust": "N",
         "theta_read": "rad", "i_a_read": "A", "v_a_read": "V"}
"""Unit of each output."""

MEANINGS = {
    "theta": "angle of the arm from hanging", "theta_dot": "its rate", "omega": "speed of the rotor",
    "i_a": "armature current", "v_a": "voltage at the motor's terminals", "thrust": "thrust, before ground and inflow",
    "theta_read": "reading of the angle, with filter and errors", "i_a_read": "reading of the current",
    "v_a_read": "reading of the voltage"}
"""Meaning of each output."""


@dataclass(frozen=True)
class Missing:
    """Something of a model that a target does not hold.

    Attributes:
        name: effect or property.
        why: the reason, and what to do if there is something.
    """

    name: str
    why: str

    def __str__(self) -> str:
        return f"{self.name}: {self.why}"


SENSORS = Missing("sensor noise, resolution and pulse timing", "readings are smooth; only the node plant has them")
SPIKES = Missing("speed_spikes", "false readings of chance; only the node plant has them")
EARLY = Missing("command_delay", "it is below 0, and a simulator does not know the next duty; 0 is taken")


def missing(model: Model) -> list[Missing]:
    """What the Python, C and FMU targets do not hold of a model."""
    found = [SENSORS]
    if "speed_spikes" in model.effects:
        found.append(SPIKES)
    if model.effect("command_delay", "delay") < 0.0:
        found.append(EARLY)
    return found


def causal(model: Model) -> Model:
    """The model without a delay below 0."""
    if model.effect("command_delay", "delay") >= 0.0:
        return model
    return model.with_effects({id_: p for id_, p in model.effects.items() if id_ != "command_delay"})


def described(model: Model) -> list[str]:
    """Lines that say what a file was made from."""
    lines = [f"The aeropendulum's model {in_comment(model.name)}, written by aeropend's command export."]
    for id_, parameters in model.effects.items():
        numbers = ", ".join(f"{name} = {value:g}" for name, value in parameters.items())
        physics = "" if id_ == PARAMETER_MISMATCH else DEFINED[id_].physics
        what = f": {physics}" if physics else ""
        lines.append(in_comment(f"effect {id_} ({numbers}){what}"))
    return [*lines, *(f"not in it: {each}" for each in missing(model))]


def late_samples(model: Model, period: float) -> tuple[int, bool]:
    """Whole samples by which the duty acts late, and whether it changes within a sample."""
    whole, part = actuator.delay(causal(model).effects, period)
    return whole, part > 0.0


def python_module(model: Model, period: float = SAMPLE_PERIOD, more: Sequence[Any] = ()) -> str:
    """A Python module that simulates a model with the standard library alone.

    Args:
        model: parameters and effects.
        period: [s] time between samples.
        more: further functions of `plant_step` that it shall have.
    """
    whole, part = late_samples(model, period)
    program = build(causal(model), period, library_sine=True, functions=(*FUNCTIONS, *more))
    doc = "\n".join(textwrap.fill(line, 110) for line in described(model))
    return f'''# SPDX-License-Identifier: Apache-2.0
"""{doc}

    model = Model()
    for duty in duties:
        outputs = model.step(duty)
"""

{python_source.source(program)}

PERIOD = {period!r}  # s, time between samples
DELAY = {whole}  # samples by which a duty acts late
SPLIT = {part}  # whether it changes within a sample


class Model:
    """The simulated rig, which starts at rest with the motor off.

    Args:
        theta: [rad] angle of the arm at the start.
    """

    def __init__(self, theta: float = 0.0):
        self.rig = begin(theta)
        self._late = [0.0] * (DELAY + 1)

    def step(self, duty: float, noise: float = 0.0):
        """What the rig shows while it takes a duty (0 to 1), and then one period on.

        Args:
            duty: it acts from now on.
            noise: a standard normal number, for the effect gust; else without effect.
        """
        self._late.append(duty)
        before, acts = self._late[0], self._late[1]
        seen = outputs(self.rig, before if SPLIT else acts)
        self.rig = self.next(acts, before, noise)
        del self._late[0]
        return seen

    def next(self, duty, before, noise):
        """The rig after one period."""
        return next_sample(self.rig, duty, before, noise)
'''


def c_files(model: Model, period: float = SAMPLE_PERIOD) -> dict[str, str]:
    """C files that simulate a model with the standard library alone, by name.

    Args:
        model: parameters and effects.
        period: [s] time between samples.
    """
    whole, part = late_samples(model, period)
    program = build(causal(model), period)
    comment = " *\n".join(f" * {each}\n" for line in described(model) for each in textwrap.wrap(line, 110))
    kinds = program.tuples()
    outputs = next(k for k in kinds if k is Outputs)
    public = [k for k in kinds if k.__name__ in ("State", "Rig")]
    inner = [k for k in kinds if any(k in _within(p) for p in public)]
    shown = [k for k in kinds if k in inner or k in public]
    rows = "".join(f"    double {name}; /* [{UNITS[name]}] {MEANINGS[name]} */\n" for name in fields(outputs))
    header = f'''/* SPDX-License-Identifier: Apache-2.0 */
/*
{comment} */
#ifndef AEROPEND_MODEL_H
#define AEROPEND_MODEL_H

#define AEROPEND_PERIOD {period!r} /* s, time between samples */
#define AEROPEND_DELAY {whole} /* samples by which a duty acts late */

{c_source.structures(shown)}
typedef struct {{
{rows}}} Outputs;

/* A simulated rig; its members are not for the user. */
typedef struct {{
    Rig rig;
    double late[AEROPEND_DELAY + 1];
    int oldest;
}} aeropend;

/* At rest at an angle (rad), motor off. */
void aeropend_begin(aeropend *model, double theta);

/* What the rig shows while it takes a duty, 0 to 1. */
Outputs aeropend_read(const aeropend *model, double duty);

/* One period on. noise: a standard normal number, for the effect gust; else without effect. */
void aeropend_advance(aeropend *model, double duty, double noise);

#endif
'''
    hidden = [k for k in kinds if k not in shown and k is not outputs]
    source = f'''/* SPDX-License-Identifier: Apache-2.0 */
/* C99: cc -O2 -c {MODULE}.c; do not use -ffast-math. {MODULE}.h says what it holds. */
#include "{MODULE}.h"

#include <math.h>

{c_source.structures(hidden)}
{c_source.functions(program)}
void aeropend_begin(aeropend *model, double theta)
{{
    int k;
    model->rig = begin(theta);
    model->oldest = 0;
    for (k = 0; k <= AEROPEND_DELAY; k++)
        model->late[k] = 0.0;
}}

/* The duty that acts: that of now if there is no delay. */
static double acting_duty(const aeropend *model, double duty)
{{
    return AEROPEND_DELAY > 0 ? model->late[(model->oldest + 1) % (AEROPEND_DELAY + 1)] : duty;
}}

Outputs aeropend_read(const aeropend *model, double duty)
{{
    return outputs(model->rig, {"model->late[model->oldest]" if part else "acting_duty(model, duty)"});
}}

void aeropend_advance(aeropend *model, double duty, double noise)
{{
    model->rig = next_sample(model->rig, acting_duty(model, duty), model->late[model->oldest], noise);
    model->late[model->oldest] = duty;
    model->oldest = (model->oldest + 1) % (AEROPEND_DELAY + 1);
}}
'''
    return {f"{MODULE}.h": header, f"{MODULE}.c": source}


def _within(kind: object) -> list[object]:
    """The types that a tuple holds, and theirs."""
    found = []
    for each in fields(kind).values():
        if each not in (float, int, bool):
            found += [each, *_within(each)]
    return found


