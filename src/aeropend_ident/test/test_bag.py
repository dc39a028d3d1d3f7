# SPDX-License-Identifier: Apache-2.0
"""Bags in the forms of `ros2 bag record`, and broken at every kind of place."""

import shutil
import sqlite3
import tempfile
from pathlib import Path

import mcap.writer
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from aeropend_ident.bags.container import Bag
from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.bags.recording import CHANNELS, read

QOS = """- history: 3
  depth: 0
  reliability: 1
  durability: 2
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""
QOS_9 = (
    QOS.replace("history: 3", "history: unknown")
    .replace("reliability: 1", "reliability: reliable")
    .replace("durability: 2", "durability: volatile")
    .replace("liveliness: 1", "liveliness: automatic")
)


def metadata(version, files, content, storage="sqlite3", mode="", form=""):
    """Write metadata.yaml as the rosbag2 of that version does."""
    counts = {}
    for topic, msgtype, _, _ in content.messages:
        counts[topic, msgtype] = counts.get((topic, msgtype), 0) + 1
    times = [one[2] for one in content.messages]
    span = f"""duration:
    nanoseconds: {max(times) - min(times)}
  starting_time:
    nanoseconds_since_epoch: {min(times)}
  message_count: {len(times)}"""
    lines = ["rosbag2_bagfile_information:", f"  version: {version}", f"  storage_identifier: {storage}", f"  {span}"]
    lines.append("  topics_with_message_count:")
    for (topic, msgtype), count in counts.items():
        lines += ["    - topic_metadata:", f"        name: {topic}", f"        type: {msgtype}"]
        lines.append("        serialization_format: cdr")
        if version >= 9:
            lines.append("        offered_qos_profiles:")
            lines += ["          " + line for line in QOS_9.splitlines()]
        elif version >= 4:
            escaped = QOS.replace("\n", "\\n")
            lines.append(f'        offered_qos_profiles: "{escaped}"')
        if version >= 7:
            lines.append(f"        type_description_hash: RIHS01_{'0' * 64}")
        lines.append(f"      message_count: {count}")
    if version >= 3:
        lines += [f'  compression_format: "{form}"', f'  compression_mode: "{mode}"']
    lines.append("  relative_file_paths:")
    lines += [f"    - {'old_bag/' if version < 4 else ''}{file}" for file in files]
    if version >= 5:
        lines.append("  files:")
        for file in files:
            lines += [f"    - path: {file}", *("      " + line for line in span.replace("\n  ", "\n").splitlines())]
    if version >= 6:
        lines.append("  custom_data: ~")
    if version >= 8:
        lines.append("  ros_distro: jazzy")
    return "\n".join(lines) + "\n"


def database(path, content, version):
    """Write an SQLite file as the rosbag2 of that version does."""
    base = sqlite3.connect(path)
    if version >= 5:
        base.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)")
        base.execute("INSERT INTO schema VALUES(?, 'x')", (2 if version < 6 else 3 if version < 7 else 4,))
        if version >= 6:
            base.execute(
                "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL,"
                " metadata TEXT NOT NULL)"
            )
            base.execute(
                "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,"
                " encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,"
                " type_description_hash TEXT NOT NULL)"
            )
    columns = "id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL"
    columns += ", offered_qos_profiles TEXT NOT NULL" if version >= 4 else ""
    columns += ", type_description_hash TEXT NOT NULL" if version >= 7 else ""
    base.execute(f"CREATE TABLE topics({columns})")
    base.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
        " data BLOB NOT NULL)"
    )
    base.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    topics = {}
    for topic, msgtype, received, message in content.messages:
        if topic not in topics:
            topics[topic] = len(topics) + 1
            row = [topics[topic], topic, msgtype, "cdr"]
            row += ([QOS] if version >= 4 else []) + ([""] if version >= 7 else [])
            base.execute(f"INSERT INTO topics VALUES({', '.join('?' * len(row))})", row)
        values = (topics[topic], received, message)
        base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", values)
    base.commit()
    base.close()


def mcap_file(path, bags, content, *, cut=None, **options):
    """Write an MCAP file with the official library; with `cut`, leave it open after that many messages."""
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **options)
        writer.start("ros2", "test")
        channels = {}
        for topic, msgtype, received, message in content.messages[:cut]:
            if topic not in channels:
                text = bags.store.generate_msgdef(msgtype, ros_version=2)[0]
                schema = writer.register_schema(msgtype, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": QOS})
            writer.add_message(channels[topic], received, message, received)
        if cut is None:
            writer.finish()
    return path


def same(recording, made, count=None):
    for name in ("stamp_ns", *CHANNELS):
        np.testing.assert_array_equal(getattr(recording, name), made.arrays[name][:count], err_msg=name)


@pytest.mark.promise("Recordings", "Bags of `ros2 bag record` are read, MCAP and SQLite3, compressed and split")
@pytest.mark.parametrize("version", range(1, 10))
def test_sqlite_of_every_version(bags, tmp_path, version):
    made = bags.content()
    database(tmp_path / "old_bag_0.db3", made, version)
    (tmp_path / "metadata.yaml").write_text(metadata(version, ["old_bag_0.db3"], made))
    recording = read(tmp_path)
    same(recording, made)
    assert recording.complete


@pytest.mark.promise("Recordings", "Bags of `ros2 bag record` are read, MCAP and SQLite3, compressed and split")
@pytest.mark.parametrize("version", [5, 6, 9])
@pytest.mark.parametrize(
    "options",
    [
        {"compression": mcap.writer.CompressionType.NONE},
        {"compression": mcap.writer.CompressionType.ZSTD, "chunk_size": 2000},
        {"compression": mcap.writer.CompressionType.LZ4, "chunk_size": 2000},
        {"use_chunking": False},
        {"index_types": mcap.writer.IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
    ],
)
def test_mcap_of_every_kind(bags, tmp_path, version, options):
    made = bags.content()
    mcap_file(tmp_path / "bag_0.mcap", bags, made, **options)
    (tmp_path / "metadata.yaml").write_text(metadata(version, ["bag_0.mcap"], made, "mcap"))
    recording = read(tmp_path)
    same(recording, made)
    assert recording.complete
    connection = next(Bag(tmp_path).messages())[0]
    assert connection.ext.offered_qos_profiles[0].reliability.name == "RELIABLE"


@pytest.mark.promise("Recordings", "Bags of `ros2 bag record` are read, MCAP and SQLite3, compressed and split")
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE])
def test_compressed(bags, tmp_path, storage, mode):
    if (storage, mode) == ("sqlite3", CompressionMode.STORAGE):
        mode = CompressionMode.NONE  # there is no such thing
    made = bags.content()
    path = bags.write(tmp_path / "bag", made, storage, mode=mode, fmt=CompressionFormat.ZSTD)
    same(read(path), made)
    if mode == CompressionMode.FILE:
        (packed,) = path.glob("*.zstd")
        same(read(packed), made)


def test_unknown_compression_is_said(bags, tmp_path):
    made = bags.content()
    database(tmp_path / "bag_0.db3", made, 5)
    (tmp_path / "metadata.yaml").write_text(metadata(5, ["bag_0.db3"], made, mode="FILE", form="fancy"))
    with pytest.raises(RecordingError, match="compressed with 'fancy', only zstd can be read"):
        read(tmp_path)


@pytest.mark.promise("Recordings", "Bags of `ros2 bag record` are read, MCAP and SQLite3, compressed and split")
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_split_bags_are_one(bags, tmp_path, storage):
    made = bags.content(60)
    files = []
    for part in range(3):
        some = bags.Content(made.messages[part * 40 : (part + 1) * 40 if part < 2 else None])
        if storage == "mcap":
            files.append(mcap_file(tmp_path / f"bag_{part}.mcap", bags, some).name)
        else:
            database(tmp_path / f"bag_{part}.db3", some, 9)
            files.append(f"bag_{part}.db3")
    (tmp_path / "metadata.yaml").write_text(metadata(9, files, made, storage))
    same(read(tmp_path), made)
    (tmp_path / files[2]).unlink()
    recording = read(tmp_path)
    assert 0 < len(recording) < 60
    assert recording.notes[0] == f"missing though metadata.yaml names it: {files[2]}"
    assert not recording.complete


def test_metadata_that_is_missing_or_damaged_is_done_without(bags, tmp_path):
    made = bags.content()
    path = bags.write(tmp_path / "bag", made)
    for text in ("", "rosbag2_bagfile_information:\n  version: [", "- 1", "rosbag2_bagfile_information: 3", "\0\0\0"):
        (path / "metadata.yaml").write_text(text)
        recording = read(path)
        same(recording, made)
        assert recording.notes[0] == "metadata.yaml is damaged"
    (path / "metadata.yaml").unlink()
    recording = read(path)
    same(recording, made)
    assert recording.notes == (
        "metadata.yaml is missing: the recording was broken off",
        f"{len(made.messages)} messages and {recording.duration:.3f} s of samples could be read",
    )
    assert not recording.complete


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "no such file or folder"),
        (lambda path: path.mkdir(), "not a bag: no metadata.yaml and no .mcap or .db3 file in it"),
        (lambda path: path.write_text("hello"), "not a bag: .* (expected .mcap or .db3 files)"),
        (lambda path: (path.mkdir(), (path / "a.mcap").write_text("hello there")), "a.mcap: not an MCAP file"),
        (lambda path: (path.mkdir(), (path / "a.db3").write_text("hello there")), "a.db3: not an SQLite file"),
        (lambda path: (path.mkdir(), (path / "a.mcap").touch()), "holds no messages (metadata.yaml is missing"),
        (lambda path: (path.mkdir(), (path / "a.db3").touch()), "holds no messages (metadata.yaml is missing"),
        (lambda path: (path.mkdir(), (path / "metadata.yaml").write_text("a: 1")), "metadata.yaml is damaged"),
        (lambda path: (path.mkdir(), (path / "a.mcap").touch(), (path / "a.db3").touch()), "not a bag: a.db3, a.mcap"),
    ],
)
def test_what_is_no_bag_is_said_in_one_line(tmp_path, make, message):
    path = tmp_path / "bag"
    make(path)
    with pytest.raises(RecordingError) as caught:
        read(path)
    said = str(caught.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    assert all(part in said for part in message.split(" .* "))


def test_files_that_metadata_names_must_be_there(bags, tmp_path):
    (tmp_path / "metadata.yaml").write_text(metadata(9, ["bag_0.mcap"], bags.content(), "mcap"))
    with pytest.raises(RecordingError, match=r"holds none of the files its metadata\.yaml names: bag_0\.mcap"):
        read(tmp_path)


# ---- broken off ------------------------------------------------------------------------------------------------------


def read_or_refuse(path):
    """Read a bag; None when it is refused, in one line."""
    said = ""
    try:
        return read(path)
    except RecordingError as error:
        said = str(error)
    assert said.startswith(str(path))
    assert "\n" not in said
    return None


def reads_a_beginning(path, made, least):
    """Read what is left: an error in one line, or the first samples and a note. Returns their number."""
    recording = read_or_refuse(path)
    if recording is None:
        assert least == 0
        return 0
    count = len(recording)
    assert count >= least
    joints = np.isfinite(recording.theta)  # the last sample may lack its armature
    np.testing.assert_array_equal(recording.theta[joints], made.arrays["theta"][:count][joints])
    assert joints[: count - 1].all()
    np.testing.assert_array_equal(recording.duty[: count - 1], made.arrays["duty"][: count - 1])
    return count


@pytest.mark.parametrize(
    ("options", "whole_messages"),
    [
        ({"compression": mcap.writer.CompressionType.NONE}, True),
        ({"compression": mcap.writer.CompressionType.NONE, "chunk_size": 3000}, True),
        ({"use_chunking": False}, True),
        ({"compression": mcap.writer.CompressionType.ZSTD, "chunk_size": 3000}, False),
        ({"compression": mcap.writer.CompressionType.LZ4, "chunk_size": 3000}, False),
    ],
)
def test_mcap_cut_anywhere_gives_what_comes_before(bags, tmp_path, options, whole_messages):
    made = bags.content(40)
    whole = mcap_file(tmp_path / "whole.mcap", bags, made, **options).read_bytes()
    ends = [whole.find(one[3]) + len(one[3]) for one in made.messages if one[0] == "/joint_states"]
    before = 0
    path = tmp_path / "cut.mcap"
    for cut in [*range(0, len(whole), 293), *range(len(whole) - 40, len(whole))]:
        path.write_bytes(whole[:cut])
        least = sum(end <= cut for end in ends) if whole_messages else 0
        count = reads_a_beginning(path, made, least)
        assert count >= before
        before = count
        if count:
            recording = read(path)
            assert not recording.complete
            assert recording.notes[0].startswith("cut.mcap ends")
            assert recording.notes[1].endswith(f"and {recording.duration:.3f} s of samples could be read")
    assert before == 40
    path.write_bytes(whole)
    assert read(path).complete


def test_mcap_left_open_by_its_writer(bags, tmp_path):
    made = bags.content(40)
    path = mcap_file(tmp_path / "open.mcap", bags, made, cut=60, chunk_size=1000)
    assert 20 <= reads_a_beginning(path, made, 0) < 30


@pytest.mark.parametrize("compression", ["NONE", "ZSTD", "LZ4"])
def test_damaged_mcap_never_crashes(bags, tmp_path, compression):
    made = bags.content(20)
    options = {"compression": mcap.writer.CompressionType[compression], "chunk_size": 2000}
    whole = bytearray(mcap_file(tmp_path / "whole.mcap", bags, made, **options).read_bytes())
    rng = np.random.default_rng(0)
    path = tmp_path / "damaged.mcap"
    stamps = set(made.arrays["stamp_ns"].tolist())
    for at in [*range(9, 200), *rng.integers(9, len(whole), 300)]:
        damaged = whole.copy()
        damaged[at] ^= 1 << int(rng.integers(8))
        if at % 3 == 0:
            damaged[at : at + 50] = bytes(50)
        path.write_bytes(damaged)
        recording = read_or_refuse(path)
        if recording is not None:
            assert set(recording.stamp_ns.tolist()) <= stamps  # chunks have checksums: no sample is made up


def test_a_damaged_chunk_is_named_and_the_others_are_read(bags, tmp_path):
    made = bags.content(40)
    path = mcap_file(tmp_path / "bag.mcap", bags, made, compression=mcap.writer.CompressionType.NONE, chunk_size=3000)
    whole = bytearray(path.read_bytes())
    (at,) = (whole.find(one[3]) for one in made.messages if one[0] == "/joint_states" and one[2] == 20 * 2_040_000
             + made.messages[0][2])  # fmt: skip
    whole[at + 20] ^= 1
    path.write_bytes(whole)
    recording = read(path)
    assert 20 < len(recording) < 40
    assert recording.stamp_ns[-1] == made.arrays["stamp_ns"][-1]
    assert "is damaged: its checksum or size is wrong" in recording.notes[0]
    assert recording.lost > 0


@pytest.mark.parametrize("version", [5, 9])
def test_sqlite_cut_anywhere_gives_what_is_left(bags, tmp_path, version):
    made = bags.content(400)
    database(tmp_path / "whole.db3", made, version)
    whole = (tmp_path / "whole.db3").read_bytes()
    path = tmp_path / "cut.db3"
    counts = []
    for cut in [0, 10, 100, 1000, 4000, *range(4096, len(whole), 4096), *range(5000, len(whole), 9001)]:
        path.write_bytes(whole[:cut])
        recording = read_or_refuse(path)
        if recording is None:
            continue
        rows = np.searchsorted(made.arrays["stamp_ns"], recording.stamp_ns)
        np.testing.assert_array_equal(recording.stamp_ns, made.arrays["stamp_ns"][rows])
        for name in CHANNELS:
            values = getattr(recording, name)
            there = np.isfinite(values)
            np.testing.assert_array_equal(values[there], made.arrays[name][rows][there])
        assert not recording.complete
        counts.append(len(recording))
    assert len(counts) > 10
    assert max(counts) > 300
    path.write_bytes(whole)
    assert len(read(path)) == 400


def test_damaged_sqlite_never_crashes(bags, tmp_path):
    made = bags.content(100)
    database(tmp_path / "whole.db3", made, 9)
    whole = bytearray((tmp_path / "whole.db3").read_bytes())
    rng = np.random.default_rng(0)
    path = tmp_path / "damaged.db3"
    for at in [*range(0, 100, 3), *rng.integers(0, len(whole), 150)]:
        damaged = whole.copy()
        damaged[at : at + 30] = rng.bytes(len(damaged[at : at + 30]))
        path.write_bytes(damaged)
        read_or_refuse(path)


@pytest.mark.parametrize("journal", ["DELETE", "WAL"])
def test_sqlite_killed_in_a_transaction_gives_what_was_committed(bags, tmp_path, journal):
    made = bags.content(100)
    live, dead = tmp_path / "live", tmp_path / "dead"
    live.mkdir()
    committed = bags.Content(made.without("/duty_command", "/reference").messages)
    database(live / "bag.db3", bags.Content(committed.messages[:100]), 9)
    writer = sqlite3.connect(live / "bag.db3", isolation_level=None)
    writer.execute(f"PRAGMA journal_mode={journal}")
    writer.execute("PRAGMA wal_autocheckpoint=0")
    if journal == "WAL":
        writer.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", committed.messages[100][2:])
    writer.execute("PRAGMA cache_size=5")  # so that pages are written before the commit that never comes
    writer.execute("BEGIN")
    for _, _, received, message in made.messages * 20:
        writer.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", (received, message[:9]))
    shutil.copytree(live, dead)
    writer.close()
    there = {file.name: file.read_bytes() for file in dead.iterdir()}
    assert len(there) > 1
    recording = read(dead / "bag.db3")
    count = 50 + (journal == "WAL")
    assert len(recording) == count
    np.testing.assert_array_equal(recording.theta, made.arrays["theta"][:count])
    assert recording.notes[0].startswith("bag.db3 was not closed")
    assert {file.name: file.read_bytes() for file in dead.iterdir()} == there


def test_compressed_file_cut_short(bags, tmp_path):
    made = bags.content(2000)
    path = bags.write(tmp_path / "bag", made, mode=CompressionMode.FILE, fmt=CompressionFormat.ZSTD)
    (packed,) = path.glob("*.zstd")
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size // 2])
    recording = read(path)
    assert 0 < len(recording) < 2000
    assert "bag.mcap.zstd: compressed data ends early" in recording.notes


def test_a_bag_can_be_read_twice(bags, tmp_path):
    made = bags.content(30)
    path = tmp_path / "cut.mcap"
    path.write_bytes(mcap_file(tmp_path / "whole.mcap", bags, made, chunk_size=1000).read_bytes()[:-100])
    bag = Bag(path)
    first, problems = list(bag.messages()), list(bag.problems)
    assert len(problems) == 1
    assert list(bag.messages()) == first
    assert bag.problems == problems
    assert bag.counts.total() == len(first)


def test_only_the_chosen_are_given_and_all_are_counted(bags, tmp_path):
    made = bags.content(30)
    for storage in ("mcap", "sqlite3"):
        bag = Bag(bags.write(tmp_path / storage, made, storage))
        chosen = [message for _, _, message in bag.messages(lambda topic, msgtype: topic == "/armature")]
        assert chosen == [one[3] for one in made.messages if one[0] == "/armature"]
        assert bag.counts.total() == len(made.messages)
        assert bag.storage == storage


def test_folder_that_may_not_be_read(bags, processes, request):
    """As another user; for root every folder is open, so the check runs in a process that gives that up."""
    folder = Path(tempfile.mkdtemp())
    request.addfinalizer(lambda: shutil.rmtree(folder))
    folder.chmod(0o755)
    path = bags.write(folder / "bag", bags.content(5))
    code = f"""
import os, sys
from aeropend_ident.bags.recording import RecordingError, read
if os.geteuid() == 0:
    os.setuid(65534)
try:
    read({str(path)!r})
except RecordingError as error:
    sys.exit(str(error))
"""
    for part in (path / "bag.mcap", path / "metadata.yaml", path):
        mode = part.stat().st_mode
        part.chmod(0)
        status, said = processes.wait(processes.start(code=code))
        part.chmod(mode)
        assert status == 1
        assert said.strip().endswith("Permission denied")
        assert said.count("\n") == 1
        assert Path(said.split(": ")[0]).is_relative_to(path)
