"""Robust three-stage central-difference Kalman filter.

No prior and no random walk for fault and gust: their estimates, one sample late, are unbiased whatever they do, and as
noisy as a difference of two measurements. See `fdi_gym.estimation.robust_three_stage`.

Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from baselines.filters.flag_thresholds import thresholds_for
from baselines.filters.three_stage_cdkf import RULES, X0_STD, initial_covariance
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.flags import with_flags
from fdi_gym.estimation.propagation import Rule, fault_inputs, linear_output
from fdi_gym.estimation.robust_three_stage import RobustThreeStage, check_existence, start, step
from fdi_gym.plant import Array, Plant


@diagnoser("robust_three_stage_cdkf", "Robust three-stage central-difference Kalman filter (RThSCDKF)")
def robust_three_stage_cdkf(
    plant: Plant,
    *,
    channels: Sequence[str] | None = None,
    x0_std: Sequence[float] = X0_STD,
    alpha: float = 0.06,
    thresholds: Sequence[float] | None = None,
    rule: str = "central difference",
) -> Diagnoser:
    """The robust three-stage filter with the flag logic.

    Args:
        plant: A plant whose fault enters additively and whose sensors are linear.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        alpha: Smoothing of the flag logic.
        thresholds: Of the flag logic, one per channel [rad]. Default: the calibrated table.
        rule: Propagation, "central difference" or "extended".

    Raises:
        NotApplicableError: The existence conditions do not hold at trim (rank of H[B E], stability of (I - L H) A), the
            plant is not of that kind, or no thresholds are known for this configuration.
    """
    if rule not in RULES:
        raise ValueError(f"unknown rule {rule!r}; there are {', '.join(RULES)}")
    inputs, H = fault_inputs(plant, channels), linear_output(plant)
    P0x = initial_covariance(plant, x0_std)
    check_existence(plant, inputs, H)
    p, q = len(inputs.names), len(plant.disturbances)
    propagate: Rule = RULES[rule](plant, inputs)
    name = "robust_three_stage_cdkf" if rule == "central difference" else "robust_three_stage_ekf"

    def first(n: int) -> RobustThreeStage:
        return start(n, plant.trim_state, P0x, p, q)

    def advance(s: RobustThreeStage, t: float, u: Array, y: Array) -> RobustThreeStage:
        none = np.zeros((len(y), p)), np.zeros((len(y), q))
        return step(propagate(t, s.x, s.P, u, *none), y, H, plant.Q, plant.R)

    def read(s: RobustThreeStage) -> tuple[Array, Array]:
        return s.b, s.cov_b

    J = thresholds_for(plant, name, inputs, thresholds)
    return with_flags(plant, inputs, first, advance, read, alpha=alpha, thresholds=J)
