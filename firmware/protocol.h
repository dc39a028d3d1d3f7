// SPDX-License-Identifier: Apache-2.0
// The serial protocol; README.md, "Protocol", describes the fields.
#ifndef PROTOCOL_H
#define PROTOCOL_H

#include <stdbool.h>
#include <stdint.h>

#define BAUD 500000UL
#define PROTOCOL_VERSION 1

#define FIRMWARE_MAJOR 1
#define FIRMWARE_MINOR 0
#define FIRMWARE_PATCH 0

enum message {
    SAMPLE = 0x01,
    HELLO = 0x02,
    ACK = 0x03,
    DUTY = 0x10,
    HELLO_REQUEST = 0x11,
    ENABLE = 0x12,
    SCHEME = 0x13,
    PID_GAINS = 0x14,
    PID_REFERENCE = 0x15,
    MODE = 0x16,
    WRITE_CALIBRATION = 0x17,
};

enum status { OK = 0, BAD_VALUE = 1, UNKNOWN_TYPE = 2, DISABLED = 3 };

enum scheme { SCHEME_PWM = 0, SCHEME_SSI = 1 };

enum mode { MODE_DIRECT = 0, MODE_PID = 1 };

enum flag {
    FLAG_ENABLED = 1 << 0,
    FLAG_SSI = 1 << 1,
    FLAG_SSI_PARITY = 1 << 2,
    FLAG_SSI_STATUS = 1 << 3,
    FLAG_PULSE_REJECTED = 1 << 4,
    FLAG_COMMAND_TIMEOUT = 1 << 5,
    FLAG_PID = 1 << 6,
    FLAG_WATCHDOG_RESET = 1 << 7,
    FLAG_BROWN_OUT = 1 << 8,
    FLAG_RECEIVE_ERROR = 1 << 9,
    FLAG_NEW_PERIOD = 1 << 10,
};

#define CALIBRATION_SIZE 16

// A frame is COBS(payload, CRC-16 big endian) and a zero byte.
#define PAYLOAD_MAX 32
#define FRAME_MAX (PAYLOAD_MAX + 4)

// Writes the frame of a payload of 1..PAYLOAD_MAX bytes. Returns its length with the final zero.
uint8_t frame_encode(const uint8_t *payload, uint8_t length, uint8_t frame[FRAME_MAX]);

// The received part of a frame.
struct decoder {
    uint8_t bytes[FRAME_MAX];
    uint8_t length; // of bytes; FRAME_MAX + 1: too long, wait for its end
    bool bad;       // set when a frame was refused; the caller clears it
};

// Decodes one byte. Returns the length of the payload in d->bytes if the byte completes a valid frame, else 0.
uint8_t frame_decode(struct decoder *d, uint8_t byte);

#endif
