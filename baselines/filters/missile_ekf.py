"""Augmented extended Kalman filters of the missile, one per hypothesis, on stacks of episodes.

Hypothesis l = 0..5 is the label. Its state z = (alpha, q, theta_l, r_a, r_b, r_c) holds the fault parameter and the
relative errors of the three pitching-moment coefficients. Arrays are z (n, 6, 6) and P (n, 6, 6, 6): episode,
hypothesis, then state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from fdi_gym.estimation.missile_model import Sample

from fdi_gym.estimation import missile_model as model
from fdi_gym.estimation.kalman import T, symmetric
from fdi_gym.plant import Array
from fdi_gym.plants.missile_pitch import DEG, DT, K_Q

SIGMA_THETA = np.array([0.0, 0.05, 0.05, 0.05, 2 * DEG, 0.05])  # at the start, for l = 0..5
Q_THETA = np.array([0.0, 0.10, 0.10, 0.05, 3 * DEG, 0.15]) ** 2  # per s
THETA_MIN = np.array([0.0, -1.5, -1.5, 0.0, -30 * DEG, 0.0])
THETA_MAX = np.array([0.0, 1.5, 1.5, 1.0, 30 * DEG, 1.0])
SIGMA_RHO = 0.05 / 3**0.5  # a uniform error of 5 %


class Filters(NamedTuple):
    """The six filters at sample k, after the update."""

    begun: Array  # (n,) bool: has seen its first sample
    z: Array  # (n, 6, 6)
    P: Array  # (n, 6, 6, 6)
    log_likelihood: Array  # (n, 6) of y_k, without its constant
    sample: Sample  # at k, for the next prediction


def start(n: int) -> Filters:
    """The filters before their first sample."""
    nothing = np.zeros(n)
    return Filters(np.zeros(n, bool), np.zeros((n, 6, 6)), np.zeros((n, 6, 6, 6)), np.zeros((n, 6)),
                   Sample(nothing, nothing, nothing, nothing, nothing))  # fmt: skip


def at_first_sample(sample: Sample, R: Array, sigma_theta: Array = SIGMA_THETA, sigma_rho: float = SIGMA_RHO) -> Filters:
    """The filters at k = 0, before the update: at the measurement. R (2, 2)."""
    z = np.zeros((len(sample.alpha), 6, 6))
    z[..., :2] = sample.y[:, None, :]
    P = np.zeros((*z.shape, 6))
    P[..., :2, :2] = R
    P[..., 2, 2] = sigma_theta**2
    P[..., [3, 4, 5], [3, 4, 5]] = sigma_rho**2
    return Filters(np.ones(len(z), bool), z, P, np.zeros(z.shape[:2]), sample)


def rates(z: Array, sample: Sample) -> tuple[Array, Array]:
    """The right-hand side of (alpha, q) (n, 6, 2) and its Jacobian to z (n, 6, 2, 6); the other states stand still."""
    alpha, q, theta = z[..., 0], z[..., 1], z[..., 2]
    delta, jet, mach = sample.delta[:, None], sample.jet[:, None], sample.mach[:, None]
    f, F = model.xi(alpha, q, delta, jet, mach), np.zeros((*z.shape[:2], 2, 6))
    F[..., 0, 0], F[..., 1, 0] = model.slopes(alpha, delta, mach)
    F[..., 0, 1] = 1.0
    for label in range(1, 6):
        own = alpha[:, label]
        Z, F0 = model.fault_function(label, own, sample.delta, sample.jet, sample.mach)
        f[:, label] += F0 + theta[:, label, None] * Z
        F[:, label, :, 2] = Z
        F[:, label, 1, 0] += theta[:, label] * model.fault_slope(label, own, sample.mach)
    D = np.stack(model.moment_terms(alpha, mach), axis=-1) * (K_Q * sample.mach**2)[:, None, None]
    f[..., 1] += (z[..., 3:] * D).sum(axis=-1)
    F[..., 1, 3:] = D
    return f, F


def predict(filters: Filters, sample: Sample) -> Filters:
    """From k - 1 to k by Heun's rule, u^ and M at both ends; Phi = I + E + E^2/2."""
    before = filters.sample
    z, P = filters.z.copy(), filters.P.copy()
    f1, F1 = rates(z, before)
    euler = z.copy()
    euler[..., :2] += DT * f1
    f2, F2 = rates(euler, sample)
    z[..., :2] += DT * (f1 + f2) / 2
    E = DT * (F1 + F2) / 2
    G = E + 0.5 * E[..., :2] @ E  # the first two rows of Phi; the others are those of the identity
    G[..., 0, 0] += 1.0
    G[..., 1, 1] += 1.0
    top = G @ P
    P[..., :2, :] = top
    P[..., 2:, :2] = T(top[..., 2:])
    P[..., :2, :2] = top @ T(G)
    bound = model.uncertainty_bound(before.alpha, before.mach)[:, 0]
    P[..., 0, 0] += (DT * ((0.577 * bound) ** 2 * 0.5 + 1e-8))[:, None]
    P[..., 1, 1] += DT * 1e-5
    P[..., 2, 2] += DT * Q_THETA
    return Filters(filters.begun, z, P, filters.log_likelihood, sample)


def predict_or_begin(filters: Filters, sample: Sample, initial: Filters) -> Filters:
    """`predict`, or where an episode sees its first sample the initial filters."""
    predicted, begun = predict(filters, sample), filters.begun
    if begun.all():
        return predicted
    return initial._replace(
        z=np.where(begun[:, None, None], predicted.z, initial.z),
        P=np.where(begun[:, None, None, None], predicted.P, initial.P),
    )


def update(filters: Filters, R: Array) -> Filters:
    """With y_k: K = P H' S^-1, log-likelihood -(v' S^-1 v + log det S)/2, parameters kept in their sets."""
    z, P, sample = filters.z, filters.P, filters.sample
    v = sample.y[:, None, :] - z[..., :2]
    S = P[..., :2, :2] + R
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    S_inv = np.empty_like(S)  # two by two: written out
    S_inv[..., 0, 0], S_inv[..., 1, 1] = S[..., 1, 1] / det, S[..., 0, 0] / det
    S_inv[..., 0, 1] = S_inv[..., 1, 0] = -S[..., 0, 1] / det
    white = (S_inv @ v[..., None])[..., 0]
    PHt = P[..., :, :2]
    z = z + (PHt @ white[..., None])[..., 0]
    z[..., 2] = np.clip(z[..., 2], THETA_MIN, THETA_MAX)
    P = symmetric(P - PHt @ S_inv @ T(PHt))
    return Filters(filters.begun, z, P, -0.5 * ((v * white).sum(axis=-1) + np.log(det)), sample)


def declared_theta(filters: Filters, mode: Array) -> tuple[Array, Array]:
    """Estimate and standard deviation (n, 5) for the declared label; a jam counts 1 and an undeclared fault 0."""
    theta, std = np.zeros((len(mode), 5)), np.zeros((len(mode), 5))
    for label in range(1, 6):
        if label != 4:
            theta[:, label - 1] = np.where(mode == label, filters.z[:, label, 2], 0.0)
            std[:, label - 1] = np.where(mode == label, np.sqrt(filters.P[:, label, 2, 2]), 0.0)
    theta[:, 3] = mode == 4
    return theta, std
