"""Episodes per second of the missile's estimators: batched, against a plain per-episode NumPy form of the EKF bank.

    python benchmarks/missile_bank.py [--episodes 600] [--plain 2]

Everything runs in one process, on one thread; both forms see the same flights and must say the same.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import platform
import time
from dataclasses import dataclass

import numpy as np
import tyro

from baselines.filters.augmented_ekf_bank import augmented_ekf_bank
from baselines.filters.missile_ekf import Q_THETA, SIGMA_RHO, SIGMA_THETA, THETA_MAX, THETA_MIN
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.engine import simulate
from fdi_gym.plants import missile_pitch as m

DEG = np.pi / 180
R = np.diag(np.square(m.SIGMA[:2]))


@dataclass
class Arguments:
    episodes: int = 600
    """Flights shown to the batched form."""
    plain: int = 2
    """Flights shown to the plain form."""


def rates(z, delta, jet, mach, label):
    """f and its Jacobian for one hypothesis of one episode."""
    alpha, q, theta, r = z[0], z[1], z[2], z[3:]
    a = abs(alpha)
    C_n = alpha * (m.A_N * a**2 + m.B_N * a + m.C_N * (2 - mach / 3))
    slope_n = 3 * m.A_N * a**2 + 2 * m.B_N * a + m.C_N * (2 - mach / 3)
    slope_m = 3 * m.A_M * a**2 + 2 * m.B_M * a + m.C_M * (-7 + 8 * mach / 3)
    k_a, k_q = m.K_ALPHA * mach, m.K_Q * mach**2
    D = k_q * np.array([m.A_M * alpha**3, m.B_M * alpha * a, m.C_M * (-7 + 8 * mach / 3) * alpha])
    force = C_n + m.D_N * delta
    fin = np.array([k_a * np.cos(alpha) * m.D_N, k_q * m.D_M])
    f = np.array([k_a * np.cos(alpha) * force + q, D.sum() + k_q * m.D_M * delta + m.L_J * jet + r @ D, 0, 0, 0, 0])
    F = np.zeros((6, 6))
    F[0, 0] = k_a * (np.cos(alpha) * slope_n - np.sin(alpha) * force)
    F[0, 1] = 1
    F[1, 0] = k_q * slope_m
    F[1, 3:] = D
    Z = np.zeros(2)
    if label == 1:
        Z[1] = m.K1 * k_q * abs(m.B_M) * alpha * a
        F[1, 0] += theta * 2 * m.K1 * k_q * abs(m.B_M) * a
    elif label == 2:
        Z[1] = m.L2 * np.exp(-((alpha / m.ALPHA_J) ** 2))
        F[1, 0] -= 2 * theta * Z[1] * alpha / m.ALPHA_J**2
    elif label == 3:
        Z = -fin * delta
    elif label == 4:
        Z = fin
        f[:2] -= fin * delta
    elif label == 5:
        Z[1] = -m.L_J * jet
    f[:2] += theta * Z
    F[:2, 2] = Z
    return f, F


def plain_bank(obs):
    """Likelihood ratios of labels 1..5 at the end of one flight, obs (K + 1, 9)."""
    H, J = np.eye(2, 6), np.zeros(6)
    z, P = np.zeros((6, 6)), np.zeros((6, 6, 6))
    for k, row in enumerate(obs):
        y, (delta, jet, mach) = row[:2], row[5:8]
        for label in range(6):
            if k == 0:
                z[label, :2] = y
                P[label] = np.diag([R[0, 0], R[1, 1], SIGMA_THETA[label] ** 2, *[SIGMA_RHO**2] * 3])
            else:
                (y0, (d0, j0, mach0)) = obs[k - 1][:2], obs[k - 1][5:8]
                a = abs(y0[0])
                bound = 0.05 * m.K_ALPHA * mach0 * np.cos(y0[0]) * (
                    abs(m.A_N) * a**3 + abs(m.B_N) * a**2 + abs(m.C_N) * abs(2 - mach0 / 3) * a)  # fmt: skip
                f1, F1 = rates(z[label], d0, j0, mach0, label)
                f2, F2 = rates(z[label] + m.DT * f1, delta, jet, mach, label)
                E = m.DT * (F1 + F2) / 2
                Phi = np.eye(6) + E + E @ E / 2
                z[label] += m.DT * (f1 + f2) / 2
                noise = m.DT * np.array([(0.577 * bound) ** 2 * 0.5 + 1e-8, 1e-5, Q_THETA[label], 0, 0, 0])
                P[label] = Phi @ P[label] @ Phi.T + np.diag(noise)
            v = y - z[label, :2]
            S = H @ P[label] @ H.T + R
            K = P[label] @ H.T @ np.linalg.inv(S)
            z[label] += K @ v
            z[label, 2] = np.clip(z[label, 2], THETA_MIN[label], THETA_MAX[label])
            P[label] -= K @ H @ P[label]
            P[label] = (P[label] + P[label].T) / 2
            J[label] = 0.995 * J[label] - 0.5 * (v @ np.linalg.solve(S, v) + np.log(np.linalg.det(S)))
    return J[1:] - J[0]


def timed(function, *arguments):
    begin = time.perf_counter()
    found = function(*arguments)
    return found, time.perf_counter() - begin


def main(arguments: Arguments) -> None:
    plant = m.plant()
    scenarios, noise = zip(*(m.episode(10000 + i) for i in range(arguments.episodes)), strict=True)
    simulate(plant, scenarios[:1], noise[:1])  # compiled, or read from the cache
    record, flying = timed(simulate, plant, scenarios, noise)

    def batched(obs):
        state = bank.init(len(obs))
        for k in range(obs.shape[1]):
            state, said = bank.update(state, obs[:, k])
        return said.signals["log-likelihood ratios"]

    bank = augmented_ekf_bank(plant)
    plain, slow = timed(lambda: np.array([plain_bank(obs) for obs in record.obs[: arguments.plain]]))
    rows = [("plain NumPy, episode by episode", arguments.plain, slow)]
    for n in dict.fromkeys((1, min(50, arguments.episodes), arguments.episodes)):
        llr, seconds = timed(batched, record.obs[:n])
        rows.append((f"batched, {n} at once", n, seconds))
    shown = min(arguments.plain, len(llr))
    error = np.abs(llr[:shown] - plain[:shown]).max() / np.abs(plain[:shown]).max()
    print(f"{platform.processor() or platform.machine()}, one thread; {record.obs.shape[1]} samples an episode")
    print(f"flying alone: {arguments.episodes / flying:.0f} episodes/s\n")
    print(f"{'whole EKF bank, six hypotheses':34s} {'episodes/s':>10s} {'us a sample':>12s} {'against plain':>14s}")
    for name, n, seconds in rows:
        speed = n / seconds
        print(f"{name:34s} {speed:10.2f} {1e6 / speed / record.obs.shape[1]:12.1f} {speed * slow / arguments.plain:13.1f}x")
    for name in ("gos", "augmented_ekf_imm"):
        _, seconds = timed(run, make_diagnoser(name, plant), record.obs)
        print(f"{name + ', all at once':34s} {arguments.episodes / seconds:10.2f}")
    print(f"\nlargest relative difference of the likelihood ratios between the two forms: {error:.1e}")
    assert error < 1e-8


if __name__ == "__main__":
    main(tyro.cli(Arguments))
