"""Covariance-adaptive unscented Kalman filters for any plant: CAUKF, GAUKF and SGAUKF with the plant's fault vector.

The augmented UKF; while the innovations are too large, the step is repeated from covariances in which the variances of
fault entries are raised, and the one that explains the measurement best is kept. `caukf`, `gaukf` and `sgaukf` are the
satellite's own; here the increments are in units of the typical faults and the flag in those of the number of sensors.

`baselines.filters.covariance_adaptation` has the searches and their sources.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters.augmented_gaussian import Gaussian, gaussian_filter, reading_of
from baselines.filters.covariance_adaptation import BETA_0, INC_JOINT, MEMORY, Search, Trial, binary_grid, element_grid
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import quadratic
from fdi_gym.plant import Array, Plant

SENSORS = 6  # of the innovations to which BETA_0 belongs
WALK = 0.1  # of the standard deviation that follows the process's faults by itself


class Adaptive(NamedTuple):
    """State of the filter."""

    filter: Gaussian
    before: Gaussian  # the filter before the last prediction
    beta: Array  # (n,) weighted mean of the innovation statistic
    updates: Array  # (n,) samples with an innovation so far
    adapted: Array  # (n,) steps adapted so far


def every_subset(p: int) -> Array:
    """All subsets of p entries (2^p, p)."""
    return (np.arange(2**p)[:, None] >> np.arange(p)) % 2 == 1


def search_of(grid: str, model: AugmentedModel, size: Array) -> Search:
    """The search by name: "full", "simplified" (odd and even entries in turn) or "elements"; size (p,) of typical faults.

    Raises:
        ValueError: Unknown name.
    """
    entries = np.arange(model.z.start, model.z.stop)
    p = len(entries)
    inc, cap = INC_JOINT * size**2, model.limit[model.z]
    if grid == "elements":
        return element_grid(entries, inc, cap=cap)
    subsets = every_subset(p)
    if grid == "full":
        return binary_grid(entries, inc, lambda count: np.broadcast_to(subsets, (len(count), *subsets.shape)), cap)
    if grid != "simplified":
        raise ValueError(f"unknown grid {grid!r}; there are full, simplified, elements")
    half = every_subset(-(-p // 2))
    turns = np.zeros((2, len(half), p), bool)
    for parity in (0, 1):
        mine = np.arange(parity, p, 2)
        turns[parity][:, mine] = half[:, : len(mine)]
    return binary_grid(entries, inc, lambda count: turns[count % 2], cap)


def adaptive_filter(model: AugmentedModel, size: Array, grid: str) -> Filter:
    """The filter without its decision; size (p,) of typical faults, grid as of `adaptive_ukf`."""
    plain, search = gaussian_filter(model, "unscented"), search_of(grid, model, size)
    beta_0, r_inv = BETA_0 / SENSORS * len(model.R), 1.0 / np.diag(model.R)

    def start(n: int) -> Adaptive:
        f = plain.start(n)
        return Adaptive(f, f, np.zeros(n), np.zeros(n, np.int64), np.zeros(n, np.int64))

    def predict(s: Adaptive, at: Interval) -> Adaptive:
        return s._replace(filter=plain.predict(s.filter, at), before=s.filter)

    def update(s: Adaptive, at: Interval, y: Array, seen: Array) -> Adaptive:
        after, ours = plain.update(s.filter, at, y, seen), seen[:, model.sensors]
        counts = ours.any(axis=1) & (at.k > 0)  # the first sample ends no interval
        # the statistic is that of all sensors: those that are missing count with their expectation
        nis = quadratic(after.nu, after.S) + (~ours).sum(axis=1)
        beta = np.where(counts, s.beta + (nis - s.beta) / MEMORY, s.beta)
        updates = s.updates + counts
        flag = counts & (beta > beta_0) & (updates > MEMORY + 1)
        if flag.any():
            up = np.flatnonzero(flag)

            def run(rows: Array, P_c: Array) -> Trial:
                i = up[rows]
                here = at.of(i)
                X, P = model.predict("unscented", s.before.X[i], P_c, here)
                done = model.update("unscented", X, P, here, y[i], seen[i])
                residual = np.where(ours[i], y[i][:, model.sensors] - model.h(done.X[:, None], here)[:, 0], 0.0)
                return Trial(done.X, done.P, residual**2 @ r_inv, P_c)

            kept = search(s.before.P[up], s.adapted[up], run)
            X, P = after.X.copy(), after.P.copy()
            X[up], P[up] = kept.x, kept.P
            after = after._replace(X=X, P=P)
        return Adaptive(after, s.before, beta, updates, s.adapted + flag)

    return Filter(
        start, predict, update, lambda s: reading_of(model, s.filter),
        expect=lambda s, at: model.expect(s.filter.X[:, model.x], at),
    )  # fmt: skip


@diagnoser("adaptive_ukf_full", "Augmented UKF, covariance adapted by binary grid search, for any plant", grid="full")
@diagnoser("adaptive_ukf_simplified", "The same with the simplified grid", grid="simplified")
@diagnoser("adaptive_ukf_elements", "The same, element by element", grid="elements")
def adaptive_ukf(
    plant: Plant,
    belief: Belief,
    calibration: Calibration,
    *,
    grid: str = "full",
    decision: str = "distance",
    walk: float = WALK,
) -> Diagnoser:
    """The adaptive filter.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: What it may assume of the plant.
        calibration: When it alarms.
        grid: "full", "simplified" or "elements".
        decision: "distance", "thresholds", "chi-square", "cusum" or "glr".
        walk: Factor on the standard deviation of the faults' random walk; small, since the search follows the jumps.

    Raises:
        ValueError: Unknown grid or decision.
    """
    model = augmented(plant, belief, walk=walk)
    filter = adaptive_filter(model, belief.z_size, grid)
    return diagnoser_of(plant, filter, by_labels(plant, calibration, decision, size=belief.z_size))
