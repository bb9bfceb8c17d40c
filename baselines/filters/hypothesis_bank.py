"""Hypothesis bank: one extended Kalman filter per label, mixed as in the interacting-multiple-model estimator.

Hypothesis j says which actuators have failed; its filter estimates state, the error of those actuators, and the
disturbance, and holds the other errors at zero. Hypotheses exchange probability with those that have one fault more or
less. H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988 (the interacting multiple model).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from baselines.filters.unknown_inputs import initial_covariance, of_all_channels
from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation import mixing
from fdi_gym.estimation.belief import FaultInputs, fault_inputs, noisy_sensors
from fdi_gym.estimation.decision import Reading, by_candidate
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, correct, log_likelihood, times
from fdi_gym.estimation.labels import channel_sets
from fdi_gym.estimation.linear import linear_output
from fdi_gym.plant import Array, Plant

LEAST = 1e-9  # probability of a hypothesis


class Hypotheses(NamedTuple):
    """State of the bank: L filters of X = [x; b; d], and their probabilities."""

    X: Array  # (n, L, N)
    P: Array  # (n, L, N, N)
    mu: Array  # (n, L) after the last update
    c: Array  # (n, L) predicted


def transitions(sets: Array, one_more: float, one_less: float) -> Array:
    """Pi(i -> j) (L, L): to each hypothesis with one fault more or less; 0 for other changes; the rest stays."""
    within = ~(sets[:, None] & ~sets[None]).any(axis=2) & ~np.eye(len(sets), dtype=bool)  # i within j
    one = within & ~((within[:, :, None] & within[None]).any(axis=1))  # and nothing between them
    Pi = one_more * one + one_less * one.T
    return Pi + np.diag(1 - Pi.sum(axis=1))


class Prior(NamedTuple):
    """What the bank believes: L hypotheses of N entries, X = [x; b; d]."""

    X0: Array  # (L, N)
    P0: Array  # (L, N, N)
    Q: Array  # (L, N, N) covariance per sample
    mu0: Array  # (L,) probabilities at first
    Pi: Array  # (L, L) transitions per sample
    onset: Array  # (p,) standard deviation of a fault at its onset


def prior_of(
    plant: Plant, sets: Array, x0_std: Sequence[float], onset: Array, step: Array, d: tuple[float, float], mu0: Array,
    Pi: Array,
) -> Prior:  # fmt: skip
    """The prior of the hypotheses that the channels `sets` (L, p) have failed.

    Args:
        plant: The plant.
        sets: Channels of each hypothesis.
        x0_std: Standard deviations of the initial state.
        onset, step: Of a fault at its onset, and of its random walk per step (p,).
        d: Of the initial disturbance, and of its random walk per step.
        mu0, Pi: As in `Prior`.
    """
    (L, p), q = sets.shape, len(plant.disturbances)

    def blocks(state: Array, fault: Array, d_std: float) -> Array:
        diagonal = [scipy.linalg.block_diag(state, np.diag(fault**2 * m), d_std**2 * np.eye(q)) for m in sets]
        return np.asarray(diagonal)

    X0 = np.tile(np.concatenate([plant.trim_state, np.zeros(p + q)]), (L, 1))
    P0 = blocks(initial_covariance(plant, x0_std), onset, d[0])
    return Prior(X0, P0, blocks(plant.Q, step, d[1]), mu0, Pi, onset)


def bank_filter(
    plant: Plant, inputs: FaultInputs, labels: Array, sets: Array, sensors: Array, H: Array, prior: Prior
) -> Filter:
    """The bank.

    Args:
        plant: The plant.
        inputs: The fault channels.
        labels, sets: Labels (L,) of the hypotheses, and their channels (L, p).
        sensors, H: The sensors (m,) that it hears, and their matrix (m, n_x).
        prior: What it believes.
    """
    R = plant.R[np.ix_(sensors, sensors)]
    (L, p), n_x, q = sets.shape, len(plant.states), len(plant.disturbances)
    N, x, b = n_x + p + q, slice(0, n_x), slice(n_x, n_x + p)
    keep = np.ones((L, N))
    keep[:, b] = sets
    width = np.concatenate([np.full(n_x + p, 1e-5), np.ones(q)])  # of the Jacobian's differences: x, b; d in m/s
    offsets = np.concatenate([np.diag(width), -np.diag(width)])

    def start(n: int) -> Hypotheses:
        X, P, mu = (np.tile(a, (n, *[1] * a.ndim)) for a in (prior.X0, prior.P0, prior.mu0))
        return Hypotheses(X, P, mu, mu)

    def ahead(X: Array, at: Interval) -> Array:
        """All points X (n, m, N) one sample later, in one call."""
        theta = np.tile(plant.nominal_theta, (*X.shape[:2], 1))
        theta[..., inputs.entries] += X[..., b]
        return plant.propagate((at.k - 1) * plant.dt, X[..., x], at.u, theta, X[..., n_x + p :] if q else None)

    def predict(s: Hypotheses, at: Interval) -> Hypotheses:
        centre = times(T(s.X), s.mu)  # where the Jacobian of all hypotheses is taken
        c, w = mixing.ahead(s.mu, prior.Pi)
        X, P = mixing.mixture(w, s.X, s.P)
        X, P = X * keep, P * (keep[:, :, None] * keep[:, None])
        P[..., range(n_x, n_x + p), range(n_x, n_x + p)] += (w @ ~sets) * sets * prior.onset**2  # of the faults that are new
        F = ahead(np.concatenate([X, centre[:, None] + offsets], axis=1), at)
        Phi = np.tile(np.eye(N), (len(c), 1, 1, 1))
        Phi[:, 0, x] = T((F[:, L : L + N] - F[:, L + N :]) / (2 * width[:, None]))
        X[..., x] = F[:, :L]
        return Hypotheses(X, Phi @ P @ T(Phi) + at.noise(prior.Q, X[..., 0].size).reshape(-1, L, N, N), s.mu, c)

    def update(s: Hypotheses, at: Interval, y: Array, seen: Array) -> Hypotheses:
        n, m = len(y), len(sensors)
        rows = np.repeat(np.arange(n), L)
        X, P = s.X.reshape(-1, N), s.P.reshape(-1, N, N)
        cross = P[..., x] @ H.T
        nu = y[:, sensors][rows] - times(H, X[:, x])
        done = correct(X, P, nu, cross, H @ cross[:, x] + R, seen[:, sensors][rows])
        fit = log_likelihood(done.nu.reshape(n, L, m), done.S.reshape(n, L, m, m))
        mu = mixing.weigh(s.c, fit, LEAST)
        mu = mu / mu.sum(axis=1, keepdims=True)
        return Hypotheses(done.x.reshape(n, L, N), done.P.reshape(n, L, N, N), mu, mu)

    def read(s: Hypotheses) -> Reading:
        mean, P = mixing.mixture(s.mu[:, None], s.X, s.P)
        mean, P = mean[:, 0], P[:, 0]
        probs = np.zeros((len(mean), len(plant.labels)))
        probs[:, labels] = s.mu
        reading = Reading(mean[:, b], P[:, b, b], mean[:, x], P[:, x, x], probs=probs)
        return of_all_channels(plant, inputs, reading)

    return Filter(start, predict, update, read, first_sample=False)


@diagnoser("hypothesis_bank", "Bank of extended Kalman filters, one per label (HypBank)", reference=True)
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
        x0_std: Standard deviations of the initial state.
        d0_std: Of the initial disturbance.
        b_onset: Standard deviation of a fault at its onset, per entry of `plant.estimated` [rad].
        b_step: Of its random walk per step.
        d_step: Of the disturbance's random walk per step.
        healthy: Initial probability of "none"; the others share the rest.
        one_more, one_less: Transition probabilities per step to each hypothesis with one fault more or less.
        alarm: "none" is left when its probability is below this ...
        release: ... and taken again when it is above this,
        persist: after so many samples in a row with the same verdict.

    Raises:
        NotApplicableError: The plant is not of that kind, or the settings have not one entry per fault.
    """
    inputs, sensors = fault_inputs(plant, channels), noisy_sensors(plant)
    H = linear_output(plant, sensors)
    if x0_std is None:
        raise NotApplicableError(f"needs x0_std, the spread of the initial state, which is not given for {plant.id}")
    for name, value in (("b_onset", b_onset), ("b_step", b_step)):
        if len(value) != len(plant.estimated):
            raise NotApplicableError(f"{name} needs one entry per fault of {plant.id}: {len(plant.estimated)}")
    onset, walk = np.asarray(b_onset)[inputs.estimated], np.asarray(b_step)[inputs.estimated]
    labels, sets = channel_sets(plant, inputs)
    mu0 = np.full(len(sets), (1 - healthy) / (len(sets) - 1))
    mu0[0] = healthy
    prior = prior_of(plant, sets, x0_std, onset, walk, (d0_std, d_step), mu0, transitions(sets, one_more, one_less))

    def candidate(r: Reading, label: Array) -> Array:
        assert r.probs is not None
        limit = np.where(label == 0, alarm, release)
        return np.where(r.probs[:, 0] > limit, 0, 1 + np.argmax(r.probs[:, 1:], axis=1))

    filter = bank_filter(plant, inputs, labels, sets, sensors, H, prior)
    return diagnoser_of(plant, filter, by_candidate(candidate, persist))
