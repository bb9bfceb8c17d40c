"""Faults that no method was told of: one label more, "something else", and a process that draws them.

    plant = load_plant("B747Lateral", unseen=True)

The process "unseen" draws the standard flights; half of the faulty ones have in place of the plant's own fault one of a
sensor (`fdi_gym.sensors`), whichever and of whatever kind: their label is "something else". Every method gets the plant
without, and what it knows is that of the process "standard". Who answers "something else" is told that there is such an
answer, and nothing of what it may be.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np

from fdi_gym.data_sheet import FaultMode, Label
from fdi_gym.faults import FaultScenario
from fdi_gym.model import Array
from fdi_gym.plant import Plant
from fdi_gym.sensors import BANDS, sensor_processes, with_sensor_faults

SOMETHING_ELSE = "something else"
SHARE = "mixed"  # the process of a plant with failing sensors whose faults are drawn: half of them are a sensor's


class _Worst(NamedTuple):
    """The size of the worst of several faults."""

    sizes: tuple[Callable[[Array], Array], ...]

    def __call__(self, theta: Array) -> Array:
        return np.max([size(theta) for size in self.sizes], axis=0)


class _Unnamed(NamedTuple):
    """Draws what another draws; modes that have no name of their own are something else."""

    sample: Callable[[np.random.Generator], FaultScenario]
    named: frozenset[str]

    def __call__(self, rng: np.random.Generator) -> FaultScenario:
        scenario = self.sample(rng)
        faults = [f if f.mode in self.named else msgspec.structs.replace(f, mode=SOMETHING_ELSE) for f in scenario.faults]
        return scenario.replace(faults=faults)


def with_unseen(plant: Plant) -> Plant:
    """The plant with faults that nobody is told of.

    Raises:
        ValueError: Its sensors are known to fail, or any of its faults may act at once.
    """
    if plant.bare is not None or plant.simultaneous:
        raise ValueError(f"{plant.id}: unseen faults are a sensor's, one at a time: no sensor_faults or simultaneous beside")
    layered, own = with_sensor_faults(plant), len(plant.modes)
    sensors = layered.modes[own:]
    mode = FaultMode(
        SOMETHING_ELSE, "a sensor's fault that no method was told of", _Worst(tuple(m.size for m in sensors)), BANDS,
        sensors[0].offset, tuple(m.direction for m in sensors), tuple(m.reach for m in sensors),  # type: ignore[arg-type]
    )  # fmt: skip
    count = len(plant.labels)
    reward = np.eye(count + 1)
    reward[:count, :count] = plant.isolation_reward
    drawn = next(p for p in sensor_processes(plant) if p.name == SHARE)
    process = dataclasses.replace(
        drawn, name="unseen", description="the standard flights, half of the faulty ones with a fault nobody was told of",
        sample=_Unnamed(drawn.sample, frozenset(plant.mode_names)),
    )  # fmt: skip
    return dataclasses.replace(
        layered, modes=(*layered.modes[:own], mode), isolation_reward=reward, unseen=True,
        labels=(*plant.labels, Label(SOMETHING_ELSE, frozenset({SOMETHING_ELSE}))),
        processes={**plant.processes, process.name: process},
    )  # fmt: skip
