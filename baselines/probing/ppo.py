"""Learned probers (PPO, and PPO with an LSTM): what `baselines.probing.sight` shows in, a probe out. They run on NumPy.

How they are trained is in `baselines.probing._learning`. `fdi-gym train ppo_probes B747Lateral` makes the weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from baselines.draws import uniform
from baselines.learned import weights
from baselines.learned.policy import actor
from baselines.probing.recipes import recipe_of
from baselines.probing.sight import Past, Sight
from fdi_gym.agents import Prober
from fdi_gym.diagnosis import prober, trainer
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.plant import Array, NotApplicableError, Plant

FOLDER = Path(__file__).parent / "weights"


class Memory(NamedTuple):
    """What is remembered of the flights, and the LSTM's output and cell (n, width)."""

    past: Past
    h: Array
    c: Array


@prober("ppo_probes_w3", "PPO on belief, doubt and observation, at three times the cost", method="ppo_probes_w3")
@prober("ppo_probes", "PPO on belief, doubt and observation", reference=True, method="ppo_probes")
def ppo_probes(
    plant: Plant, *, process: str = "standard", period: int = 10, method: str = "ppo_probes", path: str = "", seed: int = 0
) -> Prober:  # fmt: skip
    """A probe drawn by the policy's probabilities.

    Args:
        plant: A plant that there are weights for.
        process: The fault process that is met.
        period: Decision period [samples].
        method: Which policy.
        path: Weights of your own; their card lies beside them.
        seed: Of the draws, which are a hash of the newest sample.

    Raises:
        NotApplicableError: No weights for this plant, its options, process and period.
        RefusedError: Weights or a card that are not what they should be.
    """
    file = Path(path) if path else FOLDER / f"{weights.stem(method, plant)}.safetensors"
    if not file.exists():
        raise NotApplicableError(f"no trained weights for {plant.id}; train them: {weights.command(method, plant, None, 0)}")
    tensors, card = weights.read(file, plant)
    if (card.processes, card.shape.get("period")) != ([process], period):
        told = f"the process {card.processes[0]!r} and a period of {card.shape.get('period')}"
        raise NotApplicableError(f"{file.name} was trained for {told}, not for {process!r} and {period}")
    sight, hidden = Sight(plant, process, period), weights.whole_number(file, card, "hidden", weights.SIZES["hidden"])
    recurrent = card.shape.get("recurrent") is True
    weights.check_tensors(file, tensors, tensor_shapes(sight.width, sight.probes, hidden, recurrent))
    return policy(sight, {name: value.astype(float) for name, value in tensors.items()}, hidden, seed)


@prober("ppo_probes_discount_0", "PPO that never looks ahead")
def ppo_probes_discount_0(plant: Plant, *, process: str = "standard", period: int = 10) -> Prober:
    """As `ppo_probes`, trained with a discount of 0."""
    return ppo_probes(plant, process=process, period=period, method="ppo_probes_discount_0")


@prober("recurrent_ppo_probes", "PPO with an LSTM on belief, doubt and observation")
def recurrent_ppo_probes(plant: Plant, *, process: str = "standard", period: int = 10, path: str = "") -> Prober:
    """As `ppo_probes`, with an LSTM."""
    return ppo_probes(plant, process=process, period=period, method="recurrent_ppo_probes", path=path)


def policy(sight: Sight, w: Mapping[str, Array], hidden: int, seed: int = 0) -> Prober:
    """The prober of these tensors, with an LSTM where they hold one.

    Args:
        sight: What it sees.
        w: Tensors (`tensor_shapes`).
        hidden: Width of the layers.
        seed: Of the draws.
    """

    def begin(n: int) -> Memory:
        return Memory(sight.begin(n), np.zeros((n, hidden)), np.zeros((n, hidden)))

    def choose(s: Memory, obs: Array, said: Diagnosis) -> tuple[Memory, Array]:
        past, x = sight.see(s.past, obs, said)
        h, c = s.h, s.c
        if "lstm.bias" in w:
            x = x @ w["lstm.weight_ih"].T + s.h @ w["lstm.weight_hh"].T + w["lstm.bias"]
            i, f, g, o = np.split(x, 4, axis=1)
            c = scipy.special.expit(f) * s.c + scipy.special.expit(i) * np.tanh(g)
            x = h = scipy.special.expit(o) * np.tanh(c)
        gumbel = -np.log(-np.log(np.clip(uniform(obs, sight.probes, seed), 1e-12, 1.0 - 1e-12)))
        probe = (actor(w, x) + gumbel).argmax(axis=1)
        return Memory(sight.choose(past, probe), h, c), probe

    return Prober(begin, choose)


def tensor_shapes(width: int, probes: int, hidden: int, recurrent: bool) -> dict[str, tuple[int, ...]]:
    """The shapes of all arrays of a stored policy."""
    found: dict[str, tuple[int, ...]] = {}
    if recurrent:
        found = {"lstm.weight_ih": (4 * hidden, width), "lstm.weight_hh": (4 * hidden, hidden), "lstm.bias": (4 * hidden,)}
        width = hidden
    for i, (a, b) in enumerate(((width, hidden), (hidden, hidden), (hidden, probes))):
        found |= {f"layers.{i}.weight": (b, a), f"layers.{i}.bias": (b,)}
    return found


@trainer("ppo_probes", "PPO that probes, a diagnoser on board", method="ppo_probes")
@trainer("ppo_probes_w3", "The same at three times the cost", method="ppo_probes_w3", cost_weight=3.0)
@trainer("ppo_probes_discount_0", "The same that never looks ahead", method="ppo_probes_discount_0", discount=0.0)
@trainer("recurrent_ppo_probes", "PPO with an LSTM that probes", method="recurrent_ppo_probes", recurrent=True)
def train_ppo_probes(
    plant: Plant, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), threads: int = 1,
    method: str = "ppo_probes", cost_weight: float = 1.0, discount: float = 0.98, recurrent: bool = False,
) -> Path:  # fmt: skip
    """Train a prober; the path of its weights.

    Args:
        plant: The plant, with the options that it is flown with.
        budget: Decisions. Default: the recipe's.
        seed: Of the run.
        work: Folder of runs; one that was killed goes on.
        threads: Of torch.
        method: Under which name.
        cost_weight, discount, recurrent: As in `baselines.probing.recipes.ProbingRecipe`.

    Raises:
        NotApplicableError: The plant has no recipe.
        ValueError: The folder holds another run.
    """
    from baselines.probing._learning import ProbingTraining

    changes: dict[str, Any] = {"cost_weight": cost_weight, "discount": discount, "recurrent": recurrent}
    changes |= {} if budget is None else {"decisions": budget}
    return ProbingTraining(
        method, plant, recipe_of(plant, **changes), seed=seed, work=work / f"{weights.stem(method, plant)}-{seed}",
        command=weights.command(method, plant, budget, seed), threads=threads,
    ).run()  # fmt: skip
