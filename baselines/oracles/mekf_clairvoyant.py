"""The multiplicative extended Kalman filter told when the effectiveness changes: resets exactly then, and no detector."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from baselines.filters.attitude import require_attitude
from baselines.filters.effectiveness import Q_THETA, THRESHOLD, threshold_rule
from baselines.filters.mekf import mekf_filter
from fdi_gym.diagnosis import Diagnoser, diagnoser, diagnoser_of
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant


def changes(plant: Plant, scenarios: Sequence[FaultScenario]) -> Array:
    """Where f changes (episodes, samples): row k is set where the f held from sample k on is not that held before."""
    found = np.zeros((len(scenarios), 1 + max(s.steps for s in scenarios)), bool)
    for i, scenario in enumerate(scenarios):
        a = plant.theta_table(scenario).a
        found[i, : len(a)] = (np.diff(a, axis=0, prepend=plant.nominal_theta[None]) != 0).any(axis=1)
    return found


@diagnoser(
    "mekf_clairvoyant",
    "The same filter, told when the effectiveness changes",
    knows="when the effectiveness changes",
)
def mekf_clairvoyant(
    plant: Plant, *, scenarios: Sequence[FaultScenario], q_theta: float = Q_THETA, threshold: float = THRESHOLD
) -> Diagnoser:
    """The multiplicative filter with resets exactly at the changes of f, which it is told (when, not what).

    Args:
        plant: The satellite.
        scenarios: One per episode, in the order of the batch.
        q_theta, threshold: As in `mekf`.

    Raises:
        NotApplicableError: The plant has no attitude.
    """
    require_attitude(plant)
    filter = mekf_filter(plant, changes(plant, scenarios), q_theta=q_theta)
    return diagnoser_of(plant, filter, threshold_rule(plant, threshold))
