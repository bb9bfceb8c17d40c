"""An augmented filter whose gain somebody else corrects, and what it shows them: the plant predicts, a network has a say.

The state is X = [x; z; d], the plant's state, the fault vector and the disturbances that nothing measures
(`fdi_gym.estimation.augmented`). The plant's compiled model predicts; the update is

    X+ = X- + (factor * K) nu,   nu = y - h(X-),

with the nominal gain K of the augmented extended Kalman filter, carried along by its own covariance, and a factor for each
row of [x; z] and sensor. With all factors at 1 this is that filter. A sensor that did not report has no innovation and no
column in K.

What is shown at the end of each step of several samples are the differences of KalmanNet (G. Revach, N. Shlezinger, X. Ni,
A. Lopez Escoriza, R. J. G. van Sloun, Y. C. Eldar, IEEE Transactions on Signal Processing 70, 2022, section III-B):

    F1  observation difference        y_t - y_{t-1}
    F2  innovation difference         y_t - y_{t|t-1}, in units of its nominal standard deviation
    F3  forward evolution difference  x_{t|t} - x_{t-1|t-1}
    F4  forward update difference     x_{t|t} - x_{t|t-1}

where t - 1 is the end of the step before and F2 and F4 are summed over the samples of a step. Beside them: the mean square
of F2, what the nominal gain would have done to z, the estimate, how sure the nominal filter is of z, how far z is from what
each label looks like (`fdi_gym.estimation.labels`), the newest command and known signals, and how many samples of each
sensor reported.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation import gaussian
from fdi_gym.estimation.augmented import AugmentedModel
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.labels import Manifolds, distances, manifolds
from fdi_gym.plant import Array

RULE = "extended"
REACH_X, REACH_Z = float(np.log(2.0)), float(np.log(10.0))  # largest log factor of a gain of x, and of z
FARTHEST = 50.0  # scales off its start at which an estimate is stopped
CLIP = 8.0  # standard deviations at which a feature is cut, after arcsinh
T = np.transpose


class Layout(NamedTuple):
    """Where the parts of what is shown lie; `unit` is what each is counted in."""

    white: slice  # (m) F2: sum of the innovations over their standard deviations
    energy: slice  # (m) sum of the squares of these
    update: slice  # (rows) F4: sum of the corrections of [x; z]
    score: slice  # (p) sum of the nominal corrections of z, over its nominal standard deviation
    seen: slice  # (m) reports
    moved: slice  # (n_x) F3
    estimate: slice  # (rows) [x; z]
    sure: slice  # (p) log of the nominal standard deviation of z, in units of its typical size
    distance: slice  # (labels) squared distance of z to each label's set, in the metric of its nominal covariance
    change: slice  # (m) F1
    signals: slice  # (n_u + n_known) the newest command and known signals, scaled
    unit: Array  # (all,)
    sets: Manifolds  # the labels


def layout(model: AugmentedModel, stride: int) -> Layout:
    """The layout for steps of `stride` samples."""
    plant, n_x, p, m = model.plant, model.x.stop, model.z.stop - model.z.start, len(model.R)
    rows, scale, many, sets = n_x + p, model.scale[: n_x + p], float(stride), manifolds(plant)
    z_half = np.concatenate([scale[:n_x], 0.5 * scale[n_x:]])
    parts = {
        "white": np.full(m, many**0.5), "energy": np.full(m, many), "update": 0.1 * scale, "score": np.full(p, many**0.5),
        "seen": np.full(m, many), "moved": 0.1 * scale[:n_x], "estimate": z_half, "sure": np.ones(p),
        "distance": np.ones(1 + len(sets.labels)),
        "change": 2.0 * np.sqrt(np.diag(model.R)), "signals": np.ones(len(plant.commands) + len(plant.known)),
    }  # fmt: skip
    ends = np.cumsum([len(unit) for unit in parts.values()])
    slices = [slice(int(end) - len(unit), int(end)) for end, unit in zip(ends, parts.values(), strict=True)]
    assert rows == len(scale)
    return Layout(*slices, unit=np.concatenate(list(parts.values())), sets=sets)


class Corrected(NamedTuple):
    """Outcome of a correction."""

    X: Array  # (n, N)
    P: Array  # (n, N, N) the nominal covariance
    nu: Array  # (n, m) innovation, 0 where a sensor did not report
    std: Array  # (n, m) its nominal standard deviation
    K: Array  # (n, N, m) nominal gain
    H: Array  # (m, N) or (n, m, N)
    seen: Array  # (n, m) bool
    kept: Array  # (n, N) bool: not stopped


def predicted(model: AugmentedModel, X: Array, P: Array, at: Interval) -> tuple[Array, Array]:
    """X (n, N) and its nominal covariance (n, N, N) one sample later, by the plant's compiled model."""
    return model.predict(RULE, X, P, at)


def corrected(
    model: AugmentedModel, X: Array, P: Array, at: Interval, y: Array, seen: Array, factor: Array
) -> Corrected:  # fmt: skip
    """After the sensors y (n, n_y) of which `seen` reported; factor (n, rows, m) on the nominal gain.

    An estimate that is no number begins again; one that is too far off is stopped.
    """
    y, seen = y[:, model.sensors], seen[:, model.sensors]
    lost = np.logical_not(np.isfinite(X).all(axis=1) & np.isfinite(P).all(axis=(1, 2)))
    if lost.any():
        X, P = np.where(lost[:, None], model.X0, X), np.where(lost[:, None, None], model.P0, P)
    if model.H is not None:
        H = model.H
        mean, cross = X @ H.T, P @ H.T
        S = H @ cross + model.R
    else:
        mean, H = model.jacobian_h(X, at)
        cross = P @ T(H, (0, 2, 1))
        S = H @ cross + model.R
    found = gaussian.correct(X, P, mean, cross, S, y, seen)
    K = found.K.copy()
    K[:, : factor.shape[1]] *= factor
    moved = X + (K @ found.nu[..., None])[..., 0]
    low, high = model.X0 - FARTHEST * model.scale, model.X0 + FARTHEST * model.scale
    stopped = np.clip(moved, low, high)
    std = np.sqrt(np.diagonal(found.S, axis1=1, axis2=2))
    return Corrected(stopped, found.P, found.nu, std, found.K, H, seen, (stopped == moved) & ~lost[:, None])


def spread(model: AugmentedModel, P: Array) -> Array:
    """Nominal standard deviations of z (n, p)."""
    return np.sqrt(np.maximum(np.diagonal(P[:, model.z, model.z], axis1=1, axis2=2), 1e-30))


def newest(model: AugmentedModel, before: Array, y: Array, seen: Array) -> Array:
    """The newest reports of the sensors that are used (n, m), after y (n, n_y) of which `seen` reported."""
    return np.where(seen[:, model.sensors], y[:, model.sensors], before)


def at_rest(model: AugmentedModel, n: int) -> Array:
    """What they are before any report (n, m)."""
    return np.tile(np.array([s.nominal for s in model.plant.outputs])[model.sensors], (n, 1))


def added(model: AugmentedModel, total: Array, c: Corrected, factor: Array) -> Array:
    """The sums of a step (n, white to seen of the layout) with a sample."""
    rows, white = factor.shape[1], c.nu / c.std
    update = ((factor * c.K[:, :rows]) @ c.nu[..., None])[..., 0]
    score = (c.K[:, model.z] @ c.nu[..., None])[..., 0] / spread(model, c.P)
    return total + np.concatenate([white, white**2, update, score, c.seen], axis=1)


def distance_slopes(model: AugmentedModel, sets: Manifolds, X: Array, P: Array) -> Array:
    """Slopes by z (n, labels, p) of the distances: those of the nearest points held, since they are nearest."""
    z, P = X[:, model.z], P[:, model.z, model.z]
    off = z[:, None] - np.concatenate([np.zeros((len(z), 1, z.shape[1])), sets.points(distances(z, P, sets).m)], axis=1)
    return 2.0 * T(np.linalg.solve(P, T(off, (0, 2, 1))), (0, 2, 1))


def shown(
    model: AugmentedModel, sets: Manifolds, total: Array, X: Array, before: Array, P: Array, change: Array, u: Array,
    known: Array,
) -> Array:  # fmt: skip
    """What is shown at the end of a step (n, all of the layout), in the layout's order and still without units.

    Args:
        model: The model.
        sets: The labels.
        total: The sums of the step.
        X: Estimate (n, N).
        before: That at the end of the step before (n, N).
        P: Nominal covariance (n, N, N).
        change: Of the newest reports (n, m) since the end of the step before.
        u, known: The newest command (n, n_u) and known signals (n, n_known).
    """
    plant, n_x, p = model.plant, model.x.stop, model.z.stop - model.z.start
    blank = np.zeros((len(X), len(plant.outputs)))
    signals = plant.scale(np.concatenate([blank, u, known], axis=1))[:, len(plant.outputs) :]
    sure = np.log(spread(model, P) / model.scale[model.z])
    J = distances(X[:, model.z], P[:, model.z, model.z], sets).J
    return np.concatenate([total, X[:, :n_x] - before[:, :n_x], X[:, : n_x + p], sure, J, change, signals], axis=1)


def features(raw: Array, unit: Array, mean: Array, std: Array) -> Array:
    """As the network takes it: soft, standardised and bounded."""
    return np.clip((np.arcsinh(raw / unit) - mean) / std, -CLIP, CLIP)


def reach(model: AugmentedModel) -> Array:
    """Largest log factor of each row of [x; z] (rows,)."""
    return np.concatenate([np.full(model.x.stop, REACH_X), np.full(model.z.stop - model.z.start, REACH_Z)])
