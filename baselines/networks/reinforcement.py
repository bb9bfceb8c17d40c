"""PPO (stable-baselines3) on the environments, through the bridge, in legs that can be resumed exactly.

The policy sees what the supervised network sees: the features of a model of the plant, identified from training flights
(`baselines.networks.identification`); their recursive estimates are its memory. A diagnosis never feeds back into the
plant, so a decision is worth its own reward: the discount is 0. The isolation reward is
`fdi_gym.wrappers.DelayAwareReward`, weighted so that every label counts the same; the identification reward is the
environment's. The fault processes take turns, a leg each. A leg begins new flights, from seeds and random streams of its
own, so a checkpoint at its end needs the weights, the optimiser's moments, the model and the labels' shares only.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from baselines.networks import checkpoints, weights
from baselines.networks import flights as data
from baselines.networks.flights import PER_SEED, TRAINING, VALIDATION, Source
from baselines.networks.identification import Model, Shape
from baselines.networks.observed import IdentifiedFeatures
from baselines.networks.policy import actor_tensors, streaming
from fdi_gym.diagnosis import run
from fdi_gym.engine import Record
from fdi_gym.plant import Array
from fdi_gym.sb3 import FDIVecEnv
from fdi_gym.wrappers import DelayAwareReward

HEAVIEST = 10.0  # weight of a rare label's reward


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a policy is trained.

    Args:
        sources: Fault processes, with the options of the plant; they take turns.
        shape: Of the identified model; the policy decides once per `shape.period` samples.
        identify: Training flights per process from which the model is identified, with their truth: the first ones.
        task: "isolation" or "identification".
        patience: Of the delay-aware reward, in decisions.
        decisions: The budget.
        candidates: Seeds per training flight, from which those are taken that show rare labels.
        envs: Environments side by side. Their flights begin together, so `steps` should span whole flights ...
        steps: Decisions of each per update; ... but not their very end, where new flights would begin for nothing.
        updates: Updates per leg.
        epochs: Passes over an update's decisions.
        batch: Decisions per gradient step.
        rate: Learning rate at the start; it falls to a tenth.
        hidden: Widths of the two layers.
        entropy: Weight of the entropy.
        validate: Legs between validations.
        validation: Flights per process of the validation.
    """

    sources: tuple[Source, ...]
    shape: Shape
    identify: int = 300
    task: str = "isolation"
    patience: float = 10.0
    decisions: int = 1_000_000
    candidates: int = 1
    envs: int = 64
    steps: int = 250
    updates: int = 1
    epochs: int = 4
    batch: int = 512
    rate: float = 1e-3
    hidden: int = 128
    entropy: float = 0.01
    validate: int = 8
    validation: int = 60


class Run:
    """One PPO run in a folder: `run()` trains to the end, or goes on where a killed run was.

    Args:
        method: Name of the trainer, for the card.
        plant_id: The plant.
        recipe: How.
        seed: Of everything.
        work: Folder of the checkpoint and the tensorboard log.
        command: For the card.
        threads: Of torch.

    Raises:
        ValueError: The folder holds a run with another recipe or seed.
    """

    def __init__(
        self, method: str, plant_id: str, recipe: Recipe, *, seed: int, work: Path, command: str = "", threads: int = 1
    ):  # fmt: skip
        torch.set_num_threads(threads)
        self.method, self.plant_id, self.recipe, self.seed, self.command = method, plant_id, recipe, seed, command
        self.work, self.checkpoint = work, work / "checkpoint.safetensors"
        self.plants = [data.plant_of(plant_id, source) for source in recipe.sources]
        self.plant = self.plants[0]
        self.first = TRAINING + PER_SEED * seed
        per_leg = recipe.envs * recipe.steps * recipe.updates
        self.identity = checkpoints.identity(method, self.plant, seed, recipe)
        self.legs, self.per_leg = max(1, round(recipe.decisions / per_leg)), per_leg
        self.leg, self.seconds, self.curve = 0, 0.0, []
        self.started = time.perf_counter()
        self.held_out: list[Record] = []
        work.mkdir(parents=True, exist_ok=True)
        if self.checkpoint.exists():
            self.restore()
        else:
            self.begin()

    def begin(self) -> None:
        """Identify the plant, and make a new policy."""
        seeds = range(self.first, self.first + self.recipe.identify)
        records = [data.fly(p, s, seeds) for p, s in zip(self.plants, self.recipe.sources, strict=True)]
        share = np.stack([
            data.label_share(plant, source, [seed for leg in range(4) for seed in self.seeds_of(leg, index)])
            for index, (plant, source) in enumerate(zip(self.plants, self.recipe.sources, strict=True))
        ])  # fmt: skip
        self.make(data.identified(self.plants, self.recipe.shape, records), share)

    def seeds_of(self, leg: int, index: int) -> list[int]:
        """The seeds of the flights that a leg begins with."""
        r = self.recipe
        first = self.first + r.identify + leg * r.envs * r.candidates
        return data.selected(self.plants[index], r.sources[index], range(first, first + r.envs * r.candidates), r.envs)

    def make(self, model: Model, share: Array) -> None:
        """Environments and a new policy, from the model and each process's share (processes, labels) of each label."""
        r = self.recipe
        self.model, self.share = model, share
        self.venvs = [self.environments(index) for index in range(len(r.sources))]
        self.agent = PPO(
            "MlpPolicy", self.venvs[0], learning_rate=r.rate, n_steps=r.steps, batch_size=r.batch, n_epochs=r.epochs,
            gamma=0.0, gae_lambda=0.0, ent_coef=r.entropy, seed=self.seed,
            device="auto" if torch.cuda.is_available() else "cpu",
            policy_kwargs={"net_arch": [r.hidden, r.hidden], "log_std_init": -1.0},
        )  # fmt: skip
        self.agent.set_logger(Logger(folder=None, output_formats=[]))  # or SB3 leaves a temporary folder per leg

    def environments(self, index: int) -> FDIVecEnv:
        """The environments of one process, as the policy sees and is rewarded by them."""
        r, plant = self.recipe, self.plants[index]
        source = r.sources[index]
        arguments: dict[str, Any] = {"task": r.task, "process": source.process, "decision_period": r.shape.period}
        arguments |= {"autoreset_mode": AutoresetMode.SAME_STEP, **source.options}
        arguments["units"] = "physical" if r.task == "isolation" else "scaled"  # an action in [-1, 1] is learned best
        envs: Any = gym.make_vec(plant.env_id, num_envs=r.envs, **arguments)
        if r.task == "isolation":
            weight = 1 / (len(plant.labels) * np.maximum(self.share[index], 1e-9))
            envs = DelayAwareReward(envs, r.patience, np.minimum(weight, HEAVIEST).tolist())
        return FDIVecEnv(IdentifiedFeatures(envs, plant, r.shape, self.model))

    def save(self) -> None:
        """Write the checkpoint."""
        policy = self.agent.policy
        tensors = {f"policy.{k}": v for k, v in policy.state_dict().items()}
        tensors |= {"share": self.share, **{f"model.{k}": a for k, a in self.model._asdict().items()}}
        state = {"leg": self.leg, "seconds": self.seconds, "curve": self.curve}
        checkpoints.write(self.checkpoint, self.identity, tensors, policy.optimizer, state)

    def restore(self) -> None:
        """Go on from the checkpoint."""
        tensors, state = checkpoints.read(self.checkpoint, self.identity)
        self.leg, self.seconds, self.curve = state["leg"], state["seconds"], state["curve"]
        self.make(Model(*(tensors[f"model.{name}"] for name in Model._fields)), tensors["share"])
        checkpoints.restore(self.agent.policy, "policy", self.agent.policy.optimizer, tensors)

    def one_leg(self) -> float:
        """Fly and learn; the mean reward per decision."""
        r, agent = self.recipe, self.agent
        agent.set_random_seed(int(np.random.SeedSequence([self.seed, self.leg]).generate_state(1)[0]))
        index = self.leg % len(self.venvs)
        self.venvs[index]._seeds = list(self.seeds_of(self.leg, index))
        agent.set_env(self.venvs[index])  # the leg begins with a reset
        agent.learning_rate = r.rate * (1 - 0.9 * self.leg / self.legs)
        agent._setup_lr_schedule()
        agent.learn(self.per_leg, reset_num_timesteps=False)
        self.leg += 1
        return float(agent.rollout_buffer.rewards.mean())

    def tensors(self) -> dict[str, Array]:
        """What is stored: the actor and the model."""
        model = {f"model.{name}": a for name, a in self.model._asdict().items()}
        return model | actor_tensors(self.agent.policy.state_dict())

    def validate(self) -> dict[str, float]:
        """Per process the balanced accuracy per sample, or the scaled root mean square error, on the validation flights."""
        r, found = self.recipe, {}
        if not self.held_out:
            seeds = range(VALIDATION, VALIDATION + r.validation)
            self.held_out = [data.fly(p, s, seeds) for p, s in zip(self.plants, r.sources, strict=True)]
        for plant, source, record in zip(self.plants, r.sources, self.held_out, strict=True):
            said = run(streaming(plant, r.shape, self.model, self.tensors(), r.task), record.obs)
            if said.estimate is None:
                found[source.process] = data.accuracy(plant, source, record, said.label)
            else:
                error = (said.estimate - record.target) / [s.scale for s in plant.estimated]
                scored = data.scored_of(plant, source, record)
                found[f"{source.process} rmse"] = float(np.sqrt((error[scored] ** 2).mean()))
        return found

    def run(self, stop_after: int | None = None) -> Path:
        """Train, validate now and then, keep a checkpoint, and write weights and card at the end.

        Args:
            stop_after: Stop after so many legs, as if killed.
        """
        r = self.recipe
        writer = SummaryWriter(str(self.work / "tensorboard"))
        before = self.started - self.seconds
        bar = tqdm(total=self.legs, initial=self.leg, desc=f"{self.method} {self.plant_id}", unit="leg")
        while self.leg < self.legs and (stop_after is None or self.leg < stop_after):
            reward = self.one_leg()
            decisions = self.leg * self.per_leg
            writer.add_scalar("reward", reward, decisions)
            if self.leg % r.validate == 0 or self.leg == self.legs:
                found = self.validate()
                self.seconds = time.perf_counter() - before
                entry = {"step": decisions, "seconds": round(self.seconds, 1), "reward": reward, "accuracy": found}
                self.curve.append(entry)
                for name, value in found.items():
                    writer.add_scalar(f"accuracy/{name}", value, decisions)
                bar.set_postfix({k: f"{v:.3f}" for k, v in found.items()})
            self.save()
            bar.update()
        bar.close()
        writer.close()
        return self.finish() if self.leg == self.legs else self.checkpoint

    def finish(self) -> Path:
        """Write the actor and its card."""
        r = self.recipe
        revision, versions = weights.made_with()
        last = self.first + r.identify + self.legs * r.envs * r.candidates - 1
        card = weights.Card(
            method=self.method, env=self.plant.env_id, plant=self.plant_id,
            options=[dict(plant.options) for plant in self.plants], processes=[s.process for s in r.sources],
            **weights.names(self.plant),  # type: ignore[arg-type]
            task=r.task, shape={**r.shape._asdict(), "hidden": r.hidden},
            seeds={"training": [self.first, last], "validation": [VALIDATION, VALIDATION + r.validation - 1]},
            budget={"decisions": self.legs * self.per_leg, "samples": self.legs * self.per_leg * r.shape.period,
                    "seconds": round(self.seconds, 1)},
            curve=self.curve, command=self.command, revision=revision, versions=versions,
        )  # fmt: skip
        path = self.work / f"{self.method}-{self.plant_id}.safetensors"
        weights.write(path, self.tensors(), card)
        return path
