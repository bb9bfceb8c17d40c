"""Probe at random, whatever is believed."""

from __future__ import annotations

import numpy as np

from baselines.draws import uniform
from baselines.probing.periodic import numbers_of
from fdi_gym.agents import Prober
from fdi_gym.diagnosis import prober
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, Plant


@prober("random_probes_10", "One of the plant's probes, drawn, for a tenth of the time", share=0.1, hold=2)
@prober("random_probes_30", "One of the plant's probes, drawn, for 30 % of the time", reference=True, share=0.3, hold=6)
def random_probes(
    plant: Plant, *, share: float = 0.3, hold: int = 10, probes: tuple[str, ...] = (), seed: int = 0
) -> Prober:
    """One of the probes with probability `share`, else none, drawn anew every `hold` decisions.

    Args:
        plant: The plant.
        share: Of the time with a probe.
        hold: Decisions for which what was drawn stays.
        probes: Names. Default: all of the plant's.
        seed: Of the draws, which are a hash of the newest sample.

    Raises:
        ValueError: No such probe, or a number out of range.
    """
    numbers = numbers_of(plant, probes)
    if not 0 <= share <= 1 or hold < 1:
        raise ValueError(f"a probe is drawn for a share from 0 to 1 and held for 1 decision or more, not {share} and {hold}")

    def choose(state: tuple[Array, Array], obs: Array, said: Diagnosis) -> tuple[tuple[Array, Array], Array]:
        count, held = state
        drawn = uniform(obs, 2, seed)
        fresh = np.where(drawn[:, 0] < share, numbers[(drawn[:, 1] * len(numbers)).astype(int)], 0)
        held = np.where(count % hold == 0, fresh, held)
        return (count + 1, held), held

    return Prober(lambda n: (np.zeros(n, np.int64), np.zeros(n, np.int64)), choose)
