"""The same bytes wherever they are made: processes here, a Dask scheduler, a Ray cluster, jobs of submitit; lost workers."""

import contextlib
import importlib.util
import os
import signal
import sys
import time
from pathlib import Path

import joblib
import pytest
from joblib.externals.loky import get_reusable_executor
from test_cli import refused

from fdi_gym import clusters, export, row
from fdi_gym.evaluation import evaluate
from fdi_gym.files import RefusedError
from fdi_gym.suite import Suite, freeze, load_suite

# before Ray is imported: all of its nodes are on the loopback, and it tells nobody that it is used
os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_USAGE_STATS_ENABLED": "0"}
METHODS = """
import os, signal
from pathlib import Path
import numpy as np
from fdi_gym.diagnosis import Diagnoser, Diagnosis

def quiet(plant):
    return Diagnoser(lambda n: 0, lambda s, obs: (s, Diagnosis(np.zeros(len(obs), bool), np.zeros(len(obs), int))))

def deadly(plant):
    '''The first worker that runs it is killed in the middle of a flight.'''
    def update(k, obs):
        here = Path(__file__).parent
        if k == 30 and os.getpid() != int((here / "client").read_text()):
            try:
                (here / "killed").touch(exist_ok=False)
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        said = (np.abs(obs[:, 0]) > 3.0) * 1
        return k + 1, Diagnosis(said > 0, said)
    return Diagnoser(lambda n: 0, update)
"""
NAMES = ["null", "far_away:quiet"]
PARTS = {"dask": "distributed", "ray": "ray", "slurm": "submitit"}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A suite and a module with methods, in folders that no worker knows by itself."""
    folder = tmp_path_factory.mktemp("home")
    found = Suite(name="small", description="a test", env="dc_motor:DCMotor-Faults-v0", plant="DCMotor", options={},
                  process="standard", mismatch=None, seeds=list(range(1_000_000, 1_000_004)), settings={})  # fmt: skip
    path = freeze(found, folder)
    (folder / "far_away.py").write_text(METHODS)
    (folder / "client").write_text(str(os.getpid()))
    sys.path.insert(0, str(folder))
    get_reusable_executor().shutdown()  # workers of this machine that are older know no folder of later
    yield load_suite(str(path)), folder
    sys.path.remove(str(folder))


@contextlib.contextmanager
def cluster(backend):
    """A cluster of two workers, or nodes, on the loopback: what `clusters.on` is told of it."""
    pytest.importorskip(PARTS[backend], reason=f"pip install 'fdi-gym[{backend}]'")
    if backend == "dask":
        from distributed import LocalCluster

        with LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
        ) as dask:
            yield {"address": dask.scheduler_address}
    elif backend == "ray":
        from ray.cluster_utils import Cluster

        node = {"num_cpus": 1, "object_store_memory": 80_000_000}
        nodes = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
        try:
            nodes.add_node(**node)
            yield {"address": nodes.address}
        finally:
            nodes.shutdown()
    else:
        yield {"executor": "local"}


def rows_of(suite, names, work, jobs=2):
    """What evaluation gives, as the bytes that are written."""
    found = evaluate(suite, names, work=work, jobs=jobs, progress=False, block=2)
    return {name: (row.pretty(one.row), row.outcomes_text(one.outcomes)) for name, one in found.items()}


@pytest.fixture(scope="module")
def serial(home, tmp_path_factory):
    return rows_of(home[0], NAMES, tmp_path_factory.mktemp("serial"), jobs=1)


@pytest.mark.parametrize("backend", ["dask", "slurm", "ray"])
def test_a_cluster_gives_the_bytes_of_this_machine(home, serial, tmp_path, backend):
    suite, _ = home
    with cluster(backend) as told, clusters.on(backend, told, tmp_path):
        assert rows_of(suite, NAMES, tmp_path / "work") == serial
        if backend == "dask" and importlib.util.find_spec("pyarrow"):
            far = export.parquet(suite, tmp_path / "far", jobs=2, progress=False)
    if backend == "dask" and importlib.util.find_spec("pyarrow"):
        here = export.parquet(suite, tmp_path / "here", jobs=1, progress=False)
        assert {p.name: p.read_bytes() for p in far.iterdir()} == {p.name: p.read_bytes() for p in here.iterdir()}
    assert not (tmp_path / "slurm").exists()  # what submitit leaves is gone


@pytest.mark.parametrize(
    "backend", ["loky", *(pytest.param(name, marks=pytest.mark.slow) for name in ("dask", "ray", "slurm"))]
)
def test_a_worker_that_is_killed_in_the_middle_changes_nothing(home, tmp_path, backend):
    suite, folder = home
    (folder / "killed").touch()
    expected = rows_of(suite, ["far_away:deadly"], tmp_path / "whole")
    (folder / "killed").unlink()
    with contextlib.ExitStack() as stack:
        told = {} if backend == "loky" else stack.enter_context(cluster(backend))
        stack.enter_context(clusters.on(backend, told, tmp_path))
        assert rows_of(suite, ["far_away:deadly"], tmp_path / "work") == expected
    assert (folder / "killed").exists()


# -- calls


def slowly(i, marker=None):
    if marker is not None and i == 3:
        with contextlib.suppress(FileExistsError):
            Path(marker).touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.01 * (i % 3))
    return i * i


def dying(i):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("jobs", [1, 2])
def test_calls_give_their_results_in_order(jobs):
    calls = [joblib.delayed(slowly)(i) for i in range(20)]
    assert clusters.in_order(calls, jobs) == [i * i for i in range(20)]
    assert sorted(clusters.results(iter(calls), 20, jobs)) == [i * i for i in range(20)]
    assert clusters.in_order([], jobs) == []


def test_calls_of_a_lost_worker_are_made_again_and_no_other_is_lost(tmp_path):
    calls = [joblib.delayed(slowly)(i, str(tmp_path / "dead")) for i in range(20)]
    assert clusters.in_order(calls, 2) == [i * i for i in range(20)]
    assert (tmp_path / "dead").exists()


def test_workers_that_are_always_lost_end_it_in_words():
    with pytest.raises(RefusedError, match="workers were lost 3 times"):
        clusters.in_order([joblib.delayed(dying)(i) for i in range(4)], 2)


def test_a_worker_with_other_sources_refuses():
    found = clusters._there([], "another", b"never read")
    with pytest.raises(RefusedError, match=r"the worker on .* has Python .*; here is another"):
        raise found.error


class Here:
    """An executor that runs a call at once, in this process."""

    def submit(self, function, *arguments):
        future = clusters.Future()
        future.set_result(function(*arguments))
        return future


def fails(i):
    if i == 2:
        raise ValueError("the third one")
    return i


@pytest.mark.parametrize("slow", [False, True])
def test_what_a_call_raises_there_is_raised_here(slow):
    with joblib.parallel_config(backend=clusters.Futures(Here(), lambda: 2, slow)):
        assert clusters.in_order([joblib.delayed(slowly)(i) for i in range(30)]) == [i * i for i in range(30)]
        with pytest.raises(ValueError, match="the third one"):
            clusters.in_order([joblib.delayed(fails)(i) for i in range(4)])


@pytest.mark.parametrize(("arguments", "words"), [
    (("--backend", "dsk"), "did you mean dask"), (("--cluster", "address", "x"), "take no settings of a cluster: address"),
    (("--backend", "dask"), "which Dask cluster"),
    (("--backend", "dask", "--cluster", "adress", "x"), "did you mean address"),
    (("--backend", "slurm", "--jobs", "2"), "no sbatch"),
    (("--backend", "slurm", "--cluster", "executor", "local"), "--jobs 20"),
    (("--backend", "slurm", "--cluster", "executor", "moon", "--jobs", "2"), "slurm or local"),
    (("--backend", "slurm", "--cluster", "executor", "local", "colour", "x", "--jobs", "2"), "submitit: Parameter"),
    (("--backend", "slurm", "--cluster", "executor", "local", "timeout_min", "long", "--jobs", "2"), "submitit: invalid"),
])  # fmt: skip
def test_a_cluster_that_cannot_be_is_refused_in_words(home, capsys, tmp_path, monkeypatch, arguments, words):
    pytest.importorskip("distributed")
    pytest.importorskip("submitit")
    monkeypatch.delenv("DASK_SCHEDULER_ADDRESS", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    path = str(home[1] / "small.json")
    assert words in refused(capsys, "evaluate", path, "--diagnosers", "null", *arguments)


@pytest.mark.parametrize(("backend", "library"), [("dask", "distributed"), ("ray", "ray"), ("slurm", "submitit")])
def test_what_is_not_installed_is_named_with_its_extra(monkeypatch, backend, library):
    for name in ("dask", "distributed", "ray", "submitit", "fdi_gym.slurm"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(RefusedError, match=rf"fdi-gym\[{backend}\]"), clusters.on(backend):
        pass
