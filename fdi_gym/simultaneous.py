"""Faults at once: any set of a plant's modes, without a label for each.

    plant = load_plant("B747Lateral", simultaneous=True, sensor_faults=True)

A label says one set of modes. With n modes there are 2^n sets, and a plant declares labels for few of them. Where any may
act, the truth is the set itself: `plant.modes_of(label)` (..., modes). Sets that have a label keep its number; the number
of others is that of the labels plus the sum of 2^i over their modes, which no label has. The task is "modes".
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from fdi_gym.faults import Fault, FaultProcess, FaultScenario
from fdi_gym.model import Array
from fdi_gym.plant import Plant

MOST = 3  # faults of a drawn flight
MODES = 60  # so many at most, since a set is a number


class _Several(NamedTuple):
    """Draws standard flights with up to three faults, none of which owns an entry of theta that another has."""

    plant: Plant

    def __call__(self, rng: np.random.Generator) -> FaultScenario:
        source = self.plant.processes["mixed" if self.plant.bare is not None else "standard"]
        scenario = source.sample(rng)
        if not scenario.faults:
            return scenario
        wanted, faults = 1 + int(rng.integers(MOST)), list(scenario.faults)
        for _ in range(10 * wanted):
            if len(faults) >= wanted:
                break
            for fault in source.sample(rng).faults:
                if len(faults) < wanted and _fits(faults, fault):
                    faults.append(fault)
        return scenario.replace(faults=faults)


def _fits(faults: list[Fault], fault: Fault) -> bool:
    modes = {f.mode for f in faults}
    entries = {effect.entry for f in faults for effect in f.effects}
    return fault.mode not in modes and not entries & {effect.entry for effect in fault.effects}


def with_simultaneous(plant: Plant) -> Plant:
    """The plant whose modes may act in any set, with a process "simultaneous" that draws up to three.

    Raises:
        ValueError: It has too many modes, a process of that name, or faults that no method is told of.
    """
    if plant.unseen:
        raise ValueError(f"{plant.id}: unseen faults are one at a time: not simultaneous")
    if len(plant.modes) > MODES:
        raise ValueError(f"{plant.id} has {len(plant.modes)} modes; of at most {MODES} any set may act")
    if "simultaneous" in plant.processes:
        raise ValueError(f"{plant.id} has a process 'simultaneous' of its own")
    standard = plant.processes["standard"]
    found = FaultProcess(
        name="simultaneous", description=f"the standard flights with up to {MOST} faults at once", sample=_Several(plant),
        initial=standard.initial, scoring=standard.scoring,
    )  # fmt: skip
    return dataclasses.replace(plant, simultaneous=True, processes={**plant.processes, found.name: found})


class Scores(NamedTuple):
    """How well sets of modes are told, over the samples that count."""

    exact: float  # share of them at which the whole set is right
    precision: Array  # (modes,) NaN for a mode that is never told
    recall: Array  # (modes,) NaN for one that never acts
    f1: Array  # (modes,) 0 where one of the two is; NaN where it neither acts nor is told
    decisions: float  # share of flights whose set at the last sample is right


def told(plant: Plant, label: Array, signals: dict[str, Array] | None) -> Array:
    """The set of modes (..., modes) that a diagnoser tells: its signal "modes" where it has one, else that of its label."""
    if signals and "modes" in signals:
        return np.asarray(signals["modes"]) > 0.5
    return plant.modes_of(np.maximum(label, 0))


def scores(plant: Plant, truth: Array, length: Array, sets: Array, start: int = 1, grace: int = 0) -> Scores:
    """Compare sets of modes with the truth.

    Args:
        plant: The plant.
        truth: True labels (N, K + 1).
        length: Last samples (N,).
        sets: What was told (N, K + 1, modes), bool.
        start, grace: As in `fdi_gym.faults.Scoring`.
    """
    samples = np.arange(truth.shape[1])
    counts = (samples >= start) & (samples <= length[:, None])
    changed = np.zeros(truth.shape, bool)
    changed[:, 1:] = truth[:, 1:] != truth[:, :-1]
    for k in range(grace):
        counts[:, k:] &= ~changed[:, : truth.shape[1] - k]
    true = plant.modes_of(truth)
    right = (true == sets).all(axis=2)
    a, b = true[counts], sets[counts]
    with np.errstate(invalid="ignore", divide="ignore"):
        both, acts, says = (a & b).sum(axis=0), a.sum(axis=0), b.sum(axis=0)
        precision, recall, f1 = both / says, both / acts, 2 * both / (acts + says)
    rows = np.arange(len(truth))
    return Scores(float(right[counts].mean()), precision, recall, f1, float(right[rows, length].mean()))
