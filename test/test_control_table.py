# SPDX-License-Identifier: Apache-2.0
"""The table of laws against effects, on the effects that hurt most."""

import io
import subprocess
import sys

import numpy as np
from evaluation.control_table import BENCH, EFFECTS, figures, table
from rich.console import Console

HURT = ["thrust_lag", "encoder_lag", "axial_inflow", "coulomb_friction"]


def test_compensation_at_least_halves_the_excess_on_the_median():
    law = "feedback_linearization_cascade"
    nominal = figures(law, BENCH, BENCH)
    kept = []
    for effect in HURT:
        rig = BENCH.with_effects({effect: EFFECTS[effect]})
        before, after = figures(law, BENCH, rig), figures(law, rig, rig)
        kept += [max(0.0, after[j] - nominal[j]) / (before[j] - nominal[j]) for j in (0, 1)
                 if before[j] - nominal[j] > 0.05 * nominal[j]]
    assert len(kept) >= 4
    assert np.median(kept) <= 0.5


def test_a_loop_that_does_not_come_to_rest_is_marked():
    text = []
    for effect in ("gust", "voltage_offset"):
        out = io.StringIO()
        Console(file=out, width=120).print(table("feedback_linearization", [effect], diagnosed=False))
        text.append(next(line for line in out.getvalue().splitlines() if effect in line))
    assert "!" in text[0]
    assert "!" not in text[1]


def test_an_unknown_name_is_refused():
    for arguments in (["pid"], ["cascade", "--effects", "ghost"]):
        done = subprocess.run([sys.executable, "-m", "evaluation.control_table", *arguments],
                              capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1
        assert arguments[-1] in done.stderr
