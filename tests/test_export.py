"""Exports: what is written is what is flown, memory does not grow with it, and what was killed goes on."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from test_cli import refused

from fdi_gym import export
from fdi_gym.files import RefusedError
from fdi_gym.recordings import observations
from fdi_gym.recordings.columns import channel_columns, units_of
from fdi_gym.suite import Suite, freeze, load_suite

pq = pytest.importorskip("pyarrow.parquet")


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    found = Suite(name="small", description="a test", env="dc_motor:DCMotor-Faults-v0", plant="DCMotor", options={},
                  process="standard", mismatch=None, seeds=list(range(1_000_000, 1_000_010)), settings={})  # fmt: skip
    return freeze(found, tmp_path_factory.mktemp("suites"))


@pytest.fixture(scope="module")
def suite(path):
    return load_suite(str(path))


@pytest.fixture
def in_blocks(monkeypatch):
    monkeypatch.setattr(export, "SAMPLES", 1503)  # three flights


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_row_is_a_sample_and_the_columns_are_the_flights(suite, tmp_path, in_blocks):
    plant = suite.build()
    record = suite.record(plant, range(10))
    folder = export.parquet(suite, tmp_path, jobs=1, progress=False)
    assert len(list(folder.glob("*.parquet"))) == 4
    table = pq.read_table(folder)
    assert table.num_rows == int((record.length + 1).sum())
    units = {
        field.name: (field.metadata or {}).get(b"unit", b"").decode()
        for field in pq.read_schema(folder / "part-00000.parquet")
    }
    assert {name: units[name] for name in units_of(plant)} == units_of(plant)
    episode = table["episode"].to_numpy()
    for i in range(10):
        mine = episode == i
        for j, name in enumerate(channel_columns(plant)):
            assert np.array_equal(table[name].to_numpy()[mine], record.obs[i, :, j])
        for j, entry in enumerate(plant.theta):
            assert np.array_equal(table[f"theta: {entry.name}"].to_numpy()[mine], record.theta[i, :, j])
        assert [plant.labels[k].name for k in record.label[i]] == [
            v for v, m in zip(table["label"].to_pylist(), mine, strict=True) if m
        ]
    one = pq.read_table(folder, filters=[("episode", "=", 7)])
    assert np.array_equal(observations(plant, one).obs, record.obs[7])  # and back in


def test_the_description_names_every_column_and_file(suite, tmp_path, in_blocks):
    import hashlib

    folder = export.parquet(suite, tmp_path, jobs=1, progress=False)
    said = json.loads((tmp_path / "small.croissant.json").read_text())
    fields = {field["source"]["extract"]["column"]: field for field in said["recordSet"][0]["field"]}
    assert set(fields) == set(pq.read_schema(folder / "part-00000.parquet").names)
    assert fields["speed"]["description"] == "speed, as observed, in rad/s"
    parts = [one for one in said["distribution"] if one["@type"] == "cr:FileObject"]
    assert {one["contentUrl"]: one["sha256"] for one in parts} == {
        f"small/{path.name}": hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*.parquet")
    }


@pytest.mark.parametrize("format", ["parquet", "minari"])
def test_an_export_that_is_killed_ends_with_the_same_bytes(path, tmp_path, format):
    pytest.importorskip("minari" if format == "minari" else "pyarrow")
    script = (
        "import sys, fdi_gym.export as e, fdi_gym.cli as c, time\n"
        "e.SAMPLES = 1503\n"
        "from fdi_gym.suite import Suite\nfly = Suite.record\n"
        "def slowly(*a):\n    time.sleep(0.5)\n    return fly(*a)\n"
        "Suite.record = slowly\nc.main(sys.argv[1:])"
    )
    command = [sys.executable, "-c", script, "export", str(path), "--format", format, "--jobs", "1", "--output"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    half, whole = tmp_path / "half", tmp_path / "whole"
    run = subprocess.Popen(
        [*command, str(half)], env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
    )
    done = "part-00000.parquet" if format == "parquet" else export.PROGRESS
    while not any(half.rglob(done)):
        assert run.poll() is None, run.communicate()
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGKILL)
    run.communicate()
    finished = {p: p.stat().st_mtime_ns for p in half.rglob("part-*.parquet")}
    assert 0 < len(finished) < (4 if format == "parquet" else 10)
    first = min(finished)
    for place in (half, whole):
        subprocess.run([*command, str(place)], env=environment, check=True, capture_output=True)
    assert first.stat().st_mtime_ns == finished[first]
    for a in whole.rglob("*"):
        if a.is_file() and a.name != export.PROGRESS:
            assert (half / a.relative_to(whole)).read_bytes() == a.read_bytes(), a
    assert not list(half.rglob("*.part"))


def test_a_part_that_is_damaged_or_of_something_else_is_made_again(suite, tmp_path, in_blocks):
    folder = export.parquet(suite, tmp_path, jobs=1, progress=False)
    before = content(folder)
    (folder / "part-00001.parquet").write_bytes(before["part-00001.parquet"][:-30])
    (folder / "part-00002.parquet").write_bytes(before["part-00000.parquet"])
    export.parquet(suite, tmp_path, jobs=1, progress=False)
    assert content(folder) == before
    (folder / "part-00009.parquet").write_bytes(b"")
    with pytest.raises(RefusedError, match="of another export"):
        export.parquet(suite, tmp_path, jobs=1, progress=False)


def test_minari_loads_it_in_a_new_process_and_recovers_the_environment(suite, tmp_path, in_blocks):
    pytest.importorskip("minari")
    export.minari(suite, tmp_path, progress=False)
    script = """
import minari, numpy as np
data = minari.load_dataset("fdi_gym/small-v0")
env = data.recover_environment()
assert data.total_episodes == 10
for episode, meta in zip(data.iterate_episodes([0, 7]), data.storage.get_episode_metadata([0, 7])):
    obs, _ = env.reset(seed=meta["seed"])
    assert np.array_equal(obs, episode.observations[0])
    for k, action in enumerate(episode.actions):
        obs, reward, terminated, truncated, _ = env.step(action)
        assert np.array_equal(obs, episode.observations[k + 1])
        assert (reward, terminated, truncated) == (episode.rewards[k], episode.terminations[k], episode.truncations[k]), k
    assert terminated or truncated
print("same")
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "MINARI_DATASETS_PATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "same", done.stderr


def test_another_export_in_the_same_folder_is_refused(suite, tmp_path, in_blocks):
    pytest.importorskip("minari")
    export.minari(suite, tmp_path, progress=False)
    before = (tmp_path / "fdi_gym" / "small-v0" / "data" / "metadata.json").read_bytes()
    import msgspec

    other = msgspec.structs.replace(suite, description="another").sealed()
    with pytest.raises(RefusedError, match="another export"):
        export.minari(other, tmp_path, progress=False)
    assert (tmp_path / "fdi_gym" / "small-v0" / "data" / "metadata.json").read_bytes() == before


def test_what_cannot_be_exported_is_refused_in_words(capsys, tmp_path):
    for arguments, words in (
        (("b747-standrd",), "did you mean b747-standard"), (("nowhere.json",), "there is no suite"),
        (("b747-paper", "--jobs", "0", "--output", tmp_path), "jobs is 1 or more"),
    ):  # fmt: skip
        assert words in refused(capsys, "export", *arguments)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_flights(tmp_path):
    script = """
import resource, sys, pathlib
import dc_motor
from fdi_gym import export
from fdi_gym.suite import Suite
n = int(sys.argv[1])
suite = Suite(name=f"n{n}", description="", env="dc_motor:DCMotor-Faults-v0", plant="DCMotor", options={},
              process="standard", mismatch=None, seeds=list(range(n)), settings={}).sealed()
export.parquet(suite, pathlib.Path(sys.argv[2]), jobs=1, progress=False)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    used = [
        int(subprocess.run([sys.executable, "-c", script, str(n), str(tmp_path)], env=environment, capture_output=True,
                           text=True, check=True).stdout)
        for n in (1000, 10_000)
    ]  # fmt: skip
    assert used[1] < used[0] + 60_000  # kB
