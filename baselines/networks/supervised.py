"""Supervised training of the sequence network: flights flown on the fly, class-balanced loss, exact resume.

Everything random follows from the run's seed and the place in the run, so a checkpoint needs weights, the optimiser's
moments and that place; a resumed run ends with the same bytes as one that was never stopped.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from baselines.networks import calibration, checkpoints, weights
from baselines.networks import flights as data
from baselines.networks.flights import CALIBRATION, PER_SEED, TRAINING, VALIDATION, Flights, Source
from baselines.networks.identification import Model, Shape
from baselines.networks.network import SequenceNetwork, loss
from fdi_gym.engine import Record
from fdi_gym.plant import Array

RAREST = 2e-3  # share below which a label's weight grows no more


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a plant's network is trained.

    Args:
        sources: Fault processes, with the options of the plant.
        shape: Of the identified model.
        filters: Diagnosers whose words the network hears; training then starts from the network that hears none.
        flights: Training flights per process.
        identify: Flights per process for the identification, before the others.
        chunk: Flights per process that are flown together ...
        passes: ... and shown so many times.
        candidates: Seeds per training flight, from which those are taken that show rare labels.
        validation: Flights per process of the validation, and of the calibration.
        validate: Passes between validations.
        batch: Flights per step.
        hidden: Width of the network.
        rate: Learning rate at its height; it rises over 50 steps and falls as a cosine.
        decay: Weight decay.
        share: Of the identification task in the loss.
    """

    sources: tuple[Source, ...]
    shape: Shape
    filters: tuple[str, ...] = ()
    flights: int = 2048
    identify: int = 300
    chunk: int = 64
    passes: int = 4
    candidates: int = 1
    validation: int = 100
    validate: int = 8
    batch: int = 32
    hidden: int = 64
    rate: float = 3e-3
    decay: float = 1e-2
    share: float = 0.05


@dataclass
class Progress:
    """What a run has, beside its network."""

    model: Model
    prior: Array  # (processes, labels) share of each label in flights as they come,
    share: Array  # and in those that are selected for training
    passes: int = 0
    steps: int = 0
    seconds: float = 0.0
    curve: list[dict[str, Any]] = field(default_factory=list)


class Run:
    """One training run in a folder: `run()` trains to the end, or goes on where a killed run was.

    Args:
        method: Name of the trainer, for the card.
        plant_id: The plant.
        recipe: How.
        seed: Of everything.
        work: Folder of the checkpoint and the tensorboard log.
        command: For the card.
        base: Weights of the network that hears no filter, for one that does.
        threads: Of torch on a processor; the bytes of the weights depend on it.

    Raises:
        ValueError: The folder holds a run with another recipe or seed.
    """

    def __init__(
        self, method: str, plant_id: str, recipe: Recipe, *, seed: int, work: Path, command: str = "",
        base: Path | None = None, threads: int = 1,
    ):  # fmt: skip
        torch.set_num_threads(threads)
        self.method, self.plant_id, self.recipe, self.seed, self.command = method, plant_id, recipe, seed, command
        self.base, self.work, self.checkpoint = base, work, work / "checkpoint.safetensors"
        self.plants = [data.plant_of(plant_id, source) for source in recipe.sources]
        self.plant = self.plants[0]
        self.first = TRAINING + PER_SEED * seed
        self.identity = checkpoints.identity(method, self.plant, seed, recipe)
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.per_pass = -(-recipe.chunk * len(recipe.sources) // recipe.batch)
        self.total = -(-recipe.flights // recipe.chunk) * recipe.passes
        self.started = time.perf_counter()
        work.mkdir(parents=True, exist_ok=True)
        torch.manual_seed(seed)
        if self.checkpoint.exists():
            self.restore()
        else:
            self.begin()

    # -- beginning, keeping, going on

    def make(self, model: Model) -> None:
        """The network and its optimiser."""
        p, recipe = self.plant, self.recipe
        words: tuple[int, ...] = ()
        if recipe.filters:
            obs = data.fly(p, recipe.sources[0], [self.first]).obs[:, : 2 * recipe.shape.period]
            heard = data.words(self.plant_id, recipe.sources[0], recipe.filters, obs, recipe.shape.period)
            words = tuple(word.shape[-1] for word in heard)
        width = len(model.mean) + len(recipe.sources) + sum(words)
        shape = (width, len(p.labels), len(p.estimated), recipe.hidden, words, len(recipe.sources))
        self.network = SequenceNetwork(*shape).to(self.device)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)

    def begin(self) -> None:
        """Identify the plant and make a new network, or take both from the network that hears no filter."""
        recipe = self.recipe
        seeds = range(self.first, self.first + recipe.identify)
        records = [data.fly(p, s, seeds) for p, s in zip(self.plants, recipe.sources, strict=True)]
        prior = np.stack([np.bincount(r.label.ravel(), minlength=len(self.plant.labels)) / r.label.size for r in records])
        if recipe.filters:
            if self.base is None or not self.base.exists():
                raise ValueError(f"a network that hears filters starts from one without: train sequence_net {self.plant_id}")
            tensors, _ = weights.read(self.base, self.plant)
            model = Model(*(tensors[f"model.{name}"] for name in Model._fields))
            self.make(model)
            self.start_from(tensors)
        else:
            model = data.identified(self.plants, recipe.shape, records)
            self.make(model)
        share = prior
        if recipe.candidates > 1:  # of the flights that are chosen
            planned = enumerate(zip(self.plants, recipe.sources, strict=True))
            share = np.stack([data.label_share(p, s, self.seeds_of(0, i)) for i, (p, s) in planned])
        self.progress = Progress(model, np.maximum(prior, 1e-4), share)

    def seeds_of(self, chunk: int, index: int) -> list[int]:
        """The seeds of a source's flights in a chunk."""
        r = self.recipe
        first = self.first + r.identify + chunk * r.chunk * r.candidates
        return data.selected(self.plants[index], r.sources[index], range(first, first + r.chunk * r.candidates), r.chunk)

    def start_from(self, tensors: dict[str, Array]) -> None:
        """Take the weights of a network that hears no filter; the further inputs begin at 0, but for the direct way."""
        state = self.network.state_dict()
        plain = self.network.value.in_features - tensors["network.value.weight"].shape[1]
        for name, value in state.items():
            if name == "direct.weight":
                continue
            old = torch.from_numpy(tensors[f"network.{name}"])
            if name in ("value.weight", "gate.weight"):
                old = torch.cat([old, torch.zeros(len(old), plain)], dim=1)
            elif name == "join.weight":  # [features, products]: the new inputs stand between
                at = tensors["network.value.weight"].shape[1]
                old = torch.cat([old[:, :at], torch.zeros(len(old), plain), old[:, at:]], dim=1)
            value.copy_(old)

    def save(self) -> None:
        """Write the checkpoint."""
        p = self.progress
        tensors = {f"network.{k}": v for k, v in self.network.state_dict().items()}
        tensors |= {f"model.{k}": a for k, a in p.model._asdict().items()} | {"prior": p.prior, "share": p.share}
        state = {"passes": p.passes, "steps": p.steps, "seconds": p.seconds, "curve": p.curve}
        checkpoints.write(self.checkpoint, self.identity, tensors, self.optimiser, state)

    def restore(self) -> None:
        """Go on from the checkpoint."""
        tensors, state = checkpoints.read(self.checkpoint, self.identity)
        model = Model(*(tensors[f"model.{k}"] for k in Model._fields))
        self.progress = Progress(model, tensors["prior"], tensors["share"], **state)
        self.make(model)
        checkpoints.restore(self.network, "network", self.optimiser, tensors)

    # -- training

    def flown(self, seeds: list[Sequence[int]]) -> tuple[Flights, list[Record]]:
        """All sources' flights; seeds per source."""
        r = self.recipe
        found = [
            data.prepare(self.plant_id, r.sources, i, r.shape, self.progress.model, r.filters, of_source)
            for i, of_source in enumerate(seeds)
        ]
        return data.joined([f for f, _ in found]), [record for _, record in found]

    def chunk(self, index: int) -> Flights:
        """The training flights of one chunk."""
        return self.flown([self.seeds_of(index, i) for i in range(len(self.plants))])[0]

    def held_out(self, first: int) -> tuple[Flights, list[Record]]:
        """The validation or calibration flights, which are the same for every source."""
        return self.flown([range(first, first + self.recipe.validation)] * len(self.plants))

    def one_pass(self, flown: Flights) -> float:
        """Show the flights once, in an order of this pass's own; the mean loss."""
        p, r = self.progress, self.recipe
        labels = len(self.plant.labels)
        balance = 1 / (labels * np.maximum(p.share, RAREST))
        order = np.random.default_rng([self.seed, p.passes]).permutation(len(flown.label))
        total = 0.0
        for i in range(0, len(order), r.batch):
            j = order[i : i + r.batch]
            weight = balance[flown.process[j, None], flown.label[j]] * flown.scored[j]
            done = p.steps / (self.total * self.per_pass)
            for group in self.optimiser.param_groups:
                group["lr"] = r.rate * min(1.0, (p.steps + 1) / 50) * (0.5 * (1 + np.cos(np.pi * done)) + 0.01)
            batch = (flown.label[j], flown.deviation[j], weight.astype(np.float32))
            answer = self.network(torch.from_numpy(flown.features[j]).to(self.device))
            value = loss(answer, *(torch.from_numpy(a).to(self.device) for a in batch), share=r.share)
            self.optimiser.zero_grad()
            value.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            self.optimiser.step()
            total += float(value.detach())
            p.steps += 1
        p.passes += 1
        return total * r.batch / len(order)

    def logits(self, flown: Flights) -> Array:
        """The network's logits (N, T, labels)."""
        with torch.inference_mode():
            parts = [
                self.network(torch.from_numpy(flown.features[i : i + 50]).to(self.device))[0].cpu().numpy()
                for i in range(0, len(flown.label), 50)
            ]
        return np.concatenate(parts)

    def accuracy(self, flown: Flights, records: list[Record]) -> dict[str, float]:
        """Balanced accuracy per sample of each process, as the leaderboards count it."""
        found, declared = {}, self.logits(flown).argmax(axis=2)
        for index, (plant, source, record) in enumerate(zip(self.plants, self.recipe.sources, records, strict=True)):
            mine = declared[flown.process == index]
            mode = data.at_samples(mine, self.recipe.shape.period, record.label.shape[1])
            found[source.process] = data.accuracy(plant, source, record, mode)
        return found

    def run(self, stop_after: int | None = None) -> Path:
        """Train, validate now and then, keep a checkpoint, and write weights and card at the end.

        Args:
            stop_after: Stop after so many passes, as if killed.
        """
        p, r = self.progress, self.recipe
        writer = SummaryWriter(str(self.work / "tensorboard"))
        validation, records = self.held_out(VALIDATION)
        flown, flown_index = None, -1
        before = p.seconds - (time.perf_counter() - self.started)
        bar = tqdm(total=self.total, initial=p.passes, desc=f"{self.method} {self.plant_id}", unit="pass")
        while p.passes < self.total:
            if stop_after is not None and p.passes >= stop_after:
                writer.close()
                return self.checkpoint
            index = p.passes // r.passes
            if flown is None or index != flown_index:
                flown, flown_index = self.chunk(index), index
            value = self.one_pass(flown)
            p.seconds = before + time.perf_counter() - self.started
            writer.add_scalar("loss", value, p.steps)
            if p.passes % r.validate == 0 or p.passes == self.total:
                entry = {"step": p.steps, "flights": min((index + 1) * r.chunk, r.flights), "seconds": round(p.seconds, 1),
                         "loss": value, "accuracy": self.accuracy(validation, records)}  # fmt: skip
                p.curve.append(entry)
                for name, share in entry["accuracy"].items():
                    writer.add_scalar(f"accuracy/{name}", share, p.steps)
                bar.set_postfix({k: f"{v:.3f}" for k, v in entry["accuracy"].items()})
                self.save()
            bar.update()
        bar.close()
        writer.close()
        return self.finish(validation)

    # -- the end

    def calibrate(self, validation: Flights) -> dict[str, weights.Fitted]:
        """Fit the calibration on its own flights and measure it on the validation flights."""
        p, r = self.progress, self.recipe
        flown, _ = self.held_out(CALIBRATION)
        fitted, measured = self.logits(flown).astype(float), self.logits(validation).astype(float)
        found = {}
        for index, source in enumerate(r.sources):
            mine = flown.scored & (flown.process == index)[:, None]
            theirs = validation.scored & (validation.process == index)[:, None]
            scale, bias = calibration.fit(fitted[mine], flown.label[mine], p.prior[index])
            label = validation.label[theirs]
            plain = calibration.log_softmax(measured[theirs] + np.log(p.prior[index]))
            better = calibration.log_softmax(scale * measured[theirs] + bias)
            found[source.process] = weights.Fitted(
                scale=scale, bias=bias.tolist(), prior=p.prior[index].tolist(),
                log_score=(calibration.log_score(plain, label), calibration.log_score(better, label)),
                calibration_error=(
                    calibration.calibration_error(plain, label), calibration.calibration_error(better, label)
                ),
            )  # fmt: skip
        return found

    def finish(self, validation: Flights) -> Path:
        """Calibrate, and write weights and card."""
        p, r = self.progress, self.recipe
        revision, versions = weights.made_with()
        fresh = self.total // r.passes * r.chunk
        samples = len(r.sources) * (fresh + r.identify) * validation.label.shape[1] * r.shape.period
        card = weights.Card(
            method=self.method, env=self.plant.env_id, plant=self.plant_id,
            options=[dict(plant.options) for plant in self.plants], processes=[s.process for s in r.sources],
            **weights.names(self.plant),  # type: ignore[arg-type]
            task="both",
            shape={**r.shape._asdict(), "hidden": r.hidden}, filters=list(r.filters),
            seeds={
                "training": [self.first, self.first + r.identify + fresh * r.candidates - 1],
                "validation": [VALIDATION, VALIDATION + r.validation - 1],
                "calibration": [CALIBRATION, CALIBRATION + r.validation - 1],
            },
            budget={"flights": len(r.sources) * (fresh + r.identify), "samples": samples,
                    "passes": r.passes, "steps": p.steps, "seconds": round(p.seconds, 1)},
            curve=p.curve, calibration=self.calibrate(validation), command=self.command,
            revision=revision, versions=versions,
        )  # fmt: skip
        tensors = {f"network.{k}": v.cpu().numpy() for k, v in self.network.state_dict().items()}
        tensors |= {f"model.{k}": a for k, a in p.model._asdict().items()}
        path = self.work / f"{self.method}-{self.plant_id}.safetensors"
        weights.write(path, tensors, card)
        return path
