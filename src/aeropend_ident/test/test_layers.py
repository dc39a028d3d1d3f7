# SPDX-License-Identifier: Apache-2.0
"""Imports go one way: no module of the package imports from a layer above its own, and no two import each other."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import aeropend_ident

ROOT = Path(aeropend_ident.__file__).parent
PACKAGE = "aeropend_ident"

LAYERS = [
    ["interrupt", "result_folder", "bags"],
    ["signals"],
    ["estimation"],
    ["identification", "diagnosis.policy", "diagnosis.typed_json", "diagnosis.document",
     "diagnosis.left_open"],
    ["diagnosis.chain"],
    ["diagnosis.search"],
    ["diagnosis.free_run_gap", "diagnosis.regions"],
    ["diagnosis.joint_fit", "diagnosis.validation", "diagnosis.experiment_design"],
    ["diagnosis.strength"],
    ["diagnosis.gap_share", "diagnosis.gap_budget"],
    ["diagnosis.measured"],
    ["diagnosis.since", "diagnosis.isolation"],
    ["diagnosis.conclude"],
    ["diagnosis.diagnosis"],
    ["diagnosis.report"],
    ["diagnosis.results", "diagnosis.checks"],
    ["diagnosis.batch", "diagnosis.dask_cluster"],
    ["design"],
    ["tables", "bench_tests", "checkup"],
    ["live"],
    ["public", "testing"],
    ["nodes", "commands"],
    ["studies"],
]
"""From bottom to top; a module belongs to the longest name that it begins with."""


def modules() -> dict[str, Path]:
    """Name below the package -> file."""
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sorted(ROOT.rglob("*.py"))
            if path.name not in ("__init__.py", "__main__.py")}


def imports(path: Path) -> list[tuple[int, str]]:
    """Line and name below the package of each module that a file imports, inside functions too."""
    known, found = modules(), []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE):
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.startswith(PACKAGE)]
        found += [(node.lineno, name.removeprefix(f"{PACKAGE}.")) for name in names
                  if name.removeprefix(f"{PACKAGE}.") in known]
    return found


def layer(module: str) -> int:
    """Number of a module's layer."""
    fits = [(len(prefix), number) for number, prefixes in enumerate(LAYERS) for prefix in prefixes
            if module == prefix or module.startswith(f"{prefix}.")]
    assert fits, f"{module} belongs to no layer: add it to LAYERS"
    return max(fits)[1]


def test_no_module_imports_from_above():
    wrong = [f"{path.relative_to(ROOT)}:{line}: {name} imports {other}, which is above it; move what is shared down"
             for name, path in modules().items() for line, other in imports(path) if layer(other) > layer(name)]
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other():
    TopologicalSorter({name: {other for _, other in imports(path)} for name, path in modules().items()}).prepare()


def test_identification_and_diagnosis_do_not_know_each_other():
    pairs = [(name, other) for name, path in modules().items() for _, other in imports(path)
             if {name.partition(".")[0], other.partition(".")[0]} == {"identification", "diagnosis"}]
    assert not pairs


def test_an_import_from_above_is_seen(tmp_path):
    (tmp_path / "low.py").write_text("def f():\n    from aeropend_ident.commands import diagnose\n")
    ((line, other),) = imports(tmp_path / "low.py")
    assert (line, other) == (2, "commands.diagnose")
    assert layer(other) > layer("bags.recording")
