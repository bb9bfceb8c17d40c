"""Comparisons on the same flights, on rows whose truth is known."""

import numpy as np
import pytest
import scipy.stats

from fdi_gym.comparison import cliques, draw_again, holm, tied_with_best
from fdi_gym.diagnosis import diagnoser
from fdi_gym.intervals import balanced_interval, wilson
from fdi_gym.metrics import Decision, Declaration, Outcome
from fdi_gym.tables import by_identification, by_isolation, isolates

LABELS, FLIGHTS = 3, 90


def flight(label, share, samples=100):
    """One window of a label, of whose samples a share is right."""
    right = round(share * samples)
    confusion = [(label, label, right), (label, (label + 1) % LABELS, samples - right)]
    declared = label if share > 0.5 else (label + 1) % LABELS
    return Outcome(steps=samples, terminated=False, lost=False, decisions=[Decision(label, declared, 0 if label else None)],
                   confusion=confusion, banded=[(0, 0)] * 3, onsets=[], false_alarms=0, healthy_steps=0, alarm_steps=0,
                   alarmed=[(0, 0)] * 2, squared_error=[[0.0]] * 3, error_steps=[0] * 3, squared_fault=[0.0], stated=None,
                       declaration=Declaration(0, True, 1.0, []),
                   log_score=None)  # fmt: skip


def method(shares):
    return [flight(i % LABELS, share) for i, share in enumerate(shares)]


@pytest.fixture(scope="module")
def hard():
    """How hard each flight is, for all methods alike."""
    return np.random.default_rng(0).uniform(0.2, 0.9, FLIGHTS)


def test_what_is_hard_for_both_cancels(hard):
    """Two points apart, with intervals of ten: told apart on the same flights, not on others."""
    noise = np.random.default_rng(1).normal(0, 0.01, (2, FLIGHTS))
    found = {"a": method(hard + noise[0]), "b": method(hard - 0.02 + noise[1])}
    drawn = draw_again(found, LABELS)
    gap, low, high = drawn.difference("a", "b")
    assert gap == pytest.approx(0.02, abs=0.005)
    assert 0.01 < low < gap < high < 0.03
    assert drawn.again[:, 0].std() > 5 * (high - low) / 4
    assert tied_with_best(drawn) == {"a"}
    assert drawn.difference("b", "a") == pytest.approx((-gap, -high, -low))


def test_equal_methods_are_tied_and_their_difference_is_nothing(hard):
    drawn = draw_again({"a": method(hard), "b": method(hard)}, LABELS)
    assert drawn.difference("a", "b") == (0.0, 0.0, 0.0)
    assert tied_with_best(drawn) == {"a", "b"}


def test_methods_that_differ_by_chance_are_rarely_told_apart(hard):
    """Five equal methods with errors of their own: in about 5 % of the cases one is told from another, not in 40."""
    apart = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        found = {str(i): method(np.clip(hard + rng.normal(0, 0.1, FLIGHTS), 0, 1)) for i in range(5)}
        drawn = draw_again(found, LABELS)
        apart += cliques(drawn) != [(0, 4)]
    assert apart <= 9  # 3 expected; binomial, 0.3 %


def test_methods_on_other_flights_are_not_compared(hard):
    with pytest.raises(ValueError, match="b was shown other flights"):
        draw_again({"a": method(hard), "b": method(hard)[::-1]}, LABELS)


def test_holm_is_the_step_down_procedure():
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm(np.array([0.5, 0.9])) == pytest.approx([1.0, 1.0])
    assert holm(np.array([])).shape == (0,)


def test_bars_join_runs_no_two_of_which_can_be_told_apart(hard):
    rng = np.random.default_rng(2)
    shares = {"worst": -0.2, "b": 0.0, "a": 0.0, "best": 0.09}
    drawn = draw_again(
        {n: method(np.clip(hard + s + rng.normal(0, 0.02, FLIGHTS), 0, 1)) for n, s in shares.items()}, LABELS
    )
    assert cliques(drawn) == [(1, 2)]


def test_wilsons_interval_is_scipys():
    for right, size in ((30, 30), (17, 30), (0, 8)):
        known = scipy.stats.binomtest(right, size).proportion_ci(method="wilson")
        assert wilson(np.array(right / size), np.array(size), np.array(scipy.stats.norm.ppf(0.975))) == pytest.approx(known)


def test_one_answer_a_flight_has_the_interval_of_so_many_answers():
    """With one label and a flight each, it is Wilson's, with Student's quantile."""
    right = np.array([1.0] * 24 + [0.0] * 6)[:, None]
    found = balanced_interval(right, np.ones((30, 1)), np.zeros(30, int))
    size = 29.0  # the unbiased variance
    expected = wilson(np.array(0.8), np.array(size), np.array(scipy.stats.t.ppf(0.975, 29)))
    assert found == pytest.approx(expected, abs=1e-9)


def test_flights_that_err_together_have_a_wider_interval(hard):
    """Ten flights of three decisions each are ten, not thirty."""
    apart = np.random.default_rng(3).random((30, 1)) < 0.6
    low, high = balanced_interval(apart.astype(float), np.ones((30, 1)), np.zeros(30, int))
    alike = 3.0 * apart[:10]
    lower, higher = balanced_interval(alike, np.full((10, 1), 3.0), np.zeros(10, int))
    assert higher - lower > 1.5 * (high - low)


def row(name, confusion, error=None):
    found = {"balanced_accuracy": 0.5, "confusion": confusion}
    identification = None if error is None else {"relative_error": error}
    return type("R", (), {"diagnoser": name, "metrics": {"per_sample": found, "identification": identification}})()


def test_who_declares_one_label_is_not_ranked_in_isolation():
    estimator, detector = row("ppo_identification", [[5, 0, 0], [3, 0, 0]], 0.7), row("x", [[0, 5, 0], [0, 3, 0]])
    null, filter = row("null", [[5, 0, 0], [3, 0, 0]], 1.0), row("two_stage_kf", [[4, 1, 0], [0, 3, 0]], 0.9)
    assert [isolates(r) for r in (estimator, detector, null, filter)] == [False, False, False, True]
    assert {r.diagnoser for r in by_isolation([estimator, detector, null, filter])} == {"null", "two_stage_kf"}
    ranked = [r.diagnoser for r in by_identification([estimator, detector, null, filter])]
    assert ranked == ["ppo_identification", "two_stage_kf", "null"]


def test_a_ceiling_knows_something():
    with pytest.raises(ValueError, match="called a ceiling, but knows nothing"):
        diagnoser("know_nothing", "a test", ceiling=True)
