/* SPDX-License-Identifier: Apache-2.0 */
/* One model, one duty series, every state at every sample: what aeropend_sim.model.dynamics.simulate does. */
#define SIN sin
#include "plant.h"

/* duty: n, held for h seconds; inner: Runge-Kutta steps a hold; out: 7 rows of n in the order of dynamics.Trajectory */
void series(const struct plant *p, const double *duty, long n, double h, long inner, double *out) {
    struct rates r = rates_of(p);
    struct state x = {0};
    for (long k = 0; k < n; k++) {
        double v = voltage(p, duty[k]);
        out[k] = x.theta;
        out[n + k] = x.theta_dot;
        out[2 * n + k] = x.i_a;
        out[3 * n + k] = x.omega;
        out[4 * n + k] = v;
        out[5 * n + k] = x.angle;
        out[6 * n + k] = p->k_thrust * x.omega * fabs(x.omega);
        for (long j = 0; j < inner; j++)
            x = step(r, v, h / inner, x);
    }
}
