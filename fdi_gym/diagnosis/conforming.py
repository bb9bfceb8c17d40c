"""Fitting of conformities: flights of each label that is known, and how unlike anything known they look to a method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fdi_gym.diagnosis.contract import Diagnoser, run
from fdi_gym.diagnosis.fitting import VALIDATION_SEED
from fdi_gym.diagnosis.registry import Entry
from fdi_gym.engine import simulate
from fdi_gym.estimation.conformity import Conformity
from fdi_gym.estimation.data import rounded
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plant import Array, Plant

FIRST = 200_000  # flights begin at VALIDATION_SEED + FIRST
EACH, MOST = 60, 20_000  # flights of each label, of at most so many that are drawn
BLOCK = 200  # that are flown together


def decisive(plant: Plant, scenario: FaultScenario) -> tuple[int, int]:
    """The sample at which a flight is decided, the last of its first fault or of the flight, and its label there."""
    label = plant.label_rows(scenario)
    if not label.any():
        return scenario.steps, 0
    first = int(np.flatnonzero(label)[0])
    ends = np.flatnonzero(label[first:] != label[first])
    return first + int(ends[0]) - 1 if ends.size else len(label) - 1, int(label[first])


def of_each_label(plant: Plant, process: str, first: int, each: int) -> list[FaultScenario]:
    """Flights of a process with the seeds from `first` on: so many of each label, where as many are met.

    The healthy ones are those that have no fault, or are drawn with theirs taken away.
    """
    kept: dict[int, list[FaultScenario]] = {i: [] for i in range(len(plant.labels))}
    for seed in range(first, first + MOST):
        scenario = draw(plant.process(process), seed)
        some = kept[decisive(plant, scenario)[1]]
        if len(some) < each:
            some.append(scenario)
        elif len(kept[0]) < each:
            kept[0].append(scenario.without_faults())
        if all(len(some) == each for some in kept.values()):
            break
    return [scenario for some in kept.values() for scenario in some]


def decided(
    diagnoser: Diagnoser, plant: Plant, scenarios: list[FaultScenario], score: str = "unlike"
) -> tuple[Array, Array, Array]:
    """Of flights where they are decided: the signal of a method that is its score (N,), the true label, and the one said.

    Without a name of the signal the score is NaN.
    """
    found, labels, says = [], [], []
    for i in range(0, len(scenarios), BLOCK):
        some = scenarios[i : i + BLOCK]
        said = run(diagnoser, simulate(plant, some).obs, signals=bool(score))
        when, label = np.array([decisive(plant, s) for s in some]).T
        rows = np.arange(len(some))
        found.append(said.signals[score][rows, when] if said.signals else np.full(len(some), np.nan))
        says.append(said.label[rows, when])
        labels.append(label)
    return np.concatenate(found), np.concatenate(labels), np.concatenate(says)


def fit_conformity(entry: Entry, plant: Plant, process: str, settings: Mapping[str, Any]) -> Conformity:
    """The scores of a method's flights of each label, on validation flights of the process.

    Args:
        entry: The method; its signal "unlike" is the score.
        plant: A plant with a label for faults that nobody is told of.
        process: One of those that are known.
        settings: What its builder gets.
    """
    assert plant.bare is not None
    known = plant.bare
    diagnoser = entry.build(plant, conformity=Conformity(), process=process, **settings)
    score, label, _ = decided(diagnoser, known, of_each_label(known, process, VALIDATION_SEED + FIRST, EACH))
    return Conformity(scores={
        known.labels[i].name: np.sort(rounded(score[label == i])).tolist() for i in np.unique(label)
    })  # fmt: skip
