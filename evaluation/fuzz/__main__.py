# SPDX-License-Identifier: Apache-2.0
"""Give the commands that read a recording recordings with arbitrary values: `make fuzz` (ARGS="--minutes 2").

Each case is a recording of a simulated rig whose values, stamps, names and topics were changed at random, and a random
command line. A run fails if it shows a traceback, a warning of numpy or NaN, if it crashes, does not end, leaves a
result that cannot be read, or refuses a recording with anything but one line. What was found is written as JSON to
fuzz-results/.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from datetime import datetime, timezone
from pathlib import Path

from aeropend_sim.cli.command import Parser
from evaluation import results
from evaluation.fuzz import one
from evaluation.fuzz.command_lines import COMMANDS, prepare
from evaluation.fuzz.outcome import judge
from evaluation.support.graph import isolate

RESULTS = results.ROOT / "fuzz-results"
MINUTES = 10.0
PATIENCE_S = 600.0
"""Time after which a run is said not to end, s (choice: no command needs more than a minute for these recordings)."""
CASES_PER_SEED = 1_000_000

EXAMPLES = """examples:
  make fuzz
  make fuzz ARGS="--command import --minutes 10 --seed 1"
  make fuzz ARGS="--command import --case 1000047"       one case again, with all that it prints

exit codes: 0 no run failed, 1 a run failed, 2 a wrong command line, 130 interrupted"""


def tried(command: str, seed: int, files: Path, loud: bool = False) -> dict[str, object]:
    """One case: its seed, arguments and exit code, the line that it ended with, and what was wrong."""
    with tempfile.TemporaryDirectory(prefix="aeropend_fuzz_case_") as name:
        folder = Path(name)
        outcome, words, story = one.run(command, seed, folder, files, PATIENCE_S)
        wrong = judge(command, outcome, folder)
    if loud:
        print("\n".join(story), " ".join([command, *words]), outcome.stdout + outcome.stderr, sep="\n")
    return {"case": seed, "arguments": words, "recordings": story, "code": outcome.code,
            "said": outcome.first[:500], "wrong": wrong}


def failure(command: str, run: dict[str, object]) -> str:
    """A run that failed, for people at a terminal."""
    wrong = "\n".join(str(line)[-3000:] for line in run["wrong"])  # type: ignore[attr-defined]
    return f"--- {command} --case {run['case']}: {json.dumps(run['arguments'], ensure_ascii=False)}\n{wrong}\n"


def fuzz(command: str, minutes: float, seed: int, files: Path) -> dict[str, object]:
    """Run cases of a command until the time is over; returns what is written of them."""
    begun, number, runs = time.monotonic(), seed * CASES_PER_SEED, []
    while not runs or time.monotonic() - begun < 60.0 * minutes:
        number += 1
        runs.append(tried(command, number, files))
        if runs[-1]["wrong"]:
            print(failure(command, runs[-1]), flush=True)
    failed = [run for run in runs if run["wrong"]]
    codes = Counter(str(run["code"]) for run in runs)
    said = ", ".join(f"{count} with exit code {code}" for code, count in sorted(codes.items()))
    took = round((time.monotonic() - begun) / 60.0, 1)
    print(f"{command}: {len(runs)} runs in {took} minutes, {len(failed)} failed; {said}", flush=True)
    return {"runs": len(runs), "minutes": took, "codes": codes, "failed": failed,
            "said": Counter(str(run["said"]) for run in runs)}


def main() -> int:
    """Run what the command line asks for."""
    parser = Parser(prog="fuzz", description=(__doc__ or "").partition("\n")[0], epilog=EXAMPLES,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--command", nargs="+", choices=COMMANDS, default=list(COMMANDS), metavar="COMMAND",
                        help=f"which of {', '.join(COMMANDS)}; default all")
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"for each command, default {MINUTES:g}")
    parser.add_argument("--seed", type=int, default=1, help="of all that is drawn, default 1")
    parser.add_argument("--case", type=int, metavar="NUMBER", help="only this case, as a failure names it")
    options = parser.parse_args()
    if not 0.0 < options.minutes <= 1e5:
        parser.error("--minutes: give more than 0")
    isolate()
    found: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory(prefix="aeropend_fuzz_") as name:
        files = Path(name)
        prepare(files)
        for command in options.command:
            COMMANDS[command].load(files)
            if options.case is not None:
                run = tried(command, options.case, files, loud=True)
                print(failure(command, run) if run["wrong"] else f"{command}: nothing is wrong")
                found[command] = {"failed": run["wrong"]}
            else:
                found[command] = fuzz(command, options.minutes, options.seed, files)
    failed = any(of["failed"] for of in found.values())
    if options.case is None:
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        path = results.write({"format": 1, "date": date, "seed": options.seed, "commands": found,
                              "machine": results.machine(("rosbags", "numpy"))}, RESULTS)
        print(f"written to {path} and latest.json beside it")
    return int(failed)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
