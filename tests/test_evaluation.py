"""Suites, evaluation, rows: frozen, resumable, checkable."""

import json
import os
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import ROOT, build

from fdi_gym import cli, evaluation, leaderboard
from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.envs import FDIEnv
from fdi_gym.evaluation import Suite, evaluate, freeze, load_suite, suite_names

NAMES = ["null", "two_stage_kf_exponential", "known_onset_oracle"]


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    folder = tmp_path_factory.mktemp("suites")
    small = Suite(name="small", description="a test", env="B747Lateral-Faults-v0", plant="B747Lateral",
                  options={"variant": "printed/open", "labels": "single"}, scenario="standard", mismatch=None,
                  first_seed=300, episodes=12, settings={})  # fmt: skip
    return str(freeze(small, folder))


@pytest.fixture(scope="module")
def rows(suite, tmp_path_factory):
    results = tmp_path_factory.mktemp("results")
    frozen = load_suite(suite)
    made, timing = evaluate(frozen, NAMES, work=tmp_path_factory.mktemp("work"), jobs=1, progress=False, command="test")
    leaderboard.write_rows(results, frozen, made, timing)
    return results


@pytest.fixture
def small_suites(suite, monkeypatch):
    monkeypatch.setattr(evaluation, "SUITES", Path(suite).parent)


def test_rows_agree_with_playing_the_environment(suite, rows):
    """The same seeds through gym's interface give the same labels, sample by sample."""
    frozen = load_suite(suite)
    row = leaderboard.read_row(leaderboard.row_path(rows, "small", "two_stage_kf_exponential"))
    env = FDIEnv(frozen.plant, process=frozen.scenario, **frozen.options)
    diagnoser = make_diagnoser("two_stage_kf_exponential", env.plant)
    for i in (0, 5):
        obs, info = env.reset(seed=frozen.first_seed + i)
        state, right, over = diagnoser.init(1), 0.0, False
        while True:
            state, said = diagnoser.update(state, obs[None])
            if over:
                right += float(said.label[0] == info["label"])
                break
            obs, reward, terminated, truncated, info = env.step(said.label[0])
            right, over = right + reward, terminated or truncated
        counted = sum(c for true, declared, c in row.outcomes[i].confusion if true == declared)
        assert right == counted


def test_oracle_is_above_the_filter_and_null_below(rows):
    accuracy = {
        name: leaderboard.read_row(leaderboard.row_path(rows, "small", name)).metrics["per_sample"]["balanced_accuracy"]
        for name in NAMES
    }
    assert accuracy["null"] < accuracy["two_stage_kf_exponential"] < accuracy["known_onset_oracle"]


def test_a_killed_run_resumes_to_the_same_bytes(suite, tmp_path, monkeypatch):
    frozen = load_suite(suite)
    small = {"jobs": 1, "progress": False, "block": 4}
    whole, _ = evaluate(frozen, NAMES, work=tmp_path / "a", **small)
    calls = []
    real = evaluation.diagnose

    def killed(*arguments):
        calls.append(1)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(evaluation, "diagnose", killed)
    with pytest.raises(KeyboardInterrupt):
        evaluate(frozen, NAMES, work=tmp_path / "b", **small)
    calls.clear()
    calls.extend([1] * 10)
    resumed, _ = evaluate(frozen, NAMES, work=tmp_path / "b", **small)
    assert len(calls) - 10 == 3 * len(NAMES) - 4  # what had been finished was not run again
    assert msgspec.json.encode(resumed) == msgspec.json.encode(whole)
    assert not list(tmp_path.rglob("*.part"))


def test_rows_do_not_depend_on_the_blocks(suite, rows, tmp_path):
    made, _ = evaluate(load_suite(suite), NAMES, work=tmp_path, jobs=2, progress=False, block=5)
    for name, row in made.items():
        before = leaderboard.read_row(leaderboard.row_path(rows, "small", name))
        assert row.metrics["per_sample"]["confusion"] == before.metrics["per_sample"]["confusion"]
        assert [o.onsets for o in row.outcomes] == [o.onsets for o in before.outcomes]


@pytest.mark.parametrize("name", NAMES)
def test_verify_runs_episodes_again(small_suites, rows, name):
    assert leaderboard.verify(leaderboard.row_path(rows, "small", name), share=0.3) == 4


EDITS = [
    (("metrics", "per_sample", "balanced_accuracy"), 0.999, "metrics.per_sample.balanced_accuracy"),
    (("metrics", "per_episode", "balanced_accuracy_interval", 0), 0.98, "balanced_accuracy_interval"),
    (("metrics", "false_alarms_per_hour"), 0.01, "metrics.false_alarms_per_hour"),
    (("metrics", "rmse", "during", "b_rudder"), 0.001, "metrics.rmse.during.b_rudder"),
    (("metrics", "accuracy_by_severity", "small", "per_sample"), 1.0, "metrics.accuracy_by_severity.small.per_sample"),
    (("outcomes", 3, "false_alarms"), 55, "metrics.false_alarms_per_hour"),
    (("summary",), "the best", "was edited"),
    (("suite_sha256",), "0" * 64, "of the suite"),
]


@pytest.mark.parametrize(("path", "value", "named"), EDITS, ids=[".".join(map(str, e[0])) for e in EDITS])
def test_an_edited_row_is_named_and_refused(small_suites, rows, tmp_path, path, value, named):
    source = leaderboard.row_path(rows, "small", "two_stage_kf_exponential")
    content = json.loads(source.read_text())
    place = content
    for key in path[:-1]:
        place = place[key]
    assert place[path[-1]] != value
    place[path[-1]] = value
    edited = tmp_path / "row.json"
    edited.write_text(json.dumps(content))
    with pytest.raises(leaderboard.RefusedError, match=named):
        leaderboard.verify(edited)


def test_a_row_forged_as_a_whole_fails_when_it_is_run(small_suites, rows, tmp_path):
    """All figures consistent, digests right, but the episodes are not what the diagnoser does."""
    honest = leaderboard.read_row(leaderboard.row_path(rows, "small", "known_onset_oracle"))
    forged = msgspec.structs.replace(honest, diagnoser="two_stage_kf_exponential", clairvoyant=False)
    forged = msgspec.structs.replace(forged, sha256=forged.content_sha256())
    path = tmp_path / "forged.json"
    path.write_bytes(msgspec.json.encode(forged))
    with pytest.raises(leaderboard.RefusedError, match=r"outcomes\[\d+\]"):
        leaderboard.verify(path, share=0.5)


def test_a_frozen_suite_cannot_be_edited(suite, tmp_path):
    content = json.loads(Path(suite).read_text())
    content["episodes"] = 3
    edited = tmp_path / "small.json"
    edited.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="edited after it was frozen"):
        load_suite(str(edited))
    with pytest.raises(ValueError, match="choose another name"):
        freeze(msgspec.structs.replace(load_suite(suite), episodes=3), Path(suite).parent)


def run_cli(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        cli.main(list(arguments))
    return stop.value.code, capsys.readouterr().err


def test_errors_of_the_command_line_are_one_clear_line(capsys, suite, rows, tmp_path):
    code, said = run_cli(capsys, "evaluate", "b747-nonsense")
    assert code == 2
    assert "unknown suite 'b747-nonsense'; there are b747-" in said
    code, said = run_cli(capsys, "evaluate", suite, "--diagnosers", "crystal_ball")
    assert code == 2
    assert "unknown diagnoser 'crystal_ball'" in said
    assert "two_stage_kf" in said
    code, said = run_cli(capsys, "evaluate", suite, "--diagnosers", "null", "--results", "/proc/nowhere")
    assert code == 2
    assert "cannot write results to /proc/nowhere" in said


def test_a_row_of_another_suite_version_is_not_overwritten(capsys, suite, rows, tmp_path):
    old = leaderboard.read_row(leaderboard.row_path(rows, "small", "null"))
    folder = tmp_path / "small"
    folder.mkdir()
    path = folder / "null.json"
    path.write_bytes(msgspec.json.encode(msgspec.structs.replace(old, suite_sha256="f" * 64)))
    before = path.read_bytes()
    code, said = run_cli(capsys, "evaluate", suite, "--diagnosers", "null", "--results", str(tmp_path))
    assert code == 2
    assert "another version of small" in said
    assert path.read_bytes() == before
    assert os.listdir(folder) == ["null.json"]


def test_command_line_end_to_end(capsys, small_suites, suite, tmp_path):
    results, page = tmp_path / "results", tmp_path / "page.md"
    cli.main(["evaluate", "small", "--diagnosers", "null", "two_stage_kf", "--results", str(results), "--work",
              str(tmp_path / "work"), "--jobs", "1"])  # fmt: skip
    shown = capsys.readouterr().out
    assert "| two_stage_kf " in shown
    assert "rudder stuck" in shown
    cli.main(["verify", str(results / "small" / "two_stage_kf.json")])
    assert "same outcomes" in capsys.readouterr().out
    cli.main(["leaderboard", "--results", str(results), "--page", str(page)])
    assert page.read_text().count("| null") == 1


def test_your_own_diagnoser_by_module_and_function(capsys, suite, tmp_path):
    cli.main(["evaluate", suite, "--diagnosers", "baselines.trivial:null", "--work", str(tmp_path), "--jobs", "1"])
    assert "baselines.trivial:null" in capsys.readouterr().out


def test_list(capsys):
    cli.main(["list"])
    said = capsys.readouterr().out
    for name in ("B747Lateral-Faults-v0", "b747-standard", "two_stage_kf_directional"):
        assert name in said
    cli.main(["list", "B747Lateral"])
    assert "gamma_rudder" in capsys.readouterr().out


# -- what is committed


@pytest.mark.parametrize("name", suite_names())
def test_committed_suites_draw_what_they_were_frozen_with(name):
    frozen = load_suite(name)
    plant = frozen.build()
    assert evaluation.scenarios_digest(frozen.scenarios(plant, range(frozen.episodes))) == frozen.scenarios_sha256
    assert plant.env_id == frozen.env.rpartition(":")[2]


def test_committed_page_is_what_the_rows_say():
    """Renders the tables again, which checks every row on the way."""
    assert leaderboard.render(ROOT / "leaderboards" / "results") == (ROOT / "leaderboards" / "README.md").read_text()


def committed_rows():
    return sorted(p for p in (ROOT / "leaderboards" / "results").rglob("*.json") if p.name != "timing.json")


@pytest.mark.slow
@pytest.mark.parametrize("path", committed_rows(), ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_committed_rows_give_the_same_outcomes(path):
    assert leaderboard.verify(path) >= 1


def test_every_table_is_framed():
    """Each suite with rows has its floor and its ceiling."""
    for folder in (ROOT / "leaderboards" / "results").iterdir():
        names = {path.stem for path in folder.glob("*.json")}
        assert {"null", "random"} <= names
        assert any(leaderboard.read_row(folder / f"{n}.json").clairvoyant for n in names - {"timing"}), folder.name


def test_suite_seeds_are_public_test_seeds():
    """Suites use the seeds from 1,000,000 on; nothing that is tuned or trained may."""
    for name in suite_names():
        assert load_suite(name).first_seed >= 1_000_000


def test_confusion_matrix_prints_percent_of_rows(rows, suite):
    row = leaderboard.read_row(leaderboard.row_path(rows, "small", "null"))
    text = leaderboard.confusion_table(row, [label.name for label in build("B747Lateral").labels])
    assert np.isclose(float(text.splitlines()[2].split("|")[2]), 100.0)
