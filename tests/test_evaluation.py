"""Suites and their evaluation: frozen, resumable, the same on any number of blocks and workers."""

import csv
import importlib
import json
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import ROOT, build

from fdi_gym import cli, evaluation, leaderboard, suite, tables
from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.envs import FDIEnv
from fdi_gym.evaluation import evaluate
from fdi_gym.files import RefusedError
from fdi_gym.row import row_path, write_rows
from fdi_gym.suite import ActingSuite, Suite, freeze, load_suite, scenarios_digest, suite_names

NAMES = ["null", "two_stage_kf_exponential", "known_onset_oracle"]
QUIET = {"jobs": 1, "progress": False}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A frozen suite of 12 episodes: its path."""
    found = Suite(name="small", description="a test", env="B747Lateral-Faults-v0", plant="B747Lateral",
                  options={"variant": "printed/open", "labels": "single"}, process="standard", mismatch=None,
                  seeds=[*range(300, 312)], settings={})  # fmt: skip
    return freeze(found, tmp_path_factory.mktemp("suites"))


@pytest.fixture(scope="module")
def found(small, tmp_path_factory):
    return evaluate(load_suite(str(small)), NAMES, work=tmp_path_factory.mktemp("work"), command="test", **QUIET)


def test_rows_agree_with_playing_the_environment(small, found):
    """The same seeds through gym's interface give the same labels, sample by sample."""
    frozen = load_suite(str(small))
    env = FDIEnv(frozen.plant, "isolation", frozen.process, **frozen.options)
    diagnoser = make_diagnoser("two_stage_kf_exponential", env.plant)
    for i in (0, 5):
        obs, info = env.reset(seed=frozen.seeds[i])
        state, right, over = diagnoser.init(1), 0.0, False
        while True:
            state, said = diagnoser.update(state, obs[None])
            if over:
                right += float(said.label[0] == info["label"])
                break
            obs, reward, terminated, truncated, info = env.step(said.label[0])
            right, over = right + reward, terminated or truncated
        outcome = found["two_stage_kf_exponential"].outcomes[i]
        assert right == sum(c for true, declared, c in outcome.confusion if true == declared)


def test_oracle_is_above_the_filter_and_null_below(found):
    accuracy = {name: one.row.metrics["per_sample"]["balanced_accuracy"] for name, one in found.items()}
    assert accuracy["null"] < accuracy["two_stage_kf_exponential"] < accuracy["known_onset_oracle"]


def test_a_killed_run_resumes_to_the_same_bytes(small, tmp_path, monkeypatch):
    frozen = load_suite(str(small))
    whole = evaluate(frozen, NAMES, work=tmp_path / "a", block=4, **QUIET)
    calls = []
    real = evaluation.diagnose

    def killed(*arguments):
        calls.append(1)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(evaluation, "diagnose", killed)
    with pytest.raises(KeyboardInterrupt):
        evaluate(frozen, NAMES, work=tmp_path / "b", block=4, **QUIET)
    calls.clear()
    calls.extend([1] * 10)
    resumed = evaluate(frozen, NAMES, work=tmp_path / "b", block=4, **QUIET)
    assert len(calls) - 10 == 3 * len(NAMES) - 4  # what had been finished was not run again
    for name in NAMES:
        assert msgspec.json.encode(resumed[name][:2]) == msgspec.json.encode(whole[name][:2])
    assert not list(tmp_path.rglob("*.part"))


def test_rows_do_not_depend_on_blocks_and_workers(small, found, tmp_path):
    again = evaluate(load_suite(str(small)), NAMES, work=tmp_path, jobs=2, progress=False, block=5)
    for name, one in again.items():
        assert one.outcomes == found[name].outcomes
        assert one.row == found[name].row


def test_within_a_block_the_quickest_method_comes_first_and_in_the_last_the_slowest(small, tmp_path, monkeypatch):
    order = []
    real = evaluation.diagnose

    def watched(suite, plant, name, episodes, record):
        order.append((episodes.start, name))
        return msgspec.structs.replace(real(suite, plant, name, episodes, record), seconds={"null": 1.0}.get(name, 9.0))

    monkeypatch.setattr(evaluation, "diagnose", watched)
    evaluate(load_suite(str(small)), ["random", "null"], work=tmp_path, block=4, **QUIET)
    assert order == [(0, "random"), (0, "null"), (4, "null"), (4, "random"), (8, "random"), (8, "null")]


# -- suites


def heirs(of):
    """All classes that are made of one."""
    for found in of.__subclasses__():
        yield found
        yield from heirs(found)


def test_no_structure_takes_a_field_that_it_does_not_know_and_none_is_changed_once_read():
    """A misspelt field is refused. What users write themselves, options and the shapes of plants, may be changed."""
    for file in [*ROOT.glob("fdi_gym/**/*.py"), *ROOT.glob("baselines/**/*.py")]:
        if "(msgspec.Struct" in file.read_text():
            importlib.import_module(".".join(file.relative_to(ROOT).with_suffix("").parts))
    written = ("fdi_gym.options", "fdi_gym.shapes", "fdi_gym.plants.")
    found = [each for each in heirs(msgspec.Struct) if each.__module__.startswith(("fdi_gym.", "baselines."))]
    assert {"Row", "Outcome", "Belief", "Calibration", "Card", "Mapping"} <= {each.__name__ for each in found}
    assert not [each for each in found if not each.__struct_config__.forbid_unknown_fields]
    assert not [each for each in found if not each.__struct_config__.frozen and not each.__module__.startswith(written)]


def test_a_frozen_suite_cannot_be_edited(small, tmp_path):
    content = json.loads(small.read_text())
    content["seeds"] = [1, 2, 3]
    edited = tmp_path / "small.json"
    edited.write_text(json.dumps(content))
    with pytest.raises(RefusedError, match="edited after it was frozen"):
        load_suite(str(edited))
    with pytest.raises(ValueError, match="choose another name"):
        freeze(msgspec.structs.replace(load_suite(str(small)), seeds=[1, 2, 3]), small.parent)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": "../evil"}, "the name of a suite"), ({"name": "a/b"}, "the name of a suite"),
        ({"seeds": []}, "from 1 to 100000 flights, not 0"), ({"seeds": list(range(100_001))}, "from 1 to 100000 flights"),
        ({"seeds": [-1]}, "seeds are from 0"), ({"healthy": [2**62 + 1]}, "healthy are from 0"),
        ({"seeds": [1, 1]}, "named once"), ({"windows": 5}, "seeds are 5 a flight, which 12 are not"),
        ({"windows": 0}, "windows is from 1"), ({"pace": 0.0}, "pace is from 0.01"),
        ({"pace": float("nan")}, "pace is from"), ({"steps": 0}, "steps is from 1"),
        ({"steps": 10**9}, "steps is from 1"), ({"mismatch": -0.1}, "mismatch is from 0"),
        ({"mismatch": float("nan")}, "mismatch is from 0"), ({"description": "two\nlines"}, "one line"),
        ({"settings": {"../x": {}}}, "the name of a diagnoser"), ({"process": "standrd"}, "did you mean standard"),
        ({"plant": "B747"}, "unknown plant"), ({"options": {"variant": 3}}, "variant"),
        ({"options": {"varient": "bare/closed"}}, "did you mean variant"), ({"env": "HUAVHover-Faults-v0"}, "HUAVHover"),
        ({"env": "no_such_module:B747Lateral-Faults-v0"}, "cannot import no_such_module"),
        ({"settings": {"null": {"speed": 1}}}, "unknown setting of null"),
        ({"settings": {"nil": {}}}, "did you mean null"),
    ],
    ids=str,
)  # fmt: skip
def test_a_suite_that_cannot_be_flown_is_not_frozen(small, tmp_path, change, words):
    with pytest.raises(ValueError, match=words):
        freeze(msgspec.structs.replace(load_suite(str(small)), **{"name": "other", **change}), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_no_suite_is_not_overwritten(small, tmp_path):
    (tmp_path / "small.json").write_text("mine")
    with pytest.raises(RefusedError, match="is not a suite"):
        freeze(load_suite(str(small)), tmp_path)
    assert (tmp_path / "small.json").read_text() == "mine"


@pytest.mark.parametrize("name", suite_names())
def test_committed_suites_draw_what_they_were_frozen_with(name):
    frozen = load_suite(name)
    plant = frozen.build()
    assert scenarios_digest(frozen.scenarios(plant, range(frozen.episodes))) == frozen.scenarios_sha256
    assert plant.env_id == frozen.env.rpartition(":")[2]


def test_suite_seeds_are_public_test_seeds():
    """Suites use the seeds from 1,000,000 on; nothing that is tuned or trained may."""
    for name in suite_names():
        found = load_suite(name)
        assert min(found.seeds + found.healthy) >= 1_000_000


# -- the pages


@pytest.fixture(scope="module")
def committed():
    """All boards: every row is checked on the way."""
    return leaderboard.boards(ROOT / "leaderboards" / "results")


def test_committed_page_is_what_the_rows_say(committed):
    """Renders the tables again."""
    for name, text in leaderboard.pages(committed).items():
        assert (ROOT / "leaderboards" / name).read_text() == text
        for picture in re.findall(r"\((pictures/.*?)\)", text):
            assert (ROOT / "leaderboards" / picture).exists()


def test_every_committed_table_is_framed():
    """A suite with rows has its floor and its ceiling."""
    for folder in sorted((ROOT / "leaderboards" / "results").glob("*/")):
        rows = leaderboard.read_rows(folder)
        if isinstance(load_suite(folder.name), ActingSuite):
            continue  # framed by who never acts, and by the truth or who always probes
        assert {"null", "random"} <= {row.diagnoser for row in rows}, folder.name
        assert any(tables.ceiling(row) for row in rows), folder.name


def test_no_committed_row_beats_a_ceiling(committed):
    """Beyond the paired interval, per sample and per decision: else it is none."""
    for board in committed:
        if isinstance(board.suite, ActingSuite):
            continue
        for kind in ("per_sample", "per_decision"):
            drawn = board.drawn(board.rows, kind)
            for above in (row.diagnoser for row in board.rows if tables.ceiling(row)):
                for name in (row.diagnoser for row in board.rows if not tables.clairvoyant(row)):
                    assert drawn.difference(name, above)[1] <= 0, (board.suite.name, kind, name, above)


def test_what_is_attained_is_counted_from_chance_between_the_best_and_the_ceiling():
    board = leaderboard.read_board(ROOT / "leaderboards" / "results" / "b747-standard")
    score = {row.diagnoser: row.metrics["per_sample"]["balanced_accuracy"] for row in board.rows}
    best, top = board.best().diagnoser, max(score[row.diagnoser] for row in board.rows if tables.ceiling(row))
    assert board.attainable() == [score[best], top]
    shown = {
        row.diagnoser: tables.COLUMNS["attained"][1](tables.Line(row, None, False, board.attainable())) for row in board.rows
    }
    assert shown["null"] == "0-0"  # one label of five is chance
    assert shown[best] == f"{100 * (score[best] - 0.2) / (top - 0.2):.0f}-100"
    assert shown["glr_ekf"] == "-".join(f"{100 * (score['glr_ekf'] - 0.2) / (b - 0.2):.0f}" for b in (top, score[best]))
    assert {shown[row.diagnoser] for row in board.rows if tables.ceiling(row)} == {"-"}
    row = next(row for row in board.rows if row.diagnoser == best)
    assert tables.COLUMNS["attained"][1](tables.Line(row, None, False, ())) == "-"


def test_a_page_is_rendered_from_the_rows_that_are_there(small, found, tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "SUITES", small.parent)
    assert leaderboard.pages(leaderboard.boards(tmp_path)) == {"README.md": leaderboard.INTRODUCTION}
    write_rows(tmp_path, load_suite("small"), {name: found[name] for name in ("null", "known_onset_oracle")})
    page = leaderboard.pages(leaderboard.boards(tmp_path))["small.md"]
    assert page.index("| known_onset_oracle * |") < page.index("| null ")
    assert "- known_onset_oracle knows when each fault begins and ends." in page
    write_rows(tmp_path, load_suite("small"), {"two_stage_kf_exponential": found["two_stage_kf_exponential"]})
    pages = leaderboard.pages(leaderboard.boards(tmp_path))
    assert pages["small.md"].count("\n| ") == page.count("\n| ") + len(tables.RANKINGS)
    assert "| [small](small.md) | 12 " in pages["README.md"]
    assert "two_stage_kf_exponential" in pages["README.md"]
    pictures = tmp_path.with_name(f"{tmp_path.name}-pictures")
    leaderboard.draw(leaderboard.boards(tmp_path)[0], pictures)
    assert {p.name for p in pictures.iterdir()} == {"small-ranking.png", "small-confusion.png"}
    path = row_path(tmp_path, "small", "null")
    path.rename(path.with_name("random.json"))
    with pytest.raises(RefusedError, match="is the row of null"):
        leaderboard.boards(tmp_path)


def test_text_from_files_is_shown_as_it_is():
    text = "a | b `c` <script>d</script>\n# e * [f](g) \x1b[31m &lt;"
    shown = tables.plain(text)
    assert "\n" not in shown
    assert "\x1b" not in shown
    assert "<" not in shown
    for mark in "|`*[]":
        assert shown.count(mark) == shown.count("\\" + mark) == text.count(mark)


def test_a_table_that_is_too_wide_goes_on_below():
    head, body = ["method", *"abcdef"], [["one", *"123456"], ["two", *"789012"]]
    parts = tables.markdown(head, body, 24).split("\n\n")
    assert all(len(line) <= 24 for part in parts for line in part.splitlines())
    assert all(part.splitlines()[3].startswith("| two ") for part in parts)
    assert [c for part in parts for c in part.splitlines()[2].replace(" ", "").split("|")[2:-1]] == list("123456")
    assert tables.markdown(head, body, 200) == tables.markdown(head, body)


def test_confusion_matrix_prints_percent_of_rows(found):
    text = tables.confusion_table(found["null"].row, [label.name for label in build("B747Lateral").labels])
    assert np.isclose(float(text.splitlines()[2].split("|")[2]), 100.0)


# -- the whole way, by the command line


def test_command_line_end_to_end(capsys, small, tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "SUITES", small.parent)
    results, pages = tmp_path / "results", tmp_path / "pages"
    cli.main(["evaluate", "small", "--diagnosers", "null", "two_stage_kf", "--results", str(results), "--work",
              str(tmp_path / "work"), "--jobs", "1"])  # fmt: skip
    shown = capsys.readouterr().out
    assert "| two_stage_kf " in shown
    assert "rudder stuck" in shown
    cli.main(["verify", *map(str, (results / "small").glob("*.json")), "--jobs", "1"])
    assert capsys.readouterr().out.count("same outcomes") == 2
    pages.mkdir()
    cli.main(["leaderboard", "--results", str(results), "--pages", str(pages)])
    assert (pages / "small.md").read_text().count("| null") == len(tables.RANKINGS)
    assert (pages / "pictures" / "small-ranking.png").exists()


def test_a_quick_look_fits_the_screen_and_makes_no_rows(capsys, small, tmp_path):
    """Of some flights, evenly spread; with the columns and the file that are asked for."""
    look = ["evaluate", str(small), "--diagnosers", *NAMES, "--work", str(tmp_path), "--jobs", "1", "--episodes", "3"]
    cli.main([*look, "--csv", str(tmp_path / "all.csv")])
    shown = capsys.readouterr().out
    assert max(len(line) for line in shown.splitlines() if "|" in line) <= 120
    assert all(f"## {name}" in shown for name in tables.RANKINGS)
    assert "gamma_aileron" in shown
    lines = list(csv.DictReader((tmp_path / "all.csv").read_text().splitlines()))
    assert [line["diagnoser"] for line in lines] == NAMES
    assert float(lines[0]["per_sample.balanced_accuracy"]) <= 0.5
    assert lines[2]["knows"] == "when each fault begins and ends"
    cli.main([*look, "--columns", "decision", "under"])
    shown = capsys.readouterr().out
    assert "per decision %" in shown
    assert "under alarm %" in shown
    assert "per sample %" not in shown
    for wrong, words in (
        (["--columns", "decisions"], "did you mean decision"),
        (["--results", str(tmp_path)], "whole suite"),
        (["--episodes", "13"], "from 1 to 12 flights"),
    ):
        with pytest.raises(SystemExit):
            cli.main([*look, *wrong])
        assert words in capsys.readouterr().err


def test_a_diagnoser_by_module_and_function(capsys, small, tmp_path):
    cli.main(["evaluate", str(small), "--diagnosers", "baselines.trivial:null", "--work", str(tmp_path), "--jobs", "1"])
    assert "baselines.trivial:null" in capsys.readouterr().out


def test_the_folder_of_blocks_may_be_named_relatively(small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    evaluate(load_suite(str(small)).head(1), ["null"], work=Path("runs"), **QUIET)
    assert len(list(tmp_path.glob("runs/small-1-*/null-*/block-000000.json"))) == 1
