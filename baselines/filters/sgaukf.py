"""SGAUKF: GAUKF with a simplified grid that raises only two of the four variances at a step.

Four candidates in place of sixteen. "alternating" takes units 1 and 3 in the 1st, 3rd, ... adapted step of an episode
and units 2 and 4 in the others; "odd" is the source's words taken literally, units 1 and 3 always: units 2 and 4 then
keep the small variance that they converged to, and the error is pushed into 1 and 3.

A. Rahimi's study of the simplified binary grid adaptation; tuning and the alternating reading: data sheet.
"""

from __future__ import annotations

import numpy as np

from baselines.filters.dual_ukf import filter_of
from fdi_gym.diagnosis import Diagnoser, diagnoser
from baselines.filters.covariance_adaptation import BETA_0, INC_DUAL, INC_JOINT, binary_grid
from fdi_gym.estimation.effectiveness import Q_THETA, THRESHOLD
from fdi_gym.plant import Array, Plant

# candidate number c_a + 2 c_b, a < b: which units it raises
ODD = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [1, 0, 1, 0]], bool)
EVEN = np.roll(ODD, 1, axis=1)


@diagnoser("sgaukf", "Joint UKF, covariance adapted by the simplified grid, alternating")
@diagnoser("sgaukf_odd", "Joint UKF, covariance adapted by the simplified grid, odd elements only", parity="odd")
@diagnoser("dual_sgaukf", "Dual UKF, covariance adapted by the simplified grid, alternating", form="dual", inc=INC_DUAL)
@diagnoser(
    "dual_sgaukf_odd", "Dual UKF, covariance adapted by the simplified grid, odd elements only",
    form="dual", inc=INC_DUAL, parity="odd",
)  # fmt: skip
def sgaukf(
    plant: Plant,
    *,
    form: str = "joint",
    parity: str = "alternating",
    inc: float = INC_JOINT,
    beta_0: float = BETA_0,
    q_theta: float = Q_THETA,
    sigma_r: float | None = None,
    threshold: float = THRESHOLD,
    n_pass: int = 1,
) -> Diagnoser:
    """The filter with the simplified grid.

    Args:
        plant: The satellite.
        form: "joint" or "dual".
        parity: "alternating" or "odd".
        inc, beta_0, q_theta, sigma_r, threshold, n_pass: As in `gaukf`.

    Raises:
        NotApplicableError: The plant has no attitude.
        ValueError: Unknown form or parity.
    """
    build, first = filter_of(form)
    if parity not in ("alternating", "odd"):
        raise ValueError(f"unknown parity {parity!r}; there are alternating, odd")

    def choices(count: Array) -> Array:
        odd = (count % 2 == 0) | (parity == "odd")
        return np.where(odd[:, None, None], ODD, EVEN)

    search = binary_grid(first + np.arange(4), inc, choices)
    return build(plant, search, beta_0=beta_0, q_theta=q_theta, sigma_r=sigma_r, threshold=threshold, n_pass=n_pass)
