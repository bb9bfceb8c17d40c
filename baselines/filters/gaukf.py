"""GAUKF: unscented Kalman filter whose covariance is adapted by a binary grid search.

At each step with the fault flag up, every subset of the effectiveness variances is raised in turn: 16 candidates,
number sum c_i 2^(i - 1), and the one with the smallest residual after the measurement is kept.

A. Rahimi, K. D. Kumar, H. Alighanbari, Mechanical Systems and Signal Processing 135, 2020, 106419; tuning: data sheet.
"""

from __future__ import annotations

import numpy as np

from baselines.filters.dual_ukf import filter_of
from fdi_gym.diagnosis import Diagnoser, diagnoser
from baselines.filters.covariance_adaptation import BETA_0, INC_DUAL, INC_JOINT, binary_grid
from fdi_gym.estimation.effectiveness import Q_THETA, THRESHOLD
from fdi_gym.plant import Array, Plant

UNITS = 4
SUBSETS = (np.arange(2**UNITS)[:, None] >> np.arange(UNITS)) % 2 == 1  # row c: which units candidate c raises


def all_subsets(count: Array) -> Array:
    """The 16 candidates, whatever was adapted before."""
    return np.broadcast_to(SUBSETS, (len(count), *SUBSETS.shape))


@diagnoser("gaukf", "Joint UKF, covariance adapted by binary grid search")
@diagnoser("dual_gaukf", "Dual UKF, covariance adapted by binary grid search", form="dual", inc=INC_DUAL)
def gaukf(
    plant: Plant,
    *,
    form: str = "joint",
    inc: float = INC_JOINT,
    beta_0: float = BETA_0,
    q_theta: float = Q_THETA,
    sigma_r: float | None = None,
    threshold: float = THRESHOLD,
    n_pass: int = 1,
) -> Diagnoser:
    """The filter with the full binary grid.

    Args:
        plant: The satellite.
        form: "joint" or "dual".
        inc: Increment of a variance.
        beta_0: Threshold of the fault flag.
        q_theta: Variance that each effectiveness gains per step.
        sigma_r: Standard deviation of all ten sensors that the filter believes in (the source: 1e-4). None: the true ones.
        threshold: A unit that has lost more is called faulty.
        n_pass: Passes of the search per step.

    Raises:
        NotApplicableError: The plant has no attitude.
        ValueError: Unknown form.
    """
    build, first = filter_of(form)
    search = binary_grid(first + np.arange(UNITS), inc, all_subsets)
    return build(plant, search, beta_0=beta_0, q_theta=q_theta, sigma_r=sigma_r, threshold=threshold, n_pass=n_pass)
