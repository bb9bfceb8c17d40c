"""Ceiling of the three tanks: a bank that is told when each fault acts and its course, neither which it is nor how large.

Leaks and plugs grow slowly there, and come and go: a bank that is told the onset alone expects magnitudes that stay, and
is beaten. Told the course, how large a fault is at each sample as a share of its largest size, each hypothesis has one
constant unknown, its magnitude, with the process's prior; the label is the one whose likelihood is the largest. It
linearises and its priors are Gaussian: a good reference, not a strict bound. On plants whose own parameters or
disturbances weigh more than the faults' courses it is none, so it is not offered there.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from baselines.oracles.told_onset_bank import rows, told_bank
from fdi_gym.diagnosis import Diagnoser, NotApplicableError, diagnoser
from fdi_gym.estimation.belief import Belief
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant


def courses(plant: Plant, scenarios: Sequence[FaultScenario]) -> Array:
    """How large the fault of each interval is, as a share of its largest size between two changes of the label.

    The deviation of theta at the interval's end is projected on the largest one; a jam is whole from its onset on.

    Args:
        plant: The plant.
        scenarios: n of them.

    Returns:
        (n, K + 1): sample k has that of [k - 1, k); 1 where nothing acts.
    """
    found = np.ones((len(scenarios), 1 + max((scenario.steps for scenario in scenarios), default=0)))
    scale = np.array([s.scale for s in plant.theta])
    for row, scenario in zip(found, scenarios, strict=True):
        table = plant.theta_table(scenario)
        grows = np.where(table.g < 0, plant.dt, np.exp(-np.maximum(table.g, 0.0) * plant.dt))
        deviation = (table.a + table.b * grows - plant.nominal_theta) / scale
        changes = [*plant.label_changes(scenario), (scenario.steps + 1, 0)]
        for (first, label), (after, _) in itertools.pairwise(changes):
            window = deviation[first - 1 : after - 1]
            jammed = ((table.holds[:, 1] < after - 1) & (table.holds[:, 2] > first - 1)).any()
            if label and not jammed and window.any():
                largest = window[np.argmax((window**2).sum(axis=1))]
                row[first:after] = window @ largest / (largest @ largest)
    return found


@diagnoser(
    "known_course_oracle",
    "Extended Kalman filters, one per hypothesis, told when faults act and their course; for the three tanks",
    knows="when each fault acts and the course of its size",
    ceiling=True,
)
def known_course_oracle(plant: Plant, belief: Belief, *, scenarios: Sequence[FaultScenario]) -> Diagnoser:
    """The oracle.

    Args:
        plant: The three tanks.
        belief: What it may assume of them.
        scenarios: One per episode; times of the label's changes and the shape of the faults are all that is read of them.

    Raises:
        NotApplicableError: Another plant.
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    if plant.id != "ThreeTank":
        raise NotApplicableError("it is a ceiling for the three tanks only; other plants have told_onset_bank")
    r = rows(plant, belief)
    Q = r.model.Q.copy()
    Q[:, r.model.z, r.model.z] = 0.0  # magnitudes stay
    return told_bank(plant, r._replace(model=r.model.replace(Q=Q)), scenarios, courses(plant, scenarios))
