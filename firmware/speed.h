// SPDX-License-Identifier: Apache-2.0
// The period of the propeller from its IR pulses, false and missed ones left out.
#ifndef SPEED_H
#define SPEED_H

#include <stdbool.h>
#include <stdint.h>

#define TICKS_PER_S 2000000UL

// A revolution in less than this is noise: 250 rev/s.
#define SHORTEST_PERIOD (TICKS_PER_S / 250)

// After this long without a pulse the speed is not known.
#define LONGEST_PERIOD (TICKS_PER_S / 2)

// What the motor can do, in rev/s^2: 1 krad/s^2. Its stall torque gives 0.76 krad/s^2.
#define GREATEST_ACCELERATION 160.0f

struct speed {
    uint32_t period;   // of the last good revolution, ticks; 0: none
    uint32_t last;     // when the last good pulse came, ticks
    bool started;      // there was one
    uint8_t refused;   // pulses in a row
    uint32_t expected; // the period that the next must fit; 0: any
};

enum pulse { PULSE_FIRST, PULSE_PERIOD, PULSE_REJECTED };

// Takes a pulse at a time in ticks. PULSE_PERIOD: s->period is new.
enum pulse speed_pulse(struct speed *s, uint32_t time);

// Forgets a period that is too old. Call it at least once in 2^31 ticks.
void speed_age(struct speed *s, uint32_t now);

#endif
