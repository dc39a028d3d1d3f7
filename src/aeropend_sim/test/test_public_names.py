# SPDX-License-Identifier: Apache-2.0
"""The names that the package offers to scripts."""

import subprocess
import sys
from importlib.resources import files

import numpy as np
import pytest

import aeropend_sim
from aeropend_sim import Excitation, Model, Rig, load, record


def test_the_example_of_the_docstring_runs():
    code = [line.strip() for line in aeropend_sim.__doc__.splitlines() if line.startswith("    ")]
    scope: dict = {}
    exec("\n".join(code), scope)
    assert set(scope["read"]) == {"theta", "omega", "i_a", "v_a"}
    assert len(scope["read"]["theta"]) == len(Excitation(duration=10.0).series())


def test_the_names_are_those_of_the_modules():
    assert isinstance(load("bench"), Model)
    read, _ = Rig(load("bench"), 3).run(np.full(50, 0.3))
    assert np.array_equal(record(load("bench"), np.full(50, 0.3), 3)[0]["theta"], read[0])
    assert {*aeropend_sim.__all__} <= {*dir(aeropend_sim)}
    with pytest.raises(AttributeError, match="no attribute 'motor'"):
        _ = aeropend_sim.motor


def test_the_package_alone_imports_nothing_slow():
    code = "import sys, aeropend_sim; print({'numba', 'numpy', 'yaml'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_the_package_is_typed():
    assert (files("aeropend_sim") / "py.typed").is_file()
