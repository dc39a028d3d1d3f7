# SPDX-License-Identifier: Apache-2.0
"""Collect the promises to users from the markers of the tests: `python -m evaluation.promises` writes docs/promises.md.

A test that keeps a promise has the marker `@pytest.mark.promise("section", "the promise, one sentence")`. Several tests
may keep one promise.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "promises.md"

SECTIONS = ("Start", "Commands", "Recordings", "Tables", "Verdict", "Uncalibrated rigs", "Augmented model",
            "Other simulators", "Identification", "Control", "Hardware", "Views", "Measurements", "Packages")
"""The sections of the page, in their order."""

MEASURED = (
    ("The figures on calibrated rigs", "make blind", "docs/results/blind.md"),
    ("The figures on uncalibrated rigs", 'make blind ARGS="--uncalibrated"', "docs/results/uncalibrated.md"),
    ("Speed, memory and growth beside peers", "make bench", "docs/results/bench.md"),
    ("A result or one line, whatever values a recording holds, for ten minutes a command", "make fuzz", ""),
    ("Behaviour under load and faults for half an hour", "make soak", "docs/results/soak.md"),
    ("Step responses of the four laws in the whole graph", "python -m evaluation.control_graph",
     "docs/results/control.md"),
    ("The packages build with colcon, and every command starts where `ros2 run` finds it", "tools/colcon-check", ""),
)
"""Promises that only a measurement or a build can show: promise, command, page of the results."""

HEAD = """# Promises, and the tests that keep them

Written by `python -m evaluation.promises` from the markers of the tests. `make test ARGS="-k NAME"` runs one of them.
"""


class Promise(NamedTuple):
    """A promise that a test keeps."""

    section: str
    text: str
    test: str


def promises(root: Path = ROOT) -> Iterator[Promise]:
    """The promises of all tests, in the order of the files.

    Args:
        root: of the repository.

    Raises:
        ValueError: a marker has no section and text, or names a section that the page does not have.
    """
    for path in sorted([*root.glob("src/*/test/test_*.py"), *root.glob("test/**/test_*.py")]):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if not isinstance(node, ast.FunctionDef):
                continue
            for decorator in node.decorator_list:
                if not (isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.promise"):
                    continue
                arguments = [one.value for one in decorator.args if isinstance(one, ast.Constant)]
                if len(arguments) != 2 or arguments[0] not in SECTIONS:
                    raise ValueError(f"{path.name}: {node.name}: give promise() one of {', '.join(SECTIONS)}, and a "
                                     "sentence")
                yield Promise(str(arguments[0]), str(arguments[1]), node.name)


def page(root: Path = ROOT) -> str:
    """The page: a table for each section, and what is measured."""
    kept: dict[str, dict[str, list[str]]] = {section: {} for section in SECTIONS}
    for promise in promises(root):
        tests = kept[promise.section].setdefault(promise.text, [])
        if promise.test not in tests:
            tests.append(promise.test)
    lines = [HEAD]
    for section, rows in kept.items():
        lines += [f"## {section}", "", "| promise | tests |", "| --- | --- |"]
        lines += [f"| {text} | {', '.join(f'`{test}`' for test in rows[text])} |" for text in sorted(rows, key=_plain)]
        lines += [""]
    lines += ["## Measured", "", "No test shows these.", "", "| promise | command | results |", "| --- | --- | --- |"]
    lines += [f"| {text} | `{command}` | {_link(results)} |"
              for text, command, results in MEASURED]
    return "\n".join(lines) + "\n"


def _link(page: str) -> str:
    return f"[{Path(page).name}]({page.removeprefix('docs/')})" if page else ""


def _plain(text: str) -> str:
    return re.sub(r"[^\w ]", "", text).casefold()


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE.relative_to(ROOT))
