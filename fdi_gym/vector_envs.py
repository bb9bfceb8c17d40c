"""The Gymnasium environment of many flights side by side: a thin shell over flights that are flown ahead."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from fdi_gym.engine import Added, Record, advance, simulate
from fdi_gym.faults import FaultScenario
from fdi_gym.flights import Flights, Prepared
from fdi_gym.next_flights import NextFlights
from fdi_gym.plant import Array, Plant
from fdi_gym.rules import CHUNK, Rules, Specified, ahead, checked_mask, checked_seeds, whole

NOTHING = Added()
SOON = 8 * CHUNK  # samples before its end from which on a flight's next one may be prepared


class FDIVectorEnv(Specified, VectorEnv):
    """N environments side by side; equal to N `FDIEnv`, sample by sample, with episodes that end at different times.

    `gym.make_vec("B747Lateral-Faults-v0", num_envs=N, ...)`. Spaces, rewards and info are those of `FDIEnv`, batched.
    All flights are flown ahead in lock-step, some hundred samples at a time, into arrays in (sample, environment, signal)
    order that all steps read: memory is N x `CHUNK` samples, however long the flights are.

    Args:
        num_envs: N.
        autoreset_mode: A Gymnasium `AutoresetMode` or its name: "NextStep", "SameStep" or "Disabled".
        truth: False leaves `info` empty but for what ends an episode (`final_obs`, `final_info`); `truth()` gives the same
            arrays when they are wanted.
        plant, task, process, scenario, mismatch, decision_period, units, options: As in `FDIEnv`.
        render_mode: "rgb_array": `render` returns one picture per environment.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        plant: str | Plant,
        num_envs: int = 1,
        task: str = "isolation",
        process: str | None = None,
        scenario: FaultScenario | str | None = None,
        mismatch: float | None = None,
        decision_period: int = 1,
        units: str = "physical",
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        truth: bool = True,
        **options: Any,
    ):
        rules = Rules(plant, task, process, scenario, mismatch, decision_period, units, options)
        self._set_up(rules, num_envs, render_mode, autoreset_mode, truth)

    def _set_up(
        self, rules: Rules, num_envs: int, render_mode: str | None, autoreset_mode: str | AutoresetMode, truth: bool
    ) -> None:
        num_envs = whole("num_envs", num_envs, 1)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render_mode {render_mode!r}; there are {self.metadata['render_modes']}")
        if not isinstance(truth, (bool, np.bool_)):
            raise TypeError(f"truth is True or False, not {truth!r}")
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            allowed = [mode.value for mode in AutoresetMode]
            raise ValueError(f"unknown autoreset_mode {autoreset_mode!r}; there are {allowed}") from None
        self._rules = rules
        self.plant, self.num_envs, self.render_mode = self._rules.plant, num_envs, render_mode
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        self.single_observation_space = self._rules.observation_space
        self.single_action_space = self._rules.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.scenarios: list[FaultScenario | None] = [None] * num_envs
        self._seeds: list[int | None] = [None] * num_envs
        self._rngs: list[np.random.Generator | None] = [None] * num_envs  # made from the seeds when they are needed
        self._informs = bool(truth)
        self._flights: Flights | None = None
        self._k = np.zeros(num_envs, dtype=np.int64)
        self._over = np.ones(num_envs, dtype=bool)
        self._waits, self._fresh = True, True  # whether any episode is over, and whether any has just begun
        self._all = np.arange(num_envs)
        self._next = NextFlights(self._prepared)
        self._declared: list[list[tuple[int, Array]]] = [[] for _ in range(num_envs)]
        self._records: dict[int, Record] = {}
        self._canvas: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_canvas": None, "_records": {}}  # pictures are drawn anew

    def _rng(self, i: int) -> np.random.Generator:
        found = self._rngs[i]
        if found is None:
            found, self._seeds[i] = seeding.np_random(self._seeds[i])
            self._rngs[i] = found
        return found

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generators of the environments, from which the seeds of their next episodes come."""
        return tuple(self._rng(i) for i in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """What each environment's generator was seeded with."""
        return tuple(self._rng(i) is not None and self._seeds[i] for i in range(self.num_envs))  # type: ignore[misc]

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin new episodes, in all environments or in those of `options["reset_mask"]` (a bool array).

        `options={"scenario": FaultScenario}` replays one in each of them, noise included.

        Raises:
            ValueError, TypeError: As in `FDIEnv.reset`; also where not one seed per environment is given, or a mask that is
                none. Nothing has happened then.
        """
        seeds = checked_seeds(seed, self.num_envs)
        found = self._rules.checked_options(options, ("scenario", "reset_mask"))
        mask = checked_mask(found.get("reset_mask", np.ones(self.num_envs, bool)), self.num_envs)
        if self._flights is None and not mask.all():
            raise ValueError("the first reset begins an episode in every environment: no reset_mask yet")
        self._begin(np.flatnonzero(mask), seeds, found.get("scenario"))
        return self._observation(), self._infos(mask)

    def _begin(self, slots: Array, seeds: list[int | None], replay: FaultScenario | None = None) -> None:
        """Begin an episode in each of these environments, at the row where all are."""
        prepared: list[Prepared | None] = []
        for i in slots.tolist():
            seed = seeds[i]
            if seed is None:
                episode_seed = int(self._rng(i).integers(2**63))
            else:
                episode_seed, self._seeds[i], self._rngs[i] = seed, seed, None
            flight = self._next.take(i, episode_seed)
            prepared.append(flight if replay is None else None)
            self.scenarios[i] = replay or (flight.scenario if flight else self._rules.draw(episode_seed))
            self._declared[i] = []
            self._records.pop(i, None)
        scenarios = [s for i in slots if (s := self.scenarios[i]) is not None]
        if self._flights is None:
            self._flights = Flights(self.plant, scenarios)
            period = self._rules.period
            self._buffer = self._flights.blank(period + self._next_chunk(CHUNK))
            self._target = self._buffer.theta if self.plant.target is None else \
                np.zeros((*self._buffer.label.shape, len(self.plant.estimated)))  # fmt: skip
            self._row = np.zeros(self.num_envs, np.int64)
        else:
            self._flights.put(
                slots, [flight or self._flights.prepare(s) for flight, s in zip(prepared, scenarios, strict=True)]
            )
        if slots.size == self.num_envs:
            self._now, self._ahead = self._rules.period - 1, self._next_chunk(None)
            self._filled = self._now + 1 + self._ahead
        self._k[slots], self._over[slots], self._row[slots] = 0, False, self._now
        self._waits, self._fresh = bool(self._over.any()), True
        self._fly(self._now, slots)

    def _next_chunk(self, before: int | None) -> int:
        """How many samples are flown next, after so many (None: after the first one): some way ahead of the agent."""
        return ahead(before or 0, self._rules.period)

    def _fly(self, first: int, slots: Array, added: Added = NOTHING) -> None:
        """Fly these flights from this row on to where all end."""
        flights = self._flights
        assert flights is not None
        advance(
            flights, self._filled - first, self._buffer, first, slots, added.inputs, added.references,
            meanwhile=lambda: self._next.prepare_one(self._rng),
        )  # fmt: skip
        rows = slice(first, self._filled)
        where: Any = rows if slots.size == self.num_envs else (rows, slots)
        obs, _, theta, _ = self._buffer
        if self.plant.target is not None:
            self._target[where] = self.plant.estimate_target(theta[where], self.plant.split(obs[where])[1])

    def _fly_all(self) -> None:
        """The next chunk of all flights; the last rows before it stay, since a block may reach back to them."""
        m = self._rules.period
        for array in {id(a): a for a in (*self._buffer, self._target)}.values():
            array[:m] = array[self._now - m + 1 : self._now + 1].copy()
        self._now, self._ahead = m - 1, self._next_chunk(self._ahead)
        self._filled = m + self._ahead
        self._fly(m, self._all, self._added())
        if self._mode is not AutoresetMode.DISABLED:
            left = self._flights.length - self._k  # type: ignore[union-attr]
            soon = np.flatnonzero(~self._over & (left <= SOON))
            self._next.plan(soon, left[soon] // m)

    def _added(self) -> Added:
        """What is added to the flights in the chunk that is flown next (see `advance`): nothing."""
        return NOTHING

    def _prepared(self, seed: int) -> Prepared:
        """The flight of an episode's seed."""
        assert self._flights is not None
        return self._flights.prepare(self._rules.draw(seed))

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Step every environment; those that ended are treated as the autoreset mode says.

        Raises:
            ValueError: An action is not of the action space's kind; nothing has happened then.
            RuntimeError: No episode has begun; or, without autoreset, one is over.
        """
        flights = self._flights
        if flights is None:
            raise RuntimeError("no episode has begun: call reset()")
        task = self._rules.task
        checked = task.check(actions, (self.num_envs,))
        over, waits = self._over, self._waits
        begin = np.flatnonzero(over) if waits else self._all[:0]
        if waits and self._mode is AutoresetMode.DISABLED:
            raise RuntimeError(f"episodes {begin.tolist()} are over: reset them with options={{'reset_mask': ...}}")
        k = self._k
        reward = np.asarray(task.reward(checked, self._here(self._buffer.label), self._here(self._target)), float)
        if waits or self._fresh:
            reward = np.where((k == 0) | over, 0.0, reward)
        if self.render_mode is not None:
            for i in np.flatnonzero(~over):
                self._declared[i].append((int(k[i]), checked[i]))
        if self._now + 1 == self._filled:
            self._fly_all()
        self._next.prepare(self._rng)
        period = self._rules.period
        self._k = np.minimum(k + period, flights.length)
        if waits:
            self._k[over] = k[over]
        self._row = self._now + self._k - k
        self._now += period
        ended = self._k == flights.length
        if waits:
            ended &= ~over
        self._over, self._waits, self._fresh = ended, bool(ended.any()), False
        if task.at_end and self._waits:
            flown = [s for s, last in zip(self.scenarios, ended, strict=True) if last and s is not None]
            reward[ended] = self._rules.final(checked[ended], flown)
        terminated = ended & flights.terminated
        truncated = ended ^ terminated
        infos: dict[str, Any] = {}
        if self._mode is AutoresetMode.SAME_STEP:
            begin = np.flatnonzero(ended)
            for i in begin.tolist():
                infos = self._add_info(infos, {"final_obs": self._block(i), "final_info": self._info(i)}, i)
        if begin.size:
            self._begin(begin, [None] * self.num_envs)
        if self._informs:
            infos |= self._infos(np.ones(self.num_envs, dtype=bool))
        return self._observation(), reward, terminated, truncated, infos

    def _here(self, array: Array) -> Array:
        """A recorded quantity (rows, N, ...) at each environment's current sample."""
        if self._rules.period == 1 or (self._row == self._now).all():
            return array[self._now]
        return array[self._row, self._all]

    def _observation(self) -> Array:
        m, now = self._rules.period, self._now
        if m == 1:
            return self._rules.show(self._buffer.obs[now])
        shown = self._rules.show(self._buffer.obs[now - m + 1 : now + 1].swapaxes(0, 1))
        for i in np.flatnonzero((self._k == 0) | (self._row != now)).tolist():
            shown[i] = self._block(i)
        return shown

    def _block(self, i: int) -> Array:
        m, row = self._rules.period, self._row[i]
        if m == 1:
            return self._rules.show(self._buffer.obs[row, i])
        return self._rules.show(self._buffer.obs[row + np.maximum(np.arange(1 - m, 1), -self._k[i]), i])

    def _info(self, i: int) -> dict[str, Any]:
        row = self._row[i]
        return {
            "label": int(self._buffer.label[row, i]),
            "target": self._target[row, i].copy(),
            "theta": self._buffer.theta[row, i].copy(),
            "time": float(self._k[i] * self.plant.dt),
            **{name: float(value) for name, value in self.plant.monitor(self._buffer.state[row, i]).items()},
        }

    def truth(self, *names: str) -> dict[str, Array]:
        """The truth to which the next actions will be compared, by the names of `info` (all, or these): arrays (N, ...).

        Raises:
            RuntimeError: No episode has begun.
        """
        if self._flights is None:
            raise RuntimeError("no episode has begun: call reset()")
        recorded = {"label": self._buffer.label, "target": self._target, "theta": self._buffer.theta}
        found = {name: self._here(a).copy() for name, a in recorded.items() if not names or name in names}
        if not names or "time" in names:
            found["time"] = self._k * self.plant.dt
        if not names or not set(names) <= {*recorded, "time"}:
            monitored = self.plant.monitor(self._here(self._buffer.state))
            found |= {name: value for name, value in monitored.items() if not names or name in names}
        return found

    def _infos(self, mask: Array) -> dict[str, Any]:
        """The infos of the masked environments, in Gymnasium's vector form."""
        if not self._informs:
            return {}
        found = self.truth()
        if not mask.all():
            for value in found.values():
                value[~mask] = 0
        return found | {f"_{name}": mask.copy() for name in found}

    def render(self) -> tuple[Array, ...] | None:
        """One (H, W, 3) uint8 picture per environment."""
        if self.render_mode is None or self._flights is None:
            return None
        from fdi_gym.plots import Canvas

        if self._canvas is None:
            self._canvas = Canvas(self.plant, self._rules.task.name)
        for i, scenario in enumerate(self.scenarios):
            if i not in self._records and scenario is not None:
                self._records[i] = self._whole(i, scenario)
        return tuple(self._canvas.draw(self._records[i], int(self._k[i]), self._declared[i]) for i in range(self.num_envs))

    def _whole(self, i: int, scenario: FaultScenario) -> Record:
        """The flight of an environment from its beginning, as a picture shows it."""
        return simulate(self.plant, [scenario])

    def close_extras(self, **kwargs: Any) -> None:
        """Free the canvas."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None
