"""The page of the learned diagnosers is that of their rows and cards, whichever rows there are."""

import re
import sys

import msgspec
from conftest import ROOT

from baselines.learned import weights
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
