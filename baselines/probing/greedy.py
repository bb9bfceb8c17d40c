"""Greedy information gain: the probe that is worth most, by what is believed and by what each probe would tell.

What a decision under each probe resolves (`baselines.probing.doubt`), more than without, pays for so many decisions to
come; that is set against the probe's price.
"""

from __future__ import annotations

import numpy as np

from baselines.probing.doubt import Doubt
from fdi_gym.acts import probe_prices
from fdi_gym.agents import Prober
from fdi_gym.diagnosis import prober
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, Plant


@prober(
    "greedy_probes_w10", "The probe with the largest expected information gain, at ten times its price", cost_weight=10.0
)
@prober("greedy_probes_w3", "The same at three times its price", cost_weight=3.0)
@prober("greedy_probes", "The probe with the largest expected information gain at its price", reference=True)
@prober("greedy_probes_w0.3", "The same at three tenths of its price", cost_weight=0.3)
def greedy_probes(
    plant: Plant, *, process: str = "standard", period: int = 10, pays_for: float = 30.0, cost_weight: float = 1.0,
    window: int = 400,
) -> Prober:  # fmt: skip
    """The probe with the largest gain, if any has one.

    Args:
        plant: The plant.
        process: The fault process that is met.
        period: Decision period [samples].
        pays_for: Decisions for which a fault that is told from another pays.
        cost_weight: Factor on the price of a probe.
        window: Samples over which hypotheses are told apart by a probe that goes on.
    """
    doubts, price = Doubt(plant, process, period, window), cost_weight * np.array(probe_prices(plant))

    def choose(doubt: Array, obs: Array, said: Diagnosis) -> tuple[Array, Array]:
        doubt, label, probs = doubts.believed(doubt, said)
        probe = (pays_for * doubts.resolves(probs) - price).argmax(axis=1)
        return doubts.after(doubt, label, probe), probe

    return Prober(doubts.begin, choose)
