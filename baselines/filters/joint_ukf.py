"""Joint unscented Kalman filter of state and effectiveness, and the frame in which its covariance is adapted.

x = (q1..q3, w, d, f): the effectiveness f is appended to the state as a random walk. Once it is known well, a jump of f
is followed slowly; the methods that cure this (`covariance_adaptive_ukf`) give a search that raises its variance while
the fault flag is up. Flag: the exponentially weighted mean of the innovation statistic of attitude and rate exceeds
beta_0. An entry of the state that no sensor has reported yet has a wide prior; the first report is taken as it is.

A. Rahimi, K. D. Kumar, H. Alighanbari, Mechanical Systems and Signal Processing 135, 2020, 106419; tuning: data sheet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters import attitude_kernels
from baselines.filters.attitude import require_attitude, taken, with_scalar, without_scalar
from baselines.filters.covariance_adaptation import BETA_0, FaultFlag, Search, Trial, flagged, unflagged
from baselines.filters.effectiveness import F_MAX, F_MIN, P_THETA, Q_THETA, THRESHOLD, threshold_rule
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import Corrected, correct, quadratic
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.cmg_satellite import SIGMA_Q

N_XI, N_X, N_SEEN = 10, 14, 6  # (q_v, w, d); with f; the channels that carry fault information: q_v and w


class Attitude(NamedTuple):
    """A Gaussian of (q_v, w, d), or of these and f, and the hemisphere of the quaternion."""

    x: Array  # (n, 10) or (n, 14)
    P: Array
    sign: Array  # (n,) sign of q4


class JointUKF(NamedTuple):
    """The filter's state."""

    now: Attitude
    before: Attitude  # before the last prediction
    known: Array  # (n, 10) bool: the sensors that have reported
    flag: FaultFlag
    adapted: Array  # (n,) steps adapted so far
    nu: Array  # (n, 10) last innovation
    S: Array  # (n, 10, 10) its covariance
    seen: Array  # (n,) sensors in it


def predicted(plant: Plant, Q: Array, s: Attitude, u: Array) -> Attitude:
    """x (n, 14) one interval later, under the command u: the unscented transform, lambda = 2, with equal weights."""
    x, P, sign = np.empty(s.x.shape), np.empty(s.P.shape), np.empty(len(s.x))
    attitude_kernels.predict(
        plant.addresses.lanes, plant.dt, plant.substeps, plant.nominal_p, contiguous(s.x), contiguous(s.P), s.sign,
        contiguous(u), Q, x, P, sign,
    )  # fmt: skip
    return Attitude(x, P, sign)


def corrected(R: Array, s: Attitude, y: Array, seen: Array) -> Corrected:
    """Update with the sensors (n, 10) that reported."""
    cross = s.P[:, :, :N_XI]
    return correct(s.x, s.P, y - s.x[:, :N_XI], cross, cross[:, :N_XI] + R, seen)


def statistic(nu: Array, S: Array, seen: Array) -> Array:
    """r6' (S^-1)[6, 6] r6 (n,) of attitude and rate; a sensor that is missing counts with its expectation."""
    return quadratic(np.where(np.arange(N_XI) < N_SEEN, nu, 0.0), S) + (~seen[:, :N_SEEN]).sum(axis=1)


def wide_prior(plant: Plant) -> tuple[Array, Array, Array]:
    """x (10,), its variance and the sign of q4 as long as no sensor has reported: the trim, and the typical sizes."""
    x, sign = without_scalar(plant.trim_state)
    return x, np.delete([s.scale**2 for s in plant.states], 3), sign


def expected(x: Array, known: Array, sign: Array) -> Array:
    """What the sensors are expected to read (n, 11); NaN where none has reported."""
    begun = np.column_stack([known, known[:, :3].any(axis=1)])
    return np.where(begun, np.column_stack([x[:, :N_XI], sign]), np.nan)


def reading_of(
    f: Array, P_f: Array, s: Attitude, flag: FaultFlag, adapted: Array, nu: Array, S: Array, seen: Array
) -> Reading:
    """What an unscented filter of the satellite knows."""
    x = with_scalar(s.x[:, None, :N_XI], s.sign)[:, 0]
    signals = {"flag": flag.up, "statistic": flag.beta, "adapted": adapted}
    return Reading(f - 1.0, P_f, x, None, nu, S, seen, signals=signals)


def joint_filter(
    plant: Plant,
    search: Search | None = None,
    *,
    beta_0: float = BETA_0,
    q_theta: float = Q_THETA,
    sigma_q: float = SIGMA_Q,
    p_theta: float = P_THETA,
    sigma_r: float | None = None,
) -> Filter:
    """The joint filter, with a search that adapts its covariance, or none."""
    require_attitude(plant)
    Q = np.diag([sigma_q**2] * N_XI + [q_theta] * 4)
    R = plant.R[:N_XI, :N_XI] if sigma_r is None else sigma_r**2 * np.eye(N_XI)
    r_inv = 1.0 / np.diag(R)[:N_SEEN]
    x0, variance, sign0 = wide_prior(plant)

    def start(n: int) -> JointUKF:
        x, P = np.tile([*x0, 1.0, 1.0, 1.0, 1.0], (n, 1)), np.tile(np.diag([*variance, *[p_theta] * 4]), (n, 1, 1))
        now = Attitude(x, P, np.full(n, float(sign0)))
        return JointUKF(
            now, now, np.zeros((n, N_XI), bool), unflagged(n), np.zeros(n, np.int64), np.zeros((n, N_XI)),
            np.tile(R, (n, 1, 1)), np.zeros(n, np.int64),
        )  # fmt: skip

    def predict(s: JointUKF, at: Interval) -> JointUKF:
        return s._replace(now=predicted(plant, Q, s.now, at.u), before=s.now)

    def update(s: JointUKF, at: Interval, y: Array, seen: Array) -> JointUKF:
        sign = np.where(seen[:, N_XI], y[:, N_XI], s.now.sign)
        y, seen = y[:, :N_XI], seen[:, :N_XI]
        used = seen & s.known
        done = corrected(R, s.now, y, used)
        counts: Array = np.any(used[:, :N_SEEN], axis=1)
        flag = flagged(s.flag, statistic(done.nu, done.S, used), counts, beta_0)
        x, P, raised = done.x, done.P, flag.up & counts
        adapted = s.adapted
        if search is not None and raised.any():
            up = np.flatnonzero(raised)

            def run(rows: Array, P_c: Array) -> Trial:
                i = up[rows]
                ahead = predicted(plant, Q, Attitude(s.before.x[i], P_c, s.before.sign[i]), at.u[i])
                tried = corrected(R, ahead, y[i], used[i])
                residual = np.where(used[i, :N_SEEN], y[i, :N_SEEN] - tried.x[:, :N_SEEN], 0.0)
                return Trial(tried.x, tried.P, residual**2 @ r_inv, P_c)

            kept = search(s.before.P[up], adapted[up], run)
            x[up], P[up] = kept.x, kept.P
            adapted = adapted + raised
        x[:, N_XI:] = np.clip(x[:, N_XI:], F_MIN, F_MAX)
        x, P = taken(x, P, y, np.diag(R), seen & ~s.known)
        return JointUKF(
            Attitude(x, P, sign), s.before, s.known | seen, flag, adapted, done.nu, done.S, used.sum(axis=1)
        )  # fmt: skip

    def read(s: JointUKF) -> Reading:
        f, P_f = s.now.x[:, N_XI:], s.now.P[:, N_XI:, N_XI:]
        return reading_of(f, P_f, s.now, s.flag, s.adapted, s.nu, s.S, s.seen)

    return Filter(start, predict, update, read, expect=lambda s, at: expected(s.now.x, s.known, s.now.sign))


@diagnoser("joint_ukf", "Joint unscented Kalman filter of state and effectiveness", reference=True)
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
    filter = joint_filter(plant, q_theta=q_theta, sigma_q=sigma_q, p_theta=p_theta, sigma_r=sigma_r)
    return diagnoser_of(plant, filter, threshold_rule(plant, threshold))
