"""Generalised likelihood ratio of a fault at an unknown time, from the innovations of a filter that knows of none.

A fault that sets in at sample tau moves the innovations of the healthy filter by a signature that the model predicts.
Per onset: M, how far one unit of each fault entry has moved the filter's error, h = H M + D its signature, information
G = sum h' S^-1 h and g = sum h' S^-1 nu. The log likelihood ratio of a fault vector z is g'z - z'Gz / 2; its maximum over
onset and magnitude, for each label, is the statistic. Onsets are tried every few samples within a window; information
fades at the window's pace, and the oldest onset stands for all before it.

A. S. Willsky, H. L. Jones, IEEE Transactions on Automatic Control 21(1), 1976. The signature of an entry is the change
that a fault of typical size makes (a secant), so that a fault which acts like a switch has one too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, right_divide, symmetric, times
from fdi_gym.estimation.labels import manifolds
from fdi_gym.estimation.signatures import linearised, secants, spoken_for
from fdi_gym.plant import Array, Plant


class Ratio(NamedTuple):
    """State: the healthy filter, and the signatures of the onsets that are tried."""

    X: Array  # (n, N) state and unknown disturbance
    P: Array  # (n, N, N)
    M: Array  # (n, onsets, N, p), the youngest onset first
    G: Array  # (n, onsets, p, p)
    g: Array  # (n, onsets, p)
    nu: Array  # (n, m) last innovation
    S: Array  # (n, m, m)
    seen: Array  # (n,) sensors in it
    faults: Array  # (n,) bool: an interval has ended in which a fault could have acted


def glr_filter(plant: Plant, model: AugmentedModel, size: Array, onsets: int, spacing: int) -> Filter:
    """The healthy filter with its signatures.

    Args:
        plant: The plant.
        model: Its augmented model.
        size: Typical fault sizes (p,).
        onsets: Onset times that are tried.
        spacing: Samples between them.
    """
    low, high = secants(plant, size)
    rest, p, m = model.rest, len(low), len(model.R)
    N, Q = len(rest), model.Q[np.ix_(rest, rest)]
    fade = 1.0 - 1.0 / (onsets * spacing)
    sets, labels = manifolds(plant), len(plant.labels)

    def start(n: int) -> Ratio:
        return Ratio(
            np.tile(model.X0[rest], (n, 1)), np.tile(model.P0[np.ix_(rest, rest)], (n, 1, 1)), np.zeros((n, onsets, N, p)),
            np.zeros((n, onsets, p, p)), np.zeros((n, onsets, p)), np.zeros((n, m)), np.tile(model.R, (n, 1, 1)),
            np.zeros(n, np.int64), np.zeros(n, bool),
        )  # fmt: skip

    def predict(s: Ratio, at: Interval) -> Ratio:
        M, G, g = s.M, s.G, s.g
        new = at.k % spacing == 0  # a new onset; the two oldest become one
        if new.any():
            M, G, g = (
                np.where(
                    new.reshape(-1, *[1] * (a.ndim - 1)),
                    np.concatenate([np.zeros_like(a[:, :1]), a[:, :-2], a[:, -1:]], axis=1),
                    a,
                )
                for a in (M, G, g)
            )
        f = linearised(model, lambda points: model.f(points, at), s.X, low, high, rest)
        P = symmetric(f.A @ s.P @ T(f.A)) + at.noise(Q)
        return s._replace(X=f.mean, P=P, M=f.A[:, None] @ M + f.E[:, None], G=G, g=g, faults=np.ones_like(s.faults))

    def update(s: Ratio, at: Interval, y: Array, seen: Array) -> Ratio:
        seen = seen[:, model.sensors]
        h = linearised(model, lambda points: model.h(points, at), s.X, low, high, slice(None))
        cross = s.P @ T(h.A)
        signature = (h.A[:, None] @ s.M + h.E[:, None]) * s.faults[:, None, None, None]  # (n, onsets, m, p)
        nu, S, cross, signature_t = masked(seen, y[:, model.sensors] - h.mean, h.A @ cross + model.R, cross, T(signature))
        K = right_divide(cross, S)
        weighed = signature_t @ right_divide(np.eye(m), S)[:, None]
        informed = (seen.any(axis=1) & s.faults)[:, None, None]
        keep = np.where(informed, fade, 1.0)
        G = keep[..., None] * s.G + weighed @ T(signature_t)
        g = keep * s.g + (weighed @ nu[:, None, :, None])[..., 0]
        return Ratio(
            s.X + times(K, nu), symmetric(s.P - K @ T(cross)), s.M - K[:, None] @ T(signature_t), G, g, nu, S,
            seen.sum(axis=1), s.faults,
        )  # fmt: skip

    def read(s: Ratio) -> Reading:
        x = model.x
        cost, chosen = spoken_for(s.G, s.g, sets, labels)
        return Reading(chosen, None, s.X[:, x], s.P[:, x, x], s.nu, s.S, s.seen, cost)

    return Filter(start, predict, update, read, expect=lambda s, at: model.expect(s.X[:, model.x], at))


@diagnoser("glr_ekf", "GLR test with propagated fault signatures on a healthy extended Kalman filter, for any plant")
def glr_ekf(plant: Plant, belief: Belief, calibration: Calibration, *, onsets: int = 8, spacing: int = 20) -> Diagnoser:
    """The test with its decision.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: What it may assume of the plant.
        calibration: When it alarms.
        onsets: Onset times that are tried.
        spacing: Samples between them.

    Raises:
        ValueError: Fewer than two onsets.
    """
    if onsets < 2 or spacing < 1:
        raise ValueError(f"at least 2 onsets, at least 1 sample apart, are allowed, not {onsets}, {spacing}")
    model = augmented(plant, belief)
    return diagnoser_of(plant, glr_filter(plant, model, belief.z_size, onsets, spacing), by_labels(plant, calibration))
