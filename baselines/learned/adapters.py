"""A torch module or a stable-baselines3 policy of your own as a diagnoser, with or without a memory.

It sees what the environment would have shown it: scaled float32 samples, in blocks of `decision_period`, and windows of
`length` of those, `stride` apart (`fdi_gym.wrappers.VectorHistory`). What has a memory is handed it back at each decision.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis
from fdi_gym.plant import Array, Plant

if TYPE_CHECKING:
    from torch import nn


def from_torch(
    module: nn.Module,
    plant: Plant,
    *,
    task: str = "isolation",
    decision_period: int = 1,
    length: int | None = None,
    stride: int = 1,
    dtype: Any = None,
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
        dtype: Of what the module is shown; default torch.float32.

    Raises:
        ValueError: Unknown task.
    """
    import torch

    dtype = dtype or torch.float32
    module = module.to(dtype).eval()

    def answer(window: Array, memory: Any) -> Any:
        return module(torch.from_numpy(window).to(dtype)), None

    return _windowed(answer, plant, task, decision_period, length, stride)


def from_recurrent(
    module: nn.Module, plant: Plant, *, task: str = "isolation", decision_period: int = 1, dtype: Any = None
) -> Diagnoser:
    """A diagnoser that shows a module with a state each block as it comes, and hands the state on.

    Args:
        module: Maps observations (n, [decision_period,] n_obs) and its state, None before the first ones, to the answer, as
            in `from_torch`, and its next state: whatever it likes, but not changed in place.
        plant, task, decision_period, dtype: As in `from_torch`.

    Raises:
        ValueError: Unknown task.
    """
    import torch

    dtype = dtype or torch.float32
    module = module.to(dtype).eval()

    def answer(window: Array, memory: Any) -> Any:
        return module(torch.from_numpy(window).to(dtype), memory)

    return _windowed(answer, plant, task, decision_period, None, 1)


def from_sb3(
    policy: Any, plant: Plant, *, task: str = "isolation", decision_period: int = 1, length: int | None = None,
    stride: int = 1,
) -> Diagnoser:  # fmt: skip
    """A diagnoser from an SB3 actor-critic policy (`model.policy`) trained on scaled units: its best action.

    Args:
        policy: The policy: of PPO or A2C, or of sb3-contrib's RecurrentPPO, whose memory is then empty at the first sample.
        plant, task, decision_period, length, stride: As in `from_torch`.

    Raises:
        ValueError: Unknown task.
        TypeError: A policy that has no distribution of actions.
    """
    import torch

    if not hasattr(policy, "get_distribution"):
        raise TypeError(
            f"a policy of an actor-critic method (PPO, A2C, RecurrentPPO) is needed, not {type(policy).__name__}"
        )
    policy = policy.cpu()
    policy.set_training_mode(False)
    recurrent = getattr(policy, "lstm_actor", None)

    def answer(window: Array, memory: Any) -> Any:
        shown = torch.from_numpy(window).float()
        if recurrent is None:
            found = policy.get_distribution(shown)
        else:
            n = len(window)
            empty = torch.zeros(recurrent.num_layers, n, recurrent.hidden_size)
            found, memory = policy.get_distribution(shown, memory or (empty, empty), torch.zeros(n))
        found = found.distribution
        return found.logits if hasattr(found, "logits") else found.mean, memory

    return _windowed(answer, plant, task, decision_period, length, stride)


def _windowed(
    function: Callable[[Array, Any], tuple[Any, Any]], plant: Plant, task: str, decision_period: int, length: int | None,
    stride: int,
) -> Diagnoser:  # fmt: skip
    import torch

    if task not in ("isolation", "identification"):
        raise ValueError(f"unknown task {task!r}; there are isolation, identification")
    m, width = decision_period, len(plant.observed)
    depth = 1 if length is None else (length - 1) * stride + 1
    low, high = (np.array([getattr(s, name) for s in plant.estimated]) for name in ("low", "high"))
    healthy = plant.healthy

    def init(n: int) -> Any:
        label, probs, estimate = (
            np.zeros(n, np.int64),
            np.tile(np.eye(len(plant.labels))[0], (n, 1)),
            np.tile(healthy, (n, 1)),
        )
        isolates = task == "isolation"
        diagnosis = Diagnosis(label > 0, label, None if isolates else estimate, None, probs if isolates else None)
        return 0, np.zeros(n, bool), np.zeros((n, m, width)), np.zeros((n, depth, m, width)), None, diagnosis

    def decide(window: Array, memory: Any) -> tuple[Diagnosis, Any]:
        with torch.inference_mode():
            found, memory = function(window, memory)
        return said(found.double().numpy()), memory

    def said(answer: Array) -> Diagnosis:
        if task == "identification":
            estimate = low + (high - low) * (np.clip(answer, -1, 1) + 1) / 2
            return Diagnosis(np.zeros(len(estimate), bool), np.zeros(len(estimate), np.int64), estimate)
        probs = np.exp(answer - answer.max(axis=1, keepdims=True))
        label = answer.argmax(axis=1)
        return Diagnosis(label > 0, label, label_probs=probs / probs.sum(axis=1, keepdims=True))

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, begun, block, past, memory, diagnosis = state
        newest = plant.scale(obs).astype(np.float32).astype(float)
        block = np.where(begun[:, None, None], np.concatenate([block[:, 1:], newest[:, None]], axis=1), newest[:, None])
        if k % m == 0:
            past = np.where(
                begun[:, None, None, None], np.concatenate([past[:, 1:], block[:, None]], axis=1), block[:, None]
            )
            window = past[:, ::stride] if length is not None else past[:, 0]
            diagnosis, memory = decide(window if m > 1 else window[..., 0, :], memory)
        return (k + 1, np.ones_like(begun), block, past, memory, diagnosis), diagnosis

    return Diagnoser(init, update)
