// SPDX-License-Identifier: Apache-2.0
#include "pid.h"

#include <math.h>

bool gains_valid(const struct gains *g) {
    return isfinite(g->kp) && isfinite(g->ki) && isfinite(g->kd) && isfinite(g->filter) && g->filter >= 0.0f &&
           g->low >= 0.0f && g->high <= 1.0f && g->low < g->high;
}

void pid_reset(struct pid *p) {
    p->integral = p->derivative = 0.0f;
    p->started = false;
}

float pid_step(struct pid *p, float measurement, float period) {
    const struct gains *g = &p->gains;
    if (!p->started)
        p->before = measurement;
    p->started = true;
    float rate = (measurement - p->before) / period;
    p->before = measurement;
    float share = g->filter > period ? period / g->filter : 1.0f; // beyond 1, forward Euler is not stable
    p->derivative += share * (rate - p->derivative);

    float error = p->reference - measurement;
    float wanted = g->kp * error + p->integral - g->kd * p->derivative;
    float output = wanted < g->low ? g->low : wanted > g->high ? g->high : wanted;
    float step = period * g->ki * error;
    // a limited output stops the integral, unless the integral leads back into the range
    if (output == wanted || (wanted > output) == (step < 0.0f))
        p->integral += step;
    return output;
}
