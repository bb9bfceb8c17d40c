"""Interacting multiple models: one filter per label of the plant, each with the magnitudes of its own faults.

Model j has the fault vector on the line of label j: theta = healthy + offset_j + D_j m, and the state [x; m; d]. The
label is a Markov chain; between samples the models exchange state and disturbance in proportion to the probability that
the label has just changed, and a model that was not in force has the magnitude's prior back. The likelihoods of the
innovations give the probabilities of the labels.

H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.augmented import Augmented, augmented
from fdi_gym.estimation.gaussian import extended, look, predict
from fdi_gym.estimation.kalman import solve
from fdi_gym.plant import Array, Plant

SMALLEST_MAGNITUDE, SLOWEST_WALK = 0.05, 1e-3  # standard deviations, in units of the mode's root mean square
LEAST = 1e-12  # probability of a label


class Bank(NamedTuple):
    """The models of all labels, stacked."""

    model: Augmented  # of [x; m; d]; row j of a stack lies on the line of label j
    m0: Array  # (labels, f) prior magnitude of each label's faults; 0 where it has fewer
    M0: Array  # (labels, f, f) its covariance
    transition: Array  # (labels, labels) from row to column


def bank(plant: Plant, process: str = "standard") -> Bank:
    """The bank of a plant, from what one of its fault processes lets one believe.

    Raises:
        NotApplicableError: No sensor has noise, or the fault vector does not enter additively.
    """
    base = augmented(plant, process)
    p, labels, n_x = base.prior, len(plant.labels), len(plant.states)
    width = max(1, *(len(label.modes) for label in plant.labels))
    number = {mode.name: i for i, mode in enumerate(plant.modes)}
    typical = np.sqrt(p.m_mean**2 + p.m_std**2)
    offset, direction = np.zeros((labels, len(p.z_size))), np.zeros((labels, len(p.z_size), width))
    m0, M0, walk = np.zeros((labels, width)), np.zeros((labels, width, width)), np.zeros((labels, width))
    for j, label in enumerate(plant.labels):
        for f, i in enumerate(sorted(number[name] for name in label.modes)):
            mode = plant.modes[i]
            offset[j] += mode.offset
            direction[j, :, f] = mode.direction
            m0[j, f], walk[j, f] = p.m_mean[i], max(p.m_walk[i], SLOWEST_WALK * typical[i]) ** 2
            M0[j, f, f] = max(p.m_std[i], SMALLEST_MAGNITUDE * typical[i]) ** 2
    N = n_x + width + len(p.disturbances)
    z, d = slice(n_x, n_x + width), slice(n_x + width, N)
    rest = [*range(n_x), *range(base.d.start, base.d.stop)]  # of the base model: all but its fault vector
    keep = [*range(n_x), *range(d.start, N)]
    Q = np.zeros((labels, N, N))
    Q[np.ix_(range(labels), keep, keep)] = base.Q[np.ix_(rest, rest)]
    Q[:, range(z.start, z.stop), range(z.start, z.stop)] = walk
    P0 = np.zeros((N, N))
    P0[np.ix_(keep, keep)] = base.P0[np.ix_(rest, rest)]
    X0, scale = np.zeros(N), np.ones(N)
    X0[keep], scale[keep] = base.X0[rest], base.scale[rest]
    scale[z] = max(float(typical.max()), 1e-12)
    limit = np.full(N, np.inf)
    change = p.changes / (labels - 1)
    H = None
    if base.H is not None and not base.H[:, base.z].any():
        H = np.zeros((len(base.R), N))
        H[:, keep] = base.H[:, rest]
    model = base._replace(z=z, d=d, scale=scale, X0=X0, P0=P0, Q=Q, limit=limit, H=H, lines=(offset, direction))
    return Bank(model, m0, M0, np.full((labels, labels), change) + (1 - change * labels) * np.eye(labels))


class Models(NamedTuple):
    """State of the bank after its sample k - 1."""

    k: int
    X: Array  # (n, labels, N)
    P: Array  # (n, labels, N, N)
    mu: Array  # (n, labels) probabilities of the labels
    known: Array  # (n, n_known)


def start(b: Bank, n: int) -> Models:
    """The bank before its first sample: healthy."""
    labels, z = len(b.m0), b.model.z
    X, P = np.tile(b.model.X0, (n, labels, 1)), np.tile(b.model.P0, (n, labels, 1, 1))
    X[..., z], P[..., z, z] = b.m0, b.M0
    mu = np.full((n, labels), LEAST)
    mu[:, 0] = 1.0
    return Models(0, X, P, mu, np.zeros((n, len(b.model.plant.known))))


def mix(b: Bank, s: Models) -> tuple[Array, Array, Array]:
    """Predicted probabilities (n, labels), and each model's mean and covariance given that its label is in force now."""
    z, labels = b.model.z, len(b.m0)
    joint = s.mu[:, :, None] * b.transition  # (n, from, to)
    c = joint.sum(axis=1)
    w = np.swapaxes(joint / c[:, None, :], 1, 2)  # (n, to, from)
    own = w[:, range(labels), range(labels)]  # that the label has not just changed
    # the common part: every model's, in proportion
    others = s.X.copy()
    others[..., z] = 0.0
    X = w @ others
    spread = others[:, None] - X[:, :, None]  # (n, to, from, N)
    P_rest = s.P.copy()
    P_rest[..., z, :] = P_rest[..., :, z] = 0.0
    N = X.shape[-1]
    P = (w @ P_rest.reshape(*P_rest.shape[:2], N * N)).reshape(P_rest.shape)
    P += np.swapaxes(w[..., None] * spread, 2, 3) @ spread
    # the magnitude: its own, or the prior where the label is new; its correlation with the rest is its own
    m, prior = s.X[..., z], b.m0
    X[..., z] = own[..., None] * m + (1 - own[..., None]) * prior
    gap = m - prior
    a = own[..., None, None]
    P[..., z, z] = a * s.P[..., z, z] + (1 - a) * (b.M0 + a * gap[..., :, None] * gap[..., None, :])
    cross = a * s.P[..., z, :]
    keep = [i for i in range(N) if not z.start <= i < z.stop]
    cross[..., keep] += (a * gap[..., :, None]) * (s.X - X)[..., None, keep]
    P[..., z, keep] = cross[..., keep]
    P[..., keep, z] = np.swapaxes(cross[..., keep], -1, -2)
    return c, X, P


def advance(b: Bank, s: Models, obs: Array) -> Models:
    """One sample: mix, predict, update every model, weigh. obs (n, n_obs)."""
    n, labels, N = s.X.shape
    at, known = b.model.read(s.k, obs, s.known)
    at = at._replace(y=np.repeat(at.y, labels, axis=0), d=None if at.d is None else np.repeat(at.d, labels, axis=0))
    if s.k == 0:
        c, X, P = s.mu, s.X, s.P
    else:
        c, X, P = mix(b, s)
    X, P = X.reshape(n * labels, N), P.reshape(n * labels, N, N)
    if s.k > 0:
        each = b.model._replace(Q=np.tile(b.model.Q, (n, 1, 1)))
        X, P = predict(each, extended, X, P, at)
    X, P, nu, S = look(b.model, extended, X, P, at)
    log = -0.5 * (nu * solve(S, nu[..., None])[..., 0]).sum(axis=1) - 0.5 * np.linalg.slogdet(S)[1]
    log = log.reshape(n, labels) + np.log(np.maximum(c, LEAST))
    mu = np.exp(log - log.max(axis=1, keepdims=True))
    mu = np.maximum(mu / mu.sum(axis=1, keepdims=True), LEAST)
    return Models(s.k + 1, X.reshape(n, labels, N), P.reshape(n, labels, N, N), mu, known)


def deviation(b: Bank, s: Models) -> Array:
    """Each model's fault vector (n, labels, p)."""
    assert b.model.lines is not None
    offset, direction = b.model.lines
    return offset + (direction @ s.X[..., b.model.z, None])[..., 0]
