# SPDX-License-Identifier: Apache-2.0
"""Bench tests of a rig: `bench_test --blocked-rotor pairs.csv --steady speeds.csv`.

Estimates the parameters of the motor and the propeller from tables or recordings, and writes a model file with the
source of each. Exit code 0 with results, 2 with one line on standard error when the input cannot be used.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from aeropend_ident.bags import recording
from aeropend_ident.bags.recording import Recording
from aeropend_ident.bench_tests import estimates
from aeropend_ident.bench_tests.estimates import BenchTestError, Estimate, Found, Rows
from aeropend_ident.bench_tests.picture import scatter
from aeropend_ident.bench_tests.table import read_rows
from aeropend_ident.result_folder import atomic_folder, ensure_free
from aeropend_ident.signals.from_bag import checked
from aeropend_sim.cli.command import Parser, entry_point
from aeropend_sim.model.parameters import PRESETS, Model, from_flat, load, save

FILES = ("bench.yaml", "bench_tests.json", "bench_tests.svg")

TESTS = {
    "blocked-rotor": "R_a, and from a recording L_a: v_a, i_a with the rotor blocked",
    "current-step": "L_a: t, i_a around a step of the voltage with the rotor blocked",
    "steady": "K_e, K_t, k_load, B_m: v_a, i_a, omega in steady states",
    "duty-map": "k0 to k3: duty, v_a",
    "thrust": "k_thrust: thrust (or theta, from which it is computed), and omega, v_a or duty",
}
"""Test -> its results and its columns. A test uses the results of the tests before it."""

Source = Rows | Recording


def work_out(sources: Mapping[str, Source], base: Model) -> dict[str, Found]:
    """Run bench tests.

    Args:
        sources: test (see `TESTS`) -> a table or a recording.
        base: model with the parameters that no test gives.

    Raises:
        BenchTestError: a source cannot be used.
    """
    found: dict[str, Found] = {}

    def numbers() -> dict[str, float]:
        return {**base.numbers(), **{k: e.value for one in found.values() for k, e in one.numbers.items()}}

    def known(name: str) -> Estimate:
        for one in found.values():
            if name in one.numbers:
                return one.numbers[name]
        return Estimate(base.model[name], 0.0, "", f"of {base.name}")

    def rows(source: Source, *channels: str) -> Rows:
        if isinstance(source, Rows):
            return source
        settled = estimates.plateaus(source, channels, source.path)
        return settled.where(np.flatnonzero(settled.columns["omega"] > 0.0)) if "omega" in channels else settled

    def blocked(source: Source) -> Found:
        if isinstance(source, Rows):
            return estimates.blocked_rotor(source)
        return estimates.blocked_recording(source, source.path)

    def step(source: Source) -> Found:
        if isinstance(source, Rows):
            return estimates.current_step(source, known("R_a"))
        raise BenchTestError(f"{source.path}: give a recording with the rotor blocked to --blocked-rotor, which "
                             "estimates L_a as well")

    run: dict[str, Callable[[Source], Found]] = {
        "blocked-rotor": blocked,
        "current-step": step,
        "steady": lambda s: estimates.steady(rows(s, "v_a", "i_a", "omega"), known("R_a")),
        "duty-map": lambda s: estimates.duty_map(rows(s, "duty", "v_a"), base.model),
        "thrust": lambda s: estimates.thrust_curve(rows(s, "theta", "omega", "v_a"), numbers()),
    }
    for name, test in run.items():
        if name in sources:
            one = test(sources[name])
            found[name] = replace(one, notes=(*sources[name].notes, *one.notes))
    return found


def augmented(base: Model, found: Mapping[str, Found]) -> Model:
    """The base model with the estimated parameters.

    Raises:
        ModelError: a parameter is out of range.
    """
    flat = {f"model.{k}": e.value for one in found.values() for k, e in one.numbers.items()}
    return from_flat(flat, "the result of the bench tests", base)


def provenance(base: Model, found: Mapping[str, Found], command: str) -> str:
    """The source of each parameter of the model file.

    Args:
        base: model with the other parameters.
        found: results of the tests.
        command: the command line.
    """
    lines = [command, ""]
    for test, one in found.items():
        lines += [f"{k} = {value(e)}: {test} of {one.source}, {one.rows} rows, {e.how}" for k, e in one.numbers.items()]
    return "\n".join([*lines, f"all others: {base.name}"])


def value(e: Estimate) -> str:
    """An estimate with its standard deviation and unit, as text."""
    unit = "" if e.unit == "-" else f" {e.unit}"
    return f"{e.value:.5g} ± {e.sigma:.2g}{unit}" if e.sigma > 0.0 else f"{e.value:.5g}{unit}"


def lines(found: Mapping[str, Found]) -> list[str]:
    """The results as text for the terminal."""
    out = []
    for test, one in found.items():
        out.append(f"{test} ({one.source}, {one.rows} rows)")
        for name, e in {**one.numbers, **one.others}.items():
            scatter_ = "" if math.isnan(e.scatter) else f", {e.scatter:.2g} a row"
            out.append(f"  {name} = {value(e)}   ({e.how}{scatter_})")
        if "a of f = a v² + b v + c" in one.others:
            a, b, c = (one.others[f"{k} of f = a v² + b v + c"].value for k in "abc")
            if a > 0.0:
                p, q, r, s = estimates.thrust_to_voltage(a, b, c)
                out.append(f"  inverse: v = {p:.5g} + {q:.5g} sqrt({r:.5g} + {s:.5g} f)")
        out += [f"  note: {note}" for note in one.notes]
    return out


def document(found: Mapping[str, Found]) -> dict[str, object]:
    """The content of `bench_tests.json`."""

    def row(e: Estimate) -> dict[str, object]:
        return {"value": e.value, "sigma": e.sigma, "unit": e.unit, "how": e.how,
                "scatter": None if math.isnan(e.scatter) else e.scatter}

    return {"format": 1, **{test: {"source": one.source, "rows": one.rows, "notes": list(one.notes),
                                   "numbers": {k: row(e) for k, e in one.numbers.items()},
                                   "others": {k: row(e) for k, e in one.others.items()}}
                            for test, one in found.items()}}


EXAMPLES = """tables: CSV with a line of names and units, as in 'v_a [V],i_a [A],omega [rpm]'; quantities: t, v_a, i_a,
omega, duty, thrust, theta. Of a recording (folder, .mcap or .db3) the steady states are used.

examples:
  bench_test --blocked-rotor pairs.csv --steady speeds.csv --out my_bench
  bench_test --blocked-rotor blocked_bag --steady stairs_bag --duty-map stairs_bag --thrust stairs_bag
  bench_test --thrust scale.tsv --columns 'v_a [V],thrust [N]'      a table without a line of names

exit codes: 0 a model was written, 2 the input cannot be used (one line says why), 130 interrupted"""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; exits with 2 and one line where it is wrong."""
    parser = Parser(prog="bench_test", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Estimate the parameters of the motor and the propeller from bench tests.")
    for name, about in TESTS.items():
        parser.add_argument(f"--{name}", metavar="TABLE|BAG", help=about)
    parser.add_argument("--columns", metavar="NAMES", help="names and units of the columns, for tables without a line "
                        "of names")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help="model with the parameters that no test gives: "
                             f"{' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if the bag has several")
    parser.add_argument("--out", default="bench_test", metavar="DIR",
                        help="folder for the results (default: bench_test)")
    parser.add_argument("--overwrite", action="store_true", help="replace results that are already in the folder")
    options = parser.parse_args(arguments)
    if not any(getattr(options, name.replace("-", "_")) for name in TESTS):
        parser.error(f"give at least one test: {', '.join(f'--{name}' for name in TESTS)}")
    return options


def source(path: str, columns: str | None, namespace: str | None, base: Model) -> Source:
    """Read a table, or a recording: a folder, .mcap or .db3.

    Args:
        path: of the table or the recording.
        columns: names and units, for a table without a line of names.
        namespace: of the rig in the recording.
        base: model with the other parameters.

    Raises:
        BenchTestError, RecordingError: it cannot be used.
    """
    if Path(path).is_dir() or Path(path).suffix in {".mcap", ".db3"}:
        read = checked(recording.read(path, namespace), base)
        return replace(read, path=Path(path).name)
    return read_rows(Path(path), columns)


def run(options: argparse.Namespace) -> None:
    """Run the tests and write the results.

    Raises:
        BenchTestError, RecordingError, ModelError, OutputError: the input or the output cannot be used.
    """
    out = Path(options.out)
    ensure_free(out, FILES, overwrite=options.overwrite)
    base = load(options.model)
    given = {name: getattr(options, name.replace("-", "_")) for name in TESTS}
    read = {path: source(path, options.columns, options.namespace, base) for path in set(given.values()) if path}
    found = work_out({name: read[path] for name, path in given.items() if path}, base)
    model = augmented(base, found)
    command = "bench_test " + " ".join(f"--{name} {Path(path).name}" for name, path in given.items() if path)
    with atomic_folder(out, FILES) as place:
        save(model, place / FILES[0], provenance(base, found, command))
        body = json.dumps(document(found), indent=1, ensure_ascii=False, allow_nan=False)
        (place / FILES[1]).write_text(body + "\n", encoding="utf-8", errors="backslashreplace")
        (place / FILES[2]).write_text(scatter([p for one in found.values() for p in one.panels]), encoding="utf-8")
    print("\n".join(lines(found)))
    print("   ".join(str(out / name) for name in FILES))


@entry_point("bench_test")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    run(parse(arguments))
    return 0


if __name__ == "__main__":
    sys.exit(main())
