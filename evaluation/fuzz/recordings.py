# SPDX-License-Identifier: Apache-2.0
"""Recordings of a simulated rig whose values, stamps, names and topics were then changed at random."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from aeropend_ident.bags.cdr import encode
from aeropend_ident.testing.rigs import drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import Model
from evaluation.fuzz.draw import Draw

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT, BATTERY, FLOAT = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Float64"
START_NS = 1_700_000_000_000_000_000
RECEIVED_NS = 300_000
"""From the stamp of a sample until it is received."""

NUMBERS = [math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, -1e-310, 1e-38, 1e300, -1e300, 1.7e308, 3.4e38, 1e19, 1e6,
           -1e6, 1e4, -1e4, 999.9, 255.0, 100.0, 55.0, 1.7, 1.0000001, -0.5, -1.0, 1.0, 0.999, 1e-9]
FACTORS = [-1.0, 0.0, 180.0 / math.pi, -180.0 / math.pi, 100.0, -100.0, 255.0, 1023.0, 1e3, 1e6, 60.0 / (2.0 * math.pi),
           1.0 / (2.0 * math.pi), 1e-3, 1e-6, 1e-20, 1e200]
SHIFTS = [math.pi, -1.6, 0.4, 1e3, -0.2, 2.0 * math.pi, 1e6, 1e-6]
SECONDS = [-2**31, -86_400, -1, 0, 1, 1_699_913_600, 1_700_086_400, 2**31 - 1]
NANOSECONDS = [0, 999_999_999, 10**9, 1_500_000_000, 2**31 - 1, 2**31, 2**32 - 1]
NAMES = [["arm", "rotor"], ["rotor", "arm"], ["arm"], ["rotor"], [], ["Arm", "Rotor"], ["плечо", "ротор"],
         ["臂", "转子"], ["arm", "arm"], ["arm", "arm", "rotor"], ["\u202earm", "rotor"], ["x" * 300, "arm"], ["", ""],
         ["pendulum", "motor"], ["pendulum"], ["arm", "rotor", "wheel", "cart"], ["ذراع"], ["arm\n", "rotor"],
         ["a\x1b[2Jb"]]
ARRAYS = [[], [0.3], [0.3, math.nan], [math.nan, 0.3], [0.1] * 3, [0.2] * 17, [math.nan, math.nan], [math.inf],
          [1e300, -40.0], [0.1, 0.2]]
KINDS = ("steps", "steps", "steps", "latin_hypercube", "staircase", "multisine", "free decay", "constant", "both ways",
         "ramp", "binary")


@dataclass
class Content:
    """What becomes a recording of n samples.

    Attributes:
        columns: theta, omega, i_a, v_a, duty, each (n,).
        stamps: by side ("joints", "armature") the fields sec and nanosec of the stamps, each (n,).
        received: [ns] (n,).
        commands, references: rows and values of what was sent.
        topics: those that are in the bag.
        left_out: by side the rows without a message.
        odd_joints: by row names, position and velocity in place of the usual ones.
        odd_batteries: by row the voltages of cells, and the location.
        effort: of the joints.
        second: whether a second rig is in the bag.
        story: what was done, for the report of a failure.
    """

    columns: dict[str, NDArray[np.float64]]
    stamps: dict[str, list[NDArray[np.int64]]]
    received: NDArray[np.int64]
    commands: list[tuple[int, float]] = field(default_factory=list)
    references: list[tuple[int, float]] = field(default_factory=list)
    topics: set[str] = field(default_factory=lambda: {"joints", "armature", "commands", "references"})
    left_out: dict[str, set[int]] = field(default_factory=lambda: {"joints": set(), "armature": set()})
    odd_joints: dict[int, tuple[list[str], list[float], list[float]]] = field(default_factory=dict)
    odd_batteries: dict[int, tuple[list[float], str]] = field(default_factory=dict)
    effort: list[float] = field(default_factory=list)
    second: bool = False
    story: list[str] = field(default_factory=list)

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.received)


def drive(draw: Draw, kind: str, n: int, period: float, seed: int) -> NDArray[np.float64]:
    """Duty (n,) of a kind of experiment."""
    duration = max(n * period, 1.0)
    if kind == "steps":
        duty = steps(duration, seed, high=draw.pick(0.3, 0.55, 0.9, 1.0))
    elif kind in ("latin_hypercube", "staircase", "multisine"):
        duty = Excitation(kind, duration, seed).series()
    elif kind == "free decay":
        duty = np.where(np.arange(n) < n * draw.pick(0.0, 0.1, 0.3), 0.5, 0.0)
    elif kind == "constant":
        duty = np.full(n, draw.pick(0.0, 0.1, 0.45, 0.5, 1.0))
    elif kind == "both ways":
        duty = np.resize(steps(duration, seed), n) * np.where(np.arange(n) // 1500 % 2, -1.0, 1.0)
    elif kind == "ramp":
        duty = np.linspace(0.0, draw.pick(0.6, 1.0), n)
    else:  # binary
        duty = np.where(np.repeat(draw.rng.random(n // 40 + 1) < 0.5, 40)[:n], 0.55, 0.15)
    return np.pad(duty[:n], (0, max(n - len(duty), 0)))


def recorded(draw: Draw, longest: float, mild: bool, kinds: Sequence[str] = KINDS) -> Content:
    """A recording as a rig makes it; if mild, one with the length and the rate that commands ask for."""
    rate = draw.pick(490.2, 490.2, 490.2, 20.0, 50.0, 100.0, 200.0, 1000.0)
    duration = draw.pick(6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 30.0 if longest <= 40.0 else 60.0)
    if not mild:
        rate = draw.pick(rate, rate, 5.0, 10.0, 33.3, 250.0)
        duration = draw.pick(0.0, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 12.0, 40.0, 60.0, 372.0 if rate <= 20.0 else 6.0)
    fine = 0.00204 if rate < 600.0 else 0.001  # the rig is simulated at this period, and samples are left out
    every = max(round(1.0 / rate / fine), 1)
    n, seed, kind = max(round(min(duration, longest) / fine), 1), int(draw.rng.integers(10**6)), draw.pick(*kinds)
    effects = [str(id_) for id_ in draw.rng.permutation([id_ for id_ in CATALOGUE if id_ != "parameter_mismatch"])]
    effects = effects[: draw.pick(0, 0, 1, 1, 2)]
    # off by more, a parameter may be negative
    model = drawn_rig(seed, {id_: {} for id_ in effects}, off=draw.pick(0.0, 0.02, 0.02, 0.1, 0.2))
    if kind == "both ways":
        model = Model(model.name, {**model.model, "reverse": 1.0}, model.sensing, model.effects)
    duty = drive(draw, kind, n, fine, seed)
    with np.errstate(all="ignore"):
        columns = {**rig.record(model, duty, seed % 1000, fine)[0], "duty": duty}
    columns = {name: values[::every].copy() for name, values in columns.items()}
    if not mild and draw.chance(0.12):
        few = draw.pick(0, 1, 2, 3, 5, 10)
        columns = {name: values[:few] for name, values in columns.items()}
    n = len(columns["duty"])
    stamps = START_NS + round(fine * every * 1e9) * np.arange(n, dtype=np.int64)
    content = Content(columns, {side: list(np.divmod(stamps, 10**9)) for side in ("joints", "armature")},
                      stamps + RECEIVED_NS)
    content.story.append(f"{n} samples at {1.0 / (fine * every):.4g} Hz, {kind}, {' '.join(effects) or 'no effect'}")
    return content


# ---- what is changed -------------------------------------------------------------------------------------------------


def sides(draw: Draw) -> list[str]:
    """One or both of the topics with samples."""
    return list(draw.pick(("joints",), ("armature",), ("joints", "armature")))


def set_(draw: Draw, content: Content, name: str, rows: NDArray[np.int64]) -> object:
    """Any number in place of readings."""
    content.columns[name][rows] = value = draw.pick(*NUMBERS)
    return value


def scale(draw: Draw, content: Content, name: str, rows: NDArray[np.int64]) -> object:
    """Another unit or direction."""
    content.columns[name][rows] *= (factor := draw.pick(*FACTORS))
    return factor


def shift(draw: Draw, content: Content, name: str, rows: NDArray[np.int64]) -> object:
    """Another zero."""
    content.columns[name][rows] += (shift := draw.pick(*SHIFTS))
    return shift


def swap(draw: Draw, content: Content, name: str, _rows: NDArray[np.int64]) -> object:
    """Two channels in each other's place."""
    other = draw.pick(*content.columns)
    content.columns[name], content.columns[other] = content.columns[other].copy(), content.columns[name].copy()
    return other


def freeze(_draw: Draw, content: Content, name: str, rows: NDArray[np.int64]) -> object:
    """A reading that stands still."""
    if len(rows):
        content.columns[name][rows] = content.columns[name][rows[0]]
    return None


def noise(draw: Draw, content: Content, name: str, _rows: NDArray[np.int64]) -> object:
    """Noise of any size."""
    content.columns[name] += (size := draw.pick(1e-6, 0.01, 1.0, 1e3)) * draw.rng.standard_normal(content.n)
    return size


def quantise(draw: Draw, content: Content, name: str, _rows: NDArray[np.int64]) -> object:
    """Coarse steps."""
    content.columns[name] = np.round(content.columns[name] / (step := draw.pick(1e-3, 0.1, 1.0, 100.0))) * step
    return step


def spike(draw: Draw, content: Content, name: str, rows: NDArray[np.int64]) -> object:
    """Single wrong readings."""
    content.columns[name][rows[:20]] += (size := draw.pick(1e2, 1e5, 1e9))
    return size


def nothing(_draw: Draw, content: Content, name: str, _rows: NDArray[np.int64]) -> object:
    """A channel without a reading."""
    content.columns[name][:] = math.nan
    return None


def constant(draw: Draw, content: Content, name: str, _rows: NDArray[np.int64]) -> object:
    """A channel with one value."""
    content.columns[name][:] = value = draw.pick(*NUMBERS)
    return value


def wrap(_draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """An angle from 0 to one turn."""
    content.columns["theta"] = np.mod(content.columns["theta"], 2.0 * math.pi)
    return None


def late(draw: Draw, content: Content, name: str, _rows: NDArray[np.int64]) -> object:
    """A channel that comes late."""
    values, by = content.columns[name], int(draw.rng.integers(1, 600))
    content.columns[name] = np.concatenate((np.full(min(by, content.n), values[0] if content.n else 0.0),
                                            values[: max(content.n - by, 0)]))
    return by


def drop(draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """Lost messages."""
    lost = sides(draw)
    for side in lost:
        content.left_out[side] |= set(rows.tolist())
    return lost


def missing(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """A topic that was not recorded."""
    content.topics.discard(topic := draw.pick("joints", "armature", "commands", "references"))
    return topic


def only(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """One topic alone."""
    content.topics = {draw.pick("joints", "armature", "commands", "references")}
    return content.topics


def command(draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """Commands of any number."""
    value = draw.pick(*NUMBERS)
    content.commands += [(int(row), value) for row in rows[:2000]]
    return value


def reference(draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """References of any number."""
    value = draw.pick(*NUMBERS)
    content.references += [(int(row), value) for row in rows[:200]]
    return value


def gap(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """A pause."""
    return _jump(draw, content, draw.pick(1, 10, 100, 3000), "all")


def clock(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """A clock that is set during the recording."""
    return _jump(draw, content, draw.pick(-86_400, -5, 3, 86_400, 2 * 10**8, -1_700_000_000),
                 draw.pick("stamps", "receipt", "all"))


def _jump(draw: Draw, content: Content, seconds: int, what: str) -> object:
    at = int(draw.rng.integers(content.n)) if content.n else 0
    if what != "receipt":
        for stamps in content.stamps.values():
            stamps[0][at:] += seconds
    if what != "stamps":
        content.received[at:] += seconds * 10**9
    return what, seconds


def jitter(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """Stamps that are not even."""
    content.stamps = {side: list(np.divmod(sec * 10**9 + nanosec + draw.rng.integers(
        0, draw.pick(200_000, 10**6, 5 * 10**6), content.n), 10**9)) for side, (sec, nanosec) in content.stamps.items()}
    return None


def sec(draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """Seconds of stamps that are not of the time."""
    value = draw.pick(*SECONDS)
    for side in sides(draw):
        content.stamps[side][0][rows] = value
    return value


def nanosec(draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """Nanoseconds of stamps, beyond a second too."""
    value = draw.pick(*NANOSECONDS)
    for side in sides(draw):
        content.stamps[side][1][rows] = value
    return value


def jumble(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """Stamps in no order, or backwards."""
    order = draw.pick(draw.rng.permutation(content.n), np.arange(content.n)[::-1])
    for side in sides(draw):
        content.stamps[side] = [part[order].copy() for part in content.stamps[side]]
    return None


def same_stamp(_draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """Samples with one stamp."""
    for parts in content.stamps.values():
        for part in parts:
            part[rows] = part[rows[0]] if len(rows) else 0
    return None


def stamp_unit(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """Stamps in another unit, or samples at another rate than that of the rig."""
    stamps = START_NS + draw.pick(1, 1000, 10**6, 5 * 10**6, 10**8, 10**9, 60 * 10**9) * np.arange(content.n)
    stamps = draw.pick(stamps, stamps // 10**6, stamps * 10**3 % (2**31 * 10**9))
    content.stamps = {side: list(np.divmod(stamps, 10**9)) for side in content.stamps}
    return None


def received(draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """Times of receipt that say nothing."""
    what = draw.pick("zero", "same", "back", "end of time", "random")
    if what == "zero":
        content.received[rows] = 0
    elif what == "same":
        content.received[:] = START_NS
    elif what == "back":
        content.received = content.received[::-1].copy()
    elif what == "end of time":
        content.received[rows] = 2**63 - 10**9
    else:
        content.received += draw.rng.integers(-10**10, 10**10, content.n)
    return what


def joints(draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """Other joints than those of the rig."""
    odd = (draw.pick(*NAMES), draw.pick(*ARRAYS), draw.pick(*ARRAYS))
    content.odd_joints |= {int(row): odd for row in rows[:3000]}
    return odd


def joint_names(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """The rig's joints under other names, in all messages."""
    names, c = draw.pick(*NAMES), content.columns
    empty = [math.nan] * len(names)
    content.odd_joints |= {row: (names, [float(c["theta"][row]), *empty[1:]][: len(names)],
                                 [*empty[:1], float(c["omega"][row]), *empty[2:]][: len(names)])
                           for row in range(content.n)}
    return names


def battery(draw: Draw, content: Content, _name: str, rows: NDArray[np.int64]) -> object:
    """Cells and locations of batteries."""
    odd = (draw.pick([], [1.0], [math.nan] * 3, [3.7] * 24), draw.pick("", "armature", "x" * 500, "臂", "\x1b[31m"))
    content.odd_batteries |= {int(row): odd for row in rows[:3000]}
    return odd


def effort(draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """Efforts of joints."""
    content.effort = draw.pick([0.1, 0.2], [math.nan], [1e300])
    return content.effort


def second_rig(_draw: Draw, content: Content, _name: str, _rows: NDArray[np.int64]) -> object:
    """A second rig in the bag."""
    content.second = True
    return None


Edit = Callable[[Draw, Content, str, NDArray[np.int64]], object]
MILD: tuple[Edit, ...] = (set_, set_, freeze, noise, quantise, spike, nothing, late, drop, gap, jitter, shift, scale,
                          constant, missing, command, wrap)
"""Changes after which a recording can often be used."""
WILD: tuple[Edit, ...] = (*MILD, set_, scale, swap, only, reference, clock, sec, nanosec, jumble, same_stamp,
                          stamp_unit, received, joints, joints, joint_names, battery, effort, second_rig)


def change(draw: Draw, content: Content, mild: bool) -> None:
    """Change a recording at random, from nothing to six things."""
    with np.errstate(all="ignore"):
        for _ in range(draw.pick(0, 1, 1, 1, 2, 2, 3, 4, 6)):
            edit, name, rows = draw.pick(*(MILD if mild else WILD)), draw.pick(*content.columns), draw.rows(content.n)
            if mild and edit in (set_, drop, freeze):
                rows = rows[: draw.pick(1, 20, content.n // 2 or 1)]
            told = edit(draw, content, name, rows)
            content.story.append(f"{edit.__name__.strip('_')} {name}, {len(rows)} rows: {told}")


# ---- the bag ---------------------------------------------------------------------------------------------------------


def write(draw: Draw, path: Path, longest: float, mildness: float, references: float,
          kinds: Sequence[str] = KINDS) -> list[str]:
    """Write a recording; returns what it holds.

    Args:
        draw: what is drawn from.
        path: the new folder.
        longest: [s]
        mildness: share of recordings that commands can often use.
        references: share of recordings with references.
        kinds: of experiments.
    """
    mild = draw.chance(mildness)
    content = recorded(draw, longest, mild, kinds)
    n, duty = content.n, content.columns["duty"]
    if n and draw.chance(0.5):
        content.commands = [(int(row), float(duty[row])) for row in np.flatnonzero(np.diff(duty, prepend=-1.0))]
    if n and draw.chance(references):
        content.references = [(int(row), draw.pick(0.3, 0.5, 0.1, 150.0, 0.0))
                              for row in np.linspace(0, n - 1, draw.pick(1, 2, 4))]
    change(draw, content, mild)
    namespace = "" if mild else draw.pick("", "", "", "/rig1", "/a/b")
    messages = _messages(content, namespace)
    if draw.chance(0.2):
        messages.sort(key=lambda message: message[2])
    plugin = draw.pick(StoragePlugin.MCAP, StoragePlugin.MCAP, StoragePlugin.SQLITE3)
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        topics = {(topic, kind): writer.add_connection(topic, kind, typestore=STORE)
                  for topic, kind in dict.fromkeys(message[:2] for message in messages)}
        for topic, kind, at, raw in messages:
            writer.write(topics[topic, kind], at, raw)
    return [*content.story, f"{len(messages)} messages in {namespace or '/'}, {plugin.name}"]


def _messages(content: Content, namespace: str) -> list[tuple[str, str, int, bytes]]:
    """Topic, type, time of receipt and bytes of each message."""
    messages: list[tuple[str, str, int, bytes]] = []
    at = np.clip(content.received, 0, 2**63 - 10**9).tolist()
    for topic, side, kind, rows in (("joint_states", "joints", JOINT, _joint_rows(content)),
                                    ("armature", "armature", BATTERY, _battery_rows(content))):
        if side in content.topics:
            messages += [(f"{namespace}/{topic}", kind, at[row], raw) for row, raw in enumerate(rows)
                         if row not in content.left_out[side]]
    if content.second:
        messages += [(f"/other{topic}", kind, when, raw) for topic, kind, when, raw in messages[:500]]
    for topic, side, numbers in (("duty_command", "commands", content.commands),
                                 ("reference", "references", content.references)):
        if side in content.topics:
            messages += [(f"{namespace}/{topic}", FLOAT, at[row], _serialized(FLOAT, value)) for row, value in numbers]
    return messages


def _joint_rows(content: Content) -> list[bytes]:
    if not content.n:
        return []
    empty = np.full(content.n, math.nan)
    rows = encode(_joint(["arm", "rotor"], [0.0, 0.0], [0.0, 0.0], content.effort), JOINT, {
        **_stamps(content, "joints"),
        "position": np.stack((content.columns["theta"], empty), axis=1),
        "velocity": np.stack((empty, content.columns["omega"]), axis=1)})
    for row, (names, position, velocity) in content.odd_joints.items():
        rows[row] = _with_stamp_of(rows[row], _joint(names, position, velocity, content.effort))
    return rows


def _battery_rows(content: Content) -> list[bytes]:
    if not content.n:
        return []
    with np.errstate(all="ignore"):
        values = {name: content.columns[name].astype(np.float32) for name in ("v_a", "i_a", "duty")}
    rows = encode(_battery(0.0, 0.0, 0.0, [], "armature"), BATTERY, {
        **_stamps(content, "armature"), "voltage": values["v_a"], "current": values["i_a"],
        "percentage": values["duty"]})
    for row, (cells, location) in content.odd_batteries.items():
        readings = (float(values[name][row]) for name in ("v_a", "i_a", "duty"))
        rows[row] = _with_stamp_of(rows[row], _battery(*readings, cells, location))
    return rows


def _stamps(content: Content, side: str) -> dict[str, NDArray[np.int64]]:
    seconds, nanoseconds = content.stamps[side]
    return {"header.stamp.sec": np.clip(seconds, -2**31, 2**31 - 1), "header.stamp.nanosec": nanoseconds % 2**32}


def _with_stamp_of(usual: bytes, odd: bytes) -> bytes:
    """A message with the stamp of another; both begin with four bytes of CDR."""
    return odd[:4] + usual[4:12] + odd[12:]


def _joint(names: list[str], position: list[float], velocity: list[float], effort: list[float]) -> bytes:
    return _serialized(JOINT, _header(), names, np.array(position), np.array(velocity), np.array(effort))


def _battery(voltage: float, current: float, duty: float, cells: list[float], location: str) -> bytes:
    nan, each = math.nan, np.array(cells, np.float32)
    return _serialized(BATTERY, _header(), voltage, nan, current, nan, nan, nan, duty, 0, 0, 0, True, each, each,
                       location, "")


def _header() -> object:
    return STORE.types["std_msgs/msg/Header"](STORE.types["builtin_interfaces/msg/Time"](0, 0), "")


def _serialized(kind: str, *fields: object) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[kind](*fields), kind))
