"""Policies trained by PPO (stable-baselines3) on the environments: features of an identified model in, a decision out.

`ppo` isolates; `ppo_identification` estimates. They see what `sequence_net` sees (`baselines.learned.features`) through two
layers, and answer at the end of each step; the answer holds until the next. How they are trained is in
`baselines.learned._reinforcement`. The weights are the actor and the model; neither torch nor stable-baselines3 runs them.
"""

from __future__ import annotations

from pathlib import Path

from baselines.learned import weights
from baselines.learned.policy import policy_diagnoser, tensor_shapes
from baselines.learned.recipes import policy_recipe
from fdi_gym.diagnosis import Diagnoser, diagnoser, trainer
from fdi_gym.plant import Plant


@diagnoser("ppo", "PPO on features of an identified model, delay-aware reward", sensors=True, method="ppo")
@diagnoser(
    "ppo_identification",
    "PPO on features of an identified model, for the fault parameters",
    sensors=True,
    method="ppo_identification",
)
def ppo(plant: Plant, *, method: str = "ppo", path: str = "") -> Diagnoser:
    """The trained policy.

    Args:
        plant: A plant that there are weights for.
        method: Which policy: "ppo" or "ppo_identification".
        path: Weights of your own; their card lies beside them.

    Raises:
        NotApplicableError: No weights for this plant and its options.
        RefusedError: Weights or a card that are not what they should be.
    """
    file, tensors, card = weights.find(method, plant, path)
    shape, hidden = weights.shape_of(file, card)
    weights.check_tensors(file, tensors, tensor_shapes(plant, shape, card.task, hidden))
    return policy_diagnoser(plant, shape, tensors, card.task)


@trainer("ppo", "PPO on the isolation task")
@trainer("ppo_identification", "PPO on the identification task", method="ppo_identification", task="identification")
def train_ppo(
    plant: Plant, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), threads: int = 1,
    method: str = "ppo", task: str = "isolation",
) -> Path:  # fmt: skip
    """Train a policy; the path of its weights.

    Args:
        plant: The plant.
        budget: Decisions. Default: the recipe's.
        seed: Of the run.
        work: Folder of runs; one that was killed goes on.
        threads: Of torch.
        method: Under which name.
        task: "isolation" or "identification".

    Raises:
        ValueError: The folder holds another run.
    """
    from baselines.learned._reinforcement import PolicyTraining

    return PolicyTraining(
        method, plant, policy_recipe(plant, task, budget), seed=seed, work=work / f"{weights.stem(method, plant)}-{seed}",
        command=weights.command(method, plant, budget, seed), threads=threads,
    ).run()  # fmt: skip
