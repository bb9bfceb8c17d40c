"""How the committed networks were trained: one recipe per plant, and a general one for any other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from baselines.networks import reinforcement
from baselines.networks.flights import Source
from baselines.networks.identification import Shape
from baselines.networks.supervised import Recipe, Run

BOTH = (Source("standard", {}), Source("hard", {}))
GENERAL = Recipe(sources=(Source("standard", {}),), shape=Shape(stride=5, lags=6, degree=2))
RECIPES = {
    "B747Lateral": Recipe(sources=BOTH, shape=Shape(stride=4, lags=12, degree=1), flights=6144, validate=16),
    "HUAVHover": Recipe(
        sources=(Source("standard", {"kappa": 0.3}), Source("hard", {"kappa": 1.0})),
        shape=Shape(stride=5, lags=6, degree=1), flights=5120, candidates=8, validate=16,
    ),
    "MissilePitch": Recipe(
        sources=BOTH, shape=Shape(stride=2, lags=8, degree=3, effects=2, every=5), identify=200, flights=6144, validate=16,
    ),
    "CMGSatellite": Recipe(
        sources=BOTH, shape=Shape(stride=20, lags=2, degree=2, effects=2, every=2),
        identify=100, flights=1024, chunk=64, passes=8, validation=60, validate=8,
    ),
}  # fmt: skip
HEARD = {  # the filter that residual_net hears, and training flights per process: filters cost more than networks
    "B747Lateral": ("two_stage_kf_exponential_fast", 400),
    "HUAVHover": ("ascdkf", 400),
    "MissilePitch": ("augmented_ekf_imm", 300),
    "CMGSatellite": ("mekf", 100),
}

POLICIES = {  # steps: decisions of a flight, less one
    "B747Lateral": {"steps": 299, "decisions": 600_000, "entropy": 0.003},
    "HUAVHover": {"steps": 199, "decisions": 1_000_000},
    "MissilePitch": {"steps": 199, "decisions": 800_000},
    "CMGSatellite": {"steps": 249, "decisions": 600_000, "candidates": 4, "epochs": 6, "validate": 6},
}


def train(
    method: str, plant_id: str, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), threads: int = 1
) -> Path:
    """Train a supervised network; the path of its weights.

    Args:
        method: "sequence_net", or "residual_net", which hears the plant's filter and starts from the other's weights.
        plant_id: The plant.
        budget: Training flights per process. Default: the recipe's.
        seed: Of the run; each has training seeds of its own.
        work: Folder of runs; one that was killed goes on.
        threads: Of torch.

    Raises:
        ValueError: The plant has no filter to hear, or the folder holds another run.
    """
    recipe = RECIPES.get(plant_id, GENERAL)
    if method == "residual_net":
        if plant_id not in HEARD:
            raise ValueError(f"no filter is named for {plant_id} that a network could hear")
        name, flights = HEARD[plant_id]
        recipe = replace(recipe, filter=name, identify=100, flights=flights, chunk=flights, passes=24, validate=2, rate=1e-3)
    if budget is not None:
        recipe = replace(recipe, flights=budget, chunk=min(recipe.chunk, budget))
    where = {"seed": seed, "work": work / f"{method}-{plant_id}-{seed}", "threads": threads}
    return Run(method, plant_id, recipe, command=_command(method, plant_id, budget, seed), **where).run()


def policy_recipe(plant_id: str) -> reinforcement.Recipe:
    """How a plant's policy is trained: on the processes of its supervised network, seeing the same features."""
    like = RECIPES.get(plant_id, GENERAL)
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
