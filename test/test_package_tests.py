# SPDX-License-Identifier: Apache-2.0
"""The tests of a package run with that package alone, as `colcon test` runs them."""

import ast
import xml.etree.ElementTree as ET  # the files are ours
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(path.name for path in (ROOT / "src").iterdir() if path.is_dir())
OUTSIDE = {"evaluation"} | {path.stem for path in (ROOT / "test" / "support").glob("*.py")}


def imported(path):
    """The top-level modules that a file imports."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


def depends_on(package):
    """The packages of this repository that a package depends on, and itself."""
    tags = ET.parse(ROOT / "src" / package / "package.xml").getroot()
    named = {tag.text for tag in tags if tag.tag in {"depend", "exec_depend", "test_depend"}} & set(PACKAGES)
    return {package, *named}


@pytest.mark.promise("Packages", "The tests of each package run with `colcon test` alone")
@pytest.mark.parametrize("package", PACKAGES)
def test_tests_of_a_package_import_nothing_from_outside(package):
    allowed = depends_on(package)
    files = sorted((ROOT / "src" / package / "test").rglob("*.py"))
    assert files
    wrong = [(path.name, name) for path in files for name in imported(path)
             if name in OUTSIDE or (name in PACKAGES and name not in allowed)]
    assert wrong == []
