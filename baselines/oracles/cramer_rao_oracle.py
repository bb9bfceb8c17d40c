"""Cramer-Rao oracle: what could be known about the effectiveness by someone who is told when it changes.

The covariance of a Kalman filter linearised on the true trajectory is the (posterior) Cramer-Rao bound of the model
with Gaussian noise: f is known before the first change, and has the prior 0.25 I at each. The oracle draws an estimate
from N(f, P_ff) every 0.1 s around the true f and asks for the most probable set of faulty units: what it says does not
depend on the observations. It forgets at every change what it knew, which a filter need not do; it frames the satellite's
tables since no method has been measured above it.

P. Tichavsky, C. H. Muravchik, A. Nehorai, IEEE Trans. Signal Processing 46(5), 1998 (bound); classifier: data sheet.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.special

from baselines.filters.attitude import require_attitude
from baselines.filters.mekf import first_covariance, observation, transition
from baselines.oracles.mekf_clairvoyant import changes
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.engine import simulate
from fdi_gym.estimation.kalman import T, right_divide, symmetric
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.cmg_satellite import SETS, SIGMA_Q

P_PRIOR = 0.25  # variance of each effectiveness at a change
Q_FLOOR = 1e-8  # rad/s per step: process noise of the bound where there is none
EVERY = 10  # samples between two draws


def bound_step(P: Array, before: Array, after: Array, r: Array, f: Array, Q: Array, R: Array, wheel: bool) -> Array:
    """P (n, 10, 10) of (dtheta, dw, df) over an interval between the true states before and after (n, 11)."""
    Phi = transition(before[:, :4], before[:, 4:7], before[:, 7:], f, r, wheel)
    P = Phi @ P @ T(Phi) + Q
    H = observation(after[:, :4])
    HP = H @ P
    return symmetric(P - right_divide(T(HP), HP @ T(H) + R) @ HP)


def opened(P: Array, now: Array) -> Array:
    """The prior of a change in the episodes `now`: P_ff = 0.25 I, no cross terms."""
    P = P.copy()
    P[now, 6:, :6] = P[now, :6, 6:] = 0.0
    P[now, 6:, 6:] = P_PRIOR * np.eye(4)
    return P


def _log_between(a: Array, b: Array) -> Array:
    """log(Phi(b) - Phi(a)), a < b, also far out in the tails."""
    a, b = np.where(a > 0, -b, a), np.where(a > 0, -a, b)
    low, high = scipy.special.log_ndtr(a), scipy.special.log_ndtr(b)
    return high + np.log1p(-np.exp(np.minimum(low - high, -1e-300)))


def log_evidence(f_hat: Array, P: Array, alpha_min: float, alpha_max: float) -> Array:
    """log p(f_hat | label): its units have alpha U(alpha_min, alpha_max), the others f = 1; (n, 16) from f_hat (n, 4)."""
    found = np.empty((len(f_hat), len(SETS)))
    for label, faulty in enumerate(SETS):
        S, C = list(faulty), [i for i in range(4) if i not in faulty]
        P_CC, P_SC, gap = P[:, C][:, :, C], P[:, S][:, :, C], 1.0 - f_hat[:, C]
        mean, var = f_hat[:, S], np.einsum("nii->ni", P)[:, S]
        log_p = np.zeros(len(f_hat))
        if C:
            solved = np.linalg.solve(P_CC, np.concatenate([gap[..., None], T(P_SC)], axis=2))
            quadratic = (gap * solved[..., 0]).sum(axis=1)
            log_p = -0.5 * (quadratic + np.linalg.slogdet(2 * np.pi * P_CC)[1])
            mean = mean + (P_SC @ solved[..., :1])[..., 0]
            var = var - np.einsum("nsc,ncs->ns", P_SC, solved[..., 1:])
        s = np.sqrt(var)
        inside = _log_between((1.0 - alpha_max - mean) / s, (1.0 - alpha_min - mean) / s)
        found[:, label] = log_p + (inside - np.log(alpha_max - alpha_min)).sum(axis=1)
    return found


class Oracle(NamedTuple):
    """The oracle's state."""

    k: int  # samples seen
    P: Array  # (n, 10, 10) of (dtheta, dw, df)
    f: Array  # (n, 4) the estimate last drawn
    label: Array  # (n,)
    probs: Array  # (n, 16)
    episode: Array  # (n,) which of the scenarios


@diagnoser(
    "cramer_rao_oracle",
    "True effectiveness with the error of the Cramer-Rao bound, classified; looks at no observation",
    knows="the effectiveness, up to the Cramer-Rao bound",
    ceiling=True,
)
def cramer_rao_oracle(
    plant: Plant, *, scenarios: Sequence[FaultScenario], alpha_min: float = 0.02, alpha_max: float = 1.0
) -> Diagnoser:
    """The oracle. It flies the scenarios again for the truth, when it starts, and ignores the observations.

    Args:
        plant: The satellite.
        scenarios: One per episode, in the order of the batch.
        alpha_min, alpha_max: Range of the severities, as the fault process has it.

    Raises:
        NotApplicableError: The plant has no attitude.
    """
    require_attitude(plant)
    wheel = plant.options["fault_model"] == "wheel"
    R = plant.R[:6, :6]
    Q = np.diag([0.0] * 3 + [max(SIGMA_Q, Q_FLOOR) ** 2] * 3 + [0.0] * 4)
    change = changes(plant, scenarios)

    @functools.cache
    def truth() -> tuple[Array, Array, Array, Array]:
        """States as the model counts them, commands, effectiveness; and what is drawn."""
        record = simulate(plant, scenarios)
        x = record.state.copy()
        for i, scenario in enumerate(scenarios):  # the true cluster is mounted off the model's
            x[i, :, 7:] += np.deg2rad(scenario.physical.get("mounting_error_deg", 0.0))
        draws = np.stack([
            np.random.default_rng([s.noise_seed, 1]).standard_normal(((x.shape[1] - 1) // EVERY + 1, 4)) for s in scenarios
        ])  # fmt: skip
        return x, plant.split(record.obs)[1].copy(), record.theta, draws

    def init(n: int) -> Oracle:
        e, x = np.arange(n), truth()[0]
        probs = np.tile(np.eye(16)[0], (n, 1))
        return Oracle(0, first_covariance(x[e, 0, :4], R, 0.0), np.ones((n, 4)), np.zeros(n, np.int64), probs, e)

    def update(s: Oracle, obs: Array) -> tuple[Oracle, Diagnosis]:
        x, r, f, draws = truth()
        longest = x.shape[1] - 1
        e, k = s.episode, min(s.k, longest)
        P = s.P
        if 0 < s.k <= longest:
            P = bound_step(P, x[e, k - 1], x[e, k], r[e, k], f[e, k], Q, R, wheel)
        f_hat, label, probs = s.f, s.label, s.probs
        changed = P[:, 6, 6] > 0.0
        if k % EVERY == 0 and changed.any():
            f_hat, label, probs = f_hat.copy(), label.copy(), probs.copy()
            P_ff = P[changed, 6:, 6:]
            f_hat[changed] = f[e[changed], k] + (np.linalg.cholesky(P_ff) @ draws[e[changed], k // EVERY, :, None])[..., 0]
            log_p = log_evidence(f_hat[changed], P_ff, alpha_min, alpha_max)
            label[changed] = np.argmax(log_p, axis=1)
            probs[changed] = scipy.special.softmax(log_p, axis=1)
        std = np.sqrt(np.einsum("nii->ni", P[:, 6:, 6:]))
        P = opened(P, change[e, min(s.k, change.shape[1] - 1)])
        return Oracle(s.k + 1, P, f_hat, label, probs, e), Diagnosis(label > 0, label, f_hat, std, probs)

    return Diagnoser(init, update, gaps=True)
