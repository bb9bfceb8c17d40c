"""Hypothesis bank: one extended Kalman filter per label, mixed as in the interacting-multiple-model estimator.

Hypothesis j says which actuators have failed; its filter estimates state, the error of those actuators, and the
disturbance, and holds the other errors at zero. Hypotheses exchange probability with those that have one fault more or
less. H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988 (the interacting multiple model).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from fdi_gym.diagnosis import Diagnoser, Diagnosis, NotApplicableError, diagnoser
from fdi_gym.estimation.flags import label_sets
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.propagation import fault_inputs, linear_output
from fdi_gym.estimation.unknown_inputs import initial_covariance
from fdi_gym.plant import Array, Plant


class Bank(NamedTuple):
    """State of the bank: L filters of X = [x; b; d], their probabilities, and the declared hypothesis."""

    X: Array  # (n, L, N)
    P: Array  # (n, L, N, N)
    mu: Array  # (n, L)
    declared: Array  # (n,) hypothesis
    candidate: Array  # (n,) what the last step favoured,
    times: Array  # (n,) and on how many steps in a row


def transitions(sets: Array, one_more: float, one_less: float) -> Array:
    """Pi(i -> j) (L, L): to each hypothesis with one channel more or less; 0 for other changes; the rest stays."""
    sizes = sets.sum(axis=1)
    subset = ~(sets[:, None] & ~sets[None]).any(axis=2)  # i within j
    Pi = one_more * (subset & (sizes[None] == sizes[:, None] + 1)) + one_less * (
        subset.T & (sizes[None] == sizes[:, None] - 1)
    )
    return Pi + np.diag(1 - Pi.sum(axis=1))


@diagnoser("hypothesis_bank", "Bank of extended Kalman filters, one per label (HypBank)")
def hypothesis_bank(
    plant: Plant,
    *,
    channels: Sequence[str] | None = None,
    x0_std: Sequence[float] | None = None,
    d0_std: float = 0.5,
    b_onset: Sequence[float] = (5e-3, 2e-3, 2e-3, 6e-3),
    b_step: Sequence[float] = (0.7e-3, 0.5e-3, 0.5e-3, 0.7e-3),
    d_step: float = 0.08,
    healthy: float = 0.999,
    one_more: float = 5e-5,
    one_less: float = 5e-4,
    release: float = 0.5,
    alarm: float = 0.3,
    persist: int = 3,
) -> Diagnoser:
    """The hypothesis bank.

    Args:
        plant: A plant whose fault enters additively and whose sensors are linear.
        channels: The fault channels. Default: all.
        x0_std: Standard deviations of the initial state; the helicopter brings its own (`Plant.tuning`).
        d0_std: Of the initial disturbance.
        b_onset: Standard deviation of a fault at its onset, per entry of `plant.estimated` [rad].
        b_step: Of its random walk per step.
        d_step: Of the disturbance's random walk per step.
        healthy: Initial probability of "none"; the others share the rest.
        one_more, one_less: Transition probabilities per step to each hypothesis with one fault more or less.
        alarm: "none" is left when its probability is below this ...
        release: ... and taken again when it is above this,
        persist: after so many steps in a row with the same verdict.

    Raises:
        NotApplicableError: The plant is not of that kind, or the settings have not one entry per fault.
    """
    inputs, H = fault_inputs(plant, channels), linear_output(plant)
    if x0_std is None:
        raise NotApplicableError(f"needs x0_std, the spread of the initial state, which {plant.id} does not bring")
    for name, value in (("b_onset", b_onset), ("b_step", b_step)):
        if len(value) != len(plant.estimated):
            raise NotApplicableError(f"{name} needs one entry per fault of {plant.id}: {len(plant.estimated)}")
    s0, walk = np.asarray(b_onset)[inputs.estimated], np.asarray(b_step)[inputs.estimated]
    labels, sets = label_sets(plant, inputs)
    L, p = sets.shape
    n_x, q = len(plant.states), len(plant.disturbances)
    N, b_part = n_x + p + q, slice(n_x, n_x + p)
    Pi = transitions(sets, one_more, one_less)
    keep = np.ones((L, N))
    keep[:, b_part] = sets

    def blocks(x: Array, b: Array, d_std: float) -> Array:
        diagonal = [scipy.linalg.block_diag(x, np.diag(b**2 * m), d_std**2 * np.eye(q)) for m in sets]
        return np.asarray(diagonal)

    P0 = blocks(initial_covariance(plant, x0_std), s0, d0_std)
    Qa = blocks(plant.Q, walk, d_step)
    X0 = np.tile(np.concatenate([plant.trim_state, np.zeros(p + q)]), (L, 1))
    mu0 = np.full(L, (1 - healthy) / (L - 1))
    mu0[0] = healthy
    width = np.concatenate([np.full(n_x + p, 1e-5), np.ones(q)])  # of the Jacobian's differences: x, b; d in m/s
    offsets = np.concatenate([np.diag(width), -np.diag(width)])

    def init(n: int) -> Any:
        copies = [np.tile(a, (n, *[1] * a.ndim)) for a in (X0, P0, mu0)]
        return 0, Bank(*copies, *(np.zeros(n, np.int64) for _ in range(3)))

    def model(t: float, X: Array, u: Array) -> Array:
        """F for all points X (n, m, N) in one call."""
        theta = np.tile(plant.nominal_theta, (*X.shape[:2], 1))
        theta[..., inputs.entries] += X[..., b_part]
        return plant.propagate(t, X[..., :n_x], u, theta, X[..., n_x + p :] if q else None)

    def step(s: Bank, t: float, u: Array, y: Array) -> Bank:
        X, P, mu = s.X, s.P, s.mu
        n = len(y)
        # (1) where the Jacobian is taken; (2) mixing
        centre = times(T(X), mu)
        c = times(Pi.T, mu)
        w = T(Pi * mu[:, :, None]) / c[:, :, None]  # (n, j, i)
        Z = X[:, None] * keep[:, None]  # (n, j, i, N)
        Xm = (w[:, :, None] @ Z)[:, :, 0]
        spread = np.sqrt(w)[..., None] * (Z - Xm[:, :, None])
        fresh = (w @ ~sets) * sets * s0**2  # variance of the faults that are new in j
        Pm = (w @ P.reshape(n, L, N * N)).reshape(n, L, N, N) * (keep[:, :, None] * keep[:, None])
        Pm += T(spread) @ spread
        Pm[..., range(n_x, n_x + p), range(n_x, n_x + p)] += fresh
        # (3) one Jacobian for all hypotheses; (4) a Kalman filter each
        F = model(t, np.concatenate([Xm, centre[:, None] + offsets], axis=1), u)
        Phi = np.tile(np.eye(N), (n, 1, 1, 1))
        Phi[:, 0, :n_x] = T((F[:, L : L + N] - F[:, L + N :]) / (2 * width[:, None]))
        x = Xm.copy()
        x[..., :n_x] = F[:, :L]
        P = Phi @ Pm @ T(Phi) + Qa
        PHt = P[..., :n_x] @ H.T
        C = H @ PHt[:, :, :n_x] + plant.R
        K = right_divide(PHt, C)
        nu = y[:, None] - x[..., :n_x] @ H.T
        x = x + (K @ nu[..., None])[..., 0]
        P = symmetric(P - K @ T(PHt))
        # (5) probabilities
        fit = -0.5 * (nu * np.linalg.solve(C, nu[..., None])[..., 0]).sum(axis=2) - 0.5 * np.linalg.slogdet(C)[1]
        mu = c * np.exp(np.maximum(fit - fit.max(axis=1, keepdims=True), -60.0))
        mu = np.maximum(mu / mu.sum(axis=1, keepdims=True), 1e-9)
        mu = mu / mu.sum(axis=1, keepdims=True)
        # verdict
        limit = np.where(s.declared == 0, alarm, release)
        candidate = np.where(mu[:, 0] > limit, 0, 1 + np.argmax(mu[:, 1:], axis=1))
        count = np.where(candidate == s.candidate, s.times + 1, 1)
        declared = np.where(count >= persist, candidate, s.declared)
        return Bank(x, P, mu, declared, candidate, count)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, s = state
        y, u, _ = plant.split(obs)
        n = len(obs)
        if k > 0:
            s = step(s, (k - 1) * plant.dt, u, y)
        weight, b_all = s.mu[:, :, None], s.X[..., b_part]
        b = (weight * b_all).sum(axis=1)
        variance = np.einsum("nlbb->nlb", s.P[..., b_part, b_part]) + (b_all - b[:, None]) ** 2
        std, probs = np.zeros((n, len(plant.estimated))), np.zeros((n, len(plant.labels)))
        std[:, inputs.estimated] = np.sqrt((weight * variance).sum(axis=1))
        probs[:, labels] = s.mu
        theta = plant.estimate_target(inputs.theta(plant, b), u)
        return (k + 1, s), Diagnosis(s.declared > 0, labels[s.declared], theta, std, probs)

    return Diagnoser(init, update)
