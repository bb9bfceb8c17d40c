"""Faults that nobody is told of: what is drawn, that no method knows, and what "something else" promises."""

import gymnasium as gym
import numpy as np
import pytest
from conftest import PLANTS
from scipy.stats import binom

from baselines import conformal
from fdi_gym.diagnosis import (
    Diagnoser,
    Diagnosis,
    NotApplicableError,
    conforming,
    find_diagnoser,
    knowledge,
    make_diagnoser,
    run,
)
from fdi_gym.diagnosis.conforming import decided, decisive, of_each_label
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation.conformity import Conformity
from fdi_gym.faults import draw
from fdi_gym.plant import BROUGHT
from fdi_gym.suite import Suite
from fdi_gym.unseen import SOMETHING_ELSE, with_unseen


@pytest.mark.parametrize("plant_id", [*PLANTS, "DCMotor"])
def test_the_process_draws_none_and_known_faults_and_unseen_ones(plant_id):
    plant = load_plant(plant_id, unseen=True)
    other, process = len(plant.labels) - 1, plant.process("unseen")
    assert [label.name for label in plant.labels] == [*(label.name for label in plant.bare.labels), SOMETHING_ELSE]
    scenarios = [draw(process, seed) for seed in range(60)]
    record = simulate(plant, scenarios[:12])
    assert np.isfinite(record.obs).all()
    last = np.array([decisive(plant, s)[1] for s in scenarios])
    assert {0, other} < set(last.tolist())
    for scenario, label in zip(scenarios, last, strict=True):
        modes = {fault.mode for fault in scenario.faults}
        assert (label == other) == (modes == {SOMETHING_ELSE})
        assert modes <= set(plant.bare.mode_names) | {SOMETHING_ELSE}
    faulty = last[last > 0]
    assert (
        binom.sf((faulty == other).sum() - 1, len(faulty), 0.5) > 1e-4 < binom.cdf((faulty == other).sum(), len(faulty), 0.5)
    )


@pytest.mark.parametrize("name", ["augmented_ekf", "multiple_model_ekf", "two_stage_kf", "sequence_net"])
def test_no_method_is_told(name):
    """Also of those that know how sensors fail where they are told: all say what they say of the plant without."""
    plant = load_plant("B747Lateral", unseen=True)
    obs = simulate(plant, [draw(plant.process("unseen"), seed) for seed in range(4)]).obs[:, :200]
    knowing, bare = (run(make_diagnoser(name, p, process="standard"), obs) for p in (plant, plant.bare))
    assert np.array_equal(knowing.label, bare.label)
    assert (knowing.label < len(plant.labels) - 1).all()
    assert np.array_equal(knowing.alarm, bare.alarm)


def test_what_knows_a_part_of_the_truth_does_not_know_this():
    plant = load_plant("B747Lateral", unseen=True)
    with pytest.raises(NotApplicableError, match="what told_onset_bank is told of the truth does not cover"):
        make_diagnoser("told_onset_bank", plant, process="unseen", scenarios=[draw(plant.process("unseen"), 0)])


@pytest.mark.parametrize(("name", "option"), BROUGHT.items())
def test_a_process_that_an_option_brings_is_found_by_its_name(b747, name, option):
    with pytest.raises(ValueError, match=f"unknown process '{name}'.*{name} comes with {option}=True"):
        gym.make("B747Lateral-Faults-v0", process=name)
    assert name in load_plant("B747Lateral", **{option: True}).processes
    assert name not in b747.processes


def test_an_environment_has_the_answer():
    env = gym.make("B747Lateral-Faults-v0", unseen=True, process="unseen")
    assert env.action_space.n == len(load_plant("B747Lateral").labels) + 1
    env.reset(seed=3)
    assert env.step(env.action_space.n - 1)[1] in (0.0, 1.0)


@pytest.mark.parametrize("options", [{"sensor_faults": True}, {"simultaneous": True}])
def test_unseen_faults_are_alone(options):
    with pytest.raises(ValueError, match="unseen"):
        load_plant("B747Lateral", unseen=True, **options)


# ---------------------------------------------------------------------------------------------------------------
# What is promised


def test_a_p_value_counts_the_scores_that_are_at_least_as_large():
    rng = np.random.default_rng(0)
    known = {name: np.sort(rng.integers(0, 9, size=n)).astype(float).tolist() for name, n in (("a", 11), ("b", 7))}
    known["never met"] = []
    score = rng.integers(-1, 10, size=40).astype(float)
    brute = [max((1 + sum(v >= s for v in some)) / (1 + len(some)) for some in known.values() if some) for s in score]
    assert np.array_equal(Conformity(scores=known).p_value(score), brute)
    assert np.array_equal(Conformity().p_value(score), np.ones(40))


def test_a_flight_of_any_label_is_excluded_no_more_often_than_promised():
    """Of scores that differ in kind from label to label, and with as few flights as they may be."""
    rng = np.random.default_rng(1)
    draws = {
        "a": lambda n: rng.normal(size=n),
        "b": lambda n: rng.exponential(3.0, size=n),
        "c": lambda n: rng.random(n) ** 4,
    }
    excluded, times = dict.fromkeys(draws, 0), 4000
    for _ in range(times):
        known = Conformity(scores={name: np.sort(some(19)).tolist() for name, some in draws.items()})
        for name, some in draws.items():
            excluded[name] += int(known.p_value(some(1))[0] <= 0.05)
    for name, count in excluded.items():
        assert count <= binom.ppf(0.999, times, 0.05), name
    assert max(excluded.values()) > 0


def scripted(monkeypatch, probs):
    """The wrapper over a method that says these probabilities (K, labels) of the 747."""
    plant = load_plant("B747Lateral", unseen=True)

    def update(k, obs):
        now = np.tile(probs[min(k, len(probs) - 1)], (len(obs), 1))
        return k + 1, Diagnosis(now.argmax(axis=1) > 0, now.argmax(axis=1), label_probs=np.pad(now, ((0, 0), (0, 1))))

    monkeypatch.setattr(conformal, "make_diagnoser", lambda *_, **__: Diagnoser(lambda n: 0, update, True))
    found = conformal.conformal(plant, Conformity(scores={"none": np.linspace(0.0, 0.2, 60).tolist()}), pace=10 / 1200)
    return plant, run(found, np.zeros((2, len(probs), len(plant.observed))), signals=True)


def test_something_else_is_said_while_nothing_known_fits_and_no_longer(monkeypatch):
    sure, torn = np.eye(5)[1] * 0.95 + 0.01, np.array([0.19, 0.24, 0.19, 0.19, 0.19])
    probs = np.concatenate([np.tile(sure, (50, 1)), np.tile(torn, (100, 1)), np.tile(sure, (100, 1))])
    plant, said = scripted(monkeypatch, probs)
    other = len(plant.labels) - 1
    first = int((said.label[0] == other).argmax())
    assert 50 + 10 <= first < 50 + 30  # it must last as long as the smoothing
    assert (said.label[0, first:150] == other).all()
    assert (said.label[0, 200:] == 1).all()
    assert said.alarm[0].all()  # the method names a fault all the time
    assert np.allclose(said.label_probs.sum(axis=2), 1.0)
    assert said.label_probs[0, 140, other] > 0.9 > 0.3 > said.label_probs[0, -1, other]
    belief = probs[0].copy()
    for k in range(1, 150):
        belief += (probs[k] - belief) / 10
        assert np.isclose(said.signals["unlike"][0, k], 1.0 - belief.max())


@pytest.mark.slow
def test_known_flights_are_known_and_unseen_ones_are_not_named():
    """On flights that the fit has not flown: the promise, and that a bank of models makes use of it."""
    plant = load_plant("B747Lateral", unseen=True)
    other, name = len(plant.labels) - 1, "multiple_model_ekf"
    known = of_each_label(plant.bare, "standard", 4_700_000, 8)
    unseen = [s for s in of_each_label(plant, "unseen", 4_800_000, 24) if s.faults and s.faults[0].mode == SOMETHING_ELSE]
    entry = find_diagnoser(f"conformal_{name}")
    conformity = conforming.fit_conformity(entry, plant, "standard", entry.resolve(plant))
    with_it = conformal.conformal(plant, conformity, of=name)
    excluded = (decided(with_it, plant, known)[2] == other).sum()
    assert excluded <= binom.ppf(0.999, len(known), 0.05)
    before = decided(make_diagnoser(name, plant), plant, unseen, score="")[2]
    after = decided(with_it, plant, unseen)[2]
    assert (after == other).mean() > 0.4
    assert ((after > 0) & (after < other)).sum() < (before > 0).sum() / 2


def test_what_a_suite_needs_is_fitted_for_it(monkeypatch):
    """For those that have the answer; the others know what they know of the plant without."""
    monkeypatch.setattr(conforming, "EACH", 2)
    suite = Suite(name="few", description="a test", env="B747Lateral-Faults-v0", plant="B747Lateral", process="unseen",
                  options={"unseen": True}, mismatch=None, seeds=[1, 2], settings={})  # fmt: skip
    entries = [find_diagnoser(name) for name in ("conformal_sequence_net", "augmented_ekf", "conformal_hypothesis_bank")]
    (fits,) = knowledge.fit_suites(entries, [suite], jobs=1).values()
    assert not fits.beliefs
    assert not fits.calibrations
    ((key, found),) = fits.conformities.items()  # the bank cannot run on this plant
    assert key.startswith('["conformal_sequence_net", "standard"')
    plant = suite.build().bare
    assert list(found.scores) == [label.name for label in plant.labels]
    assert all(len(scores) == 2 and scores == sorted(scores) for scores in found.scores.values())


@pytest.mark.parametrize(
    ("settings", "words"),
    [({"level": 0.0}, "level is a number between 0 and 1"), ({"pace": 1.0}, "pace is a number between 0 and 1"),
     ({"of": "nobody"}, "unknown diagnoser 'nobody'"), ({"of": "windowed_nis"}, "windowed_nis gives no probabilities")],
)  # fmt: skip
def test_what_cannot_be_is_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        conformal.conformal(load_plant("B747Lateral", unseen=True), Conformity(), **settings)


def test_without_the_answer_it_does_not_run(b747):
    with pytest.raises(NotApplicableError, match="with the option unseen it has"):
        make_diagnoser("conformal_multiple_model_ekf", b747)
    with pytest.raises(ValueError, match="unseen faults are a sensor's"):
        with_unseen(load_plant("B747Lateral", sensor_faults=True))
