/* SPDX-License-Identifier: Apache-2.0 */
/* The nominal equations of the plant, as aeropend_sim.model.dynamics states them, and one classical Runge-Kutta step. */
#include <math.h>

struct plant {
    double k0, k1, k2, k3, R_a, L_a, K_e, K_t, J_m, B_m, k_load, k_thrust, mgd_over_J, c_over_J, L_over_J;
};

/* What a step needs: divisions done once. */
struct rates {
    double R_L, K_L, per_L, K_J, B_J, load_J, k_thrust, gravity, damping, lever;
};

struct state {
    double i_a, omega, angle, theta, theta_dot;
};

static inline double voltage(const struct plant *p, double duty) {
    double v = p->k0 + p->k1 * sqrt(p->k2 * duty + p->k3);
    return v > 0.0 ? v : 0.0;
}

static inline struct rates rates_of(const struct plant *p) {
    return (struct rates){p->R_a / p->L_a, p->K_e / p->L_a, 1.0 / p->L_a, p->K_t / p->J_m, p->B_m / p->J_m,
                          p->k_load / p->J_m, p->k_thrust, p->mgd_over_J, p->c_over_J, p->L_over_J};
}

static inline struct state derivative(struct rates r, double v, struct state x) {
    double square = x.omega * fabs(x.omega);
    return (struct state){r.per_L * v - r.R_L * x.i_a - r.K_L * x.omega,
                          r.K_J * x.i_a - r.B_J * x.omega - r.load_J * square,
                          x.omega,
                          x.theta_dot,
                          r.lever * r.k_thrust * square - r.damping * x.theta_dot - r.gravity * SIN(x.theta)};
}

static inline struct state along(struct state x, double h, struct state d) {
    return (struct state){x.i_a + h * d.i_a, x.omega + h * d.omega, x.angle + h * d.angle, x.theta + h * d.theta,
                          x.theta_dot + h * d.theta_dot};
}

static inline struct state step(struct rates r, double v, double h, struct state x) {
    struct state a = derivative(r, v, x);
    struct state b = derivative(r, v, along(x, 0.5 * h, a));
    struct state c = derivative(r, v, along(x, 0.5 * h, b));
    struct state d = derivative(r, v, along(x, h, c));
    double s = h / 6.0;
    return (struct state){x.i_a + s * (a.i_a + 2.0 * (b.i_a + c.i_a) + d.i_a),
                          x.omega + s * (a.omega + 2.0 * (b.omega + c.omega) + d.omega),
                          x.angle + s * (a.angle + 2.0 * (b.angle + c.angle) + d.angle),
                          x.theta + s * (a.theta + 2.0 * (b.theta + c.theta) + d.theta),
                          x.theta_dot + s * (a.theta_dot + 2.0 * (b.theta_dot + c.theta_dot) + d.theta_dot)};
}
