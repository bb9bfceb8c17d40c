"""A learned prober (PPO): what a diagnoser believes and the newest observation in, a probe out. Runs on NumPy.

`python -m baselines.probing._training` makes the weights.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.learned.policy import actor
from baselines.learned.weights import read_tensors
from fdi_gym.agents import Prober
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, NotApplicableError, Plant

FOLDER = Path(__file__).parent / "weights"


class Drawn(NamedTuple):
    """The last probe (n,), decisions so far (n,), and each flight's place in its batch (n,), of which its draws are."""

    last: Array
    count: Array
    place: Array


def begin(n: int) -> Drawn:
    """At the first decision."""
    return Drawn(np.zeros(n, np.int64), np.zeros(n, np.int64), np.arange(n))


def drawn(s: Drawn, logits: Array, seed: int) -> Drawn:
    """A probe (n,) by the policy's probabilities; the likeliest is nearly always none, since a probe pays only at times."""
    noise = [np.random.default_rng([seed, *key]).gumbel(size=logits.shape[1]) for key in zip(s.place, s.count, strict=True)]
    return Drawn((logits + noise).argmax(axis=1), s.count + 1, s.place)


def prober(plant: Plant, *, process: str = "standard", variant: str = "", seed: int = 0) -> Prober:
    """A probe drawn by the policy.

    Args:
        plant: The plant.
        process: The fault process that it was trained for.
        variant: Of the training, as in the name of the file; "" for the one that is meant to be used.
        seed: Of the draws; the i-th flight of a batch has its own.

    Raises:
        NotApplicableError: There are no weights.
        RefusedError: The file holds none.
    """
    path = weights_of(plant.id, process, variant)
    if not path.is_file():
        raise NotApplicableError(f"no probing policy {variant!r} was trained for {plant.id} and its process {process!r}")
    layers = {name: value.astype(float) for name, value in read_tensors(path).items()}

    def choose(s: Drawn, obs: Array, said: Diagnosis) -> tuple[Drawn, Array]:
        s = drawn(s, actor(layers, features(plant, obs, said, s.last)), seed)
        return s, s.last

    return Prober(begin, choose)


def weights_of(plant_id: str, process: str, variant: str) -> Path:
    """The file of a policy."""
    return FOLDER / f"{'-'.join(part for part in ('ppo', plant_id, process, variant) if part)}.safetensors"


def features(plant: Plant, obs: Array, said: Diagnosis, last: Array) -> Array:
    """What the policy sees (n, labels + probes + n_obs): the belief, the last probe, the newest observation scaled."""
    assert plant.acting is not None
    labels = len(plant.labels)
    belief: Any = np.eye(labels)[np.clip(said.label, 0, labels - 1)] if said.label_probs is None else said.label_probs
    seen = np.clip(np.nan_to_num(plant.scale(obs)), -5.0, 5.0)
    return np.concatenate([np.nan_to_num(belief), np.eye(len(plant.acting.probes))[last], seen], axis=1)
