"""CAUKF, GAUKF and SGAUKF: the satellite's unscented Kalman filters, joint or dual, with an adapted covariance.

At each step with the fault flag up, variances of the effectiveness are raised by a search, whose best candidate is kept:

- "elements" (CAUKF): the ten distinct elements one after the other by 0, 1/4, 1/2 or all of the increment; each keeps its
  best value before the next: up to 40 filter steps;
- "full" (GAUKF): every subset of the four variances: 16 candidates, number sum c_i 2^(i - 1);
- "alternating" (SGAUKF): four candidates, of units 1 and 3 in the 1st, 3rd, ... adapted step of an episode and of units 2
  and 4 in the others;
- "odd": the source's words on SGAUKF taken literally, units 1 and 3 always: units 2 and 4 then keep the small variance
  that they converged to, and the error is pushed into 1 and 3.

A. Rahimi's adaptive filter of 2017, as its later studies describe it (CAUKF); A. Rahimi, K. D. Kumar, H. Alighanbari,
Mechanical Systems and Signal Processing 135, 2020, 106419 (GAUKF); A. Rahimi's study of the simplified binary grid
adaptation (SGAUKF); grids, tuning and the alternating reading: data sheet.
"""

from __future__ import annotations

import numpy as np

from baselines.filters.covariance_adaptation import (
    BETA_0,
    INC_DUAL,
    INC_JOINT,
    Search,
    binary_grid,
    element_grid,
    repeated,
)
from baselines.filters.dual_ukf import dual_filter
from baselines.filters.effectiveness import Q_THETA, THRESHOLD, threshold_rule
from baselines.filters.joint_ukf import N_XI, joint_filter
from fdi_gym.diagnosis import Diagnoser, diagnoser, diagnoser_of
from fdi_gym.plant import Array, Plant

UNITS = 4
SUBSETS = (np.arange(2**UNITS)[:, None] >> np.arange(UNITS)) % 2 == 1  # row c: which units candidate c raises
# candidate number c_a + 2 c_b, a < b
ODD = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [1, 0, 1, 0]], bool)
EVEN = np.roll(ODD, 1, axis=1)


def all_subsets(count: Array) -> Array:
    """The 16 candidates, whatever was adapted before."""
    return np.broadcast_to(SUBSETS, (len(count), *SUBSETS.shape))


def alternating(count: Array) -> Array:
    """Four candidates, of the odd and of the even units in turn."""
    return np.where((count % 2 == 0)[:, None, None], ODD, EVEN)


def odd_units(count: Array) -> Array:
    """Four candidates, of the odd units always."""
    return np.broadcast_to(ODD, (len(count), *ODD.shape))


BINARY = {"full": all_subsets, "alternating": alternating, "odd": odd_units}


def search_of(grid: str, entries: Array, inc: float) -> Search:
    """The search by name, of these diagonal entries (4,) and with this increment of a variance.

    Raises:
        ValueError: Unknown name.
    """
    if grid == "elements":
        return element_grid(entries, inc)
    if grid not in BINARY:
        raise ValueError(f"unknown grid {grid!r}; there are elements, {', '.join(BINARY)}")
    return binary_grid(entries, inc, BINARY[grid])


@diagnoser("caukf", "Joint UKF, covariance adapted element by element", grid="elements")
@diagnoser("gaukf", "Joint UKF, covariance adapted by binary grid search", grid="full")
@diagnoser("sgaukf", "Joint UKF, covariance adapted by the simplified grid, alternating", reference=True)
@diagnoser("sgaukf_odd", "Joint UKF, covariance adapted by the simplified grid, odd elements only", grid="odd")
@diagnoser("dual_caukf", "Dual UKF, covariance adapted element by element", grid="elements", form="dual", inc=INC_DUAL)
@diagnoser("dual_gaukf", "Dual UKF, covariance adapted by binary grid search", grid="full", form="dual", inc=INC_DUAL)
@diagnoser("dual_sgaukf", "Dual UKF, covariance adapted by the simplified grid, alternating", form="dual", inc=INC_DUAL)
@diagnoser("dual_sgaukf_odd", "Dual UKF, covariance adapted by the simplified grid, odd elements only",
           grid="odd", form="dual", inc=INC_DUAL)  # fmt: skip
def covariance_adaptive_ukf(
    plant: Plant,
    *,
    grid: str = "alternating",
    form: str = "joint",
    inc: float = INC_JOINT,
    beta_0: float = BETA_0,
    q_theta: float = Q_THETA,
    sigma_r: float | None = None,
    threshold: float = THRESHOLD,
    n_pass: int = 1,
) -> Diagnoser:
    """The filter with its search.

    Args:
        plant: The satellite.
        grid: "elements", "full", "alternating" or "odd".
        form: "joint" or "dual".
        inc: Increment of a variance.
        beta_0: Threshold of the fault flag.
        q_theta: Variance that each effectiveness gains per step.
        sigma_r: Standard deviation of all ten sensors that the filter believes in (the source: 1e-4). None: the true ones.
        threshold: A unit that has lost more is called faulty.
        n_pass: Passes of the search per step.

    Raises:
        NotApplicableError: The plant has no attitude.
        ValueError: Unknown grid or form.
    """
    if form not in ("joint", "dual"):
        raise ValueError(f"unknown form {form!r}; there are joint, dual")
    first, build = (N_XI, joint_filter) if form == "joint" else (0, dual_filter)
    search = repeated(search_of(grid, first + np.arange(UNITS), inc), n_pass)
    filter = build(plant, search, beta_0=beta_0, q_theta=q_theta, sigma_r=sigma_r)
    return diagnoser_of(plant, filter, threshold_rule(plant, threshold))
