"""The papers' figures measured again: verdicts follow from figures, pages from pieces, and stars mean what they say."""

import importlib
import math
import re
import runpy
import sys

import pytest
from conftest import ROOT

from benchmarks.reproduction import index
from benchmarks.reproduction.claims import (
    CONFIRMED,
    NOT_CONFIRMED,
    OPEN,
    PARTLY,
    Check,
    Claim,
    Found,
    Measured,
    exact,
    judge,
    mean,
    paired_shares,
    ratio,
    share,
    together,
)
from benchmarks.reproduction.comparison import Comparisons
from benchmarks.reproduction.missile_pitch.measure import numbered, unclipped
from benchmarks.reproduction.pieces import command, finished, keep, kept, pieces, reference, rounded
from fdi_gym.files import read_json
from fdi_gym.suite import load_suite, suite_names

FOLDER = ROOT / "benchmarks" / "reproduction"
FOLDERS = sorted(path.name for path in FOLDER.iterdir() if (path / "__main__.py").exists())


def piece(number):
    return {"number": number, "never": math.nan}


def leaves(nest):
    """All numbers of a nest."""
    if isinstance(nest, dict):
        nest = list(nest.values())
    return [v for part in nest for v in leaves(part)] if isinstance(nest, list) else [nest]


def test_every_plant_of_a_paper_has_a_folder():
    """Those that fly a paper's scenario; and no folder is of another."""
    papers = {load_suite(name).plant for name in suite_names() if name.endswith("-paper")}
    assert {name.replace("_", "") for name in FOLDERS} == {plant.lower() for plant in papers}


@pytest.mark.parametrize("name", FOLDERS)
def test_printed_figures_say_where_they_are_from(name):
    printed = reference(name)
    assert printed.pop("source")
    assert printed.pop("publication")
    assert sum(isinstance(v, (int, float)) for v in leaves(printed)) > 100


@pytest.mark.parametrize("name", FOLDERS)
def test_the_plan_names_each_piece_once_and_a_quick_run_the_same_kinds(name):
    """A page is made of the same kinds of pieces, quick or not; the files of no two pieces fall together."""
    plan = runpy.run_module(f"benchmarks.reproduction.{name}")["plan"]
    whole, quick = plan(False), plan(True)
    assert {function for function, _ in whole.values()} == {function for function, _ in quick.values()}
    assert set(quick) <= set(whole)
    for jobs in (whole, quick):
        assert len({job.replace("/", "_") for job in jobs}) == len(jobs)


def test_finished_pieces_are_kept_and_damaged_ones_made_again(tmp_path):
    jobs = {f"a/{i}": (piece, (i,)) for i in range(3)}
    found = pieces(tmp_path, jobs, 1)
    assert found["a/2"] == {"number": 2, "never": None}
    (tmp_path / "a_1.json").write_bytes(b'{"numb')
    kept = (tmp_path / "a_0.json").stat().st_mtime_ns
    assert set(finished(tmp_path, jobs)) == {"a/0", "a/2"}
    assert pieces(tmp_path, jobs | {"b": (piece, (7,))}, 1) == found | {"b": {"number": 7, "never": None}}
    assert (tmp_path / "a_0.json").stat().st_mtime_ns == kept
    assert read_json(tmp_path / "a_1.json", dict, "piece")["number"] == 1


def test_a_page_of_no_pieces_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["-", "--page-only", "--quick", "--work", str(tmp_path), "--pages", str(tmp_path)])
    with pytest.raises(SystemExit, match="no piece is finished"):
        runpy.run_module("benchmarks.reproduction.huav_hover", run_name="__main__")
    assert not list(tmp_path.rglob("*.md"))


def test_another_machine_goes_on_with_what_the_page_lacks(tmp_path, monkeypatch):
    keep(tmp_path, "some", {"a/0": "of the other machine"})
    monkeypatch.setattr(sys, "argv", ["-", "--missing", "--workers", "1", "--work", str(tmp_path), "--pages", str(tmp_path)])
    command("some", lambda quick: {f"a/{i}": (piece, (i,)) for i in (0, 1)}, lambda found, quick, path: None)
    assert kept(tmp_path, "some") == {"a/0": "of the other machine", "a/1": {"number": 1, "never": None}}
    assert not list(tmp_path.rglob("a_0.json"))


PAGES = ROOT / "leaderboards" / "reproduction"
LETTERS = {"b747_lateral": "abcde", "huav_hover": "abcdef", "missile_pitch": "abcd", "cmg_satellite": "abcde"}


def page_of(name, found):
    return importlib.import_module(f"benchmarks.reproduction.{name}.page").page(found, False)


@pytest.mark.parametrize("name", FOLDERS)
def test_a_page_follows_from_the_pieces_beside_it(name):
    found = kept(PAGES, name)
    assert found
    assert (PAGES / f"{name}.md").read_text(encoding="utf-8") == page_of(name, found)


def test_the_index_and_the_differences_follow_from_the_same():
    assert (PAGES / "README.md").read_text(encoding="utf-8") == index.index(PAGES)
    assert (PAGES / "differences.md").read_text(encoding="utf-8") == index.differences()
    assert index.plants() == FOLDERS == sorted(index.NAMES)


@pytest.mark.parametrize("name", FOLDERS)
def test_a_page_of_no_pieces_judges_nothing_and_says_what_it_waits_for(name, monkeypatch):
    """What needs a piece is open without it; no figure is in the code. (An earlier run's figures are data, too.)"""
    monkeypatch.setattr("benchmarks.reproduction.cmg_satellite.earlier.EARLIER", {})
    text = page_of(name, Found())
    for claim in index.claims(name):
        if claim.pieces:
            judged = judge(claim, Found())
            assert judged.verdict == OPEN
            assert "is not measured" in judged.why
    assert "is not measured" in text
    assert not re.search(r"n = [1-9]", text.partition("## Agreement")[0])


@pytest.mark.parametrize("name", FOLDERS)
def test_every_claim_of_a_paper_is_judged_and_says_which_pieces_to_measure(name):
    names = [claim.name for claim in index.claims(name)]
    assert {f"({letter})" for letter in LETTERS[name]} <= set(names)
    planned = runpy.run_module(f"benchmarks.reproduction.{name}")["plan"](False)
    for claim in index.claims(name):
        assert claim.says
        assert not claim.pieces or any(job.startswith(claim.pieces) for job in planned)


@pytest.mark.parametrize("name", [*FOLDERS, "README", "differences"])
def test_pictures_and_pages_that_a_page_names_are_there(name):
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    targets = [t for t in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in t]
    assert targets
    assert all((PAGES / target).is_file() for target in targets)


@pytest.mark.parametrize("name", FOLDERS)
def test_differences_say_what_is_printed_what_is_flown_and_why(name):
    citation, found = index.differences_of(name)
    assert citation
    assert len(found) > 10
    assert all(all(difference) for difference in found)


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(1.1, 1.9, CONFIRMED), (1.0, 2.0, CONFIRMED), (0.9, 1.5, OPEN), (1.5, 2.1, OPEN), (0.0, 0.9, NOT_CONFIRMED),
     (2.1, 3.0, NOT_CONFIRMED)],
)  # fmt: skip
def test_a_verdict_is_where_the_interval_lies(low, high, verdict):
    measured = Measured((low + high) / 2, low, high, 5)
    assert Check("x", measured, 1.0, 2.0).verdict() == verdict
    assert Check("x", Measured(math.nan, -math.inf, math.inf), 1.0, 2.0).verdict() == OPEN
    mirrored = Measured(-measured.value, -high, -low, 5)
    assert Check("x", mirrored, -2.0, -1.0).verdict() == verdict


@pytest.mark.parametrize(
    ("verdicts", "one"),
    [([], OPEN), ([OPEN, OPEN], OPEN), ([CONFIRMED] * 3, CONFIRMED), ([CONFIRMED, OPEN], PARTLY),
     ([CONFIRMED, NOT_CONFIRMED], PARTLY), ([NOT_CONFIRMED, OPEN], NOT_CONFIRMED)],
)  # fmt: skip
def test_a_claim_is_confirmed_where_all_its_tests_are(verdicts, one):
    assert together(verdicts) == one


def test_a_claim_that_the_figures_cannot_reach_stays_open():
    checks = [Check("x", exact(1.0), 0.0, 2.0)]
    assert judge(Claim("(x)", "x", lambda found: checks), Found()).verdict == CONFIRMED
    judged = judge(Claim("(x)", "x", lambda found: checks, open="calibrated"), Found())
    assert (judged.verdict, judged.checks, judged.why) == (OPEN, checks, "calibrated")


def test_intervals_hold_what_they_should():
    """Wilson's and Student's by hand; pairs that agree differ by nothing, whatever their share."""
    assert share(0, 200) == pytest.approx((0.0, 0.0, 0.01885, 200), abs=1e-5)
    assert share(81, 263)[1:3] == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert mean([1.0, 2.0, None, 3.0]) == pytest.approx(
        (2.0, 2.0 - 4.302653 / math.sqrt(3), 2.0 + 4.302653 / math.sqrt(3), 3)
    )
    assert ratio([2.0, 4.0, 8.0], [1.0, 2.0, 4.0]) == pytest.approx((2.0, 2.0, 2.0, 3))
    some = [True, False] * 50
    assert paired_shares(some, some).value == 0.0
    first = paired_shares([True] * 60 + [False] * 40, [True] * 40 + [False] * 60)
    assert first.value == pytest.approx(0.2)
    assert 0.0 < first.low < 0.2 < first.high
    back = paired_shares([True] * 40 + [False] * 60, [True] * 60 + [False] * 40)
    assert (back.value, back.low) == pytest.approx((-first.value, -first.high))


def test_pieces_beside_a_page_are_kept_to_nine_digits(tmp_path):
    found = rounded({"a": [1 / 3, {"b": 2 / 3e9}], "n": 3, "none": None, "text": "x"})
    keep(tmp_path, "x", found)
    assert kept(tmp_path, "x") == found == {"a": [0.333333333, {"b": 6.66666667e-10}], "n": 3, "none": None, "text": "x"}
    assert kept(tmp_path, "y") == {}


@pytest.mark.parametrize(
    ("said", "found", "digits", "error", "cell"),
    [
        (0.5, 0.5304, 3, 0.01, "0.500 / 0.530"),  # three errors, and the rounding
        (0.5, 0.5306, 3, 0.01, "0.500 / 0.531 *"),
        (0.5, 0.4694, 3, 0.01, "0.500 / 0.469 *"),
        (0.56, 0.565, 2, 0.0, "0.56 / 0.56"),
        (0.56, 0.5651, 2, 0.0, "0.56 / 0.57 *"),
        (math.nan, None, 1, 0.0, "- / -"),
        (math.nan, 3.0, 1, 9.0, "- / 3.0 *"),
        (3.0, None, 1, 9.0, "3.0 / - *"),
    ],
)
def test_a_star_marks_more_than_three_standard_errors_and_the_rounding(said, found, digits, error, cell):
    t = Comparisons()
    assert t.cell(said, found, digits, error) == cell
    assert (t.agree, t.total) == (not cell.endswith("*"), 1)


def test_counts_are_whole():
    t = Comparisons()
    assert t.counts([3, 4], [3, 4]) == "3/4"
    assert t.counts([3, 4], [2, 4]) == "3/4 but 2/4 *"
    assert t.cells([1.0, 2.0], [1.0, 3.0], 0) == "1 / 1, 2 / 3 *"
    assert (t.agree, t.total) == (2, 4)


def test_figures_of_the_same_flights_are_counted_as_one_set():
    t = Comparisons()
    for flights, found in (("a", 1.0), ("a", 1.0), ("b", 1.0), ("b", 2.0), ("a", 1.0)):
        t.of(flights)
        t.cell(1.0, found)
    assert t.summary().startswith("1 of 2 sets of flights agree in all their figures, 4 of 5 figures")


@pytest.mark.slow
def test_the_helicopters_scenarios_are_met_to_the_last_digit():
    """The noise streams are prescribed: the paper's setting, one filter, all of its seeds."""
    from benchmarks.reproduction.huav_hover.measure import REFERENCE, scenario_key, scenario_piece

    rows = [r for r in REFERENCE["scenario"] if r["channels"] == 3 and r["filter"] == "three_stage_ekf"]
    t = Comparisons()
    for r in rows:
        found = scenario_piece(*scenario_key(r), 24)
        t.cells(r["rmse"], found["rmse"], 2)
        t.cells(r["smoothed"], found["smoothed"], 2)
        t.cells(r["delay"], found["delay"], 2)
        t.counts(r["detected"], found["detected"])
        t.cell(r["accuracy"], found["accuracy"])
    assert len(rows) == 3
    assert t.agree == t.total


@pytest.mark.parametrize("variant", reference("missile_pitch")["variant"], ids=lambda r: f"{r['noise']}-{r['size']}")
def test_the_missiles_numbered_episodes_fly_at_every_scale(variant):
    """Also where a scaled size leaves the range that the plant declares for its own processes."""
    plant, scenarios, noise = numbered(range(20_000, 20_040), variant["noise"], variant["size"])
    for scenario in scenarios:
        unclipped(plant).validate(scenario)
    sizes = [effect.value for s in scenarios for f in s.faults for effect in f.effects if effect.entry == "theta_jetloss"]
    assert (max(sizes) > 1) == (variant["size"] > 1)
    assert len(noise) == len(scenarios)
