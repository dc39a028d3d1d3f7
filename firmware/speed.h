// SPDX-License-Identifier: Apache-2.0
// The period of the propeller from its IR pulses, without false and missed ones.
#ifndef SPEED_H
#define SPEED_H

#include <stdbool.h>
#include <stdint.h>

#define TICKS_PER_S 2000000UL

// A shorter revolution is noise: 250 rev/s.
#define SHORTEST_PERIOD (TICKS_PER_S / 250)

// After a longer time without a pulse the speed is unknown: 0.5 s.
#define LONGEST_PERIOD (TICKS_PER_S / 2)

// Greatest acceleration of the rotor, rev/s^2: 1 krad/s^2. The stall torque of the motor gives 0.76 krad/s^2.
#define GREATEST_ACCELERATION 160.0f

struct speed {
    uint32_t period;   // of the last valid revolution, ticks; 0: none
    uint32_t last;     // time of the last valid pulse, ticks
    bool started;      // there was a pulse
    uint8_t refused;   // number of rejected pulses in a row
    uint32_t expected; // the period that the next must fit; 0: any
};

enum pulse { PULSE_FIRST, PULSE_PERIOD, PULSE_REJECTED };

// Processes a pulse at a time in ticks. PULSE_PERIOD: s->period is new.
enum pulse speed_pulse(struct speed *s, uint32_t time);

// Removes a period that is too old. Call it at least once in 2^31 ticks.
void speed_age(struct speed *s, uint32_t now);

#endif
