"""The rules that the single and the vector environment share: what is flown, what is shown, what a diagnosis is worth.

Everything that a caller hands in is checked here, at the door, before anything changes.
"""

from __future__ import annotations

import copy
import enum
import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box

from fdi_gym.declaration import true_declaration
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant, Signal
from fdi_gym.tasks import TASKS

UNITS = ("physical", "scaled")
SETS = ("modes", "identification")  # tasks that do not need a label

# Samples that are flown ahead of the agent: few after a reset, since an episode may be short, and twice as many each time.
# `python benchmarks/engine.py --chunks` measures what the two cost.
FIRST, CHUNK = 16, 128


def ahead(before: int, period: int) -> int:
    """Samples to fly next, after so many: a multiple of the decision period."""
    return period * -(-min(max(2 * before, FIRST), CHUNK) // period)


def whole(name: str, value: Any, least: int) -> int:
    """The value as an int of at least so much; NumPy's integers are integers, booleans are not.

    Raises:
        TypeError: Not an integer.
        ValueError: Too small.
    """
    if isinstance(value, (bool, np.bool_)) or not hasattr(value, "__index__"):
        raise TypeError(f"{name} is a whole number, at least {least}, not {value!r}")
    try:
        number = operator.index(value)
    except TypeError:  # an array of several
        raise TypeError(f"{name} is a whole number, at least {least}, not {value!r}") from None
    if number < least:
        raise ValueError(f"{name} is a whole number, at least {least}, not {value!r}")
    return number


def checked_seed(seed: Any) -> int | None:
    """A seed: None or a whole number from 0 on."""
    return None if seed is None else whole("a seed", seed, 0)


def checked_seeds(seed: Any, n: int) -> list[int | None]:
    """The seeds of n environments from what `reset` was given: None, the first one's, or one (or None) for each."""
    if seed is None:
        return [None] * n
    if isinstance(seed, (Sequence, np.ndarray)) and not isinstance(seed, (str, bytes)) and np.ndim(seed) != 0:
        if len(seed) != n:
            raise ValueError(f"one seed per environment is needed: {n}, not {len(seed)}")
        return [checked_seed(s) for s in seed]
    first = whole("a seed", seed, 0)
    return [first + i for i in range(n)]


def checked_mask(mask: Any, n: int) -> Array:
    """The environments that a reset is for."""
    if not isinstance(mask, np.ndarray) or mask.dtype != bool:
        raise TypeError(f"options['reset_mask'] is a bool array of shape ({n},), not {mask!r}")
    if mask.shape != (n,) or not mask.any():
        raise ValueError(f"options['reset_mask'] is a bool array of shape ({n},) with at least one True, not {mask!r}")
    return mask.copy()


def plain(value: Any) -> Any:
    """The argument of an environment as JSON has it: what a spec stores."""
    match value:
        case FaultScenario():
            return value.to_json()
        case np.generic():
            return value.item()
        case enum.Enum():
            return value.value
        case Mapping():
            return {key: plain(entry) for key, entry in value.items()}
        case list() | tuple():
            return [plain(entry) for entry in value]
    return value


class Readings(Box):
    """Observations: numbers between bounds, or NaN where a sensor did not report."""

    def contains(self, x: Any) -> bool:
        """Whether x is one."""
        if isinstance(x, np.ndarray) and x.shape == self.shape and np.isnan(x).any():
            x = np.where(np.isnan(x), self.low, x)
        return super().contains(x)


class Specified:
    """An environment whose spec survives JSON, whatever it was made with."""

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """What `gym.make` made it from; its arguments are plain values."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec = copy.copy(spec)
            spec.kwargs = plain(spec.kwargs)
        self._spec = spec


def _column(signals: tuple[Signal, ...], field: str) -> Array:
    return np.array([getattr(s, field) for s in signals], float)


class Rules:
    """The rules of one environment; arguments as in `FDIEnv`."""

    def __init__(
        self, plant: str | Plant, task: str, process: str | None, scenario: FaultScenario | str | None,
        mismatch: float | None, decision_period: int, units: str, options: dict[str, Any],
    ):  # fmt: skip
        if not isinstance(plant, (str, Plant)):
            raise TypeError(f"a plant is a Plant or its id, not {plant!r}")
        for name, value, allowed in (("units", units, UNITS), ("task", task, TASKS)):
            if value not in allowed:
                raise ValueError(f"unknown {name} {value!r}; there are {', '.join(allowed)}")
        self.period = whole("decision_period", decision_period, 1)
        if isinstance(plant, Plant) and options:
            raise ValueError(f"{plant.id} is built already: the options {', '.join(options)} come too late")
        self.plant = load_plant(plant, **options) if isinstance(plant, str) else plant
        if self.plant.simultaneous and task not in SETS:
            raise ValueError(
                f"where faults act at once, no label says which: the task is one of {', '.join(SETS)}, not {task!r}"
            )
        self.mismatch = self._checked_mismatch(mismatch)
        self.task = TASKS[task](self.plant, units == "scaled")
        if scenario is not None and (process is not None or mismatch is not None):
            raise ValueError("a scenario is replayed as it is: neither a process nor a mismatch goes with it")
        self.scenario = None if scenario is None else self.checked_scenario(scenario, "scenario")
        self.process = "standard" if process is None else process
        self.plant.process(self.process)  # there is one of that name
        self._declare_spaces(units)

    def _declare_spaces(self, units: str) -> None:
        seen = self.plant.observed
        low, high = _column(seen, "low"), _column(seen, "high")
        self.scaled = units == "scaled"
        dtype = np.float32 if self.scaled else np.float64
        if self.scaled:  # a rounding step wider, so that the cast to float32 cannot leave the space
            low = np.nextafter(np.float32(self.plant.scale(low)), np.float32(-np.inf))
            high = np.nextafter(np.float32(self.plant.scale(high)), np.float32(np.inf))
        if self.period > 1:
            low, high = np.tile(low, (self.period, 1)), np.tile(high, (self.period, 1))
        self.observation_space = Readings(low, high, dtype=dtype)
        self.action_space = self.task.space

    def _checked_mismatch(self, mismatch: Any) -> float | None:
        if mismatch is None:
            return None
        if self.plant.perturb is None:
            raise ValueError(f"{self.plant.id} declares no mismatch")
        if isinstance(mismatch, (bool, np.bool_)) or not isinstance(mismatch, (int, float, np.integer, np.floating)):
            raise TypeError(f"mismatch is a number from 0 on, not {mismatch!r}")
        if not (np.isfinite(mismatch) and mismatch >= 0):
            raise ValueError(f"mismatch is a number from 0 on, not {mismatch!r}")
        return float(mismatch)

    def checked_scenario(self, scenario: Any, name: str) -> FaultScenario:
        """A scenario, given as it is or as JSON text, that this plant can fly."""
        if isinstance(scenario, (str, bytes)):
            scenario = FaultScenario.from_json(scenario)
        if not isinstance(scenario, FaultScenario):
            raise TypeError(f"{name} is a FaultScenario or its JSON text, not {scenario!r}")
        self.plant.validate(scenario)
        return scenario

    def checked_options(self, options: Any, known: tuple[str, ...]) -> dict[str, Any]:
        """The options of a reset: only known ones, a scenario checked."""
        if options is None:
            return {}
        if not isinstance(options, Mapping):
            raise TypeError(f"the options of a reset are a dict, not {options!r}")
        for key in options:
            if key not in known:
                raise ValueError(f"unknown option {key!r} of a reset; there are {', '.join(known)}")
        found = {key: value for key, value in options.items() if value is not None}
        if "scenario" in found:
            found["scenario"] = self.checked_scenario(found["scenario"], "options['scenario']")
        return found

    def draw(self, seed: int) -> FaultScenario:
        """The scenario of an episode: replayed as it is where one was given, else drawn from the seed."""
        if self.scenario is not None:
            return self.scenario
        return self.plant.draw(self.process, seed, self.mismatch)

    def show(self, obs: Array) -> Array:
        """An observation in the units that were asked for; always a new array."""
        return self.plant.scale(obs).astype(np.float32) if self.scaled else obs.copy()

    def final(self, answers: Array, scenarios: Sequence[FaultScenario]) -> Array:
        """What the last answers (n, ...) of episodes are worth in a task that is judged at their end.

        The flights are flown again for the truth of the whole of each.
        """
        record = simulate(self.plant, scenarios)
        return self.task.worth(answers, true_declaration(self.plant, record), record.length)

    def time(self, k: Any) -> Any:
        """The time of sample k [s]."""
        return k * self.plant.dt
