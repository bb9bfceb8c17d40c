"""PPO (stable-baselines3) that probes: the active environment with a diagnoser on board, in legs that can be resumed.

The environment's action is the label that the diagnoser gives and the probe that the policy chooses; the reward of a
decision is what the diagnosis is worth, less the weighted cost of the flight since the last one. A probe costs now and
tells later: with a discount of 0 the policy learns never to probe, and the belief that a probe leaves behind is worth
something only to one that looks ahead.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

import fdi_gym  # noqa: F401 (registers the environments)
from baselines.learned import flights as data
from baselines.learned._reinforcement import Legs, actor_tensors
from baselines.learned.flights import VALIDATION
from baselines.probing.recipes import ProbingRecipe
from baselines.probing.sight import Sight
from fdi_gym.agents import Prober, fly
from fdi_gym.diagnosis import Diagnoser, make_diagnoser
from fdi_gym.diagnosis.contract import choose
from fdi_gym.faults import draw
from fdi_gym.plant import Array
from fdi_gym.sb3 import FDIVecEnv


class Probing(VectorWrapper):
    """Active environments as a policy sees them whose diagnoser is on board: its features in, a probe out.

    Args:
        env: Active environments that probe, in physical units, `decision_period` above 1, `autoreset_mode="SameStep"` and a
            `cost_weight` of 0: what the flight costs is asked for here.
        on_board: The diagnoser.
        sight: The features.
        cost_weight: Factor on the flight's cost.
    """

    def __init__(self, env: VectorEnv, on_board: Diagnoser, sight: Sight, cost_weight: float):
        super().__init__(env)
        self.on_board, self.sight, self.cost_weight = on_board, sight, cost_weight
        self.single_observation_space: Any = Box(-np.inf, np.inf, (sight.width,), np.float32)
        self.single_action_space: Any = Discrete(sight.probes)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.action_space = batch_space(self.single_action_space, env.num_envs)

    def _see(self, block: Array) -> Array:
        for k in range(block.shape[1]):
            self.seen, self.said = self.on_board.update(self.seen, block[:, k])
        self.past, features = self.sight.see(self.past, block[:, -1], self.said)
        return features.astype(np.float32)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin new flights in all environments."""
        obs, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self.past, self.seen = self.sight.begin(self.num_envs), self.on_board.init(self.num_envs)
        return self._see(obs[:, -1:]), infos

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Fly on with these probes and what the diagnoser says; flights that end begin anew."""
        probe = np.asarray(actions, np.int64)
        self.past = self.sight.choose(self.past, probe)
        label = np.clip(self.said.label, 0, self.sight.doubts.labels - 1)
        obs, reward, terminated, truncated, infos = self.env.step(np.stack([label, probe], axis=1))
        cost = self.env.unwrapped.truth("cost")["cost"]  # type: ignore[attr-defined]
        reward = reward - self.cost_weight * cost
        done, block = terminated | truncated, obs
        if done.any():
            block = obs.copy()
            block[done] = np.stack(list(infos["final_obs"][done]))
        shown = self._see(block)
        if done.any():
            final = np.empty(self.num_envs, dtype=object)
            for i in np.flatnonzero(done):
                final[i] = shown[i]
            infos = {**infos, "final_obs": final}
            n, first = self.num_envs, obs[:, -1]
            begun, said = self.on_board.update(self.on_board.init(n), first)
            past, again = self.sight.see(self.sight.begin(n), first, said)
            self.seen, self.past = choose(done, begun, self.seen), choose(done, past, self.past)
            self.said = choose(done, said._replace(signals=None), self.said._replace(signals=None))
            shown = np.where(done[:, None], again, shown).astype(np.float32)
        return shown, reward, terminated, truncated, infos


def lstm_tensors(state: Mapping[str, Any]) -> dict[str, Array]:
    """The actor's LSTM out of the state of an sb3-contrib `MlpLstmPolicy`."""
    w = {name: state[f"lstm_actor.{name}_l0"].cpu().numpy() for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")}
    return {"lstm.weight_ih": w["weight_ih"], "lstm.weight_hh": w["weight_hh"], "lstm.bias": w["bias_ih"] + w["bias_hh"]}


def algorithm(recurrent: bool) -> type[Any]:
    """PPO, or that of sb3-contrib with an LSTM."""
    if recurrent:
        from sb3_contrib import RecurrentPPO

        return RecurrentPPO
    return PPO


class ProbingTraining(Legs[ProbingRecipe]):
    """A policy that probes."""

    def begin(self) -> None:
        """Environments and a new policy."""
        r, process = self.recipe, self.recipe.conditions[0].process
        envs: Any = gym.make_vec(
            f"{self.plant.id}-Active-v{self.plant.version}", num_envs=r.envs, process=process, decision_period=r.period,
            cost_weight=0.0, autoreset_mode=AutoresetMode.SAME_STEP, truth=False, **self.plant.options,
        )  # fmt: skip
        self.on_board = make_diagnoser(r.on_board, self.plant, process=process)
        self.sight = Sight(self.plant, process, r.period)
        self.venvs = [FDIVecEnv(Probing(envs, self.on_board, self.sight, r.cost_weight))]
        shape: dict[str, Any] = {"net_arch": [r.hidden, r.hidden]}
        shape |= {"lstm_hidden_size": r.hidden} if r.recurrent else {}
        self.agent = algorithm(r.recurrent)(
            "MlpLstmPolicy" if r.recurrent else "MlpPolicy", self.venvs[0], learning_rate=r.rate, n_steps=r.steps,
            batch_size=r.batch, n_epochs=r.epochs, gamma=r.discount, gae_lambda=0.95 if r.discount else 0.0,
            ent_coef=r.entropy, seed=self.seed, device="cpu", policy_kwargs=shape,
        )  # fmt: skip
        self.agent.set_logger(Logger(folder=None, output_formats=[]))

    def state(self) -> dict[str, Array]:
        """Nothing else."""
        return {}

    def restore(self, tensors: Mapping[str, Array]) -> None:
        """As `begin` has left it."""
        self.begin()

    def validate(self) -> dict[str, float]:
        """Balanced accuracy per sample, the flight's cost per sample, and the reward that both come to."""
        r = self.recipe
        condition, seeds = r.conditions[0], range(VALIDATION, VALIDATION + r.validation)
        flights = [draw(self.plant.process(condition.process), seed) for seed in seeds]
        flown = fly(self.plant, flights, self.on_board, self.prober(), period=r.period)
        right = (flown.decisions.label == flown.record.label)[:, 1:].mean()
        cost = flown.cost[:, 1:].mean()
        accuracy = data.accuracy(self.plant, condition, flown.record, flown.decisions.label.astype(np.int64))
        return {condition.process: accuracy, "cost": float(cost), "reward": float(right - r.cost_weight * cost)}

    def prober(self) -> Prober:
        """The policy as it is now."""
        from baselines.probing.ppo import policy

        return policy(self.sight, {k: v.astype(float) for k, v in self.tensors().items()}, self.recipe.hidden)

    def tensors(self) -> dict[str, Array]:
        """The actor."""
        state = self.agent.policy.state_dict()
        return {**actor_tensors(state), **(lstm_tensors(state) if self.recipe.recurrent else {})}

    def card(self) -> dict[str, Any]:
        """The task, what it is made of, and what it took."""
        r, decisions = self.recipe, self.rounds * self.per_leg
        shape = {"period": r.period, "hidden": r.hidden, "recurrent": r.recurrent, "cost_weight": r.cost_weight,
                 "discount": r.discount}  # fmt: skip
        budget = {"decisions": decisions, "samples": decisions * r.period}
        return {"task": "probing", "shape": shape, "filters": [r.on_board], "budget": budget}
