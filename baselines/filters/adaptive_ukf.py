"""Covariance-adaptive unscented Kalman filters for any plant: CAUKF, GAUKF and SGAUKF with the plant's fault vector.

The augmented UKF; while the innovations are too large, the step is repeated from covariances in which the variances of
fault entries are raised, and the one that explains the measurement best is kept. `caukf`, `gaukf` and `sgaukf` are the
satellite's own; here the increments are in units of the typical faults and the flag in those of the number of sensors.

`fdi_gym.estimation.covariance_adaptation` has the searches and their sources.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.alarm import Estimate, FaultFilter
from fdi_gym.estimation.augmented import Augmented, augmented
from fdi_gym.estimation.calibration import calibrated_filter
from fdi_gym.estimation.covariance_adaptation import BETA_0, INC_JOINT, MEMORY, Search, Trial, binary_grid, element_grid
from fdi_gym.estimation.gaussian import Gaussian, look, nis, predict, start, unscented
from fdi_gym.plant import Array, Plant

SENSORS = 6  # of the innovations to which BETA_0 belongs
WALK = 0.1  # of the standard deviation that follows the process's faults by itself


class Adaptive(NamedTuple):
    """State of the filter."""

    filter: Gaussian
    beta: Array  # (n,) weighted mean of the innovation statistic
    adapted: Array  # (n,) steps adapted so far


def every_subset(p: int) -> Array:
    """All subsets of p entries (2^p, p)."""
    return (np.arange(2**p)[:, None] >> np.arange(p)) % 2 == 1


def search_of(grid: str, model: Augmented) -> Search:
    """The search by name: "full", "simplified" (odd and even entries in turn) or "elements".

    Raises:
        ValueError: Unknown name.
    """
    entries = np.arange(model.z.start, model.z.stop)
    p, size = len(entries), model.prior.z_size
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


def adaptive_filter(plant: Plant, grid: str, process: str = "standard", walk: float = WALK) -> tuple[Augmented, FaultFilter]:
    """The filter without its decision, and its model; arguments and errors as of `adaptive_ukf`."""
    model = augmented(plant, process, walk=walk)
    search, beta_0 = search_of(grid, model), BETA_0 / SENSORS * len(model.R)
    r_inv = 1.0 / np.diag(model.R)

    def step(s: Adaptive, obs: Array) -> Adaptive:
        f = s.filter
        at, known = model.read(f.k, obs, f.known)
        X, P = (f.X, f.P) if f.k == 0 else predict(model, unscented, f.X, f.P, at)
        X, P, nu, S = look(model, unscented, X, P, at)
        after = Gaussian(f.k + 1, X, P, nu, S, known)
        if f.k == 0:
            return s._replace(filter=after)
        beta = s.beta + (nis(after) - s.beta) / MEMORY
        flag = (beta > beta_0) & (f.k > MEMORY + 1)
        if flag.any():
            up = np.flatnonzero(flag)

            def run(rows: Array, P_c: Array) -> Trial:
                i = up[rows]
                here = at._replace(y=at.y[i], u=at.u[i], d=None if at.d is None else at.d[i])
                X_c, P_new, *_ = look(model, unscented, *predict(model, unscented, f.X[i], P_c, here), here)
                residual = here.y - model.h(X_c[:, None], here)[:, 0]
                return Trial(X_c, P_new, residual**2 @ r_inv, P_c)

            kept = search(f.P[up], s.adapted[up], run)
            X, P = X.copy(), P.copy()
            X[up], P[up] = kept.x, kept.P
        return Adaptive(after._replace(X=X, P=P), beta, s.adapted + flag)

    def read(s: Adaptive) -> Estimate:
        f = s.filter
        return Estimate(f.X[:, model.z], f.P[:, model.z, model.z], f.nu, f.S)

    def first(n: int) -> Adaptive:
        return Adaptive(start(model, n), np.zeros(n), np.zeros(n, np.int64))

    return model, FaultFilter(first, step, read)


@diagnoser("adaptive_ukf_full", "Augmented UKF, covariance adapted by binary grid search, for any plant", grid="full")
@diagnoser("adaptive_ukf_simplified", "The same with the simplified grid", grid="simplified")
@diagnoser("adaptive_ukf_elements", "The same, element by element", grid="elements")
def adaptive_ukf(
    plant: Plant, *, grid: str = "full", decision: str = "distance", process: str = "standard", walk: float = WALK
) -> Diagnoser:
    """The adaptive filter.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        grid: "full", "simplified" or "elements".
        decision: "distance", "thresholds", "chi-square", "cusum" or "glr".
        process: The fault process that will be met; its declaration gives walks, model errors and thresholds.
        walk: Factor on the standard deviation of the faults' random walk; small, since the search follows the jumps.

    Raises:
        NotApplicableError: No sensor has noise, or the fault does not enter additively.
        ValueError: Unknown grid, decision or process.
    """
    model, filter = adaptive_filter(plant, grid, process, walk)
    what = f"adaptive ukf {grid} {walk}"
    return calibrated_filter(plant, filter, decision, model.prior.z_size, process=process, source=__file__, what=what)
