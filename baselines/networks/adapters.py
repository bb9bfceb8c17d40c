"""A torch module or a stable-baselines3 policy of your own as a diagnoser.

It sees what the environment would have shown it: scaled float32 samples, in blocks of `decision_period`, and windows of
`length` of those, `stride` apart (`fdi_gym.wrappers.VectorHistory`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn

from fdi_gym.diagnosis import Diagnoser, Diagnosis
from fdi_gym.plant import Array, Plant


def from_torch(
    module: nn.Module,
    plant: Plant,
    *,
    task: str = "isolation",
    decision_period: int = 1,
    length: int | None = None,
    stride: int = 1,
    dtype: torch.dtype = torch.float32,
) -> Diagnoser:
    """A diagnoser that shows windows to a module and holds its answer until the next decision.

    Args:
        module: Maps observations (n, *shape) to logits (n, labels), or for the identification task to actions in
            [-1, 1] (n, n_estimated) that stand for the bounds of the estimated quantity. The shape is
            [length,] [decision_period,] n_obs: an entry in brackets is there if it was given, or is above 1.
        plant: The plant.
        task: "isolation" or "identification".
        decision_period: Samples per decision.
        length: Blocks in a window; None for no window.
        stride: Decisions between the blocks of a window.
        dtype: Of what the module is shown.

    Raises:
        ValueError: Unknown task.
    """
    if task not in ("isolation", "identification"):
        raise ValueError(f"unknown task {task!r}; there are isolation, identification")
    m, width = decision_period, len(plant.observed)
    depth = 1 if length is None else (length - 1) * stride + 1
    nominal, scale = (np.array([getattr(s, name) for s in plant.observed]) for name in ("nominal", "scale"))
    low, high = (np.array([getattr(s, name) for s in plant.estimated]) for name in ("low", "high"))
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)
    module = module.to(dtype).eval()

    def init(n: int) -> Any:
        label, probs, theta = np.zeros(n, np.int64), np.tile(np.eye(len(plant.labels))[0], (n, 1)), np.tile(healthy, (n, 1))
        isolates = task == "isolation"
        said = Diagnosis(label > 0, label, None if isolates else theta, None, probs if isolates else None)
        return 0, np.zeros(n, bool), np.zeros((n, m, width)), np.zeros((n, depth, m, width)), said

    def decide(window: Array) -> Diagnosis:
        with torch.inference_mode():
            answer = module(torch.from_numpy(window).to(dtype)).double().numpy()
        if task == "identification":
            theta = low + (high - low) * (np.clip(answer, -1, 1) + 1) / 2
            return Diagnosis(np.zeros(len(theta), bool), np.zeros(len(theta), np.int64), theta)
        probs = np.exp(answer - answer.max(axis=1, keepdims=True))
        mode = answer.argmax(axis=1)
        return Diagnosis(mode > 0, mode, label_probs=probs / probs.sum(axis=1, keepdims=True))

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, begun, block, past, said = state
        newest = ((obs - nominal) / scale).astype(np.float32).astype(float)
        block = np.where(begun[:, None, None], np.concatenate([block[:, 1:], newest[:, None]], axis=1), newest[:, None])
        if k % m == 0:
            past = np.where(
                begun[:, None, None, None], np.concatenate([past[:, 1:], block[:, None]], axis=1), block[:, None]
            )
            window = past[:, ::stride] if length is not None else past[:, 0]
            said = decide(window if m > 1 else window[..., 0, :])
        return (k + 1, np.ones_like(begun), block, past, said), said

    return Diagnoser(init, update)


class _Actor(nn.Module):
    """What an SB3 actor-critic policy does when it is asked for its best action."""

    def __init__(self, policy: Any):
        super().__init__()
        self.policy = policy

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Logits of a discrete action, or the mean of a continuous one."""
        found = self.policy.get_distribution(observation).distribution
        return found.logits if hasattr(found, "logits") else found.mean


def from_sb3(policy: Any, plant: Plant, **arguments: Any) -> Diagnoser:
    """A diagnoser from an SB3 actor-critic policy (`model.policy`) trained on scaled units; arguments as in `from_torch`."""
    return from_torch(_Actor(policy.cpu()), plant, **arguments)
