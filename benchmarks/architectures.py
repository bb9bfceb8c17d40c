"""Which network? The same flights, steps and heads for a recurrent network, one that attends to the last steps, a
convolutional and a state-space one, and for the recurrent one without the identified model. Validation flights only;
accuracy and seconds of one run.

python benchmarks/architectures.py [--plant B747Lateral] [--flights 512]
"""

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import torch
from torch import nn
from torch.nn import functional as F

from baselines.learned import weights
from baselines.learned._attention import Attention
from baselines.learned._network import SequenceNetwork
from baselines.learned._supervised import SupervisedTraining
from baselines.learned.recipes import sequence_recipe
from fdi_gym.discovery import load_plant


class Convolution(nn.Module):
    """Seven residual layers of a causal convolution over three steps, 1, 2, 4, ..., 64 apart."""

    def __init__(self, hidden: int):
        super().__init__()
        self.over = nn.ModuleList([nn.Conv1d(hidden, hidden, 3, dilation=2**i) for i in range(7)])
        self.back = nn.ModuleList([nn.Conv1d(hidden, hidden, 1) for _ in range(7)])

    def forward(self, x, h=None):
        y = x.transpose(1, 2)
        for over, back in zip(self.over, self.back, strict=True):
            y = y + back(F.silu(over(F.pad(y, (2 * over.dilation[0], 0)))))
        return y.transpose(1, 2) - x, h


class StateSpace(nn.Module):
    """Three layers of diagonal linear states, each with a learned memory of one to 400 steps, and a gate between layers."""

    def __init__(self, hidden: int):
        super().__init__()
        self.memory = nn.ParameterList([nn.Parameter(torch.linspace(0.0, 6.0, hidden)) for _ in range(3)])
        self.norm = nn.ModuleList([nn.LayerNorm(hidden) for _ in range(3)])
        self.into = nn.ModuleList([nn.Linear(hidden, hidden) for _ in range(3)])
        self.out = nn.ModuleList([nn.Linear(hidden, 2 * hidden) for _ in range(3)])

    def forward(self, x, h=None):
        y, T = x, x.shape[1]
        for memory, norm, into, out in zip(self.memory, self.norm, self.into, self.out, strict=True):
            keep = torch.exp(-torch.exp(-memory))[:, None]
            kernel = (1 - keep) * keep ** torch.arange(T)
            u = torch.fft.rfft(into(norm(y)).transpose(1, 2), n=2 * T) * torch.fft.rfft(kernel, n=2 * T)
            value, gate = out(F.silu(torch.fft.irfft(u, n=2 * T)[..., :T].transpose(1, 2))).chunk(2, dim=-1)
            y = y + value * torch.sigmoid(gate)
        return y - x, h


class Candidate(SupervisedTraining):
    """A run with another memory in its network, or without the identified model."""

    memory: type[nn.Module] | None = None
    blind = False

    def make(self, model):
        super().make(model)
        if self.memory is not None:
            net = SequenceNetwork(self.network.value.in_features, self.network.labels, self.network.estimated, 64)
            net.memory = self.memory(64)
            self.network = net
            self.optimiser = torch.optim.AdamW(net.parameters(), lr=self.recipe.rate, weight_decay=self.recipe.decay)

    def prepared(self, seeds):
        found, records = super().prepared(seeds)
        if self.blind:
            found.features[..., 2 * len(self.plant.observed) : len(self.model.mean)] = 0
        return found, records


CANDIDATES = {
    "gated recurrent unit": {},
    "attention": {"memory": Attention},
    "dilated convolution": {"memory": Convolution},
    "diagonal state space": {"memory": StateSpace},
    "gated recurrent unit, samples only": {"blind": True},
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--plant", default="B747Lateral")
    parser.add_argument("--flights", type=int, default=512)
    arguments = parser.parse_args()
    plant = load_plant(arguments.plant)
    recipe = replace(sequence_recipe(plant), flights=arguments.flights)
    for name, how in CANDIDATES.items():
        run = type("Training", (Candidate,), how)("sequence_net", plant, recipe, seed=0, work=Path(mkdtemp()))
        card = weights.read_card(run.run())
        size = sum(p.numel() for p in run.network.parameters())
        score = ", ".join(f"{k} {100 * v:.1f} %" for k, v in card.curve[-1]["accuracy"].items())
        print(f"{name:36s} {size:7d} parameters, {card.budget['seconds']:5.0f} s: {score}", flush=True)
