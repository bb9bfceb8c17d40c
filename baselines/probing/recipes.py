"""How probers are trained: the recipes of the shipped weights, one per plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

from baselines.learned.features import FeatureShape
from baselines.learned.flights import Condition
from baselines.learned.recipes import Recipe
from fdi_gym.plant import NotApplicableError, Plant

NO_MODEL = FeatureShape(stride=1, lags=0, degree=1)  # a prober sees what its diagnoser says


@dataclass(frozen=True, kw_only=True)
class ProbingRecipe(Recipe):
    """How a prober is trained by PPO, in legs that begin new flights.

    Args:
        on_board: The diagnoser.
        period: Decision period [samples].
        cost_weight: Factor on what the flight costs, in the reward.
        discount: Of rewards to come, per decision.
        recurrent: With an LSTM.
        decisions: The budget.
        envs: Environments side by side.
        steps: Decisions of each per update.
        updates: Updates per leg.
        epochs: Passes over an update's decisions.
        batch: Decisions per gradient step.
        entropy: Weight of the entropy.
    """

    shape: FeatureShape = NO_MODEL
    identify: int = 0
    rate: float = 1e-3
    validate: int = 10
    validation: int = 60
    on_board: str
    period: int
    cost_weight: float = 1.0
    discount: float = 0.98
    recurrent: bool = False
    decisions: int = 500_000
    envs: int = 64
    steps: int = 120
    updates: int = 1
    epochs: int = 6
    batch: int = 512
    entropy: float = 0.003


RECIPES = {
    "B747Lateral": ProbingRecipe(conditions=(Condition("quiet", {}),), on_board="bayes_bank", period=10),
}


def recipe_of(plant: Plant, **changes: object) -> ProbingRecipe:
    """A plant's recipe, with changes.

    Raises:
        NotApplicableError: It has none.
    """
    if plant.id not in RECIPES:
        raise NotApplicableError(f"there is no recipe for a prober of {plant.id}; there are those of {', '.join(RECIPES)}")
    return replace(RECIPES[plant.id], **changes)  # type: ignore[arg-type]
