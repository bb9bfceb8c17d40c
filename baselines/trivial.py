"""Null and random: the floor of every table, and a check of the harness."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines.draws import uniform
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.plant import Array, Plant


@diagnoser("null", "Always healthy", reference=True, sensors=True)
def null(plant: Plant) -> Diagnoser:
    """Says that there is no fault, whatever it sees."""
    theta = plant.healthy

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        n = len(obs)
        probs = np.zeros((n, len(plant.labels)))
        probs[:, 0] = 1.0
        return state, Diagnosis(np.zeros(n, bool), np.zeros(n, np.int64), np.tile(theta, (n, 1)), None, probs)

    return Diagnoser(lambda n: (), update, gaps=True)


@diagnoser("random", "A guess, uniform over the labels, at every sample", reference=True, sensors=True)
def random(plant: Plant) -> Diagnoser:
    """Guesses label and parameters uniformly, from a hash of the sample: the same in any batch and on any run."""
    low, high = (np.array([getattr(s, end) for s in plant.estimated], float) for end in ("low", "high"))
    labels = len(plant.labels)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        share = uniform(obs, 1 + len(low))
        mode = np.minimum((share[:, 0] * labels).astype(np.int64), labels - 1)
        probs = np.full((len(obs), labels), 1.0 / labels)
        return state, Diagnosis(mode > 0, mode, low + (high - low) * share[:, 1:], None, probs)

    return Diagnoser(lambda n: (), update)


@diagnoser("false_alarm", "One fault all the time, from flight to flight another", sensors=True)
def false_alarm(plant: Plant) -> Diagnoser:
    """Names one fault of two thirds of its reach, whatever it sees: which one is a hash of the first sample.

    Where diagnoses are allowed for, it shows what a false alarm does to a healthy flight.
    """
    estimates = np.tile(plant.healthy, (len(plant.labels), 1))
    for i, label in enumerate(plant.labels):
        for mode in plant.modes:
            if mode.name in label.modes:
                low, high = mode.reaches.T
                estimates[i] += np.array(mode.offset) + (low + 2 / 3 * (high - low)) @ mode.directions
    count = max(len(plant.labels) - 1, 1)

    def update(state: Array, obs: Array) -> tuple[Array, Diagnosis]:
        drawn = 1 + (uniform(np.nan_to_num(obs), 1)[:, 0] * count).astype(np.int64)
        label = np.where(state > 0, state, np.minimum(drawn, len(plant.labels) - 1))
        return label, Diagnosis(np.ones(len(obs), bool), label, estimates[label])

    return Diagnoser(lambda n: np.zeros(n, np.int64), update, gaps=True)
