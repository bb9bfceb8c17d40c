"""Scores, on episodes small enough to be read."""

import msgspec
import numpy as np
import pytest
from conftest import build

from fdi_gym.diagnosis import Decisions
from fdi_gym.engine import Record
from fdi_gym.faults import Scoring
from fdi_gym.intervals import resamples, strata, within
from fdi_gym.metrics import Declaration, Onset, check_outcomes, outcome, scored_samples
from fdi_gym.scores import balanced_accuracy, delay_quartiles, macro_f1, restricted_mean, summarise, survival

LETTERS = {".": 0, "A": 1, "S": 2, "R": 3, "?": -1}


def episode(truth, said, scoring=None, alarm=None, theta=None, estimate=None, probs=None, std=None):
    """The outcome of one episode, from strings: one letter per sample, sample 0 first."""
    plant = build("B747Lateral")
    label = np.array([[LETTERS[c] for c in truth]])
    mode = np.array([[LETTERS[c] for c in said]])
    n = label.shape[1]
    fault = np.zeros((1, n, 4)) if theta is None else np.asarray(theta, float)[None]
    record = Record(np.zeros((1, n, 6)), np.zeros((1, n, 4)), fault, fault, label, np.array([n - 1]), np.array([False]))
    raised = mode > 0 if alarm is None else np.array([[c == "!" for c in alarm]])
    guess = None if estimate is None else np.asarray(estimate, float)[None]
    sure = None if std is None else np.asarray(std, float)[None]
    decisions = Decisions(raised, mode, guess, sure, None if probs is None else np.asarray(probs, float)[None])
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
    assert found["detection"]["missed_rate"] == 0.5
    assert found["detection"]["begun_under_alarm_rate"] == 0.0


def test_a_fault_that_begins_under_an_alarm_is_neither_detected_nor_missed():
    """It says nothing about delays: it is left out there, and counted on its own."""
    standing = episode(truth="....AAA", said="..SSSAA")
    only = standing.onsets[0]
    assert (only.alarmed, only.labelled, only.detection, only.isolation) == (True, False, None, 2)
    found = scores(standing, episode(truth="....AAA", said=".....AA"))["detection"]
    assert (found["begun_under_alarm_rate"], found["missed_rate"]) == (0.5, 0.0)
    assert found["delay_quartiles"] == pytest.approx([0.2, 0.2, 0.2])


def test_a_label_that_stood_before_its_fault_isolates_nothing():
    only = episode(truth="....AAA", said="..AAAAA").onsets[0]
    assert (only.labelled, only.isolation) == (True, None)
    found = scores(episode(truth="....AAA", said="..AAAAA"), episode(truth="....AAA", said=".....AA"))["detection"]
    assert found["isolation_delay_quartiles"] == pytest.approx([0.2, 0.2, 0.2])


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
    assert found.alarm_steps == 4
    detection = scores(found)["detection"]
    assert detection["false_alarms_per_hour"] == pytest.approx(3 / (12 * 0.1 / 3600))
    assert detection["healthy_share_under_alarm"] == pytest.approx(4 / 12)


def test_an_alarm_that_is_on_from_the_start_is_a_false_alarm():
    found = episode(truth="......", said="AAAA.A")
    assert (found.false_alarms, found.alarm_steps) == (2, 4)
    assert episode(truth=".AA...", said="AAA...").false_alarms == 0  # healthy at no sample that counts


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


def decided(*arguments, **scoring):
    return [(d.label, d.declared) for d in episode(*arguments, scoring=Scoring(**scoring)).decisions]


def test_each_fault_window_and_each_healthy_flight_has_one_decision():
    assert decided("...AAAA", "...SSSA") == [(1, 1)]
    assert decided("......", ".....A") == [(0, 1)]
    assert decided("..AAA...SS..", "..AAS..SSSSS") == [(1, 2), (2, 2)]  # nothing is decided about the healthy samples
    assert decided(".AAASSS", ".AAAASA") == [(1, 1), (2, 1)]  # a fault that turns into another ends a window


def test_the_second_half_of_a_window_decides_by_the_most_frequent_label():
    # window of the fault: samples 3..8; second half 6..8: S, S, A
    assert decided("...AAAAAA..", "...AAASSA..", decision="second_half") == [(1, 2)]
    assert decided("...AAAA..", "...AASA..", decision="second_half") == [(1, 1)]  # S and A: the lower label wins
    assert decided("......", ".....A", decision="second_half") == [(0, 0)]
    assert decided("..AAAA...SSSS", "..SAAA...AASS", decision="second_half") == [(1, 1), (2, 2)]


def test_a_window_without_a_scored_sample_has_no_decision():
    assert decided("...AA.SSSS", "...AA.SSSS", grace=2) == [(2, 2)]
    assert decided("..AA..SSSS", "..AA..SSSS", start=5) == [(2, 2)]
    # of the second half, 4..6, sample 4 is within the grace
    assert decided("..AAAAA", "..SSSAA", grace=3, decision="second_half") == [(1, 1)]


def test_rmse_by_phase():
    theta = np.zeros((7, 4))
    theta[2:5, 0] = -0.5
    estimate = np.zeros((7, 4))
    estimate[5:, 1] = 0.2
    rmse = scores(episode(truth="..AAA..", said=".......", theta=theta, estimate=estimate))
    rmse = rmse["identification"]["rmse"]
    assert rmse["before"]["gamma_aileron"] == 0
    assert rmse["during"]["gamma_aileron"] == pytest.approx(0.5)
    assert rmse["after"]["gamma_rudder"] == pytest.approx(0.2)


def test_the_relative_error_is_one_where_always_healthy_is_estimated():
    theta = np.zeros((8, 4))
    theta[2:6, 0], theta[4:6, 1] = -0.5, 0.3
    for estimate, error in ((np.zeros((8, 4)), 1.0), (theta, 0.0), (theta / 2, 0.5)):
        found = scores(episode(truth="..AAAA..", said="........", theta=theta, estimate=estimate))["identification"]
        assert found["relative_error"] == pytest.approx(error)


def test_stated_deviations_are_held_against_the_errors_while_a_fault_acts():
    theta = np.zeros((6, 4))
    theta[2:] = 1.0
    std = np.full((6, 4), 0.5)
    std[3], std[4], std[5] = 1.0, 0.0, np.nan  # 2 and 1 deviations; none stated; none at all
    found = episode(truth="..AAAA", said="......", theta=theta, estimate=np.zeros((6, 4)), std=std)
    assert [(s.samples, s.covered, s.squares) for s in found.stated] == [(2, 1, 5.0)] * 4
    identification = scores(found)["identification"]
    assert (identification["coverage"], identification["nees"]) == (0.5, 2.5)
    unsaid = episode(truth="..AAAA", said="......", theta=theta, estimate=np.zeros((6, 4)))
    assert unsaid.stated is None
    assert scores(unsaid)["identification"]["nees"] is None


def test_severity_bands_use_the_size_of_the_fault():
    theta = np.zeros((7, 4))
    theta[1:3, 0], theta[3:5, 0], theta[5:, 0] = -0.4, -0.6, -0.8
    found = episode(truth=".AAAAAA", said=".A...AA", theta=theta)
    assert found.banded == [(2, 1), (2, 0), (2, 2)]
    assert [d.band for d in found.decisions] == [2]


def test_log_score():
    probs = np.tile([0.5, 0.5, 0, 0, 0], (3, 1))
    assert scores(episode(truth="..A", said="..A", probs=probs))["log_score"] == pytest.approx(np.log(0.5))


def quartiles(delays, waited):
    return delay_quartiles(survival(delays, waited), 1.0)


def test_delay_quartiles_are_right_censored():
    # half are never detected: the median is the last detection, the upper quartile is beyond the data
    assert quartiles([1, 2, None, None], [10, 10, 10, 10]) == [1.0, 2.0, None]
    # a short fault that was not detected says little: Kaplan-Meier leaves it out of the later risk sets
    assert quartiles([4, 5, None], [9, 9, 1]) == [4.0, 4.0, 5.0]
    assert quartiles([], []) == [None, None, None]


def test_the_restricted_mean_counts_what_is_longer_as_the_horizon():
    assert restricted_mean(survival([1, 2, None, 30], [10, 10, 10, 40]), 10, 0.1) == pytest.approx((1 + 2 + 10 + 10) / 40)
    assert restricted_mean(survival([None], [10]), 10, 1.0) == 10.0
    assert restricted_mean([], 7, 1.0) == 7.0


def test_detection_is_scored_apart_from_isolation():
    found = scores(episode(truth="....AAAA", said="........", alarm="...!!!!."))
    assert found["detection"]["balanced_accuracy"] == pytest.approx((2 / 3 + 3 / 4) / 2)
    assert found["per_sample"]["balanced_accuracy"] == 0.5
    assert scores(episode(truth="....AAAA", said="........"))["detection"]["balanced_accuracy"] == 0.5


def test_strata_are_the_rarest_labels_and_none_has_one_flight():
    assert strata([[0], [0], [1, 2], [1, 2], [1], [1]]).tolist() == [0, 0, 2, 2, 1, 1]
    assert strata([[0], [0], [1, 2], [1], [1], [1]]).tolist() == [0, 0, 1, 1, 1, 1]
    assert strata([[0], [1], [2]]).tolist() == [-1, -1, -1]
    assert strata([[], [0], [0]]).tolist() == [0, 0, 0]
    assert strata([[1], [0], [2], [2], [0], [2], [1], [1], [1], [3]]).tolist() == [1, 0, 2, 2, 0, 2, 1, 1, 1, 1]
    assert strata([[2]]).tolist() == [-1]  # nothing else is there


def test_the_variance_of_a_sum_over_flights_is_what_drawing_flights_anew_within_strata_gives():
    rng = np.random.default_rng(5)
    stratum = np.repeat([0, 1, 2], [30, 50, 1])
    values = rng.normal(3.0 + 10.0 * stratum[:, None], [[1.0, 4.0]], (81, 2))
    sums = [
        sum(rng.choice(values[stratum == s], (stratum == s).sum()).sum(axis=0) for s in range(3)) for _ in range(4000)
    ]  # fmt: skip
    assert within(values, stratum) == pytest.approx(np.var(sums, axis=0), rel=0.12)
    assert within(values, stratum)[0] == pytest.approx(
        sum((stratum == s).sum() * values[stratum == s, 0].var(ddof=1) for s in range(2))
    )


def test_resamples_draw_as_many_flights_of_each_stratum_as_it_has():
    stratum = np.array([3, 0, 3, -1, 0, 3, -1])
    drawn = resamples(stratum, 4000, seed=1)
    for s in np.unique(stratum):
        assert (drawn[:, stratum == s].sum(axis=1) == (stratum == s).sum()).all()
    assert drawn.mean(axis=0) == pytest.approx(np.ones(7), abs=0.05)
    assert drawn.var(axis=0) == pytest.approx(1 - 1 / np.array([3, 2, 3, 2, 2, 3, 2]), abs=0.05)
    assert np.array_equal(drawn, resamples(stratum, 4000, seed=1))
    assert not np.array_equal(drawn, resamples(stratum, 4000, seed=2))


GOOD = episode(truth="..AAAA", said="...AAA", estimate=np.zeros((6, 4)), std=np.ones((6, 4)), probs=np.full((6, 5), 0.2))
LATE = Onset(label=1, length=4, fresh=True, alarmed=False, labelled=False, detection=5, isolation=2)
KNOWN = Onset(label=1, length=4, fresh=True, alarmed=True, labelled=False, detection=1, isolation=2)


@pytest.mark.parametrize(("field", "value"), [
    ("confusion", [(0, 7, 1)]), ("confusion", [(0, 0, 9)]), ("banded", [(1, 0)]), ("banded", [(0, 0), (1, 2), (0, 0)]),
    ("alarmed", [(1, 1)]), ("alarmed", [(1, 1)] * 3), ("alarmed", [(1, 2), (0, 0)]), ("error_steps", [0, 0]),
    ("error_steps", [9, 0, 0]), ("squared_error", [[0.0] * 3] * 3), ("squared_error", [[-1.0] + [0.0] * 3] * 3),
    ("squared_fault", [0.0] * 3), ("squared_fault", [np.nan] * 4), ("stated", []), ("onsets", [LATE]), ("onsets", [KNOWN]),
    ("healthy_steps", 9), ("alarm_steps", 9), ("false_alarms", 9), ("log_score", 1.0), ("log_score", -np.inf),
    ("declaration", Declaration(0, False, 0.5, [])), ("declaration", Declaration(2, True, 1.0, [])),
])  # fmt: skip
def test_outcomes_that_no_flight_has_are_refused(field, value):
    check_outcomes([GOOD], 5, 4)
    with pytest.raises(ValueError, match="episode 0 has"):
        check_outcomes([msgspec.structs.replace(GOOD, **{field: value})], 5, 4)


def test_intervals_repeat_and_have_the_width_of_their_labels():
    rng = np.random.default_rng(0)
    episodes = [episode(truth="....AAAA", said="...." + ("AAAA" if rng.random() < 0.7 else "....")) for _ in range(60)]
    first, again = scores(*episodes), scores(*episodes)
    assert first == again
    low, high = first["per_sample"]["balanced_accuracy_interval"]
    assert low < first["per_sample"]["balanced_accuracy"] < high
    assert high - low == pytest.approx(2 * 1.96 * 0.5 * np.sqrt(0.7 * 0.3 / 60), rel=0.3)


def test_all_right_is_not_known_to_be_always_right_but_a_constant_answer_is():
    flights = [(t, t) for t in ["....", "..AA"] for _ in range(30)]
    low, high = scores(*(episode(*flight) for flight in flights))["per_decision"]["balanced_accuracy_interval"]
    assert 0.9 < low < 1.0
    assert high == 1.0
    null = scores(*(episode(truth, "....") for truth, _ in flights))
    assert null["per_decision"]["balanced_accuracy_interval"] == [0.5, 0.5]
    assert null["per_sample"]["balanced_accuracy_interval"] == [0.5, 0.5]


def test_a_rare_label_is_never_dropped():
    """Two flights of 400 hold label S: they weigh as much as all others, and the interval says so."""
    flights = [episode("....", "....")] * 199 + [episode("..AA", "..AA")] * 199
    low, high = scores(*flights, episode("..SS", "..SS"), episode("..SS", "...."))["per_decision"][
        "balanced_accuracy_interval"
    ]
    assert low < 0.75
    assert high > 0.95


def test_flights_that_end_within_the_grace_have_no_score_and_are_no_error():
    found = scores(episode("..AA", "..AA", scoring=Scoring(start=9)))
    assert found["decisions"] == 0
    for kind in ("per_sample", "per_decision"):
        assert found[kind]["balanced_accuracy"] is None
        assert found[kind]["balanced_accuracy_interval"] is None
