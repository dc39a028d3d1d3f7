# SPDX-License-Identifier: Apache-2.0
"""Every compiled function is cached by the one module that notices edits in other files."""

import re
from pathlib import Path

SOURCES = Path(__file__).parents[1] / "src"


def test_no_package_takes_the_decorators_of_numba_itself():
    imports = re.compile(r"^\s*(from numba import .*\b(n?jit|vectorize|guvectorize)\b|import numba)", re.MULTILINE)
    found = [path.name for path in SOURCES.glob("*/aeropend_*/**/*.py") if imports.search(path.read_text())]
    assert found == ["compiled.py"]
