"""Methods where sensors may fail: general ones know it from the declaration, others are shown the flights and not told."""

import functools

import numpy as np
import pytest
from conftest import build

from fdi_gym.diagnosis import NotApplicableError, diagnosers, find_diagnoser, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation.sensor_checks import MEMORY, REPEATED, SensorChecks
from fdi_gym.faults import Abrupt, Fault, Ramp, draw
from fdi_gym.sensors import KINDS, of_kind, sensor_mode
from fdi_gym.testing import check_diagnoser

FIRST = 4_500_000  # seed; neither test nor validation nor training flights
FLIGHTS = 15
GENERAL = ("augmented_ekf", "multiple_model_ekf", "onset_bank", "glr_ekf")
SEEN = ("freeze", "noise", "spikes")  # what no estimate shows


@functools.cache
def sick():
    return load_plant("B747Lateral", sensor_faults=True)


@functools.cache
def flown(kind):
    """Faulty flights of one kind."""
    process, found, seed = of_kind(sick(), kind), [], FIRST
    while len(found) < FLIGHTS:
        scenario = draw(process, seed)
        found += [scenario] if scenario.faults else []
        seed += 1
    return found, simulate(sick(), found)


@functools.cache
def diagnosed(name, kind):
    scenarios, record = flown(kind)
    return run(make_diagnoser(name, sick(), process="mixed", scenarios=scenarios), record.obs)


@pytest.mark.parametrize("kind", SEEN)
@pytest.mark.parametrize("name", GENERAL[:3])
def test_what_no_estimate_shows_is_named(name, kind):
    """At the flight's end; 13 of 15 and more, where 1 of 9 labels would be chance."""
    _, record = flown(kind)
    assert (diagnosed(name, kind).label[:, -1] == record.label[:, -1]).sum() >= FLIGHTS - 2


@pytest.mark.parametrize("name", GENERAL[:3])
def test_a_sensors_fault_is_not_taken_for_an_actuators(name):
    own, wrong, alarms = len(sick().bare.labels), 0, 0
    for kind in KINDS:
        said = diagnosed(name, kind).label[:, -1]
        wrong, alarms = wrong + int(((said > 0) & (said < own)).sum()), alarms + int((said > 0).sum())
    assert alarms > 3 * FLIGHTS
    assert wrong <= 0.15 * alarms


def test_a_bias_is_estimated_and_the_plants_own_faults_are_not_moved():
    _, record = flown("bias")
    said, own = diagnosed("augmented_ekf", "bias"), len(sick().bare.estimated)
    truth = record.target[:, -1, own:]
    error = said.estimate[:, -1, own:] - truth
    std = said.estimate_std[:, -1, own:]
    assert (np.abs(error / std) < 3).mean() > 0.85
    assert np.sqrt((error**2).mean()) < 0.5 * np.sqrt((truth**2).mean())


def test_the_ceiling_names_nearly_all():
    flights = [(scenarios[:5], record) for scenarios, record in map(flown, KINDS)]
    shown = np.concatenate([record.obs[:5] for _, record in flights])
    told = make_diagnoser("told_onset_bank", sick(), process="mixed", scenarios=[s for some, _ in flights for s in some])
    true = np.concatenate([record.label[:5, -1] for _, record in flights])
    assert (run(told, shown).label[:, -1] == true).mean() > 0.9


def test_a_heading_that_drifts_is_not_taken_for_a_yaw_gyro_with_a_bias():
    """Both make heading and yaw rate disagree in the same way; only a bias of the gyro begins at once."""
    plant = build("HUAVHover", sensor_faults=True)
    scenarios = []
    for i, (sensor, effect) in enumerate([("psi", Ramp("bias_psi", 0.2, 4.0)), ("r", Abrupt("bias_r", 0.05))] * 2):
        drawn = draw(plant.process("quiet"), FIRST + i)
        fault = Fault(sensor_mode(sensor), "bias", 300, [effect])
        scenarios.append(drawn.replace(steps=min(drawn.steps, 700), faults=[fault]))
    record = simulate(plant, scenarios)
    told = make_diagnoser("told_source_oracle", plant, process="mixed", scenarios=scenarios)
    names = [plant.labels[label].name for label in run(told, record.obs).label[range(4), record.length]]
    assert names == [sensor_mode("psi"), sensor_mode("r")] * 2


@pytest.mark.parametrize("kind", ["drift", "freeze", "plant"])
def test_told_the_source_nothing_of_a_sensor_is_taken_for_the_plants_nor_the_other_way_round(kind):
    """At every sample from the onset on; and nine in ten flights' ends are right, a frozen reading's all."""
    plant = sick()
    if kind == "plant":
        scenarios = [s for s in (draw(plant.bare.process("standard"), FIRST + i) for i in range(2 * FLIGHTS)) if s.faults]
        record = simulate(plant, scenarios)
    else:
        scenarios, record = flown(kind)
    said = run(make_diagnoser("told_source_oracle", plant, process="mixed", scenarios=scenarios), record.obs)
    own = len(plant.bare.labels)
    acts = record.label > 0
    assert ((said.label >= own) == (record.label >= own))[acts].all()
    assert not said.label[~acts].any()
    right = said.label[:, -1] == record.label[:, -1]
    assert right.mean() >= (1.0 if kind == "freeze" else 0.9)
    assert np.isfinite(said.estimate).all()
    with pytest.raises(NotApplicableError, match="no label of B747Lateral is a sensor's fault"):
        make_diagnoser("told_source_oracle", plant.bare, scenarios=scenarios)


def test_where_the_plant_has_no_ceiling_there_is_another():
    """What is best of a plant's own faults is none of the missile's: told the events, the bank is right more often."""
    plant = build("MissilePitch", sensor_faults=True)
    scenarios = [draw(plant.process("mixed"), FIRST + i) for i in range(6)]
    with pytest.raises(NotApplicableError, match="no ceiling of its own"):
        make_diagnoser("told_source_oracle", plant, process="mixed", scenarios=scenarios)
    record = simulate(plant, scenarios)
    said = run(make_diagnoser("told_events_oracle", plant, process="mixed", scenarios=scenarios), record.obs)
    acts = record.label > 0
    assert np.array_equal(said.label > 0, acts)
    assert (said.label == record.label)[acts].mean() > 0.85


def test_a_method_that_is_not_told_goes_by_the_plant_without():
    plant, (scenarios, record) = sick(), flown("bias")
    told = make_diagnoser("two_stage_kf", plant.bare)
    plain, shown = run(told, record.obs), run(make_diagnoser("two_stage_kf", plant, process="mixed"), record.obs)
    assert np.array_equal(plain.label, shown.label)
    own = len(plant.bare.estimated)
    assert np.array_equal(plain.estimate, shown.estimate[..., :own])
    assert not shown.estimate[..., own:].any()
    assert not find_diagnoser("two_stage_kf").hears_sensors
    assert (shown.label[:, -1] > 0).sum() >= 3  # and is taken in by what it was not told
    with pytest.raises(NotApplicableError, match="does not cover faults of sensors"):
        make_diagnoser("known_onset_oracle", plant, process="mixed", scenarios=scenarios)


@pytest.mark.parametrize("name", sorted(n for n, e in diagnosers().items() if e.sensors is not False and not e.knows))
def test_nothing_ever_reported_raises_nothing(name):
    """Every sensor silent for the whole flight: no alarm, no crash."""
    plant = sick()
    try:
        diagnoser = make_diagnoser(name, plant, process="mixed")
    except NotApplicableError as reason:
        pytest.skip(str(reason))
    obs = simulate(plant, [draw(plant.process("standard"), FIRST)]).obs[:, :300].copy()
    obs[..., : len(plant.outputs)] = np.nan
    said = run(diagnoser, obs)
    if name not in ("random", "false_alarm"):  # which look at nothing
        assert not said.alarm.any()
    assert not np.isinf(said.estimate if said.estimate is not None else 0.0).any()


@pytest.mark.parametrize("name", ["augmented_ekf", "multiple_model_ekf"])
def test_dropout_raises_no_more_alarms(name):
    """60 healthy flights with a fifth of the samples missing in bursts: what the calibrated rate allows in 99.9 %."""
    plant = build("B747Lateral", dropout=0.2, burst=10.0)
    record = simulate(plant, [draw(plant.process("fault-free"), FIRST + i) for i in range(60)])
    said = run(make_diagnoser(name, plant), record.obs)
    assert said.alarm.any(axis=1).sum() <= 9
    assert find_diagnoser(name).told(plant, "standard")[0] is plant
    assert plant.regular is not None
    assert plant.regular.options == build("B747Lateral").options  # what it knows was found without dropout


@pytest.mark.parametrize(
    "name",
    [
        "augmented_ekf",
        "multiple_model_ekf",
        "onset_bank",
        "told_events_oracle",
        "told_onset_bank",
        "told_source_oracle",
        "two_stage_kf",
    ],
)
def test_the_laws_of_diagnosers_hold_where_sensors_may_fail(name):
    check_diagnoser(lambda p, s: make_diagnoser(name, p, process="mixed", scenarios=s), sick())


# ---------------------------------------------------------------------------------------------------------------
# The checks themselves


def test_a_reading_that_comes_again_counts_and_one_at_the_end_of_the_range_does_not():
    plant, checks = sick(), SensorChecks(sick())
    s, seen = checks.start(1), np.ones((1, 4), bool)
    row = np.array([[1.0, 2.0, plant.outputs[2].high, 4.0]])
    for k in range(4):
        y = row + np.array([[0.0, k, 0.0, k]])
        s = checks.update(s, y, seen, None, None)
    gain = checks.gain(s)[0]
    names = [label.name for label in plant.labels]
    assert gain[names.index(sensor_mode("beta"))] == 3 * REPEATED
    assert gain.sum() == 3 * REPEATED
    unseen = checks.update(s, row * 0, np.zeros((1, 4), bool), None, None)
    assert np.array_equal(checks.gain(unseen), checks.gain(s))  # what did not report says nothing


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_noise_that_grows_is_seen_and_a_bias_is_not(factor):
    plant, checks = sick(), SensorChecks(sick())
    rng, n = np.random.default_rng(1), 200
    s, seen, S = checks.start(n), np.ones((n, 4), bool), np.eye(4) * 0.04
    for _ in range(4 * MEMORY):
        nu = 0.2 * rng.standard_normal((n, 4))
        nu[:, 0] *= factor
        nu[:, 1] += 0.2 * 5  # a bias that stays
        s = checks.update(s, rng.standard_normal((n, 4)), seen, nu, np.broadcast_to(S, (n, 4, 4)))
    gain = checks.gain(s)
    names = [label.name for label in plant.labels]
    beta, p = names.index(sensor_mode("beta")), names.index(sensor_mode("p"))
    v = factor**2
    assert np.median(gain[:, beta]) == pytest.approx(MEMORY * (v - 1 - np.log(v)), rel=0.15, abs=1.5)
    assert np.quantile(gain[:, p], 0.95) < 8


def test_only_a_plant_whose_sensors_may_fail_is_checked():
    plain, checked = (make_diagnoser("augmented_ekf", p).filter for p in (build("B747Lateral"), sick()))
    assert plain.read(plain.start(1)).gain is None
    assert checked.read(checked.start(1)).gain.tolist() == [[0.0] * len(sick().labels)]
