"""The policy that PPO trains: a window of blocks, each reduced to its mean and its newest sample, and two layers.

Runs without stable-baselines3; `baselines.networks.reinforcement` trains it.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor, nn


def compressed(summaries: Tensor) -> Tensor:
    """Summaries of blocks (n, length, 2, n_obs), as `fdi_gym.wrappers.BlockSummary` shows them, flat and compressed."""
    return torch.asinh(summaries).flatten(1)


class Policy(nn.Module):
    """The actor alone, as it is stored: logits, or the mean action, of windows.

    Args:
        widths: Of the input, of the hidden layers, and of the answer.
    """

    def __init__(self, widths: list[int]):
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(a, b) for a, b in itertools.pairwise(widths)])

    def forward(self, window: Tensor) -> Tensor:
        """The answer (n, widths[-1]) to windows (n, length, period, n_obs)."""
        x = compressed(torch.stack([window.mean(dim=2), window[:, :, -1]], dim=2))
        for layer in self.layers[:-1]:
            x = torch.tanh(layer(x))
        return self.layers[-1](x)


def actor_tensors(state: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """The actor's tensors out of the state of an SB3 `MlpPolicy`, under the names of `Policy`."""
    hidden = sorted({name.rsplit(".", 1)[0] for name in state if name.startswith("mlp_extractor.policy_net.")})
    layers = [*hidden, "action_net"]
    return {
        f"layers.{i}.{part}": state[f"{layer}.{part}"].cpu().numpy()
        for i, layer in enumerate(layers)
        for part in ("weight", "bias")
    }
