# SPDX-License-Identifier: Apache-2.0
"""Does `import` understand tables in other people's habits? Each is imported with --accept and compared with the truth.

    make habits                               40 tables of a judging seed
    make habits ARGS="--count 200 --seed 7"   others
    make habits ARGS="--show 12"              what import says about one of them

right: time, angle and command are those of the rig. asked: import does not use what it is not sure of. refused: it
cannot read the file. wrong: it made a recording that is not that of the rig. Of some tables nobody could know all
without asking (the counts of a turn, the rate of rows without a time, 60 % or 60 of 255): the first share of right
answers is that of the others. Seeds below 1000 are for development.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from aeropend_ident.bags.recording import read
from aeropend_ident.commands.import_table import main as import_table
from evaluation.habits import layouts, tables, weights
from evaluation.habits.tables import Drawn, Truth

JUDGING = 1000
"""First seed that nothing was developed with (a convention)."""

ANGLE_OFF, DUTY_OFF, TIME_OFF = 2e-3, 2e-3, 0.02
"""Greatest differences that are still right: [rad], duty, share of the duration (choices)."""

ROWS = 0.97
"""Least share of the rows that must be right: some may be lost or moved (a choice)."""

RIGHT, ASKED = 0.85, 1.0
"""Least shares that are right without options, and right or asked (the targets of the project)."""


def one(seed: int, number: int, folder: Path) -> tuple[str, str, Drawn]:
    """Make a table, import it; "right", "asked", "refused" or "wrong", what was said, and the table."""
    rng = np.random.default_rng([seed, number])
    made = tables.draw(rng)
    paths = layouts.write(made, folder / "in", rng)
    bag, said = folder / "bag", io.StringIO()
    words = [str(paths[0]), str(bag), "--accept"]
    for path in paths[1:]:
        words += ["--with", str(path)]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = import_table(words)
        except SystemExit as error:
            code = int(error.code or 0)
    text = said.getvalue()
    if code == 0:
        return ("right" if same(bag, made.truth) else "wrong"), text, made
    return ("asked" if "import: nothing imported" in text or "say --" in text else "refused"), text, made


def same(bag: Path, truth: Truth) -> bool:
    """Whether a recording holds what the rig did; the zero and the sign of the angle are free."""
    got = read(bag)
    t, at = got.t - got.t[0], truth.t - truth.t[0]
    if len(t) < ROWS * len(at) or abs(t[-1] - at[-1]) > TIME_OFF * at[-1] or "theta" not in got.channels:
        return False
    near = np.clip(np.searchsorted(at, t - 0.5 * float(np.median(np.diff(at)))), 0, len(at) - 1)
    seen = np.isfinite(got.theta)
    off = got.theta[seen] - truth.theta[near][seen]
    if (np.abs(off - np.median(off)) > ANGLE_OFF).mean() > 1.0 - ROWS:
        return False
    if truth.volts is not None and "v_a" in got.channels:
        return bool((np.abs(got.v_a - truth.volts[near])[seen] > 1e-3).mean() <= 1.0 - ROWS)
    has_duty = "duty" in got.channels or len(got.command) > 0
    if truth.duty is None or not has_duty:
        return truth.duty is None and not has_duty
    return bool((np.abs(got.duty - truth.duty[near])[seen] > DUTY_OFF).mean() <= 1.0 - ROWS)


def main() -> int:
    """Run the check; returns 1 if a target is missed."""
    parser = argparse.ArgumentParser(prog="habits", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=40, help="tables (default 40)")
    parser.add_argument("--seed", type=int, default=JUDGING, help=f"default {JUDGING}")
    parser.add_argument("--show", type=int, metavar="N", help="print what import says about table N")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the files of table N there")
    parser.add_argument("--weights", action="store_true", help="measure the weights of the guesses")
    given = parser.parse_args()
    if given.weights:
        weights.measure(max(given.count, 400))
        return 0
    found: dict[str, list[str]] = defaultdict(list)
    for k in range(given.count) if given.show is None else [given.show]:
        with tempfile.TemporaryDirectory() as folder:
            result, text, made = one(given.seed, k, given.keep or Path(folder))
        if given.show is not None:
            print(text)
        habits = ", ".join(f"{key} {value}" for key, value in made.habits.items())
        if result != "right":
            print(f"{k}: {result}: {habits}" + (f" ({made.truth.asks})" if made.truth.asks else ""))
        found["all"].append(result)
        found["to be known" if not made.truth.asks else "not to be known"].append(result)
        for key, value in made.habits.items():
            found[f"{key}: {value}"].append(result)
    print(f"{'':<28}tables  right  asked refused  wrong")
    for habit, results in sorted(found.items(), key=lambda item: (item[0] != "all", item[0])):
        counts = [results.count(result) for result in ("right", "asked", "refused", "wrong")]
        print(f"{habit:<28}{len(results):6d}" + "".join(f"{count:7d}" for count in counts))
    right = found["to be known"].count("right") / max(len(found["to be known"]), 1)
    good = 1.0 - (found["all"].count("wrong") + found["all"].count("refused")) / len(found["all"])
    of_all = found["all"].count("right") / len(found["all"])
    print(f"right without options, of those to be known: {100.0 * right:.0f} % (at least {100.0 * RIGHT:.0f} %), "
          f"of all: {100.0 * of_all:.0f} %\n"
          f"right or asked: {100.0 * good:.1f} % ({100.0 * ASKED:.0f} %), wrong: {found['all'].count('wrong')}")
    return int(right < RIGHT or good < ASKED)


if __name__ == "__main__":
    raise SystemExit(main())
