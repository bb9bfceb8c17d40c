"""Scores, on episodes small enough to be read."""

import numpy as np
import pytest
from conftest import build

from fdi_gym.diagnosis import Decisions
from fdi_gym.engine import Record
from fdi_gym.faults import Scoring
from fdi_gym.metrics import balanced_accuracy, delay_quartiles, macro_f1, outcome, scored_samples, summarise

LETTERS = {".": 0, "A": 1, "S": 2, "R": 3, "?": -1}


def episode(truth, said, scoring=None, alarm=None, theta=None, estimate=None, probs=None):
    """The outcome of one episode, from strings: one letter per sample, sample 0 first."""
    plant = build("B747Lateral")
    label = np.array([[LETTERS[c] for c in truth]])
    mode = np.array([[LETTERS[c] for c in said]])
    n = label.shape[1]
    fault = np.zeros((1, n, 4)) if theta is None else np.asarray(theta, float)[None]
    record = Record(np.zeros((1, n, 6)), np.zeros((1, n, 4)), fault, fault, label, np.array([n - 1]), np.array([False]))
    raised = mode > 0 if alarm is None else np.array([[c == "!" for c in alarm]])
    guess = None if estimate is None else np.asarray(estimate, float)[None]
    decisions = Decisions(raised, mode, guess, None, None if probs is None else np.asarray(probs, float)[None])
    return outcome(plant, scoring or Scoring(), record, decisions, 0)


def scores(*episodes):
    return summarise(list(episodes), 5, [s.name for s in build("B747Lateral").estimated], 0.1)


def test_delays_count_from_the_onset_step():
    # the fault acts from step 4 on: sample 5 is the first that can show it, with delay 1
    only = episode(truth=".....AAAAAA",
                   said=".......SAA.").onsets  # fmt: skip
    assert [(o.detection, o.isolation, o.length) for o in only] == [(3, 4, 6)]
    at_once = episode(truth="..AA", said="..AA").onsets[0]
    assert (at_once.detection, at_once.isolation) == (1, 1)


def test_a_fault_never_seen_is_missed():
    found = scores(episode(truth="...AAA", said="......"), episode(truth="...AAA", said="...AAA"))
    assert found["missed_detection_rate"] == 0.5


def test_an_alarm_that_was_already_on_detects_nothing():
    assert episode(truth="....AAA", said="..AAAAA").onsets[0].detection is None


def test_a_fault_that_follows_another_is_isolated_but_not_detected_again():
    first, second = episode(truth=".AAASSS", said=".AAAASS").onsets
    assert (first.fresh, second.fresh) == (True, False)
    assert second.detection is None
    assert second.isolation == 2


def test_false_alarms_rise_on_healthy_samples():
    # two rises before the fault, one rise as it begins (not false), one after it
    found = episode(truth=".......AAA......",
                    said="..A..AA.AA..A...")  # fmt: skip
    assert found.false_alarms == 3
    assert found.healthy_steps == 12
    assert scores(found)["false_alarms_per_hour"] == pytest.approx(3 / (12 * 0.1 / 3600))


def test_sample_zero_is_never_scored():
    found = episode(truth="....", said="A...")
    assert found.confusion == [(0, 0, 3)]


def test_grace_begins_with_the_first_new_label():
    label = np.array([0, 0, 0, 1, 1, 1, 1, 0, 0, 0])
    assert scored_samples(label, 9, Scoring(grace=2)).tolist() == [
        False,
        True,
        True,
        False,
        False,
        True,
        True,
        False,
        False,
        True,
    ]
    assert scored_samples(label, 5, Scoring(start=2)).tolist() == [
        False,
        False,
        True,
        True,
        True,
        True,
        False,
        False,
        False,
        False,
    ]


def test_balanced_accuracy_does_not_reward_the_common_class():
    always_none = scores(episode(truth="." * 91 + "A" * 10, said="." * 101))["per_sample"]
    assert always_none["accuracy"] == pytest.approx(0.9)
    assert always_none["balanced_accuracy"] == pytest.approx(0.5)
    assert balanced_accuracy(np.array([[9.0, 1, 0], [0, 0, 0]])) == pytest.approx(0.9)  # a label that never occurs


def test_equal_classes_give_the_trace_over_classes():
    confusion = np.array([[7.0, 3, 0], [2, 8, 0]])
    assert balanced_accuracy(confusion) == pytest.approx((7 + 8) / 20)
    assert macro_f1(confusion) == pytest.approx((2 * 7 / (10 + 9) + 2 * 8 / (10 + 11)) / 2)


def test_a_lost_diagnosis_is_wrong_and_counted():
    found = scores(episode(truth="..AA", said="..A?"))
    assert found["per_sample"]["confusion"][1][-1] == 1
    assert found["per_sample"]["accuracy"] == pytest.approx(2 / 3)
    assert found["lost_episodes"] == 1


def test_a_lost_estimate_leaves_the_error_of_the_others():
    estimate = np.ones((4, 4))
    estimate[3] = np.nan
    only = episode(truth="..AA", said="..A?", estimate=estimate)
    assert only.error_steps == [1, 1, 0]
    assert np.isfinite(only.squared_error).all()


def test_final_and_second_half_decisions():
    assert episode(truth="...AAAA", said="...SSSA").decision == (1, 1)
    # window of the fault: samples 3..8; second half 6..8: S, S, A
    half = episode(truth="...AAAAAA..", said="...AAASSA..", scoring=Scoring(decision="second_half"))
    assert half.decision == (1, 2)
    tie = episode(truth="...AAAA..", said="...AASA..", scoring=Scoring(decision="second_half"))
    assert tie.decision == (1, 1)  # 5..6: S and A, the lower label wins
    assert episode(truth="......", said=".....A", scoring=Scoring(decision="second_half")).decision == (0, 0)


def test_rmse_by_phase():
    theta = np.zeros((7, 4))
    theta[2:5, 0] = -0.5
    estimate = np.zeros((7, 4))
    estimate[5:, 1] = 0.2
    rmse = scores(episode(truth="..AAA..", said=".......", theta=theta, estimate=estimate))["rmse"]
    assert rmse["before"]["gamma_aileron"] == 0
    assert rmse["during"]["gamma_aileron"] == pytest.approx(0.5)
    assert rmse["after"]["gamma_rudder"] == pytest.approx(0.2)


def test_severity_bands_use_the_size_of_the_fault():
    theta = np.zeros((7, 4))
    theta[1:3, 0], theta[3:5, 0], theta[5:, 0] = -0.4, -0.6, -0.8
    found = episode(truth=".AAAAAA", said=".A...AA", theta=theta)
    assert found.banded == [(2, 1), (2, 0), (2, 2)]
    assert found.band == 2


def test_log_score():
    probs = np.tile([0.5, 0.5, 0, 0, 0], (3, 1))
    assert scores(episode(truth="..A", said="..A", probs=probs))["log_score"] == pytest.approx(np.log(0.5))


def test_delay_quartiles_are_right_censored():
    # half are never detected: the median is the last detection, the upper quartile is beyond the data
    assert delay_quartiles([1, 2, None, None], [10, 10, 10, 10], 1.0) == [1.0, 2.0, None]
    # a short fault that was not detected says little: Kaplan-Meier leaves it out of the later risk sets
    assert delay_quartiles([4, 5, None], [9, 9, 1], 1.0) == [4.0, 4.0, 5.0]
    assert delay_quartiles([], [], 1.0) == [None, None, None]


def test_intervals_cover_and_repeat():
    rng = np.random.default_rng(0)
    episodes = [episode(truth="....AAAA", said="...." + ("AAAA" if rng.random() < 0.7 else "....")) for _ in range(60)]
    first, again = scores(*episodes), scores(*episodes)
    assert first == again
    low, high = first["per_sample"]["balanced_accuracy_interval"]
    assert low < first["per_sample"]["balanced_accuracy"] < high
    assert high - low == pytest.approx(2 * 1.96 * 0.5 * np.sqrt(0.7 * 0.3 / 60), rel=0.3)
