# SPDX-License-Identifier: Apache-2.0
"""Frames: what is refused, how the stream is found again, what fuzzing finds."""

import random
import struct

import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from aeropend_bridge import protocol
from aeropend_bridge.protocol import Ack, Flag, Hello, Receiver, Sample, Scheme, Type, frame, parse, unframe


def packed(sample):
    return struct.pack("<BBIBHHhIH", Type.SAMPLE, *sample)


samples = st.builds(
    Sample,
    st.integers(0, 255),
    st.integers(0, 2**32 - 1),
    st.integers(0, 255),
    st.integers(0, 1023),
    st.integers(0, 1023),
    st.integers(-512, 511),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**11 - 1),
)
A_SAMPLE = Sample(7, 123456789, 110, 300, 512, -250, 12345, Flag.ENABLED | Flag.NEW_PERIOD)


def opened(*data):
    """A receiver in step, fed."""
    receiver = Receiver()
    assert receiver.feed(b"\0") == []
    return receiver, [message for piece in data for message in receiver.feed(piece)]


def test_the_wire_is_what_the_board_writes():
    assert frame(bytes([0x11])) == bytes([0x04, 0x11, 0xE3, 0xE0, 0x00])
    assert frame(b"123456789")[-3:] == bytes([0x29, 0xB1, 0x00])  # the CRC's published check value
    content = cobs.decode(protocol.duty_command(5, 0.5)[:-1])
    assert content[:-2] == bytes([0x10, 5, 0x00, 0x80])
    assert len(frame(packed(A_SAMPLE))) == 23


def test_every_command_has_its_layout():
    def payload(command):
        return unframe(command[:-1])

    assert payload(protocol.hello_request()) == b"\x11"
    assert payload(protocol.enable(True)) == b"\x12\x01"
    assert payload(protocol.enable(False)) == b"\x12\x00"
    assert payload(protocol.set_scheme(Scheme.SSI)) == b"\x13\x01"
    assert payload(protocol.set_mode(protocol.Mode.PID)) == b"\x16\x01"
    assert payload(protocol.pid_gains(1, 2, 3, 4, 0, 1)) == b"\x14" + struct.pack("<6f", 1, 2, 3, 4, 0, 1)
    assert payload(protocol.pid_reference(0.4)) == b"\x15" + struct.pack("<f", 0.4)
    assert payload(protocol.write_calibration(bytes(range(16)))) == b"\x17" + bytes(range(16))
    assert payload(protocol.duty_command(0, 1.0))[2:] == b"\xff\xff"
    with pytest.raises(ValueError, match="16"):
        protocol.write_calibration(b"123")


@given(samples)
def test_samples_come_back(sample):
    receiver, got = opened(frame(packed(sample)))
    assert got == [sample]
    assert receiver.bad == 0


def test_hello_and_ack_come_back():
    hello = struct.pack("<BBBBBBB16sI", Type.HELLO, 1, 2, 3, 4, 0b1000, 1, bytes(range(16)), 0xDEADBEEF)
    got = opened(frame(hello), frame(bytes([Type.ACK, 0x12, 3])))[1]
    assert got == [Hello(1, (2, 3, 4), 8, 1, bytes(range(16)), 0xDEADBEEF), Ack(0x12, 3)]
    assert got[0].why_reset() == "watchdog"


def test_hello_of_another_version_is_told_whatever_its_layout():
    (hello,) = opened(frame(bytes([Type.HELLO, 2, 99])))[1]
    assert hello.version == 2
    assert opened(frame(bytes([Type.HELLO, protocol.VERSION, 99])))[1] == []


@pytest.mark.parametrize(
    "wrong",
    [
        packed(A_SAMPLE._replace(current=1024)),
        packed(A_SAMPLE._replace(angle=1024)),
        packed(A_SAMPLE._replace(voltage=512)),
        packed(A_SAMPLE._replace(voltage=-513)),
        packed(A_SAMPLE._replace(flags=1 << 11)),
        packed(A_SAMPLE)[:-1],
        packed(A_SAMPLE) + b"\x01",
        bytes([0x7F, 1, 2]),
        bytes([Type.DUTY, 0, 0, 0]),
    ],
)
def test_right_crc_but_no_message_of_the_board_is_refused(wrong):
    receiver, got = opened(frame(wrong), frame(packed(A_SAMPLE)))
    assert got == [A_SAMPLE]
    assert receiver.bad == 1


def test_the_crc_is_checked():
    content = packed(A_SAMPLE)
    right = protocol.binascii.crc_hqx(content, 0xFFFF)
    for wrong in (0, right ^ 1, right ^ 0x8000, int.from_bytes(right.to_bytes(2, "little"), "big")):
        receiver, got = opened(cobs.encode(content + wrong.to_bytes(2, "big")) + b"\0")
        assert got == []
        assert receiver.bad == 1


def flipped(data, bits):
    return (int.from_bytes(data, "little") ^ bits).to_bytes(len(data), "little")


def corrupt(rng, kind, size):
    """Error pattern of a kind for `size` bits: 1..3 single bits, or a burst of up to 16."""
    if kind == "burst":
        length = rng.randint(2, 16)
        inner = rng.getrandbits(length - 2) << 1 if length > 2 else 0
        return (inner | 1 | 1 << (length - 1)) << rng.randrange(size - length + 1)
    return sum(1 << bit for bit in rng.sample(range(size), kind))


@pytest.mark.parametrize("kind", [1, 2, 3, "burst"])
def test_errors_on_the_wire_are_refused_and_cost_the_frame_that_they_hit(kind):
    rng = random.Random(4)
    before, hit, after = (A_SAMPLE._replace(sequence=k, time=rng.getrandbits(32)) for k in range(3))
    first, middle, last = (frame(packed(sample)) for sample in (before, hit, after))
    patterns = [1 << bit for bit in range(8 * len(middle))] if kind == 1 else None
    for trial in range(len(patterns) if patterns else 10_000):
        error = patterns[trial] if patterns else corrupt(rng, kind, 8 * len(middle))
        receiver, got = opened(first + flipped(middle, error) + last)
        # an error in the closing zero joins two frames
        closed = not error >> 8 * (len(middle) - 1)
        assert got == ([before, after] if closed else [before]), f"{error:x}"
        assert receiver.bad >= 1


@given(st.lists(samples, min_size=3, max_size=20), st.data())
@settings(max_examples=200, deadline=None)
def test_lost_and_inserted_bytes_cost_at_most_the_frames_they_touch(sent, data):
    wire = [frame(packed(sample)) for sample in sent]
    at = data.draw(st.integers(0, len(sent) - 2))
    cut = data.draw(st.integers(0, len(wire[at]) - 1))
    junk = data.draw(st.binary(max_size=100))
    wire[at] = wire[at][:cut] + junk + wire[at][cut + 1 :]
    got = opened(b"".join(wire))[1]
    lost = [sample for sample in sent[:at] + sent[at + 2 :] if sample not in got]
    assert lost == []
    assert all(message in sent for message in got)


def test_opening_in_the_middle_of_a_frame_costs_that_frame_and_is_not_counted():
    wire = b"".join(frame(packed(A_SAMPLE._replace(sequence=k))) for k in range(3))
    for cut in range(1, 23):
        receiver = Receiver()
        assert [message.sequence for message in receiver.feed(wire[cut:])] == [1, 2]
        assert receiver.bad == 0
    receiver.restart()
    assert [message.sequence for message in receiver.feed(wire[5:])] == [1, 2]


def test_random_garbage_passes_the_crc_no_more_often_than_chance():
    rng = random.Random(9)
    candidates = 150_000
    payloads = [unframe(cobs.encode(rng.randbytes(21))) for _ in range(candidates)]
    passed = [payload for payload in payloads if payload is not None]
    assert len(passed) <= 3 * candidates / 65536  # chance itself gives 2^-16
    assert sum(parse(payload) is not None for payload in passed) <= candidates / 65536


@given(st.lists(st.binary(max_size=300), max_size=30))
@settings(max_examples=300, deadline=None)
def test_fuzzed_streams_neither_crash_nor_pile_up(chunks):
    receiver = Receiver()
    for chunk in chunks:
        receiver.feed(chunk)
        assert len(receiver._rest) < protocol.LONGEST
    receiver.feed(b"\0")
    assert receiver.feed(frame(packed(A_SAMPLE))) == [A_SAMPLE]


@given(st.lists(samples, min_size=1, max_size=10), st.randoms(use_true_random=False))
def test_how_the_bytes_are_cut_does_not_matter(sent, rng):
    wire = b"".join(frame(packed(sample)) for sample in sent)
    cuts = sorted(rng.randrange(len(wire) + 1) for _ in range(20))
    pieces = [wire[a:b] for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True)]
    assert opened(*pieces)[1] == sent


@given(st.binary(min_size=1, max_size=40))
def test_any_payload_parses_or_is_refused(payload):
    parse(payload)
