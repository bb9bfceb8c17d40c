"""Shared by all tests: the plants and diagnosers there are, and the fifth plant of the examples."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

import pytest

import fdi_gym
from fdi_gym.plant import Plant, load_plant, plant_sources

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "examples"))
PLANTS = list(plant_sources())
if "DCMotor" not in PLANTS:
    fdi_gym.register_plant("DCMotor", "dc_motor:plant")

build = functools.cache(load_plant)


@pytest.fixture(params=[*PLANTS, "DCMotor"])
def plant(request: pytest.FixtureRequest) -> Plant:
    """Every plant there is, with its default options."""
    return build(request.param)


@pytest.fixture
def b747() -> Plant:
    return build("B747Lateral")


@pytest.fixture
def motor() -> Plant:
    return build("DCMotor")
