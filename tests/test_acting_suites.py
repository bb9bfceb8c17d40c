"""Suites whose flights are acted on: who may enter, that a row holds, and what its page says."""

import msgspec
import numpy as np
import pytest

from fdi_gym import cli, export, leaderboard, rounds
from fdi_gym.acted import Acted, at_this_cost, recovered
from fdi_gym.diagnosis import find_diagnoser, probers
from fdi_gym.entrants import TRUTH, find_entrant, fly_entrant, make_entrant
from fdi_gym.files import RefusedError
from fdi_gym.metrics import Outcome, check_outcomes
from fdi_gym.row import read_outcomes, read_row, row_path
from fdi_gym.scores import costs
from fdi_gym.suite import ActingSuite, Suite, freeze, load_suite, suite_names

ACTING = [name for name in suite_names() if isinstance(load_suite(name), ActingSuite)]
COMMON = {"description": "few", "env": "B747Lateral-Faults-v0", "plant": "B747Lateral", "mismatch": None,
          "seeds": [5, 6, 7, 8], "steps": 400, "settings": {}}  # fmt: skip
OUTSIDE = """
import numpy as np
from fdi_gym.agents import Prober

def mine(plant, *, process="standard", period=10, probe=1):
    return Prober(lambda n: n, lambda n, obs, said: (n, np.full(len(obs), probe)))

def wrong(plant):
    return Prober(lambda n: n, lambda n, obs, said: (n, np.full(len(obs), 99)))
"""


def said(capsys, *words):
    """What the command line says: status, stdout, stderr."""
    with pytest.raises(SystemExit) as end:
        cli.main(list(words))
    return end.value.code, *capsys.readouterr()


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with two suites, a module of one's own, and rows of both suites."""
    folder = tmp_path_factory.mktemp("acting")
    (folder / "mine_to_probe.py").write_text(OUTSIDE)
    for suite in (
        ActingSuite(name="few-active", options={"variant": "printed/open"}, process="quiet", acts="probing",
                    decision_period=10, on_board="augmented_ekf", **COMMON),
        ActingSuite(name="few-allowed", options={"variant": "bare/closed"}, process="banking", acts="accommodation",
                    decision_period=10, **COMMON),
        Suite(name="few-passive", options={"variant": "printed/open"}, process="quiet", **COMMON),
    ):  # fmt: skip
        freeze(suite, folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(str(folder))
        probing = ["augmented_ekf", "periodic_probes_30", "greedy_probes", "mine_to_probe:mine"]
        for name, entrants in (("few-active", probing), ("few-allowed", ["null", "truth", "false_alarm"])):
            cli.main(["evaluate", f"{name}.json", "--diagnosers", *entrants, "--results", "results", "--jobs", "1",
                      "--confusion", "none"])  # fmt: skip
    return folder


@pytest.fixture
def here(home, monkeypatch):
    monkeypatch.chdir(home)
    monkeypatch.syspath_prepend(str(home))
    return home


def acted_of(home, name):
    suite = load_suite(str(home / f"{name}.json"))
    board = leaderboard.read_board(home / "results" / name, {name: suite})
    return Acted(suite, board.plant, board.rows, board.outcomes)


def test_every_plant_has_a_suite_of_probing_and_one_of_accommodation():
    held = {(load_suite(name).plant, load_suite(name).acts) for name in ACTING}
    assert {(plant, acts) for plant in ("B747Lateral", "CMGSatellite", "HUAVHover", "MissilePitch", "ThreeTank")
            for acts in ("probing", "accommodation")} <= held  # fmt: skip


def test_rows_hold_and_their_flights_are_the_same_again_whoever_flies_beside(here):
    for suite, name in (("few-active", "greedy_probes"), ("few-active", "mine_to_probe:mine"), ("few-allowed", "truth"),
                        ("few-allowed", "false_alarm")):  # fmt: skip
        path = row_path(here / "results", suite, name)
        trust = ["--trust", name] if ":" in name else []
        cli.main(["verify", str(path), "--suite", f"{suite}.json", "--share", "0.3", "--seed", "1", "--jobs", "1", *trust])
        row = read_row(path)
        assert row.digests.get("on board") if suite == "few-active" else "on board" not in row.digests


def test_a_row_that_says_another_cost_is_refused(here):
    path = row_path(here / "results", "few-active", "greedy_probes")
    row, plant = read_row(path), load_suite("few-active.json").build()
    outcomes = read_outcomes(path, row, plant)
    dear = msgspec.structs.replace(outcomes[0], acted=msgspec.structs.replace(outcomes[0].acted, cost=-1.0))
    with pytest.raises(ValueError, match="acts that no flight can have"):
        check_outcomes([dear], len(plant.labels), len(plant.estimated))
    changed = {**row.metrics, "acting": {**row.metrics["acting"], "cost": 0.0}}
    from fdi_gym.verification import check_row

    with pytest.raises(RefusedError, match=r"acting\.cost"):
        check_row(msgspec.structs.replace(row, metrics=changed), outcomes, load_suite("few-active.json"), plant)


def test_what_is_not_acted_on_says_nothing_of_acts(here):
    from fdi_gym.evaluation import diagnose

    suite = load_suite("few-passive.json")
    (outcome,) = diagnose(suite, suite.build(), "null", [0]).outcomes
    assert b"acted" not in msgspec.json.encode(outcome)
    assert msgspec.json.decode(msgspec.json.encode(outcome), type=Outcome) == outcome


def test_an_entrant_that_never_probes_flies_the_passive_flights(here):
    active, passive = load_suite("few-active.json"), load_suite("few-passive.json")
    plant = active.build()
    flown = fly_entrant(active, plant, "augmented_ekf", range(4))
    np.testing.assert_array_equal(flown.record.obs, passive.record(plant, range(4)).obs)
    assert all(one.probed == 0 for one in flown.acted)


@pytest.mark.parametrize(
    ("suite", "name", "words"),
    [("few-active", "greedy_prober", "unknown prober or diagnoser 'greedy_prober'; did you mean greedy_probes"),
     ("few-allowed", "greedy_probes", "is a prober, and few-allowed allows for diagnoses"),
     ("few-passive", "greedy_probes", "is a prober, and few-passive is of flights that nobody acts on"),
     ("few-passive", "mine_to_probe:mine", "is a prober"),
     ("few-passive", "truth", "unknown diagnoser"),
     ("few-active", "mine_to_probe:none", "has no function")],
)  # fmt: skip
def test_who_cannot_enter_is_told_why(here, capsys, suite, name, words):
    code, _, err = said(capsys, "evaluate", f"{suite}.json", "--diagnosers", name, "--jobs", "1")
    assert code == 2
    assert words in " ".join(err.split())


def test_a_prober_that_chooses_what_there_is_not_is_named(here):
    suite = load_suite("few-active.json")
    with pytest.raises(ValueError, match=r"whole numbers of the shape \(1,\), of the probes 0 none, 1 aileron") as error:
        fly_entrant(suite, suite.build(), "mine_to_probe:wrong", [0])
    assert error.value.__notes__ == ["mine_to_probe:wrong"]


def test_kinds_of_entrants(here):
    suite = load_suite("few-active.json")
    plant = suite.build()
    assert find_entrant(suite, plant, "mine_to_probe:mine").kind == "prober"
    assert find_entrant(suite, plant, "baselines.trivial:null").kind == "diagnoser"
    assert find_entrant(load_suite("few-allowed.json"), plant, "truth") is TRUTH
    for name in probers():
        with pytest.raises(ValueError, match="unknown diagnoser"):
            find_diagnoser(name)


def test_flights_that_answer_are_neither_exported_nor_sealed(here, tmp_path, capsys):
    suite = load_suite("few-active.json")
    with pytest.raises(ValueError, match="answer to who acts"):
        export.parquet(suite, tmp_path, 1, progress=False)
    with pytest.raises(ValueError, match="acted on"):
        rounds.seal("round", suite, tmp_path, 1, 2)
    for words in (("report", "few-active.json", "-o", str(tmp_path / "r.html"), "--results", "results"),
                  ("plot", "flight", "few-active.json", "--methods", "augmented_ekf")):  # fmt: skip
        code, _, err = said(capsys, *words)
        assert (code, "answer to who acts" in " ".join(err.split())) == (2, True)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"decision_period": 0}, "decision_period"), ({"on_board": ""}, "diagnoser"), ({"on_board": "../x"}, "diagnoser"),
     ({"acts": "accommodation"}, "whoever enters is on board"), ({"acts": "wishing"}, "wishing")],
)  # fmt: skip
def test_a_suite_that_cannot_be_is_refused(here, tmp_path, changes, words):
    suite = msgspec.to_builtins(load_suite("few-active.json")) | changes
    with pytest.raises(ValueError, match=words):
        freeze(msgspec.convert(suite, ActingSuite), tmp_path)


def test_somebody_unknown_on_board_is_refused(here, tmp_path):
    with pytest.raises(ValueError, match="unknown diagnoser 'nobody'"):
        freeze(msgspec.structs.replace(load_suite("few-active.json"), on_board="nobody"), tmp_path)


def test_settings_of_a_suite_reach_its_probers(here):
    suite = load_suite("few-active.json")
    other = msgspec.structs.replace(suite, settings={"periodic_probes_30": {"probes": ["rudder"], "on": 20}})
    flown = fly_entrant(other, other.build(), "periodic_probes_30", [0])
    assert set(np.unique(flown.probe)) == {0, 2}
    with pytest.raises(ValueError, match="probe"):
        make_entrant(msgspec.structs.replace(suite, settings={"periodic_probes_30": {"on": 99}}), suite.build(),
                     "periodic_probes_30", None)  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------
# What the page says


def test_the_truth_recovers_all_and_nothing_recovers_nothing():
    rng = np.random.default_rng(0)
    truth, fault = rng.uniform(1, 2, 50), rng.uniform(0.5, 1.5, 50)
    nothing = truth + fault
    assert recovered(nothing, truth, truth) == (1.0, 1.0, 1.0)
    assert recovered(nothing, nothing, truth) == (0.0, 0.0, 0.0)
    half = recovered(nothing, truth + fault / 2, truth)
    assert half == pytest.approx((0.5, 0.5, 0.5))
    assert recovered(truth, truth, truth + rng.normal(size=50)) is None


def test_one_that_looks_is_held_against_the_mixture_of_its_cost(here):
    """A prober with the outcomes of a blind one is no better than it at its cost; one with the passive's neither."""
    acted = acted_of(here, "few-active")
    row = next(r for r in acted.rows if r.diagnoser == "greedy_probes")
    for twin in ("periodic_probes_30", "augmented_ekf"):
        same = acted._replace(outcomes={**acted.outcomes, "greedy_probes": acted.outcomes[twin]})
        gap = at_this_cost(same, same.drawn(), row)
        assert gap is None or gap == pytest.approx((0.0, 0.0, 0.0))
    assert at_this_cost(acted, acted.drawn(), acted.passive()) is None


def test_pages_hold_every_row_and_are_drawn(here, tmp_path):
    cli.main(["leaderboard", "--results", "results", "--pages", str(tmp_path), "--suites", "few-active.json",
              "few-allowed.json"])  # fmt: skip
    front = (tmp_path / "README.md").read_text()
    for name in ("few-active", "few-allowed"):
        text = (tmp_path / f"{name}.md").read_text()
        for row in acted_of(here, name).rows:
            assert f"| {leaderboard.plain(row.diagnoser)} " in text
        assert f"[{name}]({name}.md)" in front
        assert (tmp_path / "pictures" / f"{name}.png").stat().st_size > 10_000
    assert (tmp_path / "pictures" / "few-active-flight.png").stat().st_size > 10_000
    acted = acted_of(here, "few-allowed")
    assert costs(acted.outcomes["false_alarm"]).mean() > costs(acted.outcomes["null"]).mean()
