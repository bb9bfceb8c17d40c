"""Are the Gaussian filters as sure of themselves as they may be? NIS and NEES on healthy flights.

At every sample the normalised innovation squared and the normalised estimation error squared are averaged over the
flights; if the filter's covariances are right, the averages are chi-square with (flights x dimension) degrees of freedom
over the flights, and 95 % of them lie between its 2.5 and 97.5 % points. A filter whose averages lie there on fewer than
90 % of the samples is inconsistent: optimistic where its errors are larger than it believes, conservative where smaller.

Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from baselines.filters.adaptive_ukf import Adaptive, adaptive_filter
from fdi_gym.diagnosis import find_diagnoser
from fdi_gym.estimation import gaussian, two_stage
from fdi_gym.estimation.augmented import Augmented, augmented
from fdi_gym.estimation.kalman import quadratic, times
from fdi_gym.estimation.prior import flights_of
from fdi_gym.estimation.three_stage import ThreeStage
from fdi_gym.estimation.unknown_inputs import known_of
from fdi_gym.plant import Array, Plant

FIRST, FLIGHTS, SAMPLES = 300_000, 40, 2000  # seeds after VALIDATION_SEED, flights, samples of each that are used
ENOUGH = 0.9


class Sure(NamedTuple):
    """A filter, and what it believes after a sample: the state (n, n_x), its covariance, innovation, its covariance."""

    start: Callable[[int], Any]
    step: Callable[[Any, Array], Any]
    believes: Callable[[Any], tuple[Array, Array, Array, Array]]


def gaussian_filter(plant: Plant, process: str, rule: str) -> Sure:
    """An augmented filter."""
    model = augmented(plant, process)
    x = model.x
    return Sure(
        lambda n: gaussian.start(model, n),
        lambda s, obs: gaussian.advance(model, gaussian.RULES[rule], s, obs),
        lambda s: (s.X[:, x], s.P[:, x, x], s.nu, s.S),
    )


def two_stage_filter(plant: Plant, process: str) -> Sure:
    """The two-stage filter."""
    model: Augmented = augmented(plant, process)
    x = model.x
    return Sure(
        lambda n: two_stage.start(model, n),
        lambda s, obs: two_stage.advance(model, s, obs),
        lambda s: (s.state()[:, x], s.covariance()[:, x, x], s.nu, s.S),
    )


def adaptive(plant: Plant, process: str, grid: str) -> Sure:
    """An adaptive filter."""
    model, filter = adaptive_filter(plant, grid, process)

    def believes(s: Adaptive) -> tuple[Array, Array, Array, Array]:
        f = s.filter
        return f.X[:, model.x], f.P[:, model.x, model.x], f.nu, f.S

    return Sure(filter.start, filter.step, believes)


def unknown_input_filter(plant: Plant, process: str, name: str) -> Sure:
    """A filter of states, faults and disturbances with linear sensors y = H x.

    It keeps no innovation. With the optimal gain the residual after the update is y - H x = R S^-1 nu, and its covariance
    R S^-1 R = R - H P H', so that its normalised square is that of the innovation.
    """
    entry, n_x = find_diagnoser(name), len(plant.states)
    inputs, sensors, H, _, _, _, R, *_ = known_of(plant, None, process, plant.tuning.get(name, {}))
    settings = entry.settings_on(plant, process=process, decision="flags", thresholds=[1.0] * len(inputs.names))
    raw = entry.build(plant, **settings)

    def believes(s: tuple[Any, Array]) -> tuple[Array, Array, Array, Array]:
        own, obs = s[0][1], s[1]
        x = own.estimates()[0] if isinstance(own, ThreeStage) else own.x[:, :n_x]
        P = (own.covariance() if isinstance(own, ThreeStage) else own.P)[:, :n_x, :n_x]
        return x, P, plant.split(obs)[0].take(sensors, axis=1) - times(H, x), R - H @ P @ H.T

    return Sure(lambda n: (raw.init(n), np.zeros(0)), lambda s, obs: (raw.update(s[0], obs)[0], obs), believes)


FILTERS: dict[str, Callable[[Plant, str], Sure]] = {
    "augmented_ekf": lambda plant, process: gaussian_filter(plant, process, "extended"),
    "augmented_ukf": lambda plant, process: gaussian_filter(plant, process, "unscented"),
    "augmented_cdkf": lambda plant, process: gaussian_filter(plant, process, "central difference"),
    "two_stage_ekf": two_stage_filter,
    "adaptive_ukf_full": lambda plant, process: adaptive(plant, process, "full"),
    "adaptive_ukf_simplified": lambda plant, process: adaptive(plant, process, "simplified"),
    "adaptive_ukf_elements": lambda plant, process: adaptive(plant, process, "elements"),
    "ascdkf": lambda plant, process: unknown_input_filter(plant, process, "ascdkf"),
    "three_stage_cdkf": lambda plant, process: unknown_input_filter(plant, process, "three_stage_cdkf"),
    "three_stage_ekf": lambda plant, process: unknown_input_filter(plant, process, "three_stage_ekf"),
}


def verdict(mean: float, inside: float) -> str:
    """In one word."""
    if inside >= ENOUGH:
        return "consistent"
    return "optimistic" if mean > 1 else "conservative"


def measure(plant: Plant, process: str, name: str) -> dict[str, dict[str, float | str]]:
    """NIS and NEES of a filter on healthy flights: mean per dimension, share of samples inside the bounds, verdict."""
    _, record = flights_of(plant, process, FIRST, FLIGHTS, False)
    sure = FILTERS[name](plant, process)
    s = sure.start(FLIGHTS)
    last = min(SAMPLES, int(record.length.min()))
    found: dict[str, list[float]] = {"NIS": [], "NEES": []}
    dimension = {"NEES": len(plant.states), "NIS": 0}
    for k in range(last + 1):
        s = sure.step(s, record.obs[:, k])
        if k > 0:
            x, P, nu, S = sure.believes(s)
            dimension["NIS"] = nu.shape[1]
            found["NIS"].append(float(quadratic(nu, S).mean()))
            found["NEES"].append(float(quadratic(record.state[:, k] - x, P).mean()))
    results = {}
    for what, values in found.items():
        low, high = chi2.ppf([0.025, 0.975], FLIGHTS * dimension[what]) / FLIGHTS
        inside = float(np.mean([low <= v <= high for v in values]))
        mean = float(np.mean(values)) / dimension[what]
        results[what] = {"mean": mean, "inside": inside, "verdict": verdict(mean, inside)}
    return results
