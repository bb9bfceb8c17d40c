"""Whether the rows of a recording hold u_k instead of u_{k-1}: two tests, either of which is enough.

A controller that is fed noisy sensors hands their surprises on: u_k is correlated with what of y_k could not be foreseen,
u_{k-1} only through what it does to y_k, which the plant's equations say. And where nothing is fed back, a Kalman filter on
the plant's equations is less surprised by the sensors when the commands are moved to where they act.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.plant import Array, Plant

ENOUGH = 60  # samples
EXPLAINED = 0.3  # share of a command's surprise that the sensors' own explain
ODDS = 6.0  # difference of the normalised innovations squared: odds of exp(3)
UNKNOWN = (1e-3, 3e-2)  # what disturbances may do to a state in a step, in units of its scale: the first that is enough
BLOCK, LONGEST = 50, 1500  # samples
POOR = 3.0  # blocks in which an innovation squared is so many times what it should be are left out: a fault, another model


def held_too_early(plant: Plant, obs: Array) -> str:
    """What speaks for it, in words; "" where nothing does, or the plant has no equations or no commands.

    Args:
        plant: The plant.
        obs: Observations (K + 1, n_obs).
    """
    if not plant.commands or plant.kernels is None or len(obs) < ENOUGH:
        return ""
    share = _shared_surprise(plant, obs)
    if share > EXPLAINED:
        return f"{100 * share:.0f} % of its surprises are those of the sensors at the same row"
    gain = _gain_when_moved(plant, obs[:LONGEST])
    return (
        f"a Kalman filter expects the sensors better with it moved on by a row (odds {np.exp(min(gain / 2, 50)):.2g})"
        if gain > ODDS
        else ""
    )


def _shared_surprise(plant: Plant, obs: Array) -> float:
    """The largest share of a command's surprise that the sensors' surprise of the same row explains, as feedback does."""
    if plant.true_feedback:
        return 0.0
    n_y, n_u = len(plant.outputs), len(plant.commands)
    whole = np.asarray(np.isfinite(obs).all(axis=1))
    k = np.flatnonzero(whole[2:] & whole[1:-1] & whole[:-2]) + 2
    sizes = np.array([s.scale for s in plant.observed])
    z = obs / sizes
    past = np.hstack([z[k - 1], z[k - 2], z[k][:, n_y + n_u :], np.ones((len(k), 1))])
    if len(k) < max(ENOUGH, 4 * past.shape[1]):
        return 0.0
    now = z[k][:, : n_y + n_u]
    surprise = now - past @ np.linalg.lstsq(past, now, rcond=1e-8)[0]
    e, eps = surprise[:, :n_y], surprise[:, n_y:]
    effect, found = _effect(plant, sizes), 0.0
    for i in range(n_u):
        if eps[:, i].std() < 1e-9 * (1 + np.abs(now[:, n_y + i]).max()):
            continue
        told = e @ np.linalg.lstsq(e, eps[:, i], rcond=1e-8)[0]
        explained = 1 - float(((eps[:, i] - told) ** 2).sum() / (eps[:, i] ** 2).sum())
        follows = e.T @ eps[:, i]  # in which direction the sensors go with the surprise of the command
        size = np.linalg.norm(follows) * np.linalg.norm(effect[:, i])
        if size > 0 and follows @ effect[:, i] / size < 0.5:  # not that in which the command moves them
            found = max(found, explained)
    return found


def _effect(plant: Plant, sizes: Array) -> Array:
    """What a command over an interval does to the sensors at its end, by the model at trim (n_y, n_u), scaled."""
    n_y, n_u = len(plant.outputs), len(plant.commands)
    u = plant.trim_command + 1e-3 * np.vstack([np.eye(n_u), -np.eye(n_u)]) * sizes[n_y : n_y + n_u]
    x = plant.propagate(0.0, np.tile(plant.trim_state, (2 * n_u, 1)), u)
    y = plant.measure(plant.dt, x, u)
    return (y[:n_u] - y[n_u:]).T / sizes[:n_y, None]


def _gain_when_moved(plant: Plant, obs: Array) -> float:
    """By how much the innovations squared, normalised, are less when each command is taken to be that of the next row."""
    given = _last_known(plant.split(obs)[1], plant.trim_command)
    moved = np.vstack([plant.trim_command, given[:-1]])
    starts = np.arange(BLOCK, len(obs) - BLOCK + 1, BLOCK)  # the filter settles in the first one
    for unknown in UNKNOWN if starts.size else ():
        squares, measured = _innovations(plant, obs, np.stack([given, moved]), unknown)
        expected = np.maximum(np.add.reduceat(measured, starts), 1)
        sums = np.add.reduceat(squares, starts, axis=1)
        share = sums.min(axis=0) / expected
        good = share < POOR
        if good.sum() >= 0.3 * len(starts):
            return float(((sums[0] - sums[1]) / np.maximum(share, 1.0))[good].sum())
    return 0.0


def _last_known(values: Array, first: Array) -> Array:
    """Values (K, n) with those that are missing as they were last."""
    found, last = values.copy(), first
    for row in found:
        row[:] = last = np.where(np.isfinite(row), row, last)
    return found


def _innovations(plant: Plant, obs: Array, us: Array, unknown: float) -> tuple[Array, Array]:
    """The innovations squared (H, K) of an extended Kalman filter for each history of commands (H, K, n_u), and the number
    of sensors that reported (K,)."""
    y, _, known = plant.split(obs)
    seen = np.isfinite(y)
    n_x, n_y, H = len(plant.states), len(plant.outputs), len(us)
    scale = np.array([s.scale for s in plant.states])
    Q = plant.Q + np.diag((unknown * scale) ** 2)
    R = plant.R + np.diag([(1e-6 * s.scale) ** 2 for s in plant.outputs])
    x, P = np.tile(plant.trim_state, (H, 1)), np.tile(np.diag((0.3 * scale) ** 2) + plant.Q, (H, 1, 1))
    h = 1e-4 * scale
    around = np.vstack([np.zeros(n_x), np.diag(h), -np.diag(h)])
    squares = np.zeros((H, len(y)))

    def slope(values: Array) -> Array:
        return ((values[:, 1 : n_x + 1] - values[:, n_x + 1 :]) / (2 * h)[:, None]).swapaxes(1, 2)

    for k in range(len(y)):
        if k:
            d = None
            if plant.measured_disturbance is not None:
                d = np.nan_to_num(plant.measured_disturbance((k - 1) * plant.dt, known[k - 1 : k], known[k : k + 1]))
            X = plant.propagate((k - 1) * plant.dt, (x[:, None] + around).reshape(-1, n_x), us[:, k], None, d)
            X = X.reshape(H, -1, n_x)
            F = slope(X)
            x, P = X[:, 0], F @ P @ F.swapaxes(1, 2) + Q
        Y = plant.measure(k * plant.dt, (x[:, None] + around).reshape(-1, n_x), us[:, k]).reshape(H, -1, n_y)
        C = np.where(seen[k][:, None], slope(Y), 0.0)
        e = np.where(seen[k], y[k] - Y[:, 0], 0.0)
        S = C @ P @ C.swapaxes(1, 2) + R
        if not (np.isfinite(S).all() and np.isfinite(e).all()):
            return np.full((H, len(y)), np.inf), seen.sum(axis=1)
        gain = np.linalg.solve(S, C @ P).swapaxes(1, 2)
        squares[:, k] = np.einsum("hi,hi->h", e, np.linalg.solve(S, e[..., None])[..., 0])
        x, P = x + np.einsum("hij,hj->hi", gain, e), P - gain @ C @ P
    return squares, seen.sum(axis=1)
