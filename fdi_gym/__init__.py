"""Gymnasium environments for fault detection, isolation and identification (FDI).

Importing this package registers every environment and nothing more: numba, matplotlib and torch are imported when an
environment, a picture or a network is first made.
"""

import gymnasium as gym

from fdi_gym.discovery import PlantSource, add_plant_source, plant_sources

__version__ = "0.1.0"


def _register_environment(plant_id: str, version: int) -> None:
    for kind, single, vector in (
        ("Faults", "envs:FDIEnv", "vector_envs:FDIVectorEnv"),
        ("Active", "active_envs:ActiveEnv", "active_envs:ActiveVectorEnv"),
    ):
        gym.register(
            id=f"{plant_id}-{kind}-v{version}",
            entry_point=f"fdi_gym.{single}",
            vector_entry_point=f"fdi_gym.{vector}",
            kwargs={"plant": plant_id},
        )


def register_plant(plant_id: str, builder: str, version: int = 0) -> str:
    """Register the environment of a plant outside the package and return its Gymnasium id.

    Args:
        plant_id: The id its `Plant` declares.
        builder: "module:function" of the function that builds it; worker processes import it by that name.
        version: The version its `Plant` declares.

    Raises:
        ValueError: The id, version or builder cannot be one, or the id is that of a plant of this package.
    """
    add_plant_source(plant_id, PlantSource(builder, version))
    _register_environment(plant_id, version)
    return f"{plant_id}-Faults-v{version}"


for _id, _source in plant_sources().items():
    _register_environment(_id, _source.version)
