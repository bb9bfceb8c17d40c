"""Supervised training of the recurrent network: flights flown on the fly, balanced labels, calibrated probabilities."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from baselines.learned import flights as data
from baselines.learned import probabilities, weights
from baselines.learned._network import SequenceNetwork, loss
from baselines.learned._training import Training
from baselines.learned.features import FeatureModel
from baselines.learned.flights import CALIBRATION, VALIDATION, Flights
from baselines.learned.recipes import SequenceRecipe
from baselines.learned.sequence_net import REACH
from fdi_gym.engine import Record
from fdi_gym.plant import Array

RAREST = 2e-3  # share below which a label's weight grows no more
RIDGE = 1e-3  # of the logistic regression: the satellite's hard process has 93.7, 93.8, 93.5 on validation with 1e-2 to 1e-4


class SupervisedTraining(Training[SequenceRecipe]):
    """A run of passes over chunks of flights; arguments as in `Training`.

    Args:
        base: Weights of the network that is shown no filter, for one that is.

    Raises:
        ValueError: Also where there is no such network to start from.
    """

    unit, score = "pass", "loss"

    def __init__(self, *arguments: Any, base: Path | None = None, **further: Any):
        self.base = base
        super().__init__(*arguments, **further)

    def plan(self) -> None:
        """Passes, and the flights they are made of."""
        r = self.recipe
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        chunks = -(-r.flights // r.chunk)
        self.together, self.flights, self.rounds = r.chunk, chunks * r.chunk, chunks * r.passes
        self.newest: tuple[int, Flights] | None = None
        self.per_pass = -(-r.chunk * len(r.conditions) // r.batch)  # steps

    # -- beginning, keeping, going on

    def begin(self) -> None:
        """Identify the plant and make a new network, or take both from the network that is shown no filter."""
        r = self.recipe
        records = self.flown(self.first, r.identify)
        prior = np.stack([np.bincount(f.label.ravel(), minlength=len(self.plant.labels)) / f.label.size for f in records])
        self.prior, self.share = np.maximum(prior, 1e-4), prior  # of labels in flights as they come, and as they are shown
        if r.candidates > 1:
            planned = enumerate(zip(self.plants, r.conditions, strict=True))
            self.share = np.stack([data.label_share(p, c, self.seeds_of(0, i)) for i, (p, c) in planned])
        if not r.filters:
            self.make(data.identified(self.plants, r.shape, records))
            return
        if self.base is None or not self.base.exists():
            raise ValueError(f"residual_net starts from weights of sequence_net: train sequence_net {self.plant.id}")
        tensors, _ = weights.read(self.base, self.plant)
        self.make(weights.model_of(tensors))
        self.start_from(tensors)

    def make(self, model: FeatureModel) -> None:
        """The network and its optimiser."""
        p, r = self.plant, self.recipe
        self.model = model
        processes = [c.process for c in r.conditions]
        told = data.told_by(p, [data.shown_filter(name, p, processes[0], processes) for name in r.filters])
        inputs = len(model.mean) + len(processes) + told
        sizes = (inputs, len(p.labels), len(p.estimated), r.hidden, told, len(processes), r.memory)
        self.network = SequenceNetwork(*sizes).to(self.device)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=r.rate, weight_decay=r.decay)

    def start_from(self, tensors: Mapping[str, Array]) -> None:
        """Take the weights of a network that is shown no filter; further inputs begin at 0, `stack` begins the rest."""
        before = tensors["network.value.weight"].shape[1]
        further = self.network.value.in_features - before
        for name, value in self.network.state_dict().items():
            if name == "direct.weight":
                continue
            old = torch.from_numpy(tensors[f"network.{name}"])
            if name in ("value.weight", "gate.weight", "join.weight"):  # join: of features and products
                zeros = torch.zeros(len(old), further)
                old = torch.cat([old[:, :before], zeros, old[:, before:]], dim=1)
            value.copy_(old)

    def stack(self, flown: Flights) -> None:
        """Begin with the logistic regression of the labels on what filters say, by process, and on the network's own logits.

        Those it had without filters, times one number. Stacked generalisation: D. H. Wolpert, Neural Networks 5(2), 1992.
        """
        net = self.network
        net.direct.weight.data.zero_()
        own, told = torch.from_numpy(self.logits(flown)), torch.from_numpy(flown.features[..., -net.told :])
        weight, label = torch.from_numpy(self.weight_of(flown)), torch.from_numpy(flown.label)
        groups = [torch.from_numpy(flown.process == i) for i in range(net.processes)]
        parts = [(own[g], told[g], weight[g] / weight[g].sum().clamp(min=1e-9), label[g]) for g in groups]
        trust = torch.zeros(net.processes, net.labels, net.told, requires_grad=True)
        scale = torch.zeros(1, requires_grad=True)
        fit = torch.optim.LBFGS([trust, scale], max_iter=100, line_search_fn="strong_wolfe")

        def surprise() -> Tensor:
            fit.zero_grad()
            total = RIDGE * (trust**2).sum()
            for t, (logits, said, part, true) in zip(trust, parts, strict=True):
                entropy = F.cross_entropy((scale * logits + said @ t.T).flatten(0, 1), true.flatten(), reduction="none")
                total = total + (entropy * part.flatten()).sum()
            total.backward()
            return total

        fit.step(surprise)
        net.direct.weight.data = torch.cat([*trust.detach()], dim=1).to(self.device) / REACH
        for a in (net.heads.weight, net.heads.bias):
            a.data[: net.labels] *= float(scale.detach())

    def learned(self) -> tuple[torch.nn.Module, torch.optim.Optimizer]:
        """The network."""
        return self.network, self.optimiser

    def state(self) -> dict[str, Array]:
        """The identified model, and the shares of the labels."""
        return {**weights.model_tensors(self.model), "prior": self.prior, "share": self.share}

    def restore(self, tensors: Mapping[str, Array]) -> None:
        """As `begin` has left it."""
        self.prior, self.share = tensors["prior"], tensors["share"]
        self.make(weights.model_of(tensors))

    # -- flights

    def prepared(self, seeds: Sequence[Sequence[int]]) -> tuple[Flights, list[Record]]:
        """Flights under all conditions, as the network sees them; seeds per condition."""
        r = self.recipe
        found = [
            data.prepare(plant, r.conditions, i, r.shape, self.model, r.filters, own)
            for i, (plant, own) in enumerate(zip(self.plants, seeds, strict=True))
        ]
        return data.joined([f for f, _ in found]), [record for _, record in found]

    def chunk(self, index: int) -> Flights:
        """The training flights of one chunk; kept until the next."""
        if self.newest is None or self.newest[0] != index:
            self.newest = index, self.prepared([self.seeds_of(index, i) for i in range(len(self.plants))])[0]
        return self.newest[1]

    def held_out(self, first: int) -> tuple[Flights, list[Record]]:
        """Validation or calibration flights: the same seeds under each condition."""
        return self.prepared([range(first, first + self.recipe.validation)] * len(self.plants))

    @functools.cached_property
    def validation(self) -> tuple[Flights, list[Record]]:
        """The validation flights."""
        return self.held_out(VALIDATION)

    # -- training

    def place(self) -> dict[str, int]:
        """Steps of the optimiser, and flights per condition that were shown."""
        r = self.recipe
        return {"step": self.done * self.per_pass, "flights": min(-(-self.done // r.passes) * r.chunk, r.flights)}

    def weight_of(self, flown: Flights) -> Array:
        """Of each step (N, T), so that all labels count the same; 0 where it is not scored."""
        balance = 1 / (len(self.plant.labels) * np.maximum(self.share, RAREST))
        return (balance[flown.process[:, None], flown.label] * flown.scored).astype(np.float32)

    def learn(self) -> float:
        """Show a chunk once, in an order of this pass's own; the mean loss."""
        r, flown = self.recipe, self.chunk(self.done // self.recipe.passes)
        if r.filters and not self.done:
            self.stack(flown)
        balanced = self.weight_of(flown)
        order = np.random.default_rng([self.seed, self.done]).permutation(len(flown.label))
        total = 0.0
        for i, start in enumerate(range(0, len(order), r.batch)):
            j = order[start : start + r.batch]
            step = self.done * self.per_pass + i
            part = step / (self.rounds * self.per_pass)
            for group in self.optimiser.param_groups:  # rises over 50 steps and falls as a cosine
                group["lr"] = r.rate * min(1.0, (step + 1) / 50) * (0.5 * (1 + np.cos(np.pi * part)) + 0.01)
            truth = (flown.label[j], flown.deviation[j], balanced[j])
            answer = self.network(torch.from_numpy(flown.features[j]).to(self.device))
            value = loss(answer, *(torch.from_numpy(a).to(self.device) for a in truth), share=r.share)
            self.optimiser.zero_grad()
            value.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            self.optimiser.step()
            total += float(value.detach())
        return total * r.batch / len(order)

    def logits(self, flown: Flights) -> Array:
        """The network's logits (N, T, labels)."""
        with torch.inference_mode():
            pieces = (torch.from_numpy(flown.features[i : i + 50]) for i in range(0, len(flown.label), 50))
            return np.concatenate([self.network(piece.to(self.device))[0].cpu().numpy() for piece in pieces])

    def validate(self) -> dict[str, float]:
        """Balanced accuracy per sample under each condition, as the leaderboards count it."""
        flown, records = self.validation
        found, declared = {}, self.logits(flown).argmax(axis=2)
        for i, (plant, condition, record) in enumerate(zip(self.plants, self.recipe.conditions, records, strict=True)):
            label = data.at_samples(declared[flown.process == i], self.recipe.shape.period, record.label.shape[1])
            found[condition.name] = data.accuracy(plant, condition, record, label)
        return found

    # -- the end

    def calibrated(self) -> dict[str, weights.ProbabilityCalibration]:
        """The probabilities' calibration, fitted on flights of its own and measured on the validation flights."""
        flown, validation = self.held_out(CALIBRATION)[0], self.validation[0]
        fitted, measured = self.logits(flown).astype(float), self.logits(validation).astype(float)
        found = {}
        for i, condition in enumerate(self.recipe.conditions):
            own, other = (f.scored & (f.process == i)[:, None] for f in (flown, validation))
            prior, label = self.prior[i], validation.label[other]
            scale, bias = probabilities.fit(fitted[own], flown.label[own], prior)
            plain = probabilities.log_softmax(measured[other] + np.log(prior))
            better = probabilities.log_softmax(scale * measured[other] + bias)
            scores, errors = (
                (function(plain, label), function(better, label))
                for function in (probabilities.log_score, probabilities.calibration_error)
            )
            found[condition.name] = weights.ProbabilityCalibration(
                scale=scale, bias=bias.tolist(), prior=prior.tolist(), log_score=scores, calibration_error=errors
            )
        return found

    def tensors(self) -> dict[str, Array]:
        """The network and the model."""
        network = {f"network.{name}": value.cpu().numpy() for name, value in self.network.state_dict().items()}
        return network | weights.model_tensors(self.model)

    def card(self) -> dict[str, Any]:
        """Both tasks, the filters, the calibration and what it took."""
        r = self.recipe
        flights = len(r.conditions) * (self.flights + r.identify)
        samples = flights * self.validation[0].label.shape[1] * r.shape.period
        return {
            "task": "both", "filters": list(r.filters), "calibration": self.calibrated(),
            "seeds": {"calibration": [CALIBRATION, self.last(CALIBRATION + r.validation - 1)]},
            "budget": {"flights": flights, "samples": samples, "passes": r.passes, "steps": self.done * self.per_pass},
        }  # fmt: skip
