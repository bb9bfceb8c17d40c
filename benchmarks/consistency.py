"""Are the Gaussian filters as sure of themselves as they may be? NIS and NEES on healthy flights.

At every sample the normalised innovation squared and the normalised estimation error squared are averaged over the
flights; if the filter's covariances are right, the averages are chi-square with (flights x dimension) degrees of freedom
over the flights, and 95 % of them lie between its 2.5 and 97.5 % points. A filter whose averages lie there on fewer than
90 % of the samples is inconsistent: optimistic where its errors are larger than it believes, conservative where smaller.

Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.diagnosis.filtering import readings
from fdi_gym.diagnosis.fitting import flights_of
from fdi_gym.estimation.kalman import quadratic
from fdi_gym.plant import Plant

FIRST, FLIGHTS, SAMPLES = 300_000, 40, 2000  # seeds after VALIDATION_SEED, flights, samples of each that are used
ENOUGH = 0.9
FILTERS = (
    "augmented_ekf", "augmented_ukf", "augmented_cdkf", "two_stage_ekf", "adaptive_ukf_full", "adaptive_ukf_simplified",
    "adaptive_ukf_elements", "ascdkf", "three_stage_cdkf", "three_stage_ekf",
)  # fmt: skip


def verdict(mean: float, inside: float) -> str:
    """In one word."""
    if inside >= ENOUGH:
        return "consistent"
    return "optimistic" if mean > 1 else "conservative"


def measure(plant: Plant, process: str, name: str) -> dict[str, dict[str, float | str]]:
    """NIS and NEES of a filter on healthy flights: mean per dimension, share of samples inside the bounds, verdict."""
    _, record = flights_of(plant, process, FIRST, FLIGHTS, False)
    last = min(SAMPLES, int(record.length.min()))
    found: dict[str, list[float]] = {"NIS": [], "NEES": []}
    dimension = {"NEES": len(plant.states), "NIS": 0}
    said = readings(plant, make_diagnoser(name, plant, process=process), record.obs[:, : last + 1])
    for k, (r, _) in enumerate(said):
        if k > 0 and r.nu is not None and r.S is not None and r.x is not None and r.Px is not None:
            dimension["NIS"] = r.nu.shape[1]
            found["NIS"].append(float(quadratic(r.nu, r.S).mean()))
            found["NEES"].append(float(quadratic(record.state[:, k] - r.x, r.Px).mean()))
    results = {}
    for what, values in found.items():
        low, high = 2 * gammaincinv(0.5 * FLIGHTS * dimension[what], np.array([0.025, 0.975])) / FLIGHTS
        inside = float(np.mean([low <= v <= high for v in values]))
        mean = float(np.mean(values)) / dimension[what]
        results[what] = {"mean": mean, "inside": inside, "verdict": verdict(mean, inside)}
    return results
