"""Augmented (joint) Kalman filters for any plant: extended, unscented and central-difference, with any decision.

State, fault vector and unknown disturbances are one Gaussian vector; faults and disturbances are random walks. Nothing
but the plant's declaration is needed: noises from its data sheet, walks and model errors from its fault process. On a
linear plant the three are the Kalman filter.

`fdi_gym.estimation.gaussian` has the rules and their sources, `fdi_gym.estimation.decision` the decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.gaussian import RULES
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.sweep import sweep_of
from fdi_gym.plant import Array, Plant


class Gaussian(NamedTuple):
    """State of the filter."""

    X: Array  # (n, N)
    P: Array  # (n, N, N)
    nu: Array  # (n, m) last innovation
    S: Array  # (n, m, m) its covariance
    seen: Array  # (n,) sensors in it


def gaussian_filter(model: AugmentedModel, rule: str, first_sample: bool = True) -> Filter:
    """The filter of an augmented model.

    Args:
        model: The model.
        rule: How a Gaussian passes through it, one of `fdi_gym.estimation.gaussian.RULES`.
        first_sample: Use the first sample as a measurement; without, the filter starts from its prior alone.

    Raises:
        ValueError: Unknown rule.
    """
    if rule not in RULES:
        raise ValueError(f"unknown rule {rule!r}; there are {', '.join(RULES)}")

    def start(n: int) -> Gaussian:
        m = len(model.R)
        return Gaussian(
            np.tile(model.X0, (n, 1)), np.tile(model.P0, (n, 1, 1)), np.zeros((n, m)), np.tile(model.R, (n, 1, 1)),
            np.zeros(n, np.int64),
        )  # fmt: skip

    def predict(s: Gaussian, at: Interval) -> Gaussian:
        X, P = model.predict(rule, s.X, s.P, at)
        return s._replace(X=X, P=P)

    def update(s: Gaussian, at: Interval, y: Array, seen: Array) -> Gaussian:
        c = model.update(rule, s.X, s.P, at, y, seen)
        return Gaussian(c.X, c.P, c.nu, c.S, c.count)

    return Filter(
        start, predict, update, lambda s: reading_of(model, s), first_sample,
        expect=lambda s, at: model.expect(s.X[:, model.x], at),
    )  # fmt: skip


def reading_of(model: AugmentedModel, s: Gaussian) -> Reading:
    """What an augmented filter knows."""
    x, z = model.x, model.z
    return Reading(s.X[:, z], s.P[:, z, z], s.X[:, x], s.P[:, x, x], s.nu, s.S, s.seen)


@diagnoser("augmented_ekf", "Augmented extended Kalman filter, for any plant", reference=True)
@diagnoser("augmented_ukf", "Augmented unscented Kalman filter, for any plant", reference=True, rule="unscented")
@diagnoser("augmented_cdkf", "Augmented central-difference Kalman filter, for any plant", rule="central difference")
@diagnoser("augmented_ekf_thresholds", "The augmented EKF, fixed thresholds on the estimate", decision="thresholds")
@diagnoser("augmented_ekf_chi_square", "The augmented EKF, alarms by a chi-square test of its innovations",
           decision="chi-square")  # fmt: skip
@diagnoser("augmented_ekf_cusum", "The augmented EKF, alarms by a CUSUM of its innovations", decision="cusum")
@diagnoser("augmented_ekf_glr", "The augmented EKF, alarms by a GLR test of its innovations", decision="glr")
def augmented_ekf(
    plant: Plant,
    belief: Belief,
    calibration: Calibration,
    *,
    rule: str = "extended",
    decision: str = "distance",
    walk: float = 1.0,
    x0_std: Sequence[float] | None = None,
    z0_std: Sequence[float] | None = None,
    z_walk: Sequence[float] | None = None,
    first_sample: bool = True,
) -> Diagnoser:
    """The augmented filter.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: What it may assume of the plant.
        calibration: When it alarms.
        rule: How a Gaussian passes through the model: "extended", "unscented" or "central difference".
        decision: "distance", "thresholds", "chi-square", "cusum" or "glr".
        walk, x0_std, z0_std, z_walk: As in `fdi_gym.estimation.augmented.augmented`.
        first_sample: Use the first sample as a measurement; without, the filter starts from its prior alone.

    Raises:
        ValueError: Unknown rule or decision.
    """
    model = augmented(plant, belief, walk=walk, x0_std=x0_std, z0_std=z0_std, z_walk=z_walk)
    rules = by_labels(plant, calibration, decision, size=belief.z_size)
    sweep = sweep_of(plant, model.compiled, rule, model.Q, model.R, rules.labelling)
    return diagnoser_of(plant, gaussian_filter(model, rule, first_sample), rules, sweep)
