"""Shared by all tests: the plants and diagnosers there are, and the plant of the examples."""

from __future__ import annotations

import functools
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from fdi_gym.diagnosis import filtering
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.estimation.decision import Rule, Verdict
from fdi_gym.plant import Plant

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


SILENT = Rule(lambda n: np.zeros(n), lambda s, k, r, informed: (s, Verdict(s > 0, s.astype(int))))


def states(plant, filter, obs, begun=None):
    """The state of a filter after each sample of observations (N, K, n_obs); `begun`: a state to start from."""
    start, step = filtering.shell(plant, filter, SILENT)
    s = start(len(obs))
    if begun is not None:
        s = s._replace(filter=begun)
    for k in range(obs.shape[1]):
        s, *_ = step(s, obs[:, k])
        yield s.filter


def readings(plant, filter, obs):
    """What a filter reads after each sample."""
    return (filter.read(s) for s in states(plant, filter, obs))
