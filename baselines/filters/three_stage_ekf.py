"""Three-stage extended Kalman filter: the three-stage filter with the EKF's propagation.

Counterpart of the central-difference filter in Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021.
"""

from __future__ import annotations

from typing import Any

from baselines.filters.three_stage_cdkf import three_stage_cdkf
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.plant import Plant


@diagnoser("three_stage_ekf", "Three-stage extended Kalman filter (ThSEKF)")
def three_stage_ekf(plant: Plant, **tuning: Any) -> Diagnoser:
    """`three_stage_cdkf` with `rule="extended"`; all its other settings apply."""
    return three_stage_cdkf(plant, rule="extended", **tuning)
