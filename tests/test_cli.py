"""The command line: whatever is typed gets an answer in words, never a traceback, and nothing is lost."""

import importlib.metadata
import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest
from conftest import PLANTS, ROOT

from fdi_gym import __version__, cli, evaluation, suite
from fdi_gym.diagnosis import broken_plugins, diagnosers, registry, trainers
from fdi_gym.suite import Suite, freeze, load_suite, suite_names

FDI_GYM = [sys.executable, "-m", "fdi_gym.cli"]


def said(capsys, *arguments):
    """Exit status, standard output and standard error of a call."""
    code = 0
    try:
        cli.main([str(a) for a in arguments])
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    return code, out, err


def refused(capsys, *arguments):
    """The one line that says why a call is refused."""
    code, _, err = said(capsys, *arguments)
    lines = [line for line in err.splitlines() if line.startswith("fdi-gym: ")]
    assert code == 2, (code, err)
    assert len(lines) == 1, err
    assert "Traceback" not in err
    return lines[0]


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    found = Suite(name="small", description="a test", env="B747Lateral-Faults-v0", plant="B747Lateral",
                  options={"variant": "printed/open", "labels": "single"}, process="standard", mismatch=None,
                  seeds=[*range(300, 304)], settings={})  # fmt: skip
    return freeze(found, tmp_path_factory.mktemp("suites"))


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty current folder; the modules in it are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


# -- names


WRONG = [
    (("evaluate", "b747-standrd"), "unknown suite 'b747-standrd'; did you mean b747-standard?"),
    (("evaluate", "nowhere.json"), "there is no suite nowhere.json"),
    (("evaluate", "."), "unknown suite"), (("evaluate", "../suites/x"), "unknown suite"),
    (("evaluate", "b747-paper", "--diagnosers", "two_stage_kff"), "did you mean two_stage_kf?"),
    (("evaluate", "b747-paper", "--diagnosers", "no_such_module:build"), "cannot import no_such_module"),
    (("evaluate", "b747-paper", "--diagnosers", "json:nothing"), "json has no function 'nothing'"),
    (("evaluate", "b747-paper", "--diagnosers", "json:__name__"), "json has no function '__name__'"),
    (("evaluate", "b747-paper", "--diagnosers", "math:sin:cos"), "names something in a module"),
    (("evaluate", "b747-paper", "--diagnosers", "..:f"), "names something in a module"),
    (("evaluate", "b747-paper", "--diagnosers", ":"), "names something in a module"),
    (("evaluate", "b747-paper", "--diagnosers", "null", "--jobs", "0"), "jobs is 1 or more, or -1"),
    (("evaluate", "b747-paper", "--diagnosers", "null", "--jobs", "-3"), "jobs is 1 or more, or -1"),
    (("evaluate", "b747-paper", "--diagnosers", "null", "--results", "/proc/none"), "cannot write results to /proc/none"),
    (("evaluate", "b747-paper", "--diagnosers", "mekf"), "none of these diagnosers can run on B747Lateral"),
    (("verify",), "there are no rows"), (("verify", "results/made.json"), "there are no rows"),
    (("verify", "nowhere.json"), "nowhere.json is no file"), (("verify", "/dev/zero"), "/dev/zero is no file"),
    (("verify", "."), "is no file"), (("verify", "x.json", "--share", "2"), "share is above 0 and up to 1"),
    (("verify", "x.json", "--share", "0"), "share is above 0 and up to 1"),
    (("verify", "x.json", "--seed", "-1"), "seed is 0 or more"),
    (("leaderboard", "--results", "nowhere", "--pages", "nowhere"), "nowhere is no folder of rows"),
    (("evaluate", "b747-paper", "--diagnosers", "null", "--columns", "smple"), "did you mean sample?"),
    (("evaluate", "b747-paper", "--diagnosers", "null", "--episodes", "0"), "has from 1 to 30 flights, not 0"),
    (("list", "B747Latera"), "did you mean B747Lateral"), (("list", "b747-papr"), "did you mean b747-paper"),
    (("list", "sequence_nets"), "did you mean sequence_net"), (("list", "no_such_module:x"), "cannot import no_such_module"),
    (("list", "B747Lateral-Faults-v9"), "mean B747Lateral-Faults-v0"), (("list", "nowhere.json"), "there is no suite"),
    (("freeze", "../evil", *(standard := ("--plant", "HUAVHover", "--process", "standard", "--description", "d")),
      "--episodes", "1"), "the name of a suite"),
    (("freeze", "x", *standard, "--episodes", "0"), "from 1 to 100000 flights, not 0"),
    (("freeze", "x", *standard, "--decisions", "0"), "decisions is 1 or more, not 0"),
    (("freeze", "x", *standard, "--episodes", "1", "--first-seed", "-1"), "seeds are from 0"),
    (("freeze", "x", *standard, "--episodes", "1", "--mismatch", "nan"), "mismatch is from 0 to 1"),
    (("freeze", "x", *standard, "--episodes", "1", "--options", "kapa", "0.5"), "did you mean kappa?"),
    (("freeze", "x", *standard, "--episodes", "1", "--options", "kappa", "much"), "kappa of HUAVHover: Expected `float`"),
    (("freeze", "x", *standard, "--episodes", "1", "--options", "kappa", "nan"), "a finite number"),
    (("freeze", "x", *standard, "--episodes", "1", "--settings", "{"), "--settings is not JSON"),
    (("freeze", "x", *standard, "--episodes", "1", "--settings", '{"nul": {}}'), "did you mean null"),
    (("freeze", "x", "--plant", "HUAVHovr", *standard[2:], "--episodes", "1"), "did you mean HUAVHover"),
    (("freeze", "x", "--plant", "HUAVHover", "--process", "hrad", "--description", "d", "--episodes", "1"), "mean hard"),
    (("train", "sequence_nett", "B747Lateral"), "did you mean sequence_net?"),
    (("train", "sequence_net", "B747"), "unknown plant 'B747'; did you mean B747Lateral?"),
    (("train", "sequence_net", "B747Lateral", "--budget", "0"), "budget is 1 or more, not 0"),
    (("train", "sequence_net", "B747Lateral", "--seed", "-1"), "seed is 0 or more, not -1"),
    (("train", "sequence_net", "B747Lateral", "--threads", "0"), "threads is 1 or more, not 0"),
    (("train", "json:dumps", "B747Lateral"), "json:dumps failed: TypeError"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "words"), WRONG, ids=[" ".join(a)[:60] for a, _ in WRONG])
def test_what_is_wrong_is_one_line_that_says_what_is_right(capsys, here, arguments, words):
    assert words in refused(capsys, *arguments, *(["--folder", "."] if arguments[0] == "freeze" else []))
    assert not list(here.glob("*.json"))


@pytest.mark.parametrize("arguments", [(), ("evalute",), ("evaluate",), ("evaluate", "x", "--jobs", "two"), ("freeze", "x"),
                                       ("evaluate", "x", "--confusion", "some"), ("list", "a", "b")], ids=str)  # fmt: skip
def test_usage_errors_have_status_2(capsys, here, arguments):
    code, _, err = said(capsys, *arguments)
    assert code == 2
    assert err.strip()
    assert "Traceback" not in err


# -- your own code


BUILDERS = {
    "raises": ("def build(plant):\n    return 1 / 0", "builder of own:build failed: ZeroDivisionError: .*own.py, line 2"),
    "returns None": ("def build(plant):\n    pass", "the builder of own:build gives NoneType, not a Diagnoser"),
    "returns a number": ("def build(plant):\n    return 3", "the builder of own:build gives int, not a Diagnoser"),
    "takes nothing": ("def build():\n    pass", "own:build is no builder of a diagnoser: it takes no plant"),
    "takes more": ("def build(plant, other):\n    pass", "the builder of own:build failed: TypeError: .*'other'"),
    "refuses": ("def build(plant):\n    raise ValueError('not today')", "own:build: not today"),
    "exits": ("raise SystemExit(0)", "cannot import own: SystemExit"),
    "no Python": ("def build(", "cannot import own: SyntaxError: .*own.py, line 1"),
    "import fails": ("import no_such_thing", "cannot import own: No module named 'no_such_thing'"),
    "fails later": ("from fdi_gym.diagnosis import Diagnoser\ndef build(plant):\n"
                    "    return Diagnoser(lambda n: (), lambda s, y: {}['x'])", "own:build failed: KeyError: 'x' .*line 3"),
    "no batch": ("from fdi_gym.diagnosis import Diagnoser\ndef build(plant):\n"
                 "    return Diagnoser(lambda: (), lambda s, y: s)", "own:build failed: TypeError"),
}  # fmt: skip


@pytest.mark.parametrize("case", BUILDERS)
def test_a_builder_that_is_none_is_named(capsys, here, small, case):
    code, words = BUILDERS[case]
    (here / "own.py").write_text(code)
    line = refused(capsys, "evaluate", small, "--diagnosers", "own:build", "--jobs", "1")
    assert re.search(words, line), line


def test_a_diagnoser_in_the_current_folder_is_found_in_every_worker(here, small):
    (here / "own.py").write_text("from baselines.trivial import null as build\n")
    command = [*FDI_GYM, "evaluate", str(small), "--diagnosers", "own:build", "--jobs", "2", "--results", "results"]
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "own:build" in done.stdout
    assert (here / "results" / "small" / "own.build.json").exists()


def test_the_commands_of_the_examples_work(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT / "examples")
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p != str(ROOT / "examples")])
    code, out, err = said(capsys, "list", "dc_motor:DCMotor")
    assert code == 0, err
    assert "DCMotor-Faults-v0" in out
    name = "02_write_a_diagnoser:mean_innovation_test"
    code, out, err = said(capsys, "list", name)
    assert code == 0, err
    assert "memory" in out
    assert "did you mean DCMotor?" in refused(capsys, "train", "sequence_net", "dc_motor:DCMotors")
    options = ("--process", "standard", "--description", "d", "--episodes", "1", "--folder", tmp_path)
    assert said(capsys, "freeze", "motor", "--plant", "dc_motor:DCMotor", *options)[0] == 0
    assert load_suite(str(tmp_path / "motor.json")).env == "dc_motor:DCMotor-Faults-v0"


# -- many suites


@pytest.fixture
def two(here, small, monkeypatch):
    """A folder with two suites, which are all there are."""
    folder = here / "suites"
    folder.mkdir()
    (folder / "small.json").write_bytes(small.read_bytes())
    other = Suite(name="other", description="another", env="MissilePitch-Faults-v0", plant="MissilePitch", options={},
                  process="standard", mismatch=None, seeds=[*range(300, 302)], settings={})  # fmt: skip
    freeze(other, folder)
    monkeypatch.setattr(suite, "SUITES", folder)
    return here


ALL = (
    "evaluate",
    "all",
    "--diagnosers",
    "null",
    "random",
    "two_stage_kf",
    "--jobs",
    "1",
    "--work",
    "work",
    "--results",
    "r",
)


def rows_in(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != "made.json"}


def test_all_suites_are_evaluated_by_one_command(capsys, two):
    code, out, err = said(capsys, *ALL, "--csv", "all.csv")
    assert code == 0, err
    lines = out.strip().splitlines()[-2:]
    assert re.fullmatch(r"other: 2 rows in r/other, \d+ s", lines[0])
    assert re.fullmatch(r"small: 3 rows in r/small, \d+ s", lines[1])
    assert "other: two_stage_kf: not applicable" in err
    assert len(rows_in(two / "r")) == 2 * 5
    table = (two / "all.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in table[1:]] == ["other"] * 2 + ["small"] * 3
    assert all(float(line.split(",")[table[0].split(",").index("microseconds")]) > 0 for line in table[1:])
    before = rows_in(two / "r")
    assert said(capsys, *ALL, "--replace")[0] == 0
    assert rows_in(two / "r") == before
    made = json.loads((two / "r" / "other" / "made.json").read_text())
    assert made["null"]["command"] == "fdi-gym evaluate other --diagnosers null"


def test_the_rows_of_a_board_are_made_anew_by_one_command(capsys, two):
    """Each suite's own methods: those that have a row in the folder."""
    board = ("evaluate", "all", "--diagnosers", "board", "--jobs", "1", "--work", "again")
    assert "say which, with --results" in refused(capsys, *board)
    assert said(capsys, *ALL)[0] == 0
    (two / "r" / "small" / "random.json").unlink()
    before = rows_in(two / "r")
    code, out, err = said(capsys, *board, "--results", "r", "--replace")
    assert code == 0, err
    assert [line.rpartition(",")[0] for line in out.strip().splitlines()[-2:]] == \
        ["other: 2 rows in r/other", "small: 2 rows in r/small"]  # fmt: skip
    assert rows_in(two / "r") == before


def test_a_killed_run_over_all_suites_goes_on_where_it_was(capsys, two, monkeypatch):
    """Rows are written suite by suite, and no block is made twice."""
    evaluate = evaluation.evaluate

    def killed(asked, *arguments, **keywords):
        if asked.name == "small":
            raise KeyboardInterrupt
        return evaluate(asked, *arguments, **keywords)

    with monkeypatch.context() as patched:
        patched.setattr(evaluation, "evaluate", killed)
        code, _, err = said(capsys, *ALL)
    assert (code, err.count("goes on from what is finished")) == (130, 1)
    first = rows_in(two / "r")
    assert len(first) == 4
    done = {path: path.stat().st_mtime_ns for path in (two / "work").rglob("block-*.json")}
    assert len(done) == 2
    assert said(capsys, *ALL)[0] == 0
    assert {path: path.stat().st_mtime_ns for path in done} == done
    assert first.items() <= rows_in(two / "r").items()
    assert len(rows_in(two / "r")) == 10


def test_what_is_wrong_with_one_of_many_suites_is_said_before_anything_runs(capsys, two):
    some = ("--diagnosers", "null", "--jobs", "1", "--work", "work", "--results", "r")
    assert "did you mean small?" in refused(capsys, "evaluate", "other", "smal", *some)
    assert said(capsys, "evaluate", "small", *some)[0] == 0
    (two / "r" / "small" / "null.json").write_text("mine")
    assert "is not a row" in refused(capsys, "evaluate", "other", "small", *some, "--replace")
    assert not list((two / "work").glob("other*"))
    assert "evaluate a suite, or all; there are other, small" in refused(capsys, "evaluate")


# -- freeze


def test_options_are_of_the_types_that_the_plant_declares(capsys, here):
    code, out, err = said(
        capsys, "freeze", "own", "--plant", "HUAVHover-Faults-v0", "--process", "standard", "--description", "d",
        "--episodes", "1", "--options", "kappa", "0.5", "--settings", '{"three_stage_cdkf": {"channels": ["lon"]}}',
        "--folder", here,
    )  # fmt: skip
    assert code == 0, err
    frozen = load_suite(out.strip())
    assert frozen.options["kappa"] == 0.5
    assert frozen.build().options["kappa"] == 0.5
    assert frozen.settings == {"three_stage_cdkf": {"channels": ["lon"]}}


# -- list


def test_list_names_everything(capsys):
    code, out, _ = said(capsys, "list")
    assert code == 0
    words = out.split()
    for name in (*suite_names(), *diagnosers(), *trainers(), *(f"{p}-Faults-v0" for p in PLANTS)):
        assert name in words
    assert "broken:" not in out.lower()
    assert "Broken plug-ins" not in out


THINGS = [
    *PLANTS,
    *(f"{p}-Faults-v0" for p in PLANTS),
    *suite_names(),
    *sorted(trainers()),
    "two_stage_kf",
    "known_onset_oracle",
]


@pytest.mark.parametrize("name", THINGS)
def test_list_says_all_about_one_thing(capsys, name):
    code, out, err = said(capsys, "list", name)
    assert code == 0, err
    assert name.split("-Faults")[0] in out
    wanted = []
    if name in diagnosers():
        wanted += ["settings", *PLANTS]
    if name in suite_names():
        wanted += [load_suite(name).process, f"fdi-gym evaluate {name}"]
    if name in trainers():
        wanted += [f"fdi-gym train {name} PLANT"]
    for words in wanted or ["fault modes", "labels"]:
        assert words in out


def test_nothing_that_ships_is_broken():
    assert broken_plugins() == {}


def test_what_is_broken_does_not_stop_list(capsys, here, small, monkeypatch):
    (here / "broken_plugin.py").write_text("1 / 0")
    (here / "good_plugin").mkdir()
    (here / "good_plugin" / "__init__.py").write_text("")
    (here / "good_plugin" / "bad.py").write_text("import")
    monkeypatch.syspath_prepend(str(here))
    (here / "small.json").write_bytes(small.read_bytes())
    (here / "empty.json").write_text("")
    (here / "deep.json").write_text("[" * 100_000)
    monkeypatch.setattr(suite, "SUITES", here)
    points = [importlib.metadata.EntryPoint(f"p{i}", value, "fdi_gym.diagnosers")
              for i, value in enumerate(("broken_plugin", "good_plugin", "missing", "baselines.trivial"))]  # fmt: skip
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    broken_plugins.cache_clear()
    try:
        code, out, err = said(capsys, "list")
        assert code == 0, err
        for words in ("small ", "null ", "empty ", "deep ", "broken: ", "broken_plugin ", "ZeroDivisionError",
                      "good_plugin.bad", "SyntaxError", "missing "):  # fmt: skip
            assert words in out
    finally:
        broken_plugins.cache_clear()


def test_listing_and_evaluating_do_not_import_what_is_slow(here, small):
    code = (
        "import sys; from fdi_gym import cli; cli.main(['list']); "
        f"cli.main(['evaluate', {str(small)!r}, '--diagnosers', 'windowed_nis', '--jobs', '1']); "
        "slow = {'scipy.stats', 'torch', 'matplotlib'} & set(sys.modules); assert not slow, slow"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=here, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr


# -- how it ends


def test_version(capsys):
    assert said(capsys, "--version") == (0, f"fdi-gym {__version__}\n", "")


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_says_what_a_word_stands_for(capsys, command):
    code, out, _ = said(capsys, command, "--help")
    assert code == 0
    assert not re.search(r"\bSTR\b", out)
    assert {"evaluate": "SUITE", "verify": "ROW", "leaderboard": "PATH", "list": "NAME", "freeze": "PLANT",
            "train": "METHOD", "fit": "PLANT", "report": "SUITE", "plot": "SUITE",
            "diagnose": "FLIGHT", "collect": "FOLDER", "export": "SUITE", "new": "FOLDER",
            "check": "NAME", "diagnosability": "PLANT", "seal": "SUITE", "reveal": "ROUND"}[command] in out  # fmt: skip


@pytest.mark.parametrize("arguments", [("list",), ("--help",), ("list", "B747Lateral"), ("list", "nothing")], ids=" ".join)
def test_a_closed_pipe_is_silent(arguments):
    command = subprocess.Popen([*FDI_GYM, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    command.stdout.close()
    err = command.stderr.read().decode()
    command.stderr.close()
    assert command.wait(60) in ((2,) if "nothing" in arguments else (141,))
    assert err.count("\n") <= 1
    assert "Traceback" not in err
    assert "Exception" not in err


def test_an_interruption_is_one_line_and_status_130(tmp_path, small):
    run = subprocess.Popen(
        [*FDI_GYM, "evaluate", "b747-standard", "--diagnosers", "random", "switching_bayes_bank", "--jobs", "2",
         "--work", str(tmp_path)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background ignores it
    )  # fmt: skip
    for _ in range(1200):
        if list(tmp_path.rglob("block-*.json")) or run.poll() is not None:
            break
        time.sleep(0.05)
    time.sleep(
        3
    )  # both workers are at work on what takes long: one that still starts says in its own way that it was stopped
    os.killpg(run.pid, signal.SIGINT)
    _, err = run.communicate(timeout=60)
    assert run.returncode == 130, err
    assert "fdi-gym: interrupted" in err
    assert "Traceback" not in err


def test_rows_that_would_be_lost_are_named(capsys, here, small):
    evaluated = ("evaluate", small, "--diagnosers", "null", "--results", "results", "--jobs", "1")
    assert said(capsys, *evaluated)[0] == 0
    path = here / "results" / "small" / "null.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content))
    assert "is not written as rows are" in refused(capsys, *evaluated)
    assert json.loads(path.read_text()) == content


@pytest.mark.parametrize("words", [
    ("evaluate", "b747-standard", "--diagnosers", "null", "--csv"), ("plot", "severity", "b747-standard", "--output"),
    ("report", "b747-standard", "--output"), ("diagnosability", "B747Lateral", "--picture"),
    ("leaderboard", "--results", str(ROOT / "leaderboards" / "results"), "--pages"),
], ids=lambda words: words[0])  # fmt: skip
def test_a_place_that_cannot_be_is_refused_before_anything_is_computed(capsys, monkeypatch, tmp_path, words):
    from fdi_gym import diagnosability, evaluation, leaderboard, pictures, report

    for module, name in ((evaluation, "evaluate"), (pictures, "picture"), (report, "report"), (leaderboard, "boards"),
                         (diagnosability, "diagnosability")):  # fmt: skip
        monkeypatch.setattr(module, name, None)
    (tmp_path / "file").write_text("")
    assert "cannot write" in refused(capsys, *words, str(tmp_path / "file" / "made.png"))
    if words[0] != "leaderboard":
        (tmp_path / "folder.png").mkdir()
        assert "it is a folder" in refused(capsys, *words, str(tmp_path / "folder.png"))


def test_folders_of_what_is_made_are_made(capsys, tmp_path):
    place = tmp_path / "not" / "there" / "severity.svg"
    cli.main(
        ["plot", "severity", "b747-standard", "--output", str(place), "--results", str(ROOT / "leaderboards" / "results")]
    )
    assert place.stat().st_size > 1000
