"""The rules of an environment whose actions act: what an action may hold, and what it is worth."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete, Space

from fdi_gym.acting import Acting
from fdi_gym.acts import accommodated, acting_of, probe_prices
from fdi_gym.checks import is_finite
from fdi_gym.plant import Array
from fdi_gym.rules import Rules
from fdi_gym.tasks import numbers, scaled

TASKS = ("isolation", "diagnosis")  # those whose answer says something about the fault that acts now


class Choice(NamedTuple):
    """What actions (...) say."""

    said: Any  # the action of the task
    probe: Array  # (...) int64
    unusable: Array  # (...) bool: the estimate is not finite


class ActiveRules(Rules):
    """The rules of one active environment; arguments as in `fdi_gym.active_envs.ActiveEnv` and `Rules`."""

    def __init__(self, *arguments: Any, probing: bool, accommodation: bool, cost_weight: float):
        super().__init__(*arguments)
        for name, value in (("probing", probing), ("accommodation", accommodation)):
            if not isinstance(value, (bool, np.bool_)):
                raise TypeError(f"{name} is True or False, not {value!r}")
        if not (probing or accommodation):
            raise ValueError("an active environment needs probing=True or accommodation=True, or both")
        if self.task.name not in TASKS:
            raise ValueError(f"the task of an active environment is one of {', '.join(TASKS)}, not {self.task.name!r}")
        if not is_finite(cost_weight) or cost_weight < 0:
            raise ValueError(f"cost_weight is a number from 0 on, not {cost_weight!r}")
        acting_of(self.plant, probing, accommodation)
        self.probing, self.accommodation, self.cost_weight = bool(probing), bool(accommodation), float(cost_weight)
        self.probes = len(self.acting.probes) if probing else 1
        self.price = self.cost_weight * np.array(probe_prices(self.plant) if probing else [0.0])
        self._labels = len(self.plant.labels)
        self._said_space, self.action_space = self.task.space, self._with_probes(self.task.space)

    @property
    def acting(self) -> Acting:
        """What the plant declares."""
        return acting_of(self.plant)

    def _with_probes(self, space: Space[Any]) -> Space[Any]:
        if not self.probing:
            return space
        if isinstance(space, Discrete):
            return MultiDiscrete([int(space.n), self.probes])
        assert isinstance(space, Box)
        low = np.concatenate([space.low, np.full(self.probes, -1.0 if self.scaled else 0.0)])
        return Box(low.astype(space.dtype), np.concatenate([space.high, np.ones(self.probes)]).astype(space.dtype),
                   dtype=space.dtype.type)  # type: ignore[union-attr]  # fmt: skip

    def split(self, action: Any, shape: tuple[int, ...]) -> Choice:
        """What actions (*shape, ...) say; the task checks its own part afterwards.

        Raises:
            ValueError: Another shape or kind, or no such probe; the message says what is allowed.
        """
        discrete = isinstance(self._said_space, Discrete)
        width = 2 if discrete else int(self._said_space.shape[0]) + self.probes  # type: ignore[index]
        none = np.zeros(shape, np.int64)
        if discrete and not self.probing:
            return Choice(action, none, none > 0)
        wanted = (*shape, width) if self.probing else (*shape, *self._said_space.shape)  # type: ignore[misc]
        value = numbers(action, wanted)
        if value is None:
            raise ValueError(f"the action holds numbers in the shape {wanted}, not {action!r}")
        if discrete:
            if value.dtype.kind not in "iu" or not ((value >= 0) & (value < [self._labels, self.probes])).all():
                names = ", ".join(f"{i} {probe.name}" for i, probe in enumerate(self.acting.probes))
                raise ValueError(
                    f"the action is a label in 0..{self._labels - 1} and a probe ({names}), integers, not {action!r}"
                )
            said = value[..., 0]
            return Choice(int(said) if not shape else said, value[..., 1].astype(np.int64), none > 0)
        value = value.astype(float)
        said = value[..., : width - self.probes] if self.probing else value
        unusable = np.asarray(np.isnan(said[..., self._labels :]).any(axis=-1))
        if unusable.any():  # it allows for nothing; it is judged as if the plant were said to be healthy
            said = said.copy()
            said[..., self._labels :] = np.where(unusable[..., None], self._healthy(), said[..., self._labels :])
        probe = none
        if self.probing:
            scores = value[..., width - self.probes :]
            if not np.isfinite(scores).all():
                raise ValueError(f"the scores of the probes are finite, not {scores!r}")
            probe = scores.argmax(axis=-1)
        return Choice(said, probe, unusable)

    def _healthy(self) -> Array:
        """The healthy plant's estimate, in the units of an action."""
        low, high = np.array([(s.low, s.high) for s in self.plant.estimated], float).T
        return scaled(self.plant.healthy, low, high) if self.scaled else self.plant.healthy

    def allowed_for(self, answer: Array, unusable: Array) -> Array:
        """The estimated quantities (n, n_estimated) that the controllers allow for after the task's answers (n, ...)."""
        answer = np.asarray(answer)
        if self.task.name == "isolation":
            return accommodated(self.plant, answer)
        estimate = np.where(unusable[:, None], np.nan, answer[:, 1:])
        return accommodated(self.plant, answer[:, 0].astype(np.int64), estimate)

    def worth(self, worth: Any, probe: Array, cost: Array) -> Any:
        """The reward: minus the flight's cost with accommodation, else the diagnosis's worth less the probe's price."""
        return -cost if self.accommodation else worth - self.price[probe]
