# SPDX-License-Identifier: Apache-2.0
"""The command `doctor`: check the installation, recordings and model files, one line for each finding."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from aeropend_ident.checkup import bag, installation, model_file
from aeropend_sim.cli.command import Parser, entry_point
from aeropend_sim.model.parameters import PRESETS, Model, ModelError, load
from aeropend_sim.untrusted import printable

EXAMPLES = """examples:
  doctor                                 check the installation
  doctor my_bag                          and a recording: is it fit for a diagnosis?
  doctor monday tuesday rig.yaml         several recordings, and a model file

An error is what does not work: a missing program, a file that cannot be read, a recording that diagnose would refuse
with the same --model. A warning is what may be wrong: it does not change the exit code.

exit codes: 0 no error, 2 an error (its line says what to do) or a wrong command line, 130 interrupted"""


@entry_point("doctor")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = Parser(prog="doctor", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Check the installation, recordings and model files, and say what to do about each "
                                "fault.")
    parser.add_argument("files", nargs="*", metavar="FILE", help="a recording, or a model file (.yaml)")
    parser.add_argument("--model", metavar="PRESET|FILE",
                        help=f"model that recordings are checked with: {' or '.join(PRESETS)}, or a model file "
                             "(default: the model file that is checked too, else bench)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if a bag holds several")
    options = parser.parse_args(arguments)
    model = load(options.model) if options.model else _model_among(options.files)
    worst = 0
    for found in (installation.checks(Path.cwd()),
                  *(model_file.checks(name) if model_file.is_model(name) else bag.checks(name, model, options.namespace)
                    for name in options.files)):
        for check in found:
            print(printable(str(check)), flush=True)
            worst = max(worst, 2 if check.level == "error" else 0)
    return worst


def _model_among(files: Sequence[str]) -> Model:
    """The first model among files that loads, or bench; what does not load is reported when it is checked."""
    for name in filter(model_file.is_model, files):
        with suppress(ModelError):
            return load(name)
    return load("bench")


if __name__ == "__main__":
    sys.exit(main())
