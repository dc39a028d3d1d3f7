// SPDX-License-Identifier: Apache-2.0
#include "protocol.h"

#ifdef __AVR__
#include <util/crc16.h>
#else
static uint16_t _crc_xmodem_update(uint16_t crc, uint8_t byte) {
    crc ^= (uint16_t)(byte << 8);
    for (uint8_t bit = 0; bit < 8; bit++)
        crc = (uint16_t)(crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1);
    return crc;
}
#endif

static uint16_t crc16(const uint8_t *bytes, uint8_t length) {
    uint16_t crc = 0xFFFF;
    while (length--)
        crc = _crc_xmodem_update(crc, *bytes++);
    return crc;
}

uint8_t frame_encode(const uint8_t *payload, uint8_t length, uint8_t frame[FRAME_MAX]) {
    uint16_t crc = crc16(payload, length);
    uint8_t code = 0; // place of the distance to the next zero
    uint8_t at = 1;
    for (uint8_t i = 0; i < length + 2; i++) {
        uint8_t byte = i < length ? payload[i] : i == length ? crc >> 8 : crc & 0xFF;
        if (byte == 0) {
            frame[code] = at - code;
            code = at++;
        } else {
            frame[at++] = byte;
        }
    }
    frame[code] = at - code;
    frame[at++] = 0;
    return at;
}

// Decodes COBS in place. Returns the length, or 0 if a code points past the end.
static uint8_t unstuff(uint8_t *bytes, uint8_t length) {
    uint8_t from = 0, to = 0;
    while (from < length) {
        uint8_t code = bytes[from++];
        if (code - 1 > length - from)
            return 0;
        while (--code)
            bytes[to++] = bytes[from++];
        if (from < length)
            bytes[to++] = 0;
    }
    return to;
}

uint8_t frame_decode(struct decoder *d, uint8_t byte) {
    if (byte != 0) {
        if (d->length < FRAME_MAX)
            d->bytes[d->length++] = byte;
        else
            d->length = FRAME_MAX + 1;
        return 0;
    }
    uint8_t length = d->length;
    d->length = 0;
    if (length == 0) // zeros between frames have no meaning
        return 0;
    if (length <= FRAME_MAX) {
        length = unstuff(d->bytes, length);
        if (length > 2 && crc16(d->bytes, length - 2) == (uint16_t)(d->bytes[length - 2] << 8 | d->bytes[length - 1]))
            return length - 2;
    }
    d->bad = true;
    return 0;
}
