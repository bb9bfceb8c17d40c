"""The Gymnasium environment of one flight: a thin shell over a flight that is flown ahead."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from fdi_gym.engine import Record, advance, simulate
from fdi_gym.faults import FaultScenario
from fdi_gym.flights import Chunk, Flights
from fdi_gym.plant import Array, Plant
from fdi_gym.rules import Rules, Specified, ahead, checked_seed


class FDIEnv(Specified, gym.Env):
    """Fault diagnosis as an environment: the observation is what the sensors say, the action is the diagnosis.

    Observation space: `Box` of float64 in physical units, `[y_k, u_{k-1}, known_k]`: the sensors at sample k, the
    command held over the interval that has just ended (the trim command at k = 0), and what else the flight computer
    knows. The bounds are the sensors' and commands' ranges. With `decision_period` m > 1 it is the block of the last m
    samples, shape (m, n), oldest first; sample 0 stands in for those before it.

    Action space, by `task` (see `fdi_gym.tasks`; finite values outside a `Box` are clipped):
        "isolation": `Discrete(number of labels)`, the label of the fault that acted over [k - 1, k).
        "identification": `Box` over the estimated quantity.
        "diagnosis": `Box` of a score for each label, the largest of which is meant, and then the estimated quantity.
        "scenario": `Box` of (present, onset, end, size) for each fault mode: the declaration of the whole flight.

    Names, units, bounds and labels of a plant are in the docstring of its file, in `fdi-gym list PLANT`, and in
    `env.unwrapped.plant`.

    Reward: as the plant declares; for "diagnosis" the sum of both. The action after sample 0 is worth 0, since no interval
    has ended. With m > 1 an action is judged at the newest sample of its block. For "scenario" only the last action of the
    episode counts, and is worth 0 to 1 (`fdi_gym.declaration.worth`).

    Episode: the plant flies whatever is diagnosed. It is `truncated` at the scenario's last sample and `terminated`
    where the plant leaves its declared envelope.

    Info: the truth to which the next action will be compared: `label` (int), `target` and `theta` (arrays), `time` [s];
    and what the plant's `monitor` says of the state (floats). For training only; the evaluation never passes it on.

    Pickled, copied or sent to another process, it goes on with the same bytes.

    Args:
        plant: Plant id (set by the registration).
        task: "isolation", "modes", "identification", "diagnosis" or "scenario".
        process: Name of one of the plant's fault processes. Default: "standard".
        scenario: A `FaultScenario`, or its JSON text, that every episode replays exactly, noise included.
        mismatch: Level of the difference between the truth's physical parameters and the diagnosers' model, in the
            plant's own measure. Default: what the process prescribes.
        decision_period: Samples per agent step.
        units: "physical", or "scaled" for learners: float32 observations (value - nominal) / scale of the data sheet,
            and identification actions in [-1, 1] that stand for the bounds of the estimated quantity.
        render_mode: "rgb_array" or "human": signals, truth and diagnosis up to now.
        options: The plant's own options.

    Raises:
        ValueError: Unknown task, process, option or option value, a scenario of another plant; the message says what is
            allowed.
        TypeError: An argument of another kind.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}

    def __init__(
        self,
        plant: str | Plant,
        task: str = "isolation",
        process: str | None = None,
        scenario: FaultScenario | str | None = None,
        mismatch: float | None = None,
        decision_period: int = 1,
        units: str = "physical",
        render_mode: str | None = None,
        **options: Any,
    ):
        self._set_up(Rules(plant, task, process, scenario, mismatch, decision_period, units, options), render_mode)

    def _set_up(self, rules: Rules, render_mode: str | None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render_mode {render_mode!r}; there are {self.metadata['render_modes']}")
        self._rules = rules
        self.plant = self._rules.plant
        self.observation_space, self.action_space = self._rules.observation_space, self._rules.action_space
        self.render_mode = render_mode
        self.scenario: FaultScenario | None = None
        self._flights: Flights | None = None
        self._k, self._over = 0, True
        self._declared: list[tuple[int, Any]] = []
        self._record: Record | None = None
        self._canvas: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_canvas": None, "_record": None}  # pictures are drawn anew

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode. `options={"scenario": FaultScenario}` replays one, noise included.

        Raises:
            ValueError: A negative seed, an unknown option, a scenario of another plant.
            TypeError: A seed that is no whole number, a scenario that is none.
        """
        seed, replay = checked_seed(seed), self._rules.checked_options(options, ("scenario",)).get("scenario")
        super().reset(seed=seed)
        episode_seed = int(self.np_random.integers(2**63)) if seed is None else seed
        self.scenario = scenario = self._rules.draw(episode_seed) if replay is None else replay
        if self._flights is None:
            self._flights = Flights(self.plant, [scenario])
        else:
            self._flights.begin([0], [scenario])
        self._k, self._over, self._declared, self._record = 0, False, [], None
        self._base = self._first = self._flown = self._ahead = 0
        self._fly()
        if self.render_mode == "human":
            self.render()
        return self._block(0), self._info(0)

    def _fly(self) -> None:
        """Fly on, and keep of the observations before what a block may still reach back to.

        The rows of a chunk are cut once: each is an array of its own that nobody else reads.
        """
        assert self._flights is not None
        chunk = self._advance(self._flights)
        obs, theta = chunk.obs[:, 0], chunk.theta[:, 0]
        target = self.plant.estimate_target(theta, self.plant.split(obs)[1])
        self._first, self._label, self._target = self._flown, chunk.label[:, 0].tolist(), list(np.array(target))
        truth = {"label": self._label, "target": list(np.array(target)), "theta": list(np.array(theta))}
        self._truth = truth | {name: a.tolist() for name, a in self.plant.monitor(chunk.state[:, 0]).items()}
        if self._rules.period == 1:
            self._obs = list(self._rules.show(obs))
        else:
            keep = min(self._flown - self._base, self._flown - self._k + self._rules.period - 2)
            self._obs = np.concatenate([self._obs[-keep:], obs]) if keep > 0 else obs
            self._base = self._flown - max(keep, 0)
        self._flown += self._ahead
        self._length, self._terminated = int(self._flights.length[0]), bool(self._flights.terminated[0])

    def _advance(self, flights: Flights) -> Chunk:
        """The samples that are flown next; the flight is some way ahead, since what is said of it does not reach it."""
        self._ahead = ahead(self._ahead, self._rules.period)
        return advance(flights, self._ahead)

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Judge the diagnosis of the interval that ended at the current sample, and fly on to the next observation.

        Raises:
            ValueError: The action is not of the action space's kind; nothing has happened then.
            RuntimeError: The episode is over, or has not begun.
        """
        if self._over:
            raise RuntimeError("the episode is over, or has not begun: call reset()")
        k, rules = self._k, self._rules
        now = k - self._first
        checked = rules.task.check(action, ())
        reward = float(rules.task.reward(checked, self._label[now], self._target[now])) if k else 0.0
        if self.render_mode is not None:
            self._declared.append((k, checked))
        while self._flown <= k + rules.period and self._flown <= self._length:
            self._fly()
        self._k = k = min(k + rules.period, self._length)
        self._over = k == self._length
        if self._over and rules.task.at_end:
            assert self.scenario is not None
            reward = float(rules.final(checked[None], [self.scenario])[0])
        if self.render_mode == "human":
            self.render()
        terminated = self._over and self._terminated
        return self._block(k), reward, terminated, self._over and not terminated, self._info(k)

    def _block(self, k: int) -> Array:
        m = self._rules.period
        if m == 1:
            return self._obs[k - self._first]
        return self._rules.show(self._obs[k - self._base + np.maximum(np.arange(1 - m, 1), -k)])

    def _info(self, k: int) -> dict[str, Any]:
        row = k - self._first
        info = {name: values[row] for name, values in self._truth.items()}
        info["time"] = k * self.plant.dt
        return info

    def render(self) -> Array | None:
        """The episode so far: an (H, W, 3) uint8 picture for "rgb_array", a window for "human"."""
        if self.render_mode is None or self.scenario is None:
            return None
        from fdi_gym.plots import Canvas

        if self._canvas is None:
            self._canvas = Canvas(self.plant, self._rules.task.name, window=self.render_mode == "human")
        if self._record is None:
            self._record = self._whole()
        return self._canvas.draw(self._record, self._k, self._declared)

    def _whole(self) -> Record:
        """The flight from its beginning, as a picture shows it."""
        assert self.scenario is not None
        return simulate(self.plant, [self.scenario])

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None
