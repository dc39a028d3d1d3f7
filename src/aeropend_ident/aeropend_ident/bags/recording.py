# SPDX-License-Identifier: Apache-2.0
"""A recording as arrays: the samples of one rig, joined on their stamps.

Example:
    >>> recording = read("my_bag")
    >>> recording.t, recording.theta, recording.duty  # s, rad, 0..1
"""

from __future__ import annotations

import dataclasses
import math
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags import judging
from aeropend_ident.bags.cdr import Block, decode
from aeropend_ident.bags.container import Bag
from aeropend_ident.bags.mending import mend, named
from aeropend_ident.bags.reading import RecordingError
from aeropend_sim.untrusted import printable
from aeropend_sim.wording import counted

__all__ = ["CHANNELS", "Recording", "RecordingError", "Truth", "holds", "read", "shown", "split_topic"]

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

CHANNELS = ("theta", "omega", "i_a", "v_a", "duty")

OFF_GRID = 0.25
"""Part of a period by which a step between stamps may miss the grid."""

MOST_NAMES = 8
"""Joints of another robot that are named (choice)."""

OFF = "the stamps do not lie on one grid"
"""What a note says of stamps at irregular times."""

TWO_PROGRAMS = "two programs publish one topic (`ros2 topic info -v` lists them: end one, and record again)"
"""What a note says of messages that cannot come from one program."""

IRREGULAR = 0.01
"""Share of steps off the grid from which on it is said."""

_JOINT, _BATTERY, _FLOAT = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Float64"
_TOPICS = {
    "truth/joint_states": _JOINT,
    "truth/armature": _BATTERY,
    "joint_states": _JOINT,
    "armature": _BATTERY,
    "duty_command": _FLOAT,
    "reference": _FLOAT,
}
_ARM, _ROTOR = "arm", "rotor"
_JOINTS = ("theta", "theta_dot", "omega")
NO_JOINT = f"has no joint named {_ARM} or {_ROTOR}"
"""What a note says of joints that are none of ours."""
NO_JOINTS = "there is no joint_states"
"""What a note says where joints have a topic of another name or type, or none."""
NO_POSITION = f"the position of '{_ARM}' is no number in any message"
"""What a note says where the position of another joint holds numbers."""
NO_DUTY = "holds no duty"
"""What a note says of commands that are none."""
STANDS = 20
"""Messages of one stamp from which on its clock stands still (choice: no program repeats a sample as often)."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The plant's states before its measurement chain, on the stamps of the samples; NaN where missing.

    Attributes:
        theta: (N,) arm angle, rad.
        theta_dot: (N,) arm speed, rad/s.
        omega: (N,) rotor speed, rad/s.
        i_a: (N,) armature current, A.
        v_a: (N,) armature voltage, V.
    """

    theta: Floats
    theta_dot: Floats
    omega: Floats
    i_a: Floats
    v_a: Floats


@dataclass(frozen=True, eq=False)
class Recording:
    """The samples of one rig in the order of their stamps; NaN where a channel is unmeasured or a message is missing.

    Attributes:
        path: the bag.
        namespace: where the rig's topics are: "/", "/rig1".
        stamp_ns: (N,) instants of sampling, strictly rising, ns.
        received_ns: (N,) when the sample was recorded, by the recorder's clock, ns.
        t: (N,) time since the first sample, s.
        theta: (N,) arm angle from hanging, rad.
        omega: (N,) rotor speed, rad/s.
        i_a: (N,) armature current, A.
        v_a: (N,) armature voltage, V.
        duty: (N,) duty applied, 0..1.
        channels: those of theta, omega, i_a, v_a, duty that contain a number.
        period: sample period estimated from the stamps, s; NaN for a single sample.
        gaps: (M, 2) for every gap the index of the sample before it and the number of samples that are missing.
        duplicates: messages whose stamp had been there before (the first one counts).
        command_ns: (K,) receive times of duty_command, ns.
        command: (K,) duty commanded, as sent (not clamped, maybe NaN).
        reference_ns: (L,) receive times of reference, ns.
        reference: (L,) reference, rad (rad/s for the bare cascade).
        truth: what the plant published below truth/, if it was recorded.
        complete: whether the bag was closed and is undamaged.
        notes: what a user should know about this recording, one line each.
        others: joints that are not ours, if they have numbers: "NAME" -> (N,) position, "NAME.velocity" -> (N,).
    """

    path: str
    namespace: str
    stamp_ns: Stamps
    received_ns: Stamps
    t: Floats
    theta: Floats
    omega: Floats
    i_a: Floats
    v_a: Floats
    duty: Floats
    channels: tuple[str, ...]
    period: float
    gaps: Stamps
    duplicates: int
    command_ns: Stamps
    command: Floats
    reference_ns: Stamps
    reference: Floats
    truth: Truth | None
    complete: bool
    notes: tuple[str, ...]
    others: dict[str, Floats] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.stamp_ns)

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, s."""
        return float(self.t[-1])

    @property
    def lost(self) -> int:
        """Samples missing on the grid between the first and the last."""
        return int(self.gaps[:, 1].sum())


def read(path: Path | str, namespace: str | None = None, *, judged: bool = True) -> Recording:
    """Read a bag into arrays.

    joint_states and armature are joined on header.stamp, whatever order they arrived in. Without armature the duty is
    that of the last duty_command received before the sample; `notes` says so. Numbers that cannot be readings, and
    stamps that cannot be times, are left out; `notes` says how many (`judging`).

    Args:
        path: a rosbag2 folder (metadata up to version 9) or a bare .mcap or .db3 file, broken off or not.
        namespace: the rig to read when the bag holds several: "/rig1".
        judged: False leaves the numbers as they are recorded, for their unit to be changed, and joints with other names
            for one of them to be taken.

    Raises:
        RecordingError: the bag cannot be used; the message is one line that says what to do.
    """
    bag = Bag(path)
    series: dict[tuple[str, str], _Series] = {}
    for connection, time, data in bag.messages(lambda topic, msgtype: split_topic(topic, msgtype) is not None):
        key = (connection.topic, connection.msgtype)
        try:
            one = series[key]
        except KeyError:
            one = series[key] = _Series(connection.topic, connection.msgtype)
        one.times.append(time)
        one.messages.append(data)
    rigs, strange = _rigs(series, bag, others=not judged)
    found = _choose(rigs, namespace, bag)
    notes = [strange[found]] if found in strange else []
    notes += _of_other_types(rigs[found], found, bag)
    odd = [topic for topic, msgtype in bag.counts if msgtype == _JOINT and split_topic(topic, msgtype) is None]
    if odd and found not in strange and "joint_states" not in rigs[found]:
        notes.append(f"{NO_JOINTS}; {printable(odd[0])} has another name: record it as joint_states (--ros-args -r "
                     f"{printable(odd[0])}:=joint_states of the program that publishes it)")
    elif "joint_states" not in rigs[found] and not any(NO_JOINT in note or NO_JOINTS in note for note in notes):
        notes.append(f"{NO_JOINTS}: record it together with armature")
    try:
        recording = _Join(rigs[found], notes, judged=judged).recording(str(path), found, complete=not bag.problems)
    except RecordingError as error:
        raise RecordingError(f"{path}: {named(str(error), path)}") from None
    recording = replace(recording, notes=tuple(named(note, path) for note in recording.notes))
    if not bag.problems:
        return recording
    what = f"{bag.counts.total()} messages and {recording.duration:.3f} s of samples could be read"
    return replace(recording, notes=(*bag.problems, what, *recording.notes))


def holds(duty: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where in a duty (N,) each hold begins, and how many samples it lasts."""
    start = np.flatnonzero(np.append(True, np.diff(duty) != 0.0))
    return start, np.diff(np.append(start, len(duty)))


def split_topic(topic: str, msgtype: str) -> tuple[str, str] | None:
    """Split a topic of a rig into its namespace ("/", "/rig1") and name; None when it is none, or has another type."""
    for name, expected in _TOPICS.items():
        if msgtype == expected and (topic == name or topic.endswith("/" + name)):
            rest = topic[: -len(name)].strip("/")
            return "/" + rest, name
    return None


class _Series:
    """The messages of one topic as they lie in the bag."""

    def __init__(self, topic: str, msgtype: str) -> None:
        self.topic = topic
        self.msgtype = msgtype
        self.times: list[int] = []
        self.messages: list[bytes] = []


def _rigs(series: dict[tuple[str, str], _Series], bag: Bag, *, others: bool
          ) -> tuple[dict[str, dict[str, _Series]], dict[str, str]]:
    """Sort the series into rigs: namespace -> topic -> series. A rig has an armature, or a joint named arm or rotor.

    Args:
        series: of the bag.
        bag: the bag.
        others: whether a rig may have joints of other names.

    Returns:
        The rigs, and by namespace what is to be said of joints that are none of ours.
    """
    rigs: dict[str, dict[str, _Series]] = {}
    for one in series.values():
        split = split_topic(one.topic, one.msgtype)
        assert split is not None
        rigs.setdefault(split[0], {})[split[1]] = one
    strange: dict[str, str] = {}
    takes: dict[str, str] = {}
    for place, topics in list(rigs.items()):
        joints = topics.get("joint_states")
        if joints is not None and (names := _other_joints(joints)) is not None:
            its = f"its joints: {', '.join(map(shown, names))}" if any(names) else "its messages name no joint"
            strange[place] = f"{joints.topic} {NO_JOINT} ({its})"
            takes[place] = _taking(joints) or (f"; name the joints {_ARM} and {_ROTOR} in the program that publishes "
                                               "them, and record again")
            if not others:
                del topics["joint_states"]
        if not {"joint_states", "armature"} & set(topics):
            del rigs[place]
    if others and set(rigs) - set(strange):  # joints of another robot are no rig
        rigs = {place: topics for place, topics in rigs.items() if place not in strange or "armature" in topics}
    if rigs and others:
        return rigs, {}
    if rigs:
        return rigs, {place: f"{said}: left out{takes[place]}" for place, said in strange.items()}
    if strange:
        said = "; ".join(one + takes[place] for place, one in strange.items())
        raise RecordingError(f"{bag.path}: {named(said, bag.path)}")
    if not bag.counts.total():
        why = f" ({bag.problems[0]})" if bag.problems else ""
        raise RecordingError(f"{bag.path}: holds no messages{why}: record again while plant or bridge runs")
    there = [f"{topic} ({msgtype}, {count})" for (topic, msgtype), count in sorted(bag.counts.items())]
    listed = ", ".join(there[:8]) + (f" and {len(there) - 8} more" if len(there) > 8 else "")
    raise RecordingError(f"{bag.path}: no message of joint_states or armature in it; it holds {listed}: "
                         "record those of the rig too, or name the rig's topics so (--ros-args -r)")


def _of_other_types(rig: Mapping[str, _Series], place: str, bag: Bag) -> list[str]:
    """What is to be said of topics with the name of ours and another type, where ours is not there."""
    out = []
    for topic, msgtype in bag.counts:
        name = topic.rpartition("/")[2]
        if name in rig or topic not in (f"{place.rstrip('/')}/{name}", name) or msgtype == _TOPICS.get(name, msgtype):
            continue
        what = {"joint_states": f"{NO_JOINTS} of the right type: ", "duty_command": f"duty_command {NO_DUTY}: "}
        out.append(f"{what.get(name, '')}{printable(topic)} has the type {printable(msgtype)} and is left out; publish "
                   f"it as {_TOPICS[name]}, and record again")
    return out


def _other_joints(joints: _Series) -> list[str] | None:
    """The names of joints of which none is ours; None if one is, or if no message can be decoded."""
    for messages in (joints.messages[:1], joints.messages):  # the first message tells, but for a strange one
        names = {name for block in decode(messages, _JOINT)[0] for name in block.names.get("name", ())}
        if {_ARM, _ROTOR} & names:
            return None
    return sorted(names)[:MOST_NAMES] if decode(joints.messages[:1], _JOINT)[0] else None


def _taking(joints: _Series) -> str:
    """The command that takes joints of other names for ours: the first with an angle, and another with a speed."""
    block, *_ = decode(joints.messages[:1], _JOINT)[0]
    names = block.names.get("name", ())
    turned = {field: [name for name, x in zip(names, np.ravel(block.numbers[field][:1]).tolist(), strict=False)
                      if name and math.isfinite(x)] for field in ("position", "velocity")}
    if not turned["position"]:
        return ""
    arm = turned["position"][0]
    rotor = next((name for name in turned["velocity"] if name != arm), None)
    options = [f"--theta {shlex.quote(f'{arm}:rad')}"]
    options += [f"--omega {shlex.quote(f'{rotor}.velocity:rad/s')}"] if rotor is not None else []
    return f"; if {shown(arm)} is the arm, {mend(*options)}"


def shown(name: str) -> str:
    """The name of a joint as a message shows it: in quotation marks if blanks begin or end it."""
    return printable(name if name == name.strip() else repr(name))


def _choose(rigs: dict[str, dict[str, _Series]], namespace: str | None, bag: Bag) -> str:
    there = ", ".join(sorted(rigs))
    if namespace is None:
        if len(rigs) > 1:
            raise RecordingError(f"{bag.path}: holds several rigs: {there}; choose one with --namespace")
        return next(iter(rigs))
    wanted = "/" + namespace.strip("/")
    if wanted not in rigs:
        raise RecordingError(f"{bag.path}: no rig in namespace {wanted}; it holds {there}")
    return wanted


@dataclass(eq=False)
class _Table:
    """The messages of one topic as columns, sorted by stamp."""

    stamps: Stamps
    received: Stamps
    columns: dict[str, Floats]


class _Join:
    """The topics of one rig, joined on the stamps."""

    def __init__(self, topics: dict[str, _Series], notes: list[str], *, judged: bool) -> None:
        self.notes = notes
        self.duplicates = 0
        empty = _Table(np.empty(0, np.int64), np.empty(0, np.int64), {})
        joints = self._joints(topics["joint_states"]) if "joint_states" in topics else empty
        armature = self._armature(topics["armature"]) if "armature" in topics else empty
        if len(joints.stamps) and len(armature.stamps):
            common = len(np.intersect1d(joints.stamps, armature.stamps, assume_unique=True))
            if not common:
                notes.append("no stamp of armature equals one of joint_states: armature is left out; give both "
                             "messages of a sample the same stamp, and record again")
                armature = empty
            elif alone := len(joints.stamps) - common:
                notes.append(f"{counted(alone, 'sample')} of joint_states {_has(alone)} no armature of the same stamp")
            if common and (alone := len(armature.stamps) - common):
                notes.append(f"{counted(alone, 'sample')} of armature {_has(alone)} no joint_states of the same stamp")
        self.stamps = np.union1d(joints.stamps, armature.stamps)
        if not len(self.stamps):
            raise RecordingError(f"no sample could be read: {'; '.join(notes)}; correct the program that publishes "
                                 "them, and record again")
        self.received = np.zeros(len(self.stamps), dtype=np.int64)
        for table in (armature, joints):  # where both are there, the arrival of joint_states counts
            self.received[np.searchsorted(self.stamps, table.stamps)] = table.received
        if len(self.stamps) == 1 and self.duplicates >= STANDS:
            raise RecordingError(f"{'; '.join(notes)}; no two samples have different stamps: set header.stamp to the "
                                 "instant of each sample in the program that publishes them, and record again")
        self.columns = self._placed((armature, joints), CHANNELS)
        self.others = self._placed((joints,), [name for name in joints.columns if name not in _JOINTS])
        if judged:
            self.columns = {name: judging.channel(name, x, notes, self.columns) for name, x in self.columns.items()}
        self.command = self._values(topics.get("duty_command"))
        self.reference = self._values(topics.get("reference"))
        if not np.isfinite(self.columns["duty"]).any():
            self._take_duty_from_command("no duty in armature" if len(armature.stamps) else "no armature",
                                         judged=judged)
        repeated = self.duplicates
        self.truth = self._truth(topics)
        self.duplicates = repeated
        self._set_right()
        self.period, self.gaps, self.irregular = _grid(self.stamps)

    def _set_right(self) -> None:
        """Put the samples in order where the clock of the stamps was set."""
        stamps, kept = judging.one_clock(self.stamps, self.received, self.notes)
        rows = np.flatnonzero(kept)[np.argsort(stamps[kept], kind="stable")]
        rows = rows[np.append(True, np.diff(stamps[rows]) > 0)]
        if np.array_equal(stamps[rows], self.stamps):
            return
        self.stamps, self.received = stamps[rows], self.received[rows]
        self.columns = {name: x[rows] for name, x in self.columns.items()}
        self.others = {name: x[rows] for name, x in self.others.items()}
        if self.truth is not None:
            self.truth = Truth(**{field.name: getattr(self.truth, field.name)[rows] for field in fields(Truth)})

    def recording(self, path: str, namespace: str, *, complete: bool) -> Recording:
        """Say what there is to say, and hand over the arrays."""
        channels = tuple(name for name in CHANNELS if np.isfinite(self.columns[name]).any())
        if unmeasured := [name for name in CHANNELS if name not in channels]:
            self.notes.append(f"not measured: {', '.join(unmeasured)}")
        if self.duplicates:
            repeat = "repeats" if self.duplicates == 1 else "repeat"
            self.notes.append(f"{counted(self.duplicates, 'message')} {repeat} a stamp: the first of each counts")
        if len(self.gaps):
            missing = int(self.gaps[:, 1].sum())
            are = "is" if missing == 1 else "are"
            self.notes.append(f"{counted(missing, 'sample')} {are} missing in {counted(len(self.gaps), 'gap')}")
        if self.irregular > IRREGULAR * len(self.stamps) or len(self.gaps) > 0.25 * len(self.stamps):
            self.notes.append(f"{OFF}: {TWO_PROGRAMS}, or most samples were lost")
        return Recording(
            path=path,
            namespace=namespace,
            stamp_ns=self.stamps,
            received_ns=self.received,
            t=(self.stamps - self.stamps[0]) / 1e9,
            **self.columns,
            channels=channels,
            period=self.period,
            gaps=self.gaps,
            duplicates=self.duplicates,
            command_ns=self.command[0],
            command=self.command[1],
            reference_ns=self.reference[0],
            reference=self.reference[1],
            truth=self.truth,
            complete=complete,
            notes=tuple(self.notes),
            others={name: x for name, x in self.others.items() if np.isfinite(x).any()},
        )

    def _joints(self, series: _Series) -> _Table:
        columns = {name: np.full(len(series.messages), np.nan) for name in _JOINTS}
        blocks = self._decode(series)
        nameless, twice, turned = 0, set(), False
        for block in blocks:
            names = block.names.get("name", ())
            nameless += 0 if {_ARM, _ROTOR} & set(names) else len(block.rows)
            twice |= {name for name in (_ARM, _ROTOR) if names.count(name) > 1}
            positions = judging.numbers(block.numbers["position"])
            if _ROTOR in names and names.index(_ROTOR) < positions.shape[1]:
                turned |= bool(np.isfinite(positions[:, names.index(_ROTOR)]).any())
            for column, joint, field in (
                ("theta", _ARM, "position"),
                ("theta_dot", _ARM, "velocity"),
                ("omega", _ROTOR, "velocity"),
            ):
                values = judging.numbers(block.numbers[field])
                if joint in names and names.index(joint) < values.shape[1]:
                    columns[column][block.rows] = values[:, names.index(joint)]
            for k, name in enumerate(map(printable, names[:MOST_NAMES])):
                if name in (_ARM, _ROTOR, *_JOINTS):
                    continue
                for column, field_ in ((name, "position"), (f"{name}.velocity", "velocity")):
                    values = judging.numbers(block.numbers[field_])
                    if k < values.shape[1] and (column in columns or len(columns) < 2 * MOST_NAMES):
                        columns.setdefault(column, np.full(len(series.messages), np.nan))[block.rows] = values[:, k]
        if 0 < nameless < sum(len(block.rows) for block in blocks):
            name = "names" if nameless == 1 else "name"
            self.notes.append(f"{counted(nameless, 'message')} of {series.topic} {name} neither {_ARM} nor {_ROTOR}: "
                              "left out")
        self.notes += [f"{series.topic} names the joint {name} twice: the first counts, the second is left out"
                       for name in sorted(twice)]
        if turned and not np.isfinite(columns["theta"]).any():
            self.notes.append(f"{series.topic}: {NO_POSITION}, that of '{_ROTOR}' is: if the names are exchanged, "
                              "correct the program that publishes them, and record again")
        return self._table(series, blocks, columns)

    def _armature(self, series: _Series) -> _Table:
        columns = {name: np.full(len(series.messages), np.nan) for name in ("v_a", "i_a", "duty")}
        blocks = self._decode(series)
        for block in blocks:
            for column, field in (("v_a", "voltage"), ("i_a", "current"), ("duty", "percentage")):
                columns[column][block.rows] = judging.numbers(block.numbers[field])
        return self._table(series, blocks, columns)

    def _values(self, series: _Series | None) -> tuple[Stamps, Floats]:
        """Read a series of std_msgs/Float64: receive times and values, sorted by time."""
        if series is None:
            return np.empty(0, np.int64), np.empty(0)
        blocks = self._decode(series)
        rows = np.concatenate([block.rows for block in blocks] or [np.empty(0, np.int64)])
        values = np.concatenate([judging.numbers(block.numbers["data"]) for block in blocks] or [np.empty(0)])
        times = np.array(series.times, dtype=np.int64)[rows]
        order = np.lexsort((rows, times))
        return times[order], values[order]

    def _decode(self, series: _Series) -> list[Block]:
        blocks, failed = decode(series.messages, series.msgtype)
        if failed:
            self.notes.append(f"{counted(len(failed), 'message')} of {series.topic} could not be decoded")
        return blocks

    def _table(self, series: _Series, blocks: list[Block], columns: dict[str, Floats]) -> _Table:
        """Date the decoded messages and sort them, the first one of equal stamps only."""
        stamps = np.zeros(len(series.messages), dtype=np.int64)
        understood = np.zeros(len(series.messages), dtype=bool)
        for block in blocks:
            seconds, rest = (block.numbers[f"header.stamp.{part}"].astype(np.int64) for part in ("sec", "nanosec"))
            stamps[block.rows], understood[block.rows] = judging.times(seconds, rest)
        timeless = sum(len(block.rows) for block in blocks) - int(understood.sum())
        if timeless:
            self.notes.append(f"{counted(timeless, 'message')} of {series.topic} {_has(timeless)} a stamp that is no "
                              "time (before 1970, or nanosec of 1e9 or more): left out")
        if understood.sum() > 1 and not stamps.any():
            raise RecordingError(f"{series.topic}: header.stamp is never set, so its samples cannot be dated or "
                                 "joined: set it to the instant of each sample in the program that publishes them")
        rows = np.flatnonzero(understood)
        sorted_stamps, first, times = np.unique(stamps[rows], return_index=True, return_counts=True)
        if len(times) and times.max() >= STANDS:
            self.notes.append(f"{int(times.max())} messages of {series.topic} have one stamp: the clock that stamps "
                              "them stands still; all but the first are left out")
        if repeated := len(rows) - len(first):
            self.duplicates += repeated
            kept = rows[first][np.searchsorted(sorted_stamps, stamps[rows])]
            differs = np.any([(x[rows] != x[kept]) & np.isfinite(x[rows]) & np.isfinite(x[kept])
                              for x in columns.values()], axis=0)
            if apart := int(differs.sum()):
                self.notes.append(f"{counted(apart, 'message')} of {series.topic} {_has(apart)} the stamp of another "
                                  f"and other values: {TWO_PROGRAMS}")
        rows = rows[first]
        received = np.array(series.times, dtype=np.int64)[rows]
        return _Table(sorted_stamps, received, {name: values[rows] for name, values in columns.items()})

    def _placed(self, tables: Iterable[_Table], names: Iterable[str]) -> dict[str, Floats]:
        """Put columns of tables on the samples; stamps that are no samples are left out."""
        columns = {name: np.full(len(self.stamps), np.nan) for name in names}
        for table in tables:
            _, rows, known = np.intersect1d(self.stamps, table.stamps, assume_unique=True, return_indices=True)
            for name in columns.keys() & table.columns.keys():
                columns[name][rows] = table.columns[name][known]
        return columns

    def _take_duty_from_command(self, why: str, *, judged: bool) -> None:
        """Hold the last command the rig would have taken: finite, clamped to -1..1 if `judged`; `why` is noted."""
        times, values = self.command
        taken = np.isfinite(values)
        if not taken.any():
            if len(values):
                self.notes.append(f"duty_command {NO_DUTY}: none of its {counted(len(values), 'message')} is a number; "
                                  "correct the program that publishes them, and record again")
            return
        times, values = times[taken], values[taken]
        if judged:
            values = judging.clamped(values, self.notes)
        last = np.searchsorted(times, self.received, side="right") - 1
        self.columns["duty"] = np.where(last >= 0, values[last], np.nan)
        self.notes.append(f"{why}: the duty is that of duty_command by the time it was received")

    def _truth(self, topics: dict[str, _Series]) -> Truth | None:
        tables = []
        if "truth/joint_states" in topics:
            tables.append(self._joints(topics["truth/joint_states"]))
        if "truth/armature" in topics:
            tables.append(self._armature(topics["truth/armature"]))
        return Truth(**self._placed(tables, ("theta", "theta_dot", "omega", "i_a", "v_a"))) if tables else None


def _grid(stamps: Stamps) -> tuple[float, Stamps, int]:
    """Estimate the period (s), find the gaps and count the steps that fit no grid.

    A gap is the index of the sample before it and the number of samples missing.
    """
    steps = np.diff(stamps)
    if not len(steps):
        return float("nan"), np.empty((0, 2), dtype=np.int64), 0
    periods = np.rint(steps / np.median(steps)).astype(np.int64)
    before = np.flatnonzero(periods > 1)
    usual = np.abs(steps / np.median(steps) - 1.0) < OFF_GRID  # a pause need not be a whole number of periods
    period = float(steps[usual].mean() if usual.any() else np.median(steps)) / 1e9
    irregular = int(np.sum(np.abs(steps / np.median(steps) - periods) > OFF_GRID))
    return period, np.stack((before, periods[before] - 1), axis=1), irregular


def _has(number: int) -> str:
    return "has" if number == 1 else "have"
