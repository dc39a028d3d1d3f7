# SPDX-License-Identifier: Apache-2.0
"""What the documents say of the code is so."""

import re
from pathlib import Path

import pytest

from aeropend_sim.effects import CATALOGUE

ROOT = Path(__file__).parents[1]
ROWS = {cells[0].strip(" `"): cells for cells in (line.strip("|").split("|") for line in
        (ROOT / "docs" / "effects.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `"))}


def test_every_effect_has_its_row_in_the_order_of_the_catalogue():
    assert list(ROWS) == [*CATALOGUE, "parameter_mismatch"]


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda e: e.id)
def test_a_row_gives_place_parameters_and_units(effect):
    _, place, parameters, shows = ROWS[effect.id]
    assert place.strip() == effect.place
    assert re.findall(r"`(\w+)` ([^,|]+)", parameters.strip()) == [(n, p.unit) for n, p in effect.parameters.items()]
    assert len(shows.strip()) > 10


def test_links_of_the_readme_lead_somewhere():
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert len(links) > 5
    assert [link for link in links if not (ROOT / link).exists()] == []
