"""GLR test of the innovations of a healthy extended Kalman filter, with the fault signatures that the model predicts.

`fdi_gym.estimation.glr` has the algebra and its source.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.alarm import Detector, Evidence
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.calibration import calibrated
from fdi_gym.estimation.decision import manifolds, nearest_of
from fdi_gym.estimation.glr import Ratio, Test, advance, secants, start
from fdi_gym.plant import Array, Plant


@diagnoser("glr_ekf", "GLR test with propagated fault signatures on a healthy extended Kalman filter, for any plant")
def glr_ekf(plant: Plant, *, process: str = "standard", onsets: int = 8, spacing: int = 20) -> Diagnoser:
    """The test with its decision.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        process: The fault process that will be met; its declaration gives fault sizes, model errors and thresholds.
        onsets: Onset times that are tried.
        spacing: Samples between them.

    Raises:
        NotApplicableError: No sensor has noise, or the fault does not enter additively.
        ValueError: Unknown process, or fewer than two onsets.
    """
    if onsets < 2 or spacing < 1:
        raise ValueError(f"at least 2 onsets, at least 1 sample apart, are allowed, not {onsets}, {spacing}")
    model = augmented(plant, process)
    test = Test(model, *secants(plant, model.prior.z_size), onsets, spacing)
    groups, labels = manifolds(plant), len(plant.labels)
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)

    def step(s: Ratio, obs: Array) -> tuple[Ratio, Evidence]:
        s = advance(test, s, obs)
        n, T, p = s.g.shape
        cost, theta = np.zeros((n, labels)), np.zeros((n, labels, p))
        for sets in groups:
            value, m = nearest_of(s.G.reshape(n * T, p, p), s.g.reshape(n * T, p), sets)
            h = len(sets.labels)
            value, m = value.reshape(n, T, h), m.reshape(n, T, h, -1)
            when = np.argmin(value, axis=1)  # (n, h)
            rows, columns = np.arange(n)[:, None], np.arange(h)
            cost[:, sets.labels] = value[rows, when, columns]
            best = m[rows, when, columns]  # (n, h, f)
            theta[:, sets.labels] = sets.offset + (sets.direction @ best[..., None])[..., 0]
        best = np.argmin(cost, axis=1)
        return s, Evidence(cost, healthy + theta[np.arange(n), best])

    what = f"glr ekf {onsets} {spacing}"
    return calibrated(plant, Detector(lambda n: start(test, n), step), process=process, source=__file__, what=what)
