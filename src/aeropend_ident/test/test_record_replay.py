# SPDX-License-Identifier: Apache-2.0
"""record and replay as processes on a real graph."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from aeropend_ident.bags.container import Bag
from aeropend_ident.bags.recording import read
from aeropend_ident.nodes.record import _remove_bag, losses
from aeropend_ident.nodes.replay import Plan, Replay
from aeropend_ident.nodes.topic_recorder import TopicRecorder
from aeropend_sim.errors import UserError

FLOAT = "std_msgs/msg/Float64"
ROSOUT = ("/rosout", "rcl_interfaces/msg/Log")

FEED = """
'''Publish numbered samples at the sample rate, once somebody listens, and leave when all were delivered.'''
import sys, time
import rclpy
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64
from aeropend_sim.ros import interface
from aeropend_sim.ros.transport import without_shared_memory

count, namespace = int(sys.argv[1]), sys.argv[2]
qos = interface.QOS
if "best_effort" in sys.argv:
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
without_shared_memory()
rclpy.init()
node = rclpy.create_node("feed", namespace=namespace)
joints = node.create_publisher(JointState, interface.JOINT_STATES, qos)
armature = node.create_publisher(BatteryState, interface.ARMATURE, qos)
duty = node.create_publisher(Float64, interface.DUTY_COMMAND, qos)
truth = node.create_publisher(JointState, interface.TRUTH_JOINT_STATES, qos)
while not all(outlet.get_subscription_count() for outlet in (joints, armature, duty)):
    time.sleep(0.02)
time.sleep(0.5)  # they have found us too
start, begin = time.time_ns(), time.monotonic()
print(start, flush=True)
for row in range(count):
    time.sleep(max(0.0, begin + row * 0.00204 - time.monotonic()))
    stamp = start + row * 2_040_000
    joints.publish(interface.joint_states_message(stamp, float(row), -float(row)))
    armature.publish(interface.armature_message(stamp, row / 8, -row / 8, (row % 64) / 64))
    truth.publish(interface.joint_states_message(stamp, row + 0.5, 1.0))
    if row % 100 == 0:
        duty.publish(Float64(data=row / 1000))
if "best_effort" not in sys.argv:
    for outlet in (joints, armature, duty):
        outlet.wait_for_all_acked(Duration(seconds=20))
node.destroy_node()
rclpy.shutdown()
"""


SLOW_DISK = """
'''A recorder whose disk takes 10 ms for a message once it was asked to end.'''
import sys, time
from aeropend_ident.nodes import record

class Disk(record.BagWriter):
    slow = False

    def write(self, *message):
        time.sleep(0.01 * self.slow)
        super().write(*message)

class Record(record.Record):
    def close(self):
        Disk.slow = True
        super().close()

record.BagWriter, record.Record = Disk, Record
sys.exit(record.main())
"""


def record(processes, out, *parameters, remap=(), code="", **options):
    """Start recording; return when it does."""
    arguments = ["--ros-args", *(word for one in parameters for word in ("-p", one)), *remap]
    module = "" if code else "aeropend_ident.nodes.record"
    process = processes.start(str(out), *arguments, module=module, code=code, **options)
    deadline = time.monotonic() + 60
    while not (processes.folder / out / "metadata.yaml").exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return process


def feed(processes, count, namespace="/", *options):
    process = processes.start(str(count), namespace, *options, code=FEED)
    said, trouble = process.communicate(timeout=120)
    assert process.returncode == 0, trouble
    return int(said)


def replay(processes, bag, *parameters, remap=()):
    arguments = ["--ros-args", *(word for one in parameters for word in ("-p", one)), *remap]
    return processes.start(str(bag), *arguments, module="aeropend_ident.nodes.replay")


def topics(path):
    return {topic for topic, _ in counts(path)}


def counts(path):
    bag = Bag(path)
    list(bag.messages(lambda topic, msgtype: False))
    return bag.counts


def messages(path, topic):
    return [data for _, _, data in Bag(path).messages(lambda name, _: name == topic)]


def samples(recording, start, count):
    """Assert that a recording holds every sample that was fed, and nothing else."""
    rows = np.arange(count)
    np.testing.assert_array_equal(recording.stamp_ns, start + 2_040_000 * rows)
    np.testing.assert_array_equal(recording.theta, rows)
    np.testing.assert_array_equal(recording.omega, -rows)
    np.testing.assert_array_equal(recording.v_a, (rows / 8).astype(np.float32))
    np.testing.assert_array_equal(recording.i_a, (-rows / 8).astype(np.float32))
    np.testing.assert_array_equal(recording.duty, (rows % 64) / 64)
    assert (recording.lost, recording.duplicates) == (0, 0)


class Told:
    """A subscription whose messages are only counted."""

    def __init__(self, numbers):
        self.handle, self.numbers = self, list(numbers)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def take_message(self, *_):
        return (b"", {"publication_sequence_number": self.numbers.pop(0), "received_timestamp": 1})


@pytest.mark.parametrize(("looks", "lost"), [
    ([(0, []), (1, [7, 8, 10]), (1, [11, 12])], 1),  # joined late, and missed one at once
    ([(0, [7, 9]), (1, [10]), (1, [11])], 1),
    ([(1, [1, 2]), (1, [3, 6]), (0, [9]), (0, [])], 2),  # what waits when it has gone may be another's
    ([(1, [1, 2]), (2, [3, 500, 4]), (2, [501, 7]), (1, [502]), (1, [503, 504]), (1, [505, 507])], 1),
    ([(2, [1, 500]), (2, [2, 501]), (1, [502]), (1, [503])], 0),
    ([(2, [1, 500]), (2, [2, 501]), (2, [3, 502, 4]), (2, [6, 503, 507]), (2, [8, 508])], 1 + 3 + 1),
    ([(2, [10, 20]), (2, [11, 21]), (2, [12, 22]), (2, [30, 23, 31, 24])], 17),  # who overtakes whom does not matter
    ([(2, [7]), (2, [8]), (2, [9]), (2, [11])], 0),  # the first of the other?
    ([(1, [1, 2]), (0, []), (1, [700, 702]), (1, [703, 705])], 1)])  # fmt: skip
def test_what_is_lost_is_told_by_the_numbers_of_its_publishers(looks, lost):
    tap = TopicRecorder("joint_states", "sensor_msgs/msg/JointState")
    for publishers, numbers in looks:
        tap.count_publishers(publishers, 0.0)
        tap.subscription = Told(numbers)
        for _ in numbers:
            tap.take()
    tap.count_publishers(tap.publishers, 0.0)
    assert tap.lost == lost


@pytest.mark.parametrize(("looks", "joining"), [
    ([(100.0, 1, [1, 4]), (100.2, 1, [5, 9]), (101.0, 1, []), (101.5, 1, [10, 12]), (101.7, 1, [13])], 2 + 3),
    ([(0.0, 1, [1, 2]), (50.0, 1, [5]), (50.2, 0, []), (60.0, 1, [1, 3]), (60.2, 1, [4]), (60.4, 1, [6]),
      (60.6, 1, [7]), (61.6, 1, [9])], 1)])  # fmt: skip
def test_what_is_lost_of_a_new_publisher_is_told_apart(looks, joining):
    tap = TopicRecorder("joint_states", "sensor_msgs/msg/JointState")
    for now, publishers, numbers in looks:
        tap.count_publishers(publishers, now)
        tap.subscription = Told(numbers)
        for _ in numbers:
            tap.take()
    tap.count_publishers(tap.publishers, now)
    assert tap.lost_joining == joining < tap.lost


def test_what_is_lost_is_said_of_each_topic():
    assert losses({"joint_states": 0, "armature": 0}, 0) == "none lost"
    assert losses({"joint_states": 2, "armature": 0, "reference": 31}, 0) == "33 lost (joint_states 2, reference 31)"
    assert losses({"armature": 4}, 3) == "4 lost (armature 4), 3 of them in the first second of a publisher"


@pytest.mark.promise("Recordings", "`record` and `replay` reproduce the data")
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_record_replay_record_gives_the_same_data(processes, storage):
    count = 2000
    first = record(processes, "first", "while_published:=joint_states", f"storage:={storage}")
    start = feed(processes, count)
    status, said = processes.wait(first)
    assert status == 0, said
    assert "none lost" in said
    original = read(processes.folder / "first")
    samples(original, start, count)
    assert original.complete
    assert original.notes == ()
    np.testing.assert_array_equal(original.command, np.arange(0, count, 100) / 1000)
    assert topics(processes.folder / "first") <= {"/joint_states", "/armature", "/duty_command", "/diagnostics"}

    second = record(processes, "second", "while_published:=joint_states", f"storage:={storage}")
    player = replay(processes, "first", "topics:=joint_states,armature,duty_command", "stop_duty:=false")
    status, said = processes.wait(player)
    assert status == 0, said
    assert f"{2 * count + count // 100} messages sent" in said
    status, said = processes.wait(second)
    assert status == 0, said
    for topic in ("/joint_states", "/armature", "/duty_command"):
        assert messages(processes.folder / "second", topic) == messages(processes.folder / "first", topic)
    samples(read(processes.folder / "second"), start, count)


def test_offered_qos_is_recorded(processes):
    recorder = record(processes, "bag", "while_published:=joint_states")
    feed(processes, 50)
    assert processes.wait(recorder)[0] == 0
    with Reader(processes.folder / "bag") as reader:
        profiles = {connection.topic: connection.ext.offered_qos_profiles for connection in reader.connections}
    for topic in ("/joint_states", "/armature", "/duty_command"):
        (qos,) = profiles[topic]
        assert (qos.reliability.name, qos.durability.name) == ("RELIABLE", "VOLATILE")
        assert qos.lifespan == (9223372036, 854775807)  # for ever, as every rosbag2 writes it


def test_best_effort_publishers_are_heard_too(processes):
    recorder = record(processes, "bag", "while_published:=joint_states")
    feed(processes, 500, "/", "best_effort")
    assert processes.wait(recorder)[0] == 0
    assert len(read(processes.folder / "bag")) > 100


def test_namespace_remapping_and_more_topics(processes):
    recorder = record(
        processes, "bag", "while_published:=joint_states", "topics:=/rosout", "truth:=true",
        remap=["-r", "__ns:=/lab/rig1"],
    )  # fmt: skip
    start = feed(processes, 300, "/lab/rig1")
    status, said = processes.wait(recorder)
    assert status == 0, said
    recording = read(processes.folder / "bag")
    samples(recording, start, 300)
    assert recording.namespace == "/lab/rig1"
    np.testing.assert_array_equal(recording.truth.theta[np.isfinite(recording.truth.theta)] % 1, 0.5)
    assert np.isfinite(recording.truth.theta).sum() > 100
    assert "/rosout" in topics(processes.folder / "bag")


def test_all_records_what_it_was_not_told_of(processes):
    recorder = record(processes, "bag", "while_published:=/rig7/joint_states", "all:=true")
    feed(processes, 1500, "/rig7")
    assert processes.wait(recorder)[0] == 0
    assert {"/rig7/joint_states", "/rig7/armature", "/diagnostics", "/rosout"} <= topics(processes.folder / "bag")


def test_duration_ends_the_recording(processes):
    recorder = record(processes, "bag", "duration:=1.0")
    feeder = processes.start("100000", "/", code=FEED)
    status, said = processes.wait(recorder)
    feeder.kill()
    assert status == 0, said
    recording = read(processes.folder / "bag")
    assert recording.complete
    assert len(recording) > 400
    assert recording.received_ns[-1] - recording.received_ns[0] >= 0.95e9


def test_duration_counts_from_the_rig_whatever_else_is_heard_before(processes):
    recorder = record(processes, "bag", "all:=true", "duration:=0.5")
    deadline, others = time.monotonic() + 60, []
    while not others or others[-1] - others[0] < 2e9:  # ns; log lines and diagnostics
        assert recorder.poll() is None, recorder.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.1)
        bag = Bag(processes.folder / "bag")
        others = sorted(received for _, received, _ in bag.messages()) if ROSOUT in counts(bag.path) else []
    feeder = processes.start("100000", "/rig7", code=FEED)
    status, said = processes.wait(recorder)
    feeder.kill()
    assert status == 0, said
    assert len(read(processes.folder / "bag")) > 200


def test_all_topics_end_at_once_however_slow_the_disk(processes):
    recorder = record(processes, "bag", code=SLOW_DISK)
    feeder = processes.start("100000", "/", code=FEED)
    feeder.stdout.readline()
    time.sleep(1.0)
    status, said = processes.end(recorder)
    feeder.kill()
    assert status == 0, said
    assert "none lost" in said
    bag = Bag(processes.folder / "bag")
    last = [max(received for _, received, _ in bag.messages(lambda name, _, topic=topic: name == topic))
            for topic in ("/joint_states", "/armature")]
    assert abs(last[0] - last[1]) < 10e6  # ns; a sample takes 2


def test_nothing_heard_is_said(processes):
    recorder = record(processes, "bag", "while_published:=/diagnostics")  # its own
    deadline = time.monotonic() + 60
    said = ""
    while said.count("no message yet, 0 publishers") < 2 and time.monotonic() < deadline:
        said += recorder.stderr.readline()
    assert processes.end(recorder)[0] == 0
    assert "/joint_states: no message yet, 0 publishers" in said
    assert "/armature: no message yet, 0 publishers" in said


# ---- replay ----------------------------------------------------------------------------------------------------------


def commands(bags, values, step_ns=200_000_000, topic="/duty_command"):
    start = 1_700_000_000_000_000_000
    return bags.Content([(topic, FLOAT, start + row * step_ns, bags.number(value)) for row, value in enumerate(values)])


PLANT = ("/armature", "sensor_msgs/msg/BatteryState")


@pytest.mark.promise("Recordings", "A recorded duty drives the plant again")
def test_a_recorded_duty_drives_the_plant_and_leaves_it_at_rest(bags, processes):
    bags.write(processes.folder / "commands", commands(bags, [0.25, 0.5, 0.125, 0.375], 500_000_000))
    plant = processes.start(module="aeropend_sim.nodes.plant")
    recorder = record(processes, "bag")
    deadline = time.monotonic() + 60  # the recorder hears the plant before it is driven
    while not (processes.folder / "bag" / "metadata.yaml").exists() or not counts(processes.folder / "bag")[PLANT]:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    player = replay(processes, "commands", "topics:=duty_command", "wait:=60.0", "subscribers:=2")
    status, said = processes.wait(player)
    assert status == 0, said
    assert "duty 0 sent, so that the plant stops" in said
    time.sleep(0.5)
    assert processes.end(recorder)[0] == 0
    assert processes.end(plant)[0] == 0
    recording = read(processes.folder / "bag")
    np.testing.assert_array_equal(recording.command, [0.25, 0.5, 0.125, 0.375, 0.0])
    applied = recording.duty[np.isfinite(recording.duty)]
    steps = applied[np.flatnonzero(np.diff(applied, prepend=-1.0))]
    assert steps.tolist() == [0.0, 0.25, 0.5, 0.125, 0.375, 0.0]
    assert np.ptp(recording.theta) > 0.1  # rad; where the recording ends, the arm may hang as it did at the start


def heard(bags, processes, values, *parameters, remap=(), number=None, step_ns=200_000_000, topic="/duty_command"):
    """Replay commands; return values and receive times as somebody who listens gets them."""
    bags.write(processes.folder / "commands", commands(bags, values, step_ns))
    recorder = record(processes, "bag", f"while_published:={topic}", f"topics:={topic},/clock")
    player = replay(processes, "commands", "topics:=duty_command", "wait:=60.0", *parameters, remap=remap)
    if number is not None:
        deadline = time.monotonic() + 60
        while counts(processes.folder / "bag")[topic, FLOAT] < number:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        assert processes.end(player)[0] == 0
    status, said = processes.wait(player) if number is None else (0, "")
    assert status == 0, said
    assert processes.wait(recorder)[0] == 0
    found = list(Bag(processes.folder / "bag").messages(lambda name, _: name == topic))
    return [np.frombuffer(data[4:12]).item() for _, _, data in found], np.array([received for _, received, _ in found])


def test_messages_come_in_the_order_they_were_received(bags, tmp_path):
    made = commands(bags, np.arange(200) / 200, 5_000_000)
    rng = np.random.default_rng(0)
    shuffled = [made.messages[at] for at in np.argsort(np.arange(200) + rng.uniform(0, 150, 200))]
    plan = Plan(bags.write(tmp_path / "bag", bags.Content(shuffled)))
    assert [(received, data) for received, _, data in plan.events()] == [one[2:] for one in made.messages]
    assert plan.duration == pytest.approx(199 * 0.005)


def test_a_long_pause_is_said_with_the_start_that_skips_it(bags, tmp_path):
    made = commands(bags, np.arange(200) / 200, 5_000_000)
    late = [(*one[:2], one[2] + 86_400 * 10**9 * (k >= 100), one[3]) for k, one in enumerate(made.messages)]
    path = bags.write(tmp_path / "bag", bags.Content(late[100:] + late[:100]))
    assert Plan(bags.write(tmp_path / "whole", made)).warning() is None
    said = Plan(path).warning()
    assert "pauses for 86400 s, 0 s after the start" in said
    second = Plan(path, start=float(said.rpartition(":=")[2]))
    assert second.warning() is None
    assert second.end - second.start == pytest.approx(0.495e9, abs=1e6)


def test_what_is_in_force_at_the_start_comes_first(bags, tmp_path):
    rig = bags.content(50, "/rig1")
    path = bags.write(tmp_path / "bag", rig)
    plan = Plan(path, start=25 * 0.00204)
    events = [(connection.topic, received - plan.start, data) for received, connection, data in plan.events()]
    assert {events[0], events[1]} == {
        ("/rig1/duty_command", 0, bags.number(0.1)),
        ("/rig1/reference", 0, bags.number(0.4)),
    }
    later = [one for one in rig.messages if one[2] >= plan.start]
    assert events[2:] == [(topic, received - plan.start, data) for topic, _, received, data in later]
    assert [one[1] for one in events] == sorted(one[1] for one in events)


def test_topics_are_chosen_by_name_and_namespace(bags, tmp_path):
    both = bags.content(20, "/rig1").messages + bags.content(20, "/rig2").messages
    path = bags.write(tmp_path / "bag", bags.Content([*both, ("/duty_command_2", FLOAT, both[0][2], bags.number(1.0))]))

    def chosen(*arguments):
        return {topic for topic, _ in Plan(path, *arguments).connections}

    assert chosen(["duty_command"]) == {"/rig1/duty_command", "/rig2/duty_command"}
    assert chosen(["duty_command"], "rig2") == {"/rig2/duty_command"}
    assert chosen(["/rig1/armature", "duty_command_2"]) == {"/rig1/armature", "/duty_command_2"}
    assert chosen([], "/rig1") == {"/rig1/joint_states", "/rig1/armature", "/rig1/duty_command"}
    assert len(chosen()) == 7


def test_timing_is_kept(bags, processes):
    values, times = heard(bags, processes, [0.1, 0.2, 0.3, 0.4, 0.0], "rate:=0.5")
    assert values == [0.1, 0.2, 0.3, 0.4, 0.0]  # it ends with 0 by itself: none is added
    assert (times - times[0])[-1] >= 1.55e9  # 0.8 s at half the rate


def test_faster(bags, processes):
    _, times = heard(bags, processes, [0.1] * 20 + [0.0], "rate:=100.0")
    assert (times - times[0])[-1] < 4e9 / 2  # recorded in 4 s


def test_start_sends_the_command_in_force(bags, processes):
    values, _ = heard(bags, processes, [0.1, 0.2, 0.3, 0.4, 0.5], "start:=0.5", "rate:=10.0")
    assert values == [0.3, 0.4, 0.5, 0.0]


def test_loop_goes_on_until_it_is_stopped(bags, processes):
    values, _ = heard(bags, processes, [0.1, 0.2], "loop:=true", number=6)
    assert values[:6] == [0.1, 0.2] * 3
    assert values[-1] == 0.0


def test_topics_move_into_the_nodes_namespace(bags, processes):
    remap = ["-r", "__ns:=/rig2"]
    values, _ = heard(bags, processes, [0.1, 0.2], "rate:=10.0", remap=remap, topic="/rig2/duty_command")
    assert values == [0.1, 0.2, 0.0]


def test_clock_carries_the_recorded_time(bags, processes):
    heard(bags, processes, [0.1, 0.2, 0.3], "clock:=50.0")
    ticks = [np.frombuffer(data[4:12], np.int32) for data in messages(processes.folder / "bag", "/clock")]
    times = np.array([int(sec) * 10**9 + int(nanosec) for sec, nanosec in ticks]) - 1_700_000_000_000_000_000
    assert len(times) > 10
    assert set(np.diff(times)) == {20_000_000}
    assert times[-1] == 400_000_000


# ---- bad input -------------------------------------------------------------------------------------------------------


def one_line(process, program):
    """Wait for exit code 2; return the one line."""
    out, said = process.communicate(timeout=60)
    assert process.returncode == 2, said
    assert said.count("\n") == 1, said
    assert out == ""
    assert said.startswith(program)
    return said.rstrip("\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["there"], "there exists: give another name, or -p overwrite:=true to replace it"),
        (["there", "--ros-args", "-p", "overwrite:=true"], "there is not a bag, or holds other files too"),
        (["link", "--ros-args", "-p", "overwrite:=true"], "/bag: it is not overwritten, give that name or another one"),
        (["n" * 300], "n: cannot be written: File name too long; give another name"),
        (["file"], "file exists"),
        (["file/bag"], "file/bag: cannot be written: Not a directory"),
        (["a", "b"], "one OUT only, not a b"),
        (["a", "--duration", "3"], "unknown argument '--duration'"),
        (["a", "--ros-args", "-p", "duration:=-1.0"], "parameter duration is -1: give 0 to"),
        (["a", "--ros-args", "-p", "duraton:=1.0"], "unknown parameter duraton: did you mean duration?"),
        (["a", "--ros-args", "-p", "storage:=paper"], "parameter storage is 'paper': give one of mcap, sqlite3"),
        (["a", "--ros-args", "-p", "topics:=a b"], "'a b' is not a topic name"),
        (["a", "--ros-args", "-p", "while_published:=1x"], "'1x' is not a topic name"),
    ],
)
def test_record_refuses(bags, processes, arguments, message):
    (processes.folder / "there").mkdir()
    (processes.folder / "there" / "thesis.pdf").write_text("mine")
    (processes.folder / "file").write_text("mine")
    bags.write(processes.folder / "bag", bags.content(20))
    (processes.folder / "link").symlink_to("bag")
    assert message in one_line(processes.start(*arguments, module="aeropend_ident.nodes.record"), "record")
    assert sorted(file.name for file in processes.folder.iterdir()) == ["bag", "file", "link", "there"]
    assert len(read(processes.folder / "bag")) == 20
    assert (processes.folder / "there" / "thesis.pdf").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name one BAG: see --help"),
        (["none"], "none: no such file or folder"),
        (["text"], "text: not a bag"),
        (["bag", "--ros-args", "-p", "topics:=dutycommand"], "no topic dutycommand in it; it holds /armature, /duty"),
        (["bag", "--ros-args", "-p", "namespace:=rig3"], "no topic in namespace /rig3; it holds /armature, /duty"),
        (["bag", "--ros-args", "-p", "start:=5.0"], "start is 5 s, but it lasts 0.0"),
        (["bag", "--ros-args", "-p", "rate:=0.0"], "parameter rate is 0: give 0.001 to 1000"),
        (["empty"], "empty: holds no messages to replay"),
        (["rigs", "--ros-args", "-r", "__ns:=/x"], "several recorded topics would become /x/"),
        (["strange", "--ros-args", "-p", "topics:=strange"], "/strange cannot be replayed: message type no_msgs"),
        (["single", "--ros-args", "-p", "loop:=true"], "single: what would be replayed was received at one instant"),
        (["late", "--ros-args", "-p", "clock:=10.0"], "late: was received beyond 2038, which /clock"),
    ],
)
def test_replay_refuses(bags, processes, arguments, message):
    (processes.folder / "text").mkdir()
    bags.write(processes.folder / "bag", bags.content(20))
    bags.write(processes.folder / "empty", bags.Content())
    both = bags.content(2, "/rig1").messages + bags.content(2, "/rig2").messages
    bags.write(processes.folder / "rigs", bags.Content(both))
    from rosbags.typesys import get_types_from_msg

    bags.store.register(get_types_from_msg("float64 x", "no_msgs/msg/No"))
    bags.write(processes.folder / "strange", bags.Content([("/strange", "no_msgs/msg/No", 5, bags.number(1.0))]))
    bags.write(processes.folder / "single", commands(bags, [0.1]))
    bags.write(processes.folder / "late", bags.Content([("/reference", FLOAT, 2**62, bags.number(1.0))]))
    assert message in one_line(processes.start(*arguments, module="aeropend_ident.nodes.replay"), "replay")


def test_overwrite_replaces_a_bag(bags, processes):
    bags.write(processes.folder / "bag", bags.content(20))
    recorder = record(processes, "bag", "overwrite:=true", "while_published:=joint_states")
    start = feed(processes, 100)
    assert processes.wait(recorder)[0] == 0
    samples(read(processes.folder / "bag"), start, 100)


def test_the_folder_in_which_it_runs_is_not_overwritten(bags, tmp_path, monkeypatch):
    monkeypatch.chdir(bags.write(tmp_path / "bag", bags.content(20)))
    with pytest.raises(UserError, match="go out of it first"):
        _remove_bag(Path())
    assert len(read(tmp_path / "bag")) == 20


@pytest.mark.parametrize("program", ["record", "replay"])
def test_help(processes, program):
    process = processes.start("--help", module=f"aeropend_ident.nodes.{program}")
    said, trouble = process.communicate(timeout=60)
    assert (process.returncode, trouble) == (0, "")
    assert f"{program} my_bag --ros-args" in said
    assert "duration" in said or "rate" in said


def test_progress_on_a_terminal(processes):
    """With a terminal for standard error there is one line that changes, and no log of rates."""
    import os
    import pty

    own, theirs = pty.openpty()
    recorder = processes.start("bag", "--ros-args", "-p", "while_published:=joint_states",
                               module="aeropend_ident.nodes.record", stderr=theirs)  # fmt: skip
    os.close(theirs)
    feed(processes, 1500)
    said = b""
    while True:
        try:
            part = os.read(own, 4096)
        except OSError:  # the other end was closed
            break
        said += part
    os.close(own)
    assert recorder.wait(timeout=60) == 0
    text = said.decode()
    assert "joint_states" in text
    assert " Hz" in text
    assert "none lost" in text
    assert "Traceback" not in text


def test_entry_points_start(processes):
    """The programs that pip and colcon install are these."""
    for program in ("record", "replay", "recover"):
        path = Path(sys.executable).with_name(program)
        said = subprocess.check_output([path, "--help"], env=processes.environment, text=True, timeout=60)
        assert program in said


def test_a_wait_may_be_longer_than_any_clock_and_ends_when_it_is_told():
    end = threading.Event()
    threading.Timer(0.2, end.set).start()
    assert not Replay._until(None, time.monotonic() + 1e15, end)
