"""Wrappers for vector environments that learners want and Gymnasium lacks: past samples, a reward for haste.

All work in every autoreset mode and without a Python loop over environments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from fdi_gym.plant import Array
from fdi_gym.rules import whole


class VectorHistory(VectorWrapper):
    """Shows the last `length` observations, each `stride` steps before the next, oldest first: (N, length, *shape).

    The first observation of an episode stands in for those before it, and a window never reaches into another episode:
    `final_obs` holds the last window of the episode that ended.

    Args:
        env: A vector environment with a `Box` observation.
        length: Observations in a window.
        stride: Steps between them.

    Raises:
        ValueError: length or stride below 1, or another observation space.
        TypeError: length or stride is no whole number.
    """

    def __init__(self, env: VectorEnv, length: int, stride: int = 1):
        super().__init__(env)
        space = env.single_observation_space
        if not isinstance(space, Box):
            raise ValueError(f"a window of Box observations is made, not of {space}")
        length, stride = whole("length", length, 1), whole("stride", stride, 1)
        low, high = (np.repeat(bound[None], length, axis=0) for bound in (space.low, space.high))
        self.single_observation_space = Box(low, high, dtype=space.dtype)  # type: ignore[arg-type]
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        depth = (length - 1) * stride + 1
        self._ring = np.zeros((env.num_envs, depth, *space.shape), space.dtype)
        self._ago = np.arange(length - 1, -1, -1) * stride
        self._at = 0
        self._over = np.zeros(env.num_envs, bool)
        self._mode = env.metadata["autoreset_mode"]

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin new episodes, in all environments or in those of `options["reset_mask"]`."""
        obs, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        mask = (options or {}).get("reset_mask")
        begun = np.ones(self.num_envs, bool) if mask is None else mask
        self._ring[begun] = obs[begun, None]
        self._over &= ~begun
        return self._window(), infos

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Step every environment."""
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        ended = terminated | truncated
        self._at = (self._at + 1) % self._ring.shape[1]
        self._ring[:, self._at] = obs
        begun = self._over
        if self._mode is AutoresetMode.SAME_STEP:
            begun = ended
            if ended.any():
                last = np.flatnonzero(ended)
                self._ring[last, self._at] = np.stack(list(infos["final_obs"][last]))
                final = np.empty(self.num_envs, dtype=object)
                final[last] = list(self._window()[last])
                infos = {**infos, "final_obs": final}
        self._ring[begun] = obs[begun, None]
        self._over = ended
        return self._window(), rewards, terminated, truncated, infos

    def _window(self) -> Array:
        return self._ring[:, (self._at - self._ago) % self._ring.shape[1]]


class DelayAwareReward(VectorWrapper):
    """Isolation reward under which every sample of delay costs, and more the longer it lasts.

    A right label is worth 1. A wrong one is worth -min(1, d / patience), d the steps since the true label last changed,
    until the label has been right once; after that -1. Both are multiplied by the weight of the true label: weights
    that are inverse to the labels' shares make it the reward of balanced accuracy. The action after an episode's first
    sample is worth 0, as in the environment.

    Args:
        env: A vector environment of this package with the isolation task.
        patience: Steps after which a wrong label costs as much as a right one earns.
        weights: One per label. Default: 1 each.

    Raises:
        ValueError: Not the isolation task, or not one weight per label.
    """

    def __init__(self, env: VectorEnv, patience: float = 20.0, weights: Sequence[float] | None = None):
        super().__init__(env)
        labels = getattr(env.single_action_space, "n", None)
        if labels is None:
            raise ValueError("the delay-aware reward judges labels: the task is isolation")
        self._weights = np.ones(labels) if weights is None else np.asarray(weights, float)
        if self._weights.shape != (labels,) or not np.isfinite(self._weights).all():
            raise ValueError(f"one weight per label is needed: {labels} numbers, not {weights!r}")
        if not (patience > 0 and np.isfinite(patience)):
            raise ValueError(f"patience is a number of steps above 0, not {patience!r}")
        self._patience = patience
        self._label = np.zeros(env.num_envs, np.int64)
        self._since = np.zeros(env.num_envs)  # steps since the label changed
        self._found = np.zeros(env.num_envs, bool)
        self._first, self._over = np.ones(env.num_envs, bool), np.zeros(env.num_envs, bool)
        self._mode = env.metadata["autoreset_mode"]

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin new episodes, in all environments or in those of `options["reset_mask"]`."""
        obs, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        mask = (options or {}).get("reset_mask")
        begun = np.ones(self.num_envs, bool) if mask is None else mask
        self._over &= ~begun
        self._follow(np.where(begun, self._now(), self._label), begun)
        return obs, infos

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Step every environment and judge its action."""
        obs, _, terminated, truncated, infos = self.env.step(actions)  # refuses what is no label, before anything changes
        right = np.asarray(actions) == self._label
        late = np.where(self._found, 1.0, np.minimum(1.0, self._since / self._patience))
        rewards = np.where(self._first | self._over, 0.0, self._weights[self._label] * np.where(right, 1.0, -late))
        self._found |= right
        ended = terminated | truncated
        begun = ended if self._mode is AutoresetMode.SAME_STEP else self._over
        self._over = ended & (self._mode is not AutoresetMode.SAME_STEP)
        self._follow(self._now(), begun)
        return obs, rewards, terminated, truncated, infos

    def _now(self) -> Array:
        return self.env.unwrapped.truth("label")["label"]  # type: ignore[attr-defined]

    def _follow(self, label: Array, begun: Array) -> None:
        changed = begun | (label != self._label)
        self._since = np.where(changed, 1.0, self._since + 1.0)
        self._found = self._found & ~changed
        self._first, self._label = begun.copy(), label.copy()
