"""Dual unscented Kalman filter: one filter for the state, with f held, and one for f, through the state's prediction.

The parameter filter sees only what f does within one step, and not what the accumulated error of the rate owes to it:
that is why the joint form is better on this plant. Otherwise as `joint_ukf`.

E. A. Wan, R. van der Merwe, A. T. Nelson, NIPS 12, 2000 (dual estimation); tuning: data sheet.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from baselines.filters.joint_ukf import N_SEEN, N_XI, joint_filter
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation.attitude import require_attitude, with_scalar
from baselines.filters.covariance_adaptation import BETA_0, EPS_R, MEMORY, Search, Trial, adapt
from fdi_gym.estimation.effectiveness import F_MAX, F_MIN, P_THETA, Q_THETA, THRESHOLD, threshold_rule
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.unscented import covariance, mean_and_deviations, sigma_points, weights
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.cmg_satellite import SIGMA_Q


class DualUKF(NamedTuple):
    """The filters' state."""

    k: int  # samples seen
    xi: Array  # (n, 10)
    P: Array  # (n, 10, 10)
    f: Array  # (n, 4)
    P_f: Array  # (n, 4, 4)
    sign: Array  # (n,) sign of q4 at the last sample
    beta: Array  # (n,) weighted mean of the innovation statistic
    adapted: Array  # (n,) steps adapted so far


def moved(plant: Plant, xi: Array, sign: Array, u: Array, f: Array) -> Array:
    """F(xi, s, r, f): points xi (n, p, 10) one step on; f has n rows of one or p effectiveness vectors."""
    x = plant.propagate(0.0, with_scalar(xi, sign), u, f)
    return np.concatenate([x[..., :3], x[..., 4:]], axis=-1)


class StateStep(NamedTuple):
    """Outcome of a step of the state filter."""

    xi: Array  # (n, 10)
    P: Array  # (n, 10, 10)
    S: Array  # (n, 10, 10) innovation covariance
    b: Array  # (n,) sum of r_i^2 / S_ii over attitude and rate


def state_step(plant: Plant, Q: Array, R: Array, s: DualUKF, y: Array, u: Array) -> StateStep:
    """A step of the state filter with f held at its last estimate."""
    w = weights(N_XI)
    points = moved(plant, sigma_points(s.xi, s.P), s.sign, u, s.f)
    predicted, deviations = mean_and_deviations(points, w)
    P = covariance(deviations, deviations, w) + Q
    S = P + R
    K = right_divide(P, S)
    r = y - predicted
    b = (r[:, :N_SEEN] ** 2 / np.einsum("nii->ni", S)[:, :N_SEEN]).sum(axis=1)
    return StateStep(predicted + times(K, r), symmetric(P - K @ T(P)), S, b)


def parameter_step(
    plant: Plant, f: Array, P: Array, xi: Array, S: Array, y: Array, sign: Array, u: Array
) -> tuple[Array, Array]:
    """f and its covariance, from P before the measurement, the state filter's last estimate xi and new covariance S."""
    w = weights(4)
    points = sigma_points(f, P)
    seen = moved(plant, np.repeat(xi[:, None], points.shape[1], axis=1), sign, u, points)
    mean, deviations = mean_and_deviations(seen, w)
    Pdd = covariance(deviations, deviations, w) + S
    K = right_divide(covariance(points - f[:, None], deviations, w), Pdd)
    return f + times(K, y - mean), symmetric(P - K @ Pdd @ T(K))


def dual_filter(
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
    """The dual filter as a diagnoser, with a search that adapts the parameter filter's covariance, or none."""
    require_attitude(plant)
    Q, Q_f = sigma_q**2 * np.eye(N_XI), q_theta * np.eye(4)
    R = plant.R[:N_XI, :N_XI] if sigma_r is None else sigma_r**2 * np.eye(N_XI)
    r_inv = 1.0 / np.diag(R)[:N_SEEN]
    decide = threshold_rule(plant, threshold)

    def init(n: int) -> DualUKF:
        return DualUKF(
            0, np.zeros((n, N_XI)), np.tile(R, (n, 1, 1)), np.ones((n, 4)), np.tile(p_theta * np.eye(4), (n, 1, 1)),
            np.ones(n), np.zeros(n), np.zeros(n, np.int64),
        )  # fmt: skip

    def update(s: DualUKF, obs: Array) -> tuple[DualUKF, Diagnosis]:
        y, u, _ = plant.split(obs)
        y, sign = y[:, :N_XI], y[:, N_XI].copy()
        if s.k == 0:  # no interval has ended: the filters start from the first measurement
            s = s._replace(k=1, xi=y.copy(), sign=sign)
            return s, decide(s.f, s.P_f, np.zeros(len(obs), bool))
        new = state_step(plant, Q, R, s, y, u)
        prior = s.P_f + Q_f
        f, P_f = parameter_step(plant, s.f, prior, s.xi, new.S, y, s.sign, u)
        beta = s.beta + (new.b - s.beta) / MEMORY
        flag = (beta > beta_0) & (s.k > MEMORY + 1)
        adapted = s.adapted
        if search is not None and flag.any():
            up = np.flatnonzero(flag)

            def run(rows: Array, P_c: Array) -> Trial:
                at = up[rows]
                f_c, P = parameter_step(plant, s.f[at], P_c, s.xi[at], new.S[at], y[at], s.sign[at], u[at])
                x_c = moved(plant, s.xi[at, None], s.sign[at], u[at], f_c)[:, 0]
                return Trial(f_c, P, (y[at, :N_SEEN] - x_c[:, :N_SEEN]) ** 2 @ r_inv, P_c)

            kept = adapt(search, prior[up], adapted[up], run, n_pass, eps_r)
            f[up], P_f[up] = kept.x, kept.P
            adapted = adapted + flag
        f = np.clip(f, F_MIN, F_MAX)
        return DualUKF(s.k + 1, new.xi, new.P, f, P_f, sign, beta, adapted), decide(f, P_f, flag)

    return Diagnoser(init, update)


def filter_of(form: str) -> tuple[Callable[..., Diagnoser], int]:
    """The filter of a form, and where the effectiveness begins in the covariance that its adaptation raises.

    Raises:
        ValueError: Unknown form.
    """
    if form not in ("joint", "dual"):
        raise ValueError(f"unknown form {form!r}; there are joint, dual")
    return (joint_filter, N_XI) if form == "joint" else (dual_filter, 0)


@diagnoser("dual_ukf", "Dual unscented Kalman filters of state and effectiveness")
def dual_ukf(
    plant: Plant,
    *,
    q_theta: float = Q_THETA,
    sigma_q: float = SIGMA_Q,
    p_theta: float = P_THETA,
    sigma_r: float | None = None,
    threshold: float = THRESHOLD,
) -> Diagnoser:
    """The dual filter without adaptation; arguments as in `joint_ukf`.

    Raises:
        NotApplicableError: The plant has no attitude.
    """
    return dual_filter(plant, q_theta=q_theta, sigma_q=sigma_q, p_theta=p_theta, sigma_r=sigma_r, threshold=threshold)
