# SPDX-License-Identifier: Apache-2.0
"""Several files of one experiment become one recording, and nothing is interpolated."""

import numpy as np
import pytest
from arm_tables import DRIVEN, LONG, PUSH, imported, lines, put, refused

from aeropend_ident.bags.recording import read
from aeropend_ident.commands.import_table import main


def files(tmp_path, t, u, head="time [s],u"):
    return put(tmp_path, "time [s],angle\n" + lines(LONG, DRIVEN), "angle.csv"), put(
        tmp_path, head + "\n" + lines(t, u), "drive.csv")


@pytest.mark.promise("Tables", "Several files of one experiment are joined by their time with `--with`")
def test_signals_in_files_of_their_own(tmp_path, capsys):
    one, other = files(tmp_path, LONG, PUSH / 100.0)
    assert main([str(one), str(tmp_path / "bag"), "--with", str(other), "--accept"]) == 0
    recording = read(tmp_path / "bag")
    np.testing.assert_allclose(recording.theta, np.radians(DRIVEN), atol=1e-4)
    np.testing.assert_allclose(recording.duty, PUSH / 100.0, atol=1e-7)
    assert "drive.csv: joined by its stamps, which are the same" in capsys.readouterr().out


def test_a_file_of_changes_holds_each_value_until_the_next(tmp_path, capsys):
    changes = np.flatnonzero(np.diff(PUSH, prepend=-1.0))
    one, other = files(tmp_path, np.append(1e3 * LONG[changes] - 3.0, 1e3 * LONG[-1]), np.append(PUSH[changes], 40.0),
                       "time [ms],u")
    recording = imported(tmp_path, one, "--with", str(other), "--time", "time [s]", "--theta", "angle:deg",
                         "--duty", "u:%")
    np.testing.assert_allclose(recording.duty, PUSH / 100.0, atol=1e-7)
    assert "each row takes the last value before it, up to 983 ms old" in capsys.readouterr().out


def test_names_that_clash_get_the_name_of_their_file(tmp_path):
    one = put(tmp_path, "t,value\n" + lines(LONG, DRIVEN), "angle.csv")
    other = put(tmp_path, "t,value\n" + lines(LONG, PUSH / 100.0), "pwm.csv")
    recording = imported(tmp_path, one, "--with", str(other), "--accept")
    np.testing.assert_allclose(recording.duty, PUSH / 100.0, atol=1e-7)


def test_files_that_do_not_belong_together_are_refused(tmp_path, capsys):
    one, other = files(tmp_path, LONG + 1000.0, PUSH)
    said = refused(capsys, one, tmp_path / "bag", "--with", other, "--accept")
    assert "its times (1000 to 1011.98 s) are not those of the first file (0 to 11.98 s)" in said
    short = put(tmp_path, "u\n" + lines(PUSH[:300]), "short.csv")
    assert "no time is found in it, and it has 300 rows" in refused(capsys, one, tmp_path / "bag", "--with", short,
                                                                  "--accept")
    assert "--with belongs to one file" in refused(capsys, one, other, tmp_path / "bags", "--with", short, "--accept")
