"""Tail-controlled missile, pitch axis, in closed loop under two-time-scale dynamic inversion.

The Reichert airframe at 20,000 ft with a fin and a reaction jet, flown by a slow loop (incidence) and a fast loop
(pitch rate) that invert the nominal model. Units are ft, slug, s, rad; load factors in g; angles in degrees only
where written.

| vector | entries |
|---|---|
| state x | incidence alpha [rad], pitch rate q [rad/s], fin angle delta [rad] and its rate [rad/s], jet level j |
| command u | fin command delta_c [rad], clipped to 30 deg; jet command j_c in [-1, 1] |
| sensors y | alpha [rad], q [rad/s], normal load factor eta [g], negative for alpha > 0; noise clipped at 4 sigma |
| known | nominal fin angle delta^ and jet level j^ (actuator model on the commands), Mach M, filtered command alpha_r |
| fault theta | theta_aero, theta_leak, theta_finloss, jam, theta_jetloss; all 0 when healthy |
| physical p | rho_1..8: relative errors of a_n, b_n, c_n, a_m, b_m, c_m, d_n, d_m |
| disturbance d | Mach schedule M(t) = 2.5 + d_0 + d_1 t, exactly known to every algorithm |

    alpha_dot = K_alpha M cos(alpha) (C_n0 + (1 - theta_finloss) d_n delta) + q
    q_dot     = K_q M^2 (C_m0 + (1 - theta_finloss) d_m delta) + (1 - theta_jetloss) L_j j
                + theta_aero Z_1 + theta_leak Z_2
    eta       = K_z M^2 (C_n0 + (1 - theta_finloss) d_n delta)

| label | mode | effect |
|---|---|---|
| 1 | aero | change of the quadratic pitching moment: Z_1 = k1 K_q M^2 abs(b_m) alpha abs(alpha) |
| 2 | leak | reaction-jet valve leak, fading with incidence: Z_2 = L2 exp(-(alpha/alpha_J)^2) |
| 3 | finloss | loss of fin effectiveness |
| 4 | stuck | the fin jams where it is (`jam` = 1): its angle is frozen, its rate becomes 0 |
| 5 | jetloss | loss of jet thrust |

Faults 1, 2, 3 and 5 are incipient, theta(t) = size (1 - exp(-gamma (t - T0))), evaluated at the Runge-Kutta stages; a
jam is abrupt. The identification task asks for theta. `jam` has no size beyond being there: it counts as large.

The study's scenario and its mirror are noise-free: build the plant with `noise_scale=0`. Mismatch draws rho_1..6 in
+-level and rho_7, rho_8 in +-5/8 level, the proportions of the process "hard".

A diagnosis can act: a dither of the jet against which the fin moves, and small steps of the commanded incidence, as probes;
the inversion allows for the estimated fault.

The flight ends early where the airframe data end, |alpha| > 20 deg, or at |q| > 5 rad/s.

Sources: R. T. Reichert, IEEE Control Systems Magazine 12(5), 1992 (airframe, fin); R. A. Nichols, R. T. Reichert, W.
J. Rugh, IEEE Trans. Control Systems Technology 1(2), 1993; C. P. Mracek, J. R. Cloutier, AIAA 97-3767, 1997 (the same
numbers); X. Zhang, M. M. Polycarpou, T. Parisini, IEEE TAC 47(4), 2002 (fault model, incipient profile). Jet, fault
functions, controller gains, noise and random processes are this benchmark's.

Version history: v0, the first.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import scipy.linalg
from msgspec import UNSET, Meta, UnsetType

from fdi_gym.acting import Acting, Probe, square
from fdi_gym.checks import number
from fdi_gym.drawing import random_sign, uniform
from fdi_gym.faults import MAX_STEPS, Abrupt, Fault, FaultProcess, FaultScenario, Incipient, Scoring
from fdi_gym.kernels import kernel
from fdi_gym.plant import FaultMode, Kernels, Label, Plant, Signal
from fdi_gym.shapes import Shapes, only_with
from fdi_gym.trigonometry import sincos

ID = "MissilePitch"
VERSION = 0

DT, SUBSTEPS = 0.01, 4  # s; Runge-Kutta steps of 2.5 ms
STEPS = 2000  # 20 s
DEG = np.pi / 180.0

P0, AREA, MASS = 973.3, 0.44, 13.98  # lb/ft^2 static pressure at 20,000 ft; ft^2; slug
SOUND, LENGTH, INERTIA, G0 = 1036.4, 0.75, 182.5, 32.2  # ft/s; ft; slug ft^2; ft/s^2
K_ALPHA = 0.7 * P0 * AREA / (MASS * SOUND)  # 1/s
K_Q = 0.7 * P0 * AREA * LENGTH / INERTIA  # 1/s^2
K_Z = 0.7 * P0 * AREA / (MASS * G0)  # g
A_N, B_N, C_N, D_N = 0.000103 / DEG**3, -0.00945 / DEG**2, -0.1696 / DEG, -0.034 / DEG  # force, per rad^k
A_M, B_M, C_M, D_M = 0.000215 / DEG**3, -0.0195 / DEG**2, 0.051 / DEG, -0.206 / DEG  # moment, per rad^k

OMEGA_F, ZETA_F = 150.0, 0.7  # rad/s, -: fin actuator
DELTA_MAX = 30 * DEG  # rad: fin command limit
TAU_J, L_J = 0.02, 6.0  # s; rad/s^2: jet lag, pitch acceleration at full jet
K1, L2, ALPHA_J = 0.45, 2.0, 8 * DEG  # -; rad/s^2; rad: scales of the fault functions
SIGMA = (0.10 * DEG, 0.50 * DEG, 0.1)  # rad, rad/s, g: sensors
CLIP = 4.0  # noise is bounded at so many standard deviations, as the threshold theory asks

OMEGA_R, ZETA_R = 8.0, 0.8  # rad/s, -: command prefilter
OMEGA_A = 4.0  # rad/s: slow loop
OMEGA_Q, ZETA_Q = 20.0, 0.8  # rad/s, -: fast loop
I_MAX = 30.0  # rad/s^2: limit of the fast loop's integral
JET_SHARE = 0.5  # of the desired pitch acceleration

MACH = 2.5  # of the study's scenario
LOG_RATE, LOG_RATE_HARD = np.log([0.15, 2.0]).tolist(), np.log([0.5, 3.0]).tolist()  # of 1/s: how fast a fault grows
ALPHA_MAX, Q_MAX = 20 * DEG, 5.0  # rad, rad/s: validity of the airframe data; loss of control
MODES = ("aero", "leak", "finloss", "stuck", "jetloss")  # labels 1 to 5
DITHER_PERIOD = 0.5  # s: of the jet, as a probe
ENTRIES = ("theta_aero", "theta_leak", "theta_finloss", "jam", "theta_jetloss")


@kernel
def force(alpha, mach, a, b, c):
    """C_n0 = sgn(alpha) [a |alpha|^3 + b |alpha|^2 + c (2 - M/3) |alpha|]."""
    return alpha * (a * alpha * alpha + b * abs(alpha) + c * (2.0 - mach / 3.0))


@kernel
def moment(alpha, mach, a, b, c):
    """C_m0 = sgn(alpha) [a |alpha|^3 + b |alpha|^2 + c (-7 + 8M/3) |alpha|]."""
    return alpha * (a * alpha * alpha + b * abs(alpha) + c * (-7.0 + 8.0 * mach / 3.0))


@kernel
def normal(mach, alpha, delta, theta, p):
    """C_n0 + d_n delta of the truth: coefficients off by rho, fin effectiveness lost."""
    C_n0 = force(alpha, mach, A_N * (1.0 + p[0]), B_N * (1.0 + p[1]), C_N * (1.0 + p[2]))
    return C_n0 + (1.0 - theta[2]) * D_N * (1.0 + p[6]) * delta


@kernel
def dynamics(t, x, u, theta, d, p, dx):
    """Airframe, fin and jet. A jammed fin stands still; `project` takes its rate away."""
    alpha, q, delta, delta_dot, jet = x[0], x[1], x[2], x[3], x[4]
    mach = MACH + d[0] + d[1] * t
    C_m0 = moment(alpha, mach, A_M * (1.0 + p[3]), B_M * (1.0 + p[4]), C_M * (1.0 + p[5]))
    C_m = C_m0 + (1.0 - theta[2]) * D_M * (1.0 + p[7]) * delta
    Z_1 = K1 * K_Q * mach * mach * abs(B_M) * alpha * abs(alpha)
    dx[0] = K_ALPHA * mach * sincos(alpha)[1] * normal(mach, alpha, delta, theta, p) + q
    dx[1] = K_Q * mach * mach * C_m + (1.0 - theta[4]) * L_J * jet + theta[0] * Z_1
    if theta[1] != 0.0:  # a tenth of the time of a flight would go into an exponential that counts for nothing
        Z_2 = L2 * np.exp(-((alpha / ALPHA_J) ** 2))
        dx[1] += theta[1] * Z_2
    dx[2], dx[3] = delta_dot, OMEGA_F * OMEGA_F * (u[0] - delta) - 2.0 * ZETA_F * OMEGA_F * delta_dot
    if theta[3] >= 0.5:
        dx[2], dx[3] = 0.0, 0.0
    dx[4] = (u[1] - jet) / TAU_J


@kernel
def jacobian(t, x, u, theta, d, p, J_x, J_theta, J_d, J_p):
    """Partial derivatives of `dynamics`."""
    alpha, delta, size = x[0], x[2], abs(x[0])
    mach = MACH + d[0] + d[1] * t
    sin_alpha, cos_alpha = sincos(alpha)
    fin, pitching, lifting = 1.0 - theta[2], K_Q * mach * mach, K_ALPHA * mach * cos_alpha
    a_n, b_n, c_n, d_n = A_N * (1.0 + p[0]), B_N * (1.0 + p[1]), C_N * (1.0 + p[2]), D_N * (1.0 + p[6])
    a_m, b_m, c_m, d_m = A_M * (1.0 + p[3]), B_M * (1.0 + p[4]), C_M * (1.0 + p[5]), D_M * (1.0 + p[7])
    C_n, C_m0 = normal(mach, alpha, delta, theta, p), moment(alpha, mach, a_m, b_m, c_m)
    C_m = C_m0 + fin * d_m * delta
    aero, leak = K1 * K_Q * abs(B_M) * alpha * size, L2 * np.exp(-((alpha / ALPHA_J) ** 2))

    by_alpha_n = 3.0 * a_n * alpha * alpha + 2.0 * b_n * size + c_n * (2.0 - mach / 3.0)
    by_alpha_m = 3.0 * a_m * alpha * alpha + 2.0 * b_m * size + c_m * (-7.0 + 8.0 * mach / 3.0)
    J_x[0, 0] = lifting * by_alpha_n - K_ALPHA * mach * sin_alpha * C_n
    J_x[0, 1], J_x[0, 2] = 1.0, lifting * fin * d_n
    J_x[1, 0] = pitching * (by_alpha_m + theta[0] * 2.0 * K1 * abs(B_M) * size)
    J_x[1, 0] -= theta[1] * leak * 2.0 * alpha / (ALPHA_J * ALPHA_J)
    J_x[1, 2], J_x[1, 4] = pitching * fin * d_m, (1.0 - theta[4]) * L_J
    if theta[3] < 0.5:
        J_x[2, 3], J_x[3, 2], J_x[3, 3] = 1.0, -OMEGA_F * OMEGA_F, -2.0 * ZETA_F * OMEGA_F
    J_x[4, 4] = -1.0 / TAU_J

    J_theta[0, 2] = -lifting * d_n * delta
    J_theta[1, 0], J_theta[1, 1] = aero * mach * mach, leak
    J_theta[1, 2], J_theta[1, 4] = -pitching * d_m * delta, -L_J * x[4]

    by_mach_n = K_ALPHA * cos_alpha * (C_n - mach * c_n * alpha / 3.0)
    by_mach_m = 2.0 * K_Q * mach * C_m + pitching * c_m * alpha * 8.0 / 3.0 + theta[0] * 2.0 * aero * mach
    J_d[0, 0], J_d[0, 1], J_d[1, 0], J_d[1, 1] = by_mach_n, by_mach_n * t, by_mach_m, by_mach_m * t

    cube, square = alpha * alpha * alpha, alpha * size
    J_p[0, 0], J_p[0, 1] = lifting * A_N * cube, lifting * B_N * square
    J_p[0, 2], J_p[0, 6] = lifting * C_N * (2.0 - mach / 3.0) * alpha, lifting * fin * D_N * delta
    J_p[1, 3], J_p[1, 4] = pitching * A_M * cube, pitching * B_M * square
    J_p[1, 5], J_p[1, 7] = pitching * C_M * (-7.0 + 8.0 * mach / 3.0) * alpha, pitching * fin * D_M * delta


@kernel
def project(x, theta):
    """A jammed fin has no rate."""
    if theta[3] >= 0.5:
        x[3] = 0.0


@kernel
def output(t, x, u, theta, d, p, y):
    """Incidence, pitch rate and normal load factor."""
    mach = MACH + d[0] + d[1] * t
    y[0], y[1] = x[0], x[1]
    y[2] = K_Z * mach * mach * normal(mach, x[0], x[2], theta, p)


@kernel
def known(t, r, c, out):
    """delta^, j^, M and alpha_r at the sample, before the command is computed."""
    out[0], out[1], out[2], out[3] = c[0], c[2], r[1], c[4]


@kernel
def command(t, y, r, law, c, u):
    """Two-time-scale inversion: slow loop alpha -> q_c, fast loop q -> v, allocated to jet and fin. Updates I.

    law[6:11] is the fault parameter that the inversion allows for, law[11] the amplitude of the jet's dither.
    """
    alpha, q, mach = y[0], y[1], r[1]
    delta_hat, alpha_r = c[0], c[4]
    fin, jet = 1.0 - law[8], 1.0 - law[10]
    C_n = force(alpha, mach, A_N, B_N, C_N) + fin * D_N * delta_hat
    q_c = OMEGA_A * (alpha_r - alpha) - K_ALPHA * mach * sincos(alpha)[1] * C_n
    e = q_c - q
    c[3] = min(max(c[3] + DT * OMEGA_Q * OMEGA_Q * e, -I_MAX), I_MAX)
    v = 2.0 * ZETA_Q * OMEGA_Q * e + c[3]
    if law[6] != 0.0 or law[7] != 0.0:
        v -= law[6] * K1 * K_Q * mach * mach * abs(B_M) * alpha * abs(alpha) + law[7] * L2 * np.exp(
            -((alpha / ALPHA_J) ** 2)
        )
    C_m0 = moment(alpha, mach, A_M, B_M, C_M)
    wanted = JET_SHARE * v / (jet * L_J)
    if law[9] >= 0.5:  # the fin stands still somewhere: all is left to the jet
        wanted = (v - K_Q * mach * mach * C_m0) / (jet * L_J)
    if law[11] > 0.0:
        wanted += law[11] * np.sin(2.0 * np.pi * t / DITHER_PERIOD)
    u[1] = min(max(wanted, -1.0), 1.0)
    delta_c = (v - jet * L_J * u[1] - K_Q * mach * mach * C_m0) / (K_Q * mach * mach * fin * D_M)
    u[0] = min(max(delta_c, -DELTA_MAX), DELTA_MAX)


def over_a_sample(*rows: tuple[float, ...]) -> tuple[float, ...]:
    """The matrix, row by row, that the plant's own Runge-Kutta steps of a sample make of z' = A z."""
    hA, one = DT / SUBSTEPS * np.array(rows), np.eye(len(rows))
    step = one + hA @ (one + hA / 2 @ (one + hA / 3 @ (one + hA / 4)))
    return tuple(np.linalg.matrix_power(step, SUBSTEPS).ravel().tolist())


FIN = over_a_sample((0.0, 1.0), (-OMEGA_F * OMEGA_F, -2.0 * ZETA_F * OMEGA_F))  # delta^ and its rate, about the command
JET = over_a_sample((-1.0 / TAU_J,))  # the plant's own steps, so that delta^ = delta without a fault


@kernel
def control(t, y, r, q, c, u):
    """The command, then one sample of what the computer models: c = (delta^, its rate, j^, I, alpha_r, its rate).

    r = (alpha_c, M). q holds the prefilter's exact zero-order-hold discretisation, row by row, then its input (6); the fault
    parameter that the inversion allows for (5); the amplitude of the jet's dither, against which the fin moves.
    """
    command(t, y, r, q, c, u)
    away, rate = c[0] - u[0], c[1]
    c[0], c[1] = u[0] + FIN[0] * away + FIN[1] * rate, FIN[2] * away + FIN[3] * rate
    c[2] = u[1] + JET[0] * (c[2] - u[1])
    alpha_r, alpha_r_dot = c[4], c[5]
    c[4] = q[0] * alpha_r + q[1] * alpha_r_dot + q[4] * r[0]
    c[5] = q[2] * alpha_r + q[3] * alpha_r_dot + q[5] * r[0]


@kernel
def outside(t, x, r):
    """The airframe data hold for |alpha| <= 20 deg; |q| > 5 rad/s is a lost missile."""
    return abs(x[0]) > ALPHA_MAX or abs(x[1]) > Q_MAX


def prefilter() -> np.ndarray:
    """The command prefilter's exact zero-order-hold discretisation: matrix row by row, then input vector (6,)."""
    block = np.zeros((3, 3))
    block[0, 1] = 1.0
    block[1] = -(OMEGA_R**2), -2 * ZETA_R * OMEGA_R, OMEGA_R**2
    M = scipy.linalg.expm(block * DT)
    return np.concatenate([M[:2, :2].ravel(), M[:2, 2]])


Incidence = Annotated[float, Meta(ge=-20.0, le=20.0)]  # deg: the airframe data end there
Mach = Annotated[float, Meta(ge=1.0, le=3.5)]
Share = Annotated[float, Meta(ge=-1.0, le=1.0)]


class Reference(msgspec.Struct, forbid_unknown_fields=True):
    """The commanded incidence [deg]: zero, a sine with a period [s], or levels that are held for so many samples each."""

    command: Literal["sine", "levels", "zero"] = "zero"
    amplitude: Incidence | UnsetType = UNSET
    period: Annotated[float, Meta(ge=DT, le=1e6)] | UnsetType = UNSET
    levels: Annotated[list[Incidence], Meta(min_length=1)] | UnsetType = UNSET
    holds: list[Annotated[int, Meta(ge=0, le=MAX_STEPS)]] | UnsetType = UNSET

    def __post_init__(self) -> None:
        only_with(self, "command", {"sine": ("amplitude", "period"), "levels": ("levels", "holds")})
        if self.levels is not UNSET and self.holds is not UNSET and len(self.levels) != len(self.holds):
            raise ValueError(f"levels and holds are of one length, not {len(self.levels)} and {len(self.holds)}")


class Flow(msgspec.Struct, forbid_unknown_fields=True):
    """Mach number at the start and at the end of the flight; 2.5 where it is not given."""

    mach: tuple[Mach, Mach] | UnsetType = UNSET


class Physical(msgspec.Struct, forbid_unknown_fields=True):
    """Relative errors rho_1..8; a shorter list leaves the rest exact."""

    rho: Annotated[list[Share], Meta(max_length=8)] | UnsetType = UNSET


def mach_of(scenario: FaultScenario) -> tuple[float, float]:
    """Mach number at the start and at the end of the flight, between which it runs linearly."""
    first, last = scenario.disturbance.get("mach", (MACH, MACH))
    return float(first), float(last)


def reference_rows(scenario: FaultScenario) -> np.ndarray:
    """r_k = (alpha_c [rad], M): the commanded incidence, a sine or a staircase, and the Mach number."""
    k = np.arange(scenario.steps + 1)
    rows = np.zeros((k.size, 2))
    wanted = scenario.reference
    if wanted.get("command", "zero") == "sine":
        rows[:, 0] = wanted["amplitude"] * np.sin(2 * np.pi * k * DT / wanted["period"]) * DEG
    elif wanted.get("command") == "levels":
        start = 0
        for level, hold in zip(wanted["levels"], wanted["holds"], strict=True):
            rows[start : start + hold, 0] = level * DEG
            start += hold
        rows[start:, 0] = wanted["levels"][-1] * DEG  # the last one stays
    first, last = mach_of(scenario)
    rows[:, 1] = first + (last - first) * k / scenario.steps
    return rows


def disturbance_rows(scenario: FaultScenario) -> np.ndarray:
    """d_k = (M(0) - 2.5, dM/dt), the same at every sample: the integrator needs M at its stages."""
    first, last = mach_of(scenario)
    return np.broadcast_to([first - MACH, (last - first) / (scenario.steps * DT)], (scenario.steps + 1, 2))


def measured_disturbance(t: float, before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """d of an interval from the Mach number, which is known at both ends."""
    first, last = before[..., 2], now[..., 2]
    rate = (last - first) / DT
    return np.stack([first - MACH - rate * t, rate], axis=-1)


def physical(changes: Mapping[str, Any]) -> np.ndarray:
    """p = rho_1..8; a shorter list leaves the rest exact."""
    rho = np.zeros(8)
    given = changes.get("rho", [])
    rho[: len(given)] = given
    return rho


def perturb(rng: np.random.Generator, level: float) -> dict[str, Any]:
    """rho_1..6 = level U(-1, 1); the fin's rho_7, rho_8 five eighths of that."""
    return {"rho": (level * rng.uniform(-1, 1, 8) * [1, 1, 1, 1, 1, 1, 0.625, 0.625]).tolist()}


def fault(label: int, size: float, rate: float, onset: int, end: int | None = None) -> Fault:
    """The fault of a label in 1..5: `size` is the final theta, `rate` gamma [1/s]; a jam has neither."""
    if label == 4:
        return Fault("stuck", "jam", onset, [Abrupt("jam", 1.0)], end)
    return Fault(MODES[label - 1], "incipient", onset, [Incipient(ENTRIES[label - 1], size, rate)], end)


def study(label: int = 1, size: float = 0.75, rate: float = 0.2, steps: int = STEPS) -> FaultScenario:
    """The study's scenario (label 1) and its mirror (label 2): onset at 10 s of a sine command, M 2.5, rho = 0."""
    sine = {"command": "sine", "amplitude": 10.75, "period": 13.0}
    return FaultScenario(plant=ID, steps=steps, faults=[fault(label, size, rate, 1000)], reference=sine)


def sample_standard(rng: np.random.Generator, fault_scale: float = 1.0) -> FaultScenario:
    """The randomised process: one permanent fault or none. The order of the draws is part of the data sheet."""
    label = int(rng.integers(0, 6))
    onset = round(uniform(rng, 4, 16) / DT)
    u = rng.random()
    sign = random_sign(rng)
    rate = float(np.exp(uniform(rng, *LOG_RATE)))
    size = {1: sign * (0.1 + 0.6 * u), 2: sign * (0.1 + 0.6 * u), 3: 0.05 + 0.35 * u, 5: 0.3 + 0.7 * u}.get(label, 0.0)
    size = size * fault_scale
    if label == 5:  # its parameter set ends at the whole jet
        size = min(size, 1.0)
    mach = uniform(rng, 1.5, 3)
    mach = [mach, max(1.5, mach - uniform(rng, 0, 0.5))]
    rho = rng.uniform(-0.05, 0.05, 6).tolist()
    faults = [fault(label, size, rate, onset)] if label else []
    return FaultScenario(
        plant=ID, steps=STEPS, faults=faults, reference=_levels(rng), disturbance={"mach": mach}, physical={"rho": rho}
    )


def _levels(rng: np.random.Generator) -> dict[str, Any]:
    """A staircase of commanded incidence: holds of U(1.5, 4) s, zero in 30 % of them, else U(-12, 12) deg."""
    k, levels, holds = 0, [], []
    while k < STEPS + 1:
        holds.append(round(uniform(rng, 1.5, 4) / DT))
        levels.append(0.0 if rng.random() < 0.3 else uniform(rng, -12, 12))
        k += holds[-1]
    return {"command": "levels", "levels": levels, "holds": holds}


def sample_hard(rng: np.random.Generator, fault_scale: float = 1.0) -> FaultScenario:
    """Two windows with a fault each, none in 10 % of the flights; a plant further off the model than is told."""
    faults = []
    if rng.random() >= 0.1:
        onset = round(uniform(rng, 3, 5) / DT)
        for _ in range(2):
            end = onset + round(uniform(rng, 2.5, 4.5) / DT)
            label, u, sign = int(rng.integers(1, 6)), rng.random(), random_sign(rng)
            size = {1: sign * (0.08 + 0.22 * u), 2: sign * (0.08 + 0.22 * u), 3: 0.05 + 0.15 * u, 5: 0.15 + 0.3 * u}
            rate = float(np.exp(uniform(rng, *LOG_RATE_HARD)))
            faults.append(fault(label, size.get(label, 0.0) * fault_scale, rate, onset, end))
            onset = end + round(uniform(rng, 2.5, 4) / DT)
    mach = uniform(rng, 1.5, 3)
    mach = [mach, max(1.5, mach - uniform(rng, 0, 0.5))]
    return FaultScenario(
        plant=ID, steps=STEPS, faults=faults, reference=_levels(rng), disturbance={"mach": mach},
        physical=perturb(rng, 0.08),
    )  # fmt: skip


def bounded_noise(rng: np.random.Generator, steps: int, noise_scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """No process noise (steps, 5); sensor noise (steps + 1, 3) clipped at 4 sigma, drawn sensor by sensor."""
    v = np.clip(rng.standard_normal((3, steps + 1)), -CLIP, CLIP).T * (noise_scale * np.array(SIGMA))
    return np.zeros((steps, 5)), np.ascontiguousarray(v)


def episode(seed: int) -> tuple[FaultScenario, tuple[np.ndarray, np.ndarray]]:
    """A flight of the randomised process with its noise from one generator: the data sheet's numbered episodes.

    The environments draw scenario and noise from separate streams; reproductions fly this pair with `simulate`.
    """
    rng = np.random.default_rng(seed)
    scenario = sample_standard(rng)
    return scenario, bounded_noise(rng, scenario.steps)


def _processes(fault_scale: float) -> list[FaultProcess]:
    def standard(rng: np.random.Generator) -> FaultScenario:
        return sample_standard(rng, fault_scale)

    def hard(rng: np.random.Generator) -> FaultScenario:
        return sample_hard(rng, fault_scale)

    return [
        FaultProcess(name="standard", description="one permanent fault, or none in one flight of six", sample=standard),
        FaultProcess(name="hard", description="intermittent faults, plant off the model by 8 %", sample=hard,
                     scoring=Scoring(start=200, grace=100)),
        FaultProcess(name="study", description="the study's: aero fault from 10 s on", sample=lambda rng: study()),
        FaultProcess(name="paper", description="the same as study", sample=lambda rng: study()),
        FaultProcess(name="mirror", description="the study's with the leak", sample=lambda rng: study(2)),
    ]  # fmt: skip


def _modes() -> tuple[FaultMode, ...]:
    about = (
        ("theta_aero in [-1.5, 1.5]", (-1.5, 1.5), (0.3, 0.5)),
        ("theta_leak in [-1.5, 1.5]", (-1.5, 1.5), (0.3, 0.5)),
        ("theta_finloss in [0, 0.8]", (0.0, 0.8), (0.17, 0.28)),
        ("jam = 1", (0.0, 1.0), (0.5, 0.75)),
        ("theta_jetloss in [0, 1]", (0.0, 1.0), (0.53, 0.77)),
    )  # bands: the thirds of the standard process, at fault_scale 1
    return tuple(
        FaultMode(
            mode, text, lambda theta, i=i: np.abs(theta[..., i]), bands, (0.0,) * 5, tuple(np.eye(5)[i].tolist()), reach
        )
        for i, (mode, (text, reach, bands)) in enumerate(zip(MODES, about, strict=True))
    )


def flight_cost(x: np.ndarray, u: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The incidence from what is commanded over 2 deg, and a tenth of fin over 15 deg and jet over 1, squared."""
    error, fin = (x[..., 0] - r[..., 0]) / (2 * DEG), u[..., 0] / (15 * DEG)
    return error**2 + 0.1 * (fin**2 + u[..., 1] ** 2)


PROBES = (
    Probe("dither", f"the jet by 0.2 at a period of {DITHER_PERIOD:g} s, and the fin against it: no moment without a fault",
          parameters=np.array([0.0] * 11 + [0.2])),
    Probe("incidence", "the commanded incidence by 1.5 deg, up and down for 0.5 s each",
          reference=square(100, (1.5 * DEG, 0.0))),
)  # fmt: skip


def plant(*, noise_scale: float = 1.0, fault_scale: float = 1.0) -> Plant:
    """Build the plant.

    Args:
        noise_scale: Factor on the sensor noise; filters are told. 0 for the study's noise-free scenarios.
        fault_scale: Factor on the sizes that the random processes draw; a jetloss stays within 1.

    Raises:
        ValueError: A scale out of range.
    """
    noise_scale, fault_scale = number("noise_scale", noise_scale, 0.0, 100.0), number("fault_scale", fault_scale, 1e-6, 2.0)
    sigma = [noise_scale * s for s in SIGMA]
    q = np.concatenate([prefilter(), np.zeros(6)])

    def accommodate(theta: np.ndarray) -> np.ndarray:
        """q (n, 12) for an estimated theta (n, 5): it is allowed for in the inversion, as far as the effectors go."""
        law = np.tile(q, (len(theta), 1))
        law[:, 6:11] = np.clip(theta, [-1.5, -1.5, 0.0, 0.0, 0.0], [1.5, 1.5, 0.8, 1.0, 0.8])
        return law

    reward = np.full((6, 6), -1.0)  # a wrong fault label, or one without a fault
    reward[1:, 0] = -0.5  # missed
    np.fill_diagonal(reward, 0.0)
    return Plant(
        id=ID, version=VERSION, options={"noise_scale": noise_scale, "fault_scale": fault_scale},
        description="Tail-controlled missile, pitch axis in closed loop: aerodynamic, fin and jet faults",
        dt=DT, substeps=SUBSTEPS,
        kernels=Kernels(dynamics, output, control, known, project, outside, jacobian),
        states=(
            Signal("alpha", "rad", -ALPHA_MAX, ALPHA_MAX, 0.35), Signal("q", "rad/s", -Q_MAX, Q_MAX, 1.0),
            Signal("delta", "rad", -np.pi / 4, np.pi / 4, 0.52), Signal("delta_dot", "rad/s", -150.0, 150.0, 5.0),
            Signal("jet", "", -1.0, 1.0, 1.0),
        ),
        outputs=(
            Signal("alpha", "rad", -0.7, 0.7, 0.35, sigma[0]), Signal("q", "rad/s", -10.0, 10.0, 1.0, sigma[1]),
            Signal("eta", "g", -100.0, 100.0, 20.0, sigma[2]),
        ),
        commands=(Signal("delta_c", "rad", -DELTA_MAX, DELTA_MAX, 0.52), Signal("j_c", "", -1.0, 1.0, 1.0)),
        known=(
            Signal("delta_hat", "rad", -np.pi / 4, np.pi / 4, 0.52), Signal("j_hat", "", -1.0, 1.0, 1.0),
            Signal("mach", "", 1.0, 3.5, 0.75, nominal=2.25), Signal("alpha_r", "rad", -0.7, 0.7, 0.35),
        ),
        disturbances=(Signal("mach_offset", "", -1.5, 1.0, 0.75), Signal("mach_rate", "1/s", -0.1, 0.1, 0.025)),
        theta=(
            Signal("theta_aero", "", -1.5, 1.5, 0.4), Signal("theta_leak", "", -1.5, 1.5, 0.4),
            Signal("theta_finloss", "", 0.0, 1.0, 0.23), Signal("jam", "", 0.0, 1.0, 1.0),
            Signal("theta_jetloss", "", 0.0, 1.0, 0.65),
        ),
        modes=_modes(),
        labels=(Label("none", frozenset()), *(Label(name, frozenset({name})) for name in MODES)),
        processes=_processes(fault_scale),
        c0=np.zeros(6), q=q, physical=physical, perturb=perturb,
        reference=reference_rows, disturbance=disturbance_rows, measured_disturbance=measured_disturbance,
        shapes=Shapes(Reference, Flow, Physical), noise_limit=CLIP, isolation_reward=reward,
        acting=Acting(flight_cost=flight_cost, lost=100.0, probes=PROBES, accommodate=accommodate),
    )  # fmt: skip
