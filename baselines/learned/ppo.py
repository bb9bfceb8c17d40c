"""Policies trained by PPO (stable-baselines3) on the environments: windows of raw samples in, a decision out.

`ppo` isolates; `ppo_identification` estimates. How they were trained is in `baselines.networks.reinforcement`. The
committed weights are the actor alone; stable-baselines3 is not needed to run them.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from baselines.learned import network_module
from fdi_gym.diagnosis import Diagnoser, NotApplicableError, diagnoser
from fdi_gym.plant import Plant
from fdi_gym.training import trainer


@diagnoser("ppo", "PPO on windows of observations, delay-aware reward", method="ppo")
@diagnoser("ppo_identification", "PPO on windows of observations, for the fault parameters", method="ppo_identification")
def ppo(plant: Plant, *, method: str = "ppo", path: str = "") -> Diagnoser:
    """The trained policy.

    Args:
        plant: A plant that there are weights for.
        method: Which policy: "ppo" or "ppo_identification".
        path: Weights of your own; their card lies beside them.

    Raises:
        NotApplicableError: No weights for this plant and its options, or no torch.
    """
    weights, policy, adapters = (network_module(name) for name in ("weights", "policy", "adapters"))
    import torch

    file = Path(path) if path else weights.WEIGHTS / f"{method}-{plant.id}.safetensors"
    if not file.exists():
        raise NotApplicableError(f"no trained weights for {plant.id}; train them: fdi-gym train {method} {plant.id}")
    try:
        tensors, card = weights.read(file, plant)
    except weights.WrongPlantError as error:
        raise NotApplicableError(str(error)) from error
    answers = len(plant.labels) if card.task == "isolation" else len(plant.estimated)
    widths = [card.shape["length"] * 2 * len(plant.observed), card.shape["hidden"], card.shape["hidden"], answers]
    expected: dict[str, tuple[int, ...]] = {}
    for i, (a, b) in enumerate(itertools.pairwise(widths)):
        expected |= {f"layers.{i}.weight": (b, a), f"layers.{i}.bias": (b,)}
    weights.check_tensors(file, tensors, expected)
    actor = policy.Policy(widths)
    actor.load_state_dict({name: torch.from_numpy(value) for name, value in tensors.items()})
    window = {name: card.shape[name] for name in ("decision_period", "length", "stride")}
    return adapters.from_torch(actor, plant, task=card.task, dtype=torch.float64, **window)


@trainer("ppo", "PPO on the isolation task")
def train_ppo(plant_id: str, **arguments: Any) -> Path:
    """Train the policy that isolates."""
    return network_module("recipes").train_ppo("ppo", plant_id, **arguments)


@trainer("ppo_identification", "PPO on the identification task")
def train_ppo_identification(plant_id: str, **arguments: Any) -> Path:
    """Train the policy that estimates."""
    return network_module("recipes").train_ppo("ppo_identification", plant_id, **arguments)
