# SPDX-License-Identifier: Apache-2.0
"""The check-up of a model file: whether it loads, and whether its values are those of a rig."""

from __future__ import annotations

from collections.abc import Iterator

from aeropend_ident.checkup.check import Check, error, ok, warning
from aeropend_sim.model.parameters import PARAMETERS, PRESETS, Model, ModelError, load, to_flat
from aeropend_sim.wording import counted

SAME_MOTOR = 2.0
"""Factor between K_t and K_e from which one of them has another unit (derived: in SI units they are equal)."""

AT_END = 1e-6
"""Share of a limit within which a value is at it (derived: a bounded fit stops there)."""


def checks(source: str) -> Iterator[Check]:
    """All findings.

    Args:
        source: a model file or a preset.
    """
    try:
        model = load(source)
    except ModelError as refused:
        yield error(source, str(refused).removeprefix(f"{source}: "))
        return
    count = counted(len(model.effects), "effect")
    yield ok(source, f"a model with {count}{': ' if model.effects else ''}{', '.join(model.effects)}")
    yield from _limits(source, model)
    numbers = model.numbers()
    ratio = numbers["K_t"] / numbers["K_e"]
    if not 1.0 / SAME_MOTOR < ratio < SAME_MOTOR:
        yield warning(source, f"K_t is {ratio:.2g} times K_e, in SI units they are equal: check the unit of both")
    if not any(model.sensing.values()):
        yield warning(source, "the measurement chain has no noise and no resolution: every misfit counts as an "
                      "effect; state them in the section sensing")


def _limits(source: str, model: Model) -> Iterator[Check]:
    """Values at the limit of their range, apart from 0, which means none, and from 1 for a bridge that reverses."""
    for name, value in to_flat(model).items():
        p = PARAMETERS.get(name)
        at_end = p is not None and any(abs(value - end) <= AT_END * abs(end) for end in (p.low, p.high))
        if p is not None and value != 0.0 and at_end and name != "model.reverse":
            yield warning(source, f"{name} = {value:g} is at the limit of its range, {p.low:g} to {p.high:g}: "
                          "a fit did not determine it")


def is_model(source: str) -> bool:
    """Whether a name is that of a model file or a preset, not of a recording."""
    return source in PRESETS or source.endswith((".yaml", ".yml"))
