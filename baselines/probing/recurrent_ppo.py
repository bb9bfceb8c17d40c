"""A learned prober with a memory (recurrent PPO of sb3-contrib): what `ppo` sees goes through an LSTM. Runs on NumPy.

`python -m baselines.probing._training PLANT PROCESS DIAGNOSER --recurrent` makes the weights.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.special

from baselines.learned.policy import actor
from baselines.learned.weights import read_tensors
from baselines.probing.ppo import Drawn, begin, drawn, features, weights_of
from fdi_gym.agents import Prober
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, NotApplicableError, Plant


class Memory(NamedTuple):
    """What has been drawn, and the LSTM's output and cell (n, width)."""

    drawn: Drawn
    h: Array
    c: Array


def prober(plant: Plant, *, process: str = "standard", seed: int = 0) -> Prober:
    """A probe drawn by the policy.

    Args:
        plant: The plant.
        process: The fault process that it was trained for.
        seed: Of the draws; the i-th flight of a batch has its own.

    Raises:
        NotApplicableError: There are no weights.
        RefusedError: The file holds none.
    """
    path = weights_of(plant.id, process, "recurrent")
    if not path.is_file():
        raise NotApplicableError(f"no recurrent probing policy was trained for {plant.id} and its process {process!r}")
    w = {name: value.astype(float) for name, value in read_tensors(path).items()}
    width = w["lstm.weight_hh"].shape[1]

    def choose(s: Memory, obs: Array, said: Diagnosis) -> tuple[Memory, Array]:
        x = features(plant, obs, said, s.drawn.last)
        i, f, g, o = np.split(x @ w["lstm.weight_ih"].T + s.h @ w["lstm.weight_hh"].T + w["lstm.bias"], 4, axis=1)
        c = scipy.special.expit(f) * s.c + scipy.special.expit(i) * np.tanh(g)
        h = scipy.special.expit(o) * np.tanh(c)
        now = drawn(s.drawn, actor(w, h), seed)
        return Memory(now, h, c), now.last

    return Prober(lambda n: Memory(begin(n), np.zeros((n, width)), np.zeros((n, width))), choose)
