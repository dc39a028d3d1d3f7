# SPDX-License-Identifier: Apache-2.0
"""The names that the package offers to scripts."""

import subprocess
import sys

import pytest

import aeropend_ident
from aeropend_ident.testing import bags
from aeropend_ident.testing.rigs import drawn_rig, steps
from aeropend_sim import record
from aeropend_sim.model.parameters import SAMPLE_PERIOD


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    duty = steps(20.0, 11)
    columns, _ = record(drawn_rig(11, {"coulomb_friction": {}}), duty, 11)
    path = tmp_path_factory.mktemp("public") / "bag"
    bags.write(path, {**{c: columns[c] for c in ("theta", "omega", "i_a", "v_a")}, "duty": duty},
               round(SAMPLE_PERIOD * 1e9))
    return path


def test_a_bag_is_read_diagnosed_and_identified_in_three_lines(bag):
    recording = aeropend_ident.read(bag)
    found = aeropend_ident.diagnose(recording, "bench", jobs=2)
    assert isinstance(found, aeropend_ident.Diagnosis)
    assert found.conclusions.which.verdict == "coulomb_friction"
    assert "coulomb_friction" in found.augmented.effects
    equations = aeropend_ident.identify(recording).equations
    assert "theta_dot" in equations


def test_every_name_is_there_and_an_unknown_one_is_an_attribute_error():
    for name in aeropend_ident.__all__:
        assert getattr(aeropend_ident, name).__name__ == name
        assert name in dir(aeropend_ident)
    with pytest.raises(AttributeError, match="has no attribute 'ghost'"):
        _ = aeropend_ident.ghost


def test_the_import_alone_loads_neither_numba_nor_scipy():
    code = "import sys, aeropend_ident; print([m for m in ('numba', 'scipy', 'numpy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
