"""Probe while the diagnosis is in doubt, and see what that is worth and what it costs."""

import numpy as np

from fdi_gym.agents import NEVER, Prober, fly
from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.discovery import load_plant
from fdi_gym.faults import draw


def choose(count, obs, said):
    """The aileron's doublet and the rudder's in turn while no label has more than 0.9 of the belief."""
    doubt = said.label_probs.max(axis=1) < 0.9
    return count + 1, np.where(doubt, 1 + count // 10 % 2, 0)


if __name__ == "__main__":
    plant = load_plant("B747Lateral")
    flights = [draw(plant.process("quiet"), 2_000_000 + i) for i in range(20)]
    bank = make_diagnoser("bayes_bank", plant, process="quiet")
    for name, prober in (("never", NEVER), ("in doubt", Prober(lambda n: np.zeros(n, int), choose))):
        found = fly(plant, flights, bank, prober, period=10)
        right = (found.decisions.label == found.record.label)[:, 1:].mean()
        print(f"{name:10s} {100 * right:.0f} % of the samples right, flight cost {found.cost[:, 1:].mean():.3f}, "
              f"a probe in {100 * (found.probe > 0).mean():.0f} % of the time")  # fmt: skip
