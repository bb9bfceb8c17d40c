"""Parity space for any plant: residuals that no initial state and no unmeasured disturbance can move, only faults.

The samples of a window are stacked, and what the state at its beginning and the disturbances within it can explain is
projected out [1]; of the model nothing is asked but that it holds within the window. What is left, whitened, is moved by a
fault along the signature that the model predicts, and each label is weighed by how well its set of faults explains the
residuals of the windows so far, in sums that forget at several paces. Neighbouring windows share their edge sample.

A nonlinear plant is linearised along its model's own path within the window, which begins at the estimate of a healthy
extended Kalman filter; on a linear plant the residual does not depend on that filter at all.

[1] E. Y. Chow, A. S. Willsky, IEEE Transactions on Automatic Control 29(7), 1984.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from baselines.filters.augmented_gaussian import Gaussian, gaussian_filter, reading_of
from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, times
from fdi_gym.estimation.labels import manifolds
from fdi_gym.estimation.parity import projected, stacked
from fdi_gym.estimation.signatures import Sums, heard, local, nothing_said, spoken_for
from fdi_gym.plant import Array, Plant

LEAST = 1e-6  # a typical fault that moves the residual by fewer standard deviations is not seen at all


class Window(NamedTuple):
    """State: the filter that says where to linearise, the window of s intervals that is being filled, and its evidence."""

    healthy: Gaussian
    X: Array  # (n, N) the model's own path since the window began
    A: Array  # (n, s, n_x, n_x) of each interval
    E: Array  # (n, s, n_x, p)
    D: Array  # (n, s, n_x, q)
    Q: Array  # (n, s, n_x, n_x)
    C: Array  # (n, s + 1, m, n_x) of each sample
    H: Array  # (n, s + 1, m, p)
    e: Array  # (n, s + 1, m) what was read less what the path expects; 0 where nothing was
    seen: Array  # (n, s + 1, m) bool
    size: Array  # (n,) mean square of the last residual
    sums: Sums


def residual(w: Window, R: Array, scale: Array) -> tuple[Array, Array]:
    """The parity residual of a full window, white (n, rows), and what a unit of each fault adds to it (n, rows, p)."""
    full = stacked(w.A, w.E, w.D, w.Q, w.C, w.H, R, w.seen)
    r, V = projected(full, scale, w.e.reshape(len(w.e), -1, 1), full.T)
    return r[..., 0], V


def parity_filter(plant: Plant, belief: Belief, order: int, paces: Sequence[float]) -> Filter:
    """The residual generator and its evidence.

    Args:
        plant: The plant.
        belief: What is believed of it.
        order: Intervals in a window.
        paces: Windows within which each of the sums forgets.

    Raises:
        NotApplicableError: No parity relation of this order that the disturbances leave alone shows any fault.
    """
    model, bare = augmented(plant, belief), augmented(plant, belief, faults=False)
    path, about = gaussian_filter(bare, "extended"), local(model, belief.z_size)
    n_x, m, p, q = len(plant.states), len(model.R), len(belief.z_size), len(belief.disturbances)
    s, keep = order, 1.0 - 1.0 / np.asarray(paces, float)
    scale = np.concatenate([model.scale[model.x], np.tile(model.scale[model.d], s)])
    Q, sets, labels = model.Q[model.x, model.x], manifolds(plant), len(plant.labels)

    def start(n: int) -> Window:
        def zeros(*shape: int) -> Array:
            return np.zeros((n, *shape))

        return Window(
            path.start(n), np.tile(bare.X0, (n, 1)), zeros(s, n_x, n_x), zeros(s, n_x, p), zeros(s, n_x, q),
            np.tile(Q, (n, s, 1, 1)), zeros(s + 1, m, n_x), zeros(s + 1, m, p), zeros(s + 1, m),
            np.zeros((n, s + 1, m), bool), zeros(), nothing_said(n, len(keep), p),
        )  # fmt: skip

    def predict(w: Window, at: Interval) -> Window:
        rows, slot, f = np.arange(len(w.X)), (at.k - 1) % s, about.f(w.X, at)
        A, E, D, noise = w.A.copy(), w.E.copy(), w.D.copy(), w.Q.copy()
        A[rows, slot], E[rows, slot], D[rows, slot] = f.A[:, :n_x, :n_x], f.E[:, :n_x], f.A[:, :n_x, n_x:]
        noise[rows, slot] = at.noise(Q)
        return w._replace(healthy=path.predict(w.healthy, at), X=f.mean, A=A, E=E, D=D, Q=noise)

    def shown(w: Window, at: Interval, slot: Array, y: Array, seen: Array) -> Window:
        """With the sample in its slot."""
        rows, h = np.arange(len(w.X)), about.h(w.X, at)
        C, H, e, there = w.C.copy(), w.H.copy(), w.e.copy(), w.seen.copy()
        C[rows, slot], H[rows, slot] = h.A[..., :n_x], h.E
        e[rows, slot], there[rows, slot] = np.where(seen, y - h.mean, 0.0), seen
        return w._replace(C=C, H=H, e=e, seen=there)

    def update(w: Window, at: Interval, y: Array, seen: Array) -> Window:
        own, there, turn = y[:, model.sensors], seen[:, model.sensors], at.k % s == 0
        w = w._replace(healthy=path.update(w.healthy, at, y, seen))
        w = shown(w, at, np.where(at.k > 0, (at.k - 1) % s + 1, 0), own, there)
        if not turn.any():
            return w
        ended = turn & (at.k > 0) & w.seen.any(axis=(1, 2))
        if ended.any():
            r, V = residual(w, model.R, scale)
            sums = heard(w.sums, keep, T(V) @ V, times(T(V), r), ended)
            count = np.maximum(w.seen.sum(axis=(1, 2)), 1)
            w = w._replace(sums=sums, size=np.where(ended, (r**2).sum(axis=1) / count, w.size))
        w = w._replace(X=np.where(turn[:, None], w.healthy.X, w.X))
        first = shown(w, at, np.zeros(len(turn), np.int64), own, there)
        return w._replace(
            **{
                name: np.where(turn.reshape(-1, *[1] * (getattr(w, name).ndim - 1)), getattr(first, name), getattr(w, name))
                for name in ("C", "H", "e", "seen")
            }
        )

    def read(w: Window) -> Reading:
        healthy = reading_of(bare, w.healthy)
        cost, z = spoken_for(w.sums.G, w.sums.g, sets, labels)
        return healthy._replace(z=z, P=None, cost=cost, signals={"parity residual": w.size})

    filter = Filter(start, predict, update, read, expect=lambda w, at: model.expect(w.healthy.X[:, model.x], at))
    if not (np.diagonal(_seen(plant, filter, order), axis1=1, axis2=2) * belief.z_size**2 > LEAST**2).any():
        raise NotApplicableError(
            f"no parity relation of order {order} that the initial state and the unmeasured disturbances of {plant.id} "
            "leave alone shows any fault"
        )
    return filter


def _seen(plant: Plant, filter: Filter, order: int) -> Array:
    """Information about the faults (2, p, p) in a window from trim on, under commands of typical size, both ways."""
    u = plant.trim_command + np.array([[1.0], [-1.0]]) * [s.scale for s in plant.commands]
    known = np.tile([s.nominal for s in plant.known], (2, 1))
    w, y, seen = filter.start(2), np.tile(plant.measure(0.0, plant.trim_state, u[0]), (2, 1)), np.ones(2, bool)
    for k in range(order + 1):
        d = plant.measured_disturbance((k - 1) * plant.dt, known, known) if plant.measured_disturbance else None
        at = Interval(np.full(2, k), u, d, known)
        w = filter.update(filter.predict(w, at) if k else w, at, y, np.tile(seen[:, None], y.shape[1]))
    return w.sums.G[:, 0]


@diagnoser("parity_space", "Parity space: window residuals that state and disturbance cannot move, for any plant")
def parity_space(
    plant: Plant, belief: Belief, calibration: Calibration, *, order: int = 10, paces: Sequence[float] = (1, 4, 16, 64)
) -> Diagnoser:
    """The residuals with their decision.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: What it may assume of the plant.
        calibration: When it alarms.
        order: Intervals in a window.
        paces: Windows within which each of the sums of evidence forgets, 1 or more.

    Raises:
        NotApplicableError: No parity relation of this order that the disturbances leave alone shows any fault.
        ValueError: A number out of range.
    """
    if order < 1 or not paces or min(paces) < 1:
        raise ValueError(f"an order of at least 1 and paces of at least 1 window are allowed, not {order}, {tuple(paces)}")
    return diagnoser_of(plant, parity_filter(plant, belief, order, paces), by_labels(plant, calibration))
