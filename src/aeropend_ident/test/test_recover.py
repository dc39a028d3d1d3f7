# SPDX-License-Identifier: Apache-2.0
import shutil
import sqlite3

import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from aeropend_ident.bags.container import Bag
from aeropend_ident.bags.recording import read
from aeropend_ident.commands.recover import main, recover


def messages(path):
    with Reader(path) as reader:
        return [(connection.topic, time, message) for connection, time, message in reader.messages()]


def contents(path):
    return {file.name: file.read_bytes() for file in path.iterdir()}


@pytest.fixture
def broken(bags, tmp_path):
    """An MCAP bag of 600 samples that ends in the middle of its data."""
    made = bags.content(600)
    path = bags.write(tmp_path / "bag", made)
    file = path / "bag.mcap"
    file.write_bytes(file.read_bytes()[:100_000])
    return path, made


@pytest.mark.promise("Recordings", "`recover` makes a whole bag of a broken one")
def test_a_broken_bag_becomes_a_proper_one(broken, tmp_path, capsys):
    path, made = broken
    before = contents(path)
    with pytest.raises(Exception, match="magic"):
        messages(path)
    assert main([str(path)]) == 0
    target = tmp_path / "bag_recovered"
    got = messages(target)
    assert 300 < len(got) < 1200
    assert got == [(topic, received, message) for topic, _, received, message in made.messages[: len(got)]]
    recording = read(target)
    assert recording.complete
    said = capsys.readouterr().out.splitlines()
    assert said[0] == f"{target}: {len(got)} messages over {(got[-1][1] - got[0][1]) / 1e9:.3f} s recovered"
    count = sum(topic == "/joint_states" for topic, _, _ in got)
    assert f"  /joint_states: {count}" in said
    assert "  lost: bag.mcap ends without its index: the recording was broken off, its last moments are lost" in said
    assert contents(path) == before


@pytest.mark.parametrize(("folder", "inside", "given", "made"), [
    ("bag", True, ".", "bag_recovered"), ("bag", True, "..", "bag_recovered"),
    ("2024.05.01_run", False, "2024.05.01_run", "2024.05.01_run_recovered"),
    ("bag", True, "bag.1.mcap", "bag/bag.1_recovered")])
def test_the_new_bag_has_the_name_of_the_old_one(broken, tmp_path, monkeypatch, folder, inside, given, made):
    path = broken[0].rename(tmp_path / folder)
    (path / "bag.mcap").rename(path / "bag.1.mcap")
    (path / "metadata.yaml").unlink()
    (path / "sub").mkdir()
    monkeypatch.chdir(path / "sub" if given == ".." else path if inside else tmp_path)
    assert main([given]) == 0
    assert messages(tmp_path / made)


def test_out_names_the_target_and_is_not_overwritten(broken, tmp_path, capsys):
    path, _ = broken
    assert main([str(path / "bag.mcap"), "--out", str(tmp_path / "saved")]) == 0
    saved = contents(tmp_path / "saved")
    capsys.readouterr()
    assert main([str(path), "--out", str(tmp_path / "saved")]) == 2
    assert capsys.readouterr().err == f"recover: {tmp_path / 'saved'} exists: name another folder with --out\n"
    assert contents(tmp_path / "saved") == saved


def test_a_whole_bag_is_left_alone(bags, tmp_path, capsys):
    path = bags.write(tmp_path / "bag", bags.content(20))
    assert main([str(path)]) == 0
    assert "is whole: 41 messages" in capsys.readouterr().out
    assert [file.name for file in tmp_path.iterdir()] == ["bag"]


def test_a_folder_without_metadata_gets_it(bags, tmp_path):
    made = bags.content(20)
    path = bags.write(tmp_path / "bag", made, "sqlite3")
    (path / "metadata.yaml").unlink()
    done = recover(path)
    assert done.out == tmp_path / "bag_recovered"
    assert (done.out / "bag_recovered.db3").is_file()
    assert messages(done.out) == [(topic, received, message) for topic, _, received, message in made.messages]


def test_sqlite_that_is_damaged(bags, tmp_path):
    made = bags.content(500)
    path = bags.write(tmp_path / "bag", made, "sqlite3")
    file = path / "bag.db3"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    done = recover(path)
    got = messages(done.out)
    assert 100 < len(got) < 1000
    assert set(got) <= {(topic, received, message) for topic, _, received, message in made.messages}
    with sqlite3.connect(done.out / "bag_recovered.db3") as base:
        assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_types_of_others_come_from_the_bag(bags, tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("float64 weight\nstd_msgs/Header header", "other_msgs/msg/Scale"))
    made = bags.content(20)
    time = store.types["builtin_interfaces/msg/Time"](1, 2)
    scale = store.types["other_msgs/msg/Scale"](2.5, store.types["std_msgs/msg/Header"](time, "x"))
    data = bytes(store.serialize_cdr(scale, "other_msgs/msg/Scale"))
    made.messages.insert(3, ("/scale", "other_msgs/msg/Scale", made.messages[3][2], data))
    bags.store.register(get_types_from_msg("float64 weight\nstd_msgs/Header header", "other_msgs/msg/Scale"))
    path = bags.write(tmp_path / "bag", made)
    (path / "metadata.yaml").unlink()
    done = recover(path)
    assert done.left_out == ()
    assert messages(done.out) == [(topic, received, message) for topic, _, received, message in made.messages]


def test_types_that_nobody_knows_are_left_out_and_named(bags, tmp_path, capsys):
    made = bags.content(20)
    path = bags.write(tmp_path / "bag", made, "sqlite3")
    with sqlite3.connect(path / "bag.db3") as base:
        base.execute("UPDATE topics SET type='no_msgs/msg/Such' WHERE name='/duty_command'")
    base.close()
    (path / "metadata.yaml").unlink()
    assert main([str(path)]) == 0
    assert "  left out: /duty_command: its message type" in capsys.readouterr().out
    assert messages(tmp_path / "bag_recovered") == [
        (topic, received, message) for topic, _, received, message in made.messages if topic != "/duty_command"
    ]


def test_nothing_to_recover_is_an_error_and_leaves_nothing(bags, tmp_path, capsys):
    path = bags.write(tmp_path / "bag", bags.content(20))
    (path / "bag.mcap").write_bytes((path / "bag.mcap").read_bytes()[:60])
    for name, message in (("bag", "nothing to recover: bag.mcap ends without its index"), ("none", "no such file")):
        assert main([str(tmp_path / name)]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"recover: {tmp_path / name}: {message}")
        assert said.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["bag"]


def test_full_disk_leaves_nothing(broken, tmp_path, processes):
    path, _ = broken
    code = f"""
import resource, sys
from aeropend_ident.commands.recover import main
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))  # what writes past it fails, as on a full disk
sys.exit(main([{str(path)!r}]))
"""
    status, said = processes.wait(processes.start(code=code))
    assert status == 2
    assert said == f"recover: {tmp_path / 'bag_recovered'}: cannot be written: File too large\n"
    assert not (tmp_path / "bag_recovered").exists()


def test_qos_is_kept(bags, tmp_path):
    """A bag of an unfinished recording, as `record` leaves it when it is killed."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    from aeropend_ident.bags.writer import BagWriter

    forever = QosTime(9223372036, 854775807)
    qos = Qos(
        QosHistory.UNKNOWN, 0, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, forever, forever,
        QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip
    for storage in ("mcap", "sqlite3"):
        writer = BagWriter(tmp_path / storage, storage)
        writer.open()
        connection = writer.add_connection(
            "/reference", "std_msgs/msg/Float64", typestore=bags.store, offered_qos_profiles=[qos, qos]
        )
        writer.write(connection, 5, bags.number(0.5))
        writer.checkpoint()
        shutil.copytree(tmp_path / storage, tmp_path / f"killed_{storage}")
        writer.abort()
        done = recover(tmp_path / f"killed_{storage}")
        (found,) = Bag(done.out).messages()
        assert found[0].ext.offered_qos_profiles == [qos, qos]
        assert found[1:] == (5, bags.number(0.5))
        assert not Bag(done.out).problems


def test_help_has_examples(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    said = capsys.readouterr().out
    assert "recover my_bag --out saved" in said
