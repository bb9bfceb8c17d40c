"""Measurements that mean the same (a quaternion's negative, an angle a turn later) change nothing in what a filter says."""

import dataclasses
import functools

import numpy as np
import pytest

from fdi_gym.diagnosis import diagnosers, run
from fdi_gym.diagnosis.fitting import fit_belief
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import simulate
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.equivalent import has_equivalents, nearest
from fdi_gym.faults import draw

PLANTS = [load_plant(name) for name in plant_sources()]
DECLARING = [plant for plant in PLANTS if has_equivalents(plant)]
STEPS, FLIGHTS, PATTERNS = 200, 2, 7


def test_some_plant_declares_them():
    assert "CMGSatellite" in [plant.id for plant in DECLARING]


def test_a_wrong_declaration_is_refused():
    plant = load_plant("CMGSatellite")
    for wrong in ((0, 1, 2), (0, 1, 2, 2), (0, 1, 2, 11), (0, 1, 2, -1), (0, 1, 2, 0.5)):
        with pytest.raises(ValueError, match="quaternions"):
            dataclasses.replace(plant, quaternions=(wrong,))
    for period in (-1.0, np.nan):
        outputs = (*plant.outputs[:-1], plant.outputs[-1]._replace(period=period))
        with pytest.raises(ValueError, match="period"):
            dataclasses.replace(plant, outputs=outputs)


@pytest.mark.parametrize("signs", [True, False])
@pytest.mark.parametrize("turns", [True, False])
def test_one_kind_of_equivalent_is_enough(signs, turns):
    """A plant that declares only quaternions, or only periods, has its measurements put right too."""
    plant = load_plant("CMGSatellite")
    outputs = plant.outputs if turns else tuple(s._replace(period=0.0) for s in plant.outputs)
    plant = dataclasses.replace(plant, outputs=outputs, quaternions=plant.quaternions if signs else ())
    assert has_equivalents(plant) == (signs or turns)


# -- the rule


def turned(plant, y, quaternions=True, turns=0):
    """The same measurement said otherwise."""
    y = y.copy()
    for quaternion in plant.quaternions if quaternions else ():
        y[..., list(quaternion)] *= -1.0
    return y + turns * np.pad(plant.periods, (0, y.shape[-1] - len(plant.periods)))


@pytest.mark.parametrize("plant", DECLARING, ids=lambda plant: plant.id)
def test_the_nearest_is_found_whatever_is_reported(plant):
    rng, n = np.random.default_rng(0), 200
    x = plant.trim_state + 0.3 * rng.standard_normal((n, len(plant.states))) * [s.scale for s in plant.states]
    if plant.kernels.project is not None:
        x = plant.propagate(0.0, x, plant.trim_command)  # onto the unit quaternions
    expected = plant.measure(0.0, x, plant.trim_command)
    y = expected + 0.01 * rng.standard_normal(expected.shape) * [s.scale * (s.sigma > 0) for s in plant.outputs]
    seen = np.ones(y.shape, bool)
    np.testing.assert_array_equal(nearest(plant, y, seen, expected), y)
    for flip, turns in ((True, 0), (False, 1), (False, -3), (True, 2)):
        found = nearest(plant, turned(plant, y, flip, turns), seen, expected)
        np.testing.assert_allclose(found, y, atol=1e-12)
    unknown = np.full_like(expected, np.nan)
    other = turned(plant, y, True, 1)
    np.testing.assert_array_equal(nearest(plant, other, seen, unknown), other, "nothing is expected: it is as reported")
    some = seen & (np.arange(y.shape[1]) % 3 != 0)
    np.testing.assert_allclose(
        np.where(some, nearest(plant, other, some, expected), 0.0), np.where(some, y, 0.0), atol=1e-12
    )


def test_a_sign_that_nobody_reports_is_told_from_the_vector_and_noise_turns_nothing():
    plant = load_plant("CMGSatellite")
    expected = np.array([[0.1, -0.05, 0.02, *[0.0] * 7, 1.0]] * 4)
    expected[2:, :3] = 1e-5
    y, seen = expected.copy(), np.ones((4, 11), bool)
    y[1, :3] *= -1.0  # the negative, without its sign
    y[2, :3], y[3, :3] = 2e-4, [-1e-4, 2e-4, -1e-4]  # noise about zero, on the other side in two of three
    y[:, 10], seen[:, 10] = 0.0, False
    found = nearest(plant, y, seen, expected)
    np.testing.assert_array_equal(found[:, :3], [y[0, :3], -y[1, :3], y[2, :3], y[3, :3]])


def test_a_prior_that_says_little_leaves_the_choice_to_the_sign():
    """Attitudes 130 degrees and more from what is expected, reported in either hemisphere."""
    plant = load_plant("CMGSatellite")
    expected = np.array([[-0.7, 0.0, 0.1, *[0.0] * 7, 1.0]])
    y = np.array([[0.8, 0.1, 0.0, *[0.0] * 7, 1.0]])
    seen = np.ones((1, 11), bool)
    np.testing.assert_array_equal(nearest(plant, y, seen, expected), y)
    np.testing.assert_array_equal(nearest(plant, turned(plant, y), seen, expected), y)


# -- every filter that there is


@functools.cache
def flights(plant_id):
    """A faulty and a healthy flight, and what may be believed of the plant."""
    plant = load_plant(plant_id)
    drawn = [draw(plant.process("standard"), 2_700_000 + i) for i in range(40)]
    faulty = next(s for s in drawn if s.faults)
    moved = [type(f)(f.mode, f.kind, 60, f.effects) for f in faulty.faults]
    scenarios = [faulty.replace(faults=moved, steps=STEPS), drawn[0].without_faults().replace(steps=STEPS)]
    return scenarios, simulate(plant, scenarios), fit_belief(plant, "standard")


def built(plant):
    """All diagnosers of the plant that are filters, with one threshold for all modes."""
    scenarios, _, belief = flights(plant.id)
    scenarios = scenarios * PATTERNS
    given = {
        "belief": belief, "process": "standard", "scenarios": scenarios,
        "calibration": Calibration(thresholds={mode.name: 30.0 for mode in plant.modes}),
    }  # fmt: skip
    for name, entry in diagnosers().items():
        try:
            entry.told(plant, "standard")
            diagnoser = entry.build(plant, **{k: v for k, v in given.items() if entry.takes(k)}, **entry.resolve(plant))
        except ValueError:  # it does not suit this plant
            continue
        if diagnoser.filter is not None:
            yield name, diagnoser


@pytest.mark.parametrize("plant", DECLARING, ids=lambda plant: plant.id)
def test_an_equal_measurement_gives_an_equal_diagnosis(plant):
    _, record, _ = flights(plant.id)
    k = np.arange(STEPS + 1)[None, :, None]
    otherwise = {
        "the negative from sample 75 on": np.where(k >= 75, turned(plant, record.obs), record.obs),
        "the negative from the first sample on": turned(plant, record.obs),
        "the negative at every other sample": np.where(k % 2 == 1, turned(plant, record.obs), record.obs),
        "a turn later from sample 75 on": np.where(k >= 75, turned(plant, record.obs, False, 1), record.obs),
        "a gap, and the negative after it": np.where(k >= 100, turned(plant, record.obs), record.obs),
    }
    otherwise["a gap, and the negative after it"][:, 70:100] = np.nan
    gap = record.obs.copy()
    gap[:, 70:100] = np.nan
    names, wrong = list(otherwise), []
    filters = dict(built(plant))
    assert len(filters) > 10
    for name, diagnoser in filters.items():
        batch = np.concatenate([record.obs, gap, *otherwise.values()])
        said = run(diagnoser, batch)
        parts = [slice(i * FLIGHTS, (i + 1) * FLIGHTS) for i in range(len(names) + 2)]
        for pattern, part in zip(names, parts[2:], strict=True):
            same = parts[1] if "gap" in pattern else parts[0]
            equal = np.array_equal(said.label[part], said.label[same]) and np.array_equal(said.alarm[part], said.alarm[same])
            if said.estimate is not None:
                scale = np.array([s.scale for s in plant.estimated])
                equal &= bool(np.nanmax(np.abs(said.estimate[part] - said.estimate[same]) / scale) < 1e-6)
            if not equal:
                wrong.append(f"{name}: {pattern}")
    assert not wrong
