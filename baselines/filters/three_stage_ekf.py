"""Three-stage extended Kalman filter: the algebra of the central-difference filter with the EKF's propagation rule.

The mean goes through the plant, the spread through its Jacobian. Tuning and errors are those of `three_stage_cdkf`.

Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021: the counterpart of their simulations.
"""

from __future__ import annotations

import functools
from typing import Any

from baselines.filters.three_stage_cdkf import three_stage_cdkf
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.plant import Plant


@diagnoser("three_stage_ekf", "Three-stage extended Kalman filter (ThSEKF)")
@functools.wraps(three_stage_cdkf, assigned=())
def three_stage_ekf(plant: Plant, **tuning: Any) -> Diagnoser:
    """The filter with the flag logic; tuning as of `three_stage_cdkf`."""
    return three_stage_cdkf(plant, **{"rule": "extended", **tuning})
