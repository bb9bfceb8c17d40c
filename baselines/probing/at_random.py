"""Probe at random, whatever is believed."""

from __future__ import annotations

import numpy as np

from baselines.probing.periodic import numbers_of
from fdi_gym.agents import Prober
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, Plant


def prober(plant: Plant, *, share: float = 0.3, hold: int = 10, probes: tuple[str, ...] = (), seed: int = 0) -> Prober:
    """One of the probes with probability `share`, else none, drawn anew every `hold` decisions.

    Args:
        plant: The plant.
        share: Of the time with a probe.
        hold: Decisions for which what was drawn stays.
        probes: Names. Default: all of the plant's.
        seed: Of the draws; the i-th flight of a batch has its own.
    """
    numbers = numbers_of(plant, probes)

    def choose(state: tuple[Array, Array, Array], obs: Array, said: Diagnosis) -> tuple[tuple[Array, Array, Array], Array]:
        count, keys, held = state
        if (count % hold == 0).any():
            drawn = np.array([np.random.default_rng([seed, key, c]).random(2) for key, c in zip(keys, count, strict=True)])
            fresh = np.where(drawn[:, 0] < share, numbers[(drawn[:, 1] * len(numbers)).astype(int)], 0)
            held = np.where(count % hold == 0, fresh, held)
        return (count + 1, keys, held), held

    return Prober(lambda n: (np.zeros(n, np.int64), np.arange(n), np.zeros(n, np.int64)), choose)
