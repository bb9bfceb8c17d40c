"""Probe by the clock, whatever is believed: the plant's probes in turn."""

from __future__ import annotations

import numpy as np

from fdi_gym.agents import Prober
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, Plant


def prober(plant: Plant, *, on: int = 10, every: int = 30, probes: tuple[str, ...] = ()) -> Prober:
    """A probe for `on` decisions out of `every`, and then the next one.

    Args:
        plant: The plant.
        on: Decisions for which a probe acts.
        every: Decisions from the beginning of one to that of the next.
        probes: Names, in turn. Default: all of the plant's.

    Raises:
        ValueError: No such probe, or more decisions with a probe than there are.
    """
    numbers = numbers_of(plant, probes)
    if not 0 <= on <= every or every < 1:
        raise ValueError(f"a probe acts for 0 to {every} decisions of every {every}, not {on}")

    def choose(count: Array, obs: Array, said: Diagnosis) -> tuple[Array, Array]:
        chosen = np.where(count % every < on, numbers[count // every % len(numbers)], 0)
        return count + 1, chosen

    return Prober(lambda n: np.zeros(n, np.int64), choose)


def numbers_of(plant: Plant, probes: tuple[str, ...]) -> Array:
    """The numbers of these probes; of all but "none" where none are named.

    Raises:
        ValueError: No such probe.
    """
    names = [probe.name for probe in plant.acting.probes] if plant.acting else []
    for name in probes:
        if name not in names:
            raise ValueError(f"{plant.id} has no probe {name!r}; it has {', '.join(names) or 'none'}")
    return np.array([names.index(name) for name in probes] or range(1, len(names)))
