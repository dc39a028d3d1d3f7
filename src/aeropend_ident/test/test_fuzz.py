# SPDX-License-Identifier: Apache-2.0
"""Bags from strangers: a recording, or one line that says why not. `FUZZ=100` tries a hundred times as much."""

import csv
import io
import os
import sqlite3
import struct
import subprocess
import sys
import tempfile
import zlib
from contextlib import closing
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from aeropend_control.analysis import step_report
from aeropend_ident.bags.cdr import LONGEST, decode
from aeropend_ident.bags.msgtypes import message_class
from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.bags.recording import read
from aeropend_ident.commands import recover
from aeropend_ident.commands.diagnose import print_table
from aeropend_ident.diagnosis import batch

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

FUZZ = int(os.environ.get("FUZZ", "1"))
HOSTILE = "</script><script>alert(1)</script>\"><img src=x onerror=alert(2)>{{ 7 * 7 }}[/b]"
LIES = [0, 1, 21, 2**16 - 1, 2**28, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1]
JOINT, BATTERY = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState"
FORMS = {
    "mcap": ("mcap", {}),
    "mcap zstd": ("mcap", {"fmt": CompressionFormat.ZSTD, "mode": CompressionMode.STORAGE}),
    "messages zstd": ("mcap", {"fmt": CompressionFormat.ZSTD, "mode": CompressionMode.MESSAGE}),
    "file zstd": ("mcap", {"fmt": CompressionFormat.ZSTD, "mode": CompressionMode.FILE}),
    "sqlite3": ("sqlite3", {}),
}


def settled(examples):
    return settings(max_examples=examples * FUZZ, deadline=None, derandomize=True, database=None)


PLACES = st.one_of(st.integers(0, 400), st.integers(0, 1 << 20))
EDITS = st.lists(st.one_of(
    st.tuples(st.just("flip"), PLACES, st.integers(1, 255)),
    st.tuples(st.just("put"), PLACES, st.tuples(st.sampled_from(["<H", "<I", "<Q", ">I"]), st.sampled_from(LIES))),
    st.tuples(st.just("cut"), PLACES, st.integers(1, 500)),
    st.tuples(st.just("double"), PLACES, st.integers(1, 500)),
    st.tuples(st.just("end"), PLACES, st.just(0))), min_size=1, max_size=5)


def edited(data, edits):
    data = bytearray(data)
    for what, place, value in edits:
        at = place % (len(data) + 1)
        if what == "flip" and at < len(data):
            data[at] ^= value
        elif what == "put":
            form, lie = value
            new = struct.pack(form, lie % (1 << 8 * struct.calcsize(form)))
            data[at : at + len(new)] = new
        elif what == "cut":
            del data[at : at + value]
        elif what == "double":
            data[at:at] = data[at : at + value]
        elif what == "end":
            del data[at:]
    return bytes(data)


@pytest.fixture(scope="module")
def whole(bags, tmp_path_factory):
    """A good bag of each form: the names and contents of its files."""
    folder, made = tmp_path_factory.mktemp("whole"), bags.content(40)
    good = {}
    for name, (storage, compression) in FORMS.items():
        path = bags.write(folder / name, made, storage, **compression)
        good[name] = {file.name: file.read_bytes() for file in path.iterdir()}
    return good


def done(act):
    """What this returns, or the line that it says instead."""
    try:
        return act()
    except RecordingError as error:
        return [str(error)]


def shown(recovered):
    return [*recovered.problems, *recovered.counts]


def use(folder, path):
    """Read a bag and recover it: each works, or says in one line why not; nothing is left beside it."""
    temporary, tempfile.tempdir = tempfile.tempdir, str(folder / "tmp")
    (folder / "tmp").mkdir()
    said = []
    try:
        said += done(lambda: read(path).notes)
        said += done(lambda: shown(recover.recover(path, folder / "recovered")))
    finally:
        tempfile.tempdir = temporary
    assert all(line.isprintable() and line for line in said)
    assert list((folder / "tmp").iterdir()) == []
    assert {one.name for one in folder.iterdir()} <= {"tmp", "recovered", path.name}
    return said


@pytest.mark.parametrize("form", FORMS)
def test_a_damaged_bag_is_a_recording_or_one_line(whole, form):
    files = whole[form]
    (data,) = (name for name in files if name != "metadata.yaml")

    @settled(70)
    @given(EDITS, st.booleans())
    def try_it(edits, with_metadata):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag"
            path.mkdir()
            (path / data).write_bytes(edited(files[data], edits))
            if with_metadata:
                (path / "metadata.yaml").write_bytes(files["metadata.yaml"])
            use(Path(folder), path)

    try_it()


def test_damaged_metadata_is_a_recording_or_one_line(whole):
    files = whole["mcap"]

    @settled(70)
    @given(EDITS)
    def try_it(edits):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag"
            path.mkdir()
            (path / "bag.mcap").write_bytes(next(data for name, data in files.items() if name.endswith(".mcap")))
            (path / "metadata.yaml").write_bytes(edited(files["metadata.yaml"], edits))
            use(Path(folder), path)

    try_it()


@settled(150)
@given(st.lists(st.binary(max_size=120), max_size=8), st.lists(EDITS, max_size=6), st.sampled_from([JOINT, BATTERY]))
def test_any_message_is_decoded_or_counted(bags_of_bytes, edits, msgtype):
    messages = [*bags_of_bytes, *(edited(GOOD[msgtype], edit) for edit in edits)]
    blocks, failed = decode(messages, msgtype)
    assert sorted([*failed, *(row for block in blocks for row in block.rows.tolist())]) == list(range(len(messages)))


def test_a_message_that_is_far_too_long_is_not_decoded(bags):
    name = "x" * (LONGEST + 1)
    assert decode([bags.joint(0, [0.0], [0.0], [name]), bags.joint(0, [0.0], [0.0], ["arm"])], JOINT)[1] == [0]


@settled(60)
@given(st.lists(st.tuples(st.sampled_from(["sec", "nanosec", "value"]), st.integers(0, 39), st.sampled_from(LIES),
                          st.sampled_from([0.0, -0.0, 1e308, -1e308, 5e-324, np.inf, -np.inf, np.nan])), max_size=6))
def test_any_numbers_make_a_recording(hostile):
    messages = []
    for row in range(40):
        stamp = 1_700_000_000_000_000_000 + row * 2_040_000
        message = bytearray(GOOD[BATTERY])
        sec, nanosec = divmod(stamp, 10**9)
        for what, at, lie, value in hostile:
            if at == row and what == "value":
                struct.pack_into("<f", message, 16, np.float32(value) if abs(value) < 1e38 else value / 1e308)
            elif at == row:
                sec, nanosec = (lie, nanosec) if what == "sec" else (sec, lie)
        struct.pack_into("<II", message, 4, sec % 2**32, nanosec % 2**32)
        messages.append(("/armature", BATTERY, stamp, bytes(message)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        path.write_bytes(mcap([(1, "/armature", BATTERY, [(when, data) for _, _, when, data in messages])]))
        use(Path(folder), path)


# ---- by hand


def text(value):
    data = value if isinstance(value, bytes) else value.encode()
    return struct.pack("<I", len(data)) + data


def record(opcode, body, length=None):
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


def chunk(data, compression="", size=None, packed=None):
    body = struct.pack("<QQQI", 0, 0, len(data) if size is None else size, zlib.crc32(data))
    packed = data if packed is None else packed
    return record(0x06, body + text(compression) + struct.pack("<Q", len(packed)) + packed)


def mcap(topics, *more, encoding="ros2msg", definition="float64 data\n", qos=""):
    """An MCAP file of topics (id, name, type, messages) and whatever records follow."""
    out = b""
    for number, topic, msgtype, messages in topics:
        out += record(0x03, struct.pack("<H", number) + text(msgtype) + text(encoding) + text(definition))
        extra = text("offered_qos_profiles") + text(qos)
        out += record(0x04, struct.pack("<HH", number, number) + text(topic) + text("cdr") + text(extra))
        for when, data in messages:
            out += record(0x05, struct.pack("<HIQQ", number, 0, when, when) + data)
    return b"\x89MCAP0\r\n" + out + b"".join(more)


GOOD = {
    JOINT: bytes.fromhex("00010000") + struct.pack("<IIII", 1, 2, 1, 0) + struct.pack("<I", 2) + text(b"arm\0")
    + text(b"rotor\0") + bytes(2) + struct.pack("<IIddIIddII", 2, 0, 0.1, 0.2, 2, 0, 0.3, 0.4, 0, 0),
    BATTERY: bytes.fromhex("00010000") + struct.pack("<III", 1, 2, 1) + bytes(4) + struct.pack("<7f", *[0.5] * 7)
    + bytes(4) + struct.pack("<II", 0, 0) + text(b"a\0") + bytes(2) + text(b"\0"),
}
MESSAGES = [(1_700_000_000_000_000_000 + k * 2_040_000, GOOD[BATTERY]) for k in range(3)]


def test_topics_that_are_no_names_are_not_shown(tmp_path):
    names = ("/a\x1b[2J/armature", "/a\n/armature", "/" + "a" * 300 + "/armature", "/a\u202e/armature")
    for number, name in enumerate(names):
        (tmp_path / f"{number}").mkdir()
        (tmp_path / f"{number}" / "a.mcap").write_bytes(mcap([(1, name, BATTERY, MESSAGES)]))
        said = use(tmp_path / f"{number}", tmp_path / f"{number}" / "a.mcap")
        assert said
        assert all("a.mcap: " in line for line in said)
    (tmp_path / "html").mkdir()
    (tmp_path / "html" / "a.mcap").write_bytes(mcap([(1, f"/{HOSTILE}/armature", BATTERY, MESSAGES)]))
    assert read(tmp_path / "html" / "a.mcap").namespace == f"/{HOSTILE}"  # text like any other: reports escape it


def test_a_receive_time_beyond_all_clocks_is_no_message(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(mcap([(1, "/armature", BATTERY, [*MESSAGES, (2**64 - 1, GOOD[BATTERY])])]))
    assert len(use(tmp_path, path)) > 0


@pytest.mark.parametrize("name", ["../outside.mcap", "/etc/passwd", "a\0b.mcap", "..", "", "x" * 300 + ".mcap"])
def test_metadata_cannot_name_files_elsewhere(whole, tmp_path, name):
    path = tmp_path / "bag"
    path.mkdir()
    (tmp_path / "outside.mcap").write_bytes(whole["mcap"]["mcap.mcap"])
    metadata = whole["mcap"]["metadata.yaml"].decode().replace("mcap.mcap", repr(name)[1:-1].replace("\\x00", "?"))
    (path / "metadata.yaml").write_text(metadata)
    with pytest.raises(RecordingError) as caught:
        read(path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("program", [
    """CREATE VIEW messages AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)
       SELECT x AS id, 1 AS topic_id, x AS timestamp, zeroblob(100000) AS data FROM n""",
    """CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
       data BLOB AS (zeroblob(1000000000)))""",
    "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
    """CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, zeroblob(9) AS data;
       CREATE TABLE odd(a);
       PRAGMA writable_schema=ON;
       UPDATE sqlite_master SET sql = CAST(CAST('CREATE TABLE "a' AS BLOB) || x'ff' || CAST('"(a)' AS BLOB) AS TEXT)
       WHERE name = 'odd'""",
])
def test_a_database_that_computes_is_refused(whole, tmp_path, program):
    path = tmp_path / "a.db3"
    path.write_bytes(whole["sqlite3"]["sqlite3.db3"])
    with closing(sqlite3.connect(path)) as base:
        base.executescript(f"DROP TABLE messages; {program};")
    assert use(tmp_path, path) == [f"{path}: holds views or columns that compute what they show: not a bag"] * 2


def test_a_database_whose_columns_have_no_names_is_one_line(whole, tmp_path):
    data = whole["sqlite3"]["sqlite3.db3"]
    (tmp_path / "a.db3").write_bytes(data.replace(b"serialization_format TEXT", b"serialization_forma\xa2 TEXT"))
    assert (tmp_path / "a.db3").read_bytes() != data
    assert len(use(tmp_path, tmp_path / "a.db3")) > 0


def test_a_database_of_other_types_is_read_as_far_as_it_goes(whole, tmp_path):
    path = tmp_path / "a.db3"
    path.write_bytes(whole["sqlite3"]["sqlite3.db3"])
    with closing(sqlite3.connect(path)) as base:
        base.execute("UPDATE messages SET data = 'text' WHERE id = 3")
        base.execute("UPDATE messages SET timestamp = 'soon' WHERE id = 5")
        base.execute("UPDATE messages SET data = 3, timestamp = 1.5 WHERE id = 7")
        base.execute("UPDATE topics SET offered_qos_profiles = ?", ("[" * 100_000,))
        base.commit()
    said = use(tmp_path, path)
    assert any("nested deeper" in line for line in said)


IDL = "module a { module msg { module X_Constants { const long C = %s; }; struct X { long a; }; }; };"


@pytest.mark.parametrize(("msgtype", "encoding", "definition"), [
    ("a/msg/X", "ros2msg", "a/msg/X again\n"),
    ("9/msg/1", "ros2msg", "int32 a\n"),
    ("a/msg/X:\n    pass\nopen('pwned', 'w')\nclass B", "ros2msg", "int32 x\n"),
    ("a/msg/X'; open('pwned', 'w'); '", "ros2msg", "int32 x\n"),
    ("a/msg/X", "ros2msg", "string C='\\'; open('pwned', 'w')'\nint32 x\n"),
    ("a/msg/X", "ros2msg", "int32[99999999999] a\nint32 A=" + "9" * 5000 + "\n"),
    ("a/msg/X", "ros2idl", IDL % ("(" * 30 + "1" + ")" * 30)),
    ("a/msg/X", "ros2idl", IDL % "1" + "//" + "x" * 200_000),
    ("antigravity/msg/X", "", ""),
    ("../../a/msg/X", "", ""),
])
def test_definitions_run_no_code_and_come_to_an_end(tmp_path, monkeypatch, msgtype, encoding, definition):
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    topics = [(1, "/armature", BATTERY, MESSAGES), (2, "/x", msgtype, [(1, b"\0\1\0\0abcd")])]
    (tmp_path / "a.mcap").write_bytes(mcap(topics, encoding=encoding, definition=definition))
    done = recover.recover(tmp_path / "a.mcap", tmp_path / "out")
    assert done.counts["/armature"] == 3
    assert list(folder.iterdir()) == []
    assert "antigravity" not in sys.modules


@pytest.mark.parametrize("name", ["antigravity/msg/X", "os/msg/path", "../a/msg/X", "sensor_msgs/msg/../X", "", "/msg/",
                                  "sensor_msgs/msg/__loader__"])
def test_no_module_is_imported_by_the_word_of_a_bag(name):
    with pytest.raises(LookupError):
        message_class(name)
    assert "antigravity" not in sys.modules


def test_an_idl_definition_of_the_kind_that_ros_writes_is_taken():
    definition = IDL.replace("struct", '@verbatim (language="comment", text="(a" "b)")\n// (c)\nstruct') % "-3"
    recover._check_idl(definition)
    extra = ConnectionExtRosbag2("cdr", [])
    message = MessageDefinition(MessageDefinitionFormat.IDL, definition)
    assert Connection(1, "/x", "a/msg/X", message, "", 0, extra, None).msgdef.data == definition


ZEROS = 1 << 31
BOMB = """
import resource, sys
from pathlib import Path
from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.bags.recording import read
resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read(Path(sys.argv[1]))
except RecordingError as error:
    print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def packed_zeros(size, form):
    """Zeros by the gigabyte, packed."""
    zeros = bytes(1 << 24)
    out = io.BytesIO()
    packer = zstd.ZstdCompressor() if form == "zstd" else lz4.frame.LZ4FrameCompressor()
    if form == "lz4":
        out.write(packer.begin())
    for _ in range(size >> 24):
        out.write(packer.compress(zeros))
    out.write(packer.flush())
    return out.getvalue()


def sparse(path, size):
    with path.open("r+b") as stream:
        stream.truncate(size)


@pytest.mark.parametrize("kind", ["zstd chunk", "lz4 chunk", "file", "declared", "many"])
def test_a_bomb_takes_no_more_memory_than_a_long_recording(tmp_path, kind):
    path = tmp_path / "a.mcap"
    good = mcap([(1, "/armature", BATTERY, MESSAGES)])
    if kind.endswith("chunk"):
        path.write_bytes(good + chunk(b"", kind[:-6], ZEROS, packed_zeros(ZEROS, kind[:-6])))
    elif kind == "file":
        path = tmp_path / "a.mcap.zstd"
        path.write_bytes(packed_zeros(ZEROS, "zstd"))
    elif kind == "declared":
        path.write_bytes(good + record(0x06, b"", ZEROS))
        sparse(path, ZEROS + 10_000)
    else:
        body = record(0x05, struct.pack("<HIQQ", 9, 0, 1, 1) + bytes(1 << 27))
        one = chunk(body, "zstd", len(body), zstd.compress(body))
        path.write_bytes(good + one * 12)
    result = subprocess.run([sys.executable, "-c", BOMB, str(path)], capture_output=True, text=True, check=True,
                            timeout=250, env={**os.environ, "TMPDIR": str(tmp_path)})
    *said, grown = result.stdout.splitlines()
    assert int(grown) < 900
    if kind in ("file", "many"):
        assert said == [f"{path}: unpacks to more than 100 times its size: not a recording"]


# ---- what is shown of names


def test_a_table_shows_names_and_runs_none(capsys):
    print_table([{"recording": f"{HOSTILE}\x1b[2J\udcff", "error": f"{HOSTILE}\n"}])
    assert HOSTILE in capsys.readouterr().out.replace("\n", "")


@pytest.mark.parametrize("name", ["=HYPERLINK(\"http://x\")", "+1", "-2", "@SUM(A1)", "=cmd|' /C calc'!A0", "a\nb",
                                  "a\udcff"])
def test_the_summary_holds_no_formulas(tmp_path, name):
    batch.write_summary(tmp_path, [batch.row(batch.Outcome(name, None, f"{name}: no such file"), "x")])
    with (tmp_path / batch.SUMMARY).open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert not any(value.startswith(("=", "+", "-", "@", "\t", "\r")) for value in row.values())
    assert row["recording"].isprintable()
    assert name.startswith("a") or Path(row["recording"]) == Path(name)


def test_a_drawing_shows_names_as_text():
    t = np.linspace(0.0, 1.0, 50)
    drawing = step_report.draw(t, t, t, t, f"{HOSTILE}\x1b\udcff", "rad")
    assert "<script" not in drawing
    assert "<img" not in drawing
    drawing.encode()
