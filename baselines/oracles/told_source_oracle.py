"""A ceiling where sensors may fail, of a plant that has one: told when the label changes, and whether a sensor fails.

Which sensor it is, the bank of `told_onset_bank` says among the sensors' labels. Which of the plant's own faults it is, the
plant's own ceiling says, which knows when they act and marginalises what else is unknown of that plant. What is lost is what
nobody can tell apart there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from baselines.oracles.cramer_rao_oracle import cramer_rao_oracle
from baselines.oracles.known_onset_oracle import known_onset_oracle
from baselines.oracles.matched_oracle import matched_oracle
from baselines.oracles.told_onset_bank import rows, told_bank
from baselines.oracles.told_onset_ekf import true_labels
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.diagnosis.contract import widened
from fdi_gym.estimation.belief import Belief
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, NotApplicableError, Plant

CEILINGS: tuple[Callable[..., Diagnoser], ...] = (matched_oracle, known_onset_oracle, cramer_rao_oracle)


class Told(NamedTuple):
    """State: the two oracles, and the truth that each episode carries."""

    bank: Any
    own: Any
    label: Array  # (n, K + 1) the true one; whether there is a fault, and whether a sensor's, is all that is read of it
    k: Array  # (n,)


def even(plant: Plant, belief: Belief) -> Belief:
    """The belief, with each magnitude of the plant's own modes anywhere in its reach and walks alike in shares of that.

    The flights that a belief is found from show a mode that is rare once or never, and half of the faults are sensors'.
    """
    own = slice(0, plant.n_magnitudes if plant.bare is None else plant.bare.n_magnitudes)
    low, high = plant.reaches[own].T
    span = np.where(high > low, high - low, 1.0)
    mean, std, walk = belief.m_mean.copy(), belief.m_std.copy(), belief.m_walk.copy()
    mean[own], std[own] = (low + high) / 2, (high - low) / 12**0.5
    walk[own] = np.median(walk[own] / span) * span
    return msgspec.structs.replace(belief, m_mean=mean, m_std=std, m_walk=walk)


def own_ceiling(plant: Plant, scenarios: Sequence[FaultScenario]) -> Diagnoser:
    """The ceiling of a plant whose sensors do not fail.

    Raises:
        NotApplicableError: It has none.
    """
    modes = set(plant.mode_names)
    own = [s.replace(faults=[f for f in s.faults if f.mode in modes]) for s in scenarios]
    for make in CEILINGS:
        try:
            return make(plant, scenarios=own)
        except NotApplicableError:
            continue
    raise NotApplicableError(
        f"{plant.id} has no ceiling of its own; where its faults do not overlap it has told_events_oracle"
    )


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
        NotApplicableError: Its sensors never fail, it has no ceiling of its own, or the bank cannot run on it.
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    if plant.bare is None:
        raise NotApplicableError(f"no label of {plant.id} is a sensor's fault; with the option sensor_faults there are")
    labels, of_plant = len(plant.labels), len(plant.bare.labels)
    label = true_labels(plant, scenarios)
    own = widened(own_ceiling(plant.bare, scenarios), plant.bare, plant)
    allowed = (label >= of_plant)[..., None] & (np.arange(labels) >= of_plant)
    hypotheses = told_bank(plant, rows(plant, even(plant, belief)), scenarios, allowed=allowed)

    def start(n: int) -> Told:
        return Told(hypotheses.init(n), own.init(n), label, np.zeros(n, np.int64))

    def update(s: Told, obs: Array) -> tuple[Told, Diagnosis]:
        first, a = hypotheses.update(s.bank, obs)
        second, b = own.update(s.own, obs)
        now = s.label[np.arange(len(s.k)), np.minimum(s.k, s.label.shape[1] - 1)]
        told, acts = now >= of_plant, now > 0
        estimate = None
        if a.estimate is not None and b.estimate is not None:
            estimate = np.where(acts[:, None], np.where(told[:, None], a.estimate, b.estimate), plant.healthy)
        return Told(first, second, s.label, s.k + 1), Diagnosis(acts, np.where(told, a.label, b.label) * acts, estimate)

    return Diagnoser(start, update, hypotheses.gaps and own.gaps)
