"""Bridge to stable-baselines3: the native vector environment as an SB3 `VecEnv`, without a loop over environments.

    venv = make_vec_env("B747Lateral-Faults-v0", 256, units="scaled", decision_period=10)
    model = PPO("MlpPolicy", VecMonitor(venv))

Needs `pip install fdi-gym[learn]`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv

from fdi_gym.plant import Array


class FDIVecEnv(VecEnv):
    """An SB3 `VecEnv` over a vector environment of this package, wrapped or not; the same numbers as `DummyVecEnv`.

    An environment that ends begins anew in the same step; its `info` then holds `terminal_observation`,
    `TimeLimit.truncated` and the truth, as SB3 expects. The infos of the others are empty: the truth of all
    environments is in `truth`, as arrays, so that nothing is unpacked that nobody reads. `seed` and `set_options` act at
    the next reset.

    Args:
        envs: A vector environment with `autoreset_mode="SameStep"`.

    Raises:
        ValueError: Another autoreset mode.
    """

    def __init__(self, envs: VectorEnv):
        if envs.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise ValueError("SB3 begins an episode in the step that ends one: autoreset_mode='SameStep' is needed")
        self.envs = envs
        self.truth: dict[str, Array] = {}
        self._actions: Any = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Array:
        """Begin an episode in every environment, with the seeds and options that were set before."""
        options = self._options[0]
        if any(other != options for other in self._options):
            raise ValueError("the environments share the options of a reset; they were given different ones")
        obs, infos = self.envs.reset(seed=list(self._seeds), options=options or None)  # type: ignore[arg-type]
        self.truth = self._read(infos)
        self.reset_infos = [{name: value[i] for name, value in self.truth.items()} for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return obs

    def step_async(self, actions: Array) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:  # type: ignore[override]
        """Step: observations, rewards (float32), dones, infos."""
        obs, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        self.truth = self._read(infos)
        dones = terminated | truncated
        unpacked: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones):
            unpacked[i] = {
                **{name: value[i] for name, value in self._read(infos["final_info"]).items()},
                "terminal_observation": infos["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
            }
        return obs, rewards.astype(np.float32), dones, unpacked

    def _read(self, infos: dict[str, Any]) -> dict[str, Array]:
        return {name: infos[name] for name in ("label", "target", "theta", "time")}

    def close(self) -> None:
        """Close the vector environment."""
        self.envs.close()

    def get_images(self) -> Sequence[Array | None]:
        """One picture per environment (`render_mode="rgb_array"`)."""
        return list(self.envs.render() or [None] * self.num_envs)  # type: ignore[return-value]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute as the single environments have it: their own scenario, else what they share."""
        which = list(self._get_indices(indices))
        if attr_name == "scenario":
            return [self.envs.unwrapped.scenarios[i] for i in which]  # type: ignore[attr-defined]
        if attr_name in ("observation_space", "action_space"):
            return [getattr(self, attr_name)] * len(which)
        return [self._shared(attr_name)] * len(which)

    def _shared(self, name: str) -> Any:
        env: Any = self.envs
        while name not in vars(env) and hasattr(env, "env"):
            env = env.env
        return getattr(env, name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all environments; they share it, so one alone cannot have it."""
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"the environments share {attr_name!r}: set it for all of them")
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method once for all environments; what it returns per environment is handed out, the rest is shared."""
        which: Iterable[int] = list(self._get_indices(indices))
        if method_name in ("get_wrapper_attr", "has_wrapper_attr"):
            found = self.has_attr(*method_args) if method_name[0] == "h" else self.get_attr(*method_args)
            return [found if isinstance(found, bool) else found[i] for i in which]
        answer = self._shared(method_name)(*method_args, **method_kwargs)
        split = isinstance(answer, (tuple, list, np.ndarray)) and len(answer) == self.num_envs
        return [answer[i] if split else answer for i in which]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Whether the vector environment is wrapped with this class."""
        env, found = self.envs, False
        while env is not None and not found:
            found = isinstance(env, wrapper_class)
            env = getattr(env, "env", None)
        return [found for _ in self._get_indices(indices)]


def make_vec_env(env_id: str, num_envs: int, seed: int | None = None, **arguments: Any) -> FDIVecEnv:
    """`num_envs` environments of an id as an SB3 `VecEnv`.

    Args:
        env_id: Gymnasium id.
        num_envs: How many.
        seed: Of the first environment at the first reset; the next ones follow.
        arguments: Of the environment (`units`, `decision_period`, `process`, ...).
    """
    venv = FDIVecEnv(gym.make_vec(env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **arguments))
    if seed is not None:
        venv.seed(seed)
    return venv
