"""The grid's page is what its rows say, and no pair of method and plant is missing without a reason."""

import msgspec
import pytest
from conftest import ROOT

from baselines.reproduction.grid import KINDS, PAPER, page, reasons_of, rows_of
from fdi_gym.diagnosis import diagnosers
from fdi_gym.evaluation import load_suite

RESULTS = ROOT / "leaderboards" / "results"
FIGURES = msgspec.json.decode((ROOT / "leaderboards" / "grid.json").read_bytes())


def test_page_is_rendered_from_the_rows():
    assert (ROOT / "leaderboards" / "grid.md").read_text() == page(RESULTS, FIGURES)


@pytest.mark.parametrize("family", PAPER)
def test_every_pair_has_a_row_or_a_reason(family):
    for kind in KINDS:
        suite = load_suite(f"{family}-{kind}")
        reasons = FIGURES["reasons"][suite.name]
        rows = rows_of(RESULTS, suite.name)
        assert not set(rows) & set(reasons)
        assert set(rows) | set(reasons) >= set(diagnosers())
        assert all(reasons.values())


@pytest.mark.parametrize("family", list(PAPER))
def test_reasons_are_the_codes_own(family):
    suite = load_suite(f"{family}-standard")
    assert FIGURES["reasons"][suite.name] == reasons_of(suite)
