# SPDX-License-Identifier: Apache-2.0
"""A small blind check of uncalibrated rigs: the steps of `make blind ARGS=--uncalibrated`, on a fresh seed."""

import json
import math

import numpy as np
import pytest
from evaluation.blind import folder, score, uncalibrated

from aeropend_sim.model.parameters import load

SEED, COUNT, DURATION = 4243, 9, 20.0

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """Labels and verdicts; the labels are elsewhere while verdicts are made."""
    out = tmp_path_factory.mktemp("unknown") / "made"
    uncalibrated.make(out, COUNT, SEED, DURATION, 1)
    sealed = out / folder.SEALED
    sealed.rename(out.parent / "elsewhere")
    folder.diagnose_all(out, 1, fit_nominal=True)
    (out.parent / "elsewhere").rename(sealed)
    return out


@pytest.mark.promise("Measurements", "Few blind recordings reach the figures of the README")
def test_figures_hold_on_a_few(checked):
    figures = {f.name: f for f in uncalibrated.report(checked)}
    assert figures["free decays: right effect or none"].value == 1.0
    assert figures["no effect in it, one claimed"].value == 0.0
    driven = next(f for name, f in figures.items() if "right effect first, where" in name)
    assert driven.count >= 2
    assert driven.value >= 0.5


def test_every_recording_got_a_verdict(checked):
    verdicts = [json.loads(v.read_text()) for v in (checked / "verdicts").iterdir()]
    assert len(verdicts) == COUNT
    assert not [v["error"] for v in verdicts if "error" in v]


@pytest.mark.promise("Measurements", "The blind check opens the labels after the last verdict")
def test_labels_open_only_after_the_last_verdict(checked):
    last = sorted((checked / "verdicts").iterdir())[-1]
    last.rename(checked / "away")
    with pytest.raises(SystemExit, match=f"^1 of {COUNT} verdicts are missing .{last.stem}"):
        uncalibrated.report(checked)
    (checked / "away").rename(last)


def test_every_kind_of_recording_is_planned():
    rows = uncalibrated.plan(120, 1)
    assert len(rows) == 120
    assert {row[1] for row in rows if row[0] == "decay"} == set(uncalibrated.DAMPING)
    assert {row[1] for row in rows if row[0] == "driven"} == {"", *uncalibrated.SHOWS}
    assert rows != uncalibrated.plan(120, 2)


def test_rigs_differ_by_a_factor_of_three_and_lift_their_arm():
    nominal = load(folder.MODEL).model
    rigs = [uncalibrated.rig(nominal, np.random.default_rng(seed))[0] for seed in range(60)]
    ratio = np.array([n["c_over_J"] / nominal["c_over_J"] for n in rigs])
    assert ratio.max() / ratio.min() == pytest.approx(3.0, rel=0.15)


@pytest.mark.parametrize("damping", uncalibrated.DAMPING)
def test_a_free_decay_keeps_the_amplitude_that_it_was_drawn_with(damping):
    label, columns, period = uncalibrated.decay("x", damping, load(folder.MODEL).model, 5, rate=200.0, lsb=0.0)
    theta = columns["theta"]
    gravity = label["numbers"]["mgd_over_J"]
    swings = 10.0 * math.pi / math.sqrt(gravity)
    start = len(theta) - 1 - round(1.02 * swings / period)
    late = np.abs(theta[-round(0.2 * swings / period):]).max()
    assert 0.08 < late / theta[start] < 0.85
    assert np.ptp(theta[:max(start - 2, 1)]) == 0.0
    assert score.Label.read({**label, "what": "decay"}).keys == ({damping} if damping != "viscous" else set())
