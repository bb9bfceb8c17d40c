"""Shared by all tests: the plants and diagnosers there are, and the fifth plant of the examples."""

from __future__ import annotations

import functools
import importlib
import sys
from pathlib import Path

import pytest

from fdi_gym.engine import simulate
from fdi_gym.estimation import calibration, unknown_inputs
from fdi_gym.estimation.prior import flights_of
from fdi_gym.plant import Plant, load_plant, plant_sources

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "examples"))
PLANTS = list(plant_sources())
importlib.import_module("dc_motor")  # registers itself

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


@pytest.fixture
def short_calibrations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrations on four flights of at most 100 samples, kept nowhere: for tests that don't count alarms."""

    def short(plant, process, first, count, faults):
        scenarios, _ = flights_of(plant, process, first, min(count, 4), faults)
        scenarios = [s.replace(steps=min(s.steps, 100)) for s in scenarios]
        return scenarios, simulate(plant, scenarios)

    monkeypatch.setattr(calibration, "flights_of", short)
    monkeypatch.setattr(unknown_inputs, "flights_of", short)
    monkeypatch.setattr(calibration, "_kept", {})
    monkeypatch.setattr(calibration, "cache_folder", lambda source: None)
