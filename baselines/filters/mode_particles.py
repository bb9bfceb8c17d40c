"""Rao-Blackwellised particles for any plant: which label acts is a particle's, all else its extended Kalman filter's.

A particle is a history of labels. Given it, state, fault magnitudes and disturbances [x; m; d] are Gaussian, as in
`multiple_model`, and the likelihood of the innovations is the particle's weight. At every few samples each particle may
change to any label, with the label's prior magnitudes; of all successors so many go on. Since a change is rare, almost all
of the weight is in few of them, and drawing among them would lose all the others: those above a threshold go on as they
are, of the rest a systematic sample does, each with the threshold's weight, and the threshold is the one that leaves so
many. No two particles are the same, the expected weight of each is what it was, and of all such schemes this one changes the
weights least.

A. Doucet, N. de Freitas, K. Murphy, S. Russell, Uncertainty in Artificial Intelligence, 2000 (Rao-Blackwellisation); N. de
Freitas et al., Proceedings of the IEEE 92(3), 2004 (diagnosis by particles); P. Fearnhead, P. Clifford, Journal of the Royal
Statistical Society B 65(4), 2003 (the resampling).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from baselines.filters.multiple_model import Hypotheses, hypotheses
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.diagnosis.contract import among
from fdi_gym.estimation import mixing
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, NotApplicableError, Plant

LEAST = 1e-12  # probability of a label
CHANCE = 0.06  # that the label changes from one sample at which it may to the next
MOST = 1.9e5  # evaluations of the plant's model per second of flight
OFFSETS = np.random.default_rng(20_030_423).random(4096)  # of the systematic samples, by sample number, the same for all


class Particles(NamedTuple):
    """State: K particles of each episode."""

    X: Array  # (n, K, N)
    P: Array  # (n, K, N, N)
    log: Array  # (n, K) log weights, which sum to 1; -inf where there is no particle
    label: Array  # (n, K) int
    nu: Array  # (n, m) innovation of the heaviest healthy particle, or of the first
    S: Array  # (n, m, m) its covariance


def survivors(log: Array, count: int, offset: Array) -> tuple[Array, Array]:
    """Which of the particles log (n, C) go on, `count` of each row, as (n, count) in their order, and their log weights.

    Those heavier than c go on as they are, the others with probability w / c and weight c, by systematic sampling from
    `offset` (n,) in [0, 1); c is such that min(w / c, 1) sums to `count`. Places that are left over have weight 0.
    """
    n, C = log.shape
    w = np.exp(log - logsumexp(log, axis=1, keepdims=True))
    down = -np.sort(-w, axis=1)
    rest = np.cumsum(down[:, ::-1], axis=1)[:, ::-1]  # (n, C) weight of those from each place on
    free = count - np.arange(C)  # places for them, if all before it are kept
    keep = np.argmax(down * free <= rest, axis=1)  # how many are
    each = np.arange(n)
    c = rest[each, keep] / (count - keep)
    kept = w > c[:, None]
    places = np.cumsum(np.where(kept, 0.0, w / np.maximum(c, 1e-300)[:, None]), axis=1) + offset[:, None]
    crossed = np.diff(np.floor(places), axis=1, prepend=np.floor(offset)[:, None]) > 0
    taken = kept | (crossed & (w > 0))
    order = np.sort(np.argsort(~taken, axis=1, kind="stable")[:, :count], axis=1)  # rounding may take one more, or less
    at = each[:, None], order
    with np.errstate(divide="ignore"):
        found = np.where(taken[at], np.log(np.maximum(w[at], c[:, None])), -np.inf)
    return order, found - logsumexp(found, axis=1, keepdims=True)


def particle_filter(b: Hypotheses, count: int, every: int) -> Filter:
    """The filter of `count` particles, each of which may change its label at every `every`-th sample."""
    model, labels = b.model, len(b.m0)
    N, m, z, x = len(model.scale), len(model.R), model.z, model.x
    assert model.lines is not None
    offset, direction = model.lines
    changes = every * (b.transition - np.eye(labels))  # over `every` samples; its rows sum to 0
    log_transition = np.log(np.maximum(np.eye(labels) + changes, LEAST))

    def start(n: int) -> Particles:
        X, P = np.tile(model.X0, (n, count, 1)), np.tile(model.P0, (n, count, 1, 1))
        X[..., z], P[..., z, z] = b.m0[0], b.M0[0]
        log = np.full((n, count), -np.inf)
        log[:, 0] = 0.0
        return Particles(X, P, log, np.zeros((n, count), np.int64), np.zeros((n, m)), np.tile(model.R, (n, 1, 1)))

    def branched(s: Particles, k: Array) -> Particles:
        """Each particle stays or changes; so many of all those go on."""
        n, each = len(k), np.arange(len(k))[:, None]
        log = (s.log[..., None] + log_transition[s.label]).reshape(n, -1)
        order, log = survivors(log, count, OFFSETS[k // every % len(OFFSETS)])
        parent, label = np.divmod(order, labels)
        X, P = s.X[each, parent], s.P[each, parent]
        new = label != s.label[each, parent]
        X[..., z] = np.where(new[..., None], b.m0[label], X[..., z])
        P[..., z, :] = np.where(new[..., None, None], 0.0, P[..., z, :])
        P[..., :, z] = np.where(new[..., None, None], 0.0, P[..., :, z])
        P[..., z, z] = np.where(new[..., None, None], b.M0[label], P[..., z, z])
        return s._replace(X=X, P=P, log=log, label=label)

    def predict(s: Particles, at: Interval) -> Particles:
        s = among(at.k % every == 0, lambda: branched(s, at.k), s)
        which = s.label.reshape(-1)
        mine = model.on(offset[which], direction[which], model.Q[which])
        X, P = mine.predict("extended", s.X.reshape(-1, N), s.P.reshape(-1, N, N), at)
        return s._replace(X=X.reshape(s.X.shape), P=P.reshape(s.P.shape))

    def update(s: Particles, at: Interval, y: Array, seen: Array) -> Particles:
        n, which = len(y), s.label.reshape(-1)
        mine = model.on(offset[which], direction[which])
        done = mine.update("extended", s.X.reshape(-1, N), s.P.reshape(-1, N, N), at, y, seen)
        log = s.log + done.log_likelihood.reshape(n, count)
        log -= logsumexp(log, axis=1, keepdims=True)
        shown = np.arange(n), np.argmax(np.where(s.label == 0, log, -np.inf), axis=1)
        nu, S = done.nu.reshape(n, count, m)[shown], done.S.reshape(n, count, m, m)[shown]
        return Particles(done.X.reshape(s.X.shape), done.P.reshape(s.P.shape), log, s.label, nu, S)

    def state(s: Particles) -> Array:
        return (np.exp(s.log)[..., None] * s.X[..., x]).sum(axis=1)

    def read(s: Particles) -> Reading:
        w = np.exp(s.log)
        mu = np.stack([(w * (s.label == j)).sum(axis=1) for j in range(labels)], axis=1)
        mu = np.maximum(mu, LEAST) / np.maximum(mu, LEAST).sum(axis=1, keepdims=True)
        mean, P = mixing.over_lines(w, offset[s.label], direction[s.label], s.X[..., z], s.P[..., z, z])
        return Reading(mean, P, state(s), nu=s.nu, S=s.S, cost=-2.0 * np.log(mu), probs=mu)

    return Filter(
        start, predict, update, read, expect=lambda s, at: model.expect(state(s), at), innovation=lambda s: (s.nu, s.S)
    )


@diagnoser("mode_particles", "Rao-Blackwellised particle filter over the labels, for any plant", reference=True)
def mode_particles(
    plant: Plant, belief: Belief, calibration: Calibration, particles: int = 64, every: int | None = None
) -> Diagnoser:
    """Particles with their decision.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: The magnitudes of its faults, how often labels change, model errors.
        calibration: When it alarms.
        particles: How many go on.
        every: Samples from one possible change of the label to the next. Default: so many that 6 % of them bring one. Where
            they are many fewer, all places are soon taken by changes that no sample has yet told from none.

    Raises:
        NotApplicableError: The fault vector does not enter additively, or so many particles cost too much.
        ValueError: particles or every below 1.
    """
    if every is None:
        every = max(1, round(CHANCE / max(belief.changes, 1e-5)))
    if particles < 1 or every < 1:
        raise ValueError(f"particles and every are at least 1, not {particles} and {every}")
    b = hypotheses(plant, belief)
    rate = particles * (1 + 2 * len(b.model.scale)) / plant.dt
    if rate > MOST:
        raise NotApplicableError(
            f"{particles} particles cost too much: {rate:.0f} evaluations of the model of {plant.id} a second of flight, "
            f"where {MOST:.0f} are allowed"
        )
    return diagnoser_of(plant, particle_filter(b, particles, every), by_labels(plant, calibration))
