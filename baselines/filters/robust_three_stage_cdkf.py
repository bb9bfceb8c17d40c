"""Robust three-stage central-difference Kalman filter.

No prior and no random walk for fault and gust: their estimates, one sample late, are unbiased whatever they do, and as
noisy as a difference of two measurements. See `fdi_gym.estimation.robust_three_stage`.

Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from baselines.filters.flag_thresholds import thresholds_for
from baselines.filters.three_stage_cdkf import RULES
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.propagation import Rule
from fdi_gym.estimation.robust_three_stage import RobustThreeStage, check_existence, start, step
from fdi_gym.estimation.unknown_inputs import judged, known_of
from fdi_gym.plant import Array, Plant


@diagnoser("robust_three_stage_cdkf", "Robust three-stage central-difference Kalman filter (RThSCDKF)")
def robust_three_stage_cdkf(
    plant: Plant,
    *,
    channels: Sequence[str] | None = None,
    x0_std: Sequence[float] | None = None,
    alpha: float = 0.06,
    thresholds: Sequence[float] | None = None,
    decision: str | None = None,
    process: str = "standard",
    rule: str = "central difference",
) -> Diagnoser:
    """The robust three-stage filter.

    Args:
        plant: A plant whose fault enters additively and whose sensors are linear.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        alpha: Smoothing of the flag logic.
        thresholds: Of the flag logic, one per channel. Default: the calibrated table, else calibrated when first used.
        decision: "flags" or "distance". Default: flags where they can tell the plant's labels apart.
        process: The fault process that will be met. x0_std None is what this process says; the helicopter
            brings its paper's (`Plant.tuning`).
        rule: Propagation, "central difference" or "extended".

    Raises:
        NotApplicableError: The existence conditions do not hold at trim (rank of H[B E], stability of (I - L H) A), or
            the plant is not of that kind.
        ValueError: Unknown rule, decision or process.
    """
    if rule not in RULES:
        raise ValueError(f"unknown rule {rule!r}; there are {', '.join(RULES)}")
    known = known_of(plant, channels, process, {"x0_std": x0_std}, ["x0_std"])
    inputs, sensors, H, x0, P0, Q, R, *_ = known
    check_existence(plant, inputs, H, R)
    p, q = len(inputs.names), len(plant.disturbances)
    unseen = np.diag([plant.estimated[i].scale ** 2 for i in inputs.estimated])
    propagate: Rule = RULES[rule](plant, inputs)
    name = "robust_three_stage_cdkf" if rule == "central difference" else "robust_three_stage_ekf"

    def first(n: int) -> RobustThreeStage:
        return start(n, x0, P0, p, q)._replace(cov_b=np.tile(unseen, (n, 1, 1)))  # before there is an estimate

    def advance(s: RobustThreeStage, t: float, u: Array, y: Array) -> RobustThreeStage:
        none = np.zeros((len(y), p)), np.zeros((len(y), q))
        return step(propagate(t, s.x, s.P, u, *none), y.take(sensors, axis=1), H, Q, R)

    def read(s: RobustThreeStage) -> tuple[Array, Array]:
        return s.b, s.cov_b

    return judged(
        plant, inputs, first, advance, read, decision=decision, process=process, alpha=alpha,
        thresholds=thresholds_for(plant, name, inputs, thresholds), source=__file__, what=f"{name} {channels} {x0_std}",
    )  # fmt: skip
