"""Augmented-state central-difference Kalman filter (ASCDKF): state, fault and disturbance in one vector.

The reference that the three-stage filters decouple. Fault and disturbance are random walks; sigma points are spread
over the whole augmented vector. M. Norgaard, N. K. Poulsen, O. Ravn, Automatica 36(11), 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from baselines.filters.flag_thresholds import thresholds_for
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.propagation import central_difference_moments, central_difference_points
from fdi_gym.estimation.unknown_inputs import judged, known_of
from fdi_gym.plant import Array, Plant


class Augmented(NamedTuple):
    """State of the filter: xa = [x; b; d] and its covariance."""

    x: Array  # (n, N)
    P: Array  # (n, N, N)


@diagnoser("ascdkf", "Augmented central-difference Kalman filter (ASCDKF)")
def ascdkf(
    plant: Plant,
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
    process: str = "standard",
    h: float = 3**0.5,
) -> Diagnoser:
    """The augmented filter.

    Args:
        plant: A plant whose fault enters additively and whose sensors are linear.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        b0_std, d0_std: Of the initial fault and disturbance, in the data sheet's units; one, or one per entry.
        b_step, d_step: Standard deviations of their random walks per step, likewise.
        alpha: Smoothing of the flag logic.
        thresholds: Of the flag logic, one per channel. Default: the calibrated table, else calibrated when first used.
        decision: "flags" or "distance". Default: flags where they can tell the plant's labels apart.
        process: The fault process that will be met. Tuning that is None is what this process
            says; the helicopter brings its paper's (`Plant.tuning`).
        h: Interval of the central differences, in standard deviations.

    Raises:
        NotApplicableError: The plant is not of that kind.
        ValueError: Unknown decision or process, or a list of the wrong length.
    """
    given = {"x0_std": x0_std, "b0_std": b0_std, "d0_std": d0_std, "b_step": b_step, "d_step": d_step}
    known = known_of(plant, channels, process, given)
    inputs, sensors, H, _, _, Q, R, *_ = known
    n_x, p, q = len(plant.states), len(inputs.names), len(plant.disturbances)
    N = n_x + p + q
    P0 = np.asarray(scipy.linalg.block_diag(known.P0, known.P0b, known.P0d))
    Qa = scipy.linalg.block_diag(Q, known.Qb, known.Qd)
    fault, dist = slice(n_x, n_x + p), slice(n_x + p, N)
    x0 = np.concatenate([known.x0, np.zeros(p + q)])

    def first(n: int) -> Augmented:
        return Augmented(np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1)))

    def advance(s: Augmented, t: float, u: Array, y: Array) -> Augmented:
        points = central_difference_points(s.x, np.linalg.cholesky(s.P), h)
        theta = np.tile(plant.nominal_theta, (*points.shape[:2], 1))
        theta[..., inputs.entries] += points[..., fault]
        points[..., :n_x] = plant.propagate(t, points[..., :n_x], u, theta, points[..., dist] if q else None)
        x, Pf, _ = central_difference_moments(points, h)
        P = Pf + Qa
        PHt = P[..., :n_x] @ H.T
        C = H @ PHt[:, :n_x] + R
        K = right_divide(PHt, C)
        return Augmented(x + times(K, y.take(sensors, axis=1) - times(H, x[:, :n_x])), symmetric(P - K @ T(PHt)))

    def read(s: Augmented) -> tuple[Array, Array]:
        return s.x[:, fault], s.P[:, fault, fault]

    return judged(
        plant, inputs, first, advance, read, decision=decision, process=process, alpha=alpha,
        thresholds=thresholds_for(plant, "ascdkf", inputs, thresholds), source=__file__,
        what=f"ascdkf {channels} {given} {h}",
    )  # fmt: skip
