"""Many samples in one compiled call say to the bit what the same filter says sample by sample."""

import itertools

import numpy as np
import pytest
from conftest import PLANTS, build
from numba import njit

from fdi_gym.diagnosis import NotApplicableError, diagnosers, find_diagnoser, make_diagnoser, run
from fdi_gym.diagnosis.contract import map_arrays
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.integration import LANES
from fdi_gym.vectors import above, choose, filled, load, root, store

SWEPT = ("augmented_ekf", "augmented_ukf", "augmented_cdkf", "augmented_ekf_thresholds", "augmented_kf")
CASES = [pair for pair in itertools.product(PLANTS, SWEPT) if pair[0] == "B747Lateral" or pair[1] != "augmented_kf"]
N, SAMPLES = 11, 1200


def flights(plant, seed=0):
    """Observations (N, SAMPLES, n_obs) with scattered gaps, a sensor that is silent for long, and a time without any."""
    process = plant.process("standard" if "standard" in plant.processes else next(iter(plant.processes)))
    scenarios = [draw(process, 700 + seed + i) for i in range(N)]
    obs, m = simulate(plant, scenarios).obs[:, :SAMPLES].copy(), len(plant.outputs)
    rng = np.random.default_rng(seed)
    obs[:, :, :m][rng.random(obs[:, :, :m].shape) < 0.05] = np.nan
    obs[: N // 2, 60:100, 0] = np.nan
    obs[:, 120:131, :m] = np.nan
    return obs


def same(a, b):
    return all(
        (x is None) == (y is None) and (x is None or np.array_equal(x, y, equal_nan=True)) for x, y in zip(a, b, strict=True)
    )


@pytest.mark.parametrize(("plant_id", "name"), CASES)
def test_a_sweep_says_what_the_steps_say(plant_id, name):
    """In batches that fill the lanes, leave some empty, or are one flight; and the filter goes on from where it ended."""
    plant = build(plant_id)
    diagnoser, obs = make_diagnoser(name, plant), flights(plant)
    single = diagnoser._replace(sweep=None)
    if diagnoser.sweep is None:
        assert plant.quaternions or plant.periods.any()
        return
    expected = run(single, obs)
    assert expected.alarm.any()
    for rows in (slice(0, N), slice(0, LANES), slice(3, 4)):
        assert same(run(diagnoser, obs[rows]), map_arrays(lambda a, rows=rows: a[rows], expected))
    state = diagnoser.update(diagnoser.init(N), obs[:, 0])[0]
    found = diagnoser.sweep(state, obs[:, 1:150])
    assert found is not None
    state, said = found
    assert said.label.shape == (N, 149)
    for k in range(150, obs.shape[1]):
        state, said = diagnoser.update(state, obs[:, k])
        now = type(said)(*(None if a is None else a[:, k] for a in expected[:-1]), None)
        assert same(said[:-1], [now.alarm, now.label, now.estimate, now.estimate_std, now.label_probs, now.state])


@pytest.mark.parametrize("plant_id", PLANTS)
def test_what_it_cannot_do_goes_step_by_step(plant_id):
    """A command that did not report, and an episode that is lost, are seen to sample by sample; no other loses by it."""
    plant = build(plant_id)
    diagnoser, obs = make_diagnoser("augmented_ekf", plant), flights(plant, 1)
    single = diagnoser._replace(sweep=None)
    held = obs.copy()
    held[2, 50:60, len(plant.outputs)] = np.nan
    mad = obs.copy()
    mad[4, 80, 0] = 1e300
    for given in (held, mad):
        assert same(run(diagnoser, given), run(single, given))
        if diagnoser.sweep is not None:
            state = diagnoser.update(diagnoser.init(N), given[:, 0])[0]
            if given is held:
                assert diagnoser.sweep(state, given[:, 1:]) is None
    if diagnoser.sweep is not None:
        assert diagnoser.sweep(diagnoser.init(N), obs) is None  # before the first sample


@pytest.mark.parametrize("plant_id", ["B747Lateral", "ThreeTank"])
def test_every_method_with_a_sweep_is_tested_here(plant_id):
    plant, found = build(plant_id), set()
    for name in diagnosers():
        if not find_diagnoser(name).clairvoyant:
            try:
                found |= {name} if make_diagnoser(name, plant).sweep is not None else set()
            except NotApplicableError:
                continue
    assert found == {name for case, name in CASES if case == plant_id}


@njit(error_model="numpy")
def _algebra(A, out, flags):
    v, w = load(A, 0, 0), load(A, 1, 0)
    store(out, 0, 0, v + w * 2.0 - v / w)
    store(out, 1, 0, choose(v - w, root(w * w), 3.0 - v))
    v -= w
    store(out, 2, 0, v)
    flags[0], flags[1], flags[2], flags[3] = above(v), above(v - v), filled(v), filled(v - v)


def test_vectors_are_numbers_side_by_side():
    A, out, flags = np.random.default_rng(3).standard_normal((2, LANES)), np.zeros((3, LANES)), np.zeros(4, bool)
    A[0, 2] = np.nan
    _algebra(A, out, flags)
    v, w = A
    assert np.array_equal(out[0], v + w * 2.0 - v / w, equal_nan=True)
    assert np.array_equal(out[1], np.where(v > w, np.sqrt(w * w), 3.0 - v), equal_nan=True)
    assert np.array_equal(out[2], v - w, equal_nan=True)
    assert flags.tolist() == [True, False, True, True]  # what is no number is not above 0, and is not 0
