"""The two Gymnasium environments: one flight, and many side by side. Thin shells over recorded flights."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete, Space
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plant import Array, Plant, Signal, load_plant
from fdi_gym.engine import Record, simulate

TASKS = ("isolation", "identification")
UNITS = ("physical", "scaled")


def _column(signals: tuple[Signal, ...], field: str) -> Array:
    return np.array([getattr(s, field) for s in signals], float)


class _Game:
    """The rules that both environments share: what is flown, what is shown and what a diagnosis is worth."""

    def __init__(
        self, plant: str | Plant, task: str, scenario: str | FaultScenario, mismatch: float | None,
        decision_period: int, units: str, options: dict[str, Any],
    ):  # fmt: skip
        if units not in UNITS:
            raise ValueError(f"unknown units {units!r}; there are {', '.join(UNITS)}")
        if task not in TASKS:
            raise ValueError(f"unknown task {task!r}; there are {', '.join(TASKS)}")
        if not isinstance(decision_period, int) or decision_period < 1:
            raise ValueError(f"decision_period is a whole number of samples, at least 1, not {decision_period!r}")
        self.plant = load_plant(plant, **options) if isinstance(plant, str) else plant
        self.task, self.period = task, decision_period
        if isinstance(scenario, str) and scenario.lstrip().startswith("{"):
            scenario = FaultScenario.from_json(scenario)
        if isinstance(scenario, str):
            self.plant.process(scenario)
        self.scenario = scenario
        self.perturb = None
        if mismatch is not None:
            perturb = self.plant.perturb
            if perturb is None:
                raise ValueError(f"{self.plant.id} declares no mismatch")
            self.perturb = lambda rng: perturb(rng, mismatch)
        seen, asked = self.plant.observed, self.plant.estimated
        low, high = _column(seen, "low"), _column(seen, "high")
        self.low, self.high = _column(asked, "low"), _column(asked, "high")
        self.scaled = units == "scaled"
        self._nominal, self._scale = _column(seen, "nominal"), _column(seen, "scale")
        dtype = np.float32 if self.scaled else np.float64
        if self.scaled:  # a rounding step wider, so that the cast to float32 cannot leave the space
            low = np.nextafter(np.float32((low - self._nominal) / self._scale), np.float32(-np.inf))
            high = np.nextafter(np.float32((high - self._nominal) / self._scale), np.float32(np.inf))
        if decision_period > 1:
            low, high = np.tile(low, (decision_period, 1)), np.tile(high, (decision_period, 1))
        self.observation_space = Box(low, high, dtype=dtype)
        if task == "isolation":
            self.action_space: Space = Discrete(len(self.plant.labels))
        elif self.scaled:
            self.action_space = Box(-1.0, 1.0, (len(asked),), dtype=np.float32)
        else:
            self.action_space = Box(self.low, self.high, dtype=np.float64)

    def show(self, obs: Array) -> Array:
        """An observation in the units that were asked for; always a new array."""
        return ((obs - self._nominal) / self._scale).astype(np.float32) if self.scaled else obs.copy()

    def draw(self, seed: int) -> FaultScenario:
        """The scenario of an episode: replayed as it is where one was given, else drawn from the seed."""
        if isinstance(self.scenario, FaultScenario):
            return self.scenario
        return draw(self.plant.process(self.scenario), seed, self.perturb)

    def check_label(self, action: Any) -> int:
        """A single label, checked as `check` does, quickly."""
        if isinstance(action, (int, np.integer)) and 0 <= action < len(self.plant.labels):
            return int(action)
        return int(self.check(action, ()))

    def check(self, action: Any, shape: tuple[int, ...]) -> Array:
        """The action as an array.

        Raises:
            ValueError: Wrong shape, NaN, or not a label; the message says what is allowed.
        """
        value = np.asarray(action)
        if self.task == "isolation":
            n = len(self.plant.labels)
            if value.shape != shape or value.dtype.kind not in "iu" or (value < 0).any() or (value >= n).any():
                raise ValueError(f"the action is a label in 0..{n - 1}, shape {shape} and integer, not {action!r}")
            return value
        space = self.action_space
        assert isinstance(space, Box)
        if value.shape != (*shape, *space.shape) or value.dtype.kind not in "iuf" or not np.isfinite(value).all():
            raise ValueError(f"the action is finite and has the shape {(*shape, *space.shape)}, not {action!r}")
        if self.scaled:
            value = self.low + (self.high - self.low) * (value.astype(np.float64) + 1) / 2
        return np.clip(value, self.low, self.high)

    def reward(self, action: Array, label: Any, target: Array) -> Any:
        """What a checked action is worth where the truth is label (...) and target (..., n)."""
        if self.task == "isolation":
            return self.plant.isolation_reward[label, action]  # type: ignore[index]
        return self.plant.identification_reward(action - target)  # type: ignore[misc]


class FDIEnv(gym.Env):
    """Fault diagnosis as an environment: the observation is what the sensors say, the action is the diagnosis.

    Observation space: `Box` of float64 in physical units, `[y_k, u_{k-1}, known_k]`: the sensors at sample k, the
    command held over the interval that has just ended (the trim command at k = 0), and what else the flight computer
    knows. The bounds are the sensors' and commands' ranges. With `decision_period` m > 1 it is the block of the last m
    samples, shape (m, n), oldest first; sample 0 stands in for those before it.

    Action space: for `task="isolation"` `Discrete(number of labels)`, the label of the fault that acted over
    [k - 1, k); for `task="identification"` a `Box` over the estimated quantity in physical units (finite values outside
    it are clipped).

    Names, units, bounds and labels of a plant are in the docstring of its file, in `fdi-gym list PLANT`, and in
    `env.unwrapped.plant`.

    Reward: as the plant declares. The action after sample 0 is worth 0, since no interval has ended. With m > 1 an
    action is judged at the newest sample of its block.

    Episode: the plant flies whatever is diagnosed. It is `truncated` at the scenario's last sample and `terminated`
    where the plant leaves its declared envelope.

    Info: the truth to which the next action will be compared: `label` (int), `target` and `theta` (arrays), `time` [s];
    and what the plant's `monitor` says of the state (floats). For training only; the evaluation never passes it on.

    Args:
        plant: Plant id (set by the registration).
        task: "isolation" or "identification".
        scenario: Name of one of the plant's fault processes, or a `FaultScenario` (also as JSON text), which is
            replayed exactly, noise included.
        mismatch: Level of the difference between the truth's physical parameters and the diagnosers' model, in the
            plant's own measure. Default: what the process prescribes.
        decision_period: Samples per agent step.
        units: "physical", or "scaled" for learners: float32 observations (value - nominal) / scale of the data sheet,
            and identification actions in [-1, 1] that stand for the bounds of the estimated quantity.
        render_mode: "rgb_array" or "human": signals, truth and diagnosis up to now.
        options: The plant's own options.

    Raises:
        ValueError: Unknown task, scenario, option or option value; the message lists what exists.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}

    def __init__(
        self,
        plant: str | Plant,
        task: str = "isolation",
        scenario: str | FaultScenario = "standard",
        mismatch: float | None = None,
        decision_period: int = 1,
        units: str = "physical",
        render_mode: str | None = None,
        **options: Any,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render_mode {render_mode!r}; there are {self.metadata['render_modes']}")
        self._game = _Game(plant, task, scenario, mismatch, decision_period, units, options)
        self.plant = self._game.plant
        self.observation_space, self.action_space = self._game.observation_space, self._game.action_space
        self.render_mode = render_mode
        self.scenario: FaultScenario | None = None
        self._k, self._length, self._over = 0, 0, True
        self._rewards: list[list[float]] = np.asarray(self.plant.isolation_reward, float).tolist()
        self._declared: list[tuple[int, Any]] = []
        self._canvas: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode. `options={"scenario": FaultScenario}` replays one, noise included."""
        super().reset(seed=seed)
        replay = (options or {}).get("scenario")
        if replay is not None and not isinstance(replay, FaultScenario):
            raise ValueError(f"options['scenario'] is a FaultScenario, not {type(replay).__name__}")
        episode_seed = int(self.np_random.integers(2**63)) if seed is None else seed
        self.scenario = replay or self._game.draw(episode_seed)
        record = simulate(self.plant, [self.scenario])
        self._obs, self._target, self._theta = record.obs[0], record.target[0], record.theta[0]
        self._label: list[int] = record.label[0].tolist()
        self._monitored = {name: a.tolist() for name, a in self.plant.monitor(record.state[0]).items()}
        self._length, self._terminated = int(record.length[0]), bool(record.terminated[0])
        self._record = record
        self._k, self._over, self._declared = 0, False, []
        if self.render_mode == "human":
            self.render()
        return self._block(0), self._info(0)

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Judge the diagnosis of the interval that ended at the current sample, and fly on to the next observation."""
        if self._over:
            raise RuntimeError("the episode is over, or has not begun: call reset()")
        k = self._k
        if self._game.task == "isolation":
            checked: Any = self._game.check_label(action)
            reward = self._rewards[self._label[k]][checked] if k else 0.0
        else:
            checked = self._game.check(action, ())
            reward = float(self._game.reward(checked, self._label[k], self._target[k])) if k else 0.0
        if self.render_mode is not None:
            self._declared.append((k, checked))
        self._k = k = min(k + self._game.period, self._length)
        self._over = k == self._length
        if self.render_mode == "human":
            self.render()
        terminated = self._over and self._terminated
        return self._block(k), reward, terminated, self._over and not terminated, self._info(k)

    def _block(self, k: int) -> Array:
        m = self._game.period
        if m == 1:
            return self._game.show(self._obs[k])
        return self._game.show(self._obs[np.maximum(np.arange(k - m + 1, k + 1), 0)])

    def _info(self, k: int) -> dict[str, Any]:
        return {
            "label": self._label[k],
            "target": self._target[k].copy(),
            "theta": self._theta[k].copy(),
            "time": k * self.plant.dt,
            **{name: values[k] for name, values in self._monitored.items()},
        }

    def render(self) -> Array | None:
        """The episode so far: an (H, W, 3) uint8 picture for "rgb_array", a window for "human"."""
        if self.render_mode is None:
            return None
        from fdi_gym.plots import Canvas

        if self._canvas is None:
            self._canvas = Canvas(self.plant, self._game.task, window=self.render_mode == "human")
        return self._canvas.draw(self._record, self._k, self._declared)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None


class FDIVectorEnv(VectorEnv):
    """N environments side by side; equal to N `FDIEnv`, sample by sample, with episodes that end at different times.

    `gym.make_vec("B747Lateral-Faults-v0", num_envs=N, ...)`. Spaces, rewards and info are those of `FDIEnv`, batched.
    The episodes being flown are held in memory: N x samples x (observation and truth) x 8 bytes.

    Args:
        num_envs: N.
        autoreset_mode: A Gymnasium `AutoresetMode` or its name: "NextStep", "SameStep" or "Disabled".
        plant, task, scenario, mismatch, decision_period, units, options: As in `FDIEnv`.
        render_mode: "rgb_array": `render` returns one picture per environment.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        plant: str | Plant,
        num_envs: int = 1,
        task: str = "isolation",
        scenario: str | FaultScenario = "standard",
        mismatch: float | None = None,
        decision_period: int = 1,
        units: str = "physical",
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **options: Any,
    ):
        if not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs is a whole number, at least 1, not {num_envs!r}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render_mode {render_mode!r}; there are {self.metadata['render_modes']}")
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            allowed = [mode.value for mode in AutoresetMode]
            raise ValueError(f"unknown autoreset_mode {autoreset_mode!r}; there are {allowed}") from None
        self._game = _Game(plant, task, scenario, mismatch, decision_period, units, options)
        self.plant, self.num_envs, self.render_mode = self._game.plant, num_envs, render_mode
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        self.single_observation_space = self._game.observation_space
        self.single_action_space = self._game.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.scenarios: list[FaultScenario | None] = [None] * num_envs
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._record: Record | None = None
        self._k = np.zeros(num_envs, dtype=np.int64)
        self._over = np.ones(num_envs, dtype=bool)
        self._slots = np.arange(num_envs)
        self._declared: list[list[tuple[int, Array]]] = [[] for _ in range(num_envs)]
        self._canvas: Any = None

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin new episodes, in all environments or in those of `options["reset_mask"]` (a bool array)."""
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + i for i in range(self.num_envs)]
        seeds: list[int | None] = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"one seed per environment is needed: {self.num_envs}, not {len(seeds)}")
        mask = (options or {}).get("reset_mask")
        if mask is None:
            mask = np.ones(self.num_envs, dtype=bool)
        elif not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(f"reset_mask is a bool array of shape ({self.num_envs},) with at least one True, not {mask!r}")
        elif self._record is None and not mask.all():
            raise ValueError("the first reset begins an episode in every environment: no reset_mask yet")
        for i in np.flatnonzero(mask):
            if seeds[i] is not None or self._rngs[i] is None:
                self._rngs[i], _ = seeding.np_random(seeds[i])
        self._begin(np.flatnonzero(mask), seeds)
        return self._blocks(), self._infos(mask)

    def _begin(self, slots: Array, seeds: list[int | None]) -> None:
        """Fly new episodes in these slots."""
        for i in slots:
            rng, seed = self._rngs[i], seeds[i]
            assert rng is not None
            self.scenarios[i] = self._game.draw(int(rng.integers(2**63)) if seed is None else seed)
            self._declared[i] = []
        record = simulate(self.plant, [s for i in slots if (s := self.scenarios[i]) is not None])
        if self._record is None or record.obs.shape[1] > self._record.obs.shape[1]:
            steps = record.obs.shape[1]
            if self._record is None:
                self._record = Record(*(np.zeros((self.num_envs, *a.shape[1:]), a.dtype) for a in record))
            else:
                self._record = Record(*(
                    a if a.ndim == 1 else np.concatenate([a, np.repeat(a[:, -1:], steps - a.shape[1], axis=1)], axis=1)
                    for a in self._record
                ))  # fmt: skip
        for old, new in zip(self._record, record, strict=True):
            if new.ndim == 1:
                old[slots] = new
            else:
                old[slots, : new.shape[1]] = new
        self._k[slots], self._over[slots] = 0, False

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Step every environment; those that ended are treated as the autoreset mode says."""
        record = self._record
        if record is None:
            raise RuntimeError("no episode has begun: call reset()")
        checked = self._game.check(actions, (self.num_envs,))
        begin = np.flatnonzero(self._over)
        if begin.size and self._mode is AutoresetMode.DISABLED:
            raise RuntimeError(f"episodes {begin.tolist()} are over: reset them with options={{'reset_mask': ...}}")
        k = self._k
        reward = np.asarray(self._game.reward(checked, record.label[self._slots, k], record.target[self._slots, k]), float)
        reward = np.where((k == 0) | self._over, 0.0, reward)
        if self.render_mode is not None:
            for i in np.flatnonzero(~self._over):
                self._declared[i].append((int(k[i]), checked[i]))
        self._k = np.where(self._over, k, np.minimum(k + self._game.period, record.length))
        ended = (self._k == record.length) & ~self._over
        terminated = ended & record.terminated
        truncated = ended & ~terminated
        infos: dict[str, Any] = {}
        if self._mode is AutoresetMode.SAME_STEP:
            begin = np.flatnonzero(ended)
            for i in begin.tolist():
                infos = self._add_info(infos, {"final_obs": self._block(i), "final_info": self._info(i)}, i)
        self._over = ended
        if begin.size:
            self._begin(begin, [None] * self.num_envs)
        return (
            self._blocks(),
            reward,
            terminated,
            truncated,
            {**infos, **self._infos(np.ones(self.num_envs, dtype=bool))},
        )

    def _blocks(self) -> Array:
        assert self._record is not None
        m = self._game.period
        if m == 1:
            return self._game.show(self._record.obs[self._slots, self._k])
        rows = np.maximum(self._k[:, None] + np.arange(1 - m, 1), 0)
        return self._game.show(self._record.obs[self._slots[:, None], rows])

    def _block(self, i: int) -> Array:
        assert self._record is not None
        m = self._game.period
        rows = np.maximum(np.arange(self._k[i] - m + 1, self._k[i] + 1), 0)
        return self._game.show(self._record.obs[i, rows[0]] if m == 1 else self._record.obs[i, rows])

    def _info(self, i: int) -> dict[str, Any]:
        assert self._record is not None
        k = self._k[i]
        return {
            "label": int(self._record.label[i, k]),
            "target": self._record.target[i, k].copy(),
            "theta": self._record.theta[i, k].copy(),
            "time": float(k * self.plant.dt),
            **{name: float(value) for name, value in self.plant.monitor(self._record.state[i, k]).items()},
        }

    def _infos(self, mask: Array) -> dict[str, Any]:
        """The infos of the masked environments, in Gymnasium's vector form."""
        assert self._record is not None
        found = {name: getattr(self._record, name)[self._slots, self._k] for name in ("label", "target", "theta")}
        found |= {"time": self._k * self.plant.dt, **self.plant.monitor(self._record.state[self._slots, self._k])}
        for value in found.values():
            value[~mask] = 0
        return found | {f"_{name}": mask.copy() for name in found}

    def render(self) -> tuple[Array, ...] | None:
        """One (H, W, 3) uint8 picture per environment."""
        if self.render_mode is None or self._record is None:
            return None
        from fdi_gym.plots import Canvas

        if self._canvas is None:
            self._canvas = Canvas(self.plant, self._game.task)
        return tuple(
            self._canvas.draw(Record(*(a[i : i + 1] for a in self._record)), int(self._k[i]), self._declared[i])
            for i in range(self.num_envs)
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Free the canvas."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None
