"""Multiplicative extended Kalman filter with resets.

Error state (dtheta, dw, df), 10 numbers: the attitude error is a small rotation in body axes. Gimbal angles are dead-
reckoned with the commanded rates and drawn towards the measured ones; only attitude and rate are filtered. Where the
mean normalised innovation squared says that the model no longer holds, the covariance of f is opened and its
correlations are forgotten. Attitude and rate have a wide prior until they are first reported, and are then taken as they
are.

F. L. Markley, J. Guidance, Control, and Dynamics 26(2), 2003 (multiplicative filter); resets and tuning: data sheet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters.attitude import cross, require_attitude, rotated, taken, with_scalar
from baselines.filters.effectiveness import F_MAX, F_MIN, P_THETA, Q_THETA, THRESHOLD, threshold_rule
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation import kalman
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, quadratic, times
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.cmg_satellite import DT, H0, JS, SIGMA_Q, cluster, inertia

NIS_START = 6.0  # the mean of a chi-square with six degrees of freedom
NIS_MAX, MEMORY = 10.0, 50  # detector: threshold of the weighted mean, and its length in steps
P_RESET = 0.25  # variance of each effectiveness after a reset
D_GAIN = 0.002  # gain of the gimbal angles towards the measured ones, at least

ATTITUDE, RATE, THETA = np.arange(3), np.arange(3, 6), np.arange(6, 10)  # of the error state


class MEKF(NamedTuple):
    """The filter's state."""

    q: Array  # (n, 4)
    w: Array  # (n, 3)
    d: Array  # (n, 4)
    f: Array  # (n, 4)
    P: Array  # (n, 10, 10) of (dtheta, dw, df)
    known: Array  # (n, 6) bool: attitude, as a whole, and each rate have been reported
    angles: Array  # (n, 4) samples at which each gimbal angle was
    nis: Array  # (n,) weighted mean of the normalised innovation squared
    samples: Array  # (n,) with an innovation so far
    wait: Array  # (n,) number of them at which the next reset is allowed
    resets: Array  # (n,) resets so far
    reset: Array  # (n,) bool: there was one at the last sample
    episode: Array  # (n,) which one, for the filter that is told the changes
    nu: Array  # (n, 6) last innovation
    S: Array  # (n, 6, 6) its covariance
    seen: Array  # (n,) sensors in it


def transition(q: Array, w: Array, d: Array, f: Array, r: Array, wheel: bool) -> Array:
    """Phi (n, 10, 10) of the error state over one step, linearised at its start, to second order in its length."""
    A, E = cluster(d)
    J_inv = np.linalg.inv(inertia(A))
    g = f if wheel else np.ones_like(f)
    W = cross(w)
    F = np.zeros((len(q), 10, 10))
    F[:, :3, :3] = -W
    F[:, :3, 3:6] = np.eye(3)
    F[:, 3:6, 3:6] = J_inv @ (cross(np.array(JS) * w + H0 * times(E, g)) - W * JS)
    F[:, 3:6, 6:] = -H0 * J_inv @ (A * r[:, None, :])
    if wheel:
        F[:, 3:6, 6:] -= H0 * J_inv @ W @ E
    FT = F * DT
    return np.eye(10) + FT + 0.5 * FT @ FT


def observation(q: Array) -> Array:
    """H (n, 6, 10) of q_v and w: q_v moves by (q4 I + [q_v x]) dtheta / 2."""
    H = np.zeros((len(q), 6, 10))
    H[:, :3, :3] = 0.5 * (q[:, 3, None, None] * np.eye(3) + cross(q[:, :3]))
    H[:, 3:, 3:6] = np.eye(3)
    return H


def attitude_variance(q: Array, R: Array) -> Array:
    """Variance (n, 3) of dtheta that the noise of q_v leaves: 4 R_q / q4^2, bounded where q4 vanishes."""
    return 4.0 * np.diag(R)[:3] / np.maximum(q[:, 3:] ** 2, 0.05)


def first_variance(q: Array, R: Array) -> Array:
    """Variance (n, 6) of attitude and rate that their first measurement leaves."""
    return np.concatenate([attitude_variance(q, R), np.tile(np.diag(R)[3:6], (len(q), 1))], axis=1)


def first_covariance(q: Array, R: Array, p_theta: float) -> Array:
    """P (n, 10, 10) after the first measurement."""
    return taken(np.empty((len(q), 10)), np.tile(np.diag([0.0] * 6 + [p_theta] * 4), (len(q), 1, 1)), np.empty((len(q), 6)),
                 first_variance(q, R), np.ones((len(q), 6), bool))[1]  # fmt: skip


def begun(s: MEKF, y: Array, seen: Array, R: Array) -> MEKF:
    """Attitude and rate as they are reported for the first time."""
    fresh = seen[:, :6] & ~s.known
    fresh[:, :3] = (fresh[:, :3].all(axis=1) & seen[:, 10])[:, None]
    if not fresh.any():
        return s
    q = np.where(fresh[:, :1], with_scalar(y[:, None, :3], y[:, 10])[:, 0], s.q)
    x = np.concatenate([np.zeros_like(s.w), s.w, s.f], axis=1)
    x, P = taken(x, s.P, y[:, :6], first_variance(q, R), fresh)
    return s._replace(q=q, w=x[:, 3:6], P=P, known=s.known | fresh)


def opened(s: MEKF, now: Array, y: Array, seen: Array, R: Array, p_reset: float, memory: int) -> MEKF:
    """A reset in the episodes `now`: the covariance of the effectiveness is opened and its correlations are forgotten."""
    if not now.any():
        return s
    w, P, nis, rows = s.w.copy(), s.P.copy(), s.nis.copy(), np.flatnonzero(now)
    w[now] = np.where(seen[now, 3:6], y[now, 3:6], w[now])
    P[now, 6:, :6] = P[now, :6, 6:] = 0.0
    P[np.ix_(rows, THETA, THETA)] = p_reset * np.eye(4)
    for part, extra in ((ATTITUDE, 4.0 * np.diag(R)[:3]), (RATE, np.diag(R)[3:6])):
        P[np.ix_(rows, part, part)] += np.diag(extra)
    nis[now] = NIS_START
    return s._replace(w=w, P=P, nis=nis, wait=np.where(now, s.samples + memory, s.wait), resets=s.resets + now)


def mekf_filter(
    plant: Plant,
    known_changes: Array | None = None,
    *,
    q_theta: float = Q_THETA,
    p_theta: float = P_THETA,
    p_reset: float = P_RESET,
    nis_max: float = NIS_MAX,
    memory: int = MEMORY,
) -> Filter:
    """The filter with its detector, or with resets at known changes (episodes, samples) bool."""
    require_attitude(plant)
    wheel = plant.options["fault_model"] == "wheel"
    R = plant.R[:6, :6]
    Q = np.diag([0.0] * 3 + [SIGMA_Q**2] * 3 + [q_theta] * 4)
    scale = np.array([s.scale for s in plant.states])
    P_0 = np.diag([*(2.0 * scale[:3]) ** 2, *scale[4:7] ** 2, *[p_theta] * 4])  # an angle is twice its q_v

    def start(n: int) -> MEKF:
        x, count = np.tile(plant.trim_state, (n, 1)), np.zeros(n, np.int64)
        return MEKF(
            x[:, :4], x[:, 4:7], x[:, 7:], np.ones((n, 4)), np.tile(P_0, (n, 1, 1)), np.zeros((n, 6), bool),
            np.zeros((n, 4), np.int64), np.full(n, NIS_START), count, count, count, np.zeros(n, bool), np.arange(n),
            np.zeros((n, 6)), np.tile(R, (n, 1, 1)), count,
        )  # fmt: skip

    def predict(s: MEKF, at: Interval) -> MEKF:
        Phi = transition(s.q, s.w, s.d, s.f, at.u, wheel)
        x = plant.propagate(0.0, np.concatenate([s.q, s.w, s.d], axis=1), at.u, s.f)
        return s._replace(q=x[:, :4], w=x[:, 4:7], d=x[:, 7:], P=Phi @ s.P @ T(Phi) + Q)

    def due(s: MEKF, k: Array) -> Array:
        if known_changes is not None:
            return known_changes[s.episode, np.minimum(k, known_changes.shape[1] - 1)]
        return (s.nis > nis_max) & (s.samples >= s.wait)

    def update(s: MEKF, at: Interval, y: Array, seen: Array) -> MEKF:
        used = seen[:, :6] & s.known
        H = observation(s.q)
        nu = y[:, :6] - np.concatenate([s.q[:, :3], s.w], axis=1)
        done = kalman.update(np.zeros((len(y), 10)), s.P, nu, H, R, used)
        nis = quadratic(done.nu, done.S) + (~used).sum(axis=1)  # a missing sensor counts with its expectation
        gain = np.where(seen[:, 6:10], np.maximum(D_GAIN, 1.0 / (s.angles + 1)), 0.0)
        counts = used.any(axis=1)
        s = s._replace(
            q=rotated(s.q, done.x[:, :3]), w=s.w + done.x[:, 3:6], d=s.d + gain * (y[:, 6:10] - s.d),
            f=np.clip(s.f + done.x[:, 6:], F_MIN, F_MAX), P=done.P, angles=s.angles + seen[:, 6:10],
            nis=np.where(counts, s.nis + (nis - s.nis) / memory, s.nis), samples=s.samples + counts,
            nu=done.nu, S=done.S, seen=used.sum(axis=1),
        )  # fmt: skip
        s = begun(s, y, seen, R)
        now = due(s, at.k)
        return opened(s, now, y, seen, R, p_reset, memory)._replace(reset=now)

    def read(s: MEKF) -> Reading:
        flag = s.reset & (known_changes is None)  # a reset at a change that was known is no flag
        signals = {"flag": flag, "statistic": s.nis, "resets": s.resets}
        x = np.concatenate([s.q, s.w, s.d], axis=1)
        return Reading(s.f - 1.0, s.P[:, 6:, 6:], x, None, s.nu, s.S, s.seen, signals=signals)

    def expect(s: MEKF, at: Interval) -> Array:
        y = np.concatenate([s.q[:, :3], s.w, s.d, np.where(s.q[:, 3:] < 0.0, -1.0, 1.0)], axis=1)
        known = np.column_stack([s.known, s.angles > 0, s.known[:, 0]])
        return np.where(known, y, np.nan)

    return Filter(start, predict, update, read, expect=expect)


@diagnoser("mekf", "Multiplicative extended Kalman filter, covariance opened by a test on the innovations", reference=True)
def mekf(
    plant: Plant,
    *,
    q_theta: float = Q_THETA,
    p_theta: float = P_THETA,
    p_reset: float = P_RESET,
    nis_max: float = NIS_MAX,
    memory: int = MEMORY,
    threshold: float = THRESHOLD,
) -> Diagnoser:
    """The filter with its detector.

    Args:
        plant: The satellite.
        q_theta: Variance that each effectiveness gains per step.
        p_theta, p_reset: Variance of each effectiveness at the start and after a reset.
        nis_max: Threshold of the detector.
        memory: Length of the detector's weighted mean, and of its pause after a reset, in steps.
        threshold: A unit that has lost more is called faulty.

    Raises:
        NotApplicableError: The plant has no attitude.
    """
    filter = mekf_filter(plant, q_theta=q_theta, p_theta=p_theta, p_reset=p_reset, nis_max=nis_max, memory=memory)
    return diagnoser_of(plant, filter, threshold_rule(plant, threshold))
