"""Joint unscented Kalman filter of state and effectiveness, and the frame in which its covariance is adapted.

x = (q1..q3, w, d, f): the effectiveness f is appended to the state as a random walk. Once it is known well, a jump of f
is followed slowly; the methods that cure this (`caukf`, `gaukf`, `sgaukf`) give a search that raises its variance while
the fault flag is up. Flag: the exponentially weighted mean of the innovation statistic of attitude and rate exceeds
beta_0.

A. Rahimi, K. D. Kumar, H. Alighanbari, Mechanical Systems and Signal Processing 135, 2020, 106419; tuning: data sheet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation.attitude import require_attitude, with_scalar
from baselines.filters.covariance_adaptation import BETA_0, EPS_R, MEMORY, Search, Trial, adapt
from fdi_gym.estimation.effectiveness import F_MAX, F_MIN, P_THETA, Q_THETA, THRESHOLD, threshold_rule
from fdi_gym.estimation.kalman import T, symmetric, times
from fdi_gym.estimation.unscented import covariance, mean_and_deviations, sigma_points, weights
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.cmg_satellite import SIGMA_Q

N_XI, N_X, N_SEEN = 10, 14, 6  # (q_v, w, d); with f; the channels that carry fault information: q_v and w


class JointUKF(NamedTuple):
    """The filter's state."""

    k: int  # samples seen
    x: Array  # (n, 14)
    P: Array  # (n, 14, 14)
    sign: Array  # (n,) sign of q4 at the last sample
    beta: Array  # (n,) weighted mean of the innovation statistic
    adapted: Array  # (n,) steps adapted so far


class Step(NamedTuple):
    """Outcome of one step."""

    x: Array  # (n, 14), f not clipped
    P: Array  # (n, 14, 14)
    predicted: Array  # (n, 14) before the measurement
    b: Array  # (n,) r6' (S^-1)[6, 6] r6 of the innovations of attitude and rate


def step(plant: Plant, Q: Array, R: Array, x: Array, P: Array, y: Array, sign: Array, u: Array) -> Step:
    """One step of the joint filter: y (n, 10) ends the interval of the command u; sign is that of its start."""
    w = weights(N_X)
    points = sigma_points(x, P)
    moved = plant.propagate(0.0, with_scalar(points[..., :N_XI], sign), u, points[..., N_XI:])
    points[..., :3], points[..., 3:N_XI] = moved[..., :3], moved[..., 4:]
    predicted, deviations = mean_and_deviations(points, w)
    P = covariance(deviations, deviations, w) + Q
    Pxy = P[:, :, :N_XI]
    innovation = y - predicted[:, :N_XI]
    seen = innovation.copy()
    seen[:, N_SEEN:] = 0.0
    solved = np.linalg.solve(Pxy[:, :N_XI] + R, np.concatenate([T(Pxy), seen[..., None]], axis=2))
    K = T(solved[..., :N_X])
    return Step(
        predicted + times(K, innovation), symmetric(P - K @ T(Pxy)), predicted,
        np.einsum("ni,ni->n", seen, solved[..., N_X]),
    )  # fmt: skip


def joint_filter(
    plant: Plant,
    search: Search | None = None,
    *,
    beta_0: float = BETA_0,
    q_theta: float = Q_THETA,
    sigma_q: float = SIGMA_Q,
    p_theta: float = P_THETA,
    sigma_r: float | None = None,
    threshold: float = THRESHOLD,
    n_pass: int = 1,
    eps_r: float = EPS_R,
) -> Diagnoser:
    """The joint filter as a diagnoser, with a search that adapts its covariance, or none."""
    require_attitude(plant)
    Q = np.diag([sigma_q**2] * N_XI + [q_theta] * 4)
    R = plant.R[:N_XI, :N_XI] if sigma_r is None else sigma_r**2 * np.eye(N_XI)
    r_inv = 1.0 / np.diag(R)[:N_SEEN]
    P_0 = np.diag([*np.diag(R), *[p_theta] * 4])
    decide = threshold_rule(plant, threshold)

    def init(n: int) -> JointUKF:
        x = np.concatenate([np.zeros((n, N_XI)), np.ones((n, 4))], axis=1)
        return JointUKF(0, x, np.tile(P_0, (n, 1, 1)), np.ones(n), np.zeros(n), np.zeros(n, np.int64))

    def update(s: JointUKF, obs: Array) -> tuple[JointUKF, Diagnosis]:
        y, u, _ = plant.split(obs)
        y, sign = y[:, :N_XI], y[:, N_XI].copy()
        if s.k == 0:  # no interval has ended: the filter starts from the first measurement
            s = s._replace(k=1, x=np.concatenate([y, s.x[:, N_XI:]], axis=1), sign=sign)
            return s, decide(s.x[:, N_XI:], s.P[:, N_XI:, N_XI:], np.zeros(len(obs), bool))
        plain = step(plant, Q, R, s.x, s.P, y, s.sign, u)
        beta = s.beta + (plain.b - s.beta) / MEMORY
        flag = (beta > beta_0) & (s.k > MEMORY + 1)
        x, P, adapted = plain.x, plain.P, s.adapted
        if search is not None and flag.any():
            up = np.flatnonzero(flag)

            def run(rows: Array, P_c: Array) -> Trial:
                at = up[rows]
                tried = step(plant, Q, R, s.x[at], P_c, y[at], s.sign[at], u[at])
                residual = y[at, :N_SEEN] - tried.x[:, :N_SEEN]
                return Trial(tried.x, tried.P, residual**2 @ r_inv, P_c)

            kept = adapt(search, s.P[up], adapted[up], run, n_pass, eps_r)
            x[up], P[up] = kept.x, kept.P
            adapted = adapted + flag
        x[:, N_XI:] = np.clip(x[:, N_XI:], F_MIN, F_MAX)
        return JointUKF(s.k + 1, x, P, sign, beta, adapted), decide(x[:, N_XI:], P[:, N_XI:, N_XI:], flag)

    return Diagnoser(init, update)


@diagnoser("joint_ukf", "Joint unscented Kalman filter of state and effectiveness")
def joint_ukf(
    plant: Plant,
    *,
    q_theta: float = Q_THETA,
    sigma_q: float = SIGMA_Q,
    p_theta: float = P_THETA,
    sigma_r: float | None = None,
    threshold: float = THRESHOLD,
) -> Diagnoser:
    """The joint filter without adaptation.

    Args:
        plant: The satellite.
        q_theta: Variance that each effectiveness gains per step.
        sigma_q: Process noise of the other ten states, per step.
        p_theta: Initial variance of each effectiveness.
        sigma_r: Standard deviation of all ten sensors that the filter believes in (the source: 1e-4). None: the true ones.
        threshold: A unit that has lost more is called faulty.

    Raises:
        NotApplicableError: The plant has no attitude.
    """
    return joint_filter(plant, q_theta=q_theta, sigma_q=sigma_q, p_theta=p_theta, sigma_r=sigma_r, threshold=threshold)
