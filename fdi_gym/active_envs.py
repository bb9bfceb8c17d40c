"""Environments in which the diagnosis acts: it may add a probe to find a fault sooner, and reconfigure the controller."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from fdi_gym.active_rules import ActiveRules, Choice
from fdi_gym.acts import Acts, spent
from fdi_gym.engine import Added, Record, recorded
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import FaultScenario
from fdi_gym.flights import Chunk, Flights
from fdi_gym.plant import Array, Plant
from fdi_gym.vector_envs import FDIVectorEnv


class ActiveEnv(FDIEnv):
    """`FDIEnv` whose actions reach the plant. The engine flies exactly `decision_period` samples per action.

    The action after the observation of sample k is the diagnosis of the interval that has ended, and what is done from the
    command of sample k + 1 on: the command of sample k is computed while the diagnosis is made.

    Action space, by `task`:
        "isolation": `Discrete(labels)`; with probing `MultiDiscrete([labels, probes])`, probe 0 is "none".
        "diagnosis": the `Box` of `FDIEnv`; with probing it ends with a score for each probe, the largest of which is meant.

    Probing: the probes are the plant's (`plant.acting.probes`, `fdi_gym.acting.Probe`). Accommodation: the diagnosis goes
    to the plant's `acting.accommodate`, which gives the controller's parameters. An estimate counts along the lines of the
    label's modes; without one ("isolation") it is the middle of each mode's reach. An estimate with a NaN reconfigures
    nothing and is counted in `info["unusable"]`.

    Reward: with probing alone, what the diagnosis is worth in `FDIEnv`, less `cost_weight` times the price of the chosen
    probe: what it costs a healthy flight per sample (`fdi_gym.acts.probe_prices`), in units of the plant's flight cost. With
    accommodation, minus the flight's cost over the interval, tracking error and effort, in which a probe and a wrong
    diagnosis pay for themselves; what is left of a flight that leaves its envelope costs `acting.lost` per sample.

    Info: as in `FDIEnv`, and `cost`, the flight cost over the last interval per sample of a period; `unusable`.

    Args:
        plant, task, process, scenario, mismatch, decision_period, units, render_mode, options: As in `FDIEnv`.
        probing: Actions choose probes.
        accommodation: Diagnoses reconfigure the controller.
        cost_weight: Factor on the price of a probe.

    Raises:
        ValueError: As in `FDIEnv`; neither probing nor accommodation, or one that the plant does not declare.
    """

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
        probing: bool = True,
        accommodation: bool = False,
        cost_weight: float = 1.0,
        **options: Any,
    ):
        rules = ActiveRules(
            plant, task, process, scenario, mismatch, decision_period, units, options,
            probing=probing, accommodation=accommodation, cost_weight=cost_weight,
        )  # fmt: skip
        self._set_up(rules, render_mode)
        self._active, self._acts = rules, None

    _acts: Acts | None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """As `FDIEnv.reset`."""
        self._cost, self._unusable, self._flown_chunks = 0.0, 0, []
        return super().reset(seed=seed, options=options)

    def _advance(self, flights: Flights) -> Chunk:
        self._ahead = self._active.period if self._flown else 1
        if not self._flown:
            self._acts = Acts(flights, self._active.probing, self._active.accommodation)
            self._acts.begin(np.zeros(1, np.int64))
        assert self._acts is not None
        first = flights.k.copy()
        chunk = self._acts.advance(self._ahead)
        if self._flown:
            self._cost = float(spent(flights, chunk, first)[0]) / self._active.period
            if flights.terminated[0] and self.scenario is not None:
                self._lost = self._active.acting.lost * (self.scenario.steps - int(flights.length[0])) / self._active.period
        if self.render_mode is not None:
            self._flown_chunks.append(chunk)
        return chunk

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Judge the diagnosis of the interval that ended at the current sample, act, and fly on to the next observation.

        Raises:
            ValueError: The action is not of the action space's kind; nothing has happened then.
            RuntimeError: The episode is over, or has not begun.
        """
        if self._over:
            raise RuntimeError("the episode is over, or has not begun: call reset()")
        assert self._acts is not None
        choice = self._active.split(action, ())
        answer = self._active.task.check(choice.said, ())
        self._act(self._acts, choice, answer)
        self._lost = 0.0
        observation, worth, terminated, truncated, _ = super().step(choice.said)
        reward = self._active.worth(worth, choice.probe, np.array(self._cost + self._lost))
        return observation, float(reward), terminated, truncated, self._info(self._k)

    def _act(self, acts: Acts, choice: Choice, answer: Any) -> None:
        if self._active.accommodation:
            unusable = np.atleast_1d(choice.unusable)
            acts.accommodate(self._active.allowed_for(np.asarray(answer)[None], unusable))
            self._unusable += int(unusable[0])
        acts.choose(np.atleast_1d(choice.probe))

    def _info(self, k: int) -> dict[str, Any]:
        return {**super()._info(k), "cost": self._cost if k else 0.0, "unusable": self._unusable}

    def _whole(self) -> Record:
        """The flight so far, as long as it will be: its newest sample stands for those to come."""
        assert self._flights is not None
        length = int(self._flights.length[0])
        rows = [np.concatenate(parts)[: length + 1] for parts in zip(*self._flown_chunks, strict=True)]
        whole = (np.concatenate([a, np.repeat(a[-1:], length + 1 - len(a), axis=0)]) for a in rows)
        return recorded(self._flights, Chunk(*whole))

    def render(self) -> Array | None:
        """As `FDIEnv.render`; what has not been flown yet is not drawn."""
        self._record = None  # it has grown
        return super().render()


class ActiveVectorEnv(FDIVectorEnv):
    """N active environments side by side; equal to N `ActiveEnv`, sample by sample.

    Args:
        num_envs, autoreset_mode, truth, render_mode: As in `FDIVectorEnv`.
        plant, task, process, scenario, mismatch, decision_period, units, probing, accommodation, cost_weight, options: As in
            `ActiveEnv`.
    """

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
        probing: bool = True,
        accommodation: bool = False,
        cost_weight: float = 1.0,
        **options: Any,
    ):
        if render_mode is not None:
            raise ValueError("active environments are drawn one at a time: make one, with render_mode='rgb_array'")
        self._active = ActiveRules(
            plant, task, process, scenario, mismatch, decision_period, units, options,
            probing=probing, accommodation=accommodation, cost_weight=cost_weight,
        )  # fmt: skip
        self._set_up(self._active, num_envs, render_mode, autoreset_mode, truth)
        self._acts: Acts | None = None
        self._cost, self._spent, self._lost = np.zeros(num_envs), np.zeros(num_envs), np.zeros(num_envs)
        self._unusable = np.zeros(num_envs, np.int64)

    def _next_chunk(self, before: int | None) -> int:
        return 0 if before is None else self._active.period

    def _begin(self, slots: Array, seeds: list[int | None], replay: FaultScenario | None = None) -> None:
        super()._begin(slots, seeds, replay)
        assert self._flights is not None
        if self._acts is None:
            self._acts = Acts(self._flights, self._active.probing, self._active.accommodation)
        self._acts.begin(slots)
        self._cost[slots], self._unusable[slots] = 0.0, 0

    def _added(self) -> Added:
        assert self._acts is not None
        return self._acts.tables(self._active.period)

    def _fly_all(self) -> None:
        flights, period = self._flights, self._active.period
        assert flights is not None
        first, over = flights.k.copy(), self._over.copy()
        super()._fly_all()
        chunk = Chunk(*(array[period : 2 * period] for array in self._buffer))
        self._spent = np.where(over, 0.0, spent(flights, chunk, first) / period)
        self._cost = self._spent.copy()
        self._lost[:] = 0.0
        for i in np.flatnonzero(flights.terminated & ~over).tolist():
            scenario = self.scenarios[i]
            assert scenario is not None
            self._lost[i] = self._active.acting.lost * (scenario.steps - int(flights.length[i])) / period

    def truth(self, *names: str) -> dict[str, Array]:
        """As `FDIVectorEnv.truth`, with `cost` and `unusable`."""
        own = {"cost": self._cost, "unusable": self._unusable}
        return super().truth(*names) | {name: a.copy() for name, a in own.items() if not names or name in names}

    def _info(self, i: int) -> dict[str, Any]:
        return {**super()._info(i), "cost": float(self._cost[i]), "unusable": int(self._unusable[i])}

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """As `FDIVectorEnv.step`; what was chosen acts on the flights."""
        if self._flights is None:
            raise RuntimeError("no episode has begun: call reset()")
        assert self._acts is not None
        choice = self._active.split(actions, (self.num_envs,))
        answer = self._active.task.check(choice.said, (self.num_envs,))
        over = self._over.copy()
        if over.any() and self._mode is AutoresetMode.DISABLED:
            raise RuntimeError(f"episodes {np.flatnonzero(over).tolist()} are over: reset them with a reset_mask")
        if self._active.accommodation:
            self._acts.accommodate(self._active.allowed_for(answer, choice.unusable))
            self._unusable += choice.unusable & ~over
        self._acts.choose(choice.probe)
        observation, worth, terminated, truncated, infos = super().step(choice.said)
        reward = self._active.worth(worth, choice.probe, self._spent + self._lost)
        return observation, np.where(over, 0.0, reward), terminated, truncated, infos
