"""Robust three-stage extended Kalman filter: the algebra of the central-difference filter with the EKF's propagation rule.

The mean goes through the plant, the spread through its Jacobian. Tuning and errors are those of `robust_three_stage_cdkf`.

Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021: the counterpart of their simulations.
"""

from __future__ import annotations

import functools
from typing import Any

from baselines.filters.robust_three_stage_cdkf import robust_three_stage_cdkf
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.plant import Plant


@diagnoser("robust_three_stage_ekf", "Robust three-stage extended Kalman filter (RThSEKF)")
@functools.wraps(robust_three_stage_cdkf, assigned=())
def robust_three_stage_ekf(plant: Plant, **tuning: Any) -> Diagnoser:
    """The filter with the flag logic; tuning as of `robust_three_stage_cdkf`."""
    return robust_three_stage_cdkf(plant, **{"rule": "extended", **tuning})
