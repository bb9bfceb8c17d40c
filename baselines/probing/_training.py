"""Train a probing policy with PPO (stable-baselines3) in the active environment, a diagnoser on board.

    python -m baselines.probing._training B747Lateral quiet bayes_bank --discount 0.97 --decisions 150000

The environment's action is the label that the diagnoser gives and the probe that the policy chooses. A probe costs now and
tells later: with a discount of 0 the policy learns never to probe, and the belief that a probe leaves behind is worth
something only to one that looks ahead.
"""

from __future__ import annotations

import argparse
import time
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
from baselines.learned._reinforcement import actor_tensors
from baselines.probing.ppo import features, weights_of
from fdi_gym.diagnosis import Diagnoser, make_diagnoser
from fdi_gym.diagnosis.contract import choose
from fdi_gym.plant import Array
from fdi_gym.sb3 import FDIVecEnv

TRAINING = 3_500_000  # first seed


class Believing(VectorWrapper):
    """Active environments as a policy sees them whose diagnoser is on board: its features in, a probe out.

    Args:
        env: Active environments that probe, in physical units, `decision_period` above 1 and `autoreset_mode="SameStep"`.
        on_board: The diagnoser.
    """

    def __init__(self, env: VectorEnv, on_board: Diagnoser):
        super().__init__(env)
        self.plant, self.on_board = env.unwrapped.plant, on_board  # type: ignore[attr-defined]
        probes = len(self.plant.acting.probes)
        width = len(self.plant.labels) + probes + len(self.plant.observed)
        self.single_observation_space, self.single_action_space = (
            Box(-np.inf, np.inf, (width,), np.float32),
            Discrete(probes),
        )
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.action_space = batch_space(self.single_action_space, env.num_envs)

    def _see(self, block: Array) -> Array:
        for k in range(block.shape[1]):
            self.seen, self.said = self.on_board.update(self.seen, block[:, k])
        return features(self.plant, block[:, -1], self.said, self.last).astype(np.float32)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin new flights in all environments."""
        obs, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self.last, self.seen = np.zeros(self.num_envs, np.int64), self.on_board.init(self.num_envs)
        return self._see(obs[:, -1:]), infos

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Fly on with these probes and what the diagnoser says; flights that end begin anew."""
        self.last = np.asarray(actions, np.int64)
        label = np.clip(self.said.label, 0, len(self.plant.labels) - 1)
        obs, reward, terminated, truncated, infos = self.env.step(np.stack([label, self.last], axis=1))
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
            begun, said = self.on_board.update(self.on_board.init(self.num_envs), obs[:, -1])
            self.seen = choose(done, begun, self.seen)
            self.said = choose(done, said._replace(signals=None), self.said._replace(signals=None))
            self.last = np.where(done, 0, self.last)
            shown = np.where(done[:, None], features(self.plant, obs[:, -1], self.said, self.last), shown).astype(np.float32)
        return shown, reward, terminated, truncated, infos


def environments(plant_id: str, process: str, diagnoser: str, n: int, period: int, cost_weight: float) -> FDIVecEnv:
    """Environments of a plant's process with a diagnoser on board, for stable-baselines3."""
    envs: Any = gym.make_vec(
        f"{plant_id}-Active-v0", num_envs=n, process=process, decision_period=period, cost_weight=cost_weight,
        autoreset_mode=AutoresetMode.SAME_STEP, truth=False,
    )  # fmt: skip
    venv = FDIVecEnv(Believing(envs, make_diagnoser(diagnoser, envs.unwrapped.plant, process=process)))
    venv.seed(TRAINING)
    return venv


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


def main() -> None:
    """Train and store."""
    from safetensors.numpy import save_file

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("plant", "process", "diagnoser"):
        parser.add_argument(name)
    parser.add_argument("--period", type=int, default=10)
    parser.add_argument("--decisions", type=int, default=150_000)
    parser.add_argument("--discount", type=float, default=0.97)
    parser.add_argument("--cost-weight", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variant", default="")
    parser.add_argument("--recurrent", action="store_true", help="with an LSTM (sb3-contrib)")
    a = parser.parse_args()
    env = environments(a.plant, a.process, a.diagnoser, 32, a.period, a.cost_weight)
    shape: dict[str, Any] = {"net_arch": [64, 64], **({"lstm_hidden_size": 64} if a.recurrent else {})}
    agent = algorithm(a.recurrent)(
        "MlpLstmPolicy" if a.recurrent else "MlpPolicy", env, learning_rate=1e-3, n_steps=64, batch_size=512, n_epochs=6,
        gamma=a.discount, gae_lambda=0.9, ent_coef=0.005, seed=a.seed, device="cpu", policy_kwargs=shape,
    )  # fmt: skip
    agent.set_logger(Logger(folder=None, output_formats=[]))
    begun, done = time.monotonic(), 0
    while done < a.decisions:
        agent.learn(32 * 64 * 4, reset_num_timesteps=False)
        done = agent.num_timesteps
        probed = (np.asarray(agent.rollout_buffer.actions) > 0).mean()
        reward = agent.rollout_buffer.rewards.mean()
        print(f"{done} decisions, reward {reward:.3f}, probed {probed:.2f}, {time.monotonic() - begun:.0f} s", flush=True)
    path = weights_of(a.plant, a.process, "recurrent" if a.recurrent else a.variant)
    path.parent.mkdir(parents=True, exist_ok=True)
    state = agent.policy.state_dict()
    save_file({**actor_tensors(state), **(lstm_tensors(state) if a.recurrent else {})}, path)
    print(path)


if __name__ == "__main__":
    main()
