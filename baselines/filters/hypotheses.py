"""Banks of filters, one for each hypothesis about what has happened: rows of those that run, their weights, and mixtures.

A state has tables (n, count, ...) with a row for each hypothesis of an episode, the healthy one first; those that run are
numbered through all episodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import logsumexp

from fdi_gym.estimation.augmented import AugmentedModel
from fdi_gym.estimation.belief import fault_inputs
from fdi_gym.estimation.events import Events
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.mixing import mixture
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant

NEVER = -1e300  # log weight of a place where nothing is


def deviations_of(events: Events) -> tuple[Array, ...]:
    """Offsets and directions of the events, those that have a course first, as `lines` takes them."""
    return tuple(contiguous(a) for a in (events.offset, events.direction, events.steady, events.steady_direction))


def known_entries(plant: Plant, events: Events) -> Array:
    """Which entries the fault vector and the events have in common: (2, entries), positions in either."""
    entries, places = fault_inputs(plant).entries.tolist(), events.entries.tolist()
    known = [(j, places.index(e)) for j, e in enumerate(entries) if e in places]
    return np.array(known, np.int64).reshape(-1, 2).T


def live(log: Array) -> Array:
    """Which filters run (rows,) of log weights (n, count): the healthy ones, which come first, and all with a weight."""
    runs = log > NEVER
    runs[:, 0] = True
    return np.flatnonzero(runs)


def weighed(model: AugmentedModel, s: Any, rows: Array, at: Interval, y: Array, seen: Array, least: float) -> Any:
    """The state s of a bank after a sample: filters in these rows are corrected and weighed, those below `least` given up.

    model: On the rows' lines. s has X (n, count, N), P, log (n, count), and the healthy one's nu and S.
    """
    count = s.log.shape[1]
    of, healthy = rows // count, rows % count == 0
    done = model.update("extended", taken(s.X, rows), taken(s.P, rows), at.of(of), y[of], seen[of])
    log = put(s.log, rows, np.maximum(taken(s.log, rows) + done.log_likelihood, NEVER))
    log = np.where(s.log <= NEVER, NEVER, log - logsumexp(log, axis=1, keepdims=True))
    log[:, 1:] = np.where(log[:, 1:] < least, NEVER, log[:, 1:])
    return s._replace(X=put(s.X, rows, done.X), P=put(s.P, rows, done.P), log=log, nu=done.nu[healthy], S=done.S[healthy])


def merged(log: Array, X: Array, P: Array) -> tuple[Array, Array, Array]:
    """Log weight (a,), mean (a, N) and covariance (a, N, N) of the mixtures of log (a, b), X (a, b, N), P (a, b, N, N)."""
    total = np.asarray(logsumexp(log, axis=1))
    w = np.exp(log - total[:, None])[:, None]
    mean, covariance = mixture(w, X, P)
    return total, mean[:, 0], covariance[:, 0]


def taken(table: Array, rows: Array) -> Array:
    """Some rows of a table (n, count, ...), numbered through; the table itself where those are all."""
    flat = table.reshape(-1, *table.shape[2:])
    return flat if len(rows) == len(flat) else flat[rows]


def put(table: Array, rows: Array, values: Array) -> Array:
    """The table (n, count, ...) with other values in these rows."""
    if len(rows) == table.shape[0] * table.shape[1]:
        return values.reshape(table.shape)
    found = table.copy()
    found.reshape(-1, *table.shape[2:])[rows] = values
    return found
