# SPDX-License-Identifier: Apache-2.0
"""Workbooks, MATLAB and numpy files are read, or one line says why not."""

import datetime
import io
import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from arm_tables import (
    ANGLE,
    DRIVEN,
    DUTY,
    LONG,
    MAPPED,
    PUSH,
    TIME,
    comma,
    imported,
    lines,
    refused,
    table_rows,
    workbook,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from aeropend_ident.tables import files
from aeropend_ident.tables.table import TableError


@pytest.mark.promise("Tables", "`import` reads CSV, text, Excel, MATLAB and NumPy")
def test_a_workbook(tmp_path):
    head = [["Versuch 3"], [], ["Zeit", "Winkel", "PWM"], ["s", "°", "%"]]
    path = workbook(tmp_path / "run.xlsx", table_rows(*head), more=[("Notes", [["nothing", "here"]])])
    recording = imported(tmp_path, path, "--time", "Zeit", "--theta", "winkel", "--duty", "PWM")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE))
    np.testing.assert_allclose(recording.t, TIME, atol=1e-9)
    np.testing.assert_allclose(recording.duty, DUTY / 100, atol=1e-7)


def test_a_workbook_with_dates(tmp_path):
    begin = datetime.datetime(2024, 4, 3, 12, 34, 40)
    rows = [[begin + datetime.timedelta(seconds=float(t)), float(x)] for t, x in zip(TIME, ANGLE)]
    recording = imported(tmp_path, workbook(tmp_path / "run.xlsx", [["Zeit", "x"], *rows]), "--time", "Zeit", "--theta",
                         "x:deg")
    np.testing.assert_allclose(recording.t, TIME, atol=2e-3)  # Excel keeps ms


def test_workbooks_that_cannot_be_used(tmp_path, capsys):
    two = workbook(tmp_path / "two.xlsx", table_rows(["t", "x", "u"]), more=[("Other", table_rows())])
    assert "several sheets hold tables (Data, Other): choose one with --sheet" in refused(capsys, two, tmp_path / "b",
                                                                                        *MAPPED)
    assert len(imported(tmp_path, two, "--sheet", "Other", "--time", "1:s", "--theta", "2:deg")) == len(TIME)
    said = refused(capsys, two, tmp_path / "b", *MAPPED, "--sheet", "X")
    assert "has no sheet 'X'; its sheets are Data, Other" in said
    none = workbook(tmp_path / "none.xlsx", [["a", "b"], ["c", "d"]])
    assert "no table of numbers" in refused(capsys, none, tmp_path / "b", *MAPPED)
    rows = table_rows(["t", "x", "u"])
    rows[7][1] = "1,5"
    german = workbook(tmp_path / "german.xlsx", rows)
    assert "row 8, column 2 (x): '1,5' is text with a decimal comma" in refused(capsys, german, tmp_path / "b", *MAPPED)
    rows[7][1] = datetime.datetime(2024, 1, 5)
    dated = workbook(tmp_path / "dated.xlsx", rows)
    assert "is a date or time, others are not" in refused(capsys, dated, tmp_path / "b", *MAPPED)
    (tmp_path / "old.xls").write_bytes(b"\xd0\xcf\x11\xe0" + bytes(200))
    assert "old Excel file" in refused(capsys, tmp_path / "old.xls", tmp_path / "b", *MAPPED)


def test_what_would_fill_the_memory_is_refused(tmp_path, capsys):
    with zipfile.ZipFile(tmp_path / "bomb.xlsx", "w") as archive:
        archive.writestr("xl/worksheets/sheet1.xml", "")
        archive.infolist()[0].file_size = 600 << 20
    assert "would take 600 MiB unpacked" in refused(capsys, tmp_path / "bomb.xlsx", tmp_path / "b", *MAPPED)
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w") as archive:
        archive.writestr("t.npy", head.getvalue())
    assert "shorter than it says" in refused(capsys, tmp_path / "bomb.npz", tmp_path / "b", *MAPPED)
    packed = zlib.compress(bytes(32 << 20), 1)
    element = (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little") + packed
    (tmp_path / "bomb.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + 17 * element)
    assert "more than 512 MiB unpacked" in refused(capsys, tmp_path / "bomb.mat", tmp_path / "b", *MAPPED)
    (tmp_path / "wide.csv").write_text(lines(*np.ones((1100, 5)), form="{:.0f}"))
    assert "more than 1000" in refused(capsys, tmp_path / "wide.csv", tmp_path / "b", "--time", "1:s")


@pytest.mark.promise("Tables", "`import` reads CSV, text, Excel, MATLAB and NumPy")
def test_matlab_files(tmp_path, capsys):
    scipy.io.savemat(tmp_path / "run.mat", {"t": TIME, "log": {"angle": ANGLE[:, None], "note": "hello"}, "k": 3.0,
                                            "both": np.stack((TIME, ANGLE)), "short": TIME[:50]})
    recording = imported(tmp_path, tmp_path / "run.mat", "--time", "t:s", "--theta", "log.angle:deg")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE))
    said = capsys.readouterr().out
    assert "short (50)" in said
    assert "left out: log.note" in said
    recording = imported(tmp_path, tmp_path / "run.mat", "--time", "both[1]:s", "--theta", "both[2]:deg")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE))
    with h5py.File(tmp_path / "new.mat", "w", userblock_size=512) as file:
        file["t"], file["log/angle"] = TIME[None, :], ANGLE[None, :]
        file["out"] = h5py.ExternalLink("/etc/passwd", "/")
    with (tmp_path / "new.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    recording = imported(tmp_path, tmp_path / "new.mat", "--time", "t:s", "--theta", "log.angle:deg")
    np.testing.assert_allclose(recording.theta, np.radians(ANGLE))


@pytest.mark.promise("Tables", "`import` reads the layouts of MATLAB and Simulink")
@pytest.mark.parametrize("layout", ["v4", "To File", "structure with time", "cells", "timeseries"])
def test_layouts_of_matlab_and_simulink(tmp_path, layout):
    duty = PUSH / 100.0
    both = np.stack((LONG, DRIVEN, duty))
    signals = np.array([(DRIVEN[:, None], "angle"), (duty[:, None], "u")], dtype=[("values", "O"), ("label", "O")])
    holds = {"v4": {"Log": both}, "To File": {"ans": both}, "timeseries": {
        "angle": {"Time": LONG[:, None], "Data": DRIVEN[:, None]}, "u": {"Time": LONG[:, None], "Data": duty[:, None]}},
        "structure with time": {"scope": {"time": LONG[:, None], "signals": signals}},
        "cells": {"t": LONG, "logs": np.array([DRIVEN, duty, None], dtype=object)[:2]}}[layout]
    scipy.io.savemat(tmp_path / "run.mat", holds, format="4" if layout == "v4" else "5")
    recording = imported(tmp_path, tmp_path / "run.mat", "--accept")
    np.testing.assert_allclose(recording.theta, np.radians(DRIVEN))
    np.testing.assert_allclose(recording.duty, duty, atol=1e-7)


def test_objects_of_matlab_are_named_with_what_to_do(monkeypatch):
    arrays = {f"rig{files.OPAQUE}": np.zeros(0)}
    with pytest.raises(TableError, match=r"run.mat: holds a table or timeseries object.*writetable\(T, 'run.csv'\)"):
        files._of_arrays(Path("run.mat"), arrays)
    (note,) = files._of_arrays(Path("run.mat"), {**arrays, "t": TIME}).notes
    assert note.startswith("left out: rig, a table or timeseries object")


@pytest.mark.parametrize("start", [b"t,x\n0.0,1.0\n0.1,1.1\n", bytes(40), b"\x00" * 4 + b"abcdefghijklmnopqrstuvwxyz"])
def test_other_files_are_not_taken_for_matlab_4(start):
    assert not files.is_matlab_4(start)


@pytest.mark.promise("Tables", "`import` reads CSV, text, Excel, MATLAB and NumPy")
def test_numpy_files(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.stack((TIME, ANGLE), axis=1))
    np.savez(tmp_path / "b.npz", t=TIME, x=ANGLE.astype(np.float32), name=np.array("rig"))
    np.save(tmp_path / "c.npy", np.rec.fromarrays([TIME, ANGLE], names="t,x"))
    for name, options in (("a.npy", ("--time", "1:s", "--theta", "2:deg")), ("b.npz", MAPPED), ("c.npy", MAPPED)):
        recording = imported(tmp_path, tmp_path / name, *options)
        np.testing.assert_allclose(recording.theta, np.radians(ANGLE), rtol=1e-6)
    np.save(tmp_path / "d.npy", np.array([{"t": 1}, 2]), allow_pickle=True)
    assert "holds Python objects" in refused(capsys, tmp_path / "d.npy", tmp_path / "b", *MAPPED)


SEEDS = {}


def seed(name):
    """The bytes of a small file of each kind."""
    if name not in SEEDS:
        file = io.BytesIO()
        if name == "xlsx":
            workbook(file, table_rows(["t", "x", "u"])[:30])
        elif name == "npy":
            np.save(file, np.stack((TIME, ANGLE), axis=1))
        elif name == "npz":
            np.savez(file, t=TIME, x=ANGLE)
        else:
            file.write(("t;x\n" + comma(lines(TIME[:30], ANGLE[:30], split=";"))).encode("utf-16"))
        SEEDS[name] = file.getvalue()
    return SEEDS[name]


@given(name=st.sampled_from(["xlsx", "npy", "npz", "text"]), damage=st.lists(
    st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=8),
    end=st.floats(0.1, 1.0))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path_factory, name, damage, end):
    raw = bytearray(seed(name))
    for place, byte in damage:
        raw[int(place * len(raw))] = byte
    path = tmp_path_factory.mktemp("damaged") / "file"
    path.write_bytes(raw[: int(end * len(raw))])
    try:
        said = f"{len(files.read(path).columns)} columns"
    except TableError as error:
        said = str(error)
    assert said
    assert "\n" not in said


def test_a_matlab_file_that_crashes_its_reader_is_refused(tmp_path, capsys):
    scipy.io.savemat(tmp_path / "run.mat", {"t": TIME, "s": {"a": ANGLE}})
    raw = bytearray((tmp_path / "run.mat").read_bytes())
    for k in range(128, len(raw), 97):
        raw[k] ^= 0x5A
    (tmp_path / "run.mat").write_bytes(raw)
    assert "cannot be read as a MATLAB file" in refused(capsys, tmp_path / "run.mat", tmp_path / "b", *MAPPED)
