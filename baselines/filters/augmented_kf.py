"""Augmented Kalman filter: the fault parameter appended to the state.

The yardstick of every two-stage filter: the same statistics, one larger covariance. Any forgetting of the fault
parameter's covariance is process noise Pz- - Pz on it, so the augmented filter follows each rule exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import scipy.linalg

from baselines.filters.two_stage_kf import age, aging, decision_rule, initial_covariances
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation import gaussian
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.linear import linear_model
from fdi_gym.estimation.sweep import sweep_of
from fdi_gym.plant import Array, Plant


class AugmentedState(NamedTuple):
    """State of the filter: X = [x; z] with its covariance."""

    X: Array  # (n, n_x + p)
    P: Array  # (n, n_x + p, n_x + p)
    nu: Array  # (n, n_y) innovation
    S: Array  # (n, n_y, n_y)
    seen: Array  # (n,) sensors in it


class Augmented(NamedTuple):
    """The model of F = [A E_k; 0 I], and what a sample adds to the covariance."""

    model: gaussian.Model
    Q: Array  # (N, N)


def augmented_model(plant: Plant) -> Augmented:
    """Of a linear plant, with the fault parameter as it is.

    Raises:
        NotApplicableError: The plant is nonlinear.
    """
    linear, n_y, p = linear_model(plant), len(plant.outputs), len(plant.theta)
    scale = [s.scale for s in (*plant.states, *plant.theta)]
    model = gaussian.bind(plant, scale=scale, entries=range(p), H=np.hstack([linear.C, np.zeros((n_y, p))]))
    return Augmented(model, np.asarray(scipy.linalg.block_diag(plant.Q, np.zeros((p, p)))))


def augmented_filter(plant: Plant, known: Augmented, aged: Callable[[Array], Array]) -> Filter:
    """The Kalman filter, with the time update `aged` of the fault parameter's covariance."""
    P_x, P_z = initial_covariances(plant)
    n_x, n_y, N, model = len(P_x), len(plant.outputs), len(P_x) + len(P_z), known.model
    P0 = np.asarray(scipy.linalg.block_diag(P_x, P_z))
    Q, R, t = known.Q[None], plant.R[None], np.zeros(1)  # a linear plant knows no time

    def start(n: int) -> AugmentedState:
        S = np.tile(np.eye(n_y), (n, 1, 1))
        return AugmentedState(np.zeros((n, N)), np.tile(P0, (n, 1, 1)), np.zeros((n, n_y)), S, np.zeros(n, np.int64))

    def predict(s: AugmentedState, at: Interval) -> AugmentedState:
        X, P = gaussian.predict(model, "extended", s.X, s.P, t, at.u, None, at.noise(Q))
        before = s.P[:, n_x:, n_x:]
        after = aged(before)
        if after is not before:
            P[:, n_x:, n_x:] += after - before
        return s._replace(X=X, P=P)

    def update(s: AugmentedState, at: Interval, y: Array, seen: Array) -> AugmentedState:
        done = gaussian.update(model, "extended", s.X, s.P, t, at.u, None, y, seen, R)
        return AugmentedState(done.X, done.P, done.nu, done.S, done.count)

    def read(s: AugmentedState) -> Reading:
        return Reading(s.X[:, n_x:], s.P[:, n_x:, n_x:], s.X[:, :n_x], s.P[:, :n_x, :n_x], s.nu, s.S, s.seen)

    return Filter(start, predict, update, read, first_sample=False)


@diagnoser("augmented_kf", "Augmented Kalman filter, exponential forgetting", reference=True, forgetting="exponential")
def augmented_kf(
    plant: Plant,
    *,
    q_bias: float = 0.0,
    forgetting: str = "none",
    factor: float = 0.99,
    a_min: float = 1e-4,
    a_max: float = 1.0,
    decision: str = "distance",
    threshold: float = 8.0,
    release_after: int = 50,
    position: Mapping[str, float] | None = None,
) -> Diagnoser:
    """The augmented Kalman filter; arguments and errors as of `two_stage_kf`."""
    known, ages = augmented_model(plant), (q_bias, forgetting, factor, a_min, a_max)
    filter = augmented_filter(plant, known, aging(*ages))
    rule = decision_rule(plant, decision, threshold, release_after, position)
    sweep = sweep_of(plant, known.model, "extended", known.Q, plant.R, rule.labelling, age(*ages))
    return diagnoser_of(plant, filter, rule, sweep)
