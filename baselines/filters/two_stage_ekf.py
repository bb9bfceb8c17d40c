"""Two-stage extended Kalman filter for any plant: the sensitivity of the state to the fault, linearised at every sample.

The same numbers as `augmented_ekf`, in two smaller covariances. `fdi_gym.estimation.two_stage` has the algebra.
"""

from __future__ import annotations

from collections.abc import Sequence

from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.alarm import Estimate, FaultFilter
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.calibration import calibrated_filter
from fdi_gym.estimation.two_stage import TwoStage, advance, start
from fdi_gym.plant import Array, Plant


@diagnoser("two_stage_ekf", "Two-stage extended Kalman filter, for any plant")
def two_stage_ekf(
    plant: Plant,
    *,
    decision: str = "distance",
    process: str = "standard",
    walk: float = 1.0,
    x0_std: Sequence[float] | None = None,
    z0_std: Sequence[float] | None = None,
    z_walk: Sequence[float] | None = None,
    first_sample: bool = True,
) -> Diagnoser:
    """The two-stage filter; arguments and errors as of `augmented_ekf`."""
    model = augmented(plant, process, walk=walk, x0_std=x0_std, z0_std=z0_std, z_walk=z_walk)

    def step(s: TwoStage, obs: Array) -> TwoStage:
        return advance(model, s, obs, first_sample)

    what = f"two stage {walk} {x0_std} {z0_std} {z_walk} {first_sample}"
    filter = FaultFilter(lambda n: start(model, n), step, lambda s: Estimate(s.z, s.Pz, s.nu, s.S))
    return calibrated_filter(plant, filter, decision, model.prior.z_size, process=process, source=__file__, what=what)
