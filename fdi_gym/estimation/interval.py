"""What a filter hears of the interval between two samples, and how unsure of the state it makes where a command is held."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.kalman import T
from fdi_gym.plant import Array, Plant

HELD = 10  # samples within which a command that is held goes wrong by its typical size
STEP = 1e-3  # of the differences, in units of a command's typical size


class Interval(NamedTuple):
    """What is known of the interval that ends at a sample, for n episodes."""

    k: Array  # (n,) the sample at its end
    u: Array  # (n, n_u) the command held over it
    d: Array | None  # (n, n_d) the measured disturbance; None where none is
    known: Array  # (n, n_known) what else is known at its end
    held: Array | None = None  # (n,) bool: a command or known signal did not report, its last value stands; None: all did
    stale: Array | None = None  # (n, n_u) for how many samples in a row each command has been missing; None: none is
    Q_held: Array | None = None  # (n, n_x, n_x) what those commands add to the process noise; None: nothing

    def of(self, rows: Array) -> Interval:
        """Of some episodes, each as often as its row is named."""
        return Interval(*(None if a is None else a[rows] for a in self))  # type: ignore[arg-type]

    def noise(self, Q: Array, rows: int | None = None) -> Array:
        """The process noise over it: Q of a model whose first entries are the plant's state, and what held commands add.

        Args:
            Q: Covariance per sample (N, N), or one for each of several lines (lines, N, N).
            rows: How many rows the model has, equally many consecutive ones for each episode. Default: one each.

        Returns:
            Q itself where all commands reported, else (rows, N, N).
        """
        if self.Q_held is None:
            return Q
        n, n_x, _ = self.Q_held.shape
        wide = n if rows is None else rows
        found = np.tile(Q if Q.ndim == 3 else Q[None], (wide // (len(Q) if Q.ndim == 3 else 1), 1, 1))
        found[:, :n_x, :n_x] += np.repeat(self.Q_held, wide // n, axis=0)
        return found


def held_command_covariance(plant: Plant, x: Array, k: Array, u: Array, d: Array | None, stale: Array) -> Array:
    """What commands that were not reported add to the covariance of the state over an interval (n, n_x, n_x).

    The error of a command that is held grows to its typical size within HELD samples, and it is one error, not white noise:
    over j samples its effects add up, so that the j-th adds 2 j - 1 times its square.

    Args:
        plant: The plant.
        x: The state at the interval's start (n, n_x), or one for all (n_x,).
        k, u, d, stale: As of `Interval`.
    """
    n, n_u = u.shape
    scale = STEP * np.diag([s.scale for s in plant.commands])
    points = u[:, None] + np.concatenate([scale, -scale])  # (n, 2 n_u, n_u)
    x = np.repeat(np.broadcast_to(x, (n, len(plant.states))), 2 * n_u, axis=0)
    t, d = np.repeat((k - 1) * plant.dt, 2 * n_u), None if d is None else np.repeat(d, 2 * n_u, axis=0)
    moved = plant.propagate(t, x, points.reshape(-1, n_u), None, d).reshape(n, 2 * n_u, -1)
    B = (moved[:, :n_u] - moved[:, n_u:]) / (2 * STEP)  # (n, n_u, n_x): by a command's typical size
    weight = np.sqrt(np.maximum(2.0 * stale - 1.0, 0.0)) * np.minimum(stale / HELD, 1.0)
    B = weight[..., None] * B
    return T(B) @ B
