"""Multiplicative extended Kalman filter with resets, and the same filter told when f changes.

Error state (dtheta, dw, df), 10 numbers: the attitude error is a small rotation in body axes. Gimbal angles are dead-
reckoned with the commanded rates and drawn towards the measured ones; only attitude and rate are filtered. Where the
mean normalised innovation squared says that the model no longer holds, the covariance of f is opened and its
correlations are forgotten. Clairvoyant, the resets come exactly at the changes of f, and there is no detector.

F. L. Markley, J. Guidance, Control, and Dynamics 26(2), 2003 (multiplicative filter); resets and tuning: data sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation.attitude import cross, require_attitude, rotated
from fdi_gym.estimation.effectiveness import F_MAX, F_MIN, P_THETA, Q_THETA, THRESHOLD, threshold_rule
from fdi_gym.estimation.kalman import T, symmetric, times
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.cmg_satellite import DT, H0, JS, SIGMA_Q, cluster, inertia

NIS_START = 6.0  # the mean of a chi-square with six degrees of freedom
NIS_MAX, MEMORY = 10.0, 50  # detector: threshold of the weighted mean, and its length in steps
P_RESET = 0.25  # variance of each effectiveness after a reset
D_GAIN = 0.002  # gain of the gimbal angles towards the measured ones, at least


class MEKF(NamedTuple):
    """The filter's state."""

    k: int  # samples seen
    q: Array  # (n, 4)
    w: Array  # (n, 3)
    d: Array  # (n, 4)
    f: Array  # (n, 4)
    P: Array  # (n, 10, 10) of (dtheta, dw, df)
    nis: Array  # (n,) weighted mean of the normalised innovation squared
    wait: Array  # (n,) first sample at which the next reset is allowed
    resets: Array  # (n,) resets so far
    episode: Array  # (n,) which of the scenarios, for the clairvoyant one


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


def first_covariance(q: Array, R: Array, p_theta: float) -> Array:
    """P (n, 10, 10) after the first measurement."""
    P = np.zeros((len(q), 10, 10))
    i = np.arange(10)
    P[:, i[:3], i[:3]] = attitude_variance(q, R)
    P[:, i[3:6], i[3:6]] = np.diag(R)[3:6]
    P[:, i[6:], i[6:]] = p_theta
    return P


def changes(plant: Plant, scenarios: Sequence[FaultScenario]) -> Array:
    """Where f changes (episodes, samples): row k is set where the f held from sample k on is not that held before."""
    found = np.zeros((len(scenarios), 1 + max(s.steps for s in scenarios)), bool)
    for i, scenario in enumerate(scenarios):
        a = plant.theta_table(scenario).a
        found[i, : len(a)] = (np.diff(a, axis=0, prepend=plant.nominal_theta[None]) != 0).any(axis=1)
    return found


def mekf_filter(
    plant: Plant,
    known_changes: Array | None = None,
    *,
    q_theta: float = Q_THETA,
    p_theta: float = P_THETA,
    p_reset: float = P_RESET,
    nis_max: float = NIS_MAX,
    memory: int = MEMORY,
    threshold: float = THRESHOLD,
) -> Diagnoser:
    """The filter with its detector, or with resets at known changes (episodes, samples) bool."""
    require_attitude(plant)
    wheel = plant.options["fault_model"] == "wheel"
    R = plant.R[:6, :6]
    Q = np.diag([0.0] * 3 + [SIGMA_Q**2] * 3 + [q_theta] * 4)
    decide = threshold_rule(plant, threshold)
    i = np.arange(10)

    def init(n: int) -> MEKF:
        q = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
        return MEKF(
            0, q, np.zeros((n, 3)), np.zeros((n, 4)), np.ones((n, 4)), first_covariance(q, R, p_theta),
            np.full(n, NIS_START), np.zeros(n, np.int64), np.zeros(n, np.int64), np.arange(n),
        )  # fmt: skip

    def reset(s: MEKF, now: Array, y: Array) -> MEKF:
        """Open the covariance of the effectiveness in the episodes `now`; s.k is the number of the sample just used."""
        if not now.any():
            return s
        w, P, nis = s.w.copy(), s.P.copy(), s.nis.copy()
        w[now] = y[now, 3:6]
        P[now, 6:, :6] = P[now, :6, 6:] = 0.0
        P[now, 6:, 6:] = p_reset * np.eye(4)
        for part, extra in ((i[:3], 4.0 * np.diag(R)[:3]), (i[3:6], np.diag(R)[3:6])):
            P[np.ix_(now.nonzero()[0], part, part)] += np.diag(extra)
        nis[now] = NIS_START
        return s._replace(w=w, P=P, nis=nis, wait=np.where(now, s.k + memory, s.wait), resets=s.resets + now)

    def due(s: MEKF) -> Array:
        if known_changes is not None:
            return known_changes[s.episode, min(s.k, known_changes.shape[1] - 1)]
        return (s.nis > nis_max) & (s.k >= s.wait)

    def update(s: MEKF, obs: Array) -> tuple[MEKF, Diagnosis]:
        y, r, _ = plant.split(obs)
        if s.k == 0:  # no interval has ended: the filter starts from the first measurement
            q4 = y[:, 10] * np.sqrt(np.maximum(0.0, 1.0 - (y[:, :3] ** 2).sum(axis=1)))
            q = np.concatenate([y[:, :3], q4[:, None]], axis=1)
            s = s._replace(q=q, w=y[:, 3:6], d=y[:, 6:10], P=first_covariance(q, R, p_theta))
        else:
            Phi = transition(s.q, s.w, s.d, s.f, r, wheel)
            P = Phi @ s.P @ T(Phi) + Q
            x = plant.propagate(0.0, np.concatenate([s.q, s.w, s.d], axis=1), r, s.f)
            q, w, d = x[:, :4], x[:, 4:7], x[:, 7:]
            d = d + max(D_GAIN, 1.0 / (s.k + 1)) * (y[:, 6:10] - d)
            innovation = y[:, :6] - np.concatenate([q[:, :3], w], axis=1)
            H = observation(q)
            HP = H @ P
            solved = np.linalg.solve(HP @ T(H) + R, np.concatenate([HP, innovation[..., None]], axis=2))
            K = T(solved[..., :10])
            dx = times(K, innovation)
            nis = np.einsum("ni,ni->n", innovation, solved[..., 10])
            s = s._replace(
                q=rotated(q, dx[:, :3]), w=w + dx[:, 3:6], d=d, f=np.clip(s.f + dx[:, 6:], F_MIN, F_MAX),
                P=symmetric(P - K @ HP), nis=s.nis + (nis - s.nis) / memory,
            )  # fmt: skip
        now = due(s)
        s = reset(s, now, y)
        return s._replace(k=s.k + 1), decide(s.f, s.P[:, 6:, 6:], now & (known_changes is None))

    return Diagnoser(init, update)


@diagnoser("mekf", "Multiplicative extended Kalman filter, covariance opened by a test on the innovations")
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
    return mekf_filter(
        plant, q_theta=q_theta, p_theta=p_theta, p_reset=p_reset, nis_max=nis_max, memory=memory, threshold=threshold
    )


@diagnoser("mekf_clairvoyant", "The same filter, told when the effectiveness changes", clairvoyant=True)
def mekf_clairvoyant(
    plant: Plant, *, scenarios: Sequence[FaultScenario], q_theta: float = Q_THETA, threshold: float = THRESHOLD
) -> Diagnoser:
    """The multiplicative filter with resets exactly at the changes of f, which it is told (when, not what).

    Args:
        plant: The satellite.
        scenarios: One per episode, in the order of the batch.
        q_theta, threshold: As in `mekf`.

    Raises:
        NotApplicableError: The plant has no attitude.
    """
    require_attitude(plant)
    return mekf_filter(plant, changes(plant, scenarios), q_theta=q_theta, threshold=threshold)
