"""Fuzz: whatever stands in a file or is typed, the answer is a result or a ValueError, TypeError or OSError in words.

Mutations are drawn from seeds: JSON field by field, files byte by byte, command lines from a grammar. CI takes 700 calls,
the slow suite 30,000.
"""

import contextlib
import io
import json
import os
import shutil
import sys

import numpy as np
import pytest
from conftest import ROOT, build

from fdi_gym import cli, suite
from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.evaluation import Block, evaluate, read_block
from fdi_gym.files import digest, pretty
from fdi_gym.row import outcomes_path, read_outcomes, read_row, row_path, write_rows
from fdi_gym.suite import Suite, freeze, load_suite
from fdi_gym.verification import check_row

FEW, MANY = {"suites": 120, "rows": 120, "blocks": 120, "weights": 120, "commands": 220}, 6000
WORDS = [
    "",
    "x",
    "../x",
    "a" * 300,
    "null",
    "B747Lateral",
    "two_stage_kf",
    "os:system",
    "standard",
    "\x00",
    "é|`<b>\n",
    ":",
    "1",
]
NUMBERS = [0, -1, 1, 2**31, 2**63, 2**64, 10**30, 0.5, -0.0, 1e308, 5e-324, True, False]


def odd(rng):
    """A value that does not belong anywhere."""
    kind = rng.integers(6)
    if kind == 0:
        return WORDS[rng.integers(len(WORDS))]
    if kind == 1:
        return NUMBERS[rng.integers(len(NUMBERS))]
    return [None, [], {}, [[[]]]][rng.integers(4)]


def mutated(rng, value):
    """JSON data with one place changed: another value, one more or less, a key renamed or added."""
    if isinstance(value, dict) and value and rng.random() < 0.8:
        key = list(value)[rng.integers(len(value))]
        match rng.integers(6):
            case 0:
                return {k: v for k, v in value.items() if k != key}
            case 1:
                return {(k + "x" if k == key else k): v for k, v in value.items()}
            case 2:
                return {**value, WORDS[rng.integers(len(WORDS))]: odd(rng)}
            case _:
                return {**value, key: mutated(rng, value[key])}
    if isinstance(value, list) and value and rng.random() < 0.8:
        i = int(rng.integers(len(value)))
        match rng.integers(4):
            case 0:
                return value[:i] + value[i + 1 :]
            case 1:
                return [*value, value[i]]
            case _:
                return [*value[:i], mutated(rng, value[i]), *value[i + 1 :]]
    if isinstance(value, (int, float)) and rng.random() < 0.3:
        return value + [1, -1, 1e-3][rng.integers(3)]
    return odd(rng)


def damaged(rng, content):
    """A file with bytes changed, cut out, put in, repeated, or nested without end."""
    i = int(rng.integers(len(content) + 1))
    j = min(len(content), i + int(rng.integers(1, 40)))
    match rng.integers(7):
        case 0:
            return content[:i]
        case 1:
            return content[:i] + bytes(rng.integers(0, 256, j - i, dtype=np.uint8)) + content[j:]
        case 2:
            return content[:i] + content[j:]
        case 3:
            return content[:j] + content[i:]
        case 4:
            return content[:i] + b"[" * 20_000 + content[i:]
        case 5:
            return content[:i] + [b"NaN", b"1e999", b"-", b"\xff", b"\\ud800", b"\0"][rng.integers(6)] + content[i:]
        case _:
            return b"" if rng.random() < 0.2 else content[i:]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with a suite, rows on it and blocks."""
    folder = tmp_path_factory.mktemp("home")
    small = Suite(name="small", description="a test", env="B747Lateral-Faults-v0", plant="B747Lateral",
                  options={"variant": "printed/open", "labels": "single"}, process="standard", mismatch=None,
                  seeds=[*range(300, 302)], settings={"two_stage_kf": {"threshold": 9.0}})  # fmt: skip
    frozen = load_suite(str(freeze(small, folder)))
    names = ["null", "random", "two_stage_kf"]
    write_rows(folder, frozen, evaluate(frozen, names, work=folder / "work", jobs=1, progress=False))
    return folder


@pytest.fixture
def counted(request):
    """How many calls a test makes."""
    return lambda kind: MANY if "slow" in request.keywords else FEW[kind]


def both(function):
    """The test as CI runs it, and as the slow suite does."""
    return pytest.mark.parametrize("size", ["few", pytest.param("many", marks=pytest.mark.slow)])(function)


def answered(function):
    """Whether a call gives a result; an error other than the documented ones fails the test."""
    try:
        function()
    except (ValueError, TypeError, OSError):
        return False
    return True


def sealed(value):
    """With the digest made anew, so that what lies behind that door is reached."""
    if not isinstance(value, dict) or "sha256" not in value:
        return value
    return {**value, "sha256": digest({k: v for k, v in value.items() if k != "sha256"})}


@both
def test_suite_files(home, tmp_path, size, counted):
    honest = (home / "small.json").read_bytes()
    path, passed = tmp_path / "small.json", 0

    def use():
        found = load_suite(str(path))
        plant = found.build()
        found.scenarios(plant, range(min(found.episodes, 2)))

    for seed in range(counted("suites")):
        rng = np.random.default_rng([1, seed])
        value = json.loads(honest)
        value = sealed(mutated(rng, value)) if seed % 2 else None
        path.write_bytes(damaged(rng, honest) if value is None else pretty(value))
        passed += answered(use)
    assert passed < counted("suites") / 2
    path.write_bytes(honest)
    assert answered(use)


@both
def test_row_files(home, tmp_path, size, counted):
    frozen = load_suite(str(home / "small.json"))
    plant = frozen.build()
    path = row_path(tmp_path, "small", "two_stage_kf")
    shutil.copytree(home / "small", tmp_path / "small")
    row, outcomes = path.read_bytes(), outcomes_path(path).read_bytes()

    def use():
        found = read_row(path)
        check_row(found, read_outcomes(path, found, plant), frozen, plant)

    for seed in range(counted("rows")):
        rng = np.random.default_rng([2, seed])
        path.write_bytes(row)
        outcomes_path(path).write_bytes(outcomes)
        match seed % 3:
            case 0:
                path.write_bytes(damaged(rng, row))
            case 1:
                path.write_bytes(pretty(sealed(mutated(rng, json.loads(row)))))
            case _:
                outcomes_path(path).write_bytes(damaged(rng, outcomes))
        if answered(use):  # settings and digests are compared when a row is verified
            said, found = json.loads(row), json.loads(path.read_bytes())
            assert {k for k in said if said[k] != found.get(k)} <= {"settings", "digests", "packages", "sha256"}
    path.write_bytes(row)
    outcomes_path(path).write_bytes(outcomes)
    assert answered(use)


@both
def test_block_files(home, tmp_path, size, counted):
    """A block that is not the one that was written is none."""
    honest = next(home.rglob("two_stage_kf-*/block-*.json")).read_bytes()
    identity = json.loads(honest)["identity"]
    path = tmp_path / "block.json"
    for seed in range(counted("blocks")):
        rng = np.random.default_rng([3, seed])
        path.write_bytes(damaged(rng, honest) if seed % 2 else pretty(mutated(rng, json.loads(honest))))
        found = read_block(path, identity)
        assert found is None or isinstance(found, Block)
        if found is not None:
            assert found.content_sha256() == json.loads(honest)["sha256"]
    path.write_bytes(honest)
    assert read_block(path, identity) is not None


@both
@pytest.mark.parametrize("method", ["ppo", "sequence_net"])
def test_weights_and_cards(tmp_path, size, counted, method):
    weights = pytest.importorskip("baselines.learned.weights")
    plant = build("B747Lateral")
    source = weights.WEIGHTS / f"{method}-B747Lateral.safetensors"
    tensors, card = source.read_bytes(), source.with_suffix(".json").read_bytes()
    path = tmp_path / source.name
    obs = np.zeros((1, len(plant.observed)))

    def use():
        diagnoser = make_diagnoser(method, plant, path=str(path))
        diagnoser.update(diagnoser.init(1), obs)

    for seed in range(counted("weights") // 2):
        rng = np.random.default_rng([4, seed])
        path.write_bytes(tensors)
        path.with_suffix(".json").write_bytes(card)
        match seed % 3:
            case 0:
                path.with_suffix(".json").write_bytes(damaged(rng, card))
            case 1:
                path.with_suffix(".json").write_bytes(pretty(mutated(rng, json.loads(card))))
            case _:  # in the header mostly, with a card that belongs to it
                head = 8 + int.from_bytes(tensors[:8], "little")
                cut = damaged(rng, tensors[:head]) + tensors[head:] if rng.random() < 0.7 else damaged(rng, tensors)
                path.write_bytes(cut)
                value = json.loads(card)
                value["sha256"] = weights.hashlib.sha256(cut).hexdigest()
                path.with_suffix(".json").write_bytes(pretty(value))
        answered(use)
    path.write_bytes(tensors)
    path.with_suffix(".json").write_bytes(card)
    assert answered(use)


# -- the command line


OPTIONS = {
    "evaluate": ["--diagnosers", "--results", "--work", "--jobs", "--confusion", "--replace"],
    "verify": ["--share", "--seed", "--suite", "--trust"],
    "leaderboard": ["--results", "--page"],
    "list": [],
    "freeze": [
        "--plant",
        "--process",
        "--description",
        "--episodes",
        "--first-seed",
        "--options",
        "--mismatch",
        "--settings",
    ],
    "train": ["--seed", "--work", "--threads", "--output"],
}
ARGUMENTS = [
    *WORDS, "windowed_nis", "mekf", "random", "small", "small", "small.json", "results", "made.json", "b747-standard",
    "results/small/null.json", "results/small/two_stage_kf.json", "B747Lateral-Faults-v0", "HUAVHover", "hard",
    "sequence_net", "0", "-1", "2", "1e3", "nan", "inf", "0.5", "{}", '{"null": {}}', "[", "best", "none",
    "baselines.trivial:null", "json:dumps", "no.such:thing", "a:b:c", "--", "-", "--help", "--version", "kappa", "~", ".",
]  # fmt: skip
POSITIONAL = {"evaluate": 1, "verify": 1, "leaderboard": 0, "list": 1, "freeze": 1, "train": 2}
PLACES = ["out", "results", "deep/er", "small.json", "", "\x00", "a" * 300, "/dev/zero"]  # where something is to be written
WRITING = ("--results", "--work", "--page", "--output")


def command_line(rng):
    """A call: a command (or something else), positional words, options with what may or may not belong to them."""
    commands = list(OPTIONS)
    command = commands[rng.integers(len(commands))]
    pick = lambda: ARGUMENTS[rng.integers(len(ARGUMENTS))]  # noqa: E731
    count = POSITIONAL[command] if rng.random() < 0.8 else int(rng.integers(4))
    argv = [command if rng.random() < 0.97 else pick(), *(pick() for _ in range(count))]
    if command == "train":  # with nothing to train, however the rest turns out
        argv += ["--budget", ["0", "-1", "0", "nan"][rng.integers(4)]]
    if command == "evaluate":
        argv[1:2] = ["small" if rng.random() < 0.5 else pick()]
        argv += ["--diagnosers", ["null", "nul", "random", pick()][rng.integers(4)]]
        argv += ["--jobs", ["1", "1", "0", "x"][rng.integers(4)]]
    if command == "freeze" and rng.random() < 0.7:
        argv[1:] = [pick(), "--plant", "B747Lateral", "--process", "standard", "--description", pick(), "--episodes", "2"]
    for _ in range(int(rng.choice(3, p=[0.5, 0.35, 0.15]))):
        option = [*OPTIONS[command], "--x"][rng.integers(len(OPTIONS[command]) + 1)]
        argv += [option, PLACES[rng.integers(len(PLACES))]] if option in WRITING else [option, pick()]
    return argv


@both
def test_command_lines(home, tmp_path, monkeypatch, size, counted):
    here = tmp_path / "here"
    shutil.copytree(home / "small", here / "results" / "small")
    shutil.copy(home / "small.json", here)
    (here / "suites").mkdir()
    shutil.copy(home / "small.json", here / "suites")
    monkeypatch.setattr(suite, "SUITES", here / "suites")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(here)
    committed = {path: path.stat().st_mtime_ns for path in (ROOT / "leaderboards").rglob("*")}
    ends: dict[int, int] = {}
    for seed in range(counted("commands")):
        rng = np.random.default_rng([5, seed])
        argv, code = command_line(rng), 0
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                cli.main(argv)
            except SystemExit as stop:
                code = stop.code or 0
        ends[code] = ends.get(code, 0) + 1
        assert code in (0, 2), (argv, code, err.getvalue())
        assert code == 0 or err.getvalue().strip(), argv
        assert "Traceback" not in err.getvalue(), (argv, err.getvalue())
    assert ends[0] > 0 < ends[2]
    assert list(tmp_path.iterdir()) == [here]  # no name led out of the folder
    assert {p: p.stat().st_mtime_ns for p in (ROOT / "leaderboards").rglob("*")} == committed
    assert not [path for path in here.rglob("*") if path.name.startswith(".") and os.path.isfile(path)]
