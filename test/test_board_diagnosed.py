# SPDX-License-Identifier: Apache-2.0
"""Board in the loop, in simulated time: what its samples, turned into SI by the bridge, say of the rig behind it."""

import numpy as np
import pytest
from board import Board
from evaluation.support import boards

from aeropend_bridge import calibration, protocol
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import Signals, from_arrays
from aeropend_ident.testing.rigs import BENCH, steps
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD

DURATION_S = 30.0


@pytest.fixture(scope="module", autouse=True)
def built() -> None:
    """The program and the emulator are built and new."""
    boards.build()


def sampled(effects: dict[str, dict[str, float]], seed: int) -> Signals:
    """What the bridge would publish of a board that is given random steps of duty."""
    board, receiver, scale = Board(BENCH.with_effects(effects), seed), protocol.Receiver(), calibration.default()
    for _ in range(20):  # it starts
        board.step()
    board.send(protocol.enable(True))
    receiver.feed(board.receive())
    rows = []
    for k, duty in enumerate(steps(DURATION_S, seed)):
        board.send(protocol.duty_command(k % 256, duty))
        board.step()
        rows += [scale.measured(m)._asdict() for m in receiver.feed(board.receive()) if isinstance(m, protocol.Sample)]
    assert receiver.bad == 0
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)


@pytest.mark.promise("Hardware", "A phase-correct PWM is recognised, and is no gap")
def test_a_nominal_rig_shows_no_effect():
    result = diagnose(BENCH, [sampled({}, 1)], 1)
    assert result.body["which"]["verdict"] == "none"
    assert any("phase-correct PWM" in note for note in result.signals[0].notes)


@pytest.mark.parametrize(("effect", "within"), [("coulomb_friction", 0.05), ("brush_drop", 0.15)])
def test_an_effect_is_found(effect, within):
    parameters = {name: p.default for name, p in CATALOGUE[effect].parameters.items()}
    body = diagnose(BENCH, [sampled({effect: parameters}, 2)], 1).body
    assert body["which"]["verdict"] == effect
    found = next(c for c in body["which"]["candidates"] if c["effect"] == effect)
    for name, value in parameters.items():
        assert found["parameters"][name]["value"] == pytest.approx(value, rel=within)
