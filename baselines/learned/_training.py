"""One training run in a folder: rounds that learn, validations, a log, a checkpoint after each round, a card at the end.

Everything random follows from the run's seed and the place in the run, so a checkpoint needs no random state: what is
learned, the optimiser's moments and that place are enough, and a resumed run ends with the same bytes as one that was never
stopped. What a round is, a subclass says: a pass over flights, a leg of reinforcement learning.
"""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import save
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from baselines.learned import flights as data
from baselines.learned import weights
from baselines.learned.flights import PER_SEED, TRAINING, VALIDATION
from baselines.learned.recipes import Recipe
from fdi_gym.engine import Record
from fdi_gym.files import write_whole
from fdi_gym.plant import Array, Plant

MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # of Adam
R = TypeVar("R", bound=Recipe)


class Training(ABC, Generic[R]):
    """One training run in a folder: `run()` trains to the end, or goes on where a killed run was.

    Args:
        method: Name of the trainer, for the card.
        plant: The plant.
        recipe: How.
        seed: Of everything; each has training seeds of its own.
        work: Folder of the checkpoint and the tensorboard log.
        command: For the card.
        threads: Of torch on a processor; the bytes of the weights depend on it.

    Raises:
        ValueError: The folder holds a run with another recipe, seed or plant.
    """

    unit: str  # what a round is called
    score: str  # what a round gives: "loss", "reward"
    rounds: int  # in all
    together: int  # flights per condition that a round, or rounds in turn, begin with
    flights: int  # training flights per condition, in all

    def __init__(
        self, method: str, plant: Plant, recipe: R, *, seed: int, work: Path, command: str = "", threads: int = 1
    ):  # fmt: skip
        torch.set_num_threads(threads)
        torch.manual_seed(seed)
        self.method, self.recipe, self.seed, self.command = method, recipe, seed, command
        self.plants = [data.plant_under(plant, condition) for condition in recipe.conditions]
        self.plant = self.plants[0]
        self.first = TRAINING + PER_SEED * seed
        self.work, self.checkpoint = work, work / "checkpoint.safetensors"
        self.identity = json.dumps(
            {"method": method, "plant": plant.env_id, "options": dict(plant.options), "seed": seed, **asdict(recipe)}
        )
        self.done, self.seconds, self.curve = 0, 0.0, []
        work.mkdir(parents=True, exist_ok=True)
        self.plan()
        if self.checkpoint.exists():
            self.load()
        else:
            self.begin()

    # -- what a subclass says

    def plan(self) -> None:
        """Set `rounds`, `together` and `flights` from the recipe."""

    @abstractmethod
    def begin(self) -> None:
        """Identify the plant, and make what learns."""

    @abstractmethod
    def learned(self) -> tuple[torch.nn.Module, torch.optim.Optimizer]:
        """What learns, and its optimiser."""

    @abstractmethod
    def state(self) -> dict[str, Array]:
        """What else a checkpoint holds."""

    @abstractmethod
    def restore(self, tensors: Mapping[str, Array]) -> None:
        """Make what learns, from the state of a checkpoint."""

    @abstractmethod
    def learn(self) -> float:
        """One round, number `done` from 0 on; its score."""

    @abstractmethod
    def validate(self) -> dict[str, float]:
        """The accuracy or error under each condition on the validation flights."""

    @abstractmethod
    def place(self) -> dict[str, int]:
        """How far the run is: "step", and what else the card's curve says."""

    @abstractmethod
    def tensors(self) -> dict[str, Array]:
        """The weights that are stored at the end."""

    @abstractmethod
    def card(self) -> dict[str, Any]:
        """What the card says beyond what every card says."""

    # -- flights

    def seeds_of(self, group: int, index: int) -> list[int]:
        """The seeds of a group of training flights that begin together, under one condition."""
        r = self.recipe
        count = self.together * r.candidates
        first = self.first + r.identify + group * count
        return data.selected(self.plants[index], r.conditions[index], range(first, first + count), self.together)

    def flown(self, first: int, count: int) -> list[Record]:
        """Flights of the seeds from `first` on, under each condition."""
        seeds = range(first, first + count)
        return [data.fly(p, c, seeds) for p, c in zip(self.plants, self.recipe.conditions, strict=True)]

    def last(self, flight: int) -> int:
        """The last seed of a flight of this number, under any condition."""
        return max(condition.seeds(flight)[-1] for condition in self.recipe.conditions)

    # -- the loop

    def run(self, stop_after: int | None = None) -> Path:
        """Train, validate now and then, keep a checkpoint, and write weights and card at the end.

        Args:
            stop_after: Stop after so many rounds, as if killed.

        Returns:
            The path of the weights, or of the checkpoint.
        """
        began = time.perf_counter() - self.seconds
        until = self.rounds if stop_after is None else min(stop_after, self.rounds)
        bar = tqdm(total=self.rounds, initial=self.done, desc=weights.stem(self.method, self.plant), unit=self.unit)
        with SummaryWriter(str(self.work / "tensorboard")) as log, bar:
            while self.done < until:
                score = self.learn()
                self.done += 1
                place = self.place()
                log.add_scalar(self.score, score, place["step"])
                if self.done % self.recipe.validate == 0 or self.done == self.rounds:
                    accuracy, seconds = self.validate(), round(time.perf_counter() - began, 1)
                    self.curve.append({**place, "seconds": seconds, self.score: score, "accuracy": accuracy})
                    for name, value in accuracy.items():
                        log.add_scalar(f"accuracy/{name}", value, place["step"])
                    bar.set_postfix({name: f"{value:.3f}" for name, value in accuracy.items()})
                self.seconds = time.perf_counter() - began
                self.save()
                bar.update()
        return self.finish() if self.done == self.rounds else self.checkpoint

    def finish(self) -> Path:
        """Write weights and card."""
        r = self.recipe
        revision, versions = weights.made_with()
        last = self.first + r.identify + self.flights * r.candidates - 1
        own = self.card()
        seeds = {
            "training": [self.first, self.last(last)],
            "validation": [VALIDATION, self.last(VALIDATION + r.validation - 1)],
        }
        cut = {"windows": [c.windows for c in r.conditions], "paces": [c.pace for c in r.conditions]}
        card = weights.Card(
            method=self.method, env=self.plant.env_id, plant=self.plant.id,
            options=[dict(plant.options) for plant in self.plants], processes=[c.name for c in r.conditions],
            **weights.names(self.plant), mismatch=max(c.mismatch for c in r.conditions),  # type: ignore[arg-type]
            shape=own.pop("shape", {**r.shape._asdict(), "hidden": r.hidden}), seeds=seeds | own.pop("seeds", {}),
            budget={**own.pop("budget"), "seconds": round(self.seconds, 1)},
            curve=self.curve, command=self.command, revision=revision, versions=versions, **own,
            **(cut if max(cut["windows"]) > 1 else {}),  # type: ignore[arg-type]
        )  # fmt: skip
        path = self.work / f"{weights.stem(self.method, self.plant)}.safetensors"
        weights.write(path, self.tensors(), card)
        return path

    # -- the checkpoint

    def save(self) -> None:
        """Write the checkpoint, whole."""
        module, optimiser = self.learned()
        found = {f"learned.{name}": value for name, value in module.state_dict().items()}
        for i, moments in optimiser.state_dict()["state"].items():
            found |= {f"adam.{i}.{name}": value for name, value in moments.items()}
        content = {name: np.asarray(value.cpu().numpy(), order="C") for name, value in found.items()}
        content |= {name: np.asarray(value, order="C") for name, value in self.state().items()}
        place = {"run": self.identity, "done": self.done, "seconds": self.seconds, "curve": self.curve}
        write_whole(self.checkpoint, save(content, metadata={"state": json.dumps(place)}))

    def load(self) -> None:
        """Go on from the checkpoint."""
        tensors = weights.read_tensors(self.checkpoint)
        with safe_open(self.checkpoint, "np") as file:
            place = json.loads(file.metadata()["state"])
        if place["run"] != self.identity:
            raise ValueError(
                f"{self.checkpoint} is of a run with another recipe, seed or plant; move it away to begin a new one"
            )
        self.done, self.seconds, self.curve = place["done"], place["seconds"], place["curve"]
        self.restore(tensors)
        module, optimiser = self.learned()
        module.load_state_dict({name: torch.from_numpy(tensors[f"learned.{name}"]) for name in module.state_dict()})
        adam = optimiser.state_dict()
        adam["state"] = {
            i: {name: torch.from_numpy(tensors[f"adam.{i}.{name}"]) for name in MOMENTS}
            for i in adam["param_groups"][0]["params"]
        }
        optimiser.load_state_dict(adam)
