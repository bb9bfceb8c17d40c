"""A ceiling for any plant whose sensors may fail: told when the label changes, and whether it is a sensor that fails.

Which sensor it is, the bank of `told_onset_bank` says among the sensors' labels. Which of the plant's own faults it is, the
plant's own ceiling says, which knows when they act and marginalises what else is unknown of that plant; where it has none
the bank does, among the plant's labels. What is lost on a plant is then what nobody can tell apart there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from baselines.oracles.cramer_rao_oracle import cramer_rao_oracle
from baselines.oracles.innovation_oracle import innovation_oracle
from baselines.oracles.known_onset_oracle import known_onset_oracle
from baselines.oracles.matched_oracle import matched_oracle
from baselines.oracles.told_onset_bank import bank
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.diagnosis.contract import widened
from fdi_gym.estimation.belief import Belief
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, NotApplicableError, Plant

CEILINGS: tuple[Callable[..., Diagnoser], ...] = (innovation_oracle, matched_oracle, known_onset_oracle, cramer_rao_oracle)


class Told(NamedTuple):
    """State: the two oracles, and the truth that each episode carries."""

    bank: Any
    own: Any
    sensor: Array  # (n, K + 1) bool: a sensor failed over the interval that ends at a sample
    k: Array  # (n,)


def own_ceiling(plant: Plant, scenarios: Sequence[FaultScenario]) -> Diagnoser | None:
    """The ceiling of a plant whose sensors do not fail; None where it has none."""
    modes = set(plant.mode_names)
    own = [s.replace(faults=[f for f in s.faults if f.mode in modes]) for s in scenarios]
    for make in CEILINGS:
        try:
            return make(plant, scenarios=own)
        except NotApplicableError:
            continue
    return None


@diagnoser(
    "told_source_oracle",
    "Told when the label changes and whether a sensor fails: a bank for the sensors, the plant's own ceiling for the rest",
    knows="when the label changes, and whether it is a sensor that fails",
    ceiling=True,
)
def told_source_oracle(plant: Plant, belief: Belief, *, scenarios: Sequence[FaultScenario]) -> Diagnoser:
    """The oracle.

    Args:
        plant: A plant whose sensors may fail.
        belief: What it may assume of the plant.
        scenarios: One per episode; when the label changes, and whether it is a sensor's, is all that is read of them, beside
            what the plant's own ceiling reads of its faults.

    Raises:
        NotApplicableError: Its sensors never fail, or the bank cannot run on it.
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    if plant.bare is None:
        raise NotApplicableError(f"no label of {plant.id} is a sensor's fault; with the option sensor_faults there are")
    labels, of_plant = len(plant.labels), len(plant.bare.labels)
    sensor = np.zeros((len(scenarios), 1 + max(s.steps for s in scenarios)), bool)
    for row, scenario in zip(sensor, scenarios, strict=True):
        rows = plant.label_rows(scenario) >= of_plant
        row[: len(rows)], row[len(rows) :] = rows, rows[-1]
    hypotheses = bank(plant, belief, scenarios, sensor[..., None] == (np.arange(labels) >= of_plant))
    own = own_ceiling(plant.bare, scenarios)
    if own is None:
        return hypotheses
    own = widened(own, plant.bare, plant)

    def start(n: int) -> Told:
        return Told(hypotheses.init(n), own.init(n), sensor, np.zeros(n, np.int64))

    def update(s: Told, obs: Array) -> tuple[Told, Diagnosis]:
        first, a = hypotheses.update(s.bank, obs)
        second, b = own.update(s.own, obs)
        told = s.sensor[np.arange(len(s.k)), np.minimum(s.k, s.sensor.shape[1] - 1)]
        estimate = b.estimate if b.estimate is None else np.where(told[:, None], a.estimate, b.estimate)
        said = Diagnosis(np.where(told, a.alarm, b.alarm), np.where(told, a.label, b.label), estimate)
        return Told(first, second, s.sensor, s.k + 1), said

    return Diagnoser(start, update, hypotheses.gaps and own.gaps)
