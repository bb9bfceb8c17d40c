"""Probe by the clock, whatever is believed: the plant's probes in turn."""

from __future__ import annotations

import numpy as np

from fdi_gym.agents import Prober
from fdi_gym.diagnosis import prober
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, Plant


@prober("periodic_probes_5", "The plant's probes in turn, one for a twentieth of the time", on=1, every=20)
@prober("periodic_probes_10", "The plant's probes in turn, one for a tenth of the time", on=2, every=20)
@prober("periodic_probes_20", "The plant's probes in turn, one for a fifth of the time", on=4, every=20)
@prober("periodic_probes_30", "The plant's probes in turn, one for 30 % of the time", reference=True, on=6, every=20)
@prober("periodic_probes_60", "The plant's probes in turn, one for 60 % of the time", on=12, every=20)
@prober("always_probes", "The plant's probes in turn, always one of them", reference=True, on=20, every=20)
def periodic_probes(plant: Plant, *, on: int = 10, every: int = 30, probes: tuple[str, ...] = ()) -> Prober:
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
