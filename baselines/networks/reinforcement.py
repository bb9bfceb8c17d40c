"""PPO (stable-baselines3) on the environments, through the bridge, in legs that can be resumed exactly.

A diagnosis never feeds back into the plant, so a decision is worth its own reward: the discount is 0. The isolation
reward is `fdi_gym.wrappers.DelayAwareReward`, weighted so that every label counts the same; the identification reward is
the environment's. A leg begins new flights, from seeds and random streams of its own, so a checkpoint at its end needs
weights and the optimiser's moments only.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from safetensors import safe_open
from safetensors.numpy import save
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from baselines.networks import flights as data
from baselines.networks import weights
from baselines.networks.adapters import from_torch
from baselines.networks.flights import PER_SEED, TRAINING, VALIDATION, Source
from baselines.networks.policy import Policy, actor_tensors, compressed
from fdi_gym.diagnosis import run
from fdi_gym.evaluation import write_whole
from fdi_gym.metrics import balanced_accuracy, scored_samples
from fdi_gym.plant import Array
from fdi_gym.sb3 import FDIVecEnv
from fdi_gym.wrappers import BlockSummary, DelayAwareReward, VectorHistory


class Compressed(BaseFeaturesExtractor):
    """`compressed` as SB3 wants it."""

    def __init__(self, observation_space):
        super().__init__(observation_space, int(np.prod(observation_space.shape)))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Features of observations."""
        return compressed(observations)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a policy is trained.

    Args:
        source: Fault process and options of the plant.
        task: "isolation" or "identification".
        decision_period: Samples per decision.
        length, stride: Of the window, in decisions.
        patience: Of the delay-aware reward, in decisions.
        decisions: The budget.
        envs: Environments side by side.
        steps: Decisions of each per update.
        updates: Updates per leg.
        epochs: Passes over an update's decisions.
        batch: Decisions per gradient step.
        rate: Learning rate at the start; it falls to a tenth.
        hidden: Widths of the two layers.
        entropy: Weight of the entropy.
        validate: Legs between validations.
        validation: Flights of the validation.
    """

    source: Source
    task: str = "isolation"
    decision_period: int = 10
    length: int = 16
    stride: int = 1
    patience: float = 10.0
    decisions: int = 1_000_000
    envs: int = 64
    steps: int = 64
    updates: int = 8
    epochs: int = 4
    batch: int = 512
    rate: float = 1e-3
    hidden: int = 128
    entropy: float = 0.003
    validate: int = 4
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
        self.plant = data.plant_of(plant_id, recipe.source)
        self.first = TRAINING + PER_SEED * seed
        per_leg = recipe.envs * recipe.steps * recipe.updates
        self.legs, self.per_leg = max(1, round(recipe.decisions / per_leg)), per_leg
        self.leg, self.seconds, self.curve = 0, 0.0, []
        work.mkdir(parents=True, exist_ok=True)
        self.model = self.make()
        if self.checkpoint.exists():
            self.restore()

    def make(self) -> PPO:
        """Environments and a new policy."""
        r = self.recipe
        arguments: dict[str, Any] = {"task": r.task, "scenario": r.source.process, "decision_period": r.decision_period}
        arguments |= {"units": "scaled", "autoreset_mode": AutoresetMode.SAME_STEP, **r.source.options}
        envs: Any = gym.make_vec(self.plant.env_id, num_envs=r.envs, **arguments)
        if r.task == "isolation":
            labels = data.fly(self.plant, r.source, range(self.first, self.first + 200)).label
            share = np.bincount(labels.ravel(), minlength=len(self.plant.labels)) / labels.size
            envs = DelayAwareReward(envs, r.patience, np.minimum(1 / (len(share) * np.maximum(share, 1e-9)), 10.0).tolist())
        venv = VecMonitor(FDIVecEnv(VectorHistory(BlockSummary(envs), r.length, r.stride)))
        return PPO(
            "MlpPolicy", venv, learning_rate=r.rate, n_steps=r.steps, batch_size=r.batch, n_epochs=r.epochs, gamma=0.0,
            gae_lambda=0.0, ent_coef=r.entropy, seed=self.seed, device="auto" if torch.cuda.is_available() else "cpu",
            policy_kwargs={"features_extractor_class": Compressed, "net_arch": [r.hidden, r.hidden], "log_std_init": -1.0},
        )  # fmt: skip

    def identity(self) -> str:
        """What a checkpoint must share with the run that goes on from it."""
        return json.dumps({"method": self.method, "plant": self.plant.env_id, "seed": self.seed, **asdict(self.recipe)})

    def save(self) -> None:
        """Write the checkpoint whole."""
        tensors = {f"policy.{k}": v.cpu().numpy() for k, v in self.model.policy.state_dict().items()}
        for i, moments in self.model.policy.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{i}.{k}": v.cpu().numpy() for k, v in moments.items()}
        state = {"leg": self.leg, "seconds": self.seconds, "curve": self.curve, "run": self.identity()}
        write_whole(self.checkpoint, save(tensors, metadata={"state": json.dumps(state)}))

    def restore(self) -> None:
        """Go on from the checkpoint."""
        tensors = weights.read_tensors(self.checkpoint)
        with safe_open(self.checkpoint, "np") as file:
            state = json.loads(file.metadata()["state"])
        if state["run"] != self.identity():
            raise ValueError(f"{self.checkpoint} is of a run with another recipe or seed; move it away to begin a new one")
        self.leg, self.seconds, self.curve = state["leg"], state["seconds"], state["curve"]
        policy = self.model.policy
        policy.load_state_dict({k: torch.from_numpy(tensors[f"policy.{k}"]) for k in policy.state_dict()})
        adam = policy.optimizer.state_dict()
        moments = ("step", "exp_avg", "exp_avg_sq")
        adam["state"] = {
            i: {k: torch.from_numpy(tensors[f"adam.{i}.{k}"]) for k in moments} for i in adam["param_groups"][0]["params"]
        }
        policy.optimizer.load_state_dict(adam)

    def one_leg(self) -> float:
        """Fly and learn; the mean reward per decision."""
        r, model = self.recipe, self.model
        model.set_random_seed(int(np.random.SeedSequence([self.seed, self.leg]).generate_state(1)[0]))
        model.get_env().seed(self.first + 1000 + self.leg * r.envs)  # type: ignore[union-attr]
        model.learning_rate = r.rate * (1 - 0.9 * self.leg / self.legs)
        model._setup_lr_schedule()
        model._last_obs = None  # the leg begins with a reset
        model.learn(self.per_leg, reset_num_timesteps=False)
        self.leg += 1
        return float(model.rollout_buffer.rewards.mean())

    def actor(self) -> tuple[Policy, dict[str, Array]]:
        """The actor alone, and its tensors."""
        tensors = actor_tensors(self.model.policy.state_dict())
        shapes = [a.shape for name, a in tensors.items() if name.endswith("weight")]
        policy = Policy([shapes[0][1], *(shape[0] for shape in shapes)])
        policy.load_state_dict({k: torch.from_numpy(a.copy()) for k, a in tensors.items()})
        return policy, tensors

    def validate(self) -> dict[str, float]:
        """Balanced accuracy per sample, or the scaled root mean square error, on the validation flights."""
        r, plant = self.recipe, self.plant
        record = data.fly(plant, r.source, range(VALIDATION, VALIDATION + r.validation))
        said = run(
            from_torch(
                self.actor()[0], plant, task=r.task, decision_period=r.decision_period, length=r.length, stride=r.stride
            ),
            record.obs,
        )
        scoring, labels = plant.process(r.source.process).scoring, len(plant.labels)
        confusion, squares = np.zeros((labels, labels + 1)), []
        for i, (true, length) in enumerate(zip(record.label, record.length, strict=True)):
            scored = scored_samples(true, int(length), scoring)
            np.add.at(confusion, (true[scored], said.mode[i, scored].astype(int)), 1)
            if said.theta is not None:
                squares.append(((said.theta[i] - record.target[i]) / [s.scale for s in plant.estimated])[scored] ** 2)
        if r.task == "identification":
            return {"rmse": float(np.sqrt(np.concatenate(squares).mean()))}
        return {r.source.process: float(balanced_accuracy(confusion))}

    def run(self, stop_after: int | None = None) -> Path:
        """Train, validate now and then, keep a checkpoint, and write weights and card at the end.

        Args:
            stop_after: Stop after so many legs, as if killed.
        """
        r = self.recipe
        writer = SummaryWriter(str(self.work / "tensorboard"))
        before = time.perf_counter() - self.seconds
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
        _, tensors = self.actor()
        last = self.first + 1000 + self.legs * r.envs - 1
        shape = {"decision_period": r.decision_period, "length": r.length, "stride": r.stride, "hidden": r.hidden}
        card = weights.Card(
            method=self.method, env=self.plant.env_id, plant=self.plant_id, options=[dict(self.plant.options)],
            processes=[r.source.process], **weights.names(self.plant), task=r.task, shape=shape,  # type: ignore[arg-type]
            seeds={"training": [self.first, last], "validation": [VALIDATION, VALIDATION + r.validation - 1]},
            budget={"decisions": self.legs * self.per_leg, "samples": self.legs * self.per_leg * r.decision_period,
                    "seconds": round(self.seconds, 1)},
            curve=self.curve, command=self.command, revision=revision, versions=versions,
        )  # fmt: skip
        path = self.work / f"{self.method}-{self.plant_id}.safetensors"
        weights.write(path, tensors, card)
        return path
