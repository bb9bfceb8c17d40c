"""How the committed networks were trained: one recipe per plant, and a general one for any other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from baselines.networks import flights as data
from baselines.networks import reinforcement, weights
from baselines.networks.flights import Source
from baselines.networks.identification import Shape
from baselines.networks.supervised import Recipe, Run

BOTH = (Source("standard", {}), Source("hard", {}))
RECIPES = {
    "B747Lateral": Recipe(sources=BOTH, shape=Shape(stride=4, lags=12, degree=1), flights=6144, validate=16),
    "HUAVHover": Recipe(
        sources=(Source("standard", {"kappa": 0.3}), Source("hard", {"kappa": 1.0})),
        shape=Shape(stride=5, lags=6, degree=1), flights=10240, candidates=8, validate=16,
    ),
    "MissilePitch": Recipe(
        sources=BOTH, shape=Shape(stride=2, lags=8, degree=3, effects=2, every=5), identify=200, flights=6144, validate=16,
    ),
    "CMGSatellite": Recipe(
        sources=BOTH, shape=Shape(stride=20, lags=2, degree=2, effects=2, every=2),
        identify=100, flights=6144, chunk=64, passes=8, validation=60, validate=32,
    ),
}  # fmt: skip
HEARD = {  # the filters that residual_net hears, and training flights per process: filters cost more than networks
    "B747Lateral": (("bayes_bank", "switching_bayes_bank"), 600),
    "HUAVHover": (("hypothesis_bank", "ascdkf"), 1000),
    "MissilePitch": (("augmented_ekf_imm", "augmented_ekf_mode_probabilities"), 600),
    "CMGSatellite": (("mekf",), 400),
}
GENERAL_HEARD = (("augmented_ekf", "multiple_model_ekf"), 300)

POLICIES = {  # steps: decisions of a flight, less one
    "B747Lateral": {"steps": 299, "decisions": 600_000, "entropy": 0.003},
    "HUAVHover": {"steps": 199, "decisions": 1_000_000},
    "MissilePitch": {"steps": 199, "decisions": 800_000},
    "CMGSatellite": {"steps": 249, "decisions": 600_000, "candidates": 4, "epochs": 6, "validate": 6},
}


def general(plant_id: str) -> Recipe:
    """A recipe for any plant: for its standard and hard processes, or whichever it has beside the healthy one."""
    processes = data.plant_of(plant_id, Source("standard", {})).processes
    found = [name for name in ("standard", "hard") if name in processes] or [n for n in processes if n != "fault-free"]
    return Recipe(sources=tuple(Source(name, {}) for name in found), shape=Shape(stride=5, lags=6, degree=2))


def train(
    method: str, plant_id: str, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), threads: int = 1
) -> Path:
    """Train a supervised network; the path of its weights.

    Args:
        method: "sequence_net", or "residual_net", which hears the plant's filters and starts from the other's weights:
            those in the folder of runs, or else the committed ones.
        plant_id: The plant.
        budget: Training flights per process. Default: the recipe's.
        seed: Of the run; each has training seeds of its own.
        work: Folder of runs; one that was killed goes on.
        threads: Of torch.

    Raises:
        ValueError: There is no network to start from, or the folder holds another run.
    """
    recipe, base = RECIPES.get(plant_id) or general(plant_id), None
    if method == "residual_net":
        filters, flights = HEARD.get(plant_id, GENERAL_HEARD)
        recipe = replace(
            recipe, filters=filters, identify=100, flights=flights, chunk=flights, passes=20, validate=2, rate=1e-3
        )
        file = f"sequence_net-{plant_id}.safetensors"
        own = work / f"sequence_net-{plant_id}-{seed}" / file
        base = own if own.exists() else weights.WEIGHTS / file
    if budget is not None:
        recipe = replace(recipe, flights=budget, chunk=min(recipe.chunk, budget))
    where = {"seed": seed, "work": work / f"{method}-{plant_id}-{seed}", "threads": threads}
    return Run(method, plant_id, recipe, base=base, command=_command(method, plant_id, budget, seed), **where).run()


def policy_recipe(plant_id: str) -> reinforcement.Recipe:
    """How a plant's policy is trained: on the processes of its supervised network, seeing the same features."""
    like = RECIPES.get(plant_id) or general(plant_id)
    shared = {name: getattr(like, name) for name in ("sources", "shape", "identify", "candidates")}
    return reinforcement.Recipe(**shared | POLICIES.get(plant_id, {}))


def train_ppo(
    method: str, plant_id: str, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), threads: int = 1
) -> Path:
    """Train a policy by PPO; the path of its weights.

    Args:
        method: "ppo" for the isolation task, "ppo_identification" for the other.
        plant_id: The plant.
        budget: Decisions. Default: the recipe's.
        seed: Of the run.
        work: Folder of runs; one that was killed goes on.
        threads: Of torch.

    Raises:
        ValueError: The folder holds another run.
    """
    recipe = policy_recipe(plant_id)
    if method == "ppo_identification":
        recipe = replace(recipe, task="identification", entropy=0.0, decisions=2_000_000)
    if budget is not None:
        recipe = replace(recipe, decisions=budget)
    where = {"seed": seed, "work": work / f"{method}-{plant_id}-{seed}", "threads": threads}
    return reinforcement.Run(method, plant_id, recipe, command=_command(method, plant_id, budget, seed), **where).run()


def _command(method: str, plant_id: str, budget: int | None, seed: int) -> str:
    parts = ["fdi-gym train", method, plant_id, f"--budget {budget}" if budget else "", f"--seed {seed}" if seed else ""]
    return " ".join(part for part in parts if part)
