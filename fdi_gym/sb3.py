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
from fdi_gym.rules import checked_seed, whole

# what each environment has for itself, by the name that the vector environment has it under
OWN = {"scenario": "scenarios", "np_random": "np_random", "np_random_seed": "np_random_seed"}


class FDIVecEnv(VecEnv):
    """An SB3 `VecEnv` over a vector environment of this package, wrapped or not; the same numbers as `DummyVecEnv`.

    An environment that ends begins anew in the same step; its `info` then holds `terminal_observation`,
    `TimeLimit.truncated` and the truth, as SB3 expects. The infos of the others are empty: the truth of all
    environments is in `truth`, as arrays, so that nothing is unpacked that nobody reads. `seed` and `set_options` act at
    the next reset.

    Args:
        envs: A vector environment with `autoreset_mode="SameStep"`; `truth=False` suits it.

    Raises:
        ValueError: Another autoreset mode.
    """

    def __init__(self, envs: VectorEnv):
        if envs.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise ValueError("SB3 begins an episode in the step that ends one: autoreset_mode='SameStep' is needed")
        self.envs = envs
        self._actions: Any = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    @property
    def truth(self) -> dict[str, Array]:
        """The truth to which the next actions will be compared: label, target, theta, time and what the plant monitors."""
        return self.envs.unwrapped.truth()  # type: ignore[attr-defined]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds of the next reset: the first environment's, the next ones follow.

        Raises:
            ValueError, TypeError: Not a whole number from 0 on.
        """
        return super().seed(checked_seed(seed))

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Options of the next reset, which all environments share: a dict, or one equal dict for each.

        Raises:
            ValueError, TypeError: Not that.
        """
        each = [options or {}] * self.num_envs if options is None or isinstance(options, dict) else options
        if not isinstance(each, list) or not all(isinstance(entry, dict) for entry in each):
            raise TypeError(f"the options of a reset are a dict, or a list of them, not {options!r}")
        if len(each) != self.num_envs or any(entry is not each[0] and entry != each[0] for entry in each):
            raise ValueError(f"the {self.num_envs} environments share the options of a reset; they were given {options!r}")
        if "reset_mask" in each[0]:
            raise ValueError("unknown option 'reset_mask' of venv.reset(), which is for all; see env_method('reset')")
        super().set_options(each)

    def reset(self) -> Array:
        """Begin an episode in every environment, with the seeds and options that were set before.

        Raises:
            ValueError, TypeError: Options that the environments do not have.
        """
        options = self._options[0]
        obs, _ = self.envs.reset(seed=list(self._seeds), options=options or None)  # type: ignore[arg-type]
        self.reset_infos = self._infos(range(self.num_envs))
        self._reset_seeds()
        self._reset_options()
        return obs

    def _infos(self, indices: Iterable[int]) -> list[dict[str, Any]]:
        truth = self.truth
        return [{name: value[i] for name, value in truth.items()} for i in indices]

    def step_async(self, actions: Array) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:  # type: ignore[override]
        """Step: observations, rewards (float32), dones, infos."""
        obs, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        dones = terminated | truncated
        unpacked: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones):
            unpacked[i] = {
                **{name: value[i] for name, value in infos["final_info"].items() if not name.startswith("_")},
                "terminal_observation": infos["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
            }
        return obs, rewards.astype(np.float32), dones, unpacked

    def close(self) -> None:
        """Close the vector environment."""
        self.envs.close()

    def get_images(self) -> Sequence[Array | None]:
        """One picture per environment (`render_mode="rgb_array"`)."""
        return list(self.envs.render() or [None] * self.num_envs)  # type: ignore[return-value]

    def _get_indices(self, indices: Any) -> list[int]:
        """The environments meant.

        Raises:
            ValueError, TypeError: There is none of that number.
        """
        if indices is None:
            return list(range(self.num_envs))
        found = [whole("the index of an environment", i, 0) for i in ([indices] if np.ndim(indices) == 0 else indices)]
        if any(i >= self.num_envs for i in found):
            raise ValueError(f"there are the environments 0 to {self.num_envs - 1}, not {found}")
        return found

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute as the single environments have it: their own where each has one, else what they share."""
        which = self._get_indices(indices)
        if attr_name in OWN:
            own = getattr(self.envs.unwrapped, OWN[attr_name])
            return [own[i] for i in which]
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
        if attr_name in OWN or len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"{attr_name!r} cannot be set for one environment, and what they share is set for all of them")
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the environments: `reset` and `render` of each that is meant, any other once for all of them.

        Raises:
            ValueError: A method that they share, for some of them only; `step`, which is for all at once.
        """
        which = self._get_indices(indices)
        if method_name == "reset":
            return self._reset_some(which, *method_args, **method_kwargs)
        if method_name == "render":
            pictures = self.envs.render(*method_args, **method_kwargs)
            return [None if pictures is None else pictures[i] for i in which]
        if method_name == "get_wrapper_attr":
            return self.get_attr(*method_args, indices=which, **method_kwargs)
        if method_name == "has_wrapper_attr":
            return [self.has_attr(*method_args, **method_kwargs)] * len(which)
        if method_name == "step" or len(set(which)) != self.num_envs:
            raise ValueError(
                f"the environments share {method_name!r}: reset and render are for one alone, step is venv.step"
            )
        return [self._shared(method_name)(*method_args, **method_kwargs)] * len(which)

    def _reset_some(self, which: list[int], seed: Any = None, options: Any = None) -> list[tuple[Array, dict[str, Any]]]:
        """What `reset(seed=..., options=...)` of each of these environments gives."""
        mask = np.zeros(self.num_envs, bool)
        mask[which] = True
        seed = checked_seed(seed)
        seeds = [seed if meant else None for meant in mask]
        if options is not None and not isinstance(options, dict):
            raise TypeError(f"the options of a reset are a dict, not {options!r}")
        if "reset_mask" in (options or {}):
            raise ValueError("unknown option 'reset_mask' of an environment's reset; indices say which are meant")
        if not which:
            return []
        obs, _ = self.envs.reset(seed=seeds, options={**(options or {}), "reset_mask": mask})  # type: ignore[arg-type]
        return [(obs[i], info) for i, info in zip(which, self._infos(which), strict=True)]

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
        arguments: Of the environment (`units`, `decision_period`, `process`, ...). `truth` is False where it is not given:
            the bridge asks for it when it is wanted.

    Raises:
        ValueError, TypeError: As the environment.
    """
    arguments = {"truth": False, **arguments, "autoreset_mode": AutoresetMode.SAME_STEP}
    venv = FDIVecEnv(gym.make_vec(env_id, num_envs=num_envs, **arguments))
    if seed is not None:
        venv.seed(seed)
    return venv
