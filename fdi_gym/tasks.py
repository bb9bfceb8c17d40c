"""The tasks: what an action says, when it is judged, and what it is worth. One class each.

- `isolation`: which fault acts, as a label;
- `modes`: which of the fault modes act, each for itself;
- `identification`: the estimated quantity;
- `diagnosis`: both in one action;
- `scenario`: one declaration for the flight, made with its last action: which faults it had, when, and how large.

An action is checked at the door and turned into physical units by `check`; `reward` is what such an answer is worth.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, Space

from fdi_gym.declaration import END, ONSET, PRESENT, SIZE, bounds, columns, worth
from fdi_gym.plant import Array, Plant


class Task:
    """One task on a plant.

    Args:
        plant: The plant.
        scaled: Actions are numbers in [-1, 1] that stand for the bounds of what they say.

    Attributes:
        space: The action space of one environment.
        at_end: Only the last action of an episode is judged, as a declaration of the whole flight.
    """

    name: ClassVar[str]
    at_end: ClassVar[bool] = False
    space: Space[Any]

    def __init__(self, plant: Plant, scaled: bool):
        self.plant, self.scaled = plant, scaled

    def check(self, action: Any, shape: tuple[int, ...]) -> Array:
        """The answers (*shape, ...) of an action, in physical units.

        Raises:
            ValueError: Wrong shape, not finite, or not a label; the message says what is allowed.
        """
        raise NotImplementedError

    def reward(self, answer: Array, label: Any, target: Array) -> Any:
        """What answers (...) are worth where the truth is label (...) and target (..., n)."""
        return np.zeros(np.shape(label))

    def worth(self, answer: Array, truth: Array, length: Array) -> Array:
        """What the last answers (n, ...) are worth, for a task `at_end`.

        Args:
            answer: The answers.
            truth: The true declarations (n, modes, 4).
            length: The last samples (n,) of the flights.
        """
        raise NotImplementedError


def holds_bool(action: Any) -> bool:
    """Whether there is a boolean among the entries of an action."""
    if isinstance(action, (list, tuple)):
        return any(holds_bool(entry) for entry in action)
    return isinstance(action, (bool, np.bool_)) or (isinstance(action, np.ndarray) and action.dtype == bool)


def _array(action: Any) -> Array:
    try:
        return np.asarray(action)
    except Exception:  # an object may refuse in its own way
        return np.empty((0,))


def numbers(action: Any, shape: tuple[int, ...]) -> Array | None:
    """An action as an array, if it holds numbers in this shape; NaN is one."""
    value = _array(action)
    return value if value.shape == shape and value.dtype.kind in "iuf" and not holds_bool(action) else None


def scaled(value: Array, low: Array, high: Array) -> Array:
    """Values (..., n) between bounds (n,) as numbers in [-1, 1]."""
    return 2 * (value - low) / np.where(high > low, high - low, 1.0) - 1


def checked_box(action: Any, shape: tuple[int, ...]) -> Array:
    """An action as finite float64 of this shape.

    Raises:
        ValueError: It is not.
    """
    value = numbers(action, shape)
    if value is not None:
        with np.errstate(over="ignore"):
            value = value.astype(np.float64)
    if value is None or not np.isfinite(value).all():
        raise ValueError(f"the action is finite and has the shape {shape}, not {action!r}")
    return value


class _Boxed(Task):
    """A task whose action is a vector between bounds (n,)."""

    low: Array
    high: Array

    def _bounded(self, low: Array, high: Array) -> None:
        self.low, self.high = np.asarray(low, float), np.asarray(high, float)
        self.space = (
            Box(-1.0, 1.0, self.low.shape, np.float32) if self.scaled else Box(self.low, self.high, dtype=np.float64)
        )

    def _physical(self, action: Any, shape: tuple[int, ...]) -> Array:
        """Checked, in physical units; what is finite and outside the bounds is clipped."""
        value = checked_box(action, (*shape, *self.low.shape))
        if self.scaled:
            value = self.low + (self.high - self.low) * (value + 1) / 2
        return np.clip(value, self.low, self.high)


class Isolation(Task):
    """`Discrete(labels)`: the label of the fault that acted over [k - 1, k)."""

    name = "isolation"

    def __init__(self, plant: Plant, scaled: bool):
        super().__init__(plant, scaled)
        self.space = Discrete(len(plant.labels))
        self._rewards: list[list[float]] = np.asarray(plant.isolation_reward, float).tolist()

    def check(self, action: Any, shape: tuple[int, ...]) -> Array:
        """As `Task.check`."""
        if type(action) is int and not shape and 0 <= action < len(self.plant.labels):
            return action  # type: ignore[return-value]
        value, labels = _array(action), len(self.plant.labels)
        good = value.shape == shape and value.dtype.kind in "iu" and not holds_bool(action)
        if not good or (value.size and not 0 <= value.min() <= value.max() < labels):
            raise ValueError(f"the action is a label in 0..{labels - 1}, shape {shape} and integer, not {action!r}")
        return value

    def reward(self, answer: Array, label: Any, target: Array) -> Any:
        """As `Task.reward`."""
        if type(label) is int:
            return self._rewards[label][answer]  # type: ignore[index]
        return self.plant.isolation_reward[label, answer]  # type: ignore[index]


class Modes(Task):
    """`MultiBinary(modes)`: for each fault mode in turn, whether it acted over [k - 1, k).

    Worth the share of the modes that are answered right.
    """

    name = "modes"

    def __init__(self, plant: Plant, scaled: bool):
        super().__init__(plant, scaled)
        self.space = MultiBinary(len(plant.modes))

    def check(self, action: Any, shape: tuple[int, ...]) -> Array:
        """As `Task.check`."""
        value, wanted = _array(action), (*shape, len(self.plant.modes))
        if value.shape != wanted or value.dtype.kind not in "iub" or not ((value == 0) | (value == 1)).all():
            raise ValueError(f"the action is 0 or 1 for each fault mode, shape {wanted}, not {action!r}")
        return value.astype(bool)

    def reward(self, answer: Array, label: Any, target: Array) -> Any:
        """As `Task.reward`."""
        return (answer == self.plant.modes_of(label)).mean(axis=-1)


class Identification(_Boxed):
    """`Box` over the estimated quantity."""

    name = "identification"

    def __init__(self, plant: Plant, scaled: bool):
        super().__init__(plant, scaled)
        self._bounded(*np.array([(s.low, s.high) for s in plant.estimated], float).T)

    def check(self, action: Any, shape: tuple[int, ...]) -> Array:
        """As `Task.check`."""
        return self._physical(action, shape)

    def reward(self, answer: Array, label: Any, target: Array) -> Any:
        """As `Task.reward`."""
        return self.plant.identification_reward(answer - target)  # type: ignore[misc]


class Diagnosis(_Boxed):
    """`Box`: a score in [0, 1] for each label, of which the largest is the one that is meant, then the estimated quantity.

    The answer is (label, estimate). It is worth what the label is and what the estimate is, together.
    """

    name = "diagnosis"

    def __init__(self, plant: Plant, scaled: bool):
        super().__init__(plant, scaled)
        labels = len(plant.labels)
        low, high = np.array([(s.low, s.high) for s in plant.estimated], float).T
        self._bounded(np.r_[np.zeros(labels), low], np.r_[np.ones(labels), high])

    def check(self, action: Any, shape: tuple[int, ...]) -> Array:
        """As `Task.check`."""
        value, labels = self._physical(action, shape), len(self.plant.labels)
        return np.concatenate([value[..., :labels].argmax(axis=-1)[..., None], value[..., labels:]], axis=-1)

    def reward(self, answer: Array, label: Any, target: Array) -> Any:
        """As `Task.reward`."""
        said = answer[..., 0].astype(np.int64)
        of_label = self.plant.isolation_reward[label, said]  # type: ignore[index]
        return of_label + self.plant.identification_reward(answer[..., 1:] - target)  # type: ignore[misc]


class Scenario(_Boxed):
    """`Box`: for each fault mode in turn, whether the flight had it, its onset, its end and its size.

    The first is yes from 0.5 on; onset and end are shares of the flight; the size lies in the mode's reach. Each action is
    the declaration so far, and the last one of the episode counts: see `fdi_gym.declaration.worth`. The answer has a row
    (present, onset, end, size) for each mode; where a mode is a plane, a size for each of its directions.
    """

    name = "scenario"
    at_end = True

    def __init__(self, plant: Plant, scaled: bool):
        super().__init__(plant, scaled)
        self.rows = len(plant.modes), columns(plant)
        low, high = np.zeros(self.rows), np.ones(self.rows)
        low[:, SIZE:], high[:, SIZE:] = np.moveaxis(bounds(plant), 2, 0)
        self._bounded(low.ravel(), high.ravel())

    def check(self, action: Any, shape: tuple[int, ...]) -> Array:
        """As `Task.check`."""
        return self._physical(action, shape).reshape(*shape, *self.rows)

    def worth(self, answer: Array, truth: Array, length: Array) -> Array:
        """As `Task.worth`."""
        declared = answer.copy()
        declared[..., ONSET : END + 1] *= np.asarray(length)[..., None, None]
        return worth(self.plant, truth, declared)

    def action(self, declaration: Array, length: Array) -> Array:
        """The action that makes a declaration (n, modes, 4) of flights of these lengths (n,)."""
        value = declaration.astype(float)
        value[..., ONSET : END + 1] /= np.asarray(length)[..., None, None]
        low = self.low.reshape(self.rows)
        value[..., SIZE:] = np.where(value[..., PRESENT, None] >= 0.5, value[..., SIZE:], low[:, SIZE:])
        value = value.reshape(*value.shape[:-2], -1)
        if self.scaled:
            value = scaled(value, self.low, self.high).astype(np.float32)
        return value


TASKS: dict[str, type[Task]] = {task.name: task for task in (Isolation, Modes, Identification, Diagnosis, Scenario)}
