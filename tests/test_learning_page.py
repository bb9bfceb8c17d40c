"""The page of the learned diagnosers is that of their rows and cards."""

from conftest import ROOT

from baselines.networks import report, weights


def test_page_is_what_the_report_writes():
    cards = [weights.read_card(path) for path in sorted(weights.WEIGHTS.glob("*.safetensors"))]
    assert (ROOT / "leaderboards/learning/README.md").read_text() == report.page(cards)
    for card in cards:
        assert (ROOT / "leaderboards/learning" / f"{card.method}-{card.plant}.png").exists()


def test_verdict_says_whether_intervals_meet():
    def row(value, low, high):
        found = {"balanced_accuracy": value, "balanced_accuracy_interval": [low, high]}
        return type("R", (), {"metrics": {"per_sample": found}})()

    assert report.verdict(row(0.9, 0.88, 0.92), row(0.8, 0.79, 0.81)) == "+10.0, above"
    assert report.verdict(row(0.9, 0.88, 0.92), row(0.91, 0.90, 0.92)) == "-1.0, intervals overlap"
    assert report.verdict(row(0.7, 0.68, 0.72), row(0.8, 0.79, 0.81)) == "-10.0, below"
