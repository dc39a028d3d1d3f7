# SPDX-License-Identifier: Apache-2.0
"""Every dialect of text with columns is read, or one line says why not."""

import math

import numpy as np
import pytest
from arm_tables import ANGLE, DRIVEN, LONG, MAPPED, NUMBERS, PUSH, TIME, comma, imported, lines, put, refused

from aeropend_ident.tables import files
from aeropend_ident.tables.guess import guess
from aeropend_ident.tables.units import parse

DIALECTS = {
    "plain": ("t,x\n" + NUMBERS, "utf-8"),
    "no head": (NUMBERS, "utf-8"),
    "semicolons and decimal commas": ("t;x\n" + comma(lines(TIME, ANGLE, split=";")), "utf-8"),
    "tabs": ("t\tx\n" + lines(TIME, ANGLE, split="\t"), "utf-8"),
    "tabs and decimal commas": ("t\tx\n" + comma(lines(TIME, ANGLE, split="\t")), "utf-8"),
    "bars": ("t|x\n" + lines(TIME, ANGLE, split="|"), "utf-8"),
    "columns between blanks": ("  t   x\n" + lines(TIME, ANGLE, form="{:12.4f}", split=" "), "utf-8"),
    "commas and blanks": ("t, x\n" + lines(TIME, ANGLE, split=", "), "utf-8"),
    "BOM": ("t,x\n" + NUMBERS, "utf-8-sig"),
    "UTF-16": ("t,x\n" + NUMBERS, "utf-16"),
    "UTF-16, no BOM": ("t,x\n" + NUMBERS, "utf-16-le"),
    "UTF-16, other order": ("t,x\n" + NUMBERS, "utf-16-be"),
    "Latin-1": ("t [s],Messgröße [°]\n" + NUMBERS, "latin-1"),
    "Windows line ends": ("t,x\r\n" + lines(TIME, ANGLE, end="\r\n"), "utf-8"),
    "old Macintosh line ends": ("t,x\r" + lines(TIME, ANGLE, end="\r"), "utf-8"),
    "quoted": ('"t","x"\n' + lines(TIME, ANGLE, form='"{:.4f}"'), "utf-8"),
    "quoted decimal commas": ('"t","x"\n' + comma(lines(TIME, ANGLE, form='"{:.4f}"', split=";")).replace(";", ","),
                              "utf-8"),
    "comments": ("# rig 7\n% by hand\n// yes\nt,x\n# now\n" + NUMBERS + "# end\n", "utf-8"),
    "names in a comment": ("# t, x\n" + NUMBERS, "utf-8"),
    "line of units": ("t;x\ns;°\n" + comma(lines(TIME, ANGLE, split=";")), "utf-8"),
    "preamble": ("Gerät: A;;\nDatum;3.4.2024;\n\nt;x\n[s];[deg]\n" + comma(lines(TIME, ANGLE, split=";")), "utf-8"),
    "delimiter at the end": ("t,x,\n" + lines(TIME, ANGLE, end=",\n"), "utf-8"),
    "blank lines": ("t,x\n\n" + lines(TIME, ANGLE, end="\n\n"), "utf-8"),
    "exponents": ("t,x\n" + lines(TIME, ANGLE, form="{:.6e}"), "utf-8"),
    "text beside": ("state,t,x\n" + "".join(f"RUN,{line}\n" for line in NUMBERS.splitlines()), "utf-8"),
    "no line end at the end": ("t,x\n" + NUMBERS.rstrip("\n"), "utf-8"),
}


def test_each_column_may_have_its_own_decimal_mark(tmp_path):
    text = "t;x;u\n" + "".join(f"{t:.2f};{x:.3f};1\n".replace(".", ",", 1) for t, x in zip(TIME, ANGLE))
    table = files.read(put(tmp_path, text))
    np.testing.assert_allclose(table.columns[0].values, TIME)
    np.testing.assert_allclose(table.columns[1].values, ANGLE, atol=1e-3)
    assert table.notes == ("numbers have a decimal comma in column 1, in others a decimal point",)


@pytest.mark.parametrize("head", ["t,x,u,spare,more", "t,x", "# t,x,u,spare"])
def test_names_of_another_number_than_the_columns_are_not_used(tmp_path, head):
    table = files.read(put(tmp_path, head + "\n" + lines(TIME, ANGLE, ANGLE)))
    assert [column.name for column in table.columns] == ["", "", ""]
    assert "which belongs to which is not clear" in "".join(table.notes) or head.startswith("#")


@pytest.mark.parametrize(("head", "named"), [
    ("t;angle;duty;spare", ["t", "angle", "duty"]), ("no;t;angle;duty", ["t", "angle", "duty"]),
    ("t;angle ref;angle;duty", ["t", "angle", "duty"]), ("angle;duty", ["", "angle", "duty"])])
def test_numbers_tell_which_name_is_one_too_many_or_missing(tmp_path, head, named):
    table = files.read(put(tmp_path, head + "\n" + lines(LONG, DRIVEN, PUSH, split=";")))
    assert [column.name for column in table.columns] == named
    assert "the numbers tell which belongs to which" in "".join(table.notes)


def test_a_column_stays_without_a_name_where_two_are_as_likely(tmp_path):
    head = "t;angle;duty;temp;spare"
    table = files.read(put(tmp_path, head + "\n" + lines(LONG, DRIVEN, PUSH, 21.0 + 0.01 * LONG, split=";")))
    assert [column.name for column in table.columns] == ["t", "angle", "duty", ""]
    assert "but for column 4" in "".join(table.notes)


def test_a_name_that_may_belong_to_either_of_two_columns_decides_for_none(tmp_path):
    other = np.rint(20.0 + 30.0 * np.sin(1.7 * LONG))
    text = "t;duty;angle\n" + lines(LONG, PUSH, other, DRIVEN, split=";")
    table = files.read(put(tmp_path, text))
    assert [column.name for column in table.columns] == ["t", "duty", "angle?", "angle?"]
    assert "too" in "".join(one.why for one in guess(table) if one.quantity == "theta" and not one.sure)


def test_a_decimal_comma_is_seen_wherever_it_shows(tmp_path):
    x = np.concatenate((np.full(500, 22.5), ANGLE))
    rows = "".join(f"{k};{value:.3f}\n".replace(".", ",") for k, value in enumerate(x))
    table = files.read(put(tmp_path, "k;angle\n" + rows))
    np.testing.assert_allclose(table.columns[1].values, x, atol=1e-3)


def test_cells_beside_a_table_need_no_names(tmp_path):
    text = "t,x,u,,,\n0,1,2,,,\n1,2,3,,0.5,mean\n2,3,4,,,\n" + "".join(f"{k},2,3,,,\n" for k in range(3, 50))
    table = files.read(put(tmp_path, text))
    assert [column.name for column in table.columns][:3] == ["t", "x", "u"]


@pytest.mark.promise("Tables", "`import` reads CSV, text, Excel, MATLAB and NumPy")
@pytest.mark.parametrize("name", DIALECTS)
def test_dialects(tmp_path, name):
    text, encoding = DIALECTS[name]
    table = files.read(put(tmp_path, text, encoding=encoding))
    k = 1 if name == "text beside" else 0
    np.testing.assert_allclose(table.columns[k].values, TIME, atol=1e-4)
    np.testing.assert_allclose(table.columns[k + 1].values, ANGLE, atol=1e-3)
    assert len(table.columns) == k + 2
    if "no head" not in name:
        assert (table.columns[k].name[0], table.columns[k + 1].name[0]) in (("t", "x"), ("t", "M"))
    if "unit" in name or name in ("Latin-1", "preamble"):
        assert table.columns[0].unit == "s"
        assert parse("theta", table.columns[1].unit).size == pytest.approx(math.radians(1.0))


def test_readings_that_are_not_there(tmp_path):
    rows = [f"{t},{x}" for t, x in zip(TIME, ["", "NaN", "n/a", "-", "inf", "#N/A", "null", *ANGLE[7:]])]
    recording = imported(tmp_path, put(tmp_path, "t,x\n" + "\n".join(rows)), "--time", "t:s", "--theta", "x:deg")
    assert np.flatnonzero(np.isnan(recording.theta)).tolist() == [0, 1, 2, 3, 4, 5, 6]


def test_columns_that_are_left_out_are_named(tmp_path, capsys):
    path = put(tmp_path, "t,x,wind,sun\n" + lines(TIME, ANGLE, ANGLE, TIME))
    imported(tmp_path, path, "--time", "t:s", "--theta", "x:deg")
    assert 'left out: columns 3 "wind", 4 "sun"' in capsys.readouterr().out


def test_a_last_line_that_is_broken_off_is_told(tmp_path, capsys):
    path = put(tmp_path, "t,x,y\n" + lines(TIME, ANGLE, ANGLE) + "4.0,1")
    assert len(imported(tmp_path, path, "--time", "t:s", "--theta", "x:deg")) == len(TIME)
    assert "the last line (202) is broken off" in capsys.readouterr().out


UNREADABLE = {
    "t,x\n" + NUMBERS + "4.0,1.2.3\n4.1,0\n": "line 202, column 2 (x): '1.2.3' is not a number",
    "t,x\n" + NUMBERS + "4.0,hello\n4.1,0\n": "'hello' is not a number; correct it, or give --skip-bad",
    "t,x\n" + NUMBERS + "4.0,1,2\n4.1,0\n": "line 202 has 3 cells, the others have 2",
    "t;x\n" + comma(lines(TIME, ANGLE, split=";")) + "4,0;1.5\n4,1;0\n": "'1.5' has a decimal point, where others have",
    "t;x\n" + comma(lines(TIME, ANGLE, split=";")) + "4,0;1.234,5\n4,1;0\n": "'1.234,5' marks thousands",
    "t,x\n" + NUMBERS + '4.0,"1,234.5"\n4.1,0\n': "'1,234.5' marks thousands",
    "t;x\n" + "".join(f"{k};1,{k + 100}\n" for k in range(200)): "may have a decimal comma or mark thousands",
    "t,x\n" + comma(NUMBERS): "commas are decimal marks, they cannot split the cells as well",
    "hello\nworld\n" * 20: "no table of numbers",
    "\n\n": "the file is empty",
    "": "the file is empty",
    "%PDF-1.4 hello\n": "holds nothing but comments",
    b"\x00\x01\x02" * 100: "bytes that no text has",
    "t,x\n" + NUMBERS + "1" * 70000 + "\n": "line 202 is longer",
}


@pytest.mark.promise("Tables", "A cell that is not a number is refused with line and column")
@pytest.mark.parametrize("text", UNREADABLE, ids=range(len(UNREADABLE)))
def test_what_cannot_be_read_is_said_in_one_line(tmp_path, capsys, text):
    said = refused(capsys, put(tmp_path, text), tmp_path / "bag", *MAPPED)
    assert UNREADABLE[text] in said
    assert not (tmp_path / "bag").exists()


@pytest.mark.promise("Tables", "A cell that is not a number is refused with line and column")
def test_rows_that_cannot_be_read_are_left_out_on_demand(tmp_path, capsys):
    text = "t,x\n" + NUMBERS.replace("0.2000,", "0.2000,?!", 1).replace("0.4000,", "0.4000,1,", 1)
    recording = imported(tmp_path, put(tmp_path, text), *MAPPED, "--skip-bad")
    assert len(recording) == len(TIME) - 2
    assert recording.lost == 2
    assert "2 rows that cannot be read left out, first: line 12" in capsys.readouterr().out


def test_marks_that_the_file_leaves_open_can_be_told(tmp_path):
    text = "t;x\n" + "".join(f"{k};{1 + k % 3},{k + 100}\n" for k in range(200))
    recording = imported(tmp_path, put(tmp_path, text), "--time", "t:ms", "--theta", "x:rad", "--decimal", ",",
                         "--delimiter", ";")
    np.testing.assert_allclose(recording.theta, [1 + k % 3 + (k + 100) / 1000 for k in range(200)])
