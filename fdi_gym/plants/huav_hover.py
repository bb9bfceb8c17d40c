"""Helicopter UAV in hover, with actuator faults under wind gusts.

A small single-rotor helicopter with a Bell-Hiller stabiliser bar, held in hover by a discrete LQI controller. SI units,
angles in radians; x forward, y right, z down.

    xdot = f(x, u_true) + E_c d,   u_true = gain u_c + offset,   y = x[0:9] + v

| vector | entries |
|---|---|
| state x | body velocities u, v, w [m/s]; rates p, q, r [rad/s]; attitude phi, theta, psi [rad]; stabiliser flapping |
| | a1f (positive aft), b1f (positive right) [rad] |
| command u_c | collective col, longitudinal lon and lateral lat cyclic, pedal ped [rad]; clipped |
| fault theta | gain of each actuator (nominal 1) and offset of each [rad] (nominal 0) |
| estimated b | the actuator error u_true - u_c of each actuator [rad], whatever its cause |
| disturbance d | horizontal gust velocity u_g, v_g in body axes [m/s], not measured |

Faults, each on any actuator: bias (offset), loss of effectiveness (gain), stuck at a position or floating (gain 0, the
position in the offset: a constant, a square wave or a random drift), stuck in place (gain 0, offset held at the command
of the step before the onset). Up to two actuators fail at once: 11 labels.

Model: rotor thrust in hover solves T + D sqrt(T) = C angle (blade element with momentum inflow), torque is
C_Q T^1.5 + D_Q; the tip-path plane follows swash plate and stabiliser bar (A1 = K_B lon + K_F a1f, B1 likewise) and
acts through the thrust's tilt and the hub spring. No aerodynamic damping, no Coriolis terms: open loop has seven zero
eigenvalues, so a controller is indispensable. Servos without lag.

Gusts: each component builds up as 1 - cos, holds, and dies down. `kappa` is the share of the tail rotor's weathercock
coupling that is kept: 0 a force-only gust (the source's setting), 1 the physical one, where a side gust looks like a
pedal fault; the level of difficulty.

A diagnosis can act: small sines of the cyclic, the pedal or the collective as probes (in the process "quiet" nothing else
moves an actuator); the mixing subtracts the actuator errors that are estimated.

The flight ends early beyond 60 deg of roll or pitch, 20 m/s or 8 rad/s in any axis: a stuck or floating cyclic can
bring that about. Mismatch multiplies mass and inertias by 1 + level * U(-1, 1).

Processes: "standard" (0, 1 or 2 faults, random gusts; flight `episode(seed)` of the benchmark's own numbering), "hard"
(the same with the full coupling kappa = 1 in the truth; build the plant with kappa=1 where the diagnosers shall know
it), "fault-free", and "scenario-1" to "scenario-4" of the source ("paper" is "scenario-1"; "scenario-4" is the same
flight with all filters side by side).

Noise is prescribed: from default_rng(noise seed) first w (steps, 11), then v (steps + 1, 9).

Source: Z. Nejati et al., International Journal of Engineering, Transactions B 34(5), 2021, pp. 1290-1296,
doi 10.5829/ije.2021.34.05b.23 (structure, fault scenarios). Masses and rotor data: V. Gavrilets, Handbook of Unmanned
Aerial Vehicles, Springer 2015, pp. 279-306, doi 10.1007/978-90-481-9707-1_54 (X-Cell .60). Reconstructed where the
source is silent or misprinted: signs of thrust and tail rotor, the square root in the thrust, psi', controller, noise,
sample time, gust numbers; the randomised process is this benchmark's.

Version history: v0, the first.
"""

from __future__ import annotations

import bisect
import functools
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np
import scipy.linalg
from msgspec import UNSET, Meta, UnsetType

from fdi_gym.acting import Acting, Probe
from fdi_gym.checks import number
from fdi_gym.drawing import random_sign, uniform
from fdi_gym.faults import Abrupt, Fault, FaultProcess, FaultScenario, Hold, Samples, Scoring, Square
from fdi_gym.integration import first_order
from fdi_gym.kernels import kernel
from fdi_gym.plant import FaultMode, Kernels, Label, Plant, Signal
from fdi_gym.shapes import Nothing, Shapes
from fdi_gym.trigonometry import sincos

ID = "HUAVHover"
VERSION = 0

DT = 0.02  # s
STEPS = 1000  # 20 s
CHANNELS = ("col", "lon", "lat", "ped")
STATES = ("u", "v", "w", "p", "q", "r", "phi", "theta", "psi", "a1f", "b1f")
U_MIN = (-0.02, -0.12, -0.12, -0.20)  # rad: command limits
U_MAX = (0.20, 0.12, 0.12, 0.25)
SIGMA_V = (0.05, 0.05, 0.05, 0.005, 0.005, 0.005, 0.009, 0.009, 0.009)  # m/s, rad/s, rad: sensors
# Beyond anything that a flight can reach before it ends; psi is not wrapped
SENSOR_RANGE = (100.0, 100.0, 100.0, 50.0, 50.0, 50.0, np.pi, np.pi, 1000.0)  # m/s, rad/s, rad
SIGMA_W = (*(0.004,) * 3, *(0.005,) * 3, *(2e-4,) * 5)  # m/s, rad/s, rad, rad (flapping) per step: process
B_MAX = (0.25, 0.15, 0.15, 0.50)  # rad: a stuck actuator lets |b| grow to the command limit
B_SCALE = (0.005, 0.002, 0.002, 0.008)  # rad: error that costs 1 in the identification task

G = 9.81  # m/s^2
RHO = 1.225  # kg/m^3, sea level
MASS, JXX, JYY, JZZ = 8.2, 0.18, 0.34, 0.28  # kg, kg m^2, X-Cell .60
H_MR, D_TR, H_TR = 0.235, 0.91, 0.08  # m: hub above, tail rotor behind and above the centre of mass
R_MR, OM_MR = 0.775, 167.0  # m, rad/s: main rotor
R_TR, OM_TR = 0.13, 4.66 * OM_MR  # tail rotor, geared to the main one
C_MR, A_MR, CD0_MR = 0.058, 5.5, 0.024  # chord [m], lift slope [1/rad], profile drag
C_TR, A_TR, CD0_TR = 0.029, 5.0, 0.024
BLADES = 2
K_BETA = 54.0  # N m/rad: hub spring
S_X, S_Y = 0.1, 0.22  # m^2: drag areas of the fuselage
TAU_F = 16 / (0.8 * OM_MR)  # s: stabiliser bar, Lock number 0.8
PER_TAU_F = 1 / TAU_F
K_F = 1.0  # stabiliser flapping to tip-path plane
A_CYC = 4.2  # static swash plate to tip-path plane, K_B + K_H K_F
OFFSET_PED = 0.206  # rad: blade angle at zero pedal, so that the trim pedal is about -0.01


def rotor_constants(om: float, r: float, c: float, a: float, cd0: float) -> tuple[float, float, float, float]:
    """C_T [N/rad], D_T [N^0.5], C_Q [m N^-0.5] and D_Q [N m] of a rotor with speed, radius, chord, lift slope, drag."""
    area, solidity = np.pi * r**2, BLADES * c / (np.pi * r)
    force = RHO * area * (om * r) ** 2
    return (
        float(force * a * solidity / 6),
        float(a * solidity / 4 * np.sqrt(force / 2)),
        float(1 / (om * np.sqrt(2 * RHO * area))),
        float(force * r * solidity * cd0 / 8),
    )


CT_M, DT_M, CQ_M, DQ_M = rotor_constants(OM_MR, R_MR, C_MR, A_MR, CD0_MR)
CT_T, DT_T, CQ_T, DQ_T = rotor_constants(OM_TR, R_TR, C_TR, A_TR, CD0_TR)

# Discrete LQI: weights on the states and the integrals of u, v, w, psi; on the commands
LQI_Q = np.diag([1, 1, 2, 0.05, 0.05, 0.05, 4, 4, 8, 0, 0, 0.3, 0.3, 0.5, 2.0])
LQI_R = np.diag([2000.0, 4000, 4000, 400])
INTEGRATED = (0, 1, 2, 8)  # u, v, w, psi
ERROR_CLIP = (1.0, 1.0, 1.0, 0.5)  # m/s, m/s, m/s, rad: bounds the command while an actuator fights the loop
INTEGRAL_CLIP = 1.0  # m, rad s: with 5 the recovery of a floating cyclic overturns the helicopter


@kernel
def thrust(slope, inflow, angle):
    """T of T + inflow sqrt(T) = slope angle; zero below zero blade angle."""
    lift = slope * max(angle, 0.0)
    T = lift + 0.5 * inflow * inflow - inflow * np.sqrt(lift + 0.25 * inflow * inflow)
    return max(T, 0.0)  # rounding can leave less


@kernel
def thrust_slope(slope, inflow, root):
    """dT/d angle where sqrt(T) = root; zero below zero blade angle, as T is."""
    return slope * root / (root + 0.5 * inflow)


@kernel
def act(J_theta, i, j, u, slope):
    """d dx[i] / d angle of actuator j = slope: enter it for gain and offset."""
    J_theta[i, j], J_theta[i, 4 + j] = u[j] * slope, slope


@kernel
def dynamics(t, x, u, theta, d, p, dx):
    """Rigid body, rotors, stabiliser bar and gust."""
    roll_rate, pitch_rate, yaw_rate = x[3], x[4], x[5]
    phi, pitch = x[6], x[7]
    a1f, b1f = x[9], x[10]
    col, lon = theta[0] * u[0] + theta[4], theta[1] * u[1] + theta[5]
    lat, ped = theta[2] * u[2] + theta[6], theta[3] * u[3] + theta[7]
    per_m, per_jxx, per_jyy, per_jzz, k_b, k_h = p[0], p[1], p[2], p[3], p[4], p[5]

    tm = thrust(CT_M, DT_M, col)
    qm = CQ_M * tm * np.sqrt(tm) + DQ_M
    tt = thrust(CT_T, DT_T, ped + OFFSET_PED)
    qt = CQ_T * tt * np.sqrt(tt) + DQ_T
    a1, b1 = k_b * lon + K_F * a1f, k_b * lat + K_F * b1f
    hub = tm * H_MR + K_BETA
    (sin_phi, cos_phi), (sin_pitch, cos_pitch) = sincos(phi), sincos(pitch)
    psi_rate = (pitch_rate * sin_phi + yaw_rate * cos_phi) / cos_pitch

    dx[0] = -G * sin_pitch - tm * a1 * per_m + p[6] * d[0]
    dx[1] = G * sin_phi * cos_pitch + (tm * b1 - tt) * per_m + p[7] * d[1]
    dx[2] = G * cos_phi * cos_pitch - tm * per_m
    dx[3] = (hub * b1 - H_TR * tt) * per_jxx + p[8] * d[1]
    dx[4] = (hub * a1 - qt) * per_jyy
    dx[5] = (D_TR * tt - qm) * per_jzz + p[9] * d[1]
    dx[6] = roll_rate + sin_pitch * psi_rate
    dx[7] = pitch_rate * cos_phi - yaw_rate * sin_phi
    dx[8] = psi_rate
    dx[9] = -pitch_rate + (k_h * lon - a1f) * PER_TAU_F
    dx[10] = -roll_rate + (k_h * lat - b1f) * PER_TAU_F


@kernel
def jacobian(t, x, u, theta, d, p, J_x, J_theta, J_d, J_p):
    """The derivatives of `dynamics`; dtm is d tm / d col, and so on."""
    pitch_rate, yaw_rate, phi, pitch = x[4], x[5], x[6], x[7]
    col, lon = theta[0] * u[0] + theta[4], theta[1] * u[1] + theta[5]
    lat, ped = theta[2] * u[2] + theta[6], theta[3] * u[3] + theta[7]
    per_m, per_jxx, per_jyy, per_jzz, k_b, k_h = p[0], p[1], p[2], p[3], p[4], p[5]

    tm, tt = thrust(CT_M, DT_M, col), thrust(CT_T, DT_T, ped + OFFSET_PED)
    root_m, root_t = np.sqrt(tm), np.sqrt(tt)
    dtm, dtt = thrust_slope(CT_M, DT_M, root_m), thrust_slope(CT_T, DT_T, root_t)
    a1, b1 = k_b * lon + K_F * x[9], k_b * lat + K_F * x[10]
    hub = tm * H_MR + K_BETA
    force, roll, tilt = tm * per_m, hub * per_jxx, hub * per_jyy  # per radian of a1 or b1
    (sin_phi, cos_phi), (sin_pitch, cos_pitch) = sincos(phi), sincos(pitch)
    sec, tan = 1.0 / cos_pitch, sin_pitch / cos_pitch
    nod = pitch_rate * cos_phi - yaw_rate * sin_phi  # dx[7]
    turn = pitch_rate * sin_phi + yaw_rate * cos_phi  # cos_pitch dx[8]

    J_x[0, 7], J_x[0, 9] = -G * cos_pitch, -force * K_F
    J_x[1, 6], J_x[1, 7], J_x[1, 10] = G * cos_phi * cos_pitch, -G * sin_phi * sin_pitch, force * K_F
    J_x[2, 6], J_x[2, 7] = -G * sin_phi * cos_pitch, -G * cos_phi * sin_pitch
    J_x[3, 10], J_x[4, 9] = roll * K_F, tilt * K_F
    J_x[6, 3], J_x[6, 4], J_x[6, 5] = 1.0, tan * sin_phi, tan * cos_phi
    J_x[6, 6], J_x[6, 7] = tan * nod, turn * sec * sec
    J_x[7, 4], J_x[7, 5], J_x[7, 6] = cos_phi, -sin_phi, -turn
    J_x[8, 4], J_x[8, 5], J_x[8, 6], J_x[8, 7] = sec * sin_phi, sec * cos_phi, sec * nod, turn * sec * tan
    J_x[9, 4], J_x[9, 9] = -1.0, -PER_TAU_F
    J_x[10, 3], J_x[10, 10] = -1.0, -PER_TAU_F

    act(J_theta, 0, 0, u, -dtm * a1 * per_m)
    act(J_theta, 1, 0, u, dtm * b1 * per_m)
    act(J_theta, 2, 0, u, -dtm * per_m)
    act(J_theta, 3, 0, u, dtm * H_MR * b1 * per_jxx)
    act(J_theta, 4, 0, u, dtm * H_MR * a1 * per_jyy)
    act(J_theta, 5, 0, u, -1.5 * CQ_M * root_m * dtm * per_jzz)
    act(J_theta, 0, 1, u, -force * k_b)
    act(J_theta, 4, 1, u, tilt * k_b)
    act(J_theta, 9, 1, u, k_h * PER_TAU_F)
    act(J_theta, 1, 2, u, force * k_b)
    act(J_theta, 3, 2, u, roll * k_b)
    act(J_theta, 10, 2, u, k_h * PER_TAU_F)
    act(J_theta, 1, 3, u, -dtt * per_m)
    act(J_theta, 3, 3, u, -H_TR * dtt * per_jxx)
    act(J_theta, 4, 3, u, -1.5 * CQ_T * root_t * dtt * per_jyy)
    act(J_theta, 5, 3, u, D_TR * dtt * per_jzz)

    J_d[0, 0], J_d[1, 1], J_d[3, 1], J_d[5, 1] = p[6], p[7], p[8], p[9]

    J_p[0, 0], J_p[1, 0], J_p[2, 0] = -tm * a1, tm * b1 - tt, -tm
    J_p[3, 1], J_p[4, 2] = hub * b1 - H_TR * tt, hub * a1 - CQ_T * tt * root_t - DQ_T
    J_p[5, 3] = D_TR * tt - CQ_M * tm * root_m - DQ_M
    J_p[0, 4], J_p[1, 4], J_p[3, 4], J_p[4, 4] = -force * lon, force * lat, roll * lat, tilt * lon
    J_p[9, 5], J_p[10, 5] = lon * PER_TAU_F, lat * PER_TAU_F
    J_p[0, 6], J_p[1, 7], J_p[3, 8], J_p[5, 9] = d[0], d[1], d[1], d[1]


@kernel
def output(t, x, u, theta, d, p, y):
    """All states but the flapping are measured."""
    for i in range(9):
        y[i] = x[i]


@kernel
def control(t, y, r, q, c, u):
    """LQI with clipped errors and an observer of the stabiliser bar. c = integrals (4), observed flapping (2).

    q = the gain K (4, 15) row by row, trim command (4), trim of the outputs (9), trim flapping (2), K_H, decay of the
    observer over a sample, actuator errors that are allowed for (4).
    """
    k_h, decay = q[75], q[76]
    u_0, u_1, u_2, u_3 = q[60], q[61], q[62], q[63]
    for j in range(15):
        if j < 9:
            e = y[j] - q[64 + j]
            if j < 3:
                e = min(max(e, -ERROR_CLIP[j]), ERROR_CLIP[j])
            elif j == 8:
                e = min(max(e, -ERROR_CLIP[3]), ERROR_CLIP[3])
        elif j < 11:
            e = c[j - 5] - q[64 + j]
        else:
            e = c[j - 11]
        u_0, u_1, u_2, u_3 = u_0 - q[j] * e, u_1 - q[15 + j] * e, u_2 - q[30 + j] * e, u_3 - q[45 + j] * e
    u[0], u[1], u[2], u[3] = u_0 - q[77], u_1 - q[78], u_2 - q[79], u_3 - q[80]
    for i in range(4):
        u[i] = min(max(u[i], U_MIN[i]), U_MAX[i])
    for j in range(4):
        c[j] = min(max(c[j] + DT * y[INTEGRATED[j]], -INTEGRAL_CLIP), INTEGRAL_CLIP)
    c[4] = decay * c[4] + (1.0 - decay) * TAU_F * (-y[4] + k_h / TAU_F * (u[1] + q[78]))
    c[5] = decay * c[5] + (1.0 - decay) * TAU_F * (-y[3] + k_h / TAU_F * (u[2] + q[79]))


@kernel
def outside(t, x, r):
    """Control is lost beyond 60 deg of roll or pitch, 20 m/s, 8 rad/s."""
    lost = abs(x[6]) > np.pi / 3 or abs(x[7]) > np.pi / 3
    for i in range(3):
        lost = lost or abs(x[i]) > 20.0 or abs(x[3 + i]) > 8.0
    return lost


def _rate(x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
    """f(x, u), healthy and without gust."""
    dx = np.empty(11)
    dynamics(0.0, x, u, np.array([1.0] * 4 + [0.0] * 4), np.zeros(2), p, dx)
    return dx


def _physical(K_B: float, m: float = MASS, Jxx: float = JXX, Jyy: float = JYY, Jzz: float = JZZ) -> np.ndarray:
    """p = 1/m, 1/Jxx, 1/Jyy, 1/Jzz, K_B, K_H and four zeros in place of the gust's entries."""
    return np.array([1 / m, 1 / Jxx, 1 / Jyy, 1 / Jzz, K_B, (A_CYC - K_B) / K_F, 0.0, 0.0, 0.0, 0.0])


def trim(K_B: float = 0.84) -> tuple[np.ndarray, np.ndarray]:
    """Hover: state (11,) and command (4,), by Newton's method on the eight rates that are not kinematic."""
    p = _physical(K_B)
    free = [6, 7, 9, 10]  # phi, theta, a1f, b1f; then the four commands
    rates = [0, 1, 2, 3, 4, 5, 9, 10]

    def unpack(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = np.zeros(11)
        x[free] = z[:4]
        return x, z[4:].copy()

    z = np.array([0.08, 0, 0, 0, 0.096, 0, 0, -0.01])
    for _ in range(8):
        J = np.column_stack([
            (_rate(*unpack(z + s), p) - _rate(*unpack(z - s), p))[rates] / 2e-6 for s in 1e-6 * np.eye(8)
        ])  # fmt: skip
        z = z - np.linalg.solve(J, _rate(*unpack(z), p)[rates])
    return unpack(z)


def linearised(x: np.ndarray, u: np.ndarray, K_B: float = 0.84) -> tuple[np.ndarray, np.ndarray]:
    """Ad (11, 11) and Bd (11, 4): the Jacobians of one Runge-Kutta step at the equilibrium (x, u).

    There every stage is the equilibrium itself, so the step's Jacobian is the Taylor polynomial of fourth order in the
    continuous ones.
    """
    p = _physical(K_B)
    A = np.column_stack([(_rate(x + s, u, p) - _rate(x - s, u, p)) / 2e-5 for s in 1e-5 * np.eye(11)])
    B = np.column_stack([(_rate(x, u + s, p) - _rate(x, u - s, p)) / 2e-5 for s in 1e-5 * np.eye(4)])
    hA = DT * A
    series = np.eye(11) + hA / 2 @ (np.eye(11) + hA / 3 @ (np.eye(11) + hA / 4))
    return np.eye(11) + hA @ series, DT * series @ B


def lqi_gain(Ad: np.ndarray, Bd: np.ndarray) -> np.ndarray:
    """K (4, 15) of the discrete LQ regulator for the states and the integrals of u, v, w, psi."""
    A, B = np.eye(15), np.zeros((15, 4))
    A[:11, :11], B[:11] = Ad, Bd
    A[range(11, 15), INTEGRATED] = DT
    S = scipy.linalg.solve_discrete_are(A, B, LQI_Q, LQI_R)
    return np.linalg.solve(LQI_R + B.T @ S @ B, B.T @ S @ A)


def gust_matrix(u: np.ndarray, kappa: float) -> np.ndarray:
    """The entries (u, 0), (v, 1), (p, 1), (r, 1) of E_c (11, 2), from the rotors' thrust at the trim command u."""
    lift = CT_M * u[0], CT_T * (u[3] + OFFSET_PED)
    tm, tt = (v + d**2 / 2 - d * np.sqrt(v + d**2 / 4) for v, d in zip(lift, (DT_M, DT_T), strict=True))
    inflow = np.sqrt(tm / (2 * RHO * np.pi * R_MR**2))  # m/s, main rotor
    solidity = BLADES * C_TR / (np.pi * R_TR)
    side = RHO * A_TR * solidity * OM_TR * R_TR * np.pi * R_TR**2 / 4 / (1 + DT_T / (2 * np.sqrt(tt)))  # N per m/s
    return np.array([
        0.5 * RHO * S_X * inflow / MASS, 0.5 * RHO * S_Y * inflow / MASS + kappa * side / MASS,
        kappa * H_TR * side / JXX, -kappa * D_TR * side / JZZ,
    ])  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------
# Scenarios

X_TRIM, U_TRIM = trim()
MRAD = 1e-3

# Ranges of the randomised process, per channel
BIAS = ((1e-3, 12e-3), (0.4e-3, 6e-3), (0.3e-3, 6e-3), (2e-3, 15e-3))  # rad, log-uniform
STUCK = (6e-3, 3e-3, 3e-3, 8e-3)  # rad, about trim
SQUARE = ((2e-3, 12e-3), (1e-3, 6e-3), (1e-3, 6e-3), (3e-3, 12e-3))  # rad
DRIFT = ((2e-3, 10e-3), (1e-3, 5e-3), (1e-3, 5e-3), (3e-3, 10e-3))  # rad, standard deviation
GUSTS = ((1, 14), (1, 3), (0, 5), (-4, 4))  # s: start, rise, hold; m/s: speed
UP_TO_COUNT, UP_TO_KIND = (0.15, 0.15 + 0.65), (0.4, 0.4 + 0.2, 0.4 + 0.2 + 0.2)  # shares of flights, of faults, added up
LOG_BIAS = tuple(np.log(bounds).tolist() for bounds in BIAS)
DRIFT_DECAY = float(np.exp(-DT / 0.5))  # over a sample; and the share of the standard deviation that is new
DRIFT_NEW = float(np.sqrt(1 - np.exp(-DT / 0.5) ** 2))
LOSS = ((0.85, 0.98), (0.2, 0.7), (0.2, 0.7), (0.2, 0.7))  # gain that is left


def bias(channel: str, value: float, onset: int, end: int | None = None) -> Fault:
    """u_true = u_c + value [rad]."""
    return Fault(channel, "bias", onset, [Abrupt(f"offset_{channel}", float(value))], end)


def oscillating_bias(channel: str, value: float, period: float, onset: int, end: int | None = None) -> Fault:
    """u_true = u_c + value in the even half periods [s] since the onset, u_c - value in the odd ones."""
    wave = Square(f"offset_{channel}", float(value), -float(value), float(period))
    return Fault(channel, "bias_square", onset, [wave], end)


def stuck(channel: str, position: float | None, onset: int, end: int | None = None) -> Fault:
    """u_true = position [rad]; None freezes the actuator where it was in the step before the onset."""
    name = f"offset_{channel}"
    place = Hold(name, channel, 1) if position is None else Abrupt(name, float(position))
    kind = "stuck_hold" if position is None else "stuck_at"
    return Fault(channel, kind, onset, [Abrupt(f"gain_{channel}", 0.0), place], end)


def floating_square(channel: str, value: float, other: float, period: float, onset: int, end: int | None = None) -> Fault:
    """u_true = value in the even half periods [s] since the onset, other in the odd ones, whatever is commanded."""
    wave = Square(f"offset_{channel}", float(value), float(other), float(period))
    return Fault(channel, "float_square", onset, [Abrupt(f"gain_{channel}", 0.0), wave], end)


def floating(channel: str, positions: list[float], onset: int, end: int | None = None) -> Fault:
    """u_true = positions[k - onset] [rad], whatever is commanded."""
    drift = Samples(f"offset_{channel}", [float(v) for v in positions])
    return Fault(channel, "float_free", onset, [Abrupt(f"gain_{channel}", 0.0), drift], end)


def loss(channel: str, gain: float, onset: int, end: int | None = None) -> Fault:
    """Loss of effectiveness: u_true = gain u_c."""
    return Fault(channel, "loe", onset, [Abrupt(f"gain_{channel}", float(gain))], end)


Time = Annotated[float, Meta(ge=0.0, le=1e6)]  # s


class OneGust(msgspec.Struct, forbid_unknown_fields=True):
    """One gust, as `gust` makes it."""

    t0: Time
    rise: Annotated[float, Meta(ge=1e-3, le=1e6)]  # s
    speed: Annotated[float, Meta(ge=-50.0, le=50.0)]  # m/s
    hold: Time | None


class Gusts(msgspec.Struct, forbid_unknown_fields=True):
    """The gust of each component, where there is one."""

    u_g: OneGust | UnsetType = UNSET
    v_g: OneGust | UnsetType = UNSET


class Physical(msgspec.Struct, forbid_unknown_fields=True):
    """Mass [kg], inertias [kg m^2] and the share of the tail rotor's weathercock coupling in the truth."""

    m: Annotated[float, Meta(ge=0.1, le=1e3)] | UnsetType = UNSET
    Jxx: Annotated[float, Meta(ge=1e-3, le=1e3)] | UnsetType = UNSET
    Jyy: Annotated[float, Meta(ge=1e-3, le=1e3)] | UnsetType = UNSET
    Jzz: Annotated[float, Meta(ge=1e-3, le=1e3)] | UnsetType = UNSET
    kappa: Annotated[float, Meta(ge=0.0, le=1.0)] | UnsetType = UNSET


def gust(t0: float, rise: float, speed: float, hold: float | None = None) -> dict[str, float | None]:
    """One gust: from t0 [s] up as 1 - cos in `rise` [s] to speed [m/s], `hold` [s] there (None: for good), and down."""
    return {"t0": float(t0), "rise": float(rise), "speed": float(speed), "hold": None if hold is None else float(hold)}


CALM = np.zeros(2)  # m/s: no gusts
PAPER_GUSTS = {"u_g": gust(2.0, 2.0, 4.0), "v_g": gust(5.0, 2.0, 3.0)}


@functools.lru_cache(maxsize=4)
def _times(steps: int) -> np.ndarray:
    return np.arange(steps + 1) * DT


def disturbance_rows(scenario: FaultScenario) -> np.ndarray:
    """d (steps + 1, 2): the gust at the samples."""
    if not scenario.disturbance:
        return np.broadcast_to(CALM, (scenario.steps + 1, 2))
    d = np.zeros((scenario.steps + 1, 2))
    t = _times(scenario.steps)
    for name, g in scenario.disturbance.items():
        rise, speed, column = g["rise"], g["speed"], d[:, ("u_g", "v_g").index(name)]
        s = t - g["t0"]
        first, held = s.searchsorted(0.0, "right"), s.searchsorted(rise, "right")
        column[first:held] = speed / 2 * (1 - np.cos(np.pi * (s[first:held] / rise)))
        column[held:] = speed
        if g["hold"] is not None:
            fall = s[held:] - rise - g["hold"]
            first, over = fall.searchsorted(0.0, "right"), fall.searchsorted(rise, "left")
            column = column[held:]
            column[first:over] = speed / 2 * (1 + np.cos(np.pi * (fall[first:over] / rise)))
            column[over:] = 0.0
    return d


def paper(number: int = 1) -> FaultScenario:
    """Scenario 1 to 4 of the source: sequential biases; floating, then stuck; simultaneous; 4 is 1."""
    faults = {
        1: [oscillating_bias("lat", -0.01, 1.0, 200, 400), bias("lon", 0.005, 400, 500), bias("ped", -0.01, 500, 700)],
        2: [floating_square("lat", 0.01, -0.01, 1.0, 200, 400), stuck("lon", float(U_TRIM[1]), 700, 900)],
        3: [floating_square("lat", 0.01, -0.01, 1.0, 400, 700), bias("ped", -0.01, 400, 700)],
    }
    chosen = faults[1 if number == 4 else number]
    return FaultScenario(plant=ID, steps=STEPS, faults=chosen, disturbance=PAPER_GUSTS)


def sample(rng: np.random.Generator) -> FaultScenario:
    """A flight of the randomised process. The order of draws is part of the benchmark; magnitudes in rad."""
    count = bisect.bisect_right(UP_TO_COUNT, rng.random())
    faults = []
    for c in rng.permutation(4)[:count]:
        channel, centre = CHANNELS[c], float(U_TRIM[c])
        kind = bisect.bisect_right(UP_TO_KIND, rng.random())
        k0 = round(uniform(rng, 3, 12) / DT)
        duration = uniform(rng, 2, 6)
        k1 = STEPS if rng.random() < 0.3 else min(STEPS, k0 + round(duration / DT))
        if kind == 0:
            sign = random_sign(rng)
            faults.append(bias(channel, sign * np.exp(uniform(rng, *LOG_BIAS[c])), k0, k1))
        elif kind == 1:
            position = None if rng.random() < 0.5 else centre + uniform(rng, -1, 1) * STUCK[c]
            faults.append(stuck(channel, position, k0, k1))
        elif kind == 2 and rng.random() < 0.5:
            amplitude, period = uniform(rng, *SQUARE[c]), uniform(rng, 0.6, 2)
            amplitude = random_sign(rng) * amplitude
            faults.append(floating_square(channel, centre + amplitude, centre - amplitude, period, k0, k1))
        elif kind == 2:
            sigma = uniform(rng, *DRIFT[c])
            first = sigma * rng.standard_normal()
            news = sigma * DRIFT_NEW * rng.standard_normal(k1 - k0)
            drift = first_order(DRIFT_DECAY, np.concatenate([[first], news[:-1]]))
            faults.append(floating(channel, (centre + drift).tolist(), k0, k1))
        else:
            faults.append(loss(channel, uniform(rng, *LOSS[c]), k0, k1))
    gusts = {}
    for name in ("u_g", "v_g"):
        if rng.random() < 0.7:
            t0, rise, hold, speed = (uniform(rng, *bounds) for bounds in GUSTS)
            gusts[name] = gust(t0, rise, speed, hold)
    return FaultScenario(plant=ID, steps=STEPS, faults=faults, disturbance=gusts)


def episode(seed: int) -> FaultScenario:
    """Flight `seed` of the benchmark's own numbering: scenario from default_rng([seed, 1]), noise seed + 1,000,000."""
    return sample(np.random.default_rng([seed, 1])).replace(noise_seed=seed + 1_000_000)


def fault_free_episode(seed: int) -> FaultScenario:
    """The same flight without its faults, gusts kept."""
    return episode(seed).without_faults()


def perturb(rng: np.random.Generator, level: float) -> dict[str, float]:
    """Mass and inertias times 1 + level U(-1, 1) each."""
    nominal = {"m": MASS, "Jxx": JXX, "Jyy": JYY, "Jzz": JZZ}
    return {name: float(value * (1 + level * rng.uniform(-1, 1))) for name, value in nominal.items()}


def quiet(rng: np.random.Generator) -> FaultScenario:
    """Still air; in four flights of five one actuator loses effectiveness for good, for U(3, 12) s on."""
    faults = []
    if rng.random() >= 0.2:
        c = int(rng.integers(4))
        faults.append(loss(CHANNELS[c], uniform(rng, *LOSS[c]), round(uniform(rng, 3, 12) / DT)))
    return FaultScenario(plant=ID, steps=STEPS, faults=faults)


def _processes() -> list[FaultProcess]:
    scoring = Scoring(decision="second_half")
    found = [
        FaultProcess(name="standard", description="0, 1 or 2 actuator faults under random gusts", sample=sample,
                     scoring=scoring),
        FaultProcess(name="hard", description="the same, side gusts with the full weathercock coupling (kappa = 1)",
                     sample=lambda rng: sample(rng).replace(physical={"kappa": 1.0}), scoring=scoring),
        FaultProcess(name="quiet", description="still air, a loss of effectiveness in four flights of five", sample=quiet,
                     scoring=scoring),
        FaultProcess(name="paper", description="the source's scenario 1: biases on lat, lon and ped in turn",
                     sample=lambda rng: paper(1), scoring=scoring),
    ]  # fmt: skip
    words = ("biases on lat, lon and ped in turn", "lat floats, then lon is stuck", "lat floats while ped is biased",
             "scenario 1, for all filters side by side")  # fmt: skip
    found += [
        FaultProcess(name=f"scenario-{i}", description=text, scoring=scoring, sample=lambda rng, i=i: paper(i))
        for i, text in enumerate(words, start=1)
    ]
    return found


# ---------------------------------------------------------------------------------------------------------------
# Declaration


ACTIVITY = (0.0017, 0.0015, 0.0015, 0.0046)  # rad rms: the command about trim in the fault-free flights
BANDS = ((3e-3, 6e-3), (1e-3, 3e-3), (1e-3, 3e-3), (4e-3, 8e-3))  # rad: small, medium, large


def _size(theta: np.ndarray, c: int) -> np.ndarray:
    """Typical |b| [rad] under a fault: the error at trim, and with it the command's activity that a gain loses."""
    lost = 1 - theta[..., c]
    return np.hypot(theta[..., 4 + c] - lost * U_TRIM[c], lost * ACTIVITY[c])


def target(theta: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The actuator error b = u_true - u_c (..., 4) under theta (..., 8) and the command u (..., 4)."""
    return (theta[..., :4] - 1.0) * u + theta[..., 4:]


def prescribed_noise(rng: np.random.Generator, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Process noise w (steps, 11), then sensor noise v (steps + 1, 9): the benchmark's order of draws."""
    w = rng.standard_normal((steps, 11)) * SIGMA_W
    return w, rng.standard_normal((steps + 1, 9)) * SIGMA_V


def _labels() -> tuple[Label, ...]:
    pairs = [(a, b) for i, a in enumerate(CHANNELS) for b in CHANNELS[i + 1 :]]
    return (
        Label("none", frozenset()),
        *(Label(c, frozenset({c})) for c in CHANNELS),
        *(Label(f"{a}+{b}", frozenset({a, b})) for a, b in pairs),
    )


def flight_cost(x: np.ndarray, u: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Velocities over 0.5 m/s, angles from trim over 0.1 rad, a tenth of the commands over 0.02 rad, squared."""
    v, angles, effort = x[..., :3] / 0.5, (x[..., 6:9] - X_TRIM[6:9]) / 0.1, (u - U_TRIM) / 0.02
    return (v**2).sum(axis=-1) + (angles**2).sum(axis=-1) + 0.1 * (effort**2).sum(axis=-1)


def sine(period: int, amplitudes: tuple[float, float, float, float]) -> np.ndarray:
    """Rows (period, 4) of one sine of these amplitudes [rad], the period in samples."""
    return np.sin(2 * np.pi * np.arange(period) / period)[:, None] * np.array(amplitudes)


PROBES = (
    Probe("cyclic", "sines of lon and lat by 4 mrad, periods 0.5 s and 1 s",
          command=np.concatenate([sine(25, (0.0, 4e-3, 0.0, 0.0))] * 2) + sine(50, (0.0, 0.0, 4e-3, 0.0))),
    Probe("pedal", "a sine of ped by 10 mrad, period 0.5 s", command=sine(25, (0.0, 0.0, 0.0, 0.01))),
    Probe("collective", "a sine of col by 5 mrad, period 0.5 s", command=sine(25, (5e-3, 0.0, 0.0, 0.0))),
)  # fmt: skip


def identification_reward(error: np.ndarray) -> np.ndarray:
    """Minus the mean over the channels of min(|error| / scale, 5)."""
    return -np.minimum(np.abs(error) / B_SCALE, 5.0).mean(axis=-1)


def plant(*, kappa: float = 0.3, K_B: float = 0.84) -> Plant:
    """Build the plant.

    Args:
        kappa: Share of the tail rotor's weathercock coupling in the side gust: 0 easy, 0.3 default, 1 hard (physical).
        K_B: Direct (Bell) gain from swash plate to tip-path plane; the stabiliser bar has the rest of 4.2. The robust
            filters live on it: they see a cyclic fault in the first sample only through this path.

    Raises:
        ValueError: An option out of range.
    """
    kappa, K_B = number("kappa", kappa, 0.0, 1.0), number("K_B", K_B, 0.0, A_CYC)
    x_trim, u_trim = trim(K_B)
    K = lqi_gain(*linearised(x_trim, u_trim, K_B))
    p = _physical(K_B)

    def physical(changes: Mapping[str, Any]) -> np.ndarray:
        changed = _physical(K_B, **{name: float(value) for name, value in changes.items() if name != "kappa"})
        changed[6:] = gust_matrix(u_trim, changes.get("kappa", kappa))
        return changed

    labels = _labels()
    accused = np.array([[c in label.modes for c in CHANNELS] for label in labels])
    wrongly = (accused[None] & ~accused[:, None]).sum(axis=2)

    most = 1.25 * np.array(BIAS)[:, 1]  # beyond that an actuator is stuck, and to ask it for more is in vain

    def accommodate(b: np.ndarray) -> np.ndarray:
        return np.concatenate([np.tile(q, (len(b), 1)), np.clip(b, -most, most)], axis=1)

    q = np.concatenate([K.ravel(), u_trim, x_trim, [p[5], np.exp(-DT / TAU_F)]])
    lim = (20.0, 20.0, 20.0, 8.0, 8.0, 8.0, np.pi / 3, np.pi / 3, np.inf, np.inf, np.inf)
    units = ("m/s",) * 3 + ("rad/s",) * 3 + ("rad",) * 5
    scales = (0.5,) * 3 + (0.2,) * 3 + (0.1,) * 3 + (0.01,) * 2
    unit4 = np.eye(4)
    return Plant(
        id=ID, version=VERSION, options={"kappa": kappa, "K_B": K_B},
        description="helicopter UAV in hover: actuator faults under wind gusts",
        dt=DT, substeps=1,
        kernels=Kernels(dynamics, output, control, outside=outside, jacobian=jacobian),
        states=tuple(Signal(n, unit, -high, high, scale, w, float(x)) for n, unit, high, scale, w, x in zip(
            STATES, units, lim, scales, SIGMA_W, x_trim, strict=True)),
        outputs=tuple(Signal(n, unit, -high, high, scale, v, float(x)) for n, unit, high, scale, v, x in zip(
            STATES[:9], units[:9], SENSOR_RANGE, scales[:9], SIGMA_V, x_trim[:9], strict=True)),
        commands=tuple(Signal(c, "rad", low, high, scale, 0.0, float(u)) for c, low, high, scale, u in zip(
            CHANNELS, U_MIN, U_MAX, (0.01, 0.01, 0.01, 0.02), u_trim, strict=True)),
        theta=(
            *(Signal(f"gain_{c}", "", 0.0, 1.0, 1.0, 0.0, 1.0) for c in CHANNELS),
            *(Signal(f"offset_{c}", "rad", -b, b, s) for c, b, s in zip(CHANNELS, B_MAX, B_SCALE, strict=True)),
        ),
        estimated=tuple(Signal(c, "rad", -b, b, s) for c, b, s in zip(CHANNELS, B_MAX, B_SCALE, strict=True)),
        target=target,
        disturbances=(Signal("u_g", "m/s", -50.0, 50.0, 2.0), Signal("v_g", "m/s", -50.0, 50.0, 2.0)),
        disturbance=disturbance_rows,
        modes=tuple(FaultMode(
            c, f"the {c} actuator is not where it is commanded: b_{c} = u_true - u_c", lambda th, i=i: _size(th, i),
            BANDS[i], offset=(0.0,) * 4, direction=tuple(unit4[i].tolist()), reach=(-B_MAX[i], B_MAX[i]),
        ) for i, c in enumerate(CHANNELS)),
        labels=labels, processes=_processes(),
        c0=np.concatenate([np.zeros(4), x_trim[9:]]),
        q=np.concatenate([q, np.zeros(4)]),
        physical=physical, perturb=perturb, shapes=Shapes(Nothing, Gusts, Physical),
        isolation_reward=np.eye(len(labels)) - 0.5 * wrongly,
        identification_reward=identification_reward,
        acting=Acting(flight_cost=flight_cost, lost=100.0, probes=PROBES, accommodate=accommodate),
    )  # fmt: skip
