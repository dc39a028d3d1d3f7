# SPDX-License-Identifier: Apache-2.0
"""Effects that a poor recording cannot separate: both are named, and the proposed experiment separates them."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import Signals, from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

SURE = 0.9

WIGGLE = Excitation("multisine", 20.0, duty_min=0.37, duty_max=0.43)
CREEP = Excitation("staircase", 30.0, duty_min=0.35, duty_max=0.45, levels=30)


@dataclass(frozen=True)
class Case:
    """A rig under a poor excitation, and who else may be blamed."""

    truth: str
    rivals: set[str]
    seed: int
    poor: Excitation
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)

    def rig(self) -> Model:
        """`bench`, its numbers a little off, with the effect; `numbers` are shares of the nominal ones."""
        model = drawn_rig(self.seed, self.effects)
        off = {name: share * BENCH.model[name] for name, share in self.numbers.items()}
        return Model("rig", {**model.model, **off}, model.sensing, model.effects)


CASES = [
    Case("thrust_lag", {"encoder_lag"}, 700, WIGGLE, {"thrust_lag": {"tau": 0.03}}),
    Case("encoder_lag", {"thrust_lag"}, 701, WIGGLE, {"encoder_lag": {"tau": 0.015}}),
    Case("angle_offset", {"encoder_eccentricity", "cable_torque"}, 702, WIGGLE, {"angle_offset": {}}),
    Case("cable_torque", {"thrust_exponent"}, 709, CREEP, {"cable_torque": {}}),
]


def recorded(model: Model, duty: np.ndarray, seed: int, settled: float = 0.0) -> Signals:
    """A recording that starts after the first duty has been held for so long (s)."""
    before = round(settled / SAMPLE_PERIOD)
    whole = np.concatenate([np.full(before, duty[0]), duty])
    columns, _ = rig.record(model, whole, seed)
    return from_arrays({k: x[before:] for k, x in {**columns, "duty": whole}.items()}, SAMPLE_PERIOD, BENCH.sensing)


def names(body: dict) -> list[tuple[str, float, bool]]:
    """What was weighed: name, with the number of a mismatch, probability, and whether it is claimed."""
    return [(f"{c['effect']}:{next(iter(c['parameters']))}" if c["effect"] == "parameter_mismatch" else c["effect"],
             c["probability"], c["found"]) for c in body["which"]["candidates"]]


@pytest.mark.promise(
    "Verdict", "Effects that the recording cannot separate are both named, with the experiment that separates them")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.truth)
def test_both_are_named_and_the_experiment_advised_tells_them_apart(case):
    model = case.rig()
    poor = recorded(model, case.poor.series(), case.seed - 700, settled=20.0)
    body = diagnose(BENCH, [poor]).body
    first = names(body)[0]
    assert first[2]
    assert first[1] < SURE
    (one, *_), others = body["which"]["not_separable"][0], {b for _, b in body["which"]["not_separable"]}
    assert first[0].startswith(one)
    wanted = {case.truth, *case.rivals}
    assert first[0] in wanted
    assert all(any(w.startswith(o) for o in others) for w in wanted - {first[0]})
    advice = body["which"]["next_experiment"]
    assert first[0].partition(":")[0] in advice["why"]

    better = recorded(model, Excitation(**advice["excite"]).series(), case.seed)
    for recordings in ([better], [poor, better]):
        body = diagnose(BENCH, recordings).body
        name, probability, claimed = names(body)[0]
        assert (name, claimed) == (case.truth, True)
        assert probability > SURE
        assert not any(case.truth.startswith(n) for pair in body["which"]["not_separable"] for n in pair)
        assert body["which"]["effects"] == [case.truth.partition(":")[0]]
