# SPDX-License-Identifier: Apache-2.0
"""What the documents say of the code is so."""

import re
from pathlib import Path

import pytest

from aeropend_sim.completion import commands
from aeropend_sim.effects import CATALOGUE

ROOT = Path(__file__).parents[1]
ROWS = {cells[0].strip(" `"): cells for cells in (line.strip("|").split("|") for line in
        (ROOT / "docs" / "effects.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `"))}


READMES = [*sorted(ROOT.glob("*.md")), ROOT / "firmware" / "README.md", *sorted(ROOT.glob("src/*/README.md")),
           *sorted(ROOT.glob("docs/*.md"))]


def links(path):
    """What a document of ours links to here: (path, section), either may be empty."""
    found = re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]+))?\)", path.read_text(encoding="utf-8"))
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


def test_links_of_the_readme_lead_somewhere():
    assert len(links(ROOT / "README.md")) > 5


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
