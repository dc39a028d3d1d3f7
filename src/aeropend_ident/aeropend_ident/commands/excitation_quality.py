# SPDX-License-Identifier: Apache-2.0
"""The command `excitation_quality`: how well an input excites a rig.

A planned signal of `excite`, before it is recorded, or a recording.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

from aeropend_ident.bags import recording
from aeropend_ident.identification import dataset
from aeropend_ident.identification.excitation_quality import planned, quality
from aeropend_ident.signals.from_bag import checked
from aeropend_sim.cli.command import EXIT_CODES, Parser, as_seed, entry_point, given
from aeropend_sim.cli.progress import progress
from aeropend_sim.model.excitation import KINDS, Excitation
from aeropend_sim.model.parameters import PRESETS, load
from aeropend_sim.untrusted import printable
from aeropend_sim.wording import enumerated

EXAMPLES = f"""examples:
  excitation_quality --duration 20 --duty-max 0.3        a signal of `excite`, before it is recorded
  excitation_quality --kind steps --model my_rig.yaml
  excitation_quality my_bag                              a recording

{EXIT_CODES}"""

SIGNAL = {"duration": "length, s", "duty_min": "least duty", "duty_max": "greatest duty",
          "hold_min": "shortest hold, s", "hold_max": "longest hold, s", "rest": "duty 0 between the holds, s"}


@entry_point("excitation_quality")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = Parser(prog="excitation_quality", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="How well a planned or recorded input excites each term.")
    parser.add_argument("bag", nargs="?", metavar="BAG",
                        help="a recording; without it, a planned signal of `excite` is tested")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help=f"{' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if the bag has several")
    plan = Excitation()
    parser.add_argument("--kind", choices=KINDS, help=f"kind of the signal, as in `excite`; default {plan.kind}")
    for name, meaning in SIGNAL.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, metavar="X",
                            help=f"{meaning}; default {getattr(plan, name)}")
    parser.add_argument("--seed", type=as_seed, help=f"seed of the signal and of the noise; default {plan.seed}")
    options = parser.parse_args(arguments)
    names = ("kind", *SIGNAL, "seed")
    if options.bag and (words := given(options, names)):
        parser.error(f"a bag has its own duty: leave {enumerated(words)} out")
    if options.namespace and not options.bag:
        parser.error("--namespace tells the rigs of a recording apart: name a BAG, or leave it out")
    model = load(options.model)
    with progress("reading") as show:
        if options.bag:
            read = checked(recording.read(options.bag, options.namespace), model)
            data = dataset.from_bag(read, model.sensing, held_out=0.0)
        else:
            signal = Excitation(**{k: v for k in names if (v := getattr(options, k)) is not None})
            data = planned(model, signal.series(), seed=signal.seed)
        found = quality(model, data, show)
    for note in data.notes:
        print(printable(f"note: {note}"))
    for one in found:
        remark = "poorly excited" if one.poor else ""
        if one.rivals:
            remark = f"cannot be distinguished from {', '.join(one.rivals)}"
        share = 100.0 * one.sigma / abs(one.value)
        known = f"known to {share:8.3g} %" if math.isfinite(share) else f"{'not shown by it':19}"
        print(f"d({one.equation})/dt  {one.term:18} {one.value:12.6g}  {known}  {remark}".rstrip())
    poor = sum(one.poor for one in found)
    print(f"{poor} of {len(found)} terms would stay undetermined" if poor else "every term is excited")
    return 0


if __name__ == "__main__":
    sys.exit(main())
