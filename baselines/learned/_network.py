"""The network over steps as it is trained, and its loss; `sequence_net.forward` runs it step by step, without torch."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from baselines.learned._attention import Attention
from baselines.learned.sequence_net import LOG_STD, REACH


class SequenceNetwork(nn.Module):
    """Logits of the labels, and mean and log standard deviation of the estimated deviation, causally.

    Gated products of its features, a memory over the steps, and two heads. The memory is recurrent, or attention.

    Chosen by measurement, in equal time on one core (leaderboards/learning/README.md): a gated recurrent unit, against a
    dilated convolution and diagonal state-space layers. Its state is one vector, so a stream costs one cell per block.

    Args:
        features: Entries of an input.
        labels: Labels of the isolation task.
        estimated: Entries of the identification task.
        hidden: Width of every layer.
        told: Entries of what filters say, at an input's end: they reach the logits directly, too, for each process apart.
        processes: Entries before these that say which fault process to expect: 1 for one, 0 for the others.
        memory: "recurrent" or "attention".
    """

    def __init__(
        self, features: int, labels: int, estimated: int, hidden: int, told: int = 0, processes: int = 1,
        memory: str = "recurrent",
    ):  # fmt: skip
        super().__init__()
        self.labels, self.estimated, self.hidden = labels, estimated, hidden
        self.value, self.gate = nn.Linear(features, hidden), nn.Linear(features, hidden)
        self.join = nn.Linear(features + hidden, hidden)
        self.memory = Attention(hidden) if memory == "attention" else nn.GRU(hidden, hidden, batch_first=True)
        self.read = nn.Linear(hidden, hidden)
        self.heads = nn.Linear(hidden, labels + 2 * estimated)
        self.told, self.processes = told, processes
        if told:
            self.direct = nn.Linear(processes * told, labels, bias=False)

    def forward(self, x: Tensor, h: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features (N, T, n) after the memory h (1, N, hidden): logits, mean, log std (N, T, ...), and the memory."""
        product = self.value(x) * torch.tanh(self.gate(x))
        seen = F.silu(self.join(torch.cat([x, product], dim=-1)))
        remembered, after = self.memory(seen, h)
        out = self.heads(F.silu(self.read(seen + remembered)))
        logits, mean, log_std = out.split([self.labels, self.estimated, self.estimated], dim=-1)
        if self.told:
            process, told = x[..., -self.told - self.processes : -self.told], x[..., -self.told :]
            logits = logits + REACH * self.direct((process[..., None] * told[..., None, :]).flatten(-2))
        return logits, mean, log_std.clamp(*LOG_STD), after


def loss(
    answer: tuple[Tensor, Tensor, Tensor, Tensor], label: Tensor, deviation: Tensor, weight: Tensor, share: float
) -> Tensor:
    """Cross-entropy of the labels, weighted, plus a share of the Gaussian log likelihood of the deviation.

    Args:
        answer: What the network gave for (N, T) blocks.
        label: True labels (N, T).
        deviation: True deviations (N, T, n_estimated).
        weight: (N, T) weight of each block; 0 where it is not scored.
        share: Weight of the second part.
    """
    logits, mean, log_std, _ = answer
    entropy = F.cross_entropy(logits.transpose(1, 2), label, reduction="none")
    surprise = (0.5 * (deviation - mean) ** 2 * torch.exp(-2 * log_std) + log_std).clamp(max=20.0).sum(dim=-1)
    scored = (weight > 0).float()
    return (entropy * weight).sum() / weight.sum().clamp(min=1e-9) + share * (surprise * scored).mean()
