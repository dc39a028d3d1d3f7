# SPDX-License-Identifier: Apache-2.0
"""Sparse identification of a recording: `identify BAG --method weak`.

Exit code 0 with equations, 2 with one line on standard error when the input cannot be used.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from aeropend_ident.bags import recording
from aeropend_ident.identification import dataset, picture
from aeropend_ident.identification.dataset import Dataset
from aeropend_ident.identification.discrepancy import nominal
from aeropend_ident.identification.identify import METHODS, Identified, identify_with_traces
from aeropend_ident.identification.output_error_selection import STABLE
from aeropend_ident.identification.sindy import DERIVATIVES
from aeropend_ident.result_folder import atomic_folder, ensure_free, folder_names
from aeropend_ident.signals.from_bag import checked
from aeropend_sim.cli.command import Parser, between, entry_point
from aeropend_sim.cli.progress import progress
from aeropend_sim.model.parameters import PRESETS, load

FORMAT = 1
FILES = ("identified.json", "identified.svg")

EXAMPLES = """examples:
  identify my_bag --method weak                             the equations of a rig, from its recording
  identify my_bag --method discrepancy-weak --model thesis  the terms that a model is missing
  identify my_bag --terms 'sin(theta),theta_dot,omega^1.8,i_a,omega,v_a'     your own candidate terms

exit codes: 0 equations were written, 2 the input cannot be used (one line says why), 130 interrupted"""


def document(found: Identified, data: Dataset, bag: str, model: str, seconds: float) -> dict[str, object]:
    """The content of `identified.json`.

    Args:
        found: the equations.
        data: the dataset that they were identified from.
        bag: path of the recording.
        model: preset or path of the model file.
        seconds: [s] run time of the command.
    """
    return {"format": FORMAT, "method": found.method, "terms": list(found.terms), "equations": found.equations,
            "sigma": {state: {term: sd if math.isfinite(sd) else None for term, sd in terms.items()}
                      for state, terms in found.sigma.items()},
            "held_out_mse": found.held_out_mse, "seconds": round(seconds, 2), "bag": bag, "model": model,
            "states": list(data.states), "inputs": list(data.inputs),
            "duration_s": round(len(data) * data.period, 3), "samples": len(data),
            "train_s": [0.0, round(data.train * data.period, 3)],
            "held_out_s": [round(data.train * data.period, 3), round(len(data) * data.period, 3)],
            "stability": found.stability,
            "undetermined": [{"equation": a.equation, "term": a.term, "or": a.instead, "worse": round(a.worse, 2)}
                             for a in found.alternatives]
            + [{"equation": s, "term": t, "stability": often} for s, terms in found.stability.items()
               for t, often in terms.items() if often < STABLE]
            + [{"equation": s, "term": t, "stability": often, "left_out": True} for s, t, often in found.unstable],
            "free_run": {c: {"gap": r.gap, "floor": r.floor} for c, r in found.free_run.items()},
            "shots": found.shots, "notes": list(found.notes)}


def lines(found: Identified) -> list[str]:
    """The equations as text for the terminal."""
    out = [f"note: {note}" for note in found.notes]
    out += [f"note: d({s})/dt: {term} is left out: only {100.0 * often:.0f} % of resamples of the recording choose it"
            for s, term, often in found.unstable]
    discrepancy = found.method.startswith("discrepancy")
    for s, equation in found.equations.items():
        own = [term for term in equation if term not in found.terms]  # by the definition of a state
        ordered = sorted(equation, key=[*own, *found.terms].index)
        text = " ".join(_term(found, s, term) for term in ordered).removeprefix("+ ")
        out.append(f"to add to d({s})/dt: {text or 'nothing'}" if discrepancy else f"d({s})/dt = {text or '0'}")
    for channel, run in found.free_run.items():
        out.append(f"free run on held-out data, {channel}: RMS {run.gap:.3g}, noise {run.floor:.3g} "
                   f"({run.gap / run.floor:.2f} times)")
    return out


def _term(found: Identified, state: str, term: str) -> str:
    """One term of an equation with its sign, coefficient and doubts."""
    c, sd = found.equations[state][term], found.sigma[state][term]
    rivals = [a.instead for a in found.alternatives if (a.equation, a.term) == (state, term)]
    doubts = [f"or {', '.join(rivals)}"] if rivals else []
    often = found.stability.get(state, {}).get(term, 1.0)
    doubts += ["the recording does not show it"] if math.isinf(sd) else []
    doubts += [f"in {100.0 * often:.0f} % of resamples"] if often < STABLE else []
    shown = f"{term} [undetermined: {'; '.join(doubts)}]" if doubts else term
    name = " constant" if term == "1" else f" {shown}"
    size = f"{abs(c):.6g}" if sd == 0.0 or math.isinf(sd) else f"({abs(c):.6g} ± {sd:.2g})"
    return ("- " if c < 0.0 else "+ ") + size + name


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; exits with 2 and one line where it is wrong."""
    parser = Parser(prog="identify", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Find sparse equations of motion in a recording, or the terms that a model is missing.")
    parser.add_argument("bag", metavar="BAG", help="a recording (folder, .mcap or .db3)")
    parser.add_argument("--method", choices=METHODS, default="weak", help="default: weak")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help="model with the measurement chain of the recording; the discrepancy methods add terms to "
                             f"its equations: {' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--states", default=",".join(dataset.STATES), metavar="NAMES",
                        help=f"states, separated by commas (default: {','.join(dataset.STATES)})")
    parser.add_argument("--input", default="v_a", metavar="NAMES", help="inputs, separated by commas (default: v_a)")
    parser.add_argument("--terms", metavar="TERMS", help="candidate terms, separated by commas (default: the library "
                        "of the thesis: 1, all variables, their products of two, their sin and cos)")
    parser.add_argument("--derivative", choices=DERIVATIVES, default="smoothed",
                        help="how the SINDy methods take derivatives (default: smoothed)")
    parser.add_argument("--out", metavar="DIR", help="folder for the results (default: identified_<name of the bag>)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if the bag has several")
    parser.add_argument("--held-out", type=between(0.05, 0.8, "a share"), default=0.25, metavar="SHARE",
                        help="share at the end that is kept for testing (default: 0.25)")
    parser.add_argument("--overwrite", action="store_true", help="replace results that are already in the folder")
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """Identify and write the results.

    Raises:
        RecordingError, ModelError, OutputError, TermError: the input or the output cannot be used.
    """
    started = time.monotonic()
    out = Path(options.out or f"identified_{folder_names([options.bag])[0]}")
    ensure_free(out, FILES, overwrite=options.overwrite)
    model = load(options.model)
    known = nominal(model) if options.method.startswith("discrepancy") else None
    with progress("reading") as show:
        read = checked(recording.read(options.bag, options.namespace), model)
        data = dataset.from_bag(read, model.sensing, _listed(options.states), _listed(options.input), options.held_out)
        found, traces = identify_with_traces(data, options.method,
                                             None if options.terms is None else _listed(options.terms), known,
                                             options.derivative, show)
    body = document(found, data, options.bag, options.model, time.monotonic() - started)
    late = slice(data.train, None) if data.train < len(data) else slice(None)
    drawn = picture.draw(found.method, data.states, late.start or 0, data.period, data.values[late],
                         traces.measured[late], traces.modelled[late],
                         None if traces.free_run is None else traces.free_run[late])
    with atomic_folder(out, FILES) as place:
        (place / FILES[0]).write_text(json.dumps(body, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        (place / FILES[1]).write_text(drawn, encoding="utf-8")
    print("\n".join(lines(found)))
    print(f"{out / FILES[0]}   {out / FILES[1]}   {body['seconds']} s")


def _listed(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


@entry_point("identify")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    run(parse(arguments))
    return 0


if __name__ == "__main__":
    sys.exit(main())
