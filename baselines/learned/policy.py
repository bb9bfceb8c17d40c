"""How a policy diagnoses: features of the identified model in, two layers, a decision out. Runs on NumPy."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.learned import features as feat
from baselines.learned import streams, weights
from baselines.learned.features import FeatureShape
from fdi_gym.diagnosis import Diagnoser, Diagnosis
from fdi_gym.plant import Array, Plant


def tensor_shapes(plant: Plant, shape: FeatureShape, task: str, hidden: int) -> dict[str, tuple[int, ...]]:
    """The shapes of all arrays of a stored policy: the actor's and the model's."""
    found = feat.tensor_shapes(plant, shape)
    answers = len(plant.labels) if task == "isolation" else len(plant.estimated)
    for i, (a, b) in enumerate(itertools.pairwise([*found["model.mean"], hidden, hidden, answers])):
        found |= {f"layers.{i}.weight": (b, a), f"layers.{i}.bias": (b,)}
    return found


def actor(tensors: Mapping[str, Array], x: Array) -> Array:
    """What the actor says of features (n, n_features): logits (n, labels), or the mean action (n, n_estimated)."""
    for i in range(3):
        x = x @ tensors[f"layers.{i}.weight"].T + tensors[f"layers.{i}.bias"]
        x = np.tanh(x) if i < 2 else x
    return x


def policy_diagnoser(plant: Plant, shape: FeatureShape, tensors: Mapping[str, Array], task: str) -> Diagnoser:
    """A diagnoser that follows the features, asks the actor at each complete step and holds its answer until the next.

    Args:
        plant: The plant.
        shape: Of the features.
        tensors: The actor's and the model's.
        task: "isolation", or "identification": actions in [-1, 1] stand for the bounds of the estimated quantity.
    """
    model = weights.model_of(tensors)
    layers = {name: value.astype(float) for name, value in tensors.items() if name.startswith("layers.")}
    labels, isolates = len(plant.labels), task == "isolation"
    low, high = (np.array([getattr(s, bound) for s in plant.estimated]) for bound in ("low", "high"))
    healthy = plant.healthy

    def init(n: int) -> Any:
        none = np.zeros(n, np.int64)
        first = Diagnosis(none > 0, none, label_probs=np.full((n, labels), 1 / labels))
        return 0, streams.begin(plant, shape, n), first if isolates else Diagnosis(none > 0, none, np.tile(healthy, (n, 1)))

    def decide(x: Array) -> Diagnosis:
        answer = actor(layers, x)
        if not isolates:
            none = np.zeros(len(x), np.int64)
            return Diagnosis(none > 0, none, low + (high - low) * (np.clip(answer, -1, 1) + 1) / 2)
        probs = np.exp(answer - answer.max(axis=1, keepdims=True))
        label = answer.argmax(axis=1)
        return Diagnosis(label > 0, label, label_probs=probs / probs.sum(axis=1, keepdims=True))

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, stream, diagnosis = state
        stream, features = streams.add(plant, shape, model, stream, obs, k)
        diagnosis = diagnosis if features is None else decide(features)
        return (k + 1, stream, diagnosis), diagnosis

    return Diagnoser(init, update)
