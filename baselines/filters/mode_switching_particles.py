"""Rao-Blackwellised particle filter with mode switching, for any plant: label histories are sampled, the rest is Gaussian.

Given which labels were true when, state, magnitudes and disturbances are followed by an extended Kalman filter (exactly, on
a linear plant): only the labels are sampled [1]. Every `branch` samples each particle is continued by every label; what that
makes too many of is thinned by the optimal resampling of discrete distributions [2]: continuations heavier than a threshold
stay as they are, the rest are drawn in strata and share it. Nothing heavy is ever lost to chance, and no two particles that
stay have the same history. A particle whose label changes begins with that label's prior magnitude.

The one random number of a resampling is a function of `seed` and of the sample's number (Philox, by counter): the same for
every episode, whatever came before, so results are causal and the same bytes anywhere.

With as many particles as there are histories it is exact Bayes; see `multiple_model` for the model of the labels.

[1] N. de Freitas, IEEE Aerospace Conference, 2002 (Rao-Blackwellised particle filtering for fault diagnosis).
[2] P. Fearnhead, P. Clifford, Journal of the Royal Statistical Society B 65(4), 2003.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from baselines.filters.multiple_model import Hypotheses, hypotheses
from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant

LEAST = 1e-12  # probability that a label is said to have at least
FEWEST = 5  # samples between those at which a label may change
MOST = 8e6  # products of a covariance's update, N^3, in a second of flight: beyond, suites take hours


class Particles(NamedTuple):
    """State: M particles, lightest last; those without weight count for nothing."""

    X: Array  # (n, M, N) state, magnitudes, disturbances
    P: Array  # (n, M, N, N)
    label: Array  # (n, M) int
    w: Array  # (n, M) weights, sum 1
    nu: Array  # (n, m) the last innovation of the particle that was heaviest after it, and
    S: Array  # (n, m, m) its covariance


def uniform(seed: int, k: Array) -> Array:
    """The random number in (0, 1) of each sample (n,)."""
    found, where = np.unique(k, return_inverse=True)
    return np.array([np.random.Generator(np.random.Philox(key=seed, counter=int(j))).random() for j in found])[where]


def threshold(q: Array, most: int) -> Array:
    """The level c (n,) with sum min(q / c, 1) = most, for weights q (n, C), more than `most` of them not 0."""
    heavy = -np.sort(-q, axis=1)[:, :most]  # A of the heaviest stay as they are: A < most
    rest = q.sum(axis=1, keepdims=True) - np.cumsum(heavy, axis=1) + heavy  # of all but the A heaviest, A = 0 .. most - 1
    c = rest / (most - np.arange(most))
    fits = heavy <= c  # the next heaviest is not heavier than the level
    return c[np.arange(len(q)), np.argmax(fits, axis=1)]


def thinned(q: Array, most: int, u: Array) -> tuple[Array, Array]:
    """Which of the continuations stay (n, most), heaviest first, and their weights; `u` (n,) in (0, 1) draws the light ones.

    Every weight's expectation is what it was [2]. Where fewer have any weight, all stay, and the rest weigh 0.
    """
    n = len(q)
    few = (q > 0).sum(axis=1) <= most
    c = np.where(few, 0.0, threshold(q, most))[:, None]
    light = (q <= c) & ~few[:, None]
    counted = np.where(light, q, 0.0)
    ends = np.cumsum(counted, axis=1)
    strata = np.floor(ends / np.where(c > 0, c, 1.0) + u[:, None])  # one is drawn for each stratum of width c
    before = np.concatenate([np.floor(u)[:, None], strata[:, :-1]], axis=1)
    drawn = light & (strata > before)
    weight = np.where(light, np.where(drawn, c, 0.0), q)
    order = np.argsort(-weight, axis=1, kind="stable")[:, :most]
    found = weight[np.arange(n)[:, None], order]
    return order, found / found.sum(axis=1, keepdims=True)


def particle_filter(b: Hypotheses, particles: int, branch: int, seed: int) -> Filter:
    """The filter. A sample's prediction is made with its update: continuations live no longer than that.

    Args:
        b: The models of the labels.
        particles: Label histories that are kept.
        branch: Samples between those at which a label may change.
        seed: Of the resampling.
    """
    model, labels, M = b.model, len(b.m0), particles
    N, m, z, x, plant = len(model.scale), len(model.R), model.z, model.x, model.plant
    assert model.lines is not None
    offset, direction = model.lines
    transition = np.linalg.matrix_power(b.transition, branch)
    alone = [model.replace(lines=(offset[j : j + 1], direction[j : j + 1]), Q=model.Q[j : j + 1]) for j in range(labels)]

    def start(n: int) -> Particles:
        X, P = np.tile(model.X0, (n, M, 1)), np.tile(model.P0, (n, M, 1, 1))
        X[..., z], P[..., z, z] = b.m0[0], b.M0[0]
        w = np.tile(np.arange(M) == 0, (n, 1)).astype(float)
        return Particles(X, P, np.zeros((n, M), np.int64), w, np.zeros((n, m)), np.tile(model.R, (n, 1, 1)))

    def continued(s: Particles) -> Particles:
        """Each particle with every label, the label changing fastest: (n, M labels, ...)."""
        label = np.tile(np.arange(labels), (len(s.w), M))
        w = (s.w[..., None] * transition[s.label]).reshape(len(s.w), -1)
        X, P = np.repeat(s.X, labels, axis=1), np.repeat(s.P, labels, axis=1)
        new = label != np.repeat(s.label, labels, axis=1)
        X[..., z] = np.where(new[..., None], b.m0[label], X[..., z])
        cut = new[..., None, None]
        P[..., z, :] = np.where(cut, 0.0, P[..., z, :])
        P[..., z] = np.where(cut, 0.0, P[..., z])
        P[..., z, z] = np.where(cut, b.M0[label], P[..., z, z])
        return s._replace(X=X, P=P, label=label, w=w)

    def moved(own: AugmentedModel, X: Array, P: Array, at: Interval, y: Array, seen: Array, go: bool) -> Any:
        """Rows one sample later, updated with it: X, P, log likelihood, innovation and its covariance."""
        if go:
            X, P = own.predict("extended", X, P, at)
        done = own.update("extended", X, P, at, y, seen)
        return done.X, done.P, done.log_likelihood, done.nu, done.S

    def followed(s: Particles, at: Interval, y: Array, seen: Array, go: bool, in_turn: bool) -> Particles:
        """All particles after the sample; `in_turn`: their labels are 0, 1, ... in turn."""
        n, C = s.w.shape
        X, P, which = s.X.reshape(-1, N), s.P.reshape(-1, N, N), s.label.ravel()
        many, home = at.of(np.repeat(np.arange(n), C)), np.repeat(np.arange(n), C)
        if in_turn:
            X, P, log, nu, S = moved(model, X, P, many, y[home], seen[home], go)
        else:
            X, P, log, nu, S = X.copy(), P.copy(), np.zeros(len(X)), np.zeros((len(X), m)), np.zeros((len(X), m, m))
            for j in np.unique(which):
                mine = np.flatnonzero((which == j) & (s.w.ravel() > 0))
                if mine.size:
                    at_j = home[mine]
                    found = moved(alone[j], X[mine], P[mine], at.of(at_j), y[at_j], seen[at_j], go)
                    X[mine], P[mine], log[mine], nu[mine], S[mine] = found
        log = np.where(s.w > 0, log.reshape(n, C), -np.inf)
        w = s.w * np.exp(log - log.max(axis=1, keepdims=True))
        w = w / w.sum(axis=1, keepdims=True)
        first = np.arange(n) * C + np.argmax(w, axis=1)
        return Particles(X.reshape(n, C, N), P.reshape(n, C, N, N), s.label, w, nu[first], S[first])

    def update(s: Particles, at: Interval, y: Array, seen: Array) -> Particles:
        first, turn = at.k == 0, (at.k > 0) & ((at.k - 1) % branch == 0)
        after = Particles(*(a.copy() for a in s))
        for group, go, branching in ((first, False, False), (turn, True, True), (~first & ~turn, True, False)):
            i = np.flatnonzero(group)
            if not i.size:
                continue
            part = Particles(*(a[i] for a in s))
            part = followed(continued(part) if branching else part, at.of(i), y[i], seen[i], go, branching)
            if branching:
                stay, weight = thinned(part.w, M, uniform(seed, at.k[i]))
                rows = np.arange(len(i))[:, None]
                part = part._replace(X=part.X[rows, stay], P=part.P[rows, stay], label=part.label[rows, stay], w=weight)
            for whole, found in zip(after, part, strict=True):
                whole[i] = found
        return after

    def read(s: Particles) -> Reading:
        n = len(s.w)
        probs = np.zeros((n, labels))
        np.add.at(probs, (np.arange(n)[:, None], s.label), s.w)
        deviation = offset[s.label] + (direction[s.label] @ s.X[..., z, None])[..., 0]  # (n, M, p)
        weight = s.w[..., None]
        mean, state = (weight * deviation).sum(axis=1), (weight * s.X[..., x]).sum(axis=1)
        gap, D = deviation - mean[:, None], direction[s.label]
        within = D @ s.P[..., z, z] @ np.swapaxes(D, -1, -2)
        spread = (weight[..., None] * (within + gap[..., :, None] * gap[..., None, :])).sum(axis=1)
        shown = {"effective particles": 1.0 / (s.w**2).sum(axis=1)}
        cost = -2.0 * np.log(np.maximum(probs, LEAST))
        return Reading(mean, spread, state, nu=s.nu, S=s.S, cost=cost, probs=probs, signals=shown)

    def expect(s: Particles, at: Interval) -> Array:
        state = (s.w[..., None] * s.X[..., x]).sum(axis=1)
        ahead = plant.propagate((at.k - 1) * plant.dt, state, at.u, None, at.d)
        return model.expect(np.where((at.k > 0)[:, None], ahead, state), at)

    return Filter(start, lambda s, at: s, update, read, expect=expect)


@diagnoser("mode_switching_particles", "Rao-Blackwellised particles over label histories, optimal resampling, for any plant")
def mode_switching_particles(
    plant: Plant, belief: Belief, calibration: Calibration, *, particles: int = 24, branch_s: float = 0.5, seed: int = 0
) -> Diagnoser:
    """The particles with their decision.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: The magnitudes of its faults, how often labels change, model errors.
        calibration: When it alarms.
        particles: Label histories that are kept.
        branch_s: Seconds between the samples at which a label may change; FEWEST samples at least.
        seed: Of the resampling.

    Raises:
        NotApplicableError: That would cost too much.
        ValueError: A number out of range.
    """
    if particles < 1 or not 0 < branch_s < np.inf or seed < 0:
        raise ValueError(
            f"particles are 1 or more, branch_s above 0, the seed 0 or more, not {particles}, {branch_s}, {seed}"
        )
    branch = max(FEWEST, round(branch_s / plant.dt))
    b = hypotheses(plant, belief)
    N, labels, rate = len(b.model.scale), len(plant.labels), 1.0 / plant.dt
    work = particles * N**3 * rate * (1 + labels / branch)
    if work > MOST:
        raise NotApplicableError(
            f"{particles} particles of {N} entries, {rate:g} samples a second and {labels} labels cost too much: {work:.1e} "
            f"products a second of flight, where {MOST:.0e} are allowed; fewer particles run"
        )
    return diagnoser_of(plant, particle_filter(b, particles, branch, seed), by_labels(plant, calibration))
