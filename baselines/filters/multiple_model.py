"""Interacting multiple models for any plant: one extended Kalman filter per label, with the modes' own lines.

`fdi_gym.estimation.multiple_model` has the algebra and its source. The probabilities are the bank's; the label is the one
whose probability beats the calibrated thresholds.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.alarm import Detector, Evidence
from fdi_gym.estimation.calibration import calibrated
from fdi_gym.estimation.multiple_model import Models, advance, bank, deviation, start
from fdi_gym.plant import Array, Plant


@diagnoser("multiple_model_ekf", "Interacting multiple models, one extended Kalman filter per label, for any plant")
def multiple_model_ekf(plant: Plant, *, process: str = "standard") -> Diagnoser:
    """The bank with its decision.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        process: The fault process that will be met; its declaration gives the magnitudes, how often labels change, model
            errors and thresholds.

    Raises:
        NotApplicableError: No sensor has noise, or the fault does not enter additively.
        ValueError: Unknown process.
    """
    models = bank(plant, process)
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)

    def step(s: Models, obs: Array) -> tuple[Models, Evidence]:
        s = advance(models, s, obs)
        z = deviation(models, s)
        mean = (s.mu[..., None] * z).sum(axis=1)
        variance = (s.mu[..., None] * (z - mean[:, None]) ** 2).sum(axis=1)
        return s, Evidence(-2.0 * np.log(s.mu), healthy + mean, np.sqrt(variance), s.mu)

    return calibrated(
        plant, Detector(lambda n: start(models, n), step), process=process, source=__file__, what="multiple model ekf"
    )
