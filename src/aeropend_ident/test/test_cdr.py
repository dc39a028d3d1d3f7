# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from aeropend_ident.bags import cdr

JOINT, BATTERY = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState"

def rows(decoded):
    """Put blocks back into one row a message, to compare them."""
    blocks, failed = decoded
    table = dict.fromkeys(failed)
    for block in blocks:
        for at, row in enumerate(block.rows.tolist()):
            values = {name: np.asarray(column[at], dtype=float).tobytes() for name, column in block.numbers.items()}
            assert row not in table
            table[row] = (values, block.names)
    return table


def some_joint(bags, rng):
    """Serialize a JointState with anything in it."""
    odd = np.array([0.0, -0.0, 1.5, math.inf, math.nan, 5e-324, 1e308])
    names = [["arm", "rotor"], ["rotor"], [], ["", "é", "x" * 9]][rng.integers(4)]
    frame = ["", "a", "base_link", "é"][rng.integers(4)]
    stamp = int(rng.integers(0, 2**31 * 10**9))
    position, velocity = (rng.choice(odd, rng.integers(4)) for _ in range(2))
    return bags.joint(stamp, position, velocity, names, frame, little_endian=bool(rng.integers(2)))


@pytest.mark.parametrize("seed", range(60))
def test_bulk_and_single_decoding_agree(bags, seed):
    rng = np.random.default_rng(seed)
    kinds = [some_joint(bags, rng) for _ in range(rng.integers(1, 6))]
    messages = [kinds[rng.integers(len(kinds))] for _ in range(20)]
    together = cdr.decode(messages, JOINT)
    singles = [cdr._decode_one(row, message, JOINT) for row, message in enumerate(messages)]
    assert len(together[0]) <= len(kinds)
    assert rows(together) == rows((singles, []))
    assert len(rows(together)) == len(messages)


def test_many_layouts_fall_back_to_single_decoding(bags):
    messages = [bags.joint(row, [float(row)], [], ["arm"], "f" * row) for row in range(3 * cdr.MAX_LAYOUTS)]
    decoded = cdr.decode(messages, JOINT)
    assert len(decoded[0]) > cdr.MAX_LAYOUTS
    assert [rows(decoded)[row][0]["position"] for row in range(len(messages))] == [
        np.array([row], float).tobytes() for row in range(len(messages))
    ]


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("frame_id", ["", "abc", "a longer name"])
def test_one_block_for_one_layout(bags, little_endian, frame_id):
    messages = [
        bags.battery(row, row / 2, -row / 4, row / 128, frame_id, little_endian=little_endian) for row in range(100)
    ]
    (block,), failed = cdr.decode(messages, BATTERY)
    assert not failed
    np.testing.assert_array_equal(block.numbers["voltage"], np.arange(100) / 2)
    np.testing.assert_array_equal(block.numbers["current"], -np.arange(100) / 4)
    np.testing.assert_array_equal(block.numbers["percentage"], np.arange(100) / 128)
    np.testing.assert_array_equal(block.numbers["header.stamp.nanosec"], np.arange(100))
    assert np.isnan(block.numbers["charge"]).all()


def test_padding_may_hold_anything(bags):
    messages = [bags.joint(row, [row / 8, math.nan], [math.nan, -row / 8]) for row in range(200)]
    rng = np.random.default_rng(0)
    soiled = []
    for message in messages:
        changed = bytearray(message)
        # encapsulation options; behind the empty frame_id; behind "arm"+NUL there is none; before the doubles
        for byte in (2, 3, 17, 18, 19):
            changed[byte] = rng.integers(256)
        soiled.append(bytes(changed) + bytes(rng.integers(0, 256, 3, dtype=np.uint8)))
    (block,), failed = cdr.decode(soiled, JOINT)
    assert not failed
    np.testing.assert_array_equal(block.numbers["position"][:, 0], np.arange(200) / 8)
    np.testing.assert_array_equal(block.numbers["velocity"][:, 1], -np.arange(200) / 8)
    assert block.names["name"] == ("arm", "rotor")


def test_other_joint_names_of_equal_length_are_another_block(bags):
    pairs = [("arm", "rotor"), ("mra", "rotor")]
    messages = [bags.joint(row, [1.0, 2.0], [], names) for row, names in enumerate(pairs)]
    blocks, _ = cdr.decode(messages, JOINT)
    assert [(block.rows.tolist(), block.names["name"]) for block in blocks] == [
        ([0], ("arm", "rotor")),
        ([1], ("mra", "rotor")),
    ]


def test_what_is_no_message_is_told(bags):
    good = bags.joint(5, [1.0, 2.0], [3.0, 4.0])
    blocks, failed = cdr.decode([good, b"", good[:30], b"\0\1\0\0", good, b"\xff" * len(good)], JOINT)
    assert failed == [1, 2, 3, 5]
    assert sorted(row for block in blocks for row in block.rows.tolist()) == [0, 4]


@pytest.mark.parametrize("msgtype", [JOINT, BATTERY, "diagnostic_msgs/msg/DiagnosticArray"])
def test_any_bytes_are_decoded_or_refused(bags, msgtype):
    rng = np.random.default_rng(0)
    good = bags.joint(5, [1.0, 2.0], [3.0, 4.0])
    noise = [rng.bytes(rng.integers(200)) for _ in range(100)]
    cut = [good[:length] for length in range(len(good))]
    flipped = [bytes(value ^ (255 if at == byte else 0) for at, value in enumerate(good)) for byte in range(len(good))]
    for data in [*noise, *(b"\0\1\0\0" + one for one in noise), *cut, *flipped]:
        blocks, failed = cdr.decode([data], msgtype)
        assert sum(len(block.rows) for block in blocks) + len(failed) == 1
