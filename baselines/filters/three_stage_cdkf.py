"""Three-stage central-difference Kalman filter: state, fault and gust in three stages.

Fault and gust are random walks; the propagation is at the full estimates with the spread of the decoupled state. The
algebra is in `fdi_gym.estimation.three_stage`, the propagation rules in `fdi_gym.estimation.propagation`.

Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021, Table 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from baselines.filters.flag_thresholds import thresholds_for
from fdi_gym.diagnosis import Diagnoser, NotApplicableError, diagnoser
from fdi_gym.estimation.flags import with_flags
from fdi_gym.estimation.propagation import Rule, central_difference_rule, extended_rule, fault_inputs, linear_output
from fdi_gym.estimation.three_stage import ThreeStage, start, step
from fdi_gym.plant import Array, Plant

RULES = {"central difference": central_difference_rule, "extended": extended_rule}
# Standard deviations of the initial state of the hovering helicopter: velocities, rates and attitude, flapping
X0_STD = (0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02, 0.005, 0.005)


def initial_covariance(plant: Plant, std: Sequence[float]) -> Array:
    """diag(std^2).

    Raises:
        NotApplicableError: Not one standard deviation per state of this plant.
    """
    if len(std) != len(plant.states):
        raise NotApplicableError(f"x0_std needs one entry per state of {plant.id} ({len(plant.states)}), not {len(std)}")
    return np.diag(np.square(std))


@diagnoser("three_stage_cdkf", "Three-stage central-difference Kalman filter (ThSCDKF)")
def three_stage_cdkf(
    plant: Plant,
    *,
    channels: Sequence[str] | None = None,
    x0_std: Sequence[float] = X0_STD,
    b0_std: float = 2e-3,
    d0_std: float = 0.5,
    b_step: float = 7e-4,
    d_step: float = 0.05,
    alpha: float = 0.2,
    thresholds: Sequence[float] | None = None,
    rule: str = "central difference",
) -> Diagnoser:
    """The optimal three-stage filter with the flag logic.

    Args:
        plant: A plant whose fault enters additively and whose sensors are linear.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        b0_std, d0_std: Of the initial fault [rad] and disturbance [m/s].
        b_step, d_step: Standard deviations of their random walks per step.
        alpha: Smoothing of the flag logic.
        thresholds: Of the flag logic, one per channel [rad]. Default: the calibrated table.
        rule: Propagation, "central difference" or "extended".

    Raises:
        NotApplicableError: The plant is not of that kind, or no thresholds are known for this configuration.
    """
    if rule not in RULES:
        raise ValueError(f"unknown rule {rule!r}; there are {', '.join(RULES)}")
    inputs, H = fault_inputs(plant, channels), linear_output(plant)
    P0x = initial_covariance(plant, x0_std)
    I_b, I_d = np.eye(len(inputs.names)), np.eye(len(plant.disturbances))
    Qb, Qd = b_step**2 * I_b, d_step**2 * I_d
    propagate: Rule = RULES[rule](plant, inputs)
    name = "three_stage_cdkf" if rule == "central difference" else "three_stage_ekf"

    def first(n: int) -> ThreeStage:
        return start(n, plant.trim_state, P0x, b0_std**2 * I_b, d0_std**2 * I_d)

    def advance(s: ThreeStage, t: float, u: Array, y: Array) -> ThreeStage:
        x, b, d = s.estimates()
        return step(s, propagate(t, x, s.Px, u, b, d), y, H, plant.Q, plant.R, Qb, Qd)

    def read(s: ThreeStage) -> tuple[Array, Array]:
        return s.estimates()[1], s.fault_covariance()

    J = thresholds_for(plant, name, inputs, thresholds)
    return with_flags(plant, inputs, first, advance, read, alpha=alpha, thresholds=J)
