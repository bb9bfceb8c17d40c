"""PPO (stable-baselines3) on the environments, through the bridge, in legs that can be resumed exactly.

The policy sees what the recurrent network sees: the features of a model of the plant, identified from training flights
(`baselines.learned.features`); their recursive estimates are its memory. A diagnosis never feeds back into the plant, so a
decision is worth its own reward: the discount is 0. The isolation reward is `fdi_gym.wrappers.DelayAwareReward`, weighted
so that every label counts the same; the identification reward is the environment's. The conditions take turns, a leg each.
A leg begins new flights, from seeds and random streams of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

from baselines.learned import flights as data
from baselines.learned import weights
from baselines.learned._training import Training
from baselines.learned.feature_env import IdentifiedFeatures
from baselines.learned.features import FeatureModel
from baselines.learned.flights import VALIDATION
from baselines.learned.policy import policy_diagnoser
from baselines.learned.recipes import LegsRecipe, PolicyRecipe
from fdi_gym.diagnosis import run
from fdi_gym.engine import Record
from fdi_gym.plant import Array
from fdi_gym.sb3 import FDIVecEnv
from fdi_gym.wrappers import DelayAwareReward

HEAVIEST = 10.0  # weight of a rare label's reward


def actor_tensors(state: Mapping[str, Any]) -> dict[str, Array]:
    """The actor's tensors out of the state of an SB3 `MlpPolicy`: `layers.i.weight` and `layers.i.bias`."""
    hidden = sorted({name.rsplit(".", 1)[0] for name in state if name.startswith("mlp_extractor.policy_net.")})
    return {
        f"layers.{i}.{part}": state[f"{layer}.{part}"].cpu().numpy()
        for i, layer in enumerate([*hidden, "action_net"])
        for part in ("weight", "bias")
    }


L = TypeVar("L", bound=LegsRecipe)


class Legs(Training[L]):
    """PPO in legs, each with flights of its own; arguments as in `Training`."""

    unit, score = "leg", "reward"
    agent: Any  # PPO
    venvs: list[FDIVecEnv]  # one a condition; the legs take them in turn

    def plan(self) -> None:
        """Legs, each with flights under one condition."""
        r = self.recipe
        self.per_leg = r.envs * r.steps * r.updates  # decisions
        self.rounds = max(1, round(r.decisions / self.per_leg))
        self.together, self.flights = r.envs, self.rounds * r.envs

    def learned(self) -> tuple[torch.nn.Module, torch.optim.Optimizer]:
        """Actor and critic."""
        return self.agent.policy, self.agent.policy.optimizer

    def place(self) -> dict[str, int]:
        """Decisions."""
        return {"step": self.done * self.per_leg}

    def learn(self) -> float:
        """Fly and learn; the mean reward per decision."""
        r, agent, index = self.recipe, self.agent, self.done % len(self.venvs)
        agent.set_random_seed(int(np.random.SeedSequence([self.seed, self.done]).generate_state(1)[0]))
        self.venvs[index]._seeds = list(self.seeds_of(self.done, index))
        agent.set_env(self.venvs[index])  # the leg begins with a reset
        agent.learning_rate = r.rate * (1 - 0.9 * self.done / self.rounds)
        agent._setup_lr_schedule()
        agent.learn(self.per_leg, reset_num_timesteps=False)
        return float(agent.rollout_buffer.rewards.mean())


class PolicyTraining(Legs[PolicyRecipe]):
    """A policy on the features of `IdentifiedFeatures`."""

    def begin(self) -> None:
        """Identify the plant, and make a new policy."""
        r = self.recipe
        model = data.identified(self.plants, r.shape, self.flown(self.first, r.identify))
        share = np.stack([
            data.label_share(plant, condition, [seed for leg in range(4) for seed in self.seeds_of(leg, i)])
            for i, (plant, condition) in enumerate(zip(self.plants, r.conditions, strict=True))
        ])  # fmt: skip
        self.make(model, share)

    def make(self, model: FeatureModel, share: Array) -> None:
        """Environments and a new policy, from the model and the share of each label (conditions, labels)."""
        r = self.recipe
        self.model, self.share = model, share
        self.venvs = [self.environments(i) for i in range(len(r.conditions))]
        self.agent = PPO(
            "MlpPolicy", self.venvs[0], learning_rate=r.rate, n_steps=r.steps, batch_size=r.batch, n_epochs=r.epochs,
            gamma=0.0, gae_lambda=0.0, ent_coef=r.entropy, seed=self.seed,
            device="auto" if torch.cuda.is_available() else "cpu",
            policy_kwargs={"net_arch": [r.hidden, r.hidden], "log_std_init": -1.0},
        )  # fmt: skip
        self.agent.set_logger(Logger(folder=None, output_formats=[]))  # or SB3 leaves a temporary folder per leg

    def environments(self, index: int) -> FDIVecEnv:
        """The environments of one condition, as the policy sees and is rewarded by them."""
        r, plant = self.recipe, self.plants[index]
        arguments: dict[str, Any] = {
            "task": r.task, "process": r.conditions[index].process, "decision_period": r.shape.period,
            "units": "physical" if r.task == "isolation" else "scaled",  # an action in [-1, 1] is learned best
            "autoreset_mode": AutoresetMode.SAME_STEP,
        }  # fmt: skip
        envs: Any = gym.make_vec(plant.env_id, num_envs=r.envs, **arguments, **plant.options)
        if r.task == "isolation":
            weight = 1 / (len(plant.labels) * np.maximum(self.share[index], 1e-9))
            envs = DelayAwareReward(envs, r.patience, np.minimum(weight, HEAVIEST).tolist())
        return FDIVecEnv(IdentifiedFeatures(envs, plant, r.shape, self.model))

    def state(self) -> dict[str, Array]:
        """The identified model, and the shares of the labels."""
        return {**weights.model_tensors(self.model), "share": self.share}

    def restore(self, tensors: Mapping[str, Array]) -> None:
        """As `begin` has left it."""
        self.make(weights.model_of(tensors), tensors["share"])

    @functools.cached_property
    def validation(self) -> list[Record]:
        """The validation flights."""
        return self.flown(VALIDATION, self.recipe.validation)

    def validate(self) -> dict[str, float]:
        """Per condition the balanced accuracy per sample, or the scaled root mean square error."""
        r, found = self.recipe, {}
        for plant, condition, record in zip(self.plants, r.conditions, self.validation, strict=True):
            decisions = run(policy_diagnoser(plant, r.shape, self.tensors(), r.task), record.obs)
            if decisions.estimate is None:
                found[condition.process] = data.accuracy(plant, condition, record, decisions.label)
            else:
                error = (decisions.estimate - record.target) / [s.scale for s in plant.estimated]
                scored = data.scored_of(plant, condition, record)
                found[f"{condition.process} rmse"] = float(np.sqrt((error[scored] ** 2).mean()))
        return found

    def tensors(self) -> dict[str, Array]:
        """The actor and the model."""
        return weights.model_tensors(self.model) | actor_tensors(self.agent.policy.state_dict())

    def card(self) -> dict[str, Any]:
        """The task, and what it took."""
        decisions = self.rounds * self.per_leg
        budget = {"decisions": decisions, "samples": decisions * self.recipe.shape.period}
        return {"task": self.recipe.task, "budget": budget}
