"""Evaluations that are killed, or run out of disk, go on from their finished blocks to the same bytes."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from fdi_gym.suite import Suite, freeze

METHODS = ("null", "random", "two_stage_kf")
SCRIPT = """
import sys
from fdi_gym import cli, evaluation
evaluation.evaluate.__kwdefaults__["block"] = 2
cli.main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    found = Suite(name="small", description="a test", env="B747Lateral-Faults-v0", plant="B747Lateral",
                  options={"variant": "printed/open", "labels": "single"}, process="standard", mismatch=None,
                  seeds=[*range(300, 312)], settings={})  # fmt: skip
    return freeze(found, tmp_path_factory.mktemp("suites"))


def start(suite, work, results, **arguments):
    command = [sys.executable, "-c", SCRIPT, "evaluate", suite, "--diagnosers", *METHODS, "--work", work,
               "--results", results, "--jobs", 2]  # fmt: skip
    return subprocess.Popen(
        [str(part) for part in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True, **arguments,
    )  # fmt: skip


def finished(run):
    """The error output of a run that ended well."""
    _, err = run.communicate(timeout=300)
    assert run.returncode == 0, err
    return err


def content(results):
    """What the rows hold; how long they took is in another file."""
    found = {path.name: path.read_bytes() for path in (results / "small").iterdir()}
    assert set(found) == {"made.json", *(f"{m}.{end}" for m in METHODS for end in ("json", "outcomes.gz"))}
    del found["made.json"]
    return found


def wait_for_a_block(run, work):
    while not any(work.rglob("block-*.json")):
        assert run.poll() is None, run.communicate()
        time.sleep(0.01)


def kill(run):
    os.killpg(run.pid, signal.SIGKILL)  # its workers, too
    run.wait()
    run.stdout.close()
    run.stderr.close()


@pytest.fixture(scope="module")
def whole(suite, tmp_path_factory):
    """The rows of a run that nobody interrupts, and how long it takes from its first block on."""
    folder = tmp_path_factory.mktemp("whole")
    run = start(suite, folder / "work", folder / "results")
    wait_for_a_block(run, folder)
    since = time.monotonic()
    finished(run)
    return content(folder / "results"), time.monotonic() - since


def killed_and_resumed(suite, whole, folder, delay):
    run = start(suite, folder / "work", folder / "results")
    wait_for_a_block(run, folder / "work")
    time.sleep(delay)
    kill(run)
    done = {path: path.stat().st_mtime_ns for path in folder.rglob("block-*.json")}
    finished(start(suite, folder / "work", folder / "results"))
    assert content(folder / "results") == whole
    assert {path: path.stat().st_mtime_ns for path in done} == done  # what was finished was not made again
    assert not list(folder.rglob("*.part"))
    return len(done)


def test_a_run_that_is_killed_ends_with_the_same_bytes(suite, whole, tmp_path):
    found, duration = whole
    assert killed_and_resumed(suite, found, tmp_path, duration / 2) >= 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(50))
def test_runs_that_are_killed_at_random_moments_end_with_the_same_bytes(suite, whole, tmp_path, seed):
    found, duration = whole
    killed_and_resumed(suite, found, tmp_path, np.random.default_rng(seed).uniform(0, duration))


def failed_for_want_of_disk(run, words):
    _, err = run.communicate(timeout=300)
    assert run.returncode == 2, err
    line = next(line for line in err.splitlines() if line.startswith("fdi-gym: "))
    assert line.startswith("fdi-gym: cannot write ")
    assert words in line
    assert "Traceback" not in err


def test_a_file_that_cannot_grow_is_an_error_that_leaves_nothing(suite, whole, tmp_path):
    """A quota on the size of files stands for a full disk: the blocks of the methods that say more don't fit."""

    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))

    run = start(suite, tmp_path / "work", tmp_path / "results", preexec_fn=limited)
    failed_for_want_of_disk(run, "File too large")
    assert not list(tmp_path.rglob("*.part"))
    finished(start(suite, tmp_path / "work", tmp_path / "results"))
    assert content(tmp_path / "results") == whole[0]


@pytest.fixture
def small_disk(tmp_path):
    """A file system with room for a few blocks."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = shutil.which("mount")
    if mount is None:
        pytest.skip("there is no mount command")
    done = subprocess.run([mount, "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip(f"a small file system cannot be mounted here: {done.stderr.strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


@pytest.mark.slow
def test_a_full_disk_is_an_error_that_loses_nothing(suite, whole, tmp_path, small_disk):
    failed_for_want_of_disk(start(suite, small_disk, tmp_path / "results"), "No space left on device")
    done = sorted(small_disk.rglob("block-*.json"))
    assert done
    assert not list(small_disk.rglob("*.part"))
    shutil.copytree(small_disk, tmp_path / "larger")
    finished(start(suite, tmp_path / "larger", tmp_path / "results"))
    assert content(tmp_path / "results") == whole[0]
