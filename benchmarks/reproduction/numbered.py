"""Numbered flights: their noise comes from NumPy's generator of their seed, as where the figures were first measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fdi_gym.engine import Record, simulate, white_noise
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant


def fly(
    plant: Plant,
    scenarios: Sequence[FaultScenario],
    order: Callable[[np.random.Generator, int], tuple[Array, Array]] | None = None,
) -> Record:
    """Fly the scenarios under the noise of their seeds.

    Args:
        plant: The plant.
        scenarios: One per flight.
        order: Draws (w (K, n_x), v (K + 1, n_y)) in the order that a data sheet prescribes. Default: `white_noise`.
    """
    noise = []
    for scenario in scenarios:
        rng = np.random.default_rng(scenario.noise_seed)
        noise.append(order(rng, scenario.steps) if order else white_noise(plant, rng, scenario.steps))
    return simulate(plant, scenarios, noise)
