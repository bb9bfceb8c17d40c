"""Every plant, environment and diagnoser that exists keeps the contract."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from conftest import PLANTS, build
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from fdi_gym.diagnosis import NotApplicableError, diagnosers, make_diagnoser, run
from fdi_gym.engine import simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import draw
from fdi_gym.testing import check_diagnoser, check_plant, check_streams, check_vector_env

TASKS = [
    {},
    {"task": "identification"},
    {"decision_period": 7},
    {"task": "identification", "units": "scaled"},
    {"task": "diagnosis", "units": "scaled"},
    {"task": "scenario"},
]


def test_plant(plant):
    check_plant(plant, seeds=range(3))
    check_streams(plant)


@pytest.mark.parametrize("arguments", TASKS, ids=lambda a: "-".join(map(str, a.values())) or "isolation")
def test_vector_env_equals_single_ones(plant, arguments):
    check_vector_env(plant, n=3, steps=200, **arguments)


def test_vector_env_under_mismatch(plant):
    if plant.perturb is None:
        pytest.skip("declares no mismatch")
    check_vector_env(plant, n=2, steps=200, mismatch=0.01)


@pytest.mark.parametrize(
    "arguments",
    [{}, *({"task": task, "units": "scaled"} for task in ("identification", "diagnosis", "scenario"))],
    ids=["isolation", "identification", "diagnosis", "scenario"],
)
def test_env_checkers_are_silent(plant, arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(FDIEnv(plant.id, **arguments), skip_render_check=True)
        check_env_sb3(FDIEnv(plant.id, **arguments))


@pytest.mark.parametrize("plant_id", PLANTS)
def test_made_by_id_in_both_forms(plant_id):
    env = gym.make(build(plant_id).env_id)
    many = gym.make_vec(f"fdi_gym:{build(plant_id).env_id}", num_envs=2)
    first, _ = env.reset(seed=5)
    both, _ = many.reset(seed=5)
    assert np.array_equal(first, both[0])


@pytest.mark.parametrize("plant_id", PLANTS)
@pytest.mark.parametrize("name", list(diagnosers()))
def test_diagnoser(plant_id, name):
    entry = diagnosers()[name]

    def make(plant, scenarios):
        return make_diagnoser(name, plant, scenarios=scenarios if entry.clairvoyant else None)

    try:
        make(build(plant_id), [draw(build(plant_id).processes["standard"], 0)])
    except NotApplicableError as reason:
        pytest.skip(str(reason))
    check_diagnoser(make, build(plant_id), samples=150)


@pytest.mark.parametrize("plant_id", PLANTS)
@pytest.mark.parametrize("name", [name for name, entry in diagnosers().items() if entry.clairvoyant])
def test_an_oracle_is_told_of_faults_beyond_the_end_of_the_flight(plant_id, name):
    """They change nothing: a flight that is cut is diagnosed as the same flight without them."""
    plant, samples = build(plant_id), 12
    cut = [s.replace(steps=samples) for s in (draw(plant.process("standard"), seed) for seed in range(40)) if s.faults][:3]
    assert all(fault.onset > samples for s in cut for fault in s.faults)
    obs = simulate(plant, cut).obs
    try:
        said = [
            run(make_diagnoser(name, plant, scenarios=told), obs).label for told in (cut, [s.without_faults() for s in cut])
        ]
    except NotApplicableError as reason:
        pytest.skip(str(reason))
    assert np.array_equal(*said)
