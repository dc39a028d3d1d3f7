# SPDX-License-Identifier: Apache-2.0
"""The port: a real pty in place of a real USB port."""

import os
import tty
from pathlib import Path

import pytest

from aeropend_bridge.link import Link, LinkError
from aeropend_bridge.protocol import BAUD, Receiver, duty_command, hello_request, unframe


class Pty:
    """Both ends of a pty; the slave stays open, as in a driver."""

    def __init__(self):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self.slave)

    def read(self):
        data = b""
        try:
            while piece := os.read(self.master, 65536):
                data += piece
        except BlockingIOError:
            pass
        return data

    def close(self):
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def pty():
    pty = Pty()
    yield pty
    pty.close()


@pytest.fixture
def link(pty):
    link = Link(pty.path, BAUD)
    link.open()
    yield link
    link.close()


def test_bytes_pass_unchanged_both_ways(pty, link):
    every = bytes(range(256))
    assert link.write(every)
    assert pty.read() == every
    os.write(pty.master, every)
    data, at = link.read(1.0)
    assert data == every
    assert at > 0
    assert link.read(0.0)[0] == b""


def test_a_full_port_drops_what_is_written_and_never_waits(pty, link):
    frame = duty_command(1, 0.5)
    written = 0
    while link.write(frame):
        written += 1
        assert written < 1_000_000
    assert link.dropped == 1
    assert not link.write(frame)
    taken = pty.read()
    assert link.write(hello_request())  # after a torn frame a zero comes first: this one is whole
    pieces = (taken + pty.read()).split(b"\0")
    assert unframe(pieces[-2]) == b"\x11"
    whole = sum(unframe(piece) == unframe(frame[:-1]) for piece in pieces)
    assert whole == written


def test_what_cannot_be_opened_is_told_in_one_line(pty, link, tmp_path):
    with pytest.raises(LinkError, match="plug the board in"):
        Link(str(tmp_path / "none"), BAUD).open()
    with pytest.raises(LinkError, match="in use by another program"):
        Link(pty.path, BAUD).open()
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path, Path("/dev/null")):
        with pytest.raises(LinkError, match="is no serial port: name that of the board") as error:
            Link(str(path), BAUD).open()
        assert "\n" not in str(error.value)


def test_a_port_that_goes_away_is_told_and_opens_again(tmp_path):
    path = tmp_path / "tty"
    first, second = Pty(), Pty()
    path.symlink_to(first.path)
    link = Link(str(path), BAUD)
    with pytest.raises(LinkError, match="not open"):
        link.read(0.0)
    link.open()
    first.close()
    with pytest.raises(LinkError, match="lost"):
        link.read(1.0)
    link.close()
    assert not link.is_open
    assert not link.write(b"x")
    path.unlink()
    path.symlink_to(second.path)
    link.open()
    os.write(second.master, b"\0" + b"again\0")
    assert link.read(1.0)[0] == b"\0again\0"
    link.close()
    second.close()


def test_reading_waits_only_as_long_as_it_may(link):
    assert link.read(0.01)[0] == b""
    assert Receiver().feed(b"") == []
