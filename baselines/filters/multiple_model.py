"""Interacting multiple models for any plant: one extended Kalman filter per label, with the magnitudes of its own faults.

Model j has the fault vector on the line, or plane, of label j: theta = healthy + offset_j + D_j m, and the state [x; m; d].
The label is a Markov chain; between samples the models exchange state and disturbance in proportion to the probability that
the label has just changed, and a model that was not in force has the magnitude's prior back. The likelihoods of the
innovations give the probabilities of the labels; the label is the one whose probability beats the calibrated thresholds.

H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation import mixing
from fdi_gym.estimation.augmented import AugmentedModel, augmented, on_lines
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.labels import magnitudes_of_labels
from fdi_gym.plant import Array, Plant

SMALLEST_MAGNITUDE, SLOWEST_WALK = 0.05, 1e-3  # standard deviations, in units of the mode's root mean square
LEAST = 1e-12  # probability of a label


class Hypotheses(NamedTuple):
    """The models of all labels, stacked."""

    model: AugmentedModel  # of [x; m; d]; row j of a stack lies on the line of label j
    m0: Array  # (labels, f) prior magnitude of each label's faults; 0 where it has fewer
    M0: Array  # (labels, f, f) its covariance
    transition: Array  # (labels, labels) from row to column


def hypotheses(plant: Plant, belief: Belief) -> Hypotheses:
    """The models of a plant, from what is believed of it.

    Raises:
        NotApplicableError: The fault vector does not enter additively.
    """
    base, p = augmented(plant, belief), belief
    labels = len(plant.labels)
    width = max(1, *magnitudes_of_labels(plant).tolist())
    number = {mode.name: i for i, mode in enumerate(plant.modes)}
    typical = np.sqrt(p.m_mean**2 + p.m_std**2)
    offset, direction = np.zeros((labels, len(p.z_size))), np.zeros((labels, len(p.z_size), width))
    m0, M0, walk = np.zeros((labels, width)), np.zeros((labels, width, width)), np.zeros((labels, width))
    for j, label in enumerate(plant.labels):
        active = sorted(number[name] for name in label.modes)
        for i in active:
            offset[j] += plant.modes[i].offset
        lines = [
            (line, k) for i in active for line, k in zip(plant.modes[i].directions, plant.magnitudes_of[i], strict=True)
        ]
        for f, (line, k) in enumerate(lines):
            direction[j, :, f] = line
            m0[j, f], walk[j, f] = p.m_mean[k], max(p.m_walk[k], SLOWEST_WALK * typical[k]) ** 2
            M0[j, f, f] = max(p.m_std[k], SMALLEST_MAGNITUDE * typical[k]) ** 2
    model = on_lines(base, offset, direction, walk, max(float(typical.max()), 1e-12))
    change = p.changes / (labels - 1)
    return Hypotheses(model, m0, M0, np.full((labels, labels), change) + (1 - change * labels) * np.eye(labels))


class Models(NamedTuple):
    """State of the bank."""

    X: Array  # (n, labels, N)
    P: Array  # (n, labels, N, N)
    mu: Array  # (n, labels) probabilities of the labels
    c: Array  # (n, labels) predicted ones
    nu: Array  # (n, m) innovation of the first label's filter
    S: Array  # (n, m, m) its covariance


def bank(b: Hypotheses) -> Filter:
    """The filter of all models."""
    model, labels = b.model, len(b.m0)
    N, m, z, x = len(model.scale), len(model.R), model.z, model.x
    assert model.lines is not None
    offset, direction = model.lines

    def start(n: int) -> Models:
        X, P = np.tile(model.X0, (n, labels, 1)), np.tile(model.P0, (n, labels, 1, 1))
        X[..., z], P[..., z, z] = b.m0, b.M0
        mu = np.full((n, labels), LEAST)
        mu[:, 0] = 1.0
        return Models(X, P, mu, mu, np.zeros((n, m)), np.tile(model.R, (n, 1, 1)))

    def predict(s: Models, at: Interval) -> Models:
        n = len(s.mu)
        c, w = mixing.ahead(s.mu, b.transition)
        X, P = mixing.mix(w, s.X, s.P, z, b.m0, b.M0)
        X, P = model.predict("extended", X.reshape(-1, N), P.reshape(-1, N, N), at)
        return s._replace(X=X.reshape(n, labels, N), P=P.reshape(n, labels, N, N), c=c)

    def update(s: Models, at: Interval, y: Array, seen: Array) -> Models:
        n = len(s.mu)
        done = model.update("extended", s.X.reshape(-1, N), s.P.reshape(-1, N, N), at, y, seen)
        mu = mixing.weigh(s.c, done.log_likelihood.reshape(n, labels), LEAST)
        nu, S = done.nu.reshape(n, labels, m)[:, 0], done.S.reshape(n, labels, m, m)[:, 0]
        return Models(done.X.reshape(n, labels, N), done.P.reshape(n, labels, N, N), mu, mu, nu, S)

    def state(s: Models) -> Array:
        mu = s.mu / s.mu.sum(axis=1, keepdims=True)
        return (mu[..., None] * s.X[..., x]).sum(axis=1)

    def read(s: Models) -> Reading:
        mu = s.mu / s.mu.sum(axis=1, keepdims=True)
        mean, P = mixing.over_lines(mu, offset, direction, s.X[..., z], s.P[..., z, z])
        return Reading(mean, P, state(s), nu=s.nu, S=s.S, cost=-2.0 * np.log(s.mu), probs=mu)

    return Filter(
        start, predict, update, read, expect=lambda s, at: model.expect(state(s), at), innovation=lambda s: (s.nu, s.S)
    )


@diagnoser(
    "multiple_model_ekf", "Interacting multiple models, one extended Kalman filter per label, for any plant", reference=True
)
def multiple_model_ekf(plant: Plant, belief: Belief, calibration: Calibration) -> Diagnoser:
    """The bank with its decision.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: The magnitudes of its faults, how often labels change, model errors.
        calibration: When it alarms.
    """
    return diagnoser_of(plant, bank(hypotheses(plant, belief)), by_labels(plant, calibration))
