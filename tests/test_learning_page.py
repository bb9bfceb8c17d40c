"""The page of the learned diagnosers is that of their rows and cards, whichever rows there are."""

import json
import re
import sys

import msgspec
import numpy as np
import pytest
from conftest import ROOT

from baselines.learned import weights
from benchmarks import flights
from fdi_gym.evaluation import evaluate
from fdi_gym.row import write_rows
from fdi_gym.suite import load_suite

sys.path.insert(0, str(ROOT / "benchmarks"))
import learning_page


def cards():
    cards = [weights.read_card(path) for path in sorted(weights.WEIGHTS.glob("*.safetensors"))]
    return [card for card in cards if "accuracy" in card.curve[-1]]


def test_page_is_what_the_report_writes():
    assert (ROOT / "leaderboards/learning/README.md").read_text() == learning_page.page(cards())
    assert {learning_page.title(card) for card in cards()} <= {path.stem for path in weights.WEIGHTS.glob("*.safetensors")}
    for card in cards():
        assert (ROOT / "leaderboards/learning" / f"{learning_page.title(card)}.png").exists()


def test_rows_that_are_made_appear_on_the_page(tmp_path, monkeypatch):
    suite = load_suite("b747-standard")
    found = evaluate(suite.head(2), ["ppo", "two_stage_kf"], work=tmp_path / "work", jobs=1, progress=False)
    for name, one in found.items():  # two episodes stand for the whole suite here
        row = msgspec.structs.replace(one.row, suite=suite.name, suite_sha256=suite.sha256).sealed()
        write_rows(tmp_path / "results", suite, {name: one._replace(row=row)})
    monkeypatch.setattr(learning_page, "HOME", tmp_path)
    line = next(line for line in learning_page.accuracy_table().splitlines() if line.startswith("| b747-standard |"))
    assert re.search(rf"\| ppo +\| {re.escape(learning_page.percent(found['ppo'].row))}", line)
    assert f"two_stage_kf {learning_page.percent(found['two_stage_kf'].row)}" in line
    assert learning_page.verdict(found["ppo"].row, found["two_stage_kf"].row) in line


def test_verdict_says_whether_intervals_meet():
    def row(value, low, high):
        found = {"balanced_accuracy": value, "balanced_accuracy_interval": [low, high]}
        return type("R", (), {"metrics": {"per_sample": found}})()

    assert learning_page.verdict(row(0.9, 0.88, 0.92), row(0.8, 0.79, 0.81)) == "+10.0, above"
    assert learning_page.verdict(row(0.9, 0.88, 0.92), row(0.91, 0.90, 0.92)) == "-1.0, intervals overlap"
    assert learning_page.verdict(row(0.7, 0.68, 0.72), row(0.8, 0.79, 0.81)) == "-10.0, below"


# ---------------------------------------------------------------------------------------------------------------
# How many flights more


def test_the_page_of_the_flights_is_what_was_measured():
    text = (ROOT / "leaderboards/learning/flights.json").read_text()
    assert (ROOT / "leaderboards/learning/flights.md").read_text() == flights.page(json.loads(text))
    for plant, found in json.loads(text).items():
        card = weights.read_card(weights.WEIGHTS / f"residual_net-{plant}.safetensors")
        assert card.filters == found["filters"]
        for curve in (curve for curve in found["curves"].values() if "gaps" in curve):
            gap, low, high = np.array(curve["gaps"]).T
            assert gap == pytest.approx(curve["attained"] - np.array(curve["scores"]), abs=0.02)
            assert np.all((low <= gap) & (gap <= high))


def test_flights_that_close_a_gap_follow_from_what_a_doubling_gives():
    budgets, scores = [75, 150, 300, 600], np.array([[50.0, 80.0, 82.0, 84.0], [50.0, 84.0, 84.0, 84.0]])
    slope, needed = flights.trend(budgets, scores, np.array([89.0, 89.0]), 1.0)
    assert slope == pytest.approx([2.0, 0.0])
    assert needed == pytest.approx([2400.0, 600 * 2.0 ** (flights.FAR + 1)])
    assert flights.trend(budgets, scores[0], 84.5, 1.0)[1] == 600


@pytest.mark.parametrize(
    ("gap", "doubling", "needed", "words"),
    [
        (0.9, [2, 1, 3], [600, 600, 900], "closed"), (5, [0.2, -1, 1], [9e9] * 3, "flat"),
        (5, [1, -1, 3], [9e9] * 3, "cannot be told"), (5, [2, 1, 3], [2400, 1200, 4800], "2,400 (1,200 to 4,800)"),
        (5, [2, 1, 3], [2400, 1200, 1e9], "2,400 (1,200 to more than a thousand times these)"),
        (9, [0.6, 0.1, 1], [1e9] * 3, "more than 614,400"),
    ],
)  # fmt: skip
def test_what_is_foretold(gap, doubling, needed, words):
    curve = {"gaps": [[gap, gap - 1, gap + 1]], "points": 1.0, "doubling": doubling, "needed": needed}
    assert flights.forecast(curve, 600) == words
