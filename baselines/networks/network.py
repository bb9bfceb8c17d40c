"""The network: gated products of its features, a gated recurrent unit over the blocks, and two heads."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

TRUST = 3.0  # in the filters' labels before training: a logit
REACH = 10.0  # trust is learned so many times faster than the other weights: it must rise and fall by several logits


class SequenceNetwork(nn.Module):
    """Logits of the labels, and mean and log standard deviation of the estimated deviation, causally.

    Chosen by measurement, in equal time on one core (leaderboards/learning/README.md): a gated recurrent unit, against a
    dilated convolution and diagonal state-space layers. Its state is one vector, so a stream costs one cell per block.

    Args:
        features: Entries of an input.
        labels: Labels of the isolation task.
        estimated: Entries of the identification task.
        hidden: Width of every layer.
        words: Entries of what each filter says, at the end of an input. They reach the logits directly, too: an untrained
            network believes the labels that the filters declare, and training corrects that, for each process apart.
        processes: Entries before these words that say which fault process to expect: 1 for one, 0 for the others.
    """

    def __init__(
        self, features: int, labels: int, estimated: int, hidden: int, words: tuple[int, ...] = (), processes: int = 1
    ):  # fmt: skip
        super().__init__()
        self.labels, self.estimated, self.hidden = labels, estimated, hidden
        self.value, self.gate = nn.Linear(features, hidden), nn.Linear(features, hidden)
        self.join = nn.Linear(features + hidden, hidden)
        self.memory = nn.GRU(hidden, hidden, batch_first=True)
        self.read = nn.Linear(hidden, hidden)
        self.heads = nn.Linear(hidden, labels + 2 * estimated)
        self.words, self.processes = sum(words), processes
        if words:
            self.direct = nn.Linear(processes * self.words, labels, bias=False)
            believe = [torch.eye(labels, width) * TRUST / REACH / len(words) for width in words]
            self.direct.weight.data = torch.cat(believe * processes, dim=1)

    def forward(self, x: Tensor, h: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features (N, T, n) after the memory h (1, N, hidden): logits, mean, log std (N, T, ...), and the memory."""
        product = self.value(x) * torch.tanh(self.gate(x))
        seen = F.silu(self.join(torch.cat([x, product], dim=-1)))
        remembered, after = self.memory(seen, h)
        out = self.heads(F.silu(self.read(seen + remembered)))
        logits, mean, log_std = out.split([self.labels, self.estimated, self.estimated], dim=-1)
        if self.words:
            process, words = x[..., -self.words - self.processes : -self.words], x[..., -self.words :]
            logits = logits + REACH * self.direct((process[..., None] * words[..., None, :]).flatten(-2))
        return logits, mean, log_std.clamp(-6.0, 3.0), after


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
