"""Fault modes with more than one magnitude: a gain and a bias that move each for itself are a plane."""

import dataclasses
import functools

import numpy as np
import pytest
import valve
from conftest import PLANTS, build
from scipy.optimize import minimize
from scipy.stats import chi2

from baselines.filters.hypothesis_bank import transitions
from baselines.filters.mode_pursuit import Lines
from baselines.filters.multiple_model import hypotheses
from fdi_gym.acts import accommodated
from fdi_gym.declaration import ONSET, PRESENT, SIZE, bounds, columns, declared, errors, true_declaration, worth
from fdi_gym.diagnosability import diagnosability
from fdi_gym.diagnosis import Decisions, make_diagnoser, run
from fdi_gym.diagnosis.fitting import fit_belief
from fdi_gym.engine import simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.estimation.belief import fault_inputs
from fdi_gym.estimation.calibration import LEAST, least
from fdi_gym.estimation.labels import (
    channel_sets,
    distances,
    flags_of,
    label_of_channels,
    manifolds,
    nearest_of,
    tells_apart,
)
from fdi_gym.estimation.signatures import secants
from fdi_gym.faults import Abrupt, Fault, draw
from fdi_gym.options import Options
from fdi_gym.tasks import TASKS
from fdi_gym.testing import check_diagnoser, check_plant

FIRST, FLIGHTS = 4_700_000, 40  # seeds of neither test nor validation nor training flights
GENERAL = ("augmented_ekf", "multiple_model_ekf", "glr_ekf", "mode_pursuit_ekf", "told_onset_ekf", "told_onset_bank")
VALVE, LEAK, BOTH = 1, 2, 3


@functools.cache
def plane(**options):
    return build(valve.ID, **options)


@functools.cache
def flown():
    scenarios = [draw(plane().process("standard"), FIRST + i) for i in range(FLIGHTS)]
    return scenarios, simulate(plane(), scenarios)


@functools.cache
def diagnosed(name):
    scenarios, record = flown()
    return run(make_diagnoser(name, plane(), scenarios=scenarios), record.obs)


def last(record):
    return np.arange(len(record.length)), record.length


# ---------------------------------------------------------------------------------------------------------------
# Declaration and truth


@pytest.mark.parametrize("options", [{}, {"sensor_faults": True}, {"sensor_faults": True, "simultaneous": True}])
def test_a_plant_with_a_plane_keeps_the_laws_of_plants(options):
    check_plant(plane(**options), seeds=range(8))


@pytest.mark.parametrize(("wrong", "match"), [
    ({"reach": (valve.GAIN, (-0.1, 0.1))}, "valve is at .* whose reach is"),
    ({"direction": ((1.0, 0.0, 0.0), (0.0, 1.0, 1.0))}, "off the declared line|on its line"),
    ({"direction": (1.0, 0.0, 0.0), "reach": valve.GAIN}, "off the declared line"),
    ({"direction": ((1.0, 0.0, 0.0), (2.0, 0.0, 0.0))}, "independent directions"),
    ({"direction": ((1.0, 0.0, 0.0), (0.0, 1.0))}, "3 finite numbers in direction"),
    ({"direction": ((1.0, 0.0, 0.0), 1.0)}, "3 finite numbers in direction"),
    ({"direction": ((1.0, 0.0, 0.0), (0.0, np.nan, 0.0))}, "3 finite numbers in direction"),
    ({"direction": (1.0, 0.0, 0.0)}, "3 finite numbers in direction"),
    ({"reach": valve.GAIN}, "2 finite numbers in reach"),
    ({"reach": (valve.GAIN,)}, "a range in reach for each direction, not 1 for 2"),
    ({"reach": (valve.GAIN, (0.5, -0.5))}, "reach in rising order"),
])  # fmt: skip
def test_a_wrong_plane_is_found_and_named(wrong, match):
    def check():
        mode = plane().modes[0]._replace(**wrong)
        check_plant(dataclasses.replace(plane(), modes=(mode, plane().modes[1])), seeds=range(12))

    with pytest.raises((ValueError, AssertionError), match=match):
        check()


def test_a_line_is_a_plane_of_one_direction():
    """To the byte: beliefs, evidence and diagnoses."""
    a, b = plane(as_rows=True), plane(as_rows=False)
    assert np.ndim(a.modes[1].direction) == 2
    assert np.ndim(b.modes[1].direction) == 1
    for mine, theirs in zip(manifolds(a), manifolds(b), strict=True):
        assert mine.tobytes() == theirs.tobytes()
    scenarios = flown()[0][:6]
    obs = simulate(a, scenarios).obs
    assert obs.tobytes() == simulate(b, scenarios).obs.tobytes()
    for name in ("augmented_ekf", "multiple_model_ekf"):
        mine, theirs = (run(make_diagnoser(name, p), obs) for p in (a, b))
        assert mine.label.tobytes() == theirs.label.tobytes()
        assert mine.estimate.tobytes() == theirs.estimate.tobytes()


def test_magnitudes_are_those_that_made_the_deviation():
    plant, rng = plane(), np.random.default_rng(0)
    assert [which.tolist() for which in plant.magnitudes_of] == [[0, 1], [2]]
    assert plant.reaches.tolist() == [list(valve.GAIN), list(valve.BIAS), list(valve.LEAK)]
    m = rng.uniform(*plant.reaches.T, size=(50, 3))
    found = plant.magnitudes(np.full(50, BOTH), m)
    assert found == pytest.approx(m)
    alone = plant.magnitudes(np.full(50, VALVE), m * [1, 1, 0])
    assert alone[:, :2] == pytest.approx(m[:, :2])
    assert np.isnan(alone[:, 2]).all()
    assert np.isnan(plant.magnitudes(np.zeros(3, int), np.zeros((3, 3)))).all()


# ---------------------------------------------------------------------------------------------------------------
# Labels as sets


def test_the_distance_to_a_plane_is_that_of_its_closest_point():
    plant, rng = plane(), np.random.default_rng(1)
    sets, n = manifolds(plant), 30
    assert sets.magnitudes.tolist() == [2, 1, 3]
    z, A = rng.normal(0.0, 0.6, (n, 3)), rng.standard_normal((n, 3, 3))
    P = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(3)
    found = distances(z, P, sets)
    I = np.linalg.inv(P)  # noqa: E741
    inside = 0
    for i in range(n):

        def distance(m, D, i=i):
            r = z[i] - m @ D
            return r @ I[i] @ r

        for s, mode in enumerate(plant.modes):
            D, box = mode.directions, mode.reaches
            by_hand = minimize(
                distance, box.mean(axis=1), (D,), "L-BFGS-B", bounds=box, options={"ftol": 1e-15, "gtol": 1e-10}
            )
            assert found.J[i, 1 + s] == pytest.approx(by_hand.fun, rel=1e-6, abs=1e-9)
        free = np.linalg.solve(plant.modes[0].directions @ I[i] @ plant.modes[0].directions.T,
                               plant.modes[0].directions @ I[i] @ z[i])  # fmt: skip
        low, high = plant.modes[0].reaches.T
        if ((free > low) & (free < high)).all():
            inside += 1
            assert found.m[i, 0, :2] == pytest.approx(free)
    assert inside > 0


def test_what_a_plane_gains_without_a_fault_is_chi_square_of_two_degrees_of_freedom():
    """The free maximum of the likelihood ratio over the plane; its 95 % point is the least threshold."""
    sets, rng, n = manifolds(plane()), np.random.default_rng(2), 20_000
    wide = sets._replace(low=np.full_like(sets.low, -1e9), high=np.full_like(sets.high, 1e9))
    A = rng.standard_normal((3, 3))
    I = A @ A.T + np.eye(3)  # noqa: E741
    Iz = rng.multivariate_normal(np.zeros(3), I, n)
    value, _ = nearest_of(I[None], Iz, wide)
    for s, f in enumerate((2, 1, 3)):
        gain = -value[:, s]
        assert gain.mean() == pytest.approx(f, abs=5 * np.sqrt(2 * f / n))
        assert (gain > chi2.ppf(0.95, f)).mean() == pytest.approx(0.05, abs=5 * np.sqrt(0.05 * 0.95 / n))
    assert [least(mode) for mode in plane().modes] == [5.99, LEAST]
    assert least(plane().modes[0]) == pytest.approx(chi2.ppf(0.95, 2), abs=0.005)


def test_signatures_are_taken_to_the_sides_that_the_plane_reaches():
    low, high = secants(plane(), np.array([0.4, 0.3, 0.5]))
    assert low.tolist() == [-0.4, -0.3, 0.0]
    assert high.tolist() == [0.0, 0.3, 0.5]


def test_a_flag_on_any_channel_of_a_plane_names_it():
    plant = plane()
    inputs = fault_inputs(plant)
    labels, sets = channel_sets(plant, inputs)
    assert dict(zip(labels.tolist(), sets.tolist(), strict=True)) == {
        0: [False] * 3, VALVE: [True, True, False], LEAK: [False, False, True], BOTH: [True] * 3
    }  # fmt: skip
    assert tells_apart(plant, inputs)
    on = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]], bool)
    said = label_of_channels(*flags_of(plant, inputs), on, np.ones(on.shape))
    assert said.tolist() == [0, VALVE, VALVE, VALVE, LEAK, BOTH, BOTH, BOTH]
    Pi = transitions(sets, 0.01, 0.1)
    assert Pi.sum(axis=1) == pytest.approx(1.0)
    order = labels.tolist()
    assert Pi[order.index(0), order.index(VALVE)] == 0.01  # a plane is one fault, whatever its channels
    assert Pi[order.index(BOTH), order.index(LEAK)] == 0.1
    assert Pi[order.index(0), order.index(BOTH)] == 0.0


@pytest.mark.parametrize("plant_id", PLANTS)
def test_where_no_fault_is_a_plane_each_label_has_one_row_of_flags(plant_id):
    """Also that of a stuck surface, which moves two entries of the fault vector along one line."""
    plant = build(plant_id)
    inputs = fault_inputs(plant)
    if all(len(mode.directions) == 1 for mode in plant.modes):
        for found, expected in zip(flags_of(plant, inputs), channel_sets(plant, inputs), strict=True):
            assert np.array_equal(found, expected)


# ---------------------------------------------------------------------------------------------------------------
# Methods


def test_a_belief_has_a_magnitude_for_each_direction():
    belief = fit_belief(plane(), "standard")
    assert belief.m_mean.shape == (3,)
    assert belief.m_mean[[0, 2]] == pytest.approx([np.mean(valve.GAIN), np.mean(valve.LEAK)], abs=0.12)  # of 32 flights
    assert belief.m_std[0] == pytest.approx(0.4 / 12**0.5, abs=0.06)
    assert belief.m_std[1] == pytest.approx(0.32, abs=0.08)  # of either sign, from 0.1 to 0.5
    h = hypotheses(plane(), belief)
    assert h.model.lines[1][VALVE].tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
    assert h.model.lines[1][BOTH].tolist() == np.eye(3).tolist()
    assert h.m0[VALVE].tolist() == [*belief.m_mean[:2], 0.0]
    assert h.m0[LEAK].tolist() == [belief.m_mean[2], 0.0, 0.0]


@pytest.mark.parametrize("name", GENERAL)
def test_every_general_method_knows_the_plane(name):
    """Of 40 flights, a quarter each, at their ends; and gain and bias are both estimated."""
    _, record = flown()
    said, rows = diagnosed(name), last(record)
    truth = record.label[rows]
    assert min(np.bincount(truth, minlength=4)) >= 5
    assert (said.label[rows] == truth).mean() >= 0.9
    mine = (truth == VALVE) & (said.label[rows] == VALVE)
    assert mine.sum() >= 5
    error = (said.estimate - record.target)[rows][mine][:, :2]
    size = np.sqrt((record.target[rows][mine][:, :2] ** 2).mean(axis=0))
    assert (np.sqrt((error**2).mean(axis=0)) < 0.25 * size).all()


@pytest.mark.parametrize("name", ["augmented_ekf", "multiple_model_ekf"])
def test_the_estimates_of_gain_and_bias_are_as_sure_as_they_say(name):
    _, record = flown()
    said, rows = diagnosed(name), last(record)
    mine = (record.label[rows] == VALVE) & (said.label[rows] == VALVE)
    ratio = (said.estimate - record.target)[rows][mine][:, :2] / said.estimate_std[rows][mine][:, :2]
    assert (np.abs(ratio) < 3).mean() > 0.85


@pytest.mark.parametrize("name", GENERAL)
def test_the_laws_of_diagnosers_hold_on_a_plane(name):
    check_diagnoser(lambda p, s: make_diagnoser(name, p, scenarios=s), plane())


def test_pursuit_takes_a_plane_for_one_mode():
    lines, rng = Lines(plane()), np.random.default_rng(3)
    I = np.diag([50.0, 80.0, 60.0])[None] + 5.0  # noqa: E741
    z = np.concatenate([rng.uniform(0.3, 0.6, (10, 2)), np.zeros((10, 1))], axis=1)
    gained, alone = lines.pursue(z, np.tile(I, (10, 1, 1)), np.array([5.99, 3.84]))
    assert gained[:, 0] == pytest.approx(np.einsum("np,pq,nq->n", z, I[0], z), rel=1e-6)  # all of it is on the plane
    assert (gained[:, 1] == 0).all()
    assert (alone[:, 1] < alone[:, 0]).all()
    z[:, 2] = 0.8
    both, _ = lines.pursue(z, np.tile(I, (10, 1, 1)), np.array([5.99, 3.84]))
    assert (both > 0).all()
    assert both.sum(axis=1) == pytest.approx(np.einsum("np,pq,nq->n", z, I[0], z), rel=1e-6)


def test_the_bound_of_a_magnitude_counts_that_the_other_is_not_known():
    found = diagnosability(plane(), flights=4)
    assert found.magnitudes == ("valve gain", "valve bias", "leak")
    gain = dataclasses.replace(plane(), modes=tuple(
        m._replace(direction=(1.0, 0.0, 0.0), reach=valve.GAIN) if m.name == "valve" else m for m in plane().modes
    ))  # fmt: skip
    alone = diagnosability(gain, flights=4, belief=fit_belief(plane(), "standard").__class__(**{
        **{f: getattr(fit_belief(plane(), "standard"), f) for f in fit_belief(plane(), "standard").__struct_fields__},
        "m_mean": np.zeros(2), "m_std": np.ones(2), "m_walk": np.ones(2),
    }))  # fmt: skip
    assert (found.bound[-1, 0] > 1.5 * alone.bound[-1, 0]).all()
    assert found.bound[-1, 2] == pytest.approx(alone.bound[-1, 1])
    assert "valve bias" in found.text()


# ---------------------------------------------------------------------------------------------------------------
# Scores, tasks, acting


def test_a_declaration_has_a_size_for_each_magnitude():
    plant = plane()
    scenarios, record = flown()
    assert columns(plant) == SIZE + 2
    assert bounds(plant).tolist() == [[list(valve.GAIN), list(valve.BIAS)], [list(valve.LEAK), [0.0, 0.0]]]
    truth = true_declaration(plant, record)
    for scenario, rows in zip(scenarios, truth, strict=True):
        for fault in scenario.faults:
            row = rows[plant.mode_names.index(fault.mode)]
            assert row[SIZE : SIZE + len(fault.effects)] == pytest.approx([e.value for e in fault.effects])
    whole = declared(plant, Decisions(record.label > 0, record.label, record.target, None, None), record.length)
    assert worth(plant, truth, whole) == pytest.approx(1.0)
    i = int(np.argmax(record.label[last(record)] == VALVE))
    for column, (low, high) in enumerate(plant.modes[0].reaches, SIZE):
        off = truth.copy()
        off[i, 0, column] -= 0.3 * (high - low)
        assert errors(plant, truth, off).size[i, 0] == pytest.approx(-0.3)
        assert worth(plant, truth, off)[i] == pytest.approx(1 - 0.3 / 3)


@pytest.mark.parametrize("units", ["physical", "scaled"])
def test_the_true_declaration_as_an_action_is_worth_one(units):
    plant, scenario = plane(), next(s for s in flown()[0] if len(s.faults) == 2)
    env = FDIEnv(plant, task="scenario", units=units, scenario=scenario)
    record = simulate(plant, [scenario])
    truth = true_declaration(plant, record)
    action = TASKS["scenario"](plant, units == "scaled").action(truth, record.length)[0]
    assert env.action_space.contains(action)
    env.reset(seed=0)
    over, reward = False, 0.0
    while not over:
        _, reward, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    assert reward == pytest.approx(1.0, abs=1e-5)
    assert truth[0, 0, [PRESENT, ONSET]].tolist() == [1.0, scenario.faults[0].onset]


def test_a_controller_allows_for_both_magnitudes_within_their_reach():
    plant = plane()
    label = np.array([VALVE, VALVE, LEAK, BOTH, 0])
    estimate = np.array([[-0.3, 0.2, 0.9], [-0.9, 0.7, 0.0], [-0.3, 0.2, 0.5], [-0.3, 0.2, 0.5], [-0.3, 0.2, 0.5]])
    assert accommodated(plant, label, estimate) == pytest.approx(
        np.array([[-0.3, 0.2, 0.0], [-0.6, 0.5, 0.0], [0.0, 0.0, 0.5], [-0.3, 0.2, 0.5], [0.0, 0.0, 0.0]])
    )
    assert accommodated(plant, label[:1]) == pytest.approx(np.array([[np.mean(valve.GAIN), np.mean(valve.BIAS), 0.0]]))


def test_a_sensors_fault_is_told_from_the_plane():
    plant = Options(sensor_faults=True).applied(plane())
    name = plant.modes[-1].name
    bias = Fault(name, "", 100, [Abrupt("bias_level", 0.2)])
    scenarios = [s.replace(faults=[bias]) for s in flown()[0][:5]]
    said = run(make_diagnoser("multiple_model_ekf", plant, process="mixed"), simulate(plant, scenarios).obs)
    assert (said.label[:, -1] == plant.label_of(frozenset({name}))).all()
