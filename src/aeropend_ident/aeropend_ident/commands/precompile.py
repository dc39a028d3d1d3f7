# SPDX-License-Identifier: Apache-2.0
"""The command `precompile`: compile now what a first diagnosis would wait for.

Compiled code is kept on disk and found again by the hash of its source, so that this does nothing the second time.
Small tasks are run: each function is compiled for the kinds of models and recordings with which it is called.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from aeropend_ident.diagnosis.chain.weak_start import rotor_speed
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.identification import dataset
from aeropend_ident.identification.discrepancy import nominal
from aeropend_ident.identification.identify import identify
from aeropend_ident.testing import rigs
from aeropend_sim.cli.command import EXIT_CODES, Parser, entry_point
from aeropend_sim.cli.progress import progress
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD

EXAMPLES = f"""examples:
  precompile                       once after an installation
  precompile && diagnose my_bag

{EXIT_CODES}"""

SECONDS = 6.0
"""[s] Length of the recordings (choice: some swings of the arm, so that each step of a diagnosis has what it needs)."""


def _diagnoses() -> None:
    """Diagnoses: with effects that are found, and with one left out; and the start of an uncalibrated rig."""
    diagnose(rigs.BENCH, [rigs.recorded(3, {"coulomb_friction": {}, "brush_drop": {}, "gust": {}}, SECONDS)])
    diagnose(rigs.BENCH, [rigs.recorded(3, {"ground_effect": {}}, SECONDS)], left_out=("ground_effect",))
    rotor_speed(rigs.BENCH, rigs.recorded(3, {}, SECONDS))


def _equations() -> None:
    """An identification of the equations of motion."""
    duty = rigs.steps(SECONDS, 3)
    columns, _ = rig.record(rigs.drawn_rig(3, {}), duty, 3)
    data = dataset.from_readings({**columns, "duty": duty}, SAMPLE_PERIOD, rigs.BENCH.sensing)
    identify(data, "discrepancy-weak", ["1", "theta_dot"], nominal(rigs.BENCH))


TASKS: tuple[Callable[[], None], ...] = (_diagnoses, _equations)
"""Each compiles what the other does not."""


@entry_point("precompile")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = Parser(prog="precompile", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Compile now what the first diagnosis and identification would wait for.")
    parser.parse_args(arguments)
    jobs = min(len(TASKS), os.cpu_count() or 1)
    with progress("compiling", len(TASKS)) as show, ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for done, task in enumerate(as_completed([pool.submit(task) for task in TASKS]), 1):
            task.result()
            show(done)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
