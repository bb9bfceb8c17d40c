"""Bank of augmented extended Kalman filters, decided by forgetting likelihood ratios.

Six hypotheses run side by side (none and the five labels), each estimating its own fault parameter and the errors of
the moment coefficients. The log-likelihood ratio of each fault against none, with exponential forgetting, is compared
with a threshold; a run of exceedances raises the alarm, the largest ratio names the fault. The bank is D. T. Magill,
IEEE TAC 10(4), 1965; for likelihood ratios on innovations see A. S. Willsky, Automatica 12(6), 1976."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from fdi_gym.estimation.missile_ekf import Filters

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation import missile_ekf as ekf
from fdi_gym.estimation import missile_model as model
from fdi_gym.plant import Array, Plant


class Ratios(NamedTuple):
    """Decision state."""

    J: Array  # (n, 6) forgetting log-likelihoods
    over: Array  # (n,) consecutive samples with the best ratio over the threshold
    under: Array  # (n,) consecutive samples with the best ratio under the release level
    candidate: Array  # (n,) best label at the last "over" sample
    alarm: Array  # (n,) bool

    @property
    def llr(self) -> Array:
        """Log-likelihood ratios of labels 1..5 against none (n, 5)."""
        return self.J[:, 1:] - self.J[:, :1]


def decide(
    before: Ratios, log_likelihood: Array, forgetting: float, threshold: float, alarm_after: int,
    release: float | None, release_after: int,
) -> Ratios:  # fmt: skip
    """The ratios and the decision one sample later; `release` None latches the alarm."""
    J = forgetting * before.J + log_likelihood
    llr = J[:, 1:] - J[:, :1]
    best, largest = 1 + np.argmax(llr, axis=1), llr.max(axis=1)
    exceeds = largest > threshold
    over = np.where(exceeds, before.over + 1, 0)
    candidate = np.where(exceeds, best, before.candidate)
    alarm = before.alarm | (over >= alarm_after)
    under = before.under
    if release is not None:
        under = np.where(largest < release, under + 1, 0)
        alarm = alarm & (under < release_after)
    return Ratios(J, over, under, candidate, alarm)


@diagnoser("augmented_ekf_bank", "Augmented EKF bank, likelihood ratios, latched")
@diagnoser("augmented_ekf_bank_unlatched", "Augmented EKF bank, likelihood ratios with release",
           forgetting=0.98, threshold=30.0, release=15.0)  # fmt: skip
def augmented_ekf_bank(
    plant: Plant, *, forgetting: float = 0.995, threshold: float = 8.0, alarm_after: int = 5,
    release: float | None = None, release_after: int = 10,
) -> Diagnoser:  # fmt: skip
    """The filter bank with its decision.

    Args:
        plant: The missile.
        forgetting: Factor per sample on the accumulated log-likelihoods.
        threshold: Of the largest ratio.
        alarm_after: Consecutive samples over the threshold that raise the alarm.
        release: Level of the largest ratio below which the alarm is released; None keeps it for good.
        release_after: Consecutive samples below it.

    Raises:
        NotApplicableError: Another plant, or one without sensor noise.
    """
    model.require_missile(plant, "the augmented filter bank", noisy=True)
    R = plant.R[:2, :2]

    def init(n: int) -> tuple[Filters, Ratios]:
        count = np.zeros(n, np.int64)
        return ekf.start(n), Ratios(np.zeros((n, 6)), count, count, count, np.zeros(n, bool))

    def update(state: tuple[Filters, Ratios], obs: Array) -> tuple[tuple[Filters, Ratios], Diagnosis]:
        filters, ratios = state
        sample = model.read(plant, obs)
        filters = ekf.update(ekf.predict_or_begin(filters, sample, ekf.at_first_sample(sample, R)), R)
        ratios = decide(ratios, filters.log_likelihood, forgetting, threshold, alarm_after, release, release_after)
        mode = np.where(ratios.alarm, ratios.candidate, 0)
        return (filters, ratios), Diagnosis(ratios.alarm, mode, *ekf.declared_theta(filters, mode))

    return Diagnoser(init, update)
