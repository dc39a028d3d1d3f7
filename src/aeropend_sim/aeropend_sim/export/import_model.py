# SPDX-License-Identifier: Apache-2.0
"""The command `import_model`: a nominal model from a description of a rig (MJCF or URDF), the counterpart of `export`.

MuJoCo reads the description, whatever it is made of, and gives the equation of the joint. What a description does not
hold (motor, propeller, sensors) comes from a preset or a model file, and is named.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from aeropend_sim.cli.command import EXIT_CODES, Parser, between, entry_point
from aeropend_sim.errors import UserError
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import PARAMETERS, PRESETS, Model, load, save
from aeropend_sim.untrusted import one_line, printable

EXAMPLES = f"""examples:
  import_model rig.xml --out my_rig.yaml
  import_model rig.urdf --joint shoulder --lever 0.28 --base thesis --out my_rig.yaml

{EXIT_CODES}"""

LARGEST = 10_000_000
"""Greatest number of bytes of a description. A choice."""


@dataclass(frozen=True)
class Imported:
    """A model from a description.

    Attributes:
        model: it, with the effects that the description has.
        lines: what comes from where, a line each.
    """

    model: Model
    lines: list[str] = field(default_factory=list)


def read(path: Path, base: Model, joint: str | None = None, lever: float | None = None) -> Imported:
    """Read a description.

    Args:
        path: an MJCF or a URDF file.
        base: supplies what is not in it.
        joint: name of the hinge of the arm; None: the only one.
        lever: [m] of the thrust; None: from the description's actuator, else from `base`.

    Raises:
        UserError: there is no MuJoCo, the file cannot be read, or it has no such hinge.
    """
    mujoco, compiled = _compiled(path)
    dof, name = _hinge(mujoco, compiled, path, joint)
    at = int(compiled.jnt_qposadr[compiled.dof_jntid[dof]])
    data = mujoco.MjData(compiled)

    def moment(angle: float, control: float = 0.0) -> tuple[float, float]:
        """[N·m] Of gravity and of the actuator, at rest."""
        mujoco.mj_resetData(compiled, data)
        data.qpos[at] = angle
        data.ctrl[:] = control
        mujoco.mj_forward(compiled, data)
        return -float(data.qfrc_bias[dof]), float(data.qfrc_actuator[dof])

    gravity_0, gravity_90 = moment(0.0)[0], moment(0.5 * math.pi)[0]
    mgd, hangs = math.hypot(gravity_0, gravity_90), math.atan2(gravity_0, -gravity_90)
    if not mgd > 0.0:
        raise UserError(f"{path}: gravity does not turn the joint {name}: give the hinge of the arm with --joint")
    moment(0.0)
    inertia = _inertia(mujoco, compiled, data, dof)
    lines, numbers = [], dict(base.model)

    def take(key: str, value: float, from_: str) -> None:
        p = PARAMETERS[f"model.{key}"]
        if not p.low <= value <= p.high:
            raise UserError(f"{path}: {key} = {value:g} {p.unit} of joint {name} is out of range; "
                            f"{p.low:g} to {p.high:g} can be used")
        numbers[key] = value
        lines.append(f"{key} = {value:.6g} {p.unit}: {from_}")

    take("mgd_over_J", mgd / inertia, f"gravity on the joint {name} over its inertia, {inertia:.6g} kg·m²")
    take("c_over_J", float(compiled.dof_damping[dof]) / inertia, "its damping")
    if lever is None and compiled.nu == 1:
        lever = abs(moment(0.0, 1.0)[1] - moment(0.0)[1])
        source = f"{lever:.6g} N·m per unit of the actuator, which is taken for newtons"
    else:
        source = "the given lever"
    if lever:
        take("L_over_J", lever / inertia, source)
    else:
        lines.append(f"L_over_J = {numbers['L_over_J']:.6g}: not in the file, from {base.name}; give --lever if known")
    if abs(hangs) > 1e-6:
        lines.append(f"the arm hangs at {hangs:.6g} rad of the joint, where the model's angle is 0")
    effects = _effects(compiled, dof, at, inertia, hangs)
    lines += [f"effect {id_}: {', '.join(f'{n} = {x:.6g}' for n, x in p.items())}" for id_, p in effects.items()]
    left = [key for key in numbers if key not in ("mgd_over_J", "c_over_J", "L_over_J") and numbers[key] != 0.0]
    lines.append(f"not in the file, from {base.name}: motor and propeller ({', '.join(left)}), sensors")
    return Imported(replace(base, name=str(path), model=numbers, effects=effects), lines)


def _effects(compiled: Any, dof: int, at: int, inertia: float, hangs: float) -> dict[str, dict[str, float]]:
    """Dry friction and spring of a joint as effects."""
    friction = float(compiled.dof_frictionloss[dof]) / inertia
    stiffness = float(compiled.jnt_stiffness[compiled.dof_jntid[dof]]) / inertia
    found = {"coulomb_friction": {"accel": friction},
             "cable_torque": {"k": stiffness, "theta0": float(compiled.qpos_spring[at]) - hangs}}
    return {id_: p for id_, p in found.items() if p[CATALOGUE[id_].size] > 0.0}


def _compiled(path: Path) -> tuple[Any, Any]:
    """MuJoCo, and the description as it compiled it."""
    try:
        import mujoco
    except ImportError:
        raise UserError("import_model needs MuJoCo to read descriptions: pip install mujoco") from None
    try:
        if path.stat().st_size > LARGEST:
            raise UserError(f"{path}: larger than {LARGEST} bytes; this is no description of a rig")
        return mujoco, mujoco.MjModel.from_xml_path(str(path))
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise UserError(f"{path}: MuJoCo cannot read it as MJCF or URDF: {one_line(str(error))}") from None


def _hinge(mujoco: Any, compiled: Any, path: Path, wanted: str | None) -> tuple[int, str]:
    """Degree of freedom and name of the hinge of the arm."""
    hinges = {mujoco.mj_id2name(compiled, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint {j}": int(compiled.jnt_dofadr[j])
              for j in range(compiled.njnt) if compiled.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE}
    if wanted is not None:
        if wanted not in hinges:
            raise UserError(f"{path}: no hinge is named '{one_line(wanted)}'; it has: {', '.join(hinges) or 'none'}")
        return hinges[wanted], wanted
    if len(hinges) != 1:
        raise UserError(f"{path}: it has {len(hinges)} hinges{': ' * bool(hinges)}{', '.join(hinges)}; "
                        + ("name that of the arm with --joint" if hinges else "a pendulum needs one"))
    ((name, dof),) = hinges.items()
    return dof, name


def _inertia(mujoco: Any, compiled: Any, data: Any, dof: int) -> float:
    """[kg·m²] Inertia about a hinge, the other joints held."""
    import numpy as np

    full = np.zeros((compiled.nv, compiled.nv))
    mujoco.mj_fullM(compiled, full, data.qM)
    return float(full[dof, dof])


@entry_point("import_model", "interrupted, nothing was written")
def main(args: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = Parser(
        prog="import_model", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Make a model file from a description of a rig (MJCF or URDF): gravity, inertia, damping and dry "
                    "friction of the hinge. What the description does not hold is printed, and taken from a preset.")
    parser.add_argument("description", type=Path, metavar="FILE", help="an MJCF or URDF file")
    parser.add_argument("--out", required=True, type=Path, metavar="FILE", help="the model file to write")
    parser.add_argument("--joint", metavar="NAME", help="hinge of the arm (default: the only one)")
    parser.add_argument("--lever", type=between(1e-3, 10.0, "a length", " m"), metavar="M",
                        help="distance of the thrust from the hinge (default: that of the only actuator)")
    parser.add_argument("--base", default="bench", metavar="PRESET|FILE",
                        help=f"supplies motor, propeller and sensors: {' or '.join(PRESETS)}, or a model file "
                             "(default: bench)")
    parser.add_argument("--overwrite", action="store_true", help="replace the model file")
    options = parser.parse_args(args)
    if options.out.exists() and not options.overwrite:
        raise UserError(f"{options.out} exists: name another file with --out, or give --overwrite")
    found = read(options.description, load(options.base), options.joint, options.lever)
    save(found.model, options.out, "\n".join([f"import_model {options.description}", *found.lines]))
    for line in [str(options.out), *found.lines]:
        print(printable(line))
    return 0


if __name__ == "__main__":
    sys.exit(main())
