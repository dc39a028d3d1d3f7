# SPDX-License-Identifier: Apache-2.0
"""What the documents say of the code is so."""

import ast
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from arm_tables import driven
from evaluation import promises
from scipy.signal import lfilter

from aeropend_control.laws.registry import LAWS
from aeropend_control.nodes.controller import settings
from aeropend_ident.commands import identify, import_table
from aeropend_ident.diagnosis import batch
from aeropend_ident.diagnosis.document import schema
from aeropend_ident.identification.discrepancy import in_library
from aeropend_ident.testing import bags, rigs
from aeropend_sim import record
from aeropend_sim.cli.command import called
from aeropend_sim.cli.completion import commands
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.forms import FORMS
from aeropend_sim.model.parameters import PARAMETERS, SAMPLE_PERIOD, load
from aeropend_sim.ros import interface

ROOT = Path(__file__).parents[1]
ROWS = {cells[0].strip(" `"): cells for cells in (line.strip("|").split("|") for line in
        (ROOT / "docs" / "effects.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `"))}


INTERFACES = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
NAMED = set(re.findall(r"`([\w/-]+)`", INTERFACES))
"""Names that docs/interfaces.md defines."""

READMES = [*sorted(ROOT.glob("*.md")), ROOT / "firmware" / "README.md", *sorted(ROOT.glob("src/*/README.md")),
           *sorted(ROOT.glob("docs/**/*.md"))]
README = (ROOT / "README.md").read_text(encoding="utf-8")
GUIDE = {path.stem: path.read_text(encoding="utf-8") for path in ROOT.glob("docs/guide/*.md")}

TESTS = {name for path in [*ROOT.glob("src/*/test/test_*.py"), *ROOT.glob("test/**/test_*.py")]
         for name in re.findall(r"^ *def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)}
TOLD = {path.name: set(re.findall(r"`(test_\w+)`", path.read_text(encoding="utf-8")))
        for path in ROOT.glob("docs/**/*.md")}
"""By document, the tests that it names."""


def links(path):
    """What a document of ours links to here: (path, section), either may be empty."""
    text = path.read_text(encoding="utf-8")
    found = re.findall(r"(?:\]\(|^\[[^]]+\]: )([^)#\s]*)(?:#([^)\s]+))?", text, re.MULTILINE)
    return [(target, section) for target, section in found if not target.startswith("http")]


def sections(path):
    """The names by which the headings of a document can be linked to, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_effect_has_its_row_in_the_order_of_the_catalogue():
    assert list(ROWS) == [*CATALOGUE, "parameter_mismatch"]


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda e: e.id)
def test_a_row_gives_place_parameters_and_units(effect):
    _, place, parameters, shows = ROWS[effect.id]
    assert place.strip() == effect.place
    assert re.findall(r"`(\w+)` ([^,|]+)", parameters.strip()) == [(n, p.unit) for n, p in effect.parameters.items()]
    assert len(shows.strip()) > 10


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda e: e.id)
def test_the_equation_of_an_effect_is_that_of_the_catalogue(effect):
    text = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    assert f"- `{effect.id}`: {effect.physics}\n" in text


@pytest.mark.parametrize("form", FORMS.values(), ids=lambda e: e.id)
def test_a_form_has_its_row(form):
    text = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    (row,) = re.findall(rf"^\| {form.id} \| `(\w+)` \| (.*) \| (.*) \|$", text, re.MULTILINE)
    of, law, own = row
    term, more = re.fullmatch(r"`(.*?)`(.*)", law).groups() if form.term else (law, "")
    assert (of, term) == (form.form_of, form.term or form.physics)
    assert (f"d{form.memory}/dt = `{form.rate}`" in more) == bool(form.memory)
    assert ("sticks" in more) == form.sticks
    new = [(n, p.unit) for n, p in form.parameters.items() if n not in CATALOGUE[of].parameters and not p.refines]
    assert re.findall(r"`(\w+)` ([^,|]+)", own) == new


def keys(schema):
    """All keys of the objects in a JSON schema."""
    return {key for kind in [schema, *schema.get("$defs", {}).values()] for key in kind.get("properties", {})}


def test_the_interfaces_name_every_key_of_a_diagnosis():
    assert len(keys(schema())) > 50
    assert sorted(keys(schema()) - NAMED) == []


def test_the_interfaces_name_every_key_of_identified_equations():
    found = re.findall(r'"(\w+)":', inspect.getsource(identify.document))
    assert len(found) > 15
    assert sorted(set(found) - NAMED) == []


def test_the_interfaces_name_columns_topics_services_and_parameters():
    topics = {value for name, value in vars(interface).items() if name.isupper() and isinstance(value, str)}
    wanted = {*batch.COLUMNS, *topics, *(key.partition(".")[2] for key in PARAMETERS)} - {interface.ARMATURE_LOCATION}
    assert len(wanted) > 40
    assert sorted(wanted - NAMED) == []


FILES = re.compile(r"`((?:src|docs|test|evaluation|firmware|tools)/[\w./-]+)`")
"""A path of the tree in a document."""


@pytest.mark.promise("Packages", "Links and files in all documents exist")
@pytest.mark.parametrize("path", READMES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_that_a_document_names_are_there(path):
    named = FILES.findall(path.read_text(encoding="utf-8"))
    assert [name for name in named if not any((base / name).exists() for base in (ROOT, path.parent))] == []


def references(text):
    """The targets of the reference links of a document, by their names."""
    return dict(re.findall(r"^\[([^]]+)\]: (\S+)$", text, re.MULTILINE))


def defined(path):
    """The functions, classes, methods and constants that a source defines."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {leaf.id for target in targets for leaf in ast.walk(target) if isinstance(leaf, ast.Name)}
    return names


def test_the_method_links_each_function_to_the_file_that_defines_it():
    method = ROOT / "docs" / "method.md"
    text = method.read_text(encoding="utf-8")
    target = references(text)
    named = re.findall(r"\[`(\w+)`\]\[(\w+)\]", text)
    assert len(named) > 50
    assert [(name, ref) for name, ref in named if name not in defined(method.parent / target[ref])] == []
    steps = re.findall(r"^## (\d+\..+?)\n(.+?)(?=^## )", text, re.MULTILINE | re.DOTALL)
    assert len(steps) == 15
    assert [heading for heading, body in steps if not re.search(r"\[`\w+`\]\[", body)] == []


def test_the_glossary_names_what_is_in_the_files_that_it_links_to():
    glossary = ROOT / "docs" / "glossary.md"
    text = glossary.read_text(encoding="utf-8")
    target = references(text)
    named = re.findall(r"\| \[([^]]+)\], `(\w+)` \|", text)
    assert len(named) > 20
    assert [(ref, name) for ref, name in named if name not in defined(glossary.parent / target[ref])] == []


def test_no_source_names_a_document_that_is_not_there():
    sources = [path for folder in ("src", "test", "evaluation") for path in (ROOT / folder).rglob("*.py")]
    named = {name for path in sources for name in re.findall(r"\bdocs/[\w/]+\.md", path.read_text(encoding="utf-8"))}
    assert len(named) > 3
    assert sorted(name for name in named if not (ROOT / name).exists()) == []


def test_links_of_the_readme_lead_somewhere():
    assert len(links(ROOT / "README.md")) > 5


@pytest.mark.promise("Packages", "Links and files in all documents exist")
@pytest.mark.parametrize("path", READMES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    for target, section in links(path):
        there = (path.parent / target).resolve() if target else path
        assert there.exists(), target
        if section:
            assert section in sections(there), f"{target}#{section}"


@pytest.mark.parametrize("entry", commands(), ids=lambda entry: entry.name)
def test_every_command_has_its_row_in_the_readme_of_its_package(entry):
    package = entry.module.partition(".")[0]
    rows = (ROOT / "src" / package / "README.md").read_text(encoding="utf-8").splitlines()
    (row,) = [row for row in rows if row.startswith(f"| `{entry.name}` |")]
    assert len(row.split("|")[2].strip()) > 10


@pytest.mark.parametrize("name", [name for name, told in TOLD.items() if told])
def test_a_document_names_tests_that_are_there(name):
    assert sorted(TOLD[name] - TESTS) == []


def test_the_page_of_promises_is_that_of_the_markers():
    assert promises.PAGE.read_text(encoding="utf-8") == promises.page(), "run python -m evaluation.promises"


def test_every_section_has_promises_and_the_readme_names_no_test():
    assert {promise.section for promise in promises.promises()} == set(promises.SECTIONS)
    assert "`test_" not in README


@pytest.mark.parametrize("marker", ['"Start"', '"No such section", "It works"', ""])
def test_a_marker_without_section_and_sentence_is_refused(tmp_path, marker):
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "test_one.py").write_text(f"@pytest.mark.promise({marker})\ndef test_it():\n    pass\n")
    with pytest.raises(ValueError, match=r"test_one\.py: test_it: give promise"):
        list(promises.promises(tmp_path))


def test_the_readme_is_one_page():
    assert 100 <= len(README.splitlines()) <= 150


@pytest.mark.promise("Measurements", "The figures of the README are those of the results")
def test_figures_of_the_readme_are_those_of_the_results():
    results = [(ROOT / "docs" / "results" / f"{page}.md").read_text(encoding="utf-8")
               for page in ("blind", "circumstances", "real")]
    measured = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", "".join(results))]
    trust = README.partition("## How far to trust it\n")[2].partition("\n## ")[0]
    shown = re.findall(r"(?<![\w.])\d+(?:\.\d+)?", trust)
    assert len(shown) > 12
    assert [number for number in shown
            if float(number) not in [round(one, len(number.partition(".")[2])) for one in measured]] == []


@pytest.mark.promise("Measurements", "The index of the results has the date and the commit of each page")
def test_the_index_of_the_results_has_date_and_commit_of_each_page():
    folder = ROOT / "docs" / "results"
    rows = dict(re.findall(r"^\| \[([\w.]+)\]\([\w.]+\) \|.*?\| ([-\d]+ \| \w+) \|$",
                           (folder / "README.md").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(rows) == {path.name for path in folder.glob("*.md")} - {"README.md"}
    for name, row in rows.items():
        said = re.search(r"Measured on ([-\d]+)[^.]*?commit (\w+)", (folder / name).read_text(encoding="utf-8"))
        assert said is None or row == " | ".join(said.groups()), name


@pytest.mark.promise("Packages", "A script of the guide runs")
def test_a_script_in_the_guide_runs(tmp_path, monkeypatch, capsys):
    """A bag by the name that the script reads."""
    (script,) = re.findall(r"```python\n(.+?)```", GUIDE["python"], re.DOTALL)
    duty = rigs.steps(20.0, 11)
    columns, _ = record(rigs.drawn_rig(11, {"coulomb_friction": {}}), duty, 11)
    bags.write(tmp_path / "my_bag", {**{c: columns[c] for c in ("theta", "omega", "i_a", "v_a")}, "duty": duty},
               round(SAMPLE_PERIOD * 1e9))
    monkeypatch.chdir(tmp_path)
    exec(compile(script, "python.md", "exec"), {})
    assert capsys.readouterr().out.startswith("coulomb_friction {'coulomb_friction': {'accel': ")


def test_the_readme_has_every_command_at_its_package():
    rows = dict(re.findall(r"^\| \[(aeropend_\w+)\]\(.*?\) \| (.+) \|$", README, re.MULTILINE))
    entries = {entry.name: entry.module.partition(".")[0] for entry in commands()}
    assert {name: package for package, holds in rows.items() for name in re.findall(r"`(\w+)`", holds)} == entries


@pytest.mark.promise("Control", "The four laws of the thesis follow references within their ranges")
def test_laws_references_and_limits_are_those_of_the_guide():
    told = re.findall(r"^\| `(\w+)` \| (?:PID|the same|speed).*? \| (.+) \|$", GUIDE["control"], re.MULTILINE)
    assert {law for law, _ in told} == LAWS.keys()
    angle = [kind for kind in LAWS.values() if kind.measures == "theta"]
    assert next(reference for _, reference in told) == "rad from hanging, 0 to 1.2"
    assert [kind.reference_limits for kind in angle] == [(0.0, 1.2)] * 3
    for kind in LAWS.values():
        timeout, limit = (settings(kind)[name].default for name in ("timeout", "angle_limit"))
        assert f"no sample for {1000.0 * timeout:g} ms (`timeout`)" in GUIDE["control"]
        assert f"the arm beyond {limit:g} rad (`angle_limit`)" in GUIDE["control"]


PIECE = re.compile(r"^    from aeropend_.+?(?=\n\n\S|\Z)", re.MULTILINE | re.DOTALL)
"""Lines of Python."""


@pytest.mark.promise("Packages", "A script of the guide runs")
@pytest.mark.parametrize("path", [path for path in READMES if PIECE.search(path.read_text(encoding="utf-8"))],
                         ids=lambda path: str(path.relative_to(ROOT)))
def test_python_in_a_document_runs(path):
    """A piece that ends in a value identifies x' = -2 x + u and y' = -3 y + u."""
    u = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, 50), 60)
    x, y = (lfilter([0.0, 0.002], [1.0, 0.002 * rate - 1.0], u) for rate in (2.0, 3.0))
    noise = 1e-4 * np.random.default_rng(1).standard_normal((2, len(u)))
    for piece in PIECE.findall(path.read_text(encoding="utf-8")):
        body = ast.parse("\n".join(line[4:] for line in piece.splitlines()))
        names = {"x": x + noise[0], "y": y + noise[1], "u": u}
        last = body.body.pop() if isinstance(body.body[-1], ast.Expr) else None
        exec(compile(body, str(path), "exec"), names)
        if last is not None:
            found = eval(compile(ast.Expression(last.value), str(path), "eval"), names)
            assert {state: set(equation) for state, equation in found.items()} == {"x": {"x", "u"}, "y": {"y", "u"}}


@pytest.mark.promise("Identification", "The equations in the guide are those that the command prints")
def test_the_equations_that_the_guide_shows_are_those_of_the_simulated_rig():
    true = in_library(load("bench"))
    for state in ("theta_dot", "i_a", "omega"):
        (shown,) = re.findall(rf"^    d\({state}\)/dt = (.+)$", GUIDE["identification"], re.MULTILINE)
        terms = re.findall(r"(-?) ?\(([\d.e-]+) ± ([\d.e-]+)\) (\S+)", shown)
        assert {term for *_, term in terms} == true[state].keys()
        for sign, value, sigma, term in terms:
            assert abs(float(sign + value) - true[state][term]) < 3.0 * float(sigma), term


@pytest.mark.promise("Tables", "`import` shows the columns of a file and proposes their meaning")
def test_import_proposes_what_the_guide_shows(tmp_path, monkeypatch, capsys):
    shown = GUIDE["import"].partition(".venv/bin/import messung.csv\n")[2].partition("\n\nSay")[0]
    pwm = np.repeat([0, 59, 24, 78, 0, 43], 100)
    theta = driven(pwm) - 83.0
    rows = [f"{0.02 * k:.3f};{x:.1f}".replace(".", ",") + f";{u}\n" for k, (x, u) in enumerate(zip(theta, pwm))]
    (tmp_path / "messung.csv").write_text("Zeit [s];Winkel [°];PWM\n" + "".join(rows), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    assert import_table.main(["messung.csv"]) == 2
    out = capsys.readouterr().out.replace(called("import", "aeropend_ident"), ".venv/bin/import")
    said = [line.split() for line in out.splitlines()]
    assert [line for line in shown.splitlines() if line.split() not in said] == []


TARGETS = set(re.findall(r"^(\w+):.*## ", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


@pytest.mark.parametrize("path", READMES, ids=lambda path: str(path.relative_to(ROOT)))
def test_make_targets_that_a_document_names_are_there(path):
    named = set(re.findall(r"(?:^    |`)make ([a-z]+)", path.read_text(encoding="utf-8"), re.MULTILINE))
    assert named <= TARGETS
    assert path.name != "README.md" or path.parent != ROOT or {"demo", "test", "blind", "bench", "lint"} <= named
