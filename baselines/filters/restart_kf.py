"""Restart filter: a detector that forgets, and an estimator that starts afresh when it alarms.

The detector is the two-stage filter with exponential forgetting. At its alarm a second two-stage filter, without
forgetting, starts from the detector's state with a wide prior on the fault parameter; it then names and sizes the fault
with all data since the alarm.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines.filters.two_stage_kf import TwoStage, forget, prior, start, step
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation.decision import distance_logic, fit, manifolds
from fdi_gym.estimation.linear import linear_model
from fdi_gym.plant import Array, Plant


@diagnoser("restart_kf", "Two-stage filter with forgetting as detector, restarted without it at the alarm")
def restart_kf(
    plant: Plant, *, factor: float = 0.99, a_max: float = 1.0, threshold: float = 8.0, release_after: int = 100
) -> Diagnoser:
    """The restart filter.

    Args:
        plant: A linear plant.
        factor: Forgetting factor of the detector.
        a_max: Cap of its covariance's eigenvalues.
        threshold: Of its distance logic.
        release_after: Of its distance logic, samples.

    Raises:
        NotApplicableError: The plant is nonlinear.
    """
    model, groups = linear_model(plant), manifolds(plant)
    P_x, P_z = prior(plant)
    logic = distance_logic(plant, threshold=threshold, release_after=release_after)
    nominal = plant.nominal_theta

    def init(n: int) -> Any:
        filters = [start(n, len(plant.outputs), P_x, P_z) for _ in range(2)]
        return 0, *filters, logic.start(n), np.zeros(n, bool)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, detector, second, decided, alarm = state
        n = len(obs)
        if k == 0:
            return (1, *state[1:]), Diagnosis(alarm, np.zeros(n, np.int64), np.tile(nominal, (n, 1)))
        y, u, _ = plant.split(obs)
        Pz = forget(detector.Pz, "exponential", factor, 0.0, a_max)
        detector = step(detector, u, y, model, plant.Q, plant.R, Pz)
        second = step(second, u, y, model, plant.Q, plant.R, second.Pz)
        decided, said = logic.step(decided, k, detector.z, detector.Pz)
        rises = said.alarm & ~alarm
        if rises.any():
            fresh = start(n, len(plant.outputs), P_x, P_z)._replace(x=detector.state(), Px=detector.covariance())
            second = TwoStage(*(
                np.where(rises.reshape(-1, *[1] * (old.ndim - 1)), new, old)
                for new, old in zip(fresh, second, strict=True)
            ))  # fmt: skip
        fits = fit(second.z, second.Pz, groups)
        label = np.where(said.alarm, fits.labels[np.argmin(fits.J, axis=1)], 0)
        z = np.where(said.alarm[:, None], second.z, 0.0)
        return (k + 1, detector, second, decided, said.alarm), Diagnosis(said.alarm, label, nominal + z)

    return Diagnoser(init, update)
