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
from scipy.special import logsumexp

from baselines.filters import missile_model as model
from baselines.filters.missile_model import Known
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.decision import Reading, Rule, Verdict
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, symmetric, times
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


class Told(NamedTuple):
    """State after a sample."""

    windows: Array  # (n, w, 2) first and end step of each
    known: Known
    first: Tracked  # nominal model
    second: Tracked  # with the fin where it was at the last onset
    jam: Array  # (n,) that angle
    free: Information  # of fault-free samples about rho
    window: Information  # of the samples since the onset, fault columns included
    jammed: Information  # the same of the second filter
    log: Array  # (n, 6) log evidence of the labels
    size: Array  # (n, 4) size of each linear label


def most_probable() -> Rule:
    """The most probable label at every sample: the times are known, so nothing has to persist."""

    def step(s: None, k: Array, r: Reading, informed: Array) -> tuple[None, Verdict]:
        label = np.argmax(np.asarray(r.probs), axis=1)
        return None, Verdict(label > 0, label)

    return Rule(lambda n: None, step)


@diagnoser(
    "innovation_oracle",
    "Evidence of the innovations under the process's priors, within the known windows of faults",
    knows="when each fault begins and ends",
    ceiling=True,
)
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

    certain = np.where(np.arange(6) == 0, 0.0, -np.inf)  # there is no fault

    def start(n: int) -> Told:
        if n != len(scenarios):
            raise ValueError(f"the oracle was told of {len(scenarios)} flights, not {n}")
        times_of = [[(f.onset, NEVER if f.end is None else f.end) for f in sorted(s.faults, key=lambda f: f.onset)]
                    for s in scenarios]  # fmt: skip
        if not hard:
            times_of = [windows or [(PSEUDO_ONSET, NEVER)] for windows in times_of]
        longest = max(1, *(len(windows) for windows in times_of))
        windows = np.array([windows + [(NEVER, NEVER)] * (longest - len(windows)) for windows in times_of], np.int64)
        x, P, none = np.zeros((n, 2)), np.tile(R, (n, 1, 1)), np.zeros(n)
        return Told(windows, model.unknown(n), Tracked(x, P, np.zeros((n, 2, columns))), Tracked(x, P, np.zeros((n, 2, m))),
                    none, nothing(n, m), nothing(n, columns), nothing(n, m), np.tile(certain, (n, 1)),
                    np.zeros((n, len(LINEAR))))  # fmt: skip

    def inside(o: Told, k: Array) -> Array:
        """(n, w): the interval that ends at k was under this window's fault."""
        on, end = o.windows[..., 0], o.windows[..., 1]
        return (on < k[:, None]) & (k[:, None] <= end)

    def begin(o: Told, at: Interval, y: Array) -> Told:
        now, x = model.known(at, o.known), y[:, :2]
        o = o._replace(known=now, first=o.first._replace(x=x), second=o.second._replace(x=x), jam=now.delta)
        return observe(o, at, y, np.ones(y.shape, bool))

    def forward(o: Told, at: Interval) -> Told:
        now, within = model.known(at, o.known), inside(o, at.k)
        active = np.asarray(within.any(axis=1))
        since = np.where(active, at.k - np.where(within, o.windows[..., 0], 0).max(axis=1), 0) * DT
        earlier, beta = (1 - np.exp(-p.rates * np.maximum(t, 0.0)[:, None]) for t in (since - DT, since))
        first = predict(o.first, o.known, now, m, (earlier, beta))
        before, after = (known._replace(delta=np.where(active, o.jam, known.delta)) for known in (o.known, now))
        return o._replace(known=now, first=first, second=predict(o.second, before, after, m, None))

    def observe(o: Told, at: Interval, y: Array, seen: Array) -> Told:
        k, within, (on, end) = at.k, inside(o, at.k), np.moveaxis(o.windows, 2, 0)
        active, opens = np.asarray(within.any(axis=1)), np.asarray((on == k[:, None]).any(axis=1))
        settled = ~(active | ((end < k[:, None]) & (k[:, None] <= end + SETTLE)).any(axis=1))
        first, told = update(o.first, y[:, :2], seen[:, :2], R)
        second, told_jammed = update(o.second, y[:, :2], seen[:, :2], R)
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
        log, size, due = o.log, o.size, active & (k % every == 0)
        if due.any():
            since = np.where(active, k - np.where(within, on, 0).max(axis=1), 0) * DT
            found = evidence(free, window, jammed, 1 - np.exp(-p.rates * since[:, None]), p)
            candidates = found.log if none_allowed else np.where(np.arange(6) == 0, -np.inf, found.log)
            log, size = np.where(due[:, None], candidates, log), np.where(due[:, None], found.size, size)
        log = np.where(active[:, None], log, certain)  # outside the windows the answer is none
        return Told(
            o.windows, o.known, first, second, np.where(opens, o.known.delta, o.jam), free, window, jammed, log, size
        )

    def read(o: Told) -> Reading:
        probs = np.exp(o.log - logsumexp(o.log, axis=1, keepdims=True))
        label, z = np.argmax(o.log, axis=1), np.zeros((len(probs), 5))
        for i, l in enumerate(LINEAR):  # noqa: E741
            z[:, l - 1] = np.where(label == l, o.size[:, i], 0.0)
        z[:, 3] = label == 4
        return Reading(z, cost=-2.0 * o.log, probs=probs)

    filter = Filter(start, forward, observe, read, True, begin, model.SENSORS)
    return diagnoser_of(plant, filter, most_probable())
