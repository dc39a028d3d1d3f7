# SPDX-License-Identifier: Apache-2.0
"""Each control law against every effect of the catalogue at its default size.

The table shows how an effect changes the steps, and how much of that is left when the law's model names the effect.

`python -m evaluation.control_table [LAW ...] [--effects EFFECT ...] [--diagnosed]` prints the tables. With
`--diagnosed` the model is not the true one but what `diagnose` makes of a recording of that rig.
"""

from __future__ import annotations

import argparse
import math
import sys
from functools import cache
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from aeropend_control.analysis import closed_loop
from aeropend_control.analysis.step_response import step_responses
from aeropend_control.laws.registry import LAWS
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.testing.rigs import BENCH, drawn_rig, recorded
from aeropend_sim.cli.command import EXIT_CODES, Parser, entry_point
from aeropend_sim.cli.progress import Show, nothing, progress
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH
from aeropend_sim.model.parameters import Model
from aeropend_sim.model.rig import Rig

EFFECTS: dict[str, dict[str, float]] = {
    **{id_: {name: p.default for name, p in effect.parameters.items()} for id_, effect in CATALOGUE.items()},
    PARAMETER_MISMATCH: {"L_over_J": 1.05 * BENCH.model["L_over_J"]}}
"""Every effect at its default size."""

STEPS = {"theta": ((0.2, 0.4, 0.7), 4.0), "omega": ((60.0, 99.5, 140.0), 2.0)}
"""Levels (rad, rad/s) and s for which each is held, the first from rest."""

EXAMPLES = f"""examples:
  python -m evaluation.control_table
  python -m evaluation.control_table cascade --effects gust brush_drop --diagnosed

{EXIT_CODES}"""

SEED = 7
RECORDED_S = 30.0

RESTLESS = 0.05
"""A loop that still moves by this share of the smallest step, peak to peak, in the last fifth of a hold is restless."""

COUNTS = (0.05, 0.01)
"""Excess of t_s (share of the nominal one) and of M_p that counts as one."""


class Figures(NamedTuple):
    """Means over the steps, of the true angle or speed: t_s in s, M_p as a share; worst error at the end and swing."""

    t_s: float
    M_p: float
    e_ss: float
    swing: float


def figures(law_name: str, model: Model, rig: Model) -> Figures:
    """What a law made and tuned for a model does on a rig."""
    kind = LAWS[law_name]
    levels, hold = STEPS[kind.measures]
    law = kind.make(model, kind.tune(model))
    run = closed_loop.run(law, Rig(rig, SEED), closed_loop.staircase(levels, hold))
    true = run.truth[kind.measures]
    steps = step_responses(run.time, true, run.reference, 0.06 if kind.measures == "theta" else 0.0)
    t_s = [hold if math.isnan(s.settling_time) else s.settling_time for s in steps]
    ends = [part[-len(part) // 5:] for part in np.split(true, len(levels))]
    return Figures(float(np.mean(t_s)), float(np.mean([s.overshoot for s in steps])),
                   max((s.steady_state_error for s in steps), key=abs), max(float(np.ptp(end)) for end in ends))


@cache
def models(effect: str, diagnosed: bool) -> tuple[Model, Model]:
    """The rig with an effect, and the model that names it."""
    if not diagnosed:
        rig = BENCH.with_effects({effect: EFFECTS[effect]})
        return rig, rig
    seed = list(EFFECTS).index(effect)
    effects = {effect: {} if effect in CATALOGUE else EFFECTS[effect]}
    return drawn_rig(seed, effects), diagnose(BENCH, [recorded(seed, effects, RECORDED_S)], 2).augmented


def table(law_name: str, effects: list[str], diagnosed: bool, show: Show = nothing) -> Table:
    """One row an effect; the caption says what the compensation takes of the excess over the nominal figures."""
    kind = LAWS[law_name]
    levels, hold = STEPS[kind.measures]
    unit, scale = ("mrad", 1e3) if kind.measures == "theta" else ("rad/s", 1.0)
    out = Table(title=f"{law_name}: steps to {', '.join(f'{level:g}' for level in levels)} {kind.reference_unit}, "
                f"{hold:g} s each; without -> with a model that names the effect")
    for name in ("effect", "t_s / s", "M_p / %", f"worst e_ss / {unit}", f"still swings / {unit}"):
        out.add_column(name, justify="left" if name == "effect" else "right", no_wrap=True)
    nominal = figures(law_name, BENCH, BENCH)
    restless = RESTLESS * levels[0]

    def swing(f: Figures) -> str:
        text = f"{scale * f.swing:.1f}"
        return f"[bold red]{text} ![/]" if f.swing > restless else text

    out.add_row("none", f"{nominal.t_s:.2f}", f"{100 * nominal.M_p:.1f}", f"{scale * nominal.e_ss:.1f}", swing(nominal))
    excess: tuple[list[tuple[float, float]], ...] = ([], [])
    for number, effect in enumerate(effects):
        show(number, f"{law_name}, {effect}")
        rig, model = models(effect, diagnosed)
        a, b = figures(law_name, BENCH, rig), figures(law_name, model, rig)
        out.add_row(effect, f"{a.t_s:.2f} -> {b.t_s:.2f}", f"{100 * a.M_p:.1f} -> {100 * b.M_p:.1f}",
                    f"{scale * a.e_ss:.1f} -> {scale * b.e_ss:.1f}", f"{swing(a)} -> {swing(b)}")
        for j, least in enumerate((COUNTS[0] * nominal.t_s, COUNTS[1])):
            if a[j] - nominal[j] > least:
                excess[j].append((a[j] - nominal[j], max(0.0, b[j] - nominal[j])))
    said = [f"{name}: {len(e)} effects exceed, the median keeps {np.median([b / a for a, b in e]):.0%} of it"
            if e else f"{name}: no effect exceeds" for name, e in zip(("t_s", "M_p"), excess, strict=True)]
    out.caption = f"excess over nominal; {'; '.join(said)}; !: does not come to rest"
    return out


@entry_point("control_table")
def main() -> int:
    """The command; returns its exit code."""
    parser = Parser(prog="control_table", description=(__doc__ or "").partition("\n\n")[0], epilog=EXAMPLES,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("laws", nargs="*", metavar="LAW", help=f"of {', '.join(LAWS)}; default: all")
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS), metavar="EFFECT", help="default: all")
    parser.add_argument("--diagnosed", action="store_true", help="compensate by the model that diagnose finds")
    chosen = parser.parse_args()
    for what, names, known in (("law", chosen.laws, LAWS), ("effect", chosen.effects, EFFECTS)):
        if unknown := [name for name in names if name not in known]:
            print(f"control_table: no {what} {unknown[0]}; known: {', '.join(known)}", file=sys.stderr)
            return 2
    for law_name in chosen.laws or LAWS:
        with progress(law_name, len(chosen.effects)) as show:
            shown = table(law_name, chosen.effects, chosen.diagnosed, show)
        Console(width=120).print(shown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
