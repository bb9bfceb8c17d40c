"""Trainers by name, as `fdi-gym train` finds them: in the modules where diagnosers are found.

A trainer is a function `train(plant_id, *, budget, seed, work, threads) -> path of the weights`, marked
`@trainer("name", "summary")`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from fdi_gym.diagnosis import diagnosers
from fdi_gym.names import blamed, check_diagnoser_name, find_function, unknown


class Trainer(NamedTuple):
    """A way to train a diagnoser."""

    name: str
    summary: str
    train: Callable[..., Path]


_trainers: dict[str, Trainer] = {}


def trainer(name: str, summary: str) -> Callable[[Any], Any]:
    """Make a training function known under a name."""

    def register(train: Callable[..., Path]) -> Callable[..., Path]:
        _trainers[name] = Trainer(name, summary, train)
        return train

    return register


def trainers() -> dict[str, Trainer]:
    """All trainers by name."""
    diagnosers()  # imports the modules in which they are
    return dict(_trainers)


def find_trainer(name: str) -> Trainer:
    """The trainer of this name; "module:function" names one that is not discovered.

    Raises:
        ValueError: There is none; the message lists those that exist.
    """
    if ":" in name:
        return Trainer(name, name, find_function("trainer", check_diagnoser_name(name)))
    found = trainers()
    if name not in found:
        raise unknown("trainer", name, found)
    return found[name]


def train(method: str, plant_id: str, *, budget: int | None, seed: int, work: Path, threads: int) -> Path:
    """Train a diagnoser for a plant; the path of its weights.

    Args:
        method: As in `find_trainer`.
        plant_id: The plant.
        budget: How much to train, in the trainer's own measure; None for its recipe's.
        seed: Of the run.
        work: Folder of runs.
        threads: Of torch.

    Raises:
        ValueError: Unknown trainer, a number out of range, or the trainer fails; it is named.
    """
    for what, value, least in (("budget", budget, 1), ("seed", seed, 0), ("threads", threads, 1)):
        if value is not None and value < least:
            raise ValueError(f"{what} is {least} or more, not {value}")
    found = find_trainer(method)
    with blamed(method):
        path = found.train(plant_id, budget=budget, seed=seed, work=work, threads=threads)
    if not isinstance(path, Path) or not path.with_suffix(".safetensors").is_file():
        raise ValueError(f"{method} gives {path!r}, not the path of weights")
    return path
