"""How probers are trained: the recipes of the shipped weights, one per plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

from baselines.learned.features import FeatureShape
from baselines.learned.flights import Condition
from baselines.learned.recipes import LegsRecipe
from fdi_gym.plant import NotApplicableError, Plant

NO_MODEL = FeatureShape(stride=1, lags=0, degree=1)  # a prober sees what its diagnoser says


@dataclass(frozen=True, kw_only=True)
class ProbingRecipe(LegsRecipe):
    """How a prober learns, beside what every run in legs says.

    Args:
        on_board: The diagnoser.
        period: Decision period [samples].
        cost_weight: Factor on what the flight costs, in the reward.
        discount: Of rewards to come, per decision.
        recurrent: With an LSTM.
    """

    shape: FeatureShape = NO_MODEL
    identify: int = 0
    validate: int = 10
    on_board: str
    period: int
    cost_weight: float = 1.0
    discount: float = 0.98
    recurrent: bool = False
    decisions: int = 500_000
    steps: int = 120
    epochs: int = 6
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
