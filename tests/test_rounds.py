"""Sealed rounds: the digest binds, nothing is run that is not trusted, and what was fitted to the public flights shows."""

import hashlib
import json
import os
import sys

import msgspec
import numpy as np
import pytest
from test_cli import refused

from fdi_gym import cli, rounds
from fdi_gym.design import truths
from fdi_gym.evaluation import evaluate
from fdi_gym.files import RefusedError, pretty
from fdi_gym.row import read_row, row_path, write_rows
from fdi_gym.suite import Suite, freeze, load_suite
from fdi_gym.verification import verify

MEMORY = """
import json
from pathlib import Path
import numpy as np
from fdi_gym.diagnosis import Diagnoser, Diagnosis

def build(plant):
    '''It knows the labels of the public flights by what their first sample shows.'''
    known = json.loads((Path(__file__).parent / "memory.json").read_text())
    def init(n):
        return 0, [[]] * n
    def update(state, obs):
        k, labels = state
        labels = [known.get(one.tobytes().hex(), []) for one in obs] if k == 0 else labels
        said = np.array([mine[k] if k < len(mine) else 0 for mine in labels])
        return (k + 1, labels), Diagnosis(said > 0, said)
    return Diagnoser(init, update)

def honest(plant):
    '''It looks at the current alone.'''
    def update(state, obs):
        said = (np.abs(obs[:, 0]) > 3.0) * 1
        return state, Diagnosis(said > 0, said)
    return Diagnoser(lambda n: 0, update)

def broken(plant):
    '''It runs on the public flights only.'''
    known = json.loads((Path(__file__).parent / "memory.json").read_text())
    def update(state, obs):
        if state == "lost":
            raise RuntimeError("what is this?")
        if state == "new":
            state = "at home" if all(one.tobytes().hex() in known for one in obs) else "lost"
        return state, Diagnosis(np.zeros(len(obs), bool), np.zeros(len(obs), int))
    return Diagnoser(lambda n: "new", update)
"""
MEMORISER, HONEST, BROKEN = "memoriser:build", "memoriser:honest", "memoriser:broken"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A public suite, a round beside it, and rows of three methods, one of which was told the public flights' labels."""
    folder = tmp_path_factory.mktemp("home")
    public = Suite(name="open", description="a test", env="dc_motor:DCMotor-Faults-v0", plant="DCMotor", options={},
                   process="standard", mismatch=None, seeds=list(range(1_000_000, 1_000_024)), settings={})  # fmt: skip
    suite = load_suite(str(freeze(public, folder)))
    record = suite.record(suite.build(), range(24))
    memory = {obs[0].tobytes().hex(): label.tolist() for obs, label in zip(record.obs, record.label, strict=True)}
    (folder / "memory.json").write_text(json.dumps(memory))
    (folder / "memoriser.py").write_text(MEMORY)
    sys.path.insert(0, str(folder))
    names = [MEMORISER, HONEST, "null"]
    write_rows(folder / "results", suite, evaluate(suite, names, work=folder / "work", jobs=1, progress=False))
    with pytest.MonkeyPatch.context() as patch:  # the same flights each time: of 24 others one interval in twenty errs
        patch.setattr(rounds.secrets, "randbelow", lambda below: below // 3)
        rounds.seal("first", suite, folder, episodes=24)
    yield folder
    sys.path.remove(str(folder))


def revealed(home, **arguments):
    arguments = {"suite": str(home / "open.json"), "trust": [MEMORISER, HONEST], "jobs": 1, "progress": False, **arguments}
    return rounds.reveal(home / "first.sealed.json", home / "first.secret.json", home / "results", work=home / "work",
                         **arguments)  # fmt: skip


def test_a_method_that_knows_the_public_flights_loses_on_others(home):
    found = revealed(home)
    assert not found.refused
    lost = rounds.losses(found.methods, "per_sample")
    rows = {pair.public.diagnoser: pair for pair in found.methods}
    for name in (MEMORISER, HONEST, "null"):
        public, sealed = (row.metrics["per_sample"] for row in rows[name])
        assert (lost[name].low <= 0 <= lost[name].high) == (name != MEMORISER)
        assert lost[name].real == (name == MEMORISER)
        assert lost[name].value == pytest.approx(public["balanced_accuracy"] - sealed["balanced_accuracy"])
    assert rows[MEMORISER].public.metrics["per_sample"]["balanced_accuracy"] == 1.0
    marked = [line for line in found.page.splitlines() if line.rstrip(" |").endswith("!")]
    assert len(marked) == 3  # per sample, per decision, detection
    assert all("memoriser:build" in line for line in marked)


def test_after_the_round_its_flights_are_a_suite_and_its_rows_are_verified(home):
    found = revealed(home)
    assert found.page == (home / "first.md").read_text()
    for pair in found.methods:
        path = row_path(home / "results", "first", pair.sealed.diagnoser)
        assert read_row(path) == pair.sealed
        verify(path, suite=str(found.suite), trust=[MEMORISER, HONEST])
    published = hashlib.sha256((home / "first.revealed.json").read_bytes()).hexdigest()
    assert published == rounds.read_sealed(home / "first.sealed.json").commitment
    drawn, public = load_suite(str(found.suite)), load_suite(str(home / "open.json"))
    assert not {*drawn.seeds, *drawn.healthy} & {*public.seeds}
    assert min(drawn.seeds) > 2**40  # nobody trains there


def test_what_is_published_tells_nothing_and_no_round_is_drawn_twice(home, tmp_path):
    said = (home / "first.sealed.json").read_text()
    secret = json.loads((home / "first.secret.json").read_text())
    assert str(secret["suite"]["seeds"][0]) not in said
    assert os.stat(home / "first.secret.json").st_mode & 0o077 == 0
    public = load_suite(str(home / "open.json"))
    with pytest.raises(ValueError, match="sealed once"):
        rounds.seal("first", public, home)
    firsts = set()
    for name in ("a", "b"):
        rounds.seal(name, public, tmp_path, episodes=1)
        firsts.add(tuple(json.loads((tmp_path / f"{name}.secret.json").read_text())["suite"]["seeds"]))
    assert len(firsts) == 2


def test_sealed_flights_hold_enough_of_every_label(home, tmp_path):
    public = load_suite(str(home / "open.json"))
    rounds.seal("enough", public, tmp_path, decisions=3)
    suite = msgspec.json.decode((tmp_path / "enough.secret.json").read_bytes(), type=rounds.Secret).suite
    plant = suite.build()
    held = np.bincount([v for s in suite.scenarios(plant, range(suite.episodes)) for v in truths(plant, suite.process, s)])
    assert (held >= 3).all()
    assert len(held) == len(plant.labels)


def resealed(home, tmp_path, change):
    """A round whose secret is bound, but holds another suite than a round may."""
    secret = msgspec.json.decode((home / "first.secret.json").read_bytes(), type=rounds.Secret)
    content = pretty(msgspec.structs.replace(secret, suite=change(secret.suite)))
    (tmp_path / "first.secret.json").write_bytes(content)
    said = json.loads((home / "first.sealed.json").read_text())
    (tmp_path / "first.sealed.json").write_text(json.dumps({**said, "commitment": hashlib.sha256(content).hexdigest()}))
    return tmp_path / "first.sealed.json", tmp_path / "first.secret.json"


def edited(suite, **changes):
    suite = msgspec.structs.replace(suite, **changes)
    return msgspec.structs.replace(suite, sha256=suite.content_sha256())


@pytest.mark.parametrize(("change", "words"), [
    (lambda s: edited(s, process="fault-free"), "differ from those of open in process"),
    (lambda s: edited(s, env="evil:DCMotor-Faults-v0"), "differ from those of open in env"),
    (lambda s: edited(s, settings={"null": {}}), "in settings"), (lambda s: edited(s, name="second"), "holds second"),
    (lambda s: msgspec.structs.replace(s, steps=9), "not the round first as it was sealed"),
    (lambda s: edited(s, scenarios_sha256="0" * 64), "draws other scenarios"),
])  # fmt: skip
def test_a_round_is_of_the_public_flights_but_for_their_seeds(home, tmp_path, change, words):
    published, secret = resealed(home, tmp_path, change)
    with pytest.raises(ValueError, match=words):
        rounds.reveal(published, secret, home / "results", suite=str(home / "open.json"), progress=False)


def test_another_secret_is_refused(home, tmp_path):
    content = (home / "first.secret.json").read_text()
    for other in (content.replace("a", "b"), content + " ", "", "[" * 100_000):
        (tmp_path / "other.json").write_text(other)
        with pytest.raises(RefusedError, match="is not the secret of first"):
            rounds.reveal(
                home / "first.sealed.json", tmp_path / "other.json", home / "results", suite=str(home / "open.json")
            )
    for text, words in (("{}", "is not a sealed round"), ("[" * 100_000, "is not a sealed round")):
        (tmp_path / "x.sealed.json").write_text(text)
        with pytest.raises(RefusedError, match=words):
            rounds.reveal(tmp_path / "x.sealed.json", home / "first.secret.json", home / "results")
    (tmp_path / "x.sealed.json").write_bytes((home / "first.sealed.json").read_bytes())
    with pytest.raises(RefusedError, match=r"belongs into first\.sealed\.json"):
        rounds.read_sealed(tmp_path / "x.sealed.json")


def test_what_is_not_trusted_is_not_imported_and_the_others_are_run(home, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "memoriser", raising=False)
    found = revealed(home, trust=[])
    assert "memoriser" not in sys.modules
    assert [pair.public.diagnoser for pair in found.methods] == ["null"]
    assert all("--trust memoriser" in reason for reason in found.refused.values())
    assert len(found.refused) == 2


def test_a_method_that_is_another_one_now_or_fails_is_named_and_the_others_are_run(home, tmp_path, monkeypatch):
    suite = load_suite(str(home / "open.json"))
    results = tmp_path / "results"
    names = [BROKEN, HONEST, "null"]
    write_rows(results, suite, evaluate(suite, names, work=tmp_path / "work", jobs=1, progress=False))
    path = row_path(results, "open", HONEST)
    content = json.loads(path.read_text())
    content["digests"]["method"], content["sha256"] = "f" * 64, ""
    path.write_bytes(pretty(msgspec.convert(content, type(read_row(row_path(results, "open", "null")))).sealed()))
    published = tmp_path / "first.sealed.json"
    published.write_bytes((home / "first.sealed.json").read_bytes())
    found = rounds.reveal(published, home / "first.secret.json", results, suite=str(home / "open.json"), jobs=1,
                          trust=names, work=tmp_path / "work", progress=False)  # fmt: skip
    assert [pair.public.diagnoser for pair in found.methods] == ["null"]
    reasons = {path.stem: reason for path, reason in found.refused.items()}
    assert "digests.method" in reasons["memoriser.honest"]
    assert "what is this?" in reasons["memoriser.broken"]


def test_a_round_on_the_command_line(home, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cli.main(["seal", "second", str(home / "open.json"), "--episodes", "12"])
    assert "publish it" in capsys.readouterr().out
    command = ["reveal", "second.sealed.json", "--results", str(home / "results"), "--suite", str(home / "open.json"),
               "--jobs", "1"]  # fmt: skip
    cli.main([*command, "--trust", MEMORISER, HONEST])
    out = capsys.readouterr().out
    assert "## Isolation, per sample" in out
    assert (tmp_path / "second.json").exists()
    assert "2 of 3 submissions were not run" in refused(capsys, *command)
    assert "is no file" in refused(capsys, *command, "--secret", "nowhere.json")
    (home / "results" / "second").rename(tmp_path / "gone")
