"""Bank of augmented extended Kalman filters, decided by forgetting likelihood ratios.

Six hypotheses run side by side (none and the five labels), each estimating its own fault parameter and the errors of
the moment coefficients. The log-likelihood ratio of each fault against none, with exponential forgetting, is compared
with a threshold; a run of exceedances raises the alarm, the largest ratio names the fault. The bank is D. T. Magill,
IEEE TAC 10(4), 1965; for likelihood ratios on innovations see A. S. Willsky, Automatica 12(6), 1976."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters import missile_ekf as ekf
from baselines.filters import missile_model as model
from baselines.filters.missile_ekf import Filters
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.automaton import Automaton
from fdi_gym.estimation.calibration import Persistence
from fdi_gym.estimation.decision import Evidence, Reading, Rule, Verdict, declare, undeclared
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant


class Weighted(NamedTuple):
    """The filters and how well each has fitted."""

    filters: Filters
    J: Array  # (n, 6) forgetting log-likelihoods


def likelihood_ratios(threshold: float, release: float | None, after: Persistence) -> Rule:
    """The fault whose log-likelihood ratio against none is largest, as long as that was over the threshold.

    Given up when the largest is under `release`; None keeps the alarm for good.
    """
    floor = -np.inf if release is None else release

    def step(s: Automaton, k: Array, r: Reading, informed: Array) -> tuple[Automaton, Verdict]:
        assert r.cost is not None
        ratios = 0.5 * (r.cost[:, :1] - r.cost[:, 1:])
        largest = ratios.max(axis=1)
        over = largest > threshold
        best = np.where(over, 1 + np.argmax(ratios, axis=1), s.last)
        s = declare(s, best, over, largest < floor, after, informed)
        return s, Verdict(s.label > 0, s.label, evidence=Evidence(r.cost))

    return Rule(undeclared, step)


@diagnoser("augmented_ekf_bank", "Augmented EKF bank, likelihood ratios, latched", reference=True)
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

    def begin(s: Weighted, at: Interval, y: Array) -> Weighted:
        filters = ekf.begin(s.filters, at, y, R, ekf.SIGMA_THETA, ekf.SIGMA_RHO)
        return Weighted(filters, filters.log_likelihood)

    def predict(s: Weighted, at: Interval) -> Weighted:
        return s._replace(filters=ekf.predict(s.filters, at))

    def update(s: Weighted, at: Interval, y: Array, seen: Array) -> Weighted:
        filters = ekf.update(s.filters, y, seen, R)
        any_seen = seen[:, model.SENSORS].any(axis=1, keepdims=True)
        return Weighted(filters, np.where(any_seen, forgetting * s.J + filters.log_likelihood, s.J))

    def read(s: Weighted) -> Reading:
        best = np.eye(6)[np.argmax(s.J, axis=1)]
        found = ekf.reading(s.filters, best, -2.0 * s.J)
        return found._replace(signals={**(found.signals or {}), "log-likelihood ratios": s.J[:, 1:] - s.J[:, :1]})

    filter = Filter(lambda n: Weighted(ekf.start(n), np.zeros((n, 6))), predict, update, read, True, begin, model.SENSORS)
    after = Persistence(alarm_after, 1, release_after)
    return diagnoser_of(plant, filter, ekf.only_declared(likelihood_ratios(threshold, release, after)))
