"""An oracle for any plant: the augmented extended Kalman filter, told when the label changes, not to what.

At every change the fault vector's covariance is the prior's again; while there is no fault the fault vector is known to
be zero. So nothing is lost on detection, and what is left is isolation and identification. It is no ceiling: its
isolation is that of one linearised filter, and methods that weigh hypotheses isolate better without being told.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from baselines.filters.augmented_gaussian import Gaussian, gaussian_filter, reading_of
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.decision import Reading, by_candidate
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.labels import distances, magnitudes_of_labels, manifolds
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant

PER_MAGNITUDE = 3.84  # what each magnitude must gain in fit: the 95 % point of one degree of freedom


class Told(NamedTuple):
    """State of the oracle; each episode carries its own truth."""

    filter: Gaussian
    changes: Array  # (n, K + 1) bool: the label of the interval that ends at this sample is another than the one before
    acts: Array  # (n, K + 1) bool: a fault acted over it
    now: Array  # (n,) bool: a fault acts


def true_labels(plant: Plant, scenarios: Sequence[FaultScenario]) -> Array:
    """The label of each flight's samples (n, K + 1); the last one goes on where others fly longer."""
    label = np.zeros((len(scenarios), 1 + max((scenario.steps for scenario in scenarios), default=0)), np.int64)
    for row, scenario in zip(label, scenarios, strict=True):
        rows = plant.label_rows(scenario)
        row[: len(rows)], row[len(rows) :] = rows, rows[-1]
    return label


def label_changes(plant: Plant, scenarios: Sequence[FaultScenario], n: int) -> tuple[Array, Array]:
    """Where the label of n flights changes, and where a fault acts: (n, K + 1) bool each.

    Raises:
        ValueError: There are other than n scenarios.
    """
    if n != len(scenarios):
        raise ValueError(f"the oracle was told of {len(scenarios)} flights, not {n}")
    label = true_labels(plant, scenarios)
    return np.column_stack([np.zeros(n, bool), np.diff(label, axis=1) != 0]), label > 0


@diagnoser(
    "told_onset_ekf",
    "Augmented EKF, told when the label changes; for any plant",
    knows="when the label changes",
)
def told_onset_ekf(plant: Plant, belief: Belief, *, scenarios: Sequence[FaultScenario], walk: float = 0.3) -> Diagnoser:
    """The oracle.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: What it may assume of the plant.
        scenarios: One per episode; when the label changes, and whether a fault acts, is all that is read of them.
        walk: Factor on the standard deviation of the faults' random walk; small, since the jumps are told.

    Raises:
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    model = augmented(plant, belief, walk=walk)
    plain, sets, z = gaussian_filter(model, "extended"), manifolds(plant), model.z
    opened = np.diag(belief.z_size**2)
    extra = PER_MAGNITUDE * magnitudes_of_labels(plant)

    def start(n: int) -> Told:
        changes, acts = label_changes(plant, scenarios, n)
        return Told(plain.start(n), changes, acts, np.zeros(n, bool))

    def predict(s: Told, at: Interval) -> Told:
        rows, k = np.arange(len(at.k)), np.minimum(at.k, s.acts.shape[1] - 1)
        changed, now = s.changes[rows, k], s.acts[rows, k]
        X, P = s.filter.X.copy(), s.filter.P.copy()
        reset = changed | ~now
        X[reset, z] = 0.0
        P[reset, z, :] = 0.0
        P[reset, :, z] = 0.0
        P[changed & now, z, z] = opened
        return s._replace(filter=plain.predict(s.filter._replace(X=X, P=P), at), now=now)

    def update(s: Told, at: Interval, y: Array, seen: Array) -> Told:
        f = s.filter
        if (at.k == 0).any():  # before any interval there is no fault
            X, P, none = f.X.copy(), f.P.copy(), ~s.now
            X[none, z], P[none, z, :], P[none, :, z] = 0.0, 0.0, 0.0
            f = f._replace(X=X, P=P)
        return s._replace(filter=plain.update(f, at, y, seen))

    def read(s: Told) -> Reading:
        r = reading_of(model, s.filter)
        assert r.z is not None
        assert r.P is not None
        cost = np.full((len(s.now), len(plant.labels)), np.inf)
        cost[:, 0] = np.where(s.now, np.inf, 0.0)
        if s.now.any():
            found = distances(r.z[s.now], r.P[s.now], sets)
            cost[np.ix_(s.now, sets.labels)] = found.J[:, 1:] + extra[sets.labels]
        acts = s.now[:, None]
        return r._replace(z=np.where(acts, r.z, 0.0), P=np.where(acts[..., None], r.P, 0.0), cost=cost)

    rule = by_candidate(lambda r, label: np.argmin(np.asarray(r.cost), axis=1), 1)
    filter = Filter(start, predict, update, read, expect=lambda s, at: model.expect(s.filter.X[:, model.x], at))
    return diagnoser_of(plant, filter, rule)
