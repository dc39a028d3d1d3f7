// SPDX-License-Identifier: GPL-3.0-or-later
// Runs the program for some seconds at its greatest load (SSI, PID, a command and a pulse in each period), and prints its
// stack and the times of its interrupts.
#include <stddef.h>
#include <stdio.h>
#include <string.h>

#include "../protocol.h"
#include "board.h"

#define SECONDS 4
#define PERIODS (SECONDS * CLOCK_HZ / PERIOD_CYCLES)

static void command(struct board *b, const void *payload, uint8_t length) {
    uint8_t frame[FRAME_MAX];
    board_send(b, frame, frame_encode(payload, length, frame), 0);
}

int main(int argc, char **argv) {
    struct board *b = argc == 2 ? board_new(argv[1]) : NULL;
    if (b == NULL) {
        fprintf(stderr, "usage: measure PROGRAM.elf\n");
        return 2;
    }
    struct pins pins = {.current = 0.7, .angle = 1.0, .positive = 1.5, .negative = 0.3, .position = 400, .status = 0x10};
    struct outcome outcome;
    const float gains[] = {1.0f, 1.0f, 0.1f, 0.01f, 0.0f, 1.0f}, reference = 2.6f;
    uint8_t payload[25] = {PID_GAINS};
    memcpy(payload + 1, gains, sizeof gains);
    board_run(b, &pins, 10, NULL, 0, &outcome);
    command(b, (uint8_t[]){SCHEME, SCHEME_SSI}, 2);
    command(b, (uint8_t[]){MODE, MODE_PID}, 2);
    command(b, (uint8_t[]){ENABLE, 1}, 2);
    command(b, payload, sizeof payload);
    payload[0] = PID_REFERENCE;
    memcpy(payload + 1, &reference, sizeof reference);
    for (uint32_t i = 0; i < PERIODS; i++) {
        const uint32_t edge = i * 197 % PERIOD_CYCLES; // at each place in the period in turn
        pins.position = (uint16_t)(400 + i % 50);
        command(b, payload, 5);
        if (board_run(b, &pins, 1, &edge, i & 1, &outcome) != 0)
            return 1;
    }
    struct load load;
    board_load(b, &load);
    static const struct { uint8_t vector; const char *name; } NAMES[] = {
        {20, "timer 1 overflow"}, {29, "ADC"}, {25, "receiver"}, {26, "transmitter"}, {41, "capture"}, {45, "timer 4 overflow"},
    };
    printf("Stack: %u bytes\n", load.stack);
    printf("Interrupts: %.1f %% of the time, the longest %.1f us\n",
           100.0 * (double)load.cycles / (double)board_cycle(b), load.longest / 16.0);
    for (size_t i = 0; i < sizeof NAMES / sizeof *NAMES; i++)
        printf("  %-17s %.1f us\n", NAMES[i].name, load.longest_of[NAMES[i].vector] / 16.0);
    printf("Receiver: served within %.1f us of 40, %u bytes lost\n", load.receiver_waited / 16.0, outcome.overruns);
    board_free(b);
    return outcome.overruns || outcome.resets || outcome.ssi_faults || outcome.duty == 0;
}
