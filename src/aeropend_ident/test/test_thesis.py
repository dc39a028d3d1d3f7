# SPDX-License-Identifier: Apache-2.0
"""The tables of the thesis."""



import pytest

from aeropend_ident.studies import thesis


@pytest.mark.promise("Identification", "The tables of the thesis are recomputed beside the printed values")
def test_chapter_4_is_printed_beside_what_comes_out(capsys):
    assert thesis.main(["4"]) == 0
    said = capsys.readouterr().out
    (constant,) = (line for line in said.splitlines() if "K_ω, Table 4.3" in line)
    assert "6.6e-4 Vs/rad" in constant
    assert "0.0063" in constant
    assert "wrong unit: Table 4.2's speeds are RPM" in said
    for table in ("R_a, Table 4.1", "L_a, 4.4.2", "v_a(τ), (4.3)", "v_a(f), (4.5)", "K_q, Table 4.3"):
        assert table in said
    assert [thesis.FIGURES[figure][2] for figure in ("5.7", "5.9")] == [85, 34]  # terms too many
