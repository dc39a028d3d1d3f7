# SPDX-License-Identifier: Apache-2.0
"""The bag is whole after every checkpoint, for every reader there is."""

import io
import sqlite3
from dataclasses import fields

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError

from aeropend_ident.bags.container import Bag
from aeropend_ident.bags.recording import read
from aeropend_ident.bags.writer import BagWriter

UNFINISHED = "the recording was not closed (killed, or still running): it may end up to a second early"


def put(writer, bags, made, start=0, stop=None):
    """Write messages, entering topics as they come."""
    known = {connection.topic: connection for connection in writer.connections}
    for topic, msgtype, received, message in made.messages[start:stop]:
        if topic not in known:
            known[topic] = writer.add_connection(topic, msgtype, typestore=bags.store)
        writer.write(known[topic], received, message)


def found(path):
    """Return the messages that rosbags finds."""
    with Reader(path) as reader:
        assert reader.message_count == sum(connection.msgcount for connection in reader.connections)
        return [(connection.topic, time, message) for connection, time, message in reader.messages()]


def wanted(made, stop=None):
    return [(topic, received, message) for topic, _, received, message in made.messages[:stop]]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_whole_at_every_checkpoint(bags, tmp_path, storage):
    made = bags.content(100)
    writer = BagWriter(tmp_path / "bag", storage)
    writer.open()
    assert found(tmp_path / "bag") == []
    assert read_notes(tmp_path / "bag") == [UNFINISHED]
    for start in range(0, 200, 20):
        put(writer, bags, made, start, start + 20)
        writer.checkpoint()
        writer.checkpoint()  # nothing new: nothing changes
        assert found(tmp_path / "bag") == wanted(made, start + 20)
        assert Bag(tmp_path / "bag").problems == [UNFINISHED]
        if storage == "mcap":
            with (tmp_path / "bag" / "bag.mcap").open("rb") as stream:
                official = make_reader(stream, validate_crcs=True)
                assert official.get_summary().statistics.message_count == start + 20
                assert [message.data for _, _, message in official.iter_messages()] == [
                    one[3] for one in made.messages[: start + 20]
                ]
    put(writer, bags, made, 200)
    writer.close()
    assert found(tmp_path / "bag") == wanted(made)
    recording = read(tmp_path / "bag")
    assert recording.complete
    assert recording.notes == ()


def read_notes(path):
    bag = Bag(path)
    assert not list(bag.messages())
    return bag.problems


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_ends_as_rosbags_would_end_it(bags, tmp_path, storage):
    """Checkpoints leave no trace in the metadata, the schemas or the messages."""
    made = bags.content(50)
    writer = BagWriter(tmp_path / "a" / "bag", storage)
    writer.open()
    for start in range(0, 200, 10):
        put(writer, bags, made, start, start + 10)
        writer.checkpoint()
    writer.close()
    with Writer(tmp_path / "b" / "bag", version=9, storage_plugin=StoragePlugin[storage.upper()]) as plain:
        put(plain, bags, made)
    ours, theirs = ((tmp_path / folder / "bag" / "metadata.yaml").read_text() for folder in "ab")
    assert ours == theirs
    assert sorted(file.name for file in (tmp_path / "a" / "bag").iterdir()) == sorted(
        file.name for file in (tmp_path / "b" / "bag").iterdir()
    )
    assert found(tmp_path / "a" / "bag") == found(tmp_path / "b" / "bag")


@pytest.mark.promise("Views", "Drawing and bags are read by the libraries of RViz and Foxglove")
def test_foxglove_s_own_reader_decodes_every_message_by_the_schemas_in_the_file(bags, tmp_path):
    made = bags.content(10)
    writer = BagWriter(tmp_path / "bag")
    writer.open()
    put(writer, bags, made)
    writer.close()
    with (tmp_path / "bag" / "bag.mcap").open("rb") as stream:
        read = [(channel.topic, message) for _, channel, _, message in
                make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()]
    assert len(read) == len(made.messages)
    for (topic, message), (put_on, msgtype, _, data) in zip(read, made.messages, strict=True):
        assert topic == put_on
        assert_same(message, bags.store.deserialize_cdr(data, msgtype))


def assert_same(read, wanted):
    """Field by field, through all messages within messages."""
    if hasattr(wanted, "__msgtype__"):
        for field in fields(wanted):
            if field.name != "__msgtype__" and not field.name.isupper():  # in capitals: constants
                assert_same(getattr(read, field.name), getattr(wanted, field.name))
    elif isinstance(wanted, (list, np.ndarray)):
        assert len(read) == len(wanted)
        for one, other in zip(read, wanted, strict=True):
            assert_same(one, other)
    else:
        assert read == wanted or (read != read and wanted != wanted)


def test_metadata_has_the_fields_of_version_9(bags, tmp_path):
    """The keys that rosbag2 of Jazzy writes, none more, none less, with the types it reads them as."""
    writer = BagWriter(tmp_path / "bag")
    writer.open()
    put(writer, bags, bags.content(10))
    writer.close()
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    kinds = {
        "version": int, "storage_identifier": str, "duration": dict, "starting_time": dict, "message_count": int,
        "topics_with_message_count": list, "compression_format": str, "compression_mode": str,
        "relative_file_paths": list, "files": list, "custom_data": type(None), "ros_distro": str,
    }  # fmt: skip
    assert {key: type(value) for key, value in information.items()} == kinds
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert set(information["duration"]) == {"nanoseconds"}
    assert set(information["starting_time"]) == {"nanoseconds_since_epoch"}
    assert set(information["files"][0]) == {"path", "starting_time", "duration", "message_count"}
    topic = information["topics_with_message_count"][0]
    assert set(topic) == {"topic_metadata", "message_count"}
    assert set(topic["topic_metadata"]) == {
        "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash",
    }  # fmt: skip
    assert isinstance(topic["topic_metadata"]["offered_qos_profiles"], list)


@pytest.mark.parametrize("stop", [1, 21, 41, 61, 101])
def test_killed_in_the_middle_of_a_checkpoint(bags, tmp_path, stop):
    """Cut the writes of a checkpoint at every place: the messages of the last one are always there, and no others."""
    made = bags.content(100)
    writer = BagWriter(tmp_path / "bag")
    writer.open()
    file = tmp_path / "bag" / "bag.mcap"
    put(writer, bags, made, 0, stop)
    writer.checkpoint()
    before = file.read_bytes()
    put(writer, bags, made, stop, stop + 40)
    writer.checkpoint()
    after = file.read_bytes()
    assert len(after) > len(before)
    writer.abort()
    length = len(before)
    changed = next(at for at, (old, new) in enumerate(zip(before, after, strict=False)) if old != new)
    appending = [before + after[length:cut] for cut in range(length, len(after), 61)]
    replacing = [after[:cut] + before[cut:] + after[length:] for cut in range(changed, length, 61)]
    assert len(appending) > 20
    assert len(replacing) > 20
    for torn in appending + replacing:
        file.write_bytes(torn)
        messages = [(connection.topic, time, data) for connection, time, data in Bag(tmp_path / "bag").messages()]
        assert messages in (wanted(made, stop), wanted(made, stop + 40))


FILL = """
import resource, sys
from pathlib import Path
from aeropend_ident.bags.container import Bag
from aeropend_ident.bags.writer import BagWriter
from rosbags.typesys import Stores, get_typestore
store = get_typestore(Stores.ROS2_JAZZY)
source, target, storage, limit = *map(Path, sys.argv[1:3]), sys.argv[3], int(sys.argv[4])
messages = list(Bag(source).messages())
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))  # what writes past it fails, as on a full disk
writer = BagWriter(target, storage)
writer.open()
known = {}
stored = 0
for number, (connection, received, message) in enumerate(messages, 1):
    if connection.topic not in known:
        known[connection.topic] = writer.add_connection(connection.topic, connection.msgtype, typestore=store)
    writer.write(known[connection.topic], received, message)
    if number % 50 == 0:
        try:
            writer.checkpoint()
        except Exception as error:
            print(stored, type(error).__name__)
            writer.abort()
            sys.exit()
        stored = number
"""


@pytest.mark.parametrize("limit", [31_000, 40_123, 60_000])
@pytest.mark.parametrize(("storage", "error"), [("mcap", "OSError"), ("sqlite3", "OperationalError")])
def test_full_disk_leaves_the_last_checkpoint(bags, tmp_path, processes, storage, error, limit):
    made = bags.content(1000)
    source = bags.write(tmp_path / "source", made)
    limit *= 2 if storage == "sqlite3" else 1
    process = processes.start(str(source), str(tmp_path / "bag"), storage, str(limit), code=FILL)
    said, trouble = process.communicate(timeout=60)
    assert process.returncode == 0, trouble
    stored, kind = said.split()
    assert kind == error
    assert 50 <= int(stored) < 2000
    assert found(tmp_path / "bag") == wanted(made, int(stored))
    assert sorted(file.suffix for file in (tmp_path / "bag").iterdir()) == [
        {"mcap": ".mcap", "sqlite3": ".db3"}[storage],
        ".yaml",
    ]


@pytest.mark.parametrize("limit", [0, 100])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_full_disk_from_the_start_leaves_nothing(bags, tmp_path, processes, storage, limit):
    source = bags.write(tmp_path / "source", bags.content(10))
    process = processes.start(str(source), str(tmp_path / "bag"), storage, str(limit), code=FILL)
    status, said = processes.wait(process)
    assert status == 1
    assert "OSError" in said or "OperationalError" in said
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_abort_keeps_the_last_checkpoint(bags, tmp_path, storage):
    made = bags.content(50)
    writer = BagWriter(tmp_path / "bag", storage)
    writer.open()
    put(writer, bags, made, 0, 30)
    writer.checkpoint()
    put(writer, bags, made, 30)
    writer.abort()
    assert found(tmp_path / "bag") == wanted(made, 30)


def test_what_is_there_is_not_touched(bags, tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "file").write_text("mine")
    for name in ("bag", "file"):
        with pytest.raises(WriterError):
            BagWriter(tmp_path / name)
    late = BagWriter(tmp_path / "late")
    (tmp_path / "late").mkdir()
    with pytest.raises(WriterError):
        late.open()
    assert (tmp_path / "file").read_text() == "mine"
    assert not list((tmp_path / "bag").iterdir())
    assert not list((tmp_path / "late").iterdir())


def test_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError):  # noqa: PT011  which one depends on the system
        BagWriter(tmp_path / "file" / "bag").open()


def test_sqlite_checkpoint_is_committed(bags, tmp_path):
    writer = BagWriter(tmp_path / "bag", "sqlite3")
    writer.open()
    put(writer, bags, bags.content(10))
    writer.checkpoint()
    with sqlite3.connect(f"file:{tmp_path / 'bag' / 'bag.db3'}?mode=ro", uri=True) as other:
        assert other.execute("SELECT count(*) FROM messages").fetchone() == (20,)
    writer.abort()


def test_long_recordings_stay_whole(bags, tmp_path):
    """Hundreds of checkpoints, each in the place of the ending before it."""
    writer = BagWriter(tmp_path / "bag")
    writer.open()
    connection = writer.add_connection("/duty_command", "std_msgs/msg/Float64", typestore=bags.store)
    for row in range(300):
        writer.write(connection, row, bags.number(row))
        writer.checkpoint()
    writer.close()
    assert found(tmp_path / "bag") == [("/duty_command", row, bags.number(row)) for row in range(300)]
    size = (tmp_path / "bag" / "bag.mcap").stat().st_size
    packed = io.BytesIO((tmp_path / "bag" / "bag.mcap").read_bytes())
    assert sum(1 for _ in make_reader(packed).iter_messages()) == 300
    assert size < 300 * 400 + 20_000
