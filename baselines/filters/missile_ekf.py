"""Augmented extended Kalman filters of the missile, one per hypothesis, on stacks of episodes.

Hypothesis l = 0..5 is the label. Its state z = (alpha, q, theta_l, r_a, r_b, r_c) holds the fault parameter and the
relative errors of the three pitching-moment coefficients. Arrays are z (n, 6, 6) and P (n, 6, 6, 6): episode,
hypothesis, then state. They start at the first sample at which both sensors report."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters import missile_model as model
from baselines.filters.missile_model import Known
from fdi_gym.estimation.decision import Reading, Rule, Verdict
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, correct
from fdi_gym.estimation.kalman import log_likelihood as gaussian
from fdi_gym.plant import Array
from fdi_gym.plants.missile_pitch import DEG, DT, K_Q

SIGMA_THETA = np.array([0.0, 0.05, 0.05, 0.05, 2 * DEG, 0.05])  # at the start, for l = 0..5
Q_THETA = np.array([0.0, 0.10, 0.10, 0.05, 3 * DEG, 0.15]) ** 2  # per s
THETA_MIN = np.array([0.0, -1.5, -1.5, 0.0, -30 * DEG, 0.0])
THETA_MAX = np.array([0.0, 1.5, 1.5, 1.0, 30 * DEG, 1.0])
SIGMA_RHO = 0.05 / 3**0.5  # a uniform error of 5 %
JAM = 4


class Filters(NamedTuple):
    """The six filters after a sample."""

    z: Array  # (n, 6, 6)
    P: Array  # (n, 6, 6, 6)
    log_likelihood: Array  # (n, 6) of the sample, without its constant
    alpha: Array  # (n, 6) its incidence: measured, else estimated
    known: Known


def start(n: int) -> Filters:
    """The filters before their first sample."""
    return Filters(np.zeros((n, 6, 6)), np.zeros((n, 6, 6, 6)), np.zeros((n, 6)), np.zeros((n, 6)), model.unknown(n))


def begin(f: Filters, at: Interval, y: Array, R: Array, sigma_theta: Array, sigma_rho: float) -> Filters:
    """The filters at their first sample, which they start from and are updated with. y (n, n_y), R (2, 2)."""
    z = np.zeros((len(y), 6, 6))
    z[..., :2] = y[:, None, :2]
    P = np.zeros((*z.shape, 6))
    P[..., :2, :2] = R
    P[..., 2, 2] = sigma_theta**2
    P[..., [3, 4, 5], [3, 4, 5]] = sigma_rho**2
    begun = f._replace(z=z, P=P, known=model.known(at, f.known))
    return update(begun, y, np.ones(y.shape, bool), R)


def rates(z: Array, known: Known) -> tuple[Array, Array]:
    """The right-hand side of (alpha, q) (n, 6, 2) and its Jacobian to z (n, 6, 2, 6); the other states stand still."""
    alpha, q, theta = z[..., 0], z[..., 1], z[..., 2]
    delta, jet, mach = known.delta[:, None], known.jet[:, None], known.mach[:, None]
    f, F = model.xi(alpha, q, delta, jet, mach), np.zeros((*z.shape[:2], 2, 6))
    F[..., 0, 0], F[..., 1, 0] = model.slopes(alpha, delta, mach)
    F[..., 0, 1] = 1.0
    for label in range(1, 6):
        own = alpha[:, label]
        Z, F0 = model.fault_function(label, own, known.delta, known.jet, known.mach)
        f[:, label] += F0 + theta[:, label, None] * Z
        F[:, label, :, 2] = Z
        F[:, label, 1, 0] += theta[:, label] * model.fault_slope(label, own, known.mach)
    D = np.stack(model.moment_terms(alpha, mach), axis=-1) * (K_Q * known.mach**2)[:, None, None]
    f[..., 1] += (z[..., 3:] * D).sum(axis=-1)
    F[..., 1, 3:] = D
    return f, F


def predict(f: Filters, at: Interval) -> Filters:
    """Over an interval by Heun's rule, u^ and M at both ends; Phi = I + E + E^2/2.

    Where u^ is not known at both ends, or nothing has been measured for so long, (alpha, q) may be anywhere in their range.
    """
    before, now = f.known, model.known(at, f.known)
    z, P = f.z.copy(), f.P.copy()
    f1, F1 = rates(z, before)
    euler = z.copy()
    euler[..., :2] += DT * f1
    f2, F2 = rates(euler, now)
    z[..., :2] = np.clip(z[..., :2] + DT * (f1 + f2) / 2, -model.RANGE, model.RANGE)
    E = DT * (F1 + F2) / 2
    G = E + 0.5 * E[..., :2] @ E  # the first two rows of Phi; the others are those of the identity
    G[..., 0, 0] += 1.0
    G[..., 1, 1] += 1.0
    top = G @ P
    P[..., :2, :] = top
    P[..., 2:, :2] = T(top[..., 2:])
    P[..., :2, :2] = top @ T(G)
    bound = model.uncertainty_bound(f.alpha, before.mach[:, None])[..., 0]
    P[..., 0, 0] += DT * ((0.577 * bound) ** 2 * 0.5 + 1e-8)
    P[..., 1, 1] += DT * 1e-5
    P[..., 2, 2] += DT * Q_THETA
    lost = (P[..., 0, 0] > model.RANGE[0] ** 2) | (P[..., 1, 1] > model.RANGE[1] ** 2)
    lost |= (before.held | now.held)[:, None]
    if lost.any():
        P[lost, :2, :] = P[lost, :, :2] = 0.0
        P[lost, :2, :2] = np.diag(model.RANGE**2)
    return Filters(z, P, np.zeros_like(f.log_likelihood), z[..., 0], now)


def update(f: Filters, y: Array, seen: Array, R: Array) -> Filters:
    """With the sensors of alpha and q that reported; parameters are kept in their sets. y, seen (n, n_y), R (2, 2)."""
    z, P = f.z.reshape(-1, 6), f.P.reshape(-1, 6, 6)
    y, seen = y[:, :2], seen[:, :2]
    v = (y[:, None] - f.z[..., :2]).reshape(-1, 2)
    done = correct(z, P, v, P[:, :, :2], P[:, :2, :2] + R, np.repeat(seen, 6, axis=0))
    x = done.x.reshape(f.z.shape)
    x[..., 2] = np.clip(x[..., 2], THETA_MIN, THETA_MAX)
    alpha = np.where(seen[:, :1], y[:, :1], x[..., 0])
    return Filters(x, done.P.reshape(f.P.shape), gaussian(done.nu, done.S).reshape(f.alpha.shape), alpha, f.known)


def reading(f: Filters, share: Array, cost: Array, probs: Array | None = None) -> Reading:
    """What the filters say: each hypothesis's own fault, and the mixture of their states with the shares (n, 6).

    A jam counts 1; its angle is the fin's.
    """
    n = len(share)
    z, P = f.z[:, 1:, 2].copy(), np.zeros((n, 5, 5))
    P[:, range(5), range(5)] = f.P[:, 1:, 2, 2]
    z[:, JAM - 1], P[:, JAM - 1, JAM - 1] = 1.0, 0.0
    x = model.state((share[..., None] * f.z[..., :2]).sum(axis=1), f.known)
    free = 1.0 - share[:, JAM]
    x[:, 2] = free * x[:, 2] + share[:, JAM] * f.z[:, JAM, 2]
    x[:, 3] *= free
    parameters = {"fault parameters": f.z[:, 1:, 2]}
    return Reading(z, P, x, cost=cost, probs=probs, signals=parameters)


def only_declared(rule: Rule) -> Rule:
    """The rule, reporting the fault of the label that it declares and no other."""

    def step(state: object, k: Array, r: Reading, informed: Array) -> tuple[object, Verdict]:
        state, verdict = rule.step(state, k, r, informed)
        mine = (verdict.label[:, None] == np.arange(1, 6)).astype(float)
        assert r.z is not None
        assert r.P is not None
        return state, verdict._replace(z=mine * r.z, P=mine[:, :, None] * r.P)

    return Rule(rule.start, step)
