"""The papers' figures measured again: what is printed has a source, finished pieces are kept, stars mean what they say."""

import math
import runpy
import sys

import pytest
from conftest import ROOT

from benchmarks.reproduction.comparison import Comparisons
from benchmarks.reproduction.missile_pitch.measure import numbered, unclipped
from benchmarks.reproduction.pieces import finished, pieces, reference
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


def test_a_page_of_pieces_that_are_missing_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["-", "--page-only", "--quick", "--work", str(tmp_path), "--pages", str(tmp_path)])
    with pytest.raises(SystemExit, match="pieces are not finished"):
        runpy.run_module("benchmarks.reproduction.huav_hover", run_name="__main__")
    assert not list(tmp_path.rglob("*.md"))


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
