"""Augmented (joint) Kalman filters for any plant: extended, unscented and central-difference, with any decision logic.

State, fault vector and unknown disturbances are one Gaussian vector; faults and disturbances are random walks. Nothing
but the plant's declaration is needed: noises from its data sheet, walks and model errors from its fault process. On a
linear plant the three are the Kalman filter.

`fdi_gym.estimation.gaussian` has the filters and their sources, `fdi_gym.estimation.alarm` the decision logics.
"""

from __future__ import annotations

from collections.abc import Sequence

from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.alarm import Estimate, FaultFilter
from fdi_gym.estimation.augmented import Augmented, augmented
from fdi_gym.estimation.calibration import calibrated_filter
from fdi_gym.estimation.gaussian import RULES, Gaussian, advance, start
from fdi_gym.plant import Array, Plant


def estimate_of(model: Augmented, s: Gaussian) -> Estimate:
    """What the filter knows of the fault vector."""
    return Estimate(s.X[:, model.z], s.P[:, model.z, model.z], s.nu, s.S)


@diagnoser("augmented_ekf", "Augmented extended Kalman filter, for any plant")
@diagnoser("augmented_ukf", "Augmented unscented Kalman filter, for any plant", rule="unscented")
@diagnoser("augmented_cdkf", "Augmented central-difference Kalman filter, for any plant", rule="central difference")
@diagnoser("augmented_ekf_thresholds", "The augmented EKF, fixed thresholds on the estimate", decision="thresholds")
@diagnoser("augmented_ekf_chi_square", "The augmented EKF, alarms by a chi-square test of its innovations",
           decision="chi-square")  # fmt: skip
@diagnoser("augmented_ekf_cusum", "The augmented EKF, alarms by a CUSUM of its innovations", decision="cusum")
@diagnoser("augmented_ekf_glr", "The augmented EKF, alarms by a GLR test of its innovations", decision="glr")
def augmented_ekf(
    plant: Plant,
    *,
    rule: str = "extended",
    decision: str = "distance",
    process: str = "standard",
    walk: float = 1.0,
    x0_std: Sequence[float] | None = None,
    z0_std: Sequence[float] | None = None,
    z_walk: Sequence[float] | None = None,
    first_sample: bool = True,
) -> Diagnoser:
    """The augmented filter.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        rule: How a Gaussian passes through the model: "extended", "unscented" or "central difference".
        decision: "distance", "thresholds", "chi-square", "cusum" or "glr".
        process: The fault process that will be met; its declaration gives walks, model errors and thresholds.
        walk, x0_std, z0_std, z_walk: As in `fdi_gym.estimation.augmented.augmented`.
        first_sample: Use the first sample as a measurement; without, the filter starts from its prior alone.

    Raises:
        NotApplicableError: No sensor has noise, or the fault does not enter additively.
        ValueError: Unknown rule, decision or process.
    """
    if rule not in RULES:
        raise ValueError(f"unknown rule {rule!r}; there are {', '.join(RULES)}")
    model = augmented(plant, process, walk=walk, x0_std=x0_std, z0_std=z0_std, z_walk=z_walk)

    def step(s: Gaussian, obs: Array) -> Gaussian:
        return advance(model, RULES[rule], s, obs, first_sample)

    what = f"augmented {rule} {walk} {x0_std} {z0_std} {z_walk} {first_sample}"
    filter = FaultFilter(lambda n: start(model, n), step, lambda s: estimate_of(model, s))
    return calibrated_filter(plant, filter, decision, model.prior.z_size, process=process, source=__file__, what=what)
