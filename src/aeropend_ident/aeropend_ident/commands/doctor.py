# SPDX-License-Identifier: Apache-2.0
"""The command `doctor`: check the installation, recordings and model files, one line for each finding."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from aeropend_ident.checkup import bag, installation, model_file
from aeropend_sim.cli.command import Parser, entry_point
from aeropend_sim.model.parameters import PRESETS, load
from aeropend_sim.untrusted import printable

EXAMPLES = """examples:
  doctor                                 check the installation
  doctor my_bag                          and a recording: is it fit for a diagnosis?
  doctor monday tuesday rig.yaml         several recordings, and a model file

exit codes: 0 nothing is wrong, 2 there is an error (a line says what to do), 130 interrupted"""


@entry_point("doctor")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = Parser(prog="doctor", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Check the installation, recordings and model files, and say what to do about each "
                                "fault.")
    parser.add_argument("files", nargs="*", metavar="FILE", help="a recording, or a model file (.yaml)")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help=f"model that recordings are checked with: {' or '.join(PRESETS)}, or a model file "
                             "(default: bench)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if a bag holds several")
    options = parser.parse_args(arguments)
    model = load(options.model)
    worst = 0
    for found in (installation.checks(Path.cwd()),
                  *(model_file.checks(name) if model_file.is_model(name) else bag.checks(name, model, options.namespace)
                    for name in options.files)):
        for check in found:
            print(printable(str(check)), flush=True)
            worst = max(worst, 2 if check.level == "error" else 0)
    return worst


if __name__ == "__main__":
    sys.exit(main())
