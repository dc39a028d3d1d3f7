# SPDX-License-Identifier: Apache-2.0
"""Writing of samples as a recording: joint_states, armature, duty_command and reference in an MCAP bag."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2.errors import WriterError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from aeropend_ident.bags.cdr import encode
from aeropend_ident.bags.writer import BagWriter
from aeropend_ident.tables.mapping import Samples
from aeropend_ident.tables.table import Floats, Ints
from aeropend_sim.errors import UserError

JOINT, BATTERY, FLOAT = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Float64"

BLOCK = 5000
"""Number of samples that are serialized at once (choice)."""


class BagExistsError(UserError):
    """The recording exists already."""


def write(path: Path, samples: Samples, about: Mapping[str, str],
          progress: Callable[[float], None] | None = None) -> None:
    """Write a recording; after an error nothing is left of it.

    The time of reception of a sample is its stamp. duty_command and reference hold a message for each change.

    Args:
        path: folder of the recording.
        samples: the samples.
        about: origin of the recording, for the metadata of the bag.
        progress: gets the share that is done.

    Raises:
        BagExistsError: `path` exists already.
        OSError: it cannot be written.
    """
    try:
        writer = BagWriter(path)
        writer.open()
    except WriterError:
        raise BagExistsError(f"{path}: is there already: name another folder") from None
    try:
        for key, value in about.items():
            writer.set_custom_data(key, value)
        _fill(writer, samples, progress)
        writer.close()
    except BaseException:  # Ctrl-C too
        writer.abort()
        shutil.rmtree(path, ignore_errors=True)
        raise


def _fill(writer: BagWriter, samples: Samples, progress: Callable[[float], None] | None) -> None:
    store, templates = _templates()
    channels, count = samples.channels, len(samples.stamp_ns)
    duty = channels.get("duty")
    topics = {"/joint_states": JOINT}
    if channels.keys() & {"duty", "i_a", "v_a"}:
        topics["/armature"] = BATTERY
    if duty is not None:
        topics["/duty_command"] = FLOAT
    if samples.reference is not None:
        topics["/reference"] = FLOAT
    entered = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
    changes: dict[str, Floats] = {}
    for topic, values in (("/duty_command", duty), ("/reference", samples.reference)):
        if values is not None:
            changes[topic] = _changes(values)
    for start in range(0, count, BLOCK):
        part = slice(start, min(start + BLOCK, count))
        stamps = samples.stamp_ns[part]
        rows = {"/joint_states": encode(templates[JOINT], JOINT, _joints(stamps, channels, part))}
        if "/armature" in entered:
            rows["/armature"] = encode(templates[BATTERY], BATTERY, _armature(stamps, channels, part))
        for topic, values in changes.items():
            rows[topic] = encode(templates[FLOAT], FLOAT, {"data": values[part]})
        for k, stamp in enumerate(stamps.tolist()):
            for topic in ("/duty_command", "/reference"):  # before the first sample with the new value
                if topic in changes and math.isfinite(changes[topic][start + k]):
                    writer.write(entered[topic], stamp, rows[topic][k])
            writer.write(entered["/joint_states"], stamp, rows["/joint_states"][k])
            if "/armature" in entered:
                writer.write(entered["/armature"], stamp, rows["/armature"][k])
        if progress is not None:
            progress(part.stop / count)


def _changes(values: Floats) -> Floats:
    """(N,) The values that differ from the previous one; NaN elsewhere."""
    known = np.flatnonzero(np.isfinite(values))
    out = np.full(len(values), np.nan)
    new = known[np.concatenate(([True], np.diff(values[known]) != 0.0))] if len(known) else known
    out[new] = values[new]
    return out


def _stamps(stamps: Ints) -> dict[str, NDArray[Any]]:
    seconds, rest = np.divmod(stamps, 1_000_000_000)
    return {"header.stamp.sec": seconds, "header.stamp.nanosec": rest}


def _joints(stamps: Ints, channels: Mapping[str, Floats], part: slice) -> dict[str, NDArray[Any]]:
    nothing = np.full(len(stamps), np.nan)
    theta, omega = (channels[name][part] if name in channels else nothing for name in ("theta", "omega"))
    return {**_stamps(stamps), "position": np.stack((theta, nothing), axis=1),
            "velocity": np.stack((nothing, omega), axis=1)}


def _armature(stamps: Ints, channels: Mapping[str, Floats], part: slice) -> dict[str, NDArray[Any]]:
    fields = {"voltage": "v_a", "current": "i_a", "percentage": "duty"}
    return {**_stamps(stamps), **{field: channels[name][part] for field, name in fields.items() if name in channels}}


@lru_cache(maxsize=1)
def _templates() -> tuple[Typestore, dict[str, bytes]]:
    """The message types, and a serialized message of each with NaN in every field."""
    store = get_typestore(Stores.ROS2_JAZZY)
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](0, 0), "")
    nan, cells = math.nan, np.array([], np.float32)
    messages = {
        JOINT: store.types[JOINT](header, ["arm", "rotor"], np.full(2, nan), np.full(2, nan), np.array([])),
        BATTERY: store.types[BATTERY](header, nan, nan, nan, nan, nan, nan, nan, 0, 0, 0, True, cells, cells,
                                      "armature", ""),
        FLOAT: store.types[FLOAT](0.0),
    }
    return store, {kind: bytes(store.serialize_cdr(message, kind)) for kind, message in messages.items()}
