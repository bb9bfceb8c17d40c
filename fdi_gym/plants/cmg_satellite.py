"""Rigid satellite with four control moment gyros (CMGs) in a pyramid, each of which can lose effectiveness.

    q_v' = (q4 w + q_v x w) / 2,  q4' = -q_v.w / 2,  J w' = -w x (Js w + h) - hdot,  d' = r
    h = h0 E(d) g,  hdot = h0 A(d) diag(f) r,  J = Js - Jw A A',  y = (q_v, w, d) + v and the sign of q4

| vector | entries |
|---|---|
| state x | quaternion q1..q4, inertial to body, q4 scalar; body rate w1..w3 [rad/s]; gimbal angles d1..d4 [rad] |
| command u | gimbal rates r1..r4 [rad/s], scaled together so that none exceeds 10 rad/s |
| output y | q1..q3, w1..w3 [rad/s], d1..d4 [rad], sign of q4 (+1 or -1, without noise) |
| known | reference attitude q_d (4) and rate w_d (3) [rad/s] |
| fault theta | effectiveness f1..f4 of the CMGs: 1 healthy, 0 dead |

The attitude is propagated continuously: q4 may become negative, and y carries its sign. Consumers rebuild
q4 = sign sqrt(max(0, 1 - |q_v|^2)); q and -q are the same attitude, d and d + 2 pi the same gimbal angle. The gimbals
always move as commanded, so only w and q carry fault information.

Options:
    reference: "slew" (default; roll, pitch and yaw follow sines of 5 deg and 13, 16 and 20 s) or "regulate" (the
        source's: to rest at zero from -90, 10 and 10 deg).
    snr: Signal-to-noise ratio of all sensors [dB]; the source has 45, 55 and 75. A sensor's standard deviation is
        10^(-snr/20) of its group's root mean square over the fault-free, noise-free reference flight of 200 s.
    fault_model: "torque" (the source's: f scales the delivered torque only, g = 1) or "wheel" (the flywheel has lost
        speed: g = f; the reaction of its spin-down is left out).
    steering: "robust" (singularity-robust inverse of A) or "pinv" (pseudo-inverse, the source's).
    feedback: "measured" (the controller is fed by the sensors) or "true" (by the state).
    excitation: "none", or "null": the null motion 0.05 sin(2 pi t / 7 s) n(d) is added to the gimbal rates.

Control is the sliding-mode law tau_c = -p0 (w_e + sgn(q_e4) q_e) with the commanded hdot = -tau_c - w x h. Steering and
diagnosers know the nominal A, E, Js. Mismatch level m: each axis of Js is off by a factor 1 + m U(-1, 1), each CMG is
mounted off by U(-o, o) about its gimbal axis, o = 0.5 deg at m = 0.01 and 1 deg at m = 0.03.

A diagnosis can act: null motion and small common moves of all gimbals as probes; the steering law weights each CMG by its
effectiveness.

Labels are the 16 sets of faulty units. Processes: "standard" (also "bench": one window of 20 to 45 s), "hard" (the
units fail and recover independently, mismatch 0.01), "fault-free", "paper" (also "table4": the source's time line), and
"table5" (the source's random ranges; under "slew" also called "paper-slew").

`info["det"]` is det(A A'), 0 where the cluster is singular; contact with a singularity does not end a flight. A flight
ends early where attitude control is lost: the attitude error exceeds 60 deg, in "regulate" after 30 s.

Sources: A. Rahimi's study of a simplified binary grid adaptation of the unscented filter for CMG faults (scenario,
Tables 3 to 5); A. Rahimi, K. D. Kumar, H. Alighanbari, Mechanical Systems and Signal Processing 135, 2020, 106419;
B. Wie, D. Bailey, C. Heiberg, J. Guidance, Control, and Dynamics 24, 2001 (steering). Eq. 11 of the first has the wrong
sign in two elements of A; corrected here (A is the derivative of E). h0, the slew, the noise levels and the processes
are this benchmark's.

Version history: v0, the first.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType
from numba import void

from fdi_gym.acting import Acting, Probe, square
from fdi_gym.checks import number
from fdi_gym.faults import Abrupt, Fault, FaultProcess, FaultScenario, Scoring
from fdi_gym.kernels import M, V, compiled, kernel
from fdi_gym.model import contiguous
from fdi_gym.plant import FaultMode, Kernels, Label, Plant, Signal
from fdi_gym.shapes import Nothing, Shapes
from fdi_gym.trigonometry import sincos

ID = "CMGSatellite"
VERSION = 0

DT = 0.01  # s: integration, sampling and control period
JS = (0.015, 0.017, 0.020)  # kg m^2: inertia with actuators
JW = 1e-5  # kg m^2: inertia of one CMG
H0 = 0.02  # N m s: momentum of one flywheel, JW * 2000 rad/s
BETA_P = np.deg2rad(54.73)  # pyramid skew angle
CB, SB = float(np.cos(BETA_P)), float(np.sin(BETA_P))
P0, LAMBDA_C = 0.1, 1.0  # N m s, 1/s: controller
R_MAX = 10.0  # rad/s: gimbal rate
SIGMA_Q = 1e-5  # rad/s per step: process noise on w
ANGLE_MAX = np.deg2rad(60.0)  # attitude error at which control counts as lost
NULL_AMPLITUDE, NULL_PERIOD = 0.05, 7.0  # -, s

SLEW_AMPLITUDE = np.deg2rad(5.0)
SLEW_PERIODS = (13.0, 16.0, 20.0)  # s: roll, pitch, yaw
SLEW_PHASES = (0.0, 2.0, 4.0)  # rad
START_ANGLES = np.deg2rad([-90.0, 10.0, 10.0])  # "regulate": roll, pitch, yaw at t = 0, Table 3

# Root mean square of the sensor groups q1..q3, w [rad/s], d [rad] over the fault-free, noise-free flight of 200 s
RMS = {"regulate": (0.0328334, 0.0318471, 0.0255543), "slew": (0.0318725, 0.0256511, 0.0292119)}
UNITS = ("CMG 1", "CMG 2", "CMG 3", "CMG 4")
SETS = tuple(s for size in range(5) for s in itertools.combinations(range(4), size))  # the labels, in order

# Table 4: unit, effectiveness, first and end step
TABLE_4 = ((0, 0.5, 2000, 4000), (1, 0.1, 4000, 7000), (2, 0.1, 7000, 10000), (3, 0.1, 10000, 15000))


# ---------------------------------------------------------------------------------------------------------------
# Equations. Vectors are written out in components: numba then needs no memory, and NumPy takes arrays as components.


def cluster_rows(s1, s2, s3, s4, c1, c2, c3, c4):
    """A(d) = sum dE/dd and E(d), each as three rows of four: hdot = h0 A r, h = h0 E (1, 1, 1, 1)'."""
    A = (
        (-CB * c1, s2, CB * c3, -s4),
        (-s1, -CB * c2, s3, CB * c4),
        (SB * c1, SB * c2, SB * c3, SB * c4),
    )
    E = (
        (-CB * s1, -c2, CB * s3, c4),
        (c1, -CB * s2, -c3, CB * s4),
        (SB * s1, SB * s2, SB * s3, SB * s4),
    )
    return A, E


_cluster_rows = kernel(cluster_rows)


def pyramid(d1, d2, d3, d4):
    """A(d) and E(d) of gimbal angles in numbers or arrays."""
    return cluster_rows(*(f(d) for f in (np.sin, np.cos) for d in (d1, d2, d3, d4)))


@kernel
def _pyramid(d1, d2, d3, d4):
    (s1, c1), (s2, c2), (s3, c3), (s4, c4) = sincos(d1), sincos(d2), sincos(d3), sincos(d4)
    return _cluster_rows(s1, s2, s3, s4, c1, c2, c3, c4)


@kernel
def dot4(a, b1, b2, b3, b4):
    """Scalar product of a row of A or E with four numbers."""
    return a[0] * b1 + a[1] * b2 + a[2] * b3 + a[3] * b4


@kernel
def gram(A):
    """The six elements 11, 12, 13, 22, 23, 33 of A A'."""
    return (
        dot4(A[0], A[0][0], A[0][1], A[0][2], A[0][3]),
        dot4(A[0], A[1][0], A[1][1], A[1][2], A[1][3]),
        dot4(A[0], A[2][0], A[2][1], A[2][2], A[2][3]),
        dot4(A[1], A[1][0], A[1][1], A[1][2], A[1][3]),
        dot4(A[1], A[2][0], A[2][1], A[2][2], A[2][3]),
        dot4(A[2], A[2][0], A[2][1], A[2][2], A[2][3]),
    )


@kernel
def solve3(m11, m12, m13, m22, m23, m33, b1, b2, b3):
    """The solution of M z = b for symmetric M (3, 3), and det M; by cofactors."""
    c11, c12, c13 = m22 * m33 - m23 * m23, m13 * m23 - m12 * m33, m12 * m23 - m13 * m22
    c22, c23, c33 = m11 * m33 - m13 * m13, m12 * m13 - m11 * m23, m11 * m22 - m12 * m12
    det = m11 * c11 + m12 * c12 + m13 * c13
    return (
        (c11 * b1 + c12 * b2 + c13 * b3) / det,
        (c12 * b1 + c22 * b2 + c23 * b3) / det,
        (c13 * b1 + c23 * b2 + c33 * b3) / det,
        det,
    )


@kernel
def dynamics(t, x, u, theta, d, p, dx):
    """Kinematics, Euler's equation with the CMG cluster, gimbals. p = (Js, mounting errors [rad], 1 for "wheel")."""
    A, E = _pyramid(x[7] + p[3], x[8] + p[4], x[9] + p[5], x[10] + p[6])
    q1, q2, q3, q4, w1, w2, w3 = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
    g1, g2, g3, g4 = 1.0, 1.0, 1.0, 1.0
    if p[7] > 0.0:
        g1, g2, g3, g4 = theta[0], theta[1], theta[2], theta[3]
    r1, r2, r3, r4 = theta[0] * u[0], theta[1] * u[1], theta[2] * u[2], theta[3] * u[3]
    l1 = p[0] * w1 + H0 * dot4(E[0], g1, g2, g3, g4)  # Js w + h
    l2 = p[1] * w2 + H0 * dot4(E[1], g1, g2, g3, g4)
    l3 = p[2] * w3 + H0 * dot4(E[2], g1, g2, g3, g4)
    b1 = -(w2 * l3 - w3 * l2) - H0 * dot4(A[0], r1, r2, r3, r4)
    b2 = -(w3 * l1 - w1 * l3) - H0 * dot4(A[1], r1, r2, r3, r4)
    b3 = -(w1 * l2 - w2 * l1) - H0 * dot4(A[2], r1, r2, r3, r4)
    m11, m12, m13, m22, m23, m33 = gram(A)
    dx[4], dx[5], dx[6], _ = solve3(
        p[0] - JW * m11, -JW * m12, -JW * m13, p[1] - JW * m22, -JW * m23, p[2] - JW * m33, b1, b2, b3
    )
    dx[0] = 0.5 * (q4 * w1 + q2 * w3 - q3 * w2)
    dx[1] = 0.5 * (q4 * w2 + q3 * w1 - q1 * w3)
    dx[2] = 0.5 * (q4 * w3 + q1 * w2 - q2 * w1)
    dx[3] = -0.5 * (q1 * w1 + q2 * w2 + q3 * w3)
    for i in range(4):
        dx[7 + i] = u[i]


@kernel
def cross(a1, a2, a3, b1, b2, b3):
    """a x b."""
    return a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1


@kernel
def rate_column(J, j, C, b1, b2, b3):
    """Column j of J in the rows of w': M^-1 b, with the rows C of M^-1."""
    for i in range(3):
        J[4 + i, j] = C[i][0] * b1 + C[i][1] * b2 + C[i][2] * b3


@kernel
def jacobian(t, x, u, theta, d, p, J_x, J_theta, J_d, J_p):
    """The derivatives of `dynamics`: M w' = b gives dw'/dz = M^-1 (db/dz - dM/dz w'), and dE/dd = A, dA/dd = -E."""
    A, E = _pyramid(x[7] + p[3], x[8] + p[4], x[9] + p[5], x[10] + p[6])
    q1, q2, q3, q4, w1, w2, w3 = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
    J_x[0, 4], J_x[0, 5], J_x[0, 6] = 0.5 * q4, -0.5 * q3, 0.5 * q2
    J_x[1, 4], J_x[1, 5], J_x[1, 6] = 0.5 * q3, 0.5 * q4, -0.5 * q1
    J_x[2, 4], J_x[2, 5], J_x[2, 6] = -0.5 * q2, 0.5 * q1, 0.5 * q4
    J_x[3, 4], J_x[3, 5], J_x[3, 6] = -0.5 * q1, -0.5 * q2, -0.5 * q3
    J_x[0, 1], J_x[0, 2], J_x[0, 3] = 0.5 * w3, -0.5 * w2, 0.5 * w1
    J_x[1, 0], J_x[1, 2], J_x[1, 3] = -0.5 * w3, 0.5 * w1, 0.5 * w2
    J_x[2, 0], J_x[2, 1], J_x[2, 3] = 0.5 * w2, -0.5 * w1, 0.5 * w3
    J_x[3, 0], J_x[3, 1], J_x[3, 2] = -0.5 * w1, -0.5 * w2, -0.5 * w3

    wheel, g = 0.0, (1.0, 1.0, 1.0, 1.0)
    if p[7] > 0.0:
        wheel, g = 1.0, (theta[0], theta[1], theta[2], theta[3])
    r = (theta[0] * u[0], theta[1] * u[1], theta[2] * u[2], theta[3] * u[3])
    l1 = p[0] * w1 + H0 * dot4(E[0], *g)
    l2 = p[1] * w2 + H0 * dot4(E[1], *g)
    l3 = p[2] * w3 + H0 * dot4(E[2], *g)
    n1, n2, n3 = cross(l1, l2, l3, w1, w2, w3)
    b1, b2, b3 = n1 - H0 * dot4(A[0], *r), n2 - H0 * dot4(A[1], *r), n3 - H0 * dot4(A[2], *r)
    m11, m12, m13, m22, m23, m33 = gram(A)
    M = (p[0] - JW * m11, -JW * m12, -JW * m13, p[1] - JW * m22, -JW * m23, p[2] - JW * m33)
    C = (solve3(*M, 1.0, 0.0, 0.0), solve3(*M, 0.0, 1.0, 0.0), solve3(*M, 0.0, 0.0, 1.0))
    z1, z2, z3, _ = solve3(*M, b1, b2, b3)  # w'

    rate_column(J_x, 4, C, 0.0, l3 - p[0] * w3, p[0] * w2 - l2)
    rate_column(J_x, 5, C, p[1] * w3 - l3, 0.0, l1 - p[1] * w1)
    rate_column(J_x, 6, C, l2 - p[2] * w2, p[2] * w1 - l1, 0.0)
    rate_column(J_p, 0, C, -z1, -w1 * w3, w1 * w2)
    rate_column(J_p, 1, C, w2 * w3, -z2, -w1 * w2)
    rate_column(J_p, 2, C, -w2 * w3, w1 * w3, -z3)
    for i in range(4):
        a1, a2, a3, e1, e2, e3 = A[0][i], A[1][i], A[2][i], E[0][i], E[1][i], E[2][i]
        v1, v2, v3 = cross(w1, w2, w3, e1, e2, e3)
        k, s = H0 * u[i], H0 * wheel
        rate_column(J_theta, i, C, -k * a1 - s * v1, -k * a2 - s * v2, -k * a3 - s * v3)
        v1, v2, v3 = cross(w1, w2, w3, a1, a2, a3)
        k, s = H0 * r[i] - JW * (a1 * z1 + a2 * z2 + a3 * z3), JW * (e1 * z1 + e2 * z2 + e3 * z3)
        b1, b2, b3 = k * e1 - s * a1 - H0 * g[i] * v1, k * e2 - s * a2 - H0 * g[i] * v2, k * e3 - s * a3 - H0 * g[i] * v3
        rate_column(J_x, 7 + i, C, b1, b2, b3)
        rate_column(J_p, 3 + i, C, b1, b2, b3)


@kernel
def project(x, theta):
    """The quaternion keeps its length; its sign is left alone."""
    norm = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
    for i in range(4):
        x[i] /= norm


@kernel
def output(t, x, u, theta, d, p, y):
    """The vector part of the attitude, the rate, the gimbal angles; the sign of q4."""
    for i in range(3):
        y[i] = x[i]
        y[3 + i] = x[4 + i]
    for i in range(4):
        y[6 + i] = x[7 + i]
    y[10] = 1.0 if x[3] >= 0.0 else -1.0


@kernel
def known(t, r, c, out):
    """The reference q_d, w_d."""
    for i in range(7):
        out[i] = r[i]


@kernel
def attitude_error(q1, q2, q3, q4, r):
    """q_e and q_e4 of an attitude against the reference row r = (q_d, w_d, ...)."""
    return (
        r[3] * q1 - q4 * r[0] + q2 * r[2] - q3 * r[1],
        r[3] * q2 - q4 * r[1] + q3 * r[0] - q1 * r[2],
        r[3] * q3 - q4 * r[2] + q1 * r[1] - q2 * r[0],
        r[3] * q4 + r[0] * q1 + r[1] * q2 + r[2] * q3,
    )


@kernel
def rotated(q1, q2, q3, q4, v1, v2, v3):
    """C(q) v with C(q) = (q4^2 - q_v.q_v) I + 2 q_v q_v' - 2 q4 [q_v x]."""
    a, b = q4 * q4 - q1 * q1 - q2 * q2 - q3 * q3, 2.0 * (q1 * v1 + q2 * v2 + q3 * v3)
    return (
        a * v1 + b * q1 - 2.0 * q4 * (q2 * v3 - q3 * v2),
        a * v2 + b * q2 - 2.0 * q4 * (q3 * v1 - q1 * v3),
        a * v3 + b * q3 - 2.0 * q4 * (q1 * v2 - q2 * v1),
    )


@kernel
def sliding_mode(y, r):
    """The control torque tau_c [N m] from a measurement y (11) and the reference row r."""
    q4 = y[10] * np.sqrt(max(0.0, 1.0 - y[0] * y[0] - y[1] * y[1] - y[2] * y[2]))
    e1, e2, e3, e4 = attitude_error(y[0], y[1], y[2], q4, r)
    v1, v2, v3 = rotated(e1, e2, e3, e4, r[4], r[5], r[6])
    gain = LAMBDA_C if e4 >= 0.0 else -LAMBDA_C
    return (
        -P0 * (y[3] - v1 + gain * e1),
        -P0 * (y[4] - v2 + gain * e2),
        -P0 * (y[5] - v3 + gain * e3),
    )


@kernel
def commanded_hdot(y, r, E):
    """u = -tau_c - w x h(d): the rate of change of the cluster's momentum that the control torque asks for [N m]."""
    tau1, tau2, tau3 = sliding_mode(y, r)
    h1, h2, h3 = (
        H0 * dot4(E[0], 1.0, 1.0, 1.0, 1.0),
        H0 * dot4(E[1], 1.0, 1.0, 1.0, 1.0),
        H0 * dot4(E[2], 1.0, 1.0, 1.0, 1.0),
    )
    return -tau1 - (y[4] * h3 - y[5] * h2), -tau2 - (y[5] * h1 - y[3] * h3), -tau3 - (y[3] * h2 - y[4] * h1)


@kernel
def determinant(a, b, c, i, j, k):
    """Determinant of the columns i, j, k of the matrix with rows a, b, c."""
    return a[i] * (b[j] * c[k] - b[k] * c[j]) - a[j] * (b[i] * c[k] - b[k] * c[i]) + a[k] * (b[i] * c[j] - b[j] * c[i])


@kernel
def control(t, y, r, q, c, u):
    """Gimbal rates r = A' (A A' + lam Es)^-1 hdot / h0, with the columns of A weighted by the effectiveness.

    q = 1 for robust or 0 for pinv, amplitude of the null motion, effectiveness that is allowed for (4).
    """
    A, E = _pyramid(y[6], y[7], y[8], y[9])
    hdot1, hdot2, hdot3 = commanded_hdot(y, r, E)
    A = (
        (q[2] * A[0][0], q[3] * A[0][1], q[4] * A[0][2], q[5] * A[0][3]),
        (q[2] * A[1][0], q[3] * A[1][1], q[4] * A[1][2], q[5] * A[1][3]),
        (q[2] * A[2][0], q[3] * A[2][1], q[4] * A[2][2], q[5] * A[2][3]),
    )
    m11, m12, m13, m22, m23, m33 = gram(A)
    _, _, _, det = solve3(m11, m12, m13, m22, m23, m33, 0.0, 0.0, 0.0)
    lam = q[0] * 0.01 * np.exp(-10.0 * det)
    sine, cosine = sincos(0.5 * np.pi * t)
    e1, e2, e3 = 0.01 * sine, 0.01 * cosine, -0.01 * sine  # 0.01 sin(pi t / 2 + 0, pi / 2, pi)
    z1, z2, z3, _ = solve3(
        m11 + lam, m12 + lam * e3, m13 + lam * e2, m22 + lam, m23 + lam * e1, m33 + lam, hdot1, hdot2, hdot3
    )
    for i in range(4):
        u[i] = (A[0][i] * z1 + A[1][i] * z2 + A[2][i] * z3) / H0
    if q[1] > 0.0:
        excitation = q[1] * np.sin(2.0 * np.pi * t / NULL_PERIOD)
        u[0] += excitation * determinant(A[0], A[1], A[2], 1, 2, 3)
        u[1] -= excitation * determinant(A[0], A[1], A[2], 0, 2, 3)
        u[2] += excitation * determinant(A[0], A[1], A[2], 0, 1, 3)
        u[3] -= excitation * determinant(A[0], A[1], A[2], 0, 1, 2)
    peak = max(max(abs(u[0]), abs(u[1])), max(abs(u[2]), abs(u[3])))
    if peak > R_MAX:
        for i in range(4):
            u[i] = u[i] / peak * R_MAX


@kernel
def outside(t, x, r):
    """Attitude control is lost: the error angle exceeds 60 deg, from the time r[7] [s] on."""
    _, _, _, e4 = attitude_error(x[0], x[1], x[2], x[3], r)
    return t > r[7] and abs(e4) < np.cos(0.5 * ANGLE_MAX)


# ---------------------------------------------------------------------------------------------------------------
# The same for stacks of gimbal angles, as filters and checks use it


def cluster(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and E (..., 3, 4) at gimbal angles d (..., 4)."""
    A, E = pyramid(*np.moveaxis(np.asarray(d, float), -1, 0))
    # contiguous: products of stacked matrices then round the same for one episode and for many
    A, E = (np.ascontiguousarray(np.moveaxis(np.array(M), (0, 1), (-2, -1))) for M in (A, E))
    return A, E


def inertia(A: np.ndarray) -> np.ndarray:
    """J = Js - Jw A A' (..., 3, 3) [kg m^2]."""
    return np.diag(JS) - JW * (A @ np.swapaxes(A, -1, -2))


@compiled(void(M, V))
def _singularities(d, det):
    for i in range(det.size):
        (a, b, c), _ = _pyramid(d[i, 0], d[i, 1], d[i, 2], d[i, 3])
        det[i] = determinant(a, b, c, 0, 1, 2) ** 2 + determinant(a, b, c, 0, 1, 3) ** 2
        det[i] += determinant(a, b, c, 0, 2, 3) ** 2 + determinant(a, b, c, 1, 2, 3) ** 2


def singularity(d: np.ndarray) -> np.ndarray:
    """det(A A') (...) at d (..., 4): 1.1857 at rest, 0 where the cluster is singular. By A's minors (Cauchy, Binet)."""
    angles = np.asarray(d, float)
    det = np.empty(angles.shape[:-1])
    _singularities(contiguous(angles.reshape(-1, 4)), det.reshape(-1))
    return det


# ---------------------------------------------------------------------------------------------------------------
# References


def quaternion(angles: np.ndarray) -> np.ndarray:
    """q (..., 4) of roll, pitch, yaw (..., 3) [rad] in the 3-2-1 sequence."""
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(angles / 2), -1, 0), np.moveaxis(np.sin(angles / 2), -1, 0)
    return np.stack([
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ], axis=-1)  # fmt: skip


def slew(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """q_d (..., 4) and w_d (..., 3) [rad/s] of the slew reference at the times t (...) [s]."""
    omega = 2 * np.pi / np.array(SLEW_PERIODS)
    phase = omega * np.asarray(t, float)[..., None] + np.array(SLEW_PHASES)
    a, da = SLEW_AMPLITUDE * np.sin(phase), SLEW_AMPLITUDE * omega * np.cos(phase)
    (a1, a2, _), (d1, d2, d3) = np.moveaxis(a, -1, 0), np.moveaxis(da, -1, 0)
    w = np.stack([
        d1 - np.sin(a2) * d3,
        np.cos(a1) * d2 + np.sin(a1) * np.cos(a2) * d3,
        -np.sin(a1) * d2 + np.cos(a1) * np.cos(a2) * d3,
    ], axis=-1)  # fmt: skip
    return quaternion(a), w


@functools.lru_cache(maxsize=8)
def _rows(profile: str, steps: int) -> np.ndarray:
    rows = np.zeros((steps + 1, 8))
    if profile == "slew":
        rows[:, :4], rows[:, 4:7] = slew(np.arange(steps + 1) * DT)
    else:
        rows[:, 3], rows[:, 7] = 1.0, 30.0
    return rows


def start(profile: str) -> np.ndarray:
    """The initial state (11,): on the slew reference, or that of Table 3."""
    q, w = slew(np.array(0.0)) if profile == "slew" else (quaternion(START_ANGLES), np.zeros(3))
    return np.concatenate([q, w, np.zeros(4)])


# ---------------------------------------------------------------------------------------------------------------
# Faults


def loss(unit: int, alpha: float, onset: int, end: int) -> Fault:
    """CMG `unit` (0..3) has the effectiveness 1 - alpha on the steps onset <= k < end."""
    return Fault(UNITS[unit], "LOE", onset, [Abrupt(f"f{unit + 1}", 1.0 - alpha)], end)


Share = Annotated[float, Meta(ge=-0.9, le=10.0)]  # an inertia stays positive
Mounting = Annotated[float, Meta(ge=-180.0, le=180.0)]  # deg


class Physical(msgspec.Struct, forbid_unknown_fields=True):
    """Relative errors of the inertias, and errors of the CMGs' mounting [deg]."""

    inertia_error: tuple[Share, Share, Share] | UnsetType = UNSET
    mounting_error_deg: tuple[Mounting, Mounting, Mounting, Mounting] | UnsetType = UNSET


class Slew(msgspec.Struct, forbid_unknown_fields=True):
    """The reference of a plant with the option "slew"."""

    profile: Literal["slew"] = "slew"


class Regulate(msgspec.Struct, forbid_unknown_fields=True):
    """The reference of a plant with the option "regulate"."""

    profile: Literal["regulate"] = "regulate"


class Ranges(NamedTuple):
    """Uniform ranges of a fault window: onset and duration [s] (it ends 1 s before the horizon at least), severity."""

    onset: tuple[float, float]
    duration: tuple[float, float]
    alpha: tuple[float, float]


def window(rng: np.random.Generator, label: int, steps: int, ranges: Ranges, profile: str) -> FaultScenario:
    """One fault window in which the units of the label lose alpha each, drawn in the order onset, duration, alphas."""
    on = rng.uniform(*ranges.onset, None)
    duration = rng.uniform(ranges.duration[0], min(ranges.duration[1], steps * DT - 1.0 - on))
    a, b = int(on / DT), int((on + duration) / DT)
    faults = [loss(i, float(rng.uniform(*ranges.alpha, None)), a, b) for i in SETS[label]]
    return FaultScenario(plant=ID, steps=steps, faults=faults, reference={"profile": profile})


BENCH = Ranges((20.0, 50.0), (20.0, 45.0), (0.1, 0.9))
TABLE_5 = Ranges((0.0, 199.0), (0.0, 199.0), (0.0, 1.0))


def bench(rng: np.random.Generator, label: int, profile: str = "slew") -> FaultScenario:
    """100 s with one window: T_on U(20, 50) s, T_dur U(20, 45) s, alpha U(0.1, 0.9)."""
    return window(rng, label, 10000, BENCH, profile)


def table5(rng: np.random.Generator, label: int, profile: str) -> FaultScenario:
    """200 s with one window: T_on U(0, 199) s, T_dur U(0, 199 - T_on), alpha U(0, 1); Table 5."""
    return window(rng, label, 20000, TABLE_5, profile)


def table4(profile: str) -> FaultScenario:
    """The source's time line: each unit in turn, Table 4."""
    faults = [loss(i, 1.0 - f, a, b) for i, f, a, b in TABLE_4]
    return FaultScenario(plant=ID, steps=20000, faults=faults, reference={"profile": profile})


def perturb(rng: np.random.Generator, level: float) -> dict[str, Any]:
    """Inertia errors +-level on each axis; mounting errors up to 0.5 deg at level 0.01, 1 deg at 0.03."""
    o = min(50.0 * level, 0.25 + 25.0 * level)
    return {
        "inertia_error": rng.uniform(-level, level, 3).tolist(),
        "mounting_error_deg": rng.uniform(-o, o, 4).tolist(),
    }


def intermittent(rng: np.random.Generator, profile: str = "slew") -> FaultScenario:
    """100 s in which each unit fails for U(4, 20) s and recovers for U(10, 40) s, alpha U(0.02, 0.4); mismatch 0.01."""
    faults, steps = [], 10000
    for i in range(4):
        t = rng.uniform(5, 30)
        while t < steps * DT:
            duration, alpha = rng.uniform(4, 20), float(rng.uniform(0.02, 0.4))
            faults.append(loss(i, alpha, int(t / DT), min(int((t + duration) / DT), steps)))
            t += duration + rng.uniform(10, 40)
    return FaultScenario(plant=ID, steps=steps, faults=faults, reference={"profile": profile}, physical=perturb(rng, 0.01))


def tumble(rng: np.random.Generator) -> list[float]:
    """The initial state of Table 5: q components U(-1, 1), normalised, q4 >= 0; w components U(-0.5, 0.5) rad/s."""
    q = rng.uniform(-1, 1, 4)
    q *= (1.0 if q[3] >= 0 else -1.0) / np.linalg.norm(q)
    return [*q.tolist(), *rng.uniform(-0.5, 0.5, 3).tolist(), 0.0, 0.0, 0.0, 0.0]


def processes(profile: str) -> list[FaultProcess]:
    """The fault processes under one reference."""

    def standard(rng: np.random.Generator) -> FaultScenario:
        return bench(rng, int(rng.integers(16)), profile)

    def ranges(rng: np.random.Generator) -> FaultScenario:
        return table5(rng, int(rng.integers(16)), profile)

    settled = Scoring(grace=300, decision="second_half")
    initial = tumble if profile == "regulate" else None
    found = [
        FaultProcess(name=name, description="one fault window of 20 to 45 s in 100 s", sample=standard, scoring=settled)
        for name in ("standard", "bench")
    ]
    found += [
        FaultProcess(name="hard", description="the four units fail and recover independently, plant off the model",
                     sample=lambda rng: intermittent(rng, profile), scoring=Scoring(start=500, grace=100)),
    ]  # fmt: skip
    found += [
        FaultProcess(name=name, description="the source's time line: each unit in turn, 200 s (Table 4)",
                     sample=lambda rng: table4(profile), scoring=Scoring(start=500, grace=300))
        for name in ("paper", "table4")
    ]  # fmt: skip
    found += [
        FaultProcess(name=name, description="the source's random ranges, 200 s (Table 5)", sample=ranges,
                     initial=initial, scoring=settled)
        for name in (("table5", "paper-slew") if profile == "slew" else ("table5",))
    ]  # fmt: skip
    return found


# ---------------------------------------------------------------------------------------------------------------


def sensor_sigma(profile: str, snr: float) -> np.ndarray:
    """Standard deviations of the ten noisy sensors (10,)."""
    return np.repeat(RMS[profile], (3, 3, 4)) * 10 ** (-snr / 20)


def flight_cost(x: np.ndarray, u: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The attitude error over 0.5 deg and a tenth of the gimbal rates over 0.5 rad/s, squared."""
    e4 = np.abs((x[..., :4] * r[..., :4]).sum(axis=-1))
    angle = 2.0 * np.arccos(np.minimum(e4, 1.0))
    return (angle / np.deg2rad(0.5)) ** 2 + 0.1 * ((u / 0.5) ** 2).sum(axis=-1)


PROBES = (
    Probe("null", "null motion of the gimbals, 0.05 n(d) at a period of 7 s, which puts no torque on a healthy satellite",
          parameters=np.array([0.0, NULL_AMPLITUDE, 0.0, 0.0, 0.0, 0.0])),
    Probe("common", "all gimbals together by 0.004 rad/s, to and fro for 1 s each", command=square(200, [0.004] * 4)),
)  # fmt: skip


def plant(
    *,
    reference: str = "slew",
    snr: float = 45.0,
    fault_model: str = "torque",
    steering: str = "robust",
    feedback: str = "measured",
    excitation: str = "none",
) -> Plant:
    """Build the plant; the options are those of the data sheet above.

    Raises:
        ValueError: An option has a value that does not exist; the message lists those that do.
    """
    options = {"reference": reference, "snr": snr, "fault_model": fault_model, "steering": steering,
               "feedback": feedback, "excitation": excitation}  # fmt: skip
    choices = {"reference": tuple(RMS), "fault_model": ("torque", "wheel"), "steering": ("robust", "pinv"),
               "feedback": ("measured", "true"), "excitation": ("none", "null")}  # fmt: skip
    for name, allowed in choices.items():
        if options[name] not in allowed:
            raise ValueError(f"unknown {name} {options[name]!r}; {ID} has {', '.join(allowed)}")
    options["snr"] = snr = number("snr [dB]", snr, -40.0, 400.0)

    def physical(changes: Mapping[str, Any]) -> np.ndarray:
        js = np.array(JS) * (1.0 + np.array(changes.get("inertia_error", [0.0] * 3)))
        mounting = np.deg2rad(changes.get("mounting_error_deg", [0.0] * 4))
        return np.concatenate([js, mounting, [float(fault_model == "wheel")]])

    q = np.array([float(steering == "robust"), NULL_AMPLITUDE if excitation == "null" else 0.0, 1.0, 1.0, 1.0, 1.0])

    def accommodate(f: np.ndarray) -> np.ndarray:
        return np.concatenate([np.tile(q[:2], (len(f), 1)), np.clip(f, 0.05, 1.0)], axis=1)

    x0, sigma = start(reference), sensor_sigma(reference, snr)
    attitude = [Signal(f"q{i + 1}", "", -1.1, 1.1, 0.1, nominal=x0[i]) for i in range(4)]
    w = [Signal(f"w{i + 1}", "rad/s", -20.0, 20.0, 0.05, SIGMA_Q, x0[4 + i]) for i in range(3)]
    d = [Signal(f"d{i + 1}", "rad", -2500.0, 2500.0, 0.2) for i in range(4)]
    seen = [*attitude[:3], *w, *(s._replace(period=2 * np.pi) for s in d)]
    return Plant(
        id=ID, version=VERSION, options=options,
        description="Satellite with four control moment gyros: loss of effectiveness of any subset",
        dt=DT, substeps=1,
        kernels=Kernels(dynamics, output, control, known, project, outside, jacobian=jacobian),
        states=(*attitude, *w, *d),
        outputs=(*(s._replace(sigma=float(v), nominal=0.0) for s, v in zip(seen, sigma, strict=True)),
                 Signal("sign q4", "", -1.0, 1.0)),
        commands=tuple(Signal(f"r{i + 1}", "rad/s", -R_MAX, R_MAX, 0.5) for i in range(4)),
        known=(*(Signal(f"q_d{i + 1}", "", -1.0, 1.0, 0.1) for i in range(4)),
               *(Signal(f"w_d{i + 1}", "rad/s", -1.0, 1.0, 0.05) for i in range(3))),
        theta=tuple(Signal(f"f{i + 1}", "", 0.0, 1.0, 1.0, nominal=1.0) for i in range(4)),
        modes=tuple(
            FaultMode(name, f"f{i + 1} < 1", lambda theta, i=i: 1.0 - theta[..., i], (0.2, 0.5), offset=(0.0,) * 4,
                      direction=tuple(-1.0 if j == i else 0.0 for j in range(4)),
                      reach=(0.02, 1.0))
            for i, name in enumerate(UNITS)
        ),
        labels=tuple(Label(" + ".join(UNITS[i] for i in s) or "none", frozenset(UNITS[i] for i in s)) for s in SETS),
        processes=processes(reference),
        q=q,
        true_feedback=feedback == "true", physical=physical, perturb=perturb,
        reference=lambda scenario: _rows(reference, scenario.steps),
        shapes=Shapes(Slew if reference == "slew" else Regulate, Nothing, Physical),
        quaternions=((0, 1, 2, 10),),
        monitor=lambda state: {"det": singularity(state[..., 7:])},
        isolation_reward=np.eye(16) - 1.0, identification_reward=lambda error: -np.abs(error).mean(axis=-1),
        acting=Acting(flight_cost=flight_cost, lost=100.0, probes=PROBES, accommodate=accommodate),
    )  # fmt: skip
