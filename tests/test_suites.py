"""What suites hold, and that scores on them mean what they say: laws over all suites and all plants."""

import msgspec
import numpy as np
import pytest
from conftest import ROOT, build

from fdi_gym import design
from fdi_gym.design import DECISIONS, by_label, truths
from fdi_gym.diagnosis import Decisions, make_diagnoser, run
from fdi_gym.discovery import plant_sources
from fdi_gym.engine import Record, simulate
from fdi_gym.metrics import outcome
from fdi_gym.scores import summarise
from fdi_gym.suite import Suite, chained, load_suite, suite_names

SUITES = suite_names()
DRAWN = [  # with every label of the plant
    name for name in SUITES if not name.endswith("-paper") and load_suite(name).process != "quiet"
]


def record_of(plant, scenarios):
    """The true labels of flights that nobody flies: all that isolation is scored by."""
    samples = 1 + max(s.steps for s in scenarios)
    label = np.zeros((len(scenarios), samples), np.int64)
    for row, scenario in zip(label, scenarios, strict=True):
        row[: scenario.steps + 1] = plant.label_rows(scenario)
    theta = np.broadcast_to(plant.nominal_theta, (*label.shape, len(plant.nominal_theta)))
    target = np.broadcast_to(plant.healthy, (*label.shape, len(plant.estimated)))
    obs = np.zeros((*label.shape, 1))
    return Record(obs, obs, theta, target, label, np.array([s.steps for s in scenarios]), np.zeros(len(label), bool))


def scores(plant, process, record, said):
    scoring = plant.process(process).scoring
    found = [outcome(plant, scoring, record, said, i) for i in range(len(record.label))]
    return summarise(found, len(plant.labels), [s.name for s in plant.estimated], plant.dt)


@pytest.mark.parametrize("name", SUITES)
def test_the_truth_scores_one_and_null_scores_chance(name):
    """The truth: all right, by sample and by decision, in detection, at once. Null: right about healthy flights alone."""
    suite = load_suite(name)
    plant = suite.build()
    record = record_of(plant, suite.scenarios(plant, range(suite.episodes)))
    truth = scores(plant, suite.process, record, Decisions(record.label > 0, record.label, None, None, None))
    for kind in ("per_sample", "per_decision"):
        assert truth[kind]["balanced_accuracy"] == truth[kind]["accuracy"] == 1.0
    detection = truth["detection"]
    assert (detection["balanced_accuracy"], detection["missed_rate"], detection["false_alarms_per_hour"]) == (1.0, 0.0, 0.0)
    assert detection["delay_quartiles"] == pytest.approx([plant.dt] * 3)
    assert detection["delay_restricted_mean"] == pytest.approx(plant.dt)
    assert (truth["scenario"]["exact"], truth["scenario"]["onset_error_quartiles"]) == (1.0, [0.0] * 3)
    silent = np.zeros_like(record.label)
    null = scores(plant, suite.process, record, Decisions(silent > 0, silent, None, None, None))
    for kind in ("per_sample", "per_decision"):
        rows = np.array(null[kind]["confusion"]).sum(axis=1)
        chance = (rows[0] > 0) / (rows > 0).sum()
        assert null[kind]["balanced_accuracy"] == pytest.approx(chance)
        assert null[kind]["balanced_accuracy_interval"] == pytest.approx([chance, chance])
        if name in DRAWN:
            assert chance == pytest.approx(1 / len(plant.labels))
    assert null["scenario"]["exact"] == null["scenario"]["worth"] == (record.label == 0).all(axis=1).mean()
    assert null["detection"]["balanced_accuracy"] == 0.5
    assert null["detection"]["missed_rate"] == 1.0


@pytest.mark.parametrize("plant_id", plant_sources())
def test_the_truth_scores_one_on_flown_flights_of_every_process(plant_id):
    plant = build(plant_id)
    for process in plant.processes.values():
        suite = Suite(name="few", description="few", env=plant.env_id, plant=plant_id, options=dict(plant.options),
                      process=process.name, mismatch=None, seeds=[5, 6, 7, 8], settings={})  # fmt: skip
        scenarios = [s.replace(steps=min(s.steps, 3000)) for s in suite.scenarios(plant, range(4))]
        record = simulate(plant, scenarios)
        truth = Decisions(record.label > 0, record.label, record.target, None, None)
        found = scores(plant, process.name, record, truth)
        null = scores(plant, process.name, record, run(make_diagnoser("null", plant), record.obs))
        assert found["per_sample"]["balanced_accuracy"] == 1.0
        if found["decisions"]:
            assert found["per_decision"]["balanced_accuracy"] == 1.0
            held = {row for row, counts in enumerate(found["per_decision"]["confusion"]) if sum(counts)}
            assert null["per_decision"]["balanced_accuracy"] == pytest.approx((0 in held) / len(held))
        if found["identification"]["relative_error"] is not None:
            assert found["identification"]["relative_error"] == 0.0
            assert null["identification"]["relative_error"] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("name", SUITES)
def test_every_label_has_enough_decisions(name):
    """In the papers' suites, and in quiet flight: every label that the process draws."""
    suite = load_suite(name)
    plant = suite.build()
    held = np.bincount(
        [v for s in suite.scenarios(plant, range(suite.episodes)) for v in truths(plant, suite.process, s)],
        minlength=len(plant.labels),
    )
    assert (held if name in DRAWN else held[held > 0]).min() >= DECISIONS


@pytest.mark.parametrize("name", ["b747-hard", "missile-standard"])
def test_drawing_a_suite_again_gives_its_file(name):
    import importlib.util

    spec = importlib.util.spec_from_file_location("suites", ROOT / "benchmarks" / "suites.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.drawn(load_suite(name)) == load_suite(name)


def test_a_suite_of_a_label_that_is_too_rare_is_refused(monkeypatch):
    monkeypatch.setattr(design, "SEARCHED", 200)
    with pytest.raises(ValueError, match=r"fewer than 30 decisions about .* in 200 flights"):
        by_label(load_suite("huav-standard"), 30)


def test_flights_that_are_made_healthy_are_the_same_ones_without_their_faults():
    suite = load_suite("cmg-hard")
    plant = suite.build()
    first = len(suite.seeds)
    healthy = suite.scenarios(plant, [first])[0]
    seed = suite.healthy[0]
    faulty = msgspec.structs.replace(suite, seeds=[seed], healthy=[]).scenarios(plant, [0])[0]
    assert faulty.faults
    assert healthy == faulty.without_faults()
    assert not set(suite.seeds) & set(suite.healthy)


def test_windows_of_several_flights_follow_one_another():
    suite = load_suite("cmg-standard")
    plant = suite.build()
    apart = msgspec.structs.replace(suite, windows=1, pace=1.0, healthy=[]).scenarios(plant, range(3))
    whole = chained(apart, 0.2)
    assert [f.effects for f in whole.faults] == [f.effects for s in apart for f in s.faults]
    now = 0
    for scenario in apart:
        onset, end = scenario.faults[0].onset, scenario.faults[0].end
        mine = whole.faults[: len(scenario.faults)]
        assert {(f.onset - now, f.end - now) for f in mine} == {(round(0.2 * onset), round(0.2 * end))}
        now += round(0.2 * end)
        whole = whole.replace(faults=whole.faults[len(scenario.faults) :])
    assert whole.steps == now
    assert chained(apart[:1], 1.0) is apart[0]
