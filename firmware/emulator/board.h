// SPDX-License-Identifier: GPL-3.0-or-later
// An Arduino Mega with the board's program, one period of its PWM per call; see README.md.
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

#define CLOCK_HZ 16000000u
#define PERIOD_CYCLES (64u * 510u)

// State of the pins during a period, from TOP to TOP of Timer1 with the sample in its middle.
struct pins {
    double current;       // V at A0 while the pulse is high
    double angle;         // V at A2
    double positive;      // V at A3
    double negative;      // V at A1
    uint16_t position;    // of the AS5040, 0..1023
    uint8_t status;       // its OCF, COF, LIN, MagINC, MagDEC, as 5 bits
    uint8_t parity_error; // 1: a wrong parity bit
};

struct outcome {
    uint64_t start;      // of the period, cycles since power-on
    uint32_t cycles;     // that passed
    uint8_t duty;        // OCR1A that acts in the next period; 0 if the pin is not driven
    uint8_t running;     // Timer1 ended the period; 0: it does not run, as in a reset
    uint16_t resets;     // by the watchdog, so far
    uint16_t overruns;   // bytes that the receiver lost, so far
    uint16_t ssi_faults; // clock edges too close for the AS5040, so far
    uint64_t written;    // cycle at which OCR1A was last written to with another value
};

struct load {
    uint64_t cycles;          // of all interrupts so far
    uint32_t longest;         // cycles of one interrupt, with nested ones
    uint32_t longest_of[64];  // by vector
    uint32_t receiver_waited; // cycles, at most; after 640 a third byte has come, and the next is lost
    uint32_t stack;           // bytes, greatest size
};

enum cause { POWER_ON = 1, EXTERNAL = 2, BROWN_OUT = 4 }; // as in MCUSR

struct board;

// Loads a program. Returns NULL, and prints the reason, if that fails.
struct board *board_new(const char *elf);
void board_free(struct board *b);

// Runs periods with constant pins; `edges` are rising edges at the IR input, in cycles from the start, ascending.
// Returns 0, or -1 if the processor has stopped.
int board_run(struct board *b, const struct pins *pins, uint32_t periods, const uint32_t *edges, uint32_t count,
              struct outcome *outcome);

// Sends bytes to the board, back to back at its rate, the first one `delay` cycles from now.
// Returns the number of bytes for which there was room.
uint32_t board_send(struct board *b, const uint8_t *bytes, uint32_t count, uint32_t delay);

// Returns the bytes that the board has sent; `times`, if not NULL, gets the cycle at which each byte was complete.
uint32_t board_receive(struct board *b, uint8_t *bytes, uint64_t *times, uint32_t room);

// Resets the processor; the time continues.
void board_reset(struct board *b, enum cause cause);

// Stops the main program until a reset; interrupts continue.
void board_hang(struct board *b);

// The cycle of the next overflow of Timer4.
uint64_t board_next_overflow(const struct board *b);

uint64_t board_cycle(const struct board *b);
uint8_t board_duty_register(const struct board *b);
void board_load(const struct board *b, struct load *load);

#endif
