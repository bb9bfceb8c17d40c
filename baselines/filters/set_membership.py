"""Set membership: a label is given up when no bounded noise explains what was measured. For linear plants.

Noise within so many standard deviations, a start within so many of its spread, and faults within their sizes leave the state
in a set: a zonotope c + G [-1, 1]^q for each label, moved by the model and cut by the measurements with the gain that leaves
the least |G|^2. The set of a fault's label allows it at any size, none included, at every sample, so that it holds whenever
the fault began. Where a measurement is outside what a label's set can give, nothing that the label allows has happened: it
is refuted, and begins anew from a set without bounds. So long as the noise keeps its bounds there are no false alarms at
all, which no other method here can say. The price: noise at its bound for as long as it takes may do what a fault does, so
that a fault no larger than that is never found, however long it lasts.

The label is none until that is refuted; then the fault that is not, or of several the one whose set fits best.

C. Combastel, Automatica 55, 2015 (zonotopes and the gain); A. Girard, Hybrid Systems: Computation and Control, 2005 (fewer
generators); M. Blanke, M. Kinnaert, J. Lunze, M. Staroswiecki, Diagnosis and Fault-Tolerant Control, 2016 (consistency).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief, fault_inputs
from fdi_gym.estimation.decision import Reading, by_candidate
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, right_divide
from fdi_gym.estimation.linear import linear_model
from fdi_gym.plant import Array, Plant

WIDE = 1e3  # a set without bounds, in units of the scales
SIZES = 3.0  # standard deviations about its mean within which the size of a fault is
GENERATORS = 8  # of a set, for each of its dimensions
PACE = 20  # samples over which a set's fit is averaged


class Sets(NamedTuple):
    """State: a zonotope for each label."""

    c: Array  # (n, labels, N) centres
    G: Array  # (n, labels, N, q) generators
    since: Array  # (n, labels) samples since the label was refuted; as many as matter where it never was
    fit: Array  # (n, labels) mean of how far the measurements are from the centre, 1 at the edge of what can be


class Deviations(NamedTuple):
    """What each label's fault vector may be: mid + half [-1, 1]^f, none included."""

    mid: Array  # (labels, p)
    half: Array  # (labels, p, f)


def deviations(plant: Plant, belief: Belief) -> Deviations:
    """The faults of all labels, at the sizes that are believed."""
    names = [mode.name for mode in plant.modes]
    width = 1 + max(sum(len(plant.magnitudes_of[names.index(name)]) for name in label.modes) for label in plant.labels)
    p = len(belief.z_size)
    mid, half = np.zeros((len(plant.labels), p)), np.zeros((len(plant.labels), p, width))
    for j, label in enumerate(plant.labels):
        column = 1
        for i in sorted(names.index(name) for name in label.modes):
            mid[j] += 0.5 * np.asarray(plant.modes[i].offset)
            half[j, :, 0] += 0.5 * np.asarray(plant.modes[i].offset)
            for line, k in zip(plant.modes[i].directions, plant.magnitudes_of[i], strict=True):
                low = min(0.0, belief.m_mean[k] - SIZES * belief.m_std[k])
                high = max(0.0, belief.m_mean[k] + SIZES * belief.m_std[k])
                mid[j] += 0.5 * (low + high) * np.asarray(line)
                half[j, :, column] = 0.5 * (high - low) * np.asarray(line)
                column += 1
    return Deviations(mid, half)


def fewer(G: Array, count: int) -> Array:
    """At most `count` generators (..., N, count) of a zonotope that holds that of G (..., N, q)."""
    N, q = G.shape[-2:]
    if q <= count:
        return np.concatenate([G, np.zeros((*G.shape[:-1], count - q))], axis=-1)
    size = np.abs(G)
    order = np.argsort(-(size.sum(axis=-2) - size.max(axis=-2)), axis=-1, kind="stable")[..., None, :]
    whole = np.take_along_axis(G, order[..., : count - N], axis=-1)
    box = np.take_along_axis(size, order[..., count - N :], axis=-1).sum(axis=-1)
    return np.concatenate([whole, box[..., None] * np.eye(N)], axis=-1)


def root(P: Array) -> Array:
    """L (..., N, N) with P = L L', for a covariance that may be singular."""
    values, vectors = np.linalg.eigh(P)
    return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]


def set_filter(plant: Plant, model: AugmentedModel, faults: Deviations, bound: float, memory: int) -> Filter:
    """The filter of all labels' sets."""
    H, V = model.H, bound * np.sqrt(np.diag(model.R))
    if H is None or plant.bare is not None:
        raise NotApplicableError(f"needs sensors that are linear and do not fail; those of {plant.id} are not so")
    equations, entries = linear_model(plant), fault_inputs(plant).entries
    N, m, labels, n_x = len(model.scale), len(model.R), len(faults.mid), len(plant.states)
    count, eye = GENERATORS * N, np.eye(N)
    W = bound * root(model.Q)
    at = Interval(np.ones(1, np.int64), plant.trim_command[None], None, np.zeros((1, len(plant.known))))
    F = model.jacobian_f(np.zeros((1, N)), at)[1][0]
    wide, V_all = WIDE * np.diag(model.scale), np.diag(V)

    def start(n: int) -> Sets:
        G = fewer(bound * root(model.P0), count)
        return Sets(np.tile(model.X0, (n, labels, 1)), np.tile(G, (n, labels, 1, 1)), np.full((n, labels), memory),
                    np.zeros((n, labels)))  # fmt: skip

    def predict(s: Sets, at: Interval) -> Sets:
        n, E = len(at.k), np.zeros((len(at.k), 1, N, len(entries)))
        E[:, 0, :n_x] = equations.E(at.u)[:, :, entries]
        own = [np.broadcast_to(W, (n, labels, N, N)), E @ faults.half]
        if at.Q_held is not None:  # what a command that did not report may be
            held = np.zeros((n, 1, N, N))
            held[:, 0, :n_x, :n_x] = bound * root(at.Q_held)
            own.append(np.broadcast_to(held, (n, labels, N, N)))
        c = model.f(s.c, at) + (E @ faults.mid[..., None])[..., 0]
        return s._replace(c=c, G=fewer(np.concatenate([F @ s.G, *own], axis=-1), count))

    def update(s: Sets, at: Interval, y: Array, seen: Array) -> Sets:
        n = len(y)
        heard = seen[:, None, model.sensors]
        e = np.where(heard, y[:, None, model.sensors] - s.c @ H.T, 0.0)
        far = (np.abs(e) / (np.abs(H @ s.G).sum(axis=-1) + V)).max(axis=-1)
        refuted = far > 1.0
        c, G = np.where(refuted[..., None], model.X0, s.c), s.G
        if refuted.any():
            G = np.where(refuted[..., None, None], fewer(wide, count), G)
            e = np.where(heard, y[:, None, model.sensors] - c @ H.T, 0.0)
        G, every = G.reshape(-1, N, count), np.repeat(heard[:, 0], labels, axis=0)
        cross = G @ T(H @ G)
        nu, S, cross = masked(every, e.reshape(-1, m), H @ cross + V_all**2, cross)
        K = right_divide(cross, S)
        c = c.reshape(-1, N) + (K @ nu[..., None])[..., 0]
        G = fewer(np.concatenate([(eye - K @ H) @ G, K @ V_all], axis=-1), count)
        told = heard.any(axis=-1)
        since = np.where(told, np.where(refuted, 0, np.minimum(s.since + 1, memory)), s.since)
        fit = np.where(told, s.fit + (np.minimum(far, WIDE) - s.fit) / PACE, s.fit)
        return Sets(c.reshape(n, labels, N), G.reshape(n, labels, N, count), since, fit)

    def read(s: Sets) -> Reading:
        return Reading(x=s.c[:, 0, :n_x], signals={"since": s.since.astype(float), "fit": s.fit})

    return Filter(start, predict, update, read, expect=lambda s, at: model.expect(s.c[:, 0, :n_x], at))


@diagnoser("set_membership", "Zonotopes of all labels, which bounded noise never leaves, for linear plants", reference=True)
def set_membership(plant: Plant, belief: Belief, bound: float = 3.0, memory: int = 100) -> Diagnoser:
    """The sets with their label.

    Args:
        plant: A linear plant whose sensors have noise.
        belief: The sizes of its faults, noise and model errors.
        bound: Standard deviations that noise, start and model errors keep within.
        memory: Samples for which a label that was refuted is not named, or for none, before which no fault is given up.

    Raises:
        NotApplicableError: The plant or a sensor is not linear, or sensors may fail.
        ValueError: A bound that is not positive, or memory below 1.
    """
    if not bound > 0 or memory < 1:
        raise ValueError(f"bound is positive and memory at least 1, not {bound} and {memory}")
    linear_model(plant)
    model = augmented(plant, belief, faults=False)
    filter = set_filter(plant, model, deviations(plant, belief), bound, memory)

    def candidate(r: Reading, label: Array) -> Array:
        assert r.signals is not None
        can, fit = r.signals["since"] >= memory, r.signals["fit"]
        order = np.where(can, fit, WIDE + fit)
        order[:, 0] = np.inf
        best, each = np.argmin(order, axis=1), np.arange(len(label))
        stays = (label > 0) & (can[each, label] | ~can[:, 1:].any(axis=1))
        return np.where(can[:, 0], 0, np.where(stays, label, best))

    return diagnoser_of(plant, filter, by_candidate(candidate, 1))
