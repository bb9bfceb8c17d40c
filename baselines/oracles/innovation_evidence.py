"""What innovations of a nominal filter say about unknown constants: their sensitivities, and the evidence of each label.

To first order the innovations depend linearly on the constants (the coefficient errors, which are a nuisance, and the
faults' sizes, on a grid of growth rates), so the sensitivities to a unit of each are propagated along. Under Gaussian
priors the evidence of a label is then a closed form.

Sensitivities of innovations to a fault: A. S. Willsky, H. L. Jones, IEEE TAC 21(1), 1976.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from baselines.filters import missile_model as model
from baselines.filters.missile_model import Known
from fdi_gym.estimation.kalman import T, masked, symmetric, times
from fdi_gym.plant import Array
from fdi_gym.plants.missile_pitch import DT

LINEAR = (1, 2, 3, 5)  # labels whose size enters the innovations linearly; 4 is the jam
Q = DT * np.diag([1e-8, 2e-5])


class Priors(NamedTuple):
    """What the oracle expects."""

    rho: Array  # (m,) standard deviations of the coefficient errors
    rates: Array  # (g,) growth rates [1/s]
    mu: Array  # (4, 2) mean sizes, both signs
    sd: Array  # (4,) standard deviations of the sizes


def priors(sizes: Sequence[tuple[float, float]], rates: tuple[float, float], rho: float, fin: float) -> Priors:
    """Gaussian priors with the moments of uniform ones; labels 1 and 2 take either sign. fin = 0: d_n, d_m exact."""
    low, high = np.array(sizes).T
    mean = (low + high) / 2
    bounds = [rho] * 6 + ([fin] * 2 if fin else [])
    return Priors(
        np.array(bounds) / np.sqrt(3),
        np.geomspace(*rates, 7),
        mean[:, None] * np.where(np.isin(LINEAR, (1, 2))[:, None], [1.0, -1.0], 1.0),
        (high - low) / np.sqrt(12),
    )


class Tracked(NamedTuple):
    """A filter of (alpha, q) with the sensitivities of its error to c unknown constants, after the update at k."""

    x: Array  # (n, 2)
    P: Array  # (n, 2, 2)
    s: Array  # (n, 2, c)


class Information(NamedTuple):
    """What innovations v = X phi + noise say about phi."""

    A: Array  # (n, c, c) sum of X' S^-1 X
    b: Array  # (n, c) sum of X' S^-1 v
    c: Array  # (n,) sum of v' S^-1 v + log det S

    def add(self, other: Information, where: Array) -> Information:
        """The sum, where the mask (n,) is set."""
        return Information(*(a + np.where(where.reshape(-1, *[1] * (a.ndim - 1)), b, 0)
                             for a, b in zip(self, other, strict=True)))  # fmt: skip

    def keep(self, where: Array) -> Information:
        """Zero where the mask (n,) is not set."""
        return Information(*(np.where(where.reshape(-1, *[1] * (a.ndim - 1)), a, 0) for a in self))


def nothing(n: int, c: int) -> Information:
    """No information."""
    return Information(np.zeros((n, c, c)), np.zeros((n, c)), np.zeros(n))


def regressors(alpha: Array, known: Known, m: int, beta: Array | None) -> Array:
    """B (n, 2, m + 4 g): the coefficient errors' columns, then beta Z of each linear label by growth rate."""
    columns = [model.uncertainty_regressors(alpha, known.mach)]
    if m == 8:
        columns.append(model.fin(alpha, known.mach)[:, :, None] * known.delta[:, None, None] * np.eye(2))
    if beta is not None:
        for label in LINEAR:
            Z, _ = model.fault_function(label, alpha, known.delta, known.jet, known.mach)
            columns.append(Z[:, :, None] * beta[:, None, :])
    return np.concatenate(columns, axis=-1)


def predict(f: Tracked, before: Known, now: Known, m: int, betas: tuple[Array, Array] | None) -> Tracked:
    """From k - 1 to k by Heun's rule; the sensitivities gain Ts (Phi B_{k-1} + B_k)/2.

    Where the actuators are not known at both ends, or nothing was measured for long, the state is lost: it may be anywhere.
    """

    def jacobian(alpha: Array, known: Known) -> Array:
        F = np.zeros((len(alpha), 2, 2))
        F[:, 0, 0], F[:, 1, 0] = model.slopes(alpha, known.delta, known.mach)
        F[:, 0, 1] = 1.0
        return F

    first, second = betas if betas is not None else (None, None)
    alpha, q = f.x.T
    f1 = model.xi(alpha, q, before.delta, before.jet, before.mach)
    euler = f.x + DT * f1
    f2 = model.xi(euler[:, 0], euler[:, 1], now.delta, now.jet, now.mach)
    E = DT * (jacobian(alpha, before) + jacobian(euler[:, 0], now)) / 2
    Phi = np.eye(2) + E + E @ E / 2
    B1, B2 = regressors(alpha, before, m, first), regressors(euler[:, 0], now, m, second)
    x = np.clip(f.x + DT * (f1 + f2) / 2, -model.RANGE, model.RANGE)
    P, s = Phi @ f.P @ T(Phi) + Q, Phi @ f.s + DT * (Phi @ B1 + B2) / 2
    lost = before.held | now.held | (np.einsum("nii->ni", P) > model.RANGE**2).any(axis=1)
    if lost.any():
        P[lost], s[lost] = np.diag(model.RANGE**2), 0.0
    return Tracked(x, P, s)


def update(f: Tracked, y: Array, seen: Array, R: Array) -> tuple[Tracked, Information]:
    """With what was measured at k, y and seen (n, 2), and what the innovation says."""
    v, S, PHt, HsT = masked(seen, y - f.x, f.P + R, f.P, T(f.s))
    Hs = T(HsT)
    K = PHt @ np.linalg.inv(S)  # two by two, used on many columns
    weighted = np.linalg.solve(S, np.concatenate([Hs, v[..., None]], axis=-1))
    found = HsT @ weighted
    c = (v * weighted[..., -1]).sum(axis=-1) + np.linalg.slogdet(S)[1]
    after = Tracked(f.x + times(K, v), symmetric(f.P - K @ T(PHt)), f.s - K @ Hs)
    return after, Information(found[..., :-1], found[..., -1], c)


class Marginal(NamedTuple):
    """Log evidence of the labels (n, 6), up to a constant, and the size of each linear label now (n, 4)."""

    log: Array
    size: Array


def evidence(free: Information, window: Information, jammed: Information, beta: Array, p: Priors) -> Marginal:
    """Marginal likelihoods of the window's innovations, given what the fault-free samples say about rho."""
    m = len(p.rho)
    prior = free.A + np.diag(1 / p.rho**2)

    def marginal(part: Information) -> tuple[Array, Array]:
        """Without a fault column: log evidence, and M^-1 times (h, all columns of A)."""
        M, h = prior + part.A[:, :m, :m], free.b + part.b[:, :m]
        solved = np.linalg.solve(M, np.concatenate([h[..., None], part.A[:, :m, m:]], axis=-1))
        log = -0.5 * part.c + 0.5 * (h * solved[..., 0]).sum(axis=-1) - 0.5 * np.linalg.slogdet(M)[1]
        return log, solved

    log, solved = marginal(window)
    cross = window.A[:, :m, m:]
    shape = (len(log), len(LINEAR), len(p.rates), 1)
    c = np.einsum("njj->nj", window.A[:, m:, m:]) - (cross * solved[..., 1:]).sum(axis=1)
    e = window.b[:, m:] - (cross * solved[..., :1]).sum(axis=1)
    c, e = c.reshape(shape), e.reshape(shape)
    mu, variance = p.mu[:, None, :], (p.sd**2)[:, None, None]
    mean = (e + mu / variance) / (c + 1 / variance)  # (n, 4, g, 2)
    gain = 0.5 * (mean**2 * (c + 1 / variance) - mu**2 / variance - np.log1p(c * variance))
    total = np.asarray(logsumexp(gain, axis=(2, 3)))
    share = np.exp(gain - total[:, :, None, None])
    logs = np.zeros((len(log), 6))
    logs[:, LINEAR] = log[:, None] + total - np.log(2 * len(p.rates))
    logs[:, 0], logs[:, 4] = log, marginal(jammed)[0]
    return Marginal(logs, (share * mean * beta[:, None, :, None]).sum(axis=(2, 3)))
