"""Bayesian reference that knows when a fault acts, but not which: the ceiling of the missile's tables.

A filter of the nominal, healthy model produces innovations. To first order they depend linearly on the unknown
constants, so the sensitivities of the innovations to a unit of each are propagated along (nuisance: the coefficient
errors; faults: their sizes, on a grid of growth rates). Under Gaussian priors the evidence of each class is then a
closed form, and the largest decides. A jam changes the model too much for that and has a filter of its own, whose fin
stands where it was at the onset.

It linearises and uses Gaussian priors: a good reference, not a strict bound. It is no diagnoser, since it is told the
times. Sensitivities of innovations to a fault: A. S. Willsky, H. L. Jones, IEEE TAC 21(1), 1976."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from fdi_gym.estimation.missile_model import Sample
from scipy.special import logsumexp

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation import missile_model as model
from fdi_gym.estimation.kalman import T, symmetric, times
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import DT

LINEAR = (1, 2, 3, 5)  # labels whose size enters the innovations linearly; 4 is the jam
Q = DT * np.diag([1e-8, 2e-5])
PSEUDO_ONSET = 1000  # of a flight without a fault
SETTLE = 100  # samples after a window that don't count as fault-free
NEVER = 1 << 40


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


def regressors(alpha: Array, sample: Sample, m: int, beta: Array | None) -> Array:
    """B (n, 2, m + 4 g): the coefficient errors' columns, then beta Z of each linear label by growth rate."""
    columns = [model.uncertainty_regressors(alpha, sample.mach)]
    if m == 8:
        columns.append(model.fin(alpha, sample.mach)[:, :, None] * sample.delta[:, None, None] * np.eye(2))
    if beta is not None:
        for label in LINEAR:
            Z, _ = model.fault_function(label, alpha, sample.delta, sample.jet, sample.mach)
            columns.append(Z[:, :, None] * beta[:, None, :])
    return np.concatenate(columns, axis=-1)


def predict(f: Tracked, before: Sample, now: Sample, m: int, betas: tuple[Array, Array] | None) -> Tracked:
    """From k - 1 to k by Heun's rule; the sensitivities gain Ts (Phi B_{k-1} + B_k)/2."""

    def jacobian(alpha: Array, sample: Sample) -> Array:
        F = np.zeros((len(alpha), 2, 2))
        F[:, 0, 0], F[:, 1, 0] = model.slopes(alpha, sample.delta, sample.mach)
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
    return Tracked(f.x + DT * (f1 + f2) / 2, Phi @ f.P @ T(Phi) + Q, Phi @ f.s + DT * (Phi @ B1 + B2) / 2)


def update(f: Tracked, y: Array, R: Array) -> tuple[Tracked, Information]:
    """With y_k, and what the innovation says."""
    v, S = y - f.x, f.P + R
    K = f.P @ np.linalg.inv(S)  # two by two, used on many columns
    weighted = np.linalg.solve(S, np.concatenate([f.s, v[..., None]], axis=-1))
    found = T(f.s) @ weighted
    c = (v * weighted[..., -1]).sum(axis=-1) + np.linalg.slogdet(S)[1]
    after = Tracked(f.x + times(K, v), symmetric(f.P - K @ f.P), f.s - K @ f.s)
    return after, Information(found[..., :-1], found[..., -1], c)


class Evidence(NamedTuple):
    """Log evidence of the labels (n, 6), up to a constant, and the size of each linear label now (n, 4)."""

    log: Array
    size: Array


def evidence(free: Information, window: Information, jammed: Information, beta: Array, p: Priors) -> Evidence:
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
    return Evidence(logs, (share * mean * beta[:, None, :, None]).sum(axis=(2, 3)))


class Oracle(NamedTuple):
    """State at sample k."""

    k: int  # samples shown so far
    begun: Array  # (n,) bool: has seen its first sample
    windows: Array  # (n, w, 2) first and end step of each
    sample: Sample
    first: Tracked  # nominal model
    second: Tracked  # with the fin where it was at the last onset
    held: Array  # (n,) that angle
    free: Information  # of fault-free samples about rho
    window: Information  # of the samples since the onset, fault columns included
    jammed: Information  # the same of the second filter
    said: Diagnosis


@diagnoser("innovation_oracle", "Knows the onset: evidence of the innovations under the process's priors", clairvoyant=True)
def innovation_oracle(
    plant: Plant, *, scenarios: Sequence[FaultScenario], hard: bool = False, every: int = 1, none_allowed: bool = True
) -> Diagnoser:
    """The oracle.

    Args:
        plant: The missile.
        scenarios: One per episode; onsets and ends are all that is read of them.
        hard: Priors of the process "hard" and no question asked outside its windows; else those of "standard", with a
            question asked from 10 s on where there is no fault.
        every: Samples between two evaluations.
        none_allowed: Label 0 is among the candidates inside a window.

    Raises:
        NotApplicableError: Another plant, or one without sensor noise.
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    model.require_missile(plant, "the innovation oracle", noisy=True)
    scale = float(plant.options["fault_scale"])
    if hard:
        sizes, p_rates, rho, fin = [(0.08, 0.30), (0.08, 0.30), (0.05, 0.20), (0.15, 0.45)], (0.5, 3.0), 0.08, 0.05
    else:
        sizes, p_rates, rho, fin = [(0.1, 0.7), (0.1, 0.7), (0.05, 0.40), (0.3, 1.0)], (0.15, 2.0), 0.05, 0.0
    p = priors([(scale * low, scale * high) for low, high in sizes], p_rates, rho, fin)
    m, columns = len(p.rho), len(p.rho) + len(LINEAR) * len(p.rates)
    R = plant.R[:2, :2]

    def init(n: int) -> Oracle:
        if n != len(scenarios):
            raise ValueError(f"the oracle was told of {len(scenarios)} flights, not {n}")
        told = [[(f.onset, NEVER if f.end is None else f.end) for f in sorted(s.faults, key=lambda f: f.onset)]
                for s in scenarios]  # fmt: skip
        if not hard:
            told = [windows or [(PSEUDO_ONSET, NEVER)] for windows in told]
        longest = max(1, *(len(windows) for windows in told))
        windows = np.array([windows + [(NEVER, NEVER)] * (longest - len(windows)) for windows in told], dtype=np.int64)
        x, P, none = np.zeros((n, 2)), np.tile(R, (n, 1, 1)), np.zeros(n)
        said = Diagnosis(np.zeros(n, bool), np.zeros(n, np.int64), np.zeros((n, 5)), None, np.eye(6)[np.zeros(n, int)])
        return Oracle(0, np.zeros(n, bool), windows, Sample(none, none, none, none, none),
                      Tracked(x, P, np.zeros((n, 2, columns))), Tracked(x, P, np.zeros((n, 2, m))), none,
                      nothing(n, m), nothing(n, columns), nothing(n, m), said)  # fmt: skip

    def observe(o: Oracle, obs: Array) -> tuple[Oracle, Diagnosis]:
        now, k = model.read(plant, obs), o.k
        on, end = o.windows[..., 0], o.windows[..., 1]
        inside = (on < k) & (k <= end)  # the interval that ends at k was under a fault
        active, opens = np.asarray(inside.any(axis=1)), np.asarray((on == k).any(axis=1))
        settled = ~(active | ((end < k) & (k <= end + SETTLE)).any(axis=1))
        since = np.where(active, k - np.where(inside, on, 0).max(axis=1), 0) * DT
        beta = 1 - np.exp(-p.rates * since[:, None])
        earlier = 1 - np.exp(-p.rates * np.maximum(since - DT, 0.0)[:, None])
        first = predict(o.first, o.sample, now, m, (earlier, beta))
        jam_before, jam_now = (s._replace(delta=np.where(active, o.held, s.delta)) for s in (o.sample, now))
        second = predict(o.second, jam_before, jam_now, m, None)
        if not o.begun.all():  # the first sample of an episode: its filters start there
            first, second = (begin(f, o.begun, now) for f in (first, second))
        first, told = update(first, now.y, R)
        second, told_jammed = update(second, now.y, R)
        rho_only = Information(told.A[:, :m, :m], told.b[:, :m], told.c)
        free = o.free.add(rho_only, settled)
        window = o.window.keep(~opens).add(told, active)
        jammed = o.jammed.keep(~opens).add(told_jammed, active)
        if opens.any():
            fresh = opens[:, None, None]
            clean = np.concatenate([first.s[..., :m], np.zeros_like(first.s[..., m:])], axis=-1)
            first = first._replace(s=np.where(fresh, clean, first.s))
            second = Tracked(np.where(opens[:, None], first.x, second.x), np.where(fresh, first.P, second.P),
                             np.where(fresh, first.s[..., :m], second.s))  # fmt: skip
        said = o.said
        if k % every == 0 and active.any():
            said = answer(evidence(free, window, jammed, beta, p))
        said = silent(said, active)
        held = np.where(opens, now.delta, o.held)
        return Oracle(k + 1, np.ones(len(obs), bool), o.windows, now, first, second, held, free, window, jammed, said), said

    def answer(found: Evidence) -> Diagnosis:
        log = found.log.copy()
        if not none_allowed:
            log[:, 0] = -np.inf
        mode = np.argmax(log, axis=1)
        theta = np.zeros((len(mode), 5))
        for i, label in enumerate(LINEAR):
            theta[:, label - 1] = np.where(mode == label, found.size[:, i], 0.0)
        theta[:, 3] = mode == 4
        probs = np.exp(log - logsumexp(log, axis=1, keepdims=True))
        return Diagnosis(mode > 0, mode, theta, None, probs)

    def silent(said: Diagnosis, active: Array) -> Diagnosis:
        """Outside the windows the answer is none."""
        none = np.eye(6)[np.zeros(len(active), int)]
        assert said.estimate is not None
        assert said.label_probs is not None
        return Diagnosis(said.alarm & active, np.where(active, said.label, 0), said.estimate * active[:, None], None,
                         np.where(active[:, None], said.label_probs, none))  # fmt: skip

    def begin(f: Tracked, begun: Array, sample: Sample) -> Tracked:
        mask = begun[:, None, None]
        return Tracked(np.where(begun[:, None], f.x, sample.y), np.where(mask, f.P, R), np.where(mask, f.s, 0.0))

    return Diagnoser(init, observe)
