# SPDX-License-Identifier: Apache-2.0
"""The cache of compiled functions notices an edit in another file; the cache of numba alone does not."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import aeropend_sim
from aeropend_sim.compiled import VERSIONS

OURS, NUMBAS = ("from aeropend_sim.compiled import njit", "@njit()"), ("from numba import njit", "@njit(cache=True)")
PRINT = "from aeropend_sim.outer import twice_scaled; print(twice_scaled(1.0))"


@pytest.fixture
def tree(tmp_path):
    """A copy of the package's source."""
    copy = tmp_path / "tree" / "aeropend_sim"
    shutil.copytree(Path(aeropend_sim.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    return copy


def output(tree, code, **environment):
    """What a new process prints with this tree. It writes no .pyc: that of a quick edit of equal length looks fresh."""
    inherited = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    own = {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": str(tree.parent)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tree.parent,
                          env={**inherited, **own, **environment})  # fmt: skip
    return done.stdout.strip()


def write_pair(tree, factor, style=OURS):
    """Two modules: the function of one is compiled into the function of the other."""
    imported, decorator = style
    head = f"{imported}\n\n\n"
    (tree / "inner.py").write_text(f"{head}{decorator}\ndef scaled(x):\n    return {factor} * x\n")
    (tree / "outer.py").write_text(f"from aeropend_sim.inner import scaled\n{head}{decorator}\n"
                                   "def twice_scaled(x):\n    return 2.0 * scaled(x)\n")  # fmt: skip


def cached(folder, name="outer.twice_scaled"):
    return sorted(path.name for path in folder.rglob(f"{name}-*.nbi"))


@pytest.mark.parametrize(("style", "after"), [(OURS, "6.0"), (NUMBAS, "4.0")], ids=["ours", "numba"])
def test_an_edit_of_an_inlined_function_in_another_file_is_noticed_but_not_by_numba_alone(tree, style, after):
    write_pair(tree, 2.0, style)
    assert output(tree, PRINT) == "4.0"
    write_pair(tree, 3.0, style)
    assert output(tree, PRINT) == after


def test_an_edit_of_a_constant_in_another_file_is_noticed(tree):
    code = ("import numpy as np\nfrom aeropend_sim.model import sensing\n"
            "from aeropend_sim.model.parameters import load\n"
            "chain = sensing.prepare(load('bench'))._replace(spike_rate=1e9, speed_noise=0.0, tick=0.0)\n"
            "memory = sensing.Memory(0.0, 0.0, 0.0, 0.0, 100.0, 6.2, -0.1, 100.0, 0.0)\n"
            "print(sensing.time_pulses(memory, 100.0, 6.4, np.zeros(2), 0.0, chain)[1])")  # fmt: skip
    before = float(output(tree, code))
    effects = tree / "model" / "effects.py"
    text = effects.read_text()
    low = re.search(r"^SPIKE_FACTOR = \(([\d.]+)", text, re.MULTILINE)
    effects.write_text(text.replace(low[0], f"SPIKE_FACTOR = ({2.0 * float(low[1])}"))
    assert float(output(tree, code)) == pytest.approx(2.0 * before)


def test_what_is_unchanged_is_loaded_and_old_versions_do_not_pile_up(tree):
    folder = tree / "__pycache__"
    write_pair(tree, 1.5, NUMBAS)
    assert output(tree, PRINT) == "3.0"
    assert len(cached(folder)) == 1
    for factor in range(2, 4 + VERSIONS):
        write_pair(tree, float(factor))
        assert output(tree, PRINT) == str(2.0 * factor)
    kept = cached(folder)
    assert len(kept) == VERSIONS
    hits = "; print(sum(twice_scaled.stats.cache_hits.values()))"
    assert output(tree, PRINT + hits).splitlines() == [str(2.0 * factor), "1"]
    write_pair(tree, float(factor - 1))  # an earlier source
    assert output(tree, PRINT + hits).splitlines() == [str(2.0 * (factor - 1)), "1"]
    assert cached(folder) == kept


def test_code_from_the_cache_runs_without_what_only_the_compiler_needs(tree):
    (tree / "filled.py").write_text(f"import numpy as np\n{OURS[0]}\n\n\n{OURS[1]}\ndef filled(x):\n"
                                    "    return np.full(3, x)\n")  # fmt: skip
    code = ("import sys; from aeropend_sim.filled import filled; "
            "print(filled(2.0).sum(), 'numba.np.linalg' in sys.modules)")  # fmt: skip
    assert output(tree, code) == "6.0 True"
    assert output(tree, code) == "6.0 False"


def test_two_processes_that_compile_at_once_never_take_each_others_code(tree):
    (tree / "inner.py").write_text(f"{OURS[0]}\n\n\n{OURS[1]}\ndef doubled(x):\n    return 2 * x\n")
    whole, real = (f"from aeropend_sim.inner import doubled; print(doubled({x}))" for x in (3, 1.5))
    folder = tree / "__pycache__"
    assert output(tree, whole) == "6"
    of_whole = {path: path.read_bytes() for path in folder.glob("inner.doubled-*.nbc")}
    for path in folder.glob("inner.doubled-*.nbi"):  # the second process read the index before the first one wrote it
        path.unlink()
    assert output(tree, real) == "3.0"
    for path, code in of_whole.items():  # and the first process writes its code last
        path.write_bytes(code)
    assert output(tree, real) == "3.0"


def test_the_users_own_cache_folder_is_used_and_a_read_only_source_has_its_cache_elsewhere(tree, tmp_path):
    write_pair(tree, 2.0)
    named = tmp_path / "named"
    assert output(tree, PRINT, NUMBA_CACHE_DIR=str(named)) == "4.0"
    assert len(cached(named)) == 1
    assert not cached(tree)
    (tree / "__pycache__").write_text("")  # no folder can be made there
    home = tmp_path / "home"
    assert output(tree, PRINT, XDG_CACHE_HOME=str(home)) == "4.0"
    assert len(cached(home)) == 1


def test_without_numba_the_functions_are_those_of_python(tree):
    write_pair(tree, 2.0)
    assert output(tree, PRINT + "; print(type(twice_scaled).__name__)", NUMBA_DISABLE_JIT="1") == "4.0\nfunction"
