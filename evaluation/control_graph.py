# SPDX-License-Identifier: Apache-2.0
"""Every law through the real graph: a plant, the law's node and `step_test` as processes, at the sample rate.

`python -m evaluation.control_graph [LAW ...]` prints one table; exit code 0 when every limit is kept, 1 when one is
not.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console

from aeropend_control.analysis import step_report
from aeropend_control.analysis.step_response import StepResponse
from aeropend_control.laws.registry import LAWS
from evaluation.support.graph import Process, isolate, parameters


class FailedError(RuntimeError):
    """A process ended by an error; the message is what it said."""


def measured(law: str, model: str, hold: float) -> dict[str, Any]:
    """What `step_test` writes of a law on a plant of the same model, both in processes of their own."""
    with tempfile.TemporaryDirectory(prefix="aeropend_steps_") as folder:
        plant, controller = Process("plant", *parameters(preset=model)), Process(law, *parameters(model=model))
        try:
            test = Process("step_test", "--law", law, "--hold", f"{hold:g}", "--out", folder)
            if test.wait(120.0 + 3.0 * hold) != 0:
                raise FailedError(f"step_test of {law}: {test.output.strip().splitlines()[-1]}")
        finally:
            controller.stop()
            plant.stop()
        if controller.popen.returncode:
            raise FailedError(f"{law} ended with {controller.popen.returncode}: {controller.output}")
        return dict(json.loads((Path(folder) / "steps.json").read_text(encoding="utf-8")))


def response(step: dict[str, Any]) -> StepResponse:
    """A step as `step_test` wrote it."""
    return StepResponse(*(math.nan if step[name] is None else step[name] for name in StepResponse._fields))


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("laws", nargs="*", metavar="LAW", help=f"by default all: {', '.join(LAWS)}")
    parser.add_argument("--model", default="bench", choices=("bench", "thesis"), help="of plant and law, default bench")
    parser.add_argument("--hold", type=float, default=5.0, metavar="S", help="time at each level, default 5 s")
    options = parser.parse_args()
    for law in options.laws:
        if law not in LAWS:
            parser.error(f"no law {law}: give some of {', '.join(LAWS)}")
    isolate()
    console = Console(width=None if sys.stdout.isatty() else 120)
    found: dict[str, list[StepResponse]] = {}
    try:
        for law in options.laws or LAWS:
            found[law] = [response(step) for step in measured(law, options.model, options.hold)["steps"]]
    except FailedError as error:
        print(f"control_graph: {error}", file=sys.stderr)
        return 2
    console.print(step_report.table(found, {law: LAWS[law].reference_unit for law in found}))
    return int(any(step_report.missed(step, step_report.limits(law)) for law, each in found.items() for step in each))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
