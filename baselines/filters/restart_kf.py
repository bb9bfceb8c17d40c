"""Restart filter: a detector that forgets, and an estimator that starts afresh when it alarms.

The detector is the two-stage filter with exponential forgetting. At its alarm a second two-stage filter, without
forgetting, starts from the detector's state with a wide prior on the fault parameter; it then names and sizes the fault
with all data since the alarm.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from baselines.filters.two_stage_kf import TwoStage, aging, decision_rule, initial_covariances, start, two_stage_filter
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.diagnosis.contract import choose
from fdi_gym.estimation.decision import Reading, by_candidate
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.labels import distances, manifolds
from fdi_gym.plant import Array, Plant


class Restarted(NamedTuple):
    """State: both filters, the detector's decision, and whether it alarms (n,)."""

    detector: TwoStage
    second: TwoStage
    decision: Any
    alarm: Array


@diagnoser("restart_kf", "Two-stage filter with forgetting as detector, restarted without it at the alarm")
def restart_kf(
    plant: Plant, *, factor: float = 0.99, a_max: float = 1.0, threshold: float = 8.0, release_after: int = 100
) -> Diagnoser:
    """The restart filter.

    Args:
        plant: A linear plant.
        factor: Forgetting factor of the detector.
        a_max: Cap of its covariance's eigenvalues.
        threshold: Of its distance to the labels.
        release_after: Samples in a row with little evidence that give an alarm up.

    Raises:
        NotApplicableError: The plant is nonlinear.
    """
    detector = two_stage_filter(plant, aging(0.0, "exponential", factor, 0.0, a_max))
    second = two_stage_filter(plant, lambda Pz: Pz)
    rule, sets = decision_rule(plant, "distance", threshold, release_after), manifolds(plant)
    P_x, P_z = initial_covariances(plant)

    def begin(n: int) -> Restarted:
        return Restarted(detector.start(n), second.start(n), rule.start(n), np.zeros(n, bool))

    def predict(s: Restarted, at: Interval) -> Restarted:
        return s._replace(detector=detector.predict(s.detector, at), second=second.predict(s.second, at))

    def update(s: Restarted, at: Interval, y: Array, seen: Array) -> Restarted:
        first, other = (f.update(part, at, y, seen) for f, part in ((detector, s.detector), (second, s.second)))
        decision, verdict = rule.step(s.decision, at.k, detector.read(first), np.asarray(seen.any(axis=1)))
        rises = verdict.alarm & ~s.alarm
        if rises.any():
            x, Px = first.optimal()
            fresh = start(len(y), len(plant.outputs), P_x, P_z)._replace(x=x, Px=Px)
            other = choose(rises, fresh, other)
        return Restarted(first, other, decision, verdict.alarm)

    def read(s: Restarted) -> Reading:
        fits = distances(s.second.z, s.second.Pz, sets)
        cost = np.full((len(s.alarm), len(plant.labels)), np.inf)
        cost[:, sets.labels] = np.where(s.alarm[:, None], fits.J[:, 1:], np.inf)
        cost[:, 0] = np.where(s.alarm, np.inf, 0.0)
        z, filter = np.where(s.alarm[:, None], s.second.z, 0.0), s.detector
        return Reading(z, s.second.Pz, *filter.optimal(), filter.nu, filter.S, filter.seen, cost)

    filter = Filter(begin, predict, update, read, first_sample=False)
    return diagnoser_of(plant, filter, by_candidate(lambda r, label: np.argmin(np.asarray(r.cost), axis=1), 1))
