// SPDX-License-Identifier: Apache-2.0
// The PID controller of the thesis' section 6.4: derivative of the measurement, limits, anti-windup, forward Euler.
#ifndef PID_H
#define PID_H

#include <stdbool.h>

struct gains {
    float kp, ki, kd; // output per rad, per rad s, per rad/s
    float filter;     // time constant of the derivative's filter, s
    float low, high;  // limits of the output, duty 0..1
};

struct pid {
    struct gains gains;
    float reference; // rad
    float integral, derivative, before;
    bool started;
};

// Whether the gains are valid.
bool gains_valid(const struct gains *g);

// Resets the state; gains and reference stay.
void pid_reset(struct pid *p);

// Returns the duty for a measurement (rad), `period` s after the one before.
float pid_step(struct pid *p, float measurement, float period);

#endif
