"""A vector environment whose observation is what a network sees: the features of the identified model of the plant."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from baselines.learned import streams
from baselines.learned.features import FeatureModel, FeatureShape
from baselines.learned.streams import Stream
from fdi_gym.plant import Array, Plant


class IdentifiedFeatures(VectorWrapper):
    """Shows the features (N, n_features), float32, of the last step of `shape.period` samples that is complete.

    They are those of `streams.add`, fed with the samples of each episode alone. After j decisions the newest
    sample is j * period, so the last complete step ended one sample before; at an episode's beginning, before the first,
    the features are 0, their mean. All environments are at the same place of their steps, also where an episode begins
    anew while others go on.

    Args:
        env: A vector environment of this package with `decision_period=shape.period` and `autoreset_mode="SameStep"`,
            in physical units (exactly the numbers of `add`) or scaled ones (the same to the rounding of float32).
        plant: Its plant.
        shape: Of the model.
        model: What was identified.

    Raises:
        ValueError: Observations are not blocks of `shape.period` samples, or another autoreset mode.
    """

    def __init__(self, env: VectorEnv, plant: Plant, shape: FeatureShape, model: FeatureModel):
        super().__init__(env)
        space = env.single_observation_space
        if shape.period < 2 or space.shape != (shape.period, len(plant.observed)):
            raise ValueError(
                f"the model's steps ask for decision_period={shape.period}, at least 2; observations are {space}"
            )
        if env.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise ValueError("features are followed through autoreset_mode='SameStep' only")
        self.single_observation_space = Box(-np.inf, np.inf, model.mean.shape, np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._plant, self._shape, self._model = plant, shape, model
        scaled = space.dtype == np.float32
        self._scale = np.array([s.scale if scaled else 1.0 for s in plant.observed])
        self._offset = np.array([s.nominal if scaled else 0.0 for s in plant.observed])
        self._fresh = streams.begin(plant, shape, env.num_envs)
        self._stream, self._shown = self._fresh, np.zeros((env.num_envs, *model.mean.shape), np.float32)
        self._k = np.zeros(env.num_envs, np.int64)  # newest sample of each episode

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin new episodes in all environments.

        Raises:
            ValueError: A `reset_mask` that leaves some out: those would be at another place of their steps.
        """
        mask = (options or {}).get("reset_mask")
        if mask is not None and not mask.all():
            raise ValueError("all environments begin anew together; no reset_mask")
        block, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self._begin(np.ones(self.num_envs, bool), block)
        return self._shown.copy(), infos

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Step every environment."""
        block, rewards, terminated, truncated, infos = self.env.step(actions)
        ended = terminated | truncated
        which, m, last = np.flatnonzero(ended), self._shape.period, block
        flown = np.full(self.num_envs, m)  # samples since the last decision
        if which.size:
            last = block.copy()
            last[which] = np.stack(list(infos["final_obs"][which]))
            flown[which] = np.rint(infos["final_info"]["time"][which] / self._plant.dt).astype(int) - self._k[which]
            early = which[flown[which] == m - 1]  # the step is complete: its samples are at the end of the block
            last[early, :-1] = last[early, 1:]
        self._k += m
        shown = self._add(last)
        shown[flown < m - 1] = self._shown[flown < m - 1]
        self._shown = shown
        if which.size:
            final = np.empty(self.num_envs, dtype=object)
            final[which] = list(shown[which])
            infos = {**infos, "final_obs": final}
            self._begin(ended, block)
        return self._shown.copy(), rewards, terminated, truncated, infos

    def _physical(self, obs: Array) -> Array:
        return obs * self._scale + self._offset

    def _add(self, block: Array) -> Array:
        """Feed the newest period of samples (N, m, n_obs) after the first; the features of the step that it completes."""
        shown, model = None, (self._plant, self._shape, self._model)
        for k in range(1, self._shape.period + 1):
            self._stream, seen = streams.add(*model, self._stream, self._physical(block[:, k - 1]), k)
            shown = seen if seen is not None else shown
        assert shown is not None
        return shown.astype(np.float32)

    def _begin(self, begun: Array, block: Array) -> None:
        """Set the episodes that begin back to their first sample, which is all of their block."""
        obs = self._physical(block[:, -1])
        first, _ = streams.add(self._plant, self._shape, self._model, self._fresh, obs, 0)
        mixed = (np.where(begun.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(first, self._stream, strict=True))
        self._stream = Stream(*mixed)
        self._shown = np.where(begun[:, None], np.float32(0), self._shown)
        self._k[begun] = 0
