"""The policy that PPO trains, and how it diagnoses: features of the identified model in, two layers, a decision out.

Runs without torch and stable-baselines3; `baselines.networks.reinforcement` trains it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.networks import identification as ident
from baselines.networks.identification import Model, Shape
from fdi_gym.diagnosis import Diagnoser, Diagnosis
from fdi_gym.plant import Array, Plant


def actor_tensors(state: Mapping[str, Any]) -> dict[str, Array]:
    """The actor's tensors out of the state of an SB3 `MlpPolicy`: `layers.i.weight` and `layers.i.bias`."""
    hidden = sorted({name.rsplit(".", 1)[0] for name in state if name.startswith("mlp_extractor.policy_net.")})
    layers = [*hidden, "action_net"]
    return {
        f"layers.{i}.{part}": state[f"{layer}.{part}"].cpu().numpy()
        for i, layer in enumerate(layers)
        for part in ("weight", "bias")
    }


def shapes(plant: Plant, shape: Shape, task: str, hidden: int) -> dict[str, tuple[int, ...]]:
    """The shapes of all arrays of a stored policy: the actor's and the model's."""
    found = ident.shapes(plant, shape)
    answers = len(plant.labels) if task == "isolation" else len(plant.estimated)
    for i, (a, b) in enumerate(itertools.pairwise([*found["model.mean"], hidden, hidden, answers])):
        found |= {f"layers.{i}.weight": (b, a), f"layers.{i}.bias": (b,)}
    return found


def answer(tensors: Mapping[str, Array], x: Array) -> Array:
    """What the actor says of features (n, n_features): logits (n, labels), or the mean action (n, n_estimated)."""
    last = sum(name.endswith(".bias") for name in tensors) - 1
    for i in range(last + 1):
        x = x @ tensors[f"layers.{i}.weight"].T + tensors[f"layers.{i}.bias"]
        x = np.tanh(x) if i < last else x
    return x


def streaming(plant: Plant, shape: Shape, model: Model, tensors: Mapping[str, Array], task: str) -> Diagnoser:
    """A diagnoser that follows the features, asks the actor at each complete step and holds its answer until the next.

    Args:
        plant: The plant.
        shape, model: What it sees.
        tensors: The actor's, under the names of `actor_tensors`.
        task: "isolation", or "identification": actions in [-1, 1] stand for the bounds of the estimated quantity.
    """
    actor = {name: value.astype(float) for name, value in tensors.items() if name.startswith("layers.")}
    labels, isolates = len(plant.labels), task == "isolation"
    low, high = (np.array([getattr(s, bound) for s in plant.estimated]) for bound in ("low", "high"))
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)

    def init(n: int) -> Any:
        none = np.zeros(n, np.int64)
        said = Diagnosis(none > 0, none, label_probs=np.full((n, labels), 1 / labels))
        return 0, ident.begin(plant, shape, n), said if isolates else Diagnosis(none > 0, none, np.tile(healthy, (n, 1)))

    def decide(x: Array) -> Diagnosis:
        found = answer(actor, x)
        if not isolates:
            none = np.zeros(len(x), np.int64)
            return Diagnosis(none > 0, none, low + (high - low) * (np.clip(found, -1, 1) + 1) / 2)
        probs = np.exp(found - found.max(axis=1, keepdims=True))
        mode = found.argmax(axis=1)
        return Diagnosis(mode > 0, mode, label_probs=probs / probs.sum(axis=1, keepdims=True))

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, stream, said = state
        stream, seen = ident.add(plant, shape, model, stream, obs, k)
        said = said if seen is None else decide(seen)
        return (k + 1, stream, said), said

    return Diagnoser(init, update)
