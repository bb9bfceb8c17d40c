"""CAUKF: unscented Kalman filter whose covariance is adapted element by element.

At each step with the fault flag up, the ten distinct elements of the effectiveness block are raised one after the other
by 0, 1/4, 1/2 or all of the increment; each keeps its best value before the next is searched: up to 40 filter steps.

A. Rahimi's adaptive filter of 2017, as its later studies describe it; grid and tuning: data sheet.
"""

from __future__ import annotations

import numpy as np

from baselines.filters.dual_ukf import filter_of
from fdi_gym.diagnosis import Diagnoser, diagnoser
from baselines.filters.covariance_adaptation import BETA_0, INC_DUAL, INC_JOINT, element_grid
from fdi_gym.estimation.effectiveness import Q_THETA, THRESHOLD
from fdi_gym.plant import Plant


@diagnoser("caukf", "Joint UKF, covariance adapted element by element")
@diagnoser("dual_caukf", "Dual UKF, covariance adapted element by element", form="dual", inc=INC_DUAL)
def caukf(
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
    """The filter with the element-wise search; arguments as in `gaukf`.

    Raises:
        NotApplicableError: The plant has no attitude.
        ValueError: Unknown form.
    """
    build, first = filter_of(form)
    search = element_grid(first + np.arange(4), inc)
    return build(plant, search, beta_0=beta_0, q_theta=q_theta, sigma_r=sigma_r, threshold=threshold, n_pass=n_pass)
