# SPDX-License-Identifier: Apache-2.0
"""Draw docs/export-mujoco.png: a rig's recording beside the arm in MuJoCo, without and with the effect that was found.

`python -m evaluation.export_picture [--out FILE]`: a rig is recorded, `diagnose` finds what its model lacks, the
nominal and the augmented model are exported, and MuJoCo runs both with the recorded duty.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.cli.command import Parser
from aeropend_sim.export.mujoco_drive import files
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

Array = NDArray[np.float64]

EFFECT, SEED, DURATION, HELD_OUT = "quadratic_drag", 12, 40.0, 0.7
"""The effect, the seed of the rig, s of recording, and share of it that is fitted."""

_RUN = """
import sys, numpy as np
from aeropend_mujoco import Rig
rig = Rig()
np.save("angle.npy", [rig.step(duty).theta_read for duty in np.load("duty.npy").tolist()])
"""


def in_mujoco(model: Model, duty: Array) -> Array:
    """The angle (rad, as read) of a model in MuJoCo, by its exported files in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files(model).items():
            (Path(folder) / name).write_text(text)
        np.save(Path(folder) / "duty.npy", duty)
        subprocess.run([sys.executable, "-c", _RUN], cwd=folder, check=True)
        return np.load(Path(folder) / "angle.npy")


def main() -> int:
    """Record, diagnose, export, run, draw."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    parser = Parser(prog="export_picture", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "export-mujoco.png",
                        help="the picture (default: docs/export-mujoco.png)")
    options = parser.parse_args()
    duty = steps(DURATION, SEED)
    read, _ = rig.record(drawn_rig(SEED, {EFFECT: {}}), duty, SEED)
    found = diagnose(BENCH, [from_arrays({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    models = {"MuJoCo, nominal model": BENCH, "MuJoCo, augmented model": found.augmented}
    runs = {name: in_mujoco(model, duty) for name, model in models.items()}

    unseen = slice(round(HELD_OUT * len(duty)), None)
    t = SAMPLE_PERIOD * np.arange(len(duty))[unseen]
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(8.0, 4.6), height_ratios=(2, 1), dpi=100)
    above.plot(t, read["theta"][unseen], color="0.6", linewidth=3.0, label="the rig's recording")
    for (name, theta), colour in zip(runs.items(), ("tab:red", "tab:blue")):
        left = (theta - read["theta"])[unseen]
        above.plot(t, theta[unseen], color=colour, linewidth=1.0, label=name)
        below.plot(t, left, color=colour, linewidth=0.8)
        print(f"{name}: RMS difference from the recording {1e3 * np.sqrt(np.mean(left**2)):.2f} mrad")
    print(f"verdict: {', '.join(found.conclusions.which.effects)}")
    above.set_ylabel("angle, rad")
    below.set_ylabel("difference, rad")
    below.set_xlabel("time, s (nothing was fitted to this part)")
    above.legend(loc="upper right", fontsize=8, ncols=3, frameon=False)
    above.margins(y=0.22)
    figure.align_ylabels()
    figure.tight_layout()
    figure.savefig(options.out, metadata={"Software": None})
    return 0


if __name__ == "__main__":
    sys.exit(main())
