"""Rows are believed only as far as they can be recomputed; what they are made of is followed to its files."""

import functools
import importlib
import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

import fdi_gym
from fdi_gym import cli, discovery, evaluation, leaderboard, row, suite, tables, verification
from fdi_gym.diagnosis import diagnosers, registry
from fdi_gym.estimation import data
from fdi_gym.evaluation import applicable, digests_of, evaluate, settings_of
from fdi_gym.files import RefusedError, compress, digest, pretty, sweep, write_whole
from fdi_gym.metrics import Decision, Onset, Outcome, Stated
from fdi_gym.provenance import provenance, sources
from fdi_gym.row import check_writable, outcomes_path, outcomes_text, read_outcomes, read_row, row_path, write_rows
from fdi_gym.scores import summarise
from fdi_gym.suite import Suite, freeze, load_suite, suite_names
from fdi_gym.verification import verify

NAMES = ["null", "two_stage_kf_exponential", "known_onset_oracle"]
FILTER = "two_stage_kf_exponential"
QUIET = {"jobs": 1, "progress": False}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with a suite, and rows on it."""
    folder = tmp_path_factory.mktemp("home")
    small = Suite(name="small", description="a test", env="B747Lateral-Faults-v0", plant="B747Lateral",
                  options={"variant": "printed/open", "labels": "single"}, process="standard", mismatch=None,
                  seeds=[*range(300, 308)], settings={})  # fmt: skip
    frozen = load_suite(str(freeze(small, folder)))
    write_rows(folder, frozen, evaluate(frozen, NAMES, work=folder / "work", command="test", **QUIET))
    return folder


@pytest.fixture
def rows(home, tmp_path, monkeypatch):
    """A copy of the rows, beside whose suite others may be frozen."""
    monkeypatch.setattr(suite, "SUITES", home)
    shutil.copytree(home / "small", tmp_path / "results" / "small")
    return tmp_path / "results"


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """A folder for modules of one's own; they are forgotten afterwards."""
    folder = tmp_path / "modules"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = set(sys.modules)
    yield folder
    for name in set(sys.modules) - before:
        if str(folder) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def resealed(content):
    """A forged row with its digest made anew, as anybody can."""
    content = {**content, "sha256": ""}
    return {**content, "sha256": digest({k: v for k, v in content.items() if k != "sha256"})}


def change(path, keys, value, seal=True):
    """Change a field of a row's file."""
    content = json.loads(path.read_text())
    place = content
    for key in keys[:-1]:
        place = place[key]
    assert place.get(keys[-1]) != value if isinstance(place, dict) else place[keys[-1]] != value
    place[keys[-1]] = value
    path.write_bytes(pretty(resealed(content) if seal else content))


def leaves(value, keys=()):
    """The places of all figures and words of a row."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from leaves(part, (*keys, key))
    elif isinstance(value, list) and value:
        for i, part in enumerate(value):
            yield from leaves(part, (*keys, i))
    else:
        yield keys, value


def test_honest_rows_are_verified(rows):
    for name in NAMES:
        assert len(verify(row_path(rows, "small", name), share=0.3).episodes) == 3


def test_no_field_of_a_row_can_be_forged(rows):
    """Whatever is changed, with the row's own digest made anew or not, and whatever is added, is refused."""
    path = row_path(rows, "small", FILTER)
    honest = path.read_bytes()
    places = [(keys, value) for keys, value in leaves(json.loads(honest)) if keys[0] != "sha256"]
    drawn = np.random.default_rng(0).choice(len(places), 25, replace=False)
    named = [i for i, (keys, _) in enumerate(places) if keys[0] not in ("metrics",)]
    assert len(named) >= 9
    for i in {*drawn.tolist(), *named}:
        keys, value = places[i]
        other = {bool: not value, int: 7, float: 0.123, str: "a" * 64}.get(type(value), 0.5)
        for seal in (True, False):
            change(path, keys, other, seal)
            with pytest.raises(ValueError, match=r"\w+"):
                verify(path, share=1.0)
            path.write_bytes(honest)
    for extra in (("note",), ("settings", "note"), ("digests", "note"), ("metrics", "note")):
        change(path, extra, "mine")
        with pytest.raises(RefusedError, match=r"note|unknown field"):
            verify(path)
        path.write_bytes(honest)
    assert verify(path)


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        (("clairvoyant",), False, "unknown field `clairvoyant`"), (("summary",), "the best", "unknown field `summary`"),
        (("schema",), 99, "Invalid enum value 99"), (("suite",), "../suites/x", "the name of a suite"),
        (("suite",), "smal", "did you mean small"), (("diagnoser",), "null", "belongs into null.json"),
        (("diagnoser",), "../x", "the name of a diagnoser"), (("settings", "factor"), 0.5, "settings.factor"),
        (("digests", "plant"), "0" * 64, "digests.plant"), (("metrics", "episodes"), 9, "metrics.episodes"),
        (("suite_sha256",), "0" * 64, "of the suite"),
    ],
    ids=str,
)  # fmt: skip
def test_what_is_wrong_with_a_row_is_said(rows, keys, value, words):
    path = row_path(rows, "small", FILTER)
    change(path, keys, value)
    with pytest.raises(RefusedError if "mean" not in words else ValueError, match=words):
        verify(path)


def test_a_clairvoyant_row_cannot_be_given_to_another(rows):
    """All figures consistent, digests right, but the episodes are not what the diagnoser does."""
    oracle = row_path(rows, "small", "known_onset_oracle")
    path = row_path(rows, "small", FILTER)
    stolen, own = json.loads(oracle.read_text()), json.loads(path.read_text())
    own["metrics"], own["digests"]["outcomes"] = stolen["metrics"], stolen["digests"]["outcomes"]
    path.write_bytes(pretty(resealed(own)))
    shutil.copy(outcomes_path(oracle), outcomes_path(path))
    with pytest.raises(RefusedError, match=r"outcomes\[\d+\]"):
        verify(path, share=0.5)
    assert tables.clairvoyant(read_row(oracle))


def doctored(rows, which):
    """A row whose outcomes of some episodes are made up, with everything else consistent."""
    path, frozen = row_path(rows, "small", FILTER), load_suite("small")
    plant = frozen.build()
    outcomes = read_outcomes(path, read_row(path), plant)
    for i in which:
        right = [(true, true, count) for true, _, count in outcomes[i].confusion]
        outcomes[i] = msgspec.structs.replace(outcomes[i], confusion=right)
    content = json.loads(path.read_text())
    content["digests"]["outcomes"] = row.outcomes_digest(outcomes)
    content["metrics"] = summarise(outcomes, len(plant.labels), [s.name for s in plant.estimated], plant.dt)
    path.write_bytes(pretty(resealed(json.loads(msgspec.json.encode(content)))))
    outcomes_path(path).write_bytes(compress(outcomes_text(outcomes)))
    return path


def test_the_sample_is_the_verifiers(rows, monkeypatch):
    """Made-up episodes are found by the share that was asked for, whatever stands in the row; a seed draws the same."""
    path = doctored(rows, [2])
    with monkeypatch.context() as patched:
        patched.setattr(verification, "check_episodes", lambda *arguments: None)
        drawn = [tuple(verify(path, share=0.25).episodes) for _ in range(40)]
        assert len(set(drawn)) > 10
        assert verify(path, share=0.25, seed=5) == verify(path, share=0.25, seed=5)
        hit = next(seed for seed in range(100) if 2 in verify(path, share=0.25, seed=seed).episodes)
        missed = next(seed for seed in range(100) if 2 not in verify(path, share=0.25, seed=seed).episodes)
    with pytest.raises(RefusedError, match=r"outcomes\[2\]"):
        verify(path, share=0.25, seed=hit)
    assert verify(path, share=0.25, seed=missed)
    with pytest.raises(RefusedError, match=r"outcomes\[2\]"):
        verify(path, share=1.0)


@pytest.mark.parametrize("share", [0, -0.1, 1.5, 2, float("nan")])
def test_shares_and_seeds_out_of_range_are_refused(rows, share):
    with pytest.raises(ValueError, match="share is above 0"):
        verify(row_path(rows, "small", "null"), share=share)
    with pytest.raises(ValueError, match="seed is 0 or more"):
        verify(row_path(rows, "small", "null"), seed=-1)


def test_a_module_that_a_row_names_is_imported_only_if_trusted(rows, modules):
    (modules / "outsider.py").write_text("from baselines.trivial import null as build\n")
    frozen, name = load_suite("small"), "outsider:build"
    write_rows(rows, frozen, evaluate(frozen, [name], work=rows.parent / "work", **QUIET))
    path = row_path(rows, "small", name)
    del sys.modules["outsider"]
    with pytest.raises(RefusedError, match="--trust outsider:build"):
        verify(path)
    assert "outsider" not in sys.modules
    leaderboard.boards(rows)
    assert "outsider" not in sys.modules
    assert verify(path, trust=[name])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[" * 100_000, "is not a row"), (b'{"metrics":' * 50_000, "is not a row"),
        (b'{"settings": {"a": ' + b"[" * 100_000, "nested too deeply"), (b"\xff\xfe{}", "is not a row"),
        (b'{"suite": "\xff"}', "is not a row"), (b'{"metrics": {"a": NaN}}', "is not a row"), (b"", "is not a row"),
        (b" " * (2**20 + 1), "larger than"), (b'{"metrics": {"a": 1e999}}', "is not a row"), (b"null", "is not a row"),
    ],
    ids=["deep", "deep fields", "deep settings", "bytes", "text", "NaN", "empty", "large", "inf", "null"],
)  # fmt: skip
def test_files_that_are_no_rows_are_refused_in_words(rows, content, words):
    path = row_path(rows, "small", "null")
    path.write_bytes(content)
    with pytest.raises(RefusedError, match=words):
        verify(path)


def test_outcomes_that_no_flight_can_have_are_refused(rows):
    frozen = load_suite("small")
    plant, path = frozen.build(), row_path(rows, "small", "null")
    outcomes = read_outcomes(path, read_row(path), plant)
    first = outcomes[0]
    changes = [
        {"decisions": [Decision(99, 0, 0)]}, {"decisions": [Decision(0, 0, 1)]}, {"decisions": [Decision(1, 0, 5)]},
        {"decisions": [Decision(0, 0, None)] * (first.steps + 1)}, {"alarm_steps": first.healthy_steps + 1},
        {"alarmed": [(1, 2), (0, 0)]}, {"alarmed": [(1, 1)]}, {"squared_fault": [1.0]}, {"squared_fault": [-1.0] * 4},
        {"stated": [Stated(1, 2, 0.0)] * 4}, {"stated": [Stated(1, 1, 0.0)]}, {"stated": [Stated(1, 1, -1.0)] * 4},
        {"onsets": [Onset(1, 3, True, True, False, 2, None)]}, {"onsets": [Onset(1, 3, True, False, True, None, 2)]},
        {"confusion": [(0, 7, 3)]}, {"confusion": [(0, 0, 10**6)]}, {"false_alarms": 10**9},
        {"squared_error": [[0.0]]}, {"squared_error": [[-1.0] * 4] * 3}, {"banded": [(1, 2), (0, 0), (0, 0)]},
        {"error_steps": [1]}, {"log_score": 1.0}, {"healthy_steps": first.steps + 1},
    ]  # fmt: skip
    for fields in changes:
        forged = [msgspec.structs.replace(first, **fields), *outcomes[1:]]
        content = json.loads(path.read_text())
        content["digests"]["outcomes"] = row.outcomes_digest(forged)
        path.write_bytes(pretty(resealed(content)))
        outcomes_path(path).write_bytes(compress(outcomes_text(forged)))
        with pytest.raises(RefusedError, match=r"episode 0 has|does not hold outcomes"):
            read_outcomes(path, read_row(path), plant)


def test_compressed_outcomes_are_the_same_bytes_and_refused_when_damaged(rows):
    path = outcomes_path(row_path(rows, "small", "null"))
    whole = path.read_bytes()
    plant = load_suite("small").build()
    for damaged in (whole[:-3], whole + b"x", b"", b"not gzip", compress(b"\0" * (2**26 + 1)), compress(b"{}"), whole[::-1]):
        path.write_bytes(damaged)
        with pytest.raises(RefusedError, match=r"outcomes|Outcome"):
            read_outcomes(row_path(rows, "small", "null"), read_row(row_path(rows, "small", "null")), plant)
    assert compress(b"a" * 1000) == compress(b"a" * 1000)
    assert whole[4:8] == b"\0\0\0\0"  # no time


# -- renewing


def held(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_renewing_writes_the_digests_of_what_is_here_and_nothing_else(rows):
    frozen, name = load_suite("small"), "two_stage_ekf"
    write_rows(rows, frozen, evaluate(frozen, [name], work=rows.parent / "work", **QUIET))
    path, honest = row_path(rows, "small", name), held(rows / "small")
    kinds = set(read_row(path).digests) - {"outcomes"}
    assert kinds == {"method", "plant", "engine", "belief", "calibration"}
    for kind in (*sorted(kinds), "data"):  # one that is no more
        change(path, ("digests", kind), "f" * 64)
        with pytest.raises(RefusedError, match=rf"digests\.{kind}: .*renew it"):
            verify(path)
        assert verify(path, renew=True).renewed == [kind]
        assert held(rows / "small") == honest
        assert verify(path).renewed == []
    before = path.stat().st_mtime_ns
    assert verify(path, renew=True).renewed == []
    assert path.stat().st_mtime_ns == before


def test_a_row_says_the_packages_that_made_it(rows):
    """Another version is refused; a row that was made before rows said so holds, and is told when it is renewed."""
    path, here = row_path(rows, "small", FILTER), f"fdi-gym {fdi_gym.__version__}"
    honest = path.read_bytes()
    assert read_row(path).packages == {"method": here, "plant": here, "engine": here}
    change(path, ("packages", "method"), "fdi-gym 0.0.1")
    with pytest.raises(RefusedError, match=r"packages\.method: .*0\.0\.1.*renew it"):
        verify(path)
    assert verify(path, renew=True).renewed == ["packages"]
    assert path.read_bytes() == honest
    content = json.loads(honest)
    del content["packages"]
    path.write_bytes(pretty(resealed(content)))
    assert read_row(path).packages is msgspec.UNSET
    old = path.read_bytes()
    assert verify(path).renewed == []
    assert path.read_bytes() == old
    assert verify(path, renew=True).renewed == ["packages"]
    assert path.read_bytes() == honest


def test_a_forged_row_is_never_renewed(rows):
    """Whatever else is changed in a row of other sources, it is refused and stays as it is."""
    path = row_path(rows, "small", FILTER)
    change(path, ("digests", "engine"), "f" * 64)
    old = path.read_bytes()
    places = [(keys, value) for keys, value in leaves(json.loads(old)) if keys[0] not in ("sha256", "digests", "packages")]
    named = [i for i, (keys, _) in enumerate(places) if keys[0] != "metrics"]
    assert len(named) >= 5
    for i in {*np.random.default_rng(1).choice(len(places), 25, replace=False).tolist(), *named}:
        keys, value = places[i]
        change(path, keys, {bool: not value, int: 7, float: 0.123, str: "a" * 64}.get(type(value), 0.5))
        forged = path.read_bytes()
        with pytest.raises(ValueError, match=r"\w+"):
            verify(path, share=1.0, renew=True)
        assert path.read_bytes() == forged
        path.write_bytes(old)
    change(path, ("digests", "outcomes"), "f" * 64)
    with pytest.raises(RefusedError, match="the digest differs"):
        verify(path, renew=True)


def test_made_up_outcomes_are_not_renewed(rows):
    path = doctored(rows, range(8))
    change(path, ("digests", "method"), "f" * 64)
    before = held(rows / "small")
    with pytest.raises(RefusedError, match=r"the code no longer gives this row; .*outcomes\[\d\]"):
        verify(path, share=1.0, renew=True)
    assert held(rows / "small") == before


QUIET_METHOD = """
import numpy as np
from fdi_gym.diagnosis import Diagnoser, Diagnosis
def build(plant):
    return Diagnoser(lambda n: (), lambda s, y: (s, Diagnosis(np.full(len(y), True), np.full(len(y), 1))))
"""


def test_an_edited_source_makes_old_the_rows_of_its_method_alone(rows, modules):
    """What changes no outcome is renewed, what does is refused; other methods' rows don't notice."""
    frozen, names = load_suite("small"), ["first_method:build", "second_method:build"]
    files = [modules / f"{name.partition(':')[0]}.py" for name in names]
    for file in files:
        file.write_text(QUIET_METHOD)
    write_rows(rows, frozen, evaluate(frozen, names, work=rows.parent / "work", **QUIET))
    paths = [row_path(rows, "small", name) for name in names]
    honest = [path.read_bytes() for path in paths]

    def edited(text):
        files[0].write_text(text)
        sys.modules.pop("first_method", None)
        importlib.invalidate_caches()
        return [found for _, found in verification.verify_all(paths, trust=names, renew=True)]

    first, second = edited(f"# the same\n{QUIET_METHOD}")
    assert (first.renewed, second.renewed) == (["method"], [])
    renewed = paths[0].read_bytes()
    old, new = json.loads(honest[0]), json.loads(renewed)
    assert {k for k in old if old[k] != new[k]} == {"digests", "sha256"}
    assert {k for k in old["digests"] if old["digests"][k] != new["digests"][k]} == {"method"}
    first, second = edited(QUIET_METHOD.replace("len(y), 1", "len(y), 2"))
    assert isinstance(first, RefusedError)
    assert "the code no longer gives this row" in str(first)
    assert second.renewed == []
    assert [path.read_bytes() for path in paths] == [renewed, honest[1]]


def test_many_rows_are_verified_past_one_that_fails(rows, capsys):
    """A line each, in their order; status 2 at the end; those that are not renewed stay as they are."""
    paths = [row_path(rows, "small", name) for name in NAMES]
    honest = [path.read_bytes() for path in paths]
    change(paths[0], ("metrics", "episodes"), 9)
    change(paths[1], ("digests", "method"), "f" * 64)
    forged = paths[0].read_bytes()
    arguments = ["verify", *map(str, paths), str(rows / "small" / "made.json"), "--jobs", "2",
                 "--suite", str(suite.SUITES / "small.json")]  # fmt: skip

    def said(*more):
        code = 0
        try:
            cli.main([*arguments, *more])
        except SystemExit as stop:
            code = stop.code
        out, err = capsys.readouterr()
        return code, out.splitlines(), [line for line in err.splitlines() if "refused" in line]

    code, out, err = said()
    assert (code, len(out), len(err)) == (2, 1, 3)
    assert out[0].startswith(f"{paths[2]}: every figure follows")
    assert err[0].startswith(f"{paths[0]}: refused: small/null: metrics.episodes")
    assert err[1].startswith(f"{paths[1]}: refused: small/{FILTER}: digests.method")
    assert err[2] == f"fdi-gym: 2 of 3 rows are refused, 0 renewed: {paths[0]}, {paths[1]}"
    code, out, err = said("--renew")
    assert (code, len(out), len(err)) == (2, 2, 2)
    assert out[0].endswith("digests made anew: method")
    assert err[1] == f"fdi-gym: 1 of 3 rows are refused, 1 renewed: {paths[0]}"
    assert [path.read_bytes() for path in paths] == [forged, *honest[1:]]
    paths[0].write_bytes(honest[0])
    code, out, err = said("--renew")
    assert (code, out[-1], err) == (0, "3 rows hold, 0 of them renewed", [])


# -- writing loses nothing


def test_rows_of_something_else_are_not_overwritten(rows):
    frozen = load_suite("small")
    asked = [frozen, ["null"], functools.partial(digests_of, frozen, frozen.build())]
    check_writable(rows, *asked)
    path = row_path(rows, "small", "null")
    for keys, words in ((("digests", "method"), "another method"), (("suite_sha256",), "another version of small")):
        honest = path.read_bytes()
        change(path, keys, "f" * 64)
        with pytest.raises(ValueError, match=words):
            check_writable(rows, *asked)
        path.write_bytes(honest)
    change(path, ("digests", "method"), "f" * 64)
    check_writable(rows, *asked, replace=True)
    for file in (path, rows / "small" / "made.json"):
        file.write_text("mine")
        with pytest.raises(RefusedError, match="is not a"):
            check_writable(rows, *asked, replace=True)
        assert file.read_text() == "mine"
        shutil.copy(suite.SUITES / "small" / file.name, file)


def test_how_other_rows_were_made_is_kept(rows):
    frozen = load_suite("small")
    write_rows(rows, frozen, evaluate(frozen, ["random"], work=rows.parent / "work", command="mine", **QUIET))
    made = row.read_made(rows / "small")
    assert set(made) == {*NAMES, "random"}
    assert (made["random"].command, made["null"].command) == ("mine random", "test null")


def test_a_file_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_whole(path, b"before")

    def full(self, content):
        with self.open("wb") as file:
            file.write(content[:3])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"cannot write .*a\.json: No space left"):
        write_whole(path, b"after")
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
    assert path.read_bytes() == b"before"


def test_what_killed_processes_left_is_swept_and_nothing_else(tmp_path):
    host = socket.gethostname().replace(".", "-")
    dead = tmp_path / f".a.json.{host}.4194400.part"
    alive = tmp_path / f".a.json.{host}.{os.getpid()}.part"
    elsewhere = tmp_path / ".a.json.another-host.4194400.part"
    for path in (dead, alive, elsewhere):
        path.write_bytes(b"")
    sweep(tmp_path)
    assert set(tmp_path.iterdir()) == {alive, elsewhere}


# -- what a row was made of


def files(work):
    return set(Path(work).rglob("block-*.json"))


DAMAGE = {
    "truncated": lambda b: b[: len(b) // 2], "empty": lambda b: b"", "garbage": lambda b: bytes(reversed(b)),
    "edited": lambda b: b.replace(b'"false_alarms":', b'"false_alarms":1'), "nested": lambda b: b"[" * 10**6,
    "another's": lambda b: b.replace(b'"identity":"', b'"identity":"0'), "not text": lambda b: b"\xff" + b,
}  # fmt: skip


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_block_is_made_again(rows, how):
    frozen = load_suite("small").head(2)
    whole = evaluate(frozen, ["random"], work=rows.parent / "work", block=1, **QUIET)
    first = min(files(rows.parent / "work"))
    before = first.read_bytes()
    first.write_bytes(DAMAGE[how](before))
    assert first.read_bytes() != before
    again = evaluate(frozen, ["random"], work=rows.parent / "work", block=1, **QUIET)
    assert again["random"][:2] == whole["random"][:2]
    held = (msgspec.json.decode(content, type=evaluation.Block) for content in (before, first.read_bytes()))
    assert next(held).outcomes == next(held).outcomes


def test_forged_blocks_with_a_right_digest_of_another_making_are_not_taken(rows):
    frozen = load_suite("small").head(1)
    evaluate(frozen, ["random", "null"], work=rows.parent / "work", **QUIET)
    null, random = sorted(files(rows.parent / "work"))
    null.write_bytes(random.read_bytes())
    again = evaluate(frozen, ["random", "null"], work=rows.parent / "work", **QUIET)
    assert again["null"].row.metrics["per_sample"] != again["random"].row.metrics["per_sample"]


METHOD = """
from pathlib import Path
import numpy as np
from fdi_gym.diagnosis import Diagnoser, Diagnosis
from helper import LABEL
{top}
def build(plant):
    {read}
    return Diagnoser(lambda n: (), lambda s, y: (s, Diagnosis(np.full(len(y), True), np.full(len(y), LABEL + value))))
"""
READ = "int((Path(__file__).parent / 'value.txt').read_text())"
PLACES = {
    "when built": {"top": "", "read": f"value = {READ}"},
    "when imported": {"top": f"value = {READ}", "read": "pass"},
    "once, kept": {
        "top": f"import functools\n@functools.cache\ndef kept():\n    return {READ}\n", "read": "value = kept()"
    },
}  # fmt: skip


@pytest.mark.parametrize("where", PLACES)
@pytest.mark.parametrize("edited", ["value.txt", "helper.py", "method.py"])
def test_edited_methods_helpers_and_data_give_new_rows(rows, modules, where, edited):
    frozen = load_suite("small").head(2)
    (modules / "helper.py").write_text("LABEL = 1\n")
    (modules / "value.txt").write_text("0")
    (modules / "method.py").write_text(METHOD.format(**PLACES[where]))

    def made():
        for name in ("method", "helper"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        return evaluate(frozen, ["method:build"], work=rows.parent / "work", **QUIET)["method:build"]

    first = made()
    assert made().row == first.row
    path = modules / edited
    path.write_text(
        {"value.txt": "1", "helper.py": "LABEL = 2\n"}.get(
            edited, path.read_text().replace("LABEL + value", "1 + LABEL + value")
        )
    )
    second = made()
    changed = {k for k in first.row.digests if first.row.digests[k] != second.row.digests[k]}
    assert changed == {"outcomes", "data" if edited == "value.txt" else "method"}
    assert {d for o in first.outcomes for _, d, _ in o.confusion} == {1}
    assert {d for o in second.outcomes for _, d, _ in o.confusion} == {2}


PLANT = """
import dataclasses
import fdi_gym
from fdi_gym.plants import b747_lateral
ID, NOISE = "Outside747", 1.0
def plant():
    inner = b747_lateral.plant()
    own = inner.processes["standard"]
    process = dataclasses.replace(own, sample=lambda rng: own.sample(rng).replace(plant=ID))
    outputs = tuple(s._replace(sigma=s.sigma * NOISE) for s in inner.outputs)
    return dataclasses.replace(inner, id=ID, options={}, outputs=outputs, processes={"standard": process})
fdi_gym.register_plant(ID, "outside_plant:plant")
"""


def test_an_edited_plant_outside_the_package_gives_new_rows(rows, modules, monkeypatch):
    monkeypatch.setattr(discovery, "_registered", {})
    file = modules / "outside_plant.py"

    def made(text):
        file.write_text(text)
        sys.modules.pop("outside_plant", None)
        importlib.invalidate_caches()
        frozen = Suite(name="outside", description="", env="outside_plant:Outside747-Faults-v0", plant="Outside747",
                       options={}, process="standard", mismatch=None, seeds=[*range(2)], settings={})  # fmt: skip
        return evaluate(frozen.sealed(), ["two_stage_kf"], work=rows.parent / "work", **QUIET)["two_stage_kf"].row

    first = made(PLANT)
    assert made(PLANT) == first
    second = made(PLANT.replace('NOISE = "Outside747", 1.0', 'NOISE = "Outside747", 3.0'))
    assert {k for k in first.digests if first.digests[k] != second.digests[k]} == {"outcomes", "plant"}


def test_replaced_weights_give_new_rows(rows, tmp_path):
    weights = pytest.importorskip("baselines.learned.weights")
    plant = load_suite("small").build()
    own = tmp_path / "own.safetensors"
    source = weights.WEIGHTS / "ppo-B747Lateral.safetensors"
    tensors, card = weights.read_tensors(source), weights.read_card(source)
    found = []
    for scale in (1.0, 1.0, 1.01):
        weights.write(own, {name: value * np.float32(scale) for name, value in tensors.items()}, card)
        found.append(provenance("ppo", plant, "standard", {"path": str(own)}))
    assert found[0] == found[1]
    assert {k for k in found[0] if found[0][k] != found[2][k]} == {"data"}
    assert provenance("ppo", plant, "standard", {})["data"] != found[0]["data"]


def test_sources_follow_imports_inside_functions_and_by_name():
    found = sources(["baselines.learned.sequence_net"])
    assert {"baselines.learned.weights", "baselines.learned._supervised", "fdi_gym.diagnosis", "fdi_gym.plant"} <= set(found)
    assert not any(name.split(".")[0] in ("numpy", "torch", "msgspec") for name in found)
    assert "baselines.filters.two_stage_kf" in found  # it may be shown any filter that it finds by name
    other = sources(["baselines.filters.two_stage_kf"])
    assert any(name.startswith("fdi_gym.estimation.") for name in other)
    assert not {"baselines.filters.mekf", "fdi_gym.leaderboard", "fdi_gym.cli"} & set(other)


def test_every_method_on_every_suite_has_settings_that_json_can_say():
    for name in suite_names():
        frozen = load_suite(name)
        plant = frozen.build()
        for method in diagnosers():
            settings = settings_of(frozen, plant, method)
            assert json.loads(json.dumps(settings, allow_nan=False)) == settings


def test_settings_in_a_row_are_what_the_builder_got(monkeypatch):
    frozen = load_suite("huav-standard")
    got = {}
    entry = diagnosers()["three_stage_cdkf"]

    @functools.wraps(entry.build)
    def build(plant, **settings):
        got.update(settings)
        return entry.build(plant, **settings)

    monkeypatch.setitem(registry._entries["diagnoser"], "three_stage_cdkf", entry._replace(build=build))
    plant = frozen.build()
    applicable(frozen, plant, ["three_stage_cdkf"])
    knowledge = {name: data.digest(got.pop(name)) for name in ("belief", "calibration")}
    assert got
    assert json.loads(json.dumps(got)) == settings_of(frozen, plant, "three_stage_cdkf")
    assert knowledge.items() <= digests_of(frozen, plant, "three_stage_cdkf").items()


@pytest.mark.parametrize("name", ["three_stage_cdkf", "sequence_net"])
def test_digests_do_not_depend_on_what_was_loaded_before(name):
    code = (
        "import sys, json; from fdi_gym.diagnosis import make_diagnoser; from fdi_gym.evaluation import digests_of; "
        "from fdi_gym.suite import load_suite; frozen = load_suite('huav-standard'); plant = frozen.build(); "
        "first = sys.argv[1:] and make_diagnoser(sys.argv[1], plant, process='standard'); "
        f"print(json.dumps(digests_of(frozen, plant, {name!r})))"
    )
    found = [
        json.loads(subprocess.run([sys.executable, "-c", code, *first], capture_output=True, text=True, check=True).stdout)
        for first in ([], ["augmented_ekf"] if name == "sequence_net" else [name])
    ]
    assert found[0] == found[1]


# -- what is committed


def committed():
    results = Path(__file__).parent.parent / "leaderboards" / "results"
    return [path for folder in sorted(results.glob("*/")) for path in row.row_files(folder)]


def test_committed_rows_are_small():
    for path in committed():
        large = path.parent.name == "cmg-mixed"  # two confusion matrices of 26 labels
        assert path.stat().st_size < (30_000 if large else 20_000)
        assert outcomes_path(path).stat().st_size < 400_000


@pytest.mark.slow
@pytest.mark.parametrize("path", committed(), ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_committed_rows_give_the_same_outcomes(path):
    """Sources may have been edited since, so the digests of what made a row are not asked for; its outcomes are."""
    found, frozen = read_row(path), load_suite(path.parent.name)
    plant = frozen.build()
    outcomes: list[Outcome] = read_outcomes(path, found, plant)
    verification.check_row(found, outcomes, frozen, plant)
    drawn = np.random.default_rng(0).choice(frozen.episodes, max(1, frozen.episodes // 10), replace=False)
    verification.check_episodes(found, outcomes, frozen, plant, sorted(drawn.tolist()))
