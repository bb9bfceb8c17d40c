"""The grid's page is what its rows say, for any rows there are, and a method without a row has a reason or is to be run."""

import msgspec
import pytest
from conftest import ROOT

from benchmarks.grid import KINDS, families, missing, page, reasons_of, rows_of
from fdi_gym.diagnosis import diagnosers
from fdi_gym.files import pretty
from fdi_gym.leaderboard import read_rows
from fdi_gym.row import row_path
from fdi_gym.suite import load_suite

RESULTS = ROOT / "leaderboards" / "results"
FIGURES = msgspec.json.decode((ROOT / "leaderboards" / "grid.json").read_bytes())


def test_page_is_rendered_from_the_rows():
    assert (ROOT / "leaderboards" / "grid.md").read_text() == page(RESULTS, FIGURES)


@pytest.mark.parametrize("family", families())
def test_every_pair_has_a_row_or_a_reason_or_is_named_as_missing(family):
    absent = missing(RESULTS, FIGURES)
    for kind in KINDS:
        suite = load_suite(f"{family}-{kind}")
        reasons = FIGURES["reasons"][suite.name]
        rows = rows_of(RESULTS, suite.name)
        assert not set(rows) & set(reasons)
        assert set(rows) | set(reasons) | set(absent.get(suite.name, ())) >= set(diagnosers())
        assert all(reasons.values())


@pytest.mark.parametrize("family", families())
def test_reasons_are_the_codes_own(family):
    suite = load_suite(f"{family}-standard")
    assert FIGURES["reasons"][suite.name] == reasons_of(suite)


def test_a_row_that_is_there_appears_on_the_page(tmp_path):
    """The best method, the paper's best filter and the oracle are those of the rows that are there."""
    folder = tmp_path / "results" / "b747-standard"
    folder.mkdir(parents=True)
    template = next(iter(read_rows(RESULTS / "b747-standard")))
    for name, share in (("null", 0.2), ("two_stage_kf", 0.625), ("known_onset_oracle", 0.9)):
        figures = {
            **template.metrics["per_sample"],
            "balanced_accuracy": share,
            "balanced_accuracy_interval": [share, share],
        }
        row = msgspec.structs.replace(template, diagnoser=name, metrics={**template.metrics, "per_sample": figures})
        row_path(tmp_path / "results", row.suite, name).write_bytes(pretty(row.sealed()))
    empty, text = page(tmp_path / "nowhere", FIGURES), page(tmp_path / "results", FIGURES)
    assert "| two_stage_kf" not in empty
    line = next(line for line in text.splitlines() if line.startswith("| b747-standard |"))
    assert line.count("two_stage_kf 62.5 [62.5, 62.5]") == 2
    assert "its own wins" in line
    assert "| known_onset_oracle *" in text
    absent = next(line for line in text.splitlines() if line.startswith("- b747-standard: "))
    assert "bayes_bank" in absent
    assert "two_stage_kf," not in absent.split(": ")[1].split(", ")
