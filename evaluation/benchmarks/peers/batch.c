/* SPDX-License-Identifier: Apache-2.0 */
/* Many models, one recording, sums of squared errors only: what aeropend_sim.model.dynamics.squared_errors does.
   16 models advance side by side in SIMD lanes, blocks of them on 2 threads. */
static inline double sine(double x);
#define SIN sine
#include "plant.h"

#define LANES 16

/* Odd polynomial on [-pi/2, pi/2], to 1e-11: the compiler makes lanes of it, which it does not of a call. */
static inline double sine(double x) {
    double k = nearbyint(x * (1.0 / M_PI));
    double r = x - k * M_PI, z = r * r;
    double s = r * (1.0 + z * (-1.0 / 6 + z * (1.0 / 120 + z * (-1.0 / 5040 + z * (1.0 / 362880
             + z * (-1.0 / 39916800 + z * (1.0 / 6227020800)))))));
    double odd = k - 2.0 * nearbyint(0.5 * k);
    return (1.0 - 2.0 * odd * odd) * s;
}

/* p: one a model, a multiple of 16; measured: theta, omega, i_a, v_a, rows of n; errors: 4 a model */
void batch(const struct plant *p, long models, const double *duty, const double *measured, long n, double h,
           double *errors) {
#pragma omp parallel for num_threads(2) schedule(dynamic)
    for (long block = 0; block < models / LANES; block++) {
        struct rates r[LANES];
        double i_a[LANES] = {0}, omega[LANES] = {0}, theta[LANES] = {0}, theta_dot[LANES] = {0}, v[LANES] = {0};
        double sums[4][LANES] = {{0}};
        double R_L[LANES], K_L[LANES], per_L[LANES], K_J[LANES], B_J[LANES], load_J[LANES], gravity[LANES],
            damping[LANES], lever[LANES];
        for (int j = 0; j < LANES; j++) {
            r[j] = rates_of(&p[block * LANES + j]);
            R_L[j] = r[j].R_L, K_L[j] = r[j].K_L, per_L[j] = r[j].per_L, K_J[j] = r[j].K_J, B_J[j] = r[j].B_J;
            load_J[j] = r[j].load_J, gravity[j] = r[j].gravity, damping[j] = r[j].damping;
            lever[j] = r[j].lever * r[j].k_thrust;
        }
        for (long k = 0; k < n; k++) {
            if (k == 0 || duty[k] != duty[k - 1])
                for (int j = 0; j < LANES; j++)
                    v[j] = voltage(&p[block * LANES + j], duty[k]);
            double m0 = measured[k], m1 = measured[n + k], m2 = measured[2 * n + k], m3 = measured[3 * n + k];
#pragma omp simd
            for (int j = 0; j < LANES; j++) {
                struct rates lane = {R_L[j], K_L[j], per_L[j], K_J[j], B_J[j], load_J[j], 1.0, gravity[j], damping[j],
                                     lever[j]};
                struct state x = {i_a[j], omega[j], 0.0, theta[j], theta_dot[j]};
                sums[0][j] += (x.theta - m0) * (x.theta - m0);
                sums[1][j] += (x.omega - m1) * (x.omega - m1);
                sums[2][j] += (x.i_a - m2) * (x.i_a - m2);
                sums[3][j] += (v[j] - m3) * (v[j] - m3);
                x = step(lane, v[j], h, x);
                i_a[j] = x.i_a, omega[j] = x.omega, theta[j] = x.theta, theta_dot[j] = x.theta_dot;
            }
        }
        for (int j = 0; j < LANES; j++)
            for (int e = 0; e < 4; e++)
                errors[(block * LANES + j) * 4 + e] = sums[e][j];
    }
}
