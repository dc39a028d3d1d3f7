# SPDX-License-Identifier: Apache-2.0
"""The command `export`: a model for other simulators."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from aeropend_sim.cli.command import EXIT_CODES, Parser, between, entry_point
from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import PRESETS, SAMPLE_PERIOD, Model, load
from aeropend_sim.untrusted import printable

TARGETS = ("python", "c", "fmu", "mjcf", "urdf", "sdf")

EXAMPLES = f"""examples:
  export verdict/augmented.yaml --to mjcf --out in_mujoco
  export verdict/augmented.yaml --to fmu --out in_simulink
  export bench --to c --out src --period 0.001
  export rig.yaml --to urdf --out description

  mjcf    aeropendulum.xml for MuJoCo, and aeropend_mujoco.py, which drives it with motor, propeller and effects
  fmu     aeropend_model.fmu, FMI 3.0 for co-simulation: Simulink, Modelica tools, fmpy
  c       aeropend_model.h and .c, C99 without dependencies
  python  aeropend_model.py, which needs the standard library alone
  urdf    aeropendulum.urdf, the arm alone
  sdf     aeropendulum.sdf, the arm alone, for Gazebo

What a target cannot hold of the model is printed, and written into its files.
In a shell `export` is a word of the shell: write the whole path, `aeropend export` or `ros2 run aeropend_sim export`.

{EXIT_CODES}"""


def _texts(model: Model, target: str, period: float) -> tuple[dict[str, str], list[str]]:
    """Files by name, and what is not in them."""
    from aeropend_sim.export import mujoco_drive, rigid_body, targets

    if target == "python":
        return {f"{targets.MODULE}.py": targets.python_module(model, period)}, list(map(str, targets.missing(model)))
    if target == "c":
        return targets.c_files(model, period), list(map(str, targets.missing(model)))
    if target == "mjcf":
        alone = [each.name for each in rigid_body.missing(model, "mjcf")[:-1]]
        return mujoco_drive.files(model, period), [
            *map(str, targets.missing(model)),
            f"{', '.join(alone)}: not in {mujoco_drive.XML} alone; {mujoco_drive.DRIVER} applies them"]
    text = rigid_body.urdf(model) if target == "urdf" else rigid_body.sdf(model)
    return {f"aeropendulum.{target}": text}, list(map(str, rigid_body.missing(model, target)))


def write(model: Model, target: str, out: Path, period: float = SAMPLE_PERIOD, *, overwrite: bool = False
          ) -> tuple[list[Path], list[str]]:
    """Write a model for another simulator.

    Args:
        model: parameters and effects.
        target: one of `TARGETS`.
        out: the folder; it is made.
        period: [s] time between samples.
        overwrite: replace files.

    Returns:
        The files, and lines that say what of the model is not in them.

    Raises:
        UserError: a file is there already, or cannot be written.
    """
    from aeropend_sim.export import fmu, targets

    texts: dict[str, str] = {}
    if target == "fmu":
        names, missing = [f"{targets.MODULE}.fmu"], list(map(str, targets.missing(model)))
    else:
        texts, missing = _texts(model, target, period)
        names = list(texts)
    paths = [out / name for name in names]
    for path in paths:
        if path.exists() and not overwrite:
            raise UserError(f"{path} exists: name another folder with --out, or give --overwrite")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path in paths:
            if path.name in texts:
                path.write_text(texts[path.name], encoding="utf-8")
            elif not fmu.write(model, path, period):
                missing.append("compiled library: there is no C compiler here, so the FMU has its sources alone; "
                               "install gcc and export again, or compile it with `fmpy compile`")
    except OSError as error:
        raise UserError(f"{out}: cannot be written: {error.strerror}") from None
    return paths, missing


@entry_point("export")
def main(args: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = Parser(
        prog="export", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Write a model, with its effects, for another simulator.")
    parser.add_argument("model", metavar="PRESET|FILE", help=f"{' or '.join(PRESETS)}, or a model file such as "
                                                             "verdict/augmented.yaml")
    parser.add_argument("--to", required=True, choices=TARGETS, help="what to write, see below")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the files")
    parser.add_argument("--period", type=between(1e-5, 0.1, "a time", " s"), default=SAMPLE_PERIOD, metavar="S",
                        help=f"time between samples (default: {SAMPLE_PERIOD:g} s, that of the rig)")
    parser.add_argument("--overwrite", action="store_true", help="replace files in the folder")
    options = parser.parse_args(args)
    paths, missing = write(load(options.model), options.to, Path(options.out), options.period,
                           overwrite=options.overwrite)
    for path in paths:
        print(printable(str(path)))
    for line in missing:
        print(printable(f"not in it: {line}"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
