"""Policies trained by PPO (stable-baselines3) on the environments: features of an identified model in, a decision out.

`ppo` isolates; `ppo_identification` estimates. They see what `sequence_net` sees
(`baselines.networks.identification`), and answer at the end of each step; the answer holds until the next. How they were
trained is in `baselines.networks.reinforcement`. The committed weights are the actor and the model; neither torch nor
stable-baselines3 is needed to run them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines.learned import network_module
from fdi_gym.diagnosis import Diagnoser, NotApplicableError, diagnoser
from fdi_gym.plant import Plant
from fdi_gym.training import trainer


@diagnoser("ppo", "PPO on features of an identified model, delay-aware reward", method="ppo")
@diagnoser(
    "ppo_identification", "PPO on features of an identified model, for the fault parameters", method="ppo_identification"
)
def ppo(plant: Plant, *, method: str = "ppo", path: str = "") -> Diagnoser:
    """The trained policy.

    Args:
        plant: A plant that there are weights for.
        method: Which policy: "ppo" or "ppo_identification".
        path: Weights of your own; their card lies beside them.

    Raises:
        NotApplicableError: No weights for this plant and its options, or no safetensors.
        RefusedError: Weights or a card that are not what they should be.
    """
    weights, policy, ident = (network_module(name) for name in ("weights", "policy", "identification"))
    file = Path(path) if path else weights.WEIGHTS / f"{method}-{plant.id}.safetensors"
    if not file.exists():
        raise NotApplicableError(f"no trained weights for {plant.id}; train them: fdi-gym train {method} {plant.id}")
    try:
        tensors, card = weights.read(file, plant)
    except weights.WrongPlantError as error:
        raise NotApplicableError(str(error)) from error
    shape, hidden = weights.shape_of(file, card)
    weights.check_tensors(file, tensors, policy.shapes(plant, shape, card.task, hidden))
    model = ident.Model(*(tensors[f"model.{name}"] for name in ident.Model._fields))
    return policy.streaming(plant, shape, model, tensors, card.task)


@trainer("ppo", "PPO on the isolation task")
def train_ppo(plant_id: str, **arguments: Any) -> Path:
    """Train the policy that isolates."""
    return network_module("recipes").train_ppo("ppo", plant_id, **arguments)


@trainer("ppo_identification", "PPO on the identification task")
def train_ppo_identification(plant_id: str, **arguments: Any) -> Path:
    """Train the policy that estimates."""
    return network_module("recipes").train_ppo("ppo_identification", plant_id, **arguments)
