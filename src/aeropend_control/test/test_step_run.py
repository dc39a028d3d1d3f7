# SPDX-License-Identifier: Apache-2.0
import pytest

from aeropend_control.nodes import step_run


def test_the_defaults_make_a_folder_of_their_own():
    options = step_run.parse([])
    assert options.levels is None
    assert options.out.name.startswith("step_test_")


def test_results_are_replaced_only_when_asked(tmp_path, capsys):
    (tmp_path / "steps.json").write_text("mine")
    with pytest.raises(SystemExit) as end:
        step_run.parse(["--out", str(tmp_path)])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "steps.json already" in line
    assert step_run.parse(["--out", str(tmp_path), "--overwrite"]).out == tmp_path


@pytest.mark.parametrize(("words", "said"), [
    (["--hold", "0.1"], "0.5 to 600"), (["--levels", "nan"], "nan"), (["--levels", "much"], "much"),
    (["--law", "bang_bang"], "bang_bang"), (["0.4"], "0.4"), (["--out", __file__], "no folder"),
])
def test_what_cannot_be_used_is_said_in_one_line(capsys, words, said):
    with pytest.raises(SystemExit) as end:
        step_run.parse(words)
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("step_test: ")
    assert said in line
