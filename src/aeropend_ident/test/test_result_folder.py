# SPDX-License-Identifier: Apache-2.0
"""A folder with results is there whole, or not at all, whenever Ctrl-C comes."""

import signal
from pathlib import Path

import pytest

from aeropend_ident.result_folder import atomic_folder

FILES = ("a.json", "b.html")


def write(out, when=None):
    with atomic_folder(out, FILES) as place:
        for name in FILES:
            if when == f"{name} is written":
                signal.raise_signal(signal.SIGINT)
            (place / name).write_text("new")


@pytest.mark.parametrize("when", [f"{name} is written" for name in FILES])
@pytest.mark.parametrize("before", [None, "old"])
def test_ctrl_c_while_they_are_written_leaves_what_there_was(tmp_path, when, before):
    out = tmp_path / "out"
    if before:
        out.mkdir()
        for name in FILES:
            (out / name).write_text(before)
    with pytest.raises(KeyboardInterrupt):
        write(out, when)
    assert {path.name: path.read_text() for path in out.glob("*")} == (dict.fromkeys(FILES, before) if before else {})
    assert out.exists() == bool(before)


@pytest.mark.parametrize("nth", [0, 1])
def test_ctrl_c_while_they_are_put_in_place_waits_until_they_are(tmp_path, monkeypatch, nth):
    replace, placed = Path.replace, []

    def interrupted(self, target):
        if len(placed) == nth:
            signal.raise_signal(signal.SIGINT)
        placed.append(target)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out")
    assert {path.name: path.read_text() for path in (tmp_path / "out").glob("*")} == dict.fromkeys(FILES, "new")
    assert signal.getsignal(signal.SIGINT) is handler
