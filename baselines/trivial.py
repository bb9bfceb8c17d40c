"""Null and random: the floor of every table, and a check of the harness."""

from __future__ import annotations

from typing import Any

import numpy as np

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
        bits = np.ascontiguousarray(obs).view(np.uint64).sum(axis=1, dtype=np.uint64)[:, None]
        with np.errstate(over="ignore"):  # splitmix64, one stream per answer
            h = bits + np.uint64(0x9E3779B97F4A7C15) * np.arange(1, len(low) + 2, dtype=np.uint64)
            h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            h = h ^ (h >> np.uint64(31))
        share = (h >> np.uint64(11)) / 2.0**53
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
        bits = np.ascontiguousarray(np.nan_to_num(obs)).view(np.uint64).sum(axis=1, dtype=np.uint64)
        with np.errstate(over="ignore"):
            drawn = (bits * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(33)) % np.uint64(count)
        label = np.where(state > 0, state, np.minimum(1 + drawn.astype(np.int64), len(plant.labels) - 1))
        return label, Diagnosis(np.ones(len(obs), bool), label, estimates[label])

    return Diagnoser(lambda n: np.zeros(n, np.int64), update, gaps=True)
