"""Never probe: what every passive diagnoser does."""

from __future__ import annotations

from fdi_gym.agents import NEVER, Prober
from fdi_gym.plant import Plant


def prober(plant: Plant) -> Prober:
    """No probe, ever."""
    return NEVER
