"""Trainers by name, as `fdi-gym train` finds them: in the modules where diagnosers are found.

A trainer is a function `train(plant_id, *, budget, seed, work, threads) -> path of the weights`, marked
`@trainer("name", "summary")`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from fdi_gym.diagnosis import diagnosers


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
        module, function = name.split(":", 1)
        try:
            return Trainer(name, name, getattr(importlib.import_module(module), function))
        except (ImportError, AttributeError) as error:
            raise ValueError(f"no trainer {name!r}: {error}") from error
    found = trainers()
    if name not in found:
        raise ValueError(f"unknown trainer {name!r}; there are {', '.join(found) or 'none'}")
    return found[name]
