"""What a learned prober sees: belief and doubt, what each probe would tell, what has been probed, the newest observation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.probing.doubt import Doubt
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, Plant

FADES = 0.9  # of the memory of a probe, per decision
PAYS = 30.0  # decisions for which a resolved error pays: the scale of what a probe would tell


class Past(NamedTuple):
    """What n flights remember of their own: an array each, episodes first."""

    doubt: Array  # (n, labels)
    label: Array  # (n,) that was said last
    last: Array  # (n,) probe
    age: Array  # (n,) decisions for which it has gone on
    recent: Array  # (n, probes - 1) how much of each lately


class Sight:
    """The features of one plant's prober.

    Args:
        plant: The plant.
        process: The fault process that is met.
        period: Decision period [samples].
    """

    def __init__(self, plant: Plant, process: str, period: int):
        assert plant.acting is not None
        self.plant, self.doubts, self.probes = plant, Doubt(plant, process, period), len(plant.acting.probes)
        rows = [(p.command, p.reference) for p in plant.acting.probes]
        self.lengths = np.array([max([1, *(len(r) for r in some if r is not None)]) for some in rows]) / period  # decisions
        self.width = 2 * len(plant.labels) + 3 * self.probes - 1 + len(plant.observed)

    def begin(self, n: int) -> Past:
        """At the first decision."""
        none = np.zeros(n, np.int64)
        return Past(self.doubts.begin(n), none, none, none, np.zeros((n, self.probes - 1)))

    def see(self, past: Past, obs: Array, said: Diagnosis) -> tuple[Past, Array]:
        """The features (n, width) of the newest samples (n, n_obs) and what is said of them."""
        doubt, label, probs = self.doubts.believed(past.doubt, said)
        phase = past.age % self.lengths[past.last] / self.lengths[past.last]
        seen = np.clip(np.nan_to_num(self.plant.scale(obs)), -5.0, 5.0)
        parts = [probs, np.log10(np.maximum(probs, 1e-6)) / 6.0, PAYS * self.doubts.resolves(probs)[:, 1:],
                 np.eye(self.probes)[past.last], phase[:, None], past.recent, seen]  # fmt: skip
        return past._replace(doubt=doubt, label=label), np.concatenate(parts, axis=1)

    def choose(self, past: Past, probe: Array) -> Past:
        """After the probes (n,) were chosen."""
        age = np.where(probe == past.last, past.age + 1, 1)
        recent = FADES * past.recent + (1.0 - FADES) * np.eye(self.probes)[probe][:, 1:]
        return Past(self.doubts.after(past.doubt, past.label, probe), past.label, probe, age, recent)
