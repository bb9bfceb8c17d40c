"""Dual unscented Kalman filter: one filter for the state, with f held, and one for f, through the state's prediction.

The parameter filter sees only what f does within one step, and not what the accumulated error of the rate owes to it:
that is why the joint form is better on this plant. Otherwise as `joint_ukf`.

E. A. Wan, R. van der Merwe, A. T. Nelson, NIPS 12, 2000 (dual estimation); tuning: data sheet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters.attitude import require_attitude, taken, with_scalar, without_scalar
from baselines.filters.covariance_adaptation import BETA_0, FaultFlag, Search, Trial, flagged, unflagged
from baselines.filters.effectiveness import F_MAX, F_MIN, P_THETA, Q_THETA, THRESHOLD, threshold_rule
from baselines.filters.joint_ukf import N_SEEN, N_XI, Attitude, corrected, expected, reading_of, wide_prior
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import Corrected, correct
from fdi_gym.estimation.sigma_points import covariance, mean_and_deviations, unscented_points, weights
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.cmg_satellite import SIGMA_Q


class DualUKF(NamedTuple):
    """The filters' state."""

    now: Attitude  # (n, 10)
    before: Attitude  # before the last prediction
    f: Array  # (n, 4)
    P_f: Array  # (n, 4, 4)
    known: Array  # (n, 10) bool: the sensors that have reported
    flag: FaultFlag
    adapted: Array  # (n,) steps adapted so far
    nu: Array  # (n, 10) last innovation of the state filter
    S: Array  # (n, 10, 10) its covariance
    seen: Array  # (n,) sensors in it


def moved(plant: Plant, xi: Array, sign: Array, u: Array, f: Array) -> tuple[Array, Array]:
    """F(xi, s, r, f): points xi (n, p, 10) one step on, and their signs; f has n rows of one or p effectiveness vectors."""
    return without_scalar(plant.propagate(0.0, with_scalar(xi, sign), u, f))


def parameters_corrected(
    plant: Plant, f: Array, P: Array, s: Attitude, S: Array, y: Array, seen: Array, u: Array
) -> Corrected:
    """f, from its P before the measurement, the state s before the interval and the state filter's covariance S."""
    points, w = unscented_points(f, P), weights(4)
    images, _ = moved(plant, np.repeat(s.x[:, None], points.shape[1], axis=1), s.sign, u, points)
    mean, deviations = mean_and_deviations(images, w)
    cross = covariance(points - f[:, None], deviations, w)
    return correct(f, P, y - mean, cross, covariance(deviations, deviations, w) + S, seen)


def dual_filter(
    plant: Plant,
    search: Search | None = None,
    *,
    beta_0: float = BETA_0,
    q_theta: float = Q_THETA,
    sigma_q: float = SIGMA_Q,
    p_theta: float = P_THETA,
    sigma_r: float | None = None,
) -> Filter:
    """The dual filter, with a search that adapts the parameter filter's covariance, or none."""
    require_attitude(plant)
    Q, Q_f = sigma_q**2 * np.eye(N_XI), q_theta * np.eye(4)
    R = plant.R[:N_XI, :N_XI] if sigma_r is None else sigma_r**2 * np.eye(N_XI)
    r_inv = 1.0 / np.diag(R)[:N_SEEN]
    x0, variance, sign0 = wide_prior(plant)

    def start(n: int) -> DualUKF:
        now = Attitude(np.tile(x0, (n, 1)), np.tile(np.diag(variance), (n, 1, 1)), np.full(n, float(sign0)))
        return DualUKF(
            now, now, np.ones((n, 4)), np.tile(p_theta * np.eye(4), (n, 1, 1)), np.zeros((n, N_XI), bool), unflagged(n),
            np.zeros(n, np.int64), np.zeros((n, N_XI)), np.tile(R, (n, 1, 1)), np.zeros(n, np.int64),
        )  # fmt: skip

    def predict(s: DualUKF, at: Interval) -> DualUKF:
        points, sign = moved(plant, unscented_points(s.now.x, s.now.P), s.now.sign, at.u, s.f)
        w = weights(N_XI)
        mean, deviations = mean_and_deviations(points, w)
        now = Attitude(mean, covariance(deviations, deviations, w) + Q, sign[:, 0])
        return s._replace(now=now, before=s.now, P_f=s.P_f + Q_f)

    def update(s: DualUKF, at: Interval, y: Array, seen: Array) -> DualUKF:
        sign = np.where(seen[:, N_XI], y[:, N_XI], s.now.sign)
        y, seen = y[:, :N_XI], seen[:, :N_XI]
        used = seen & s.known
        done, S = corrected(R, s.now, y, used), s.now.P + R
        found = parameters_corrected(plant, s.f, s.P_f, s.before, S, y, used, at.u)
        counts: Array = np.any(used[:, :N_SEEN], axis=1)
        each = np.where(used, done.nu, 0.0)[:, :N_SEEN] ** 2 / np.einsum("nii->ni", S)[:, :N_SEEN]
        flag = flagged(s.flag, (each + ~used[:, :N_SEEN]).sum(axis=1), counts, beta_0)
        f, P_f, raised, adapted = found.x, found.P, flag.up & counts, s.adapted
        if search is not None and raised.any():
            up = np.flatnonzero(raised)

            def run(rows: Array, P_c: Array) -> Trial:
                i = up[rows]
                before = Attitude(s.before.x[i], s.before.P[i], s.before.sign[i])
                tried = parameters_corrected(plant, s.f[i], P_c, before, S[i], y[i], used[i], at.u[i])
                x_c = moved(plant, before.x[:, None], before.sign, at.u[i], tried.x)[0][:, 0]
                residual = np.where(used[i, :N_SEEN], y[i, :N_SEEN] - x_c[:, :N_SEEN], 0.0)
                return Trial(tried.x, tried.P, residual**2 @ r_inv, P_c)

            kept = search(s.P_f[up], adapted[up], run)
            f[up], P_f[up] = kept.x, kept.P
            adapted = adapted + raised
        x, P = taken(done.x, done.P, y, np.diag(R), seen & ~s.known)
        return DualUKF(
            Attitude(x, P, sign), s.before, np.clip(f, F_MIN, F_MAX), P_f, s.known | seen, flag, adapted, done.nu, done.S,
            used.sum(axis=1),
        )  # fmt: skip

    def read(s: DualUKF) -> Reading:
        return reading_of(s.f, s.P_f, s.now, s.flag, s.adapted, s.nu, s.S, s.seen)

    return Filter(start, predict, update, read, expect=lambda s, at: expected(s.now.x, s.known, s.now.sign))


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
    filter = dual_filter(plant, q_theta=q_theta, sigma_q=sigma_q, p_theta=p_theta, sigma_r=sigma_r)
    return diagnoser_of(plant, filter, threshold_rule(plant, threshold))
