// SPDX-License-Identifier: Apache-2.0
#include "speed.h"

// After so many rejected pulses in a row, the earlier pulses were wrong.
#define PATIENCE 3

// Greatest difference of two periods of a steady rotor by the rounding of the edges, ticks.
#define SLACK 8.0f

// Whether the greatest acceleration allows the second period after the first one.
static bool follows(uint32_t before, uint32_t after) {
    const float half = 0.5f * GREATEST_ACCELERATION / ((float)TICKS_PER_S * (float)TICKS_PER_S);
    float p = before, q = after;
    float difference = p > q ? p - q : q - p;
    return difference <= SLACK + half * (p + q) * p * q;
}

enum pulse speed_pulse(struct speed *s, uint32_t time) {
    uint32_t period = time - s->last;
    if (!s->started || period > LONGEST_PERIOD) {
        *s = (struct speed){.last = time, .started = true};
        return PULSE_FIRST;
    }
    if (period < SHORTEST_PERIOD)
        return PULSE_REJECTED;
    if (s->expected != 0 && !follows(s->expected, period)) {
        if (++s->refused >= PATIENCE) {
            *s = (struct speed){.period = s->period, .last = time, .started = true};
        } else if (period > s->expected) { // a pulse was missed: the time is valid, the period is not
            s->last = time;
        }
        return PULSE_REJECTED;
    }
    s->period = s->expected = period;
    s->last = time;
    s->refused = 0;
    return PULSE_PERIOD;
}

void speed_age(struct speed *s, uint32_t now) {
    if (s->started && (int32_t)(now - s->last) > (int32_t)LONGEST_PERIOD)
        *s = (struct speed){0};
}
