# SPDX-License-Identifier: Apache-2.0
"""First-order responses of the arm and of the motor, around a motion, to many forcings at once."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.compiled import njit
from aeropend_sim.model.arm import linear_arm

Array = NDArray[np.float64]


@njit(nogil=True)
def arm_response(drive: Array, stiffness: Array, damping: float, tau: float, h: float) -> Array:
    """First-order response of the angle read to torques on the arm.

    Args:
        drive: [rad/s²] (K, N) torques over inertia.
        stiffness: [1/s²] (N,) of the arm at its angle.
        damping: [1/s] of the arm.
        tau: [s] time constant of each of the two stages of the angle's filter.
        h: [s] sample period.

    Returns:
        [rad] (K, N).
    """
    out = np.empty_like(drive)
    keep = math.exp(-h / tau) if tau > 0.0 else 0.0
    step = np.empty((drive.shape[1], 6))
    for k in range(drive.shape[1]):
        step[k] = linear_arm(stiffness[k], damping, h)
    for j in range(drive.shape[0]):
        x = v = s1 = s2 = 0.0
        for k in range(drive.shape[1]):
            out[j, k] = s2
            a, b, c, d, e, f = step[k]
            u = drive[j, k]
            x, v = a * x + b * v + c * u, d * x + e * v + f * u
            s1 = keep * s1 + (1.0 - keep) * x
            s2 = keep * s2 + (1.0 - keep) * s1
    return out


@njit(nogil=True)
def motor_response(voltage: Array, torque: Array, omega: Array, R_a: float, L_a: float, K_e: float, K_t: float,
                   J_m: float, B_m: float, k_load: float, h: float) -> tuple[Array, Array, Array]:
    """First-order response of the motor to voltages in the winding and torques on the rotor.

    Args:
        voltage: [V] (K, N).
        torque: [N·m] (K, N).
        omega: [rad/s] (N,) speed around which the motor is linear.
        R_a: [Ω] winding resistance.
        L_a: [H] winding inductance.
        K_e: [V·s/rad] back-EMF constant.
        K_t: [N·m/A] torque constant.
        J_m: [kg·m²] rotor inertia.
        B_m: [N·m·s/rad] viscous friction.
        k_load: [N·m·s²/rad²] aerodynamic load.
        h: [s] sample period.

    Returns:
        [A] current, [rad/s] speed and [rad] rotor angle, (K, N) each.
    """
    i_out, w_out, angle_out = np.empty_like(voltage), np.empty_like(voltage), np.empty_like(voltage)
    decay = math.exp(-h * R_a / L_a)
    hold = (1.0 - decay) * L_a / (R_a * h)  # of the current at the beginning of a sample, in its mean
    per_volt, mean_per_volt = (1.0 - decay) / R_a, (1.0 - hold) / R_a
    per_inertia = h / J_m
    pull = per_inertia * K_t
    kept = 1.0 - pull * mean_per_volt * K_e
    slowed = 1.0 / (1.0 + per_inertia * (B_m + 2.0 * k_load * np.abs(omega)))
    for j in range(voltage.shape[0]):
        i = w = angle = 0.0
        for k in range(voltage.shape[1]):
            i_out[j, k], w_out[j, k], angle_out[j, k] = i, w, angle
            drive = pull * mean_per_volt * voltage[j, k] + per_inertia * torque[j, k]
            after = (kept * w + (pull * hold * i + drive)) * slowed[k]
            i = decay * i + per_volt * (voltage[j, k] - K_e * w)
            angle += 0.5 * h * (w + after)
            w = after
    return i_out, w_out, angle_out
