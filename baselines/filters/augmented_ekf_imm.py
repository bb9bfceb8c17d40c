"""Interacting multiple models over the augmented extended Kalman filters: follows faults that come and go.

The six filters of the bank exchange their estimates before each prediction, weighted by the probability that the
fault has just begun or ended. Mode 0 forgets the fault parameter; a fault's mode restarts it from a prior where the
fault is new. The label is the most probable mode.

H. A. P. Blom, Y. Bar-Shalom, IEEE TAC 33(8), 1988; for faults Y. Zhang, X. R. Li, IEEE Trans. Aerospace and Electronic
Systems 34(4), 1998.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from fdi_gym.estimation.missile_ekf import Filters

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation import missile_ekf as ekf
from fdi_gym.estimation import missile_model as model
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import DEG, DT

RESTART_SD = np.array([0.0, 0.2, 0.2, 0.1, 2 * DEG, 0.2])  # of theta where a fault begins, l = 0..5
RESTART_MEAN = np.array([0.0, 0.0, 0.0, 0.1, np.nan, 0.3])  # a jam begins at delta^
SIGMA_RHO = 0.08 / 3**0.5
MU_MIN = 1e-8


class IMM(NamedTuple):
    """State at sample k."""

    filters: Filters
    mu: Array  # (n, 6) mode probabilities


def transition(p: float) -> Array:
    """Mode transitions (6, 6): none to each fault with p/5, each fault to none with p, no fault to another."""
    Pi = (1 - p) * np.eye(6)
    Pi[0, 1:], Pi[1:, 0] = p / 5, p
    return Pi


def matched(weights: list[Array], parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Mean (n, m, 6) and covariance (n, m, 6, 6) of a mixture, spread of the means included; weights (n, m) sum to 1."""
    mean = np.sum([w[..., None] * z for w, (z, _) in zip(weights, parts, strict=True)], axis=0)
    P = np.zeros((*mean.shape, mean.shape[-1]))
    for w, (z, covariance) in zip(weights, parts, strict=True):
        d = z - mean
        P += w[..., None, None] * (covariance + d[..., :, None] * d[..., None, :])
    return mean, P


def without_theta(z: Array, P: Array) -> tuple[Array, Array]:
    """The estimate with the fault parameter at 0, known exactly."""
    z, P = z.copy(), P.copy()
    z[..., 2], P[..., 2, :], P[..., :, 2] = 0.0, 0.0, 0.0
    return z, P


def mix(state: IMM, Pi: Array) -> IMM:
    """The filters' interaction before a prediction, and the predicted mode probabilities."""
    f, mu = state
    joint = mu[:, :, None] * Pi  # (n, from, to)
    ahead = joint.sum(axis=1)
    share = joint / ahead[:, None, :]
    healthy = without_theta(f.z, f.P)
    z, P = np.empty_like(f.z), np.empty_like(f.P)
    parts = [(healthy[0][:, i : i + 1], healthy[1][:, i : i + 1]) for i in range(6)]
    z[:, :1], P[:, :1] = matched([share[:, i, :1] for i in range(6)], parts)
    begun_z, begun_P = np.repeat(healthy[0][:, :1], 5, axis=1), np.repeat(healthy[1][:, :1], 5, axis=1)
    begun_z[..., 2], begun_P[..., 2, 2] = RESTART_MEAN[1:], RESTART_SD[1:] ** 2
    begun_z[:, 3, 2] = f.sample.delta
    own = np.diagonal(share, axis1=1, axis2=2)[:, 1:]
    z[:, 1:], P[:, 1:] = matched([own, share[:, 0, 1:]], [(f.z[:, 1:], f.P[:, 1:]), (begun_z, begun_P)])
    return IMM(f._replace(z=z, P=P), ahead)


@diagnoser("augmented_ekf_imm", "Augmented EKFs as interacting multiple models")
@diagnoser("augmented_ekf_mode_probabilities", "The bank's filters with mode probabilities, no interaction",
           interaction=False, dwell=4.0, sigma_rho=ekf.SIGMA_RHO)  # fmt: skip
def augmented_ekf_imm(
    plant: Plant, *, dwell: float = 1.5, sigma_rho: float = SIGMA_RHO, interaction: bool = True
) -> Diagnoser:
    """The interacting filters.

    Args:
        plant: The missile.
        dwell: Mean time in a mode [s].
        sigma_rho: Initial standard deviation of the moment coefficients' errors.
        interaction: Mix the estimates; without it the filters run alone, as in the bank, and only mu is filtered.

    Raises:
        NotApplicableError: Another plant, or one without sensor noise.
    """
    model.require_missile(plant, "the interacting filter bank", noisy=True)
    R, Pi = plant.R[:2, :2], transition(DT / dwell)
    sigma_theta = RESTART_SD if interaction else ekf.SIGMA_THETA

    def init(n: int) -> IMM:
        return IMM(ekf.start(n), np.tile(np.eye(6)[0], (n, 1)))

    def update(state: IMM, obs: Array) -> tuple[IMM, Diagnosis]:
        sample, begun = model.read(plant, obs), state.filters.begun
        mixed = mix(state, Pi) if interaction else IMM(state.filters, state.mu @ Pi)
        initial = ekf.at_first_sample(sample, R, sigma_theta, sigma_rho)
        filters = ekf.update(ekf.predict_or_begin(mixed.filters, sample, initial), R)
        mu = np.where(begun[:, None], mixed.mu, state.mu)
        mu = mu * np.exp(filters.log_likelihood - filters.log_likelihood.max(axis=1, keepdims=True))
        mu = np.maximum(mu / mu.sum(axis=1, keepdims=True), MU_MIN)
        mode = np.argmax(mu, axis=1)
        answer = Diagnosis(mode > 0, mode, *ekf.declared_theta(filters, mode), mu / mu.sum(axis=1, keepdims=True))
        return IMM(filters, mu), answer

    return Diagnoser(init, update)
