# SPDX-License-Identifier: Apache-2.0
"""The boot loader of an Arduino Mega 2560 behind a pty: as much of STK500v2 (Atmel AVR068) as avrdude asks for."""

import os
import select
import threading
import tty
from functools import reduce
from operator import xor

SIGN_ON, SET_PARAMETER, GET_PARAMETER, LOAD_ADDRESS = 0x01, 0x02, 0x03, 0x06
ENTER, LEAVE, PROGRAM_FLASH, READ_FLASH, READ_SIGNATURE = 0x10, 0x11, 0x13, 0x14, 0x1B
OK, UNKNOWN = 0x00, 0xC9
START, TOKEN = 0x1B, 0x0E
SIGNATURE = bytes([0x1E, 0x98, 0x01])
"""Of the ATmega2560, data sheet section 30.7.10."""


class BootLoader:
    """Listens at `port` from its making until `stop`.

    Args:
        worn: address of a byte of the flash that stays as it is.

    Attributes:
        port: path of the pty.
        flash: what the chip's flash holds, 0xFF where it is erased.
        left: programming was ended, as it should be: the program starts.
    """

    def __init__(self, worn: int | None = None) -> None:
        self._worn = worn
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.flash = bytearray(b"\xff" * 256 * 1024)
        self.left = False
        self._address = 0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop listening."""
        self._end.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _run(self) -> None:
        pending = b""
        while not self._end.is_set():
            if not select.select([self._master], [], [], 0.05)[0]:
                continue
            pending += os.read(self._master, 4096)
            while len(pending) >= 5 and len(pending) >= (length := 6 + int.from_bytes(pending[2:4], "big")):
                message, pending = pending[:length], pending[length:]
                if reduce(xor, message) == 0 and message[0] == START and message[4] == TOKEN:
                    self._send(message[1], self._answer(message[5:-1]))

    def _send(self, sequence: int, body: bytes) -> None:
        message = bytes([START, sequence, *len(body).to_bytes(2, "big"), TOKEN]) + body
        os.write(self._master, message + bytes([reduce(xor, message)]))

    def _answer(self, body: bytes) -> bytes:
        command, done = body[0], bytes([body[0], OK])
        if command == SIGN_ON:
            return done + b"\x08AVRISP_2"
        if command == GET_PARAMETER:
            return done + b"\x02"
        if command == LOAD_ADDRESS:
            self._address = 2 * (int.from_bytes(body[1:5], "big") & 0x7FFFFFFF)  # in words; the top bit: beyond 64 KiB
            return done
        if command == READ_SIGNATURE:
            return done + bytes([SIGNATURE[body[4]], OK])
        if command == PROGRAM_FLASH:
            return done if self._write(body[10:], int.from_bytes(body[1:3], "big")) else bytes([command, UNKNOWN])
        if command == READ_FLASH:
            start, count = self._address, int.from_bytes(body[1:3], "big")
            self._address += count
            return done + bytes(self.flash[start : start + count]) + bytes([OK])
        if command in (SET_PARAMETER, ENTER, LEAVE):
            self.left = command == LEAVE
            return done
        return bytes([command, UNKNOWN])

    def _write(self, data: bytes, count: int) -> bool:
        self.flash[self._address : self._address + len(data)] = data
        self._address += len(data)
        if self._worn is not None:
            self.flash[self._worn] = 0xFF
        return len(data) == count
