"""Augmented-state central-difference Kalman filter (ASCDKF): state, fault and disturbance in one vector.

The reference that the three-stage filters decouple: the general augmented filter with the paper's tuning. Fault and
disturbance are random walks; sigma points are spread over the whole augmented vector. M. Norgaard, N. K. Poulsen, O. Ravn,
Automatica 36(11), 2000.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg

from baselines.filters.augmented_gaussian import Gaussian, gaussian_filter, reading_of
from baselines.filters.unknown_inputs import Known, decided, known_of
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.augmented import AugmentedModel
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading
from fdi_gym.plant import Plant


def augmented_model(plant: Plant, known: Known) -> AugmentedModel:
    """The augmented model of what is known: all disturbances, and no limit to the walks."""
    inputs, n_x, p, q = known.inputs, len(plant.states), len(known.P0b), len(known.P0d)
    N = n_x + p + q
    estimated = [plant.estimated[i] for i in inputs.estimated]
    return AugmentedModel(
        plant=plant, inputs=inputs, sensors=known.sensors, disturbances=np.arange(q), x=slice(0, n_x),
        z=slice(n_x, n_x + p), d=slice(n_x + p, N),
        scale=np.array([s.scale for s in (*plant.states, *estimated, *plant.disturbances)]),
        X0=np.concatenate([known.x0, np.zeros(p + q)]),
        P0=np.asarray(scipy.linalg.block_diag(known.P0, known.P0b, known.P0d)),
        Q=np.asarray(scipy.linalg.block_diag(known.Q, known.Qb, known.Qd)),
        R=known.R, limit=np.full(N, np.inf), H=np.hstack([known.H, np.zeros((len(known.H), p + q))]),
    )  # fmt: skip


@diagnoser("ascdkf", "Augmented central-difference Kalman filter (ASCDKF)")
def ascdkf(
    plant: Plant,
    belief: Belief,
    calibration: Calibration,
    *,
    channels: Sequence[str] | None = None,
    x0_std: Sequence[float] | None = None,
    b0_std: float | Sequence[float] | None = None,
    d0_std: float | Sequence[float] | None = None,
    b_step: float | Sequence[float] | None = None,
    d_step: float | Sequence[float] | None = None,
    alpha: float = 0.2,
    thresholds: Sequence[float] | None = None,
    decision: str | None = None,
) -> Diagnoser:
    """The augmented filter.

    Args:
        plant: A plant whose fault enters additively and whose sensors are linear.
        belief: What it assumes of the plant where no tuning is given.
        calibration: When it alarms.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        b0_std, d0_std: Of the initial fault and disturbance, in the data sheet's units; one, or one per entry.
        b_step, d_step: Standard deviations of their random walks per step, likewise.
        alpha, thresholds, decision: As in `baselines.filters.unknown_inputs.decided`.

    Raises:
        NotApplicableError: The plant is not of that kind.
        ValueError: Unknown decision, or a list of the wrong length.
    """
    given = {"x0_std": x0_std, "b0_std": b0_std, "d0_std": d0_std, "b_step": b_step, "d_step": d_step}
    known = known_of(plant, belief, channels, given)
    model = augmented_model(plant, known)

    def read(s: Gaussian) -> Reading:
        return reading_of(model, s)._replace(signals={"disturbance": s.X[:, model.d]})

    filter = gaussian_filter(model, "central difference", first_sample=False)._replace(read=read)
    return decided(plant, known.inputs, filter, calibration, decision=decision, alpha=alpha, thresholds=thresholds)
