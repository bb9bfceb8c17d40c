"""Where work that is done side by side is done: by processes of this machine, or on a cluster that exists.

    with on("dask", {"address": "tcp://head:8786"}):
        evaluate(suite, names, work=Path("/shared/runs"))

All parallel work of the package is a list of calls that joblib runs (`results`), and joblib runs them where it is told. For
Dask, Ray and Slurm it is told so by one backend over futures (`Futures`), each made by the cluster's own library, which
brings a lost worker's calls to another one (Dask, Ray) or whose jobs are submitted again (`fdi_gym.slurm`). joblib's own
backend for Dask waits for ever for a call that the scheduler has given up, and Ray's gives no results before the last.

A worker needs the same Python environment and sees the same files. It refuses to work with other sources than those of the
process that asks, so that results are the same bytes wherever they are made.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import platform
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cloudpickle
import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError
from joblib.parallel import ParallelBackendBase, get_active_backend

from fdi_gym.files import RefusedError
from fdi_gym.names import unknown

NAMES = ("loky", "dask", "ray", "slurm")
TRIES = 3  # of calls whose worker was lost
SHARES = 4  # batches for each job of a cluster that takes long to start one

_alone = threading.Lock()  # a worker that has several threads does one call at a time: methods are timed by their process


class Executor(Protocol):
    """What takes calls and gives futures of their results."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """A future (of `concurrent.futures`, or alike) of what a call gives."""
        ...


class _Failed(NamedTuple):
    """What a call raised."""

    error: BaseException


class Futures(ParallelBackendBase):
    """joblib's calls as futures of an executor.

    Args:
        executor: It.
        workers: How many calls it runs at a time.
        slow: It takes long to begin with one: calls are handed over in batches.
    """

    supports_retrieve_callback = True

    def __init__(self, executor: Executor, workers: Callable[[], int], slow: bool = False):
        super().__init__(nesting_level=0)
        self.executor, self.workers, self.slow, self.total = executor, workers, slow, 1

    def effective_n_jobs(self, n_jobs: int) -> int:
        """How many calls are under way: two at least, since joblib would run a single one here."""
        return max(2, self.workers() if n_jobs == -1 else n_jobs)

    def compute_batch_size(self) -> int:
        """Calls that are handed over together."""
        return max(1, self.total // (SHARES * self.parallel._cached_effective_n_jobs)) if self.slow else 1  # type: ignore[union-attr]

    def submit(self, func: Any, callback: Any = None) -> Any:
        """Hand over a batch of calls."""
        future = self.executor.submit(_there, _paths(), stamp(), cloudpickle.dumps(func))
        future.add_done_callback(callback)
        return future

    def retrieve_result_callback(self, out: Future[Any]) -> Any:
        """The results of a batch; what it raised is raised here."""
        found = out.result()
        if isinstance(found, _Failed):
            raise found.error
        return found


@functools.cache
def stamp() -> str:
    """What must be the same wherever results are made: the versions, and a digest of this package's sources."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    libraries = " ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba"))
    return f"Python {platform.python_version()} {libraries} fdi_gym {digest.hexdigest()[:12]}"


def _paths() -> list[str]:
    return [str(Path(place).resolve()) for place in sys.path if Path(place).is_dir()]


def _there(paths: list[str], wanted: str, calls: bytes) -> Any:
    """Run a batch of calls in a worker, with the modules that the process that asks can import."""
    try:
        if stamp() != wanted:
            raise RefusedError(f"the worker on {platform.node()} has {stamp()}; here is {wanted}")
        with _alone:
            sys.path += [place for place in paths if place not in sys.path]
            return cloudpickle.loads(calls)()
    except BaseException as error:
        return _Failed(error)


# ---------------------------------------------------------------------------------------------------------------
# Clusters


@contextlib.contextmanager
def on(backend: str = "loky", cluster: Mapping[str, str] | None = None, folder: Path = Path("runs")) -> Iterator[None]:
    """All parallel work in this block is done there.

    Args:
        backend: "loky" (processes of this machine), "dask", "ray" or "slurm".
        cluster: What the cluster's library is told: for Dask `address` (default: what Dask's own settings say), for Ray
            `address` (default: the running cluster's), for Slurm the parameters of submitit (`slurm_partition`,
            `timeout_min`, ...) and `executor` ("local" to try it without Slurm).
        folder: Where files of jobs go; on Slurm all machines see it.

    Raises:
        ValueError: There is no such backend, or it is not told so.
        RefusedError: Its library is not installed.
        OSError: The cluster cannot be reached.
    """
    if backend not in NAMES:
        raise unknown("backend", backend, NAMES)
    told = dict(cluster or {})
    if backend == "loky" and told:
        raise ValueError(f"processes of this machine take no settings of a cluster: {', '.join(told)}")
    if backend == "loky":
        yield
        return
    for name in () if backend == "slurm" else told:
        if name != "address":
            raise unknown(f"setting of {backend}", name, ["address"])
    with _CLUSTERS[backend](told, folder) as futures, joblib.parallel_config(backend=futures):
        yield


@contextlib.contextmanager
def _dask(told: Mapping[str, str], folder: Path) -> Iterator[Futures]:
    with _needs("dask"):
        import dask
        from distributed import Client
    address = told.get("address") or dask.config.get("scheduler-address", None)  # type: ignore[attr-defined]
    if address is None:
        raise ValueError("which Dask cluster: --cluster address tcp://HOST:8786, or DASK_SCHEDULER_ADDRESS")
    client = Client(address, set_as_default=False, name="fdi-gym")
    try:
        executor = client.get_executor(pure=False)
        yield Futures(executor, lambda: sum(client.ncores().values()))  # type: ignore[arg-type,union-attr]
        executor.shutdown(wait=False)
    finally:
        client.close()


@contextlib.contextmanager
def _ray(told: Mapping[str, str], folder: Path) -> Iterator[Futures]:
    with _needs("ray"):
        import ray

    class Tasks:
        run: Any = staticmethod(ray.remote(max_retries=TRIES)(_there))  # type: ignore[arg-type]

        def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
            return self.run.remote(*arguments).future()

    began = not ray.is_initialized()
    if began:
        ray.init(told.get("address", "auto"), log_to_driver=False, logging_level="ERROR")  # type: ignore[arg-type]
    try:
        yield Futures(Tasks(), lambda: int(ray.cluster_resources().get("CPU", 1)))
    finally:
        if began:
            ray.shutdown()


@contextlib.contextmanager
def _slurm(told: Mapping[str, str], folder: Path) -> Iterator[Futures]:
    with _needs("submitit"):
        from fdi_gym.slurm import Jobs
    with Jobs(folder.resolve() / "slurm", told, TRIES) as jobs:
        yield Futures(jobs, jobs.workers, slow=True)


_CLUSTERS: dict[str, Callable[..., Any]] = {"dask": _dask, "ray": _ray, "slurm": _slurm}


@contextlib.contextmanager
def _needs(library: str) -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        extra = "slurm" if library == "submitit" else library
        raise RefusedError(f"the backend {extra} needs {library}: pip install 'fdi-gym[{extra}]' ({error})") from None


# ---------------------------------------------------------------------------------------------------------------
# Calls


def check_jobs(jobs: int) -> None:
    """Check a number of worker processes.

    Raises:
        ValueError: It is out of range.
    """
    if jobs != -1 and jobs < 1:
        raise ValueError(f"jobs is 1 or more, or -1 for one per core, not {jobs}")


def _numbered(i: int, call: tuple[Any, ...]) -> tuple[int, Any]:
    function, arguments, keywords = call
    return i, function(*arguments, **keywords)


def results(calls: Iterable[Any], total: int, jobs: int = -1) -> Iterator[Any]:
    """What calls give, in the order in which they end, done side by side where joblib is told.

    A worker that is lost, killed for want of memory for example, does not end it: what it had in hand is done again.

    Args:
        calls: `joblib.delayed(function)(...)` each; they are asked for as workers become free.
        total: How many there are, about.
        jobs: Worker processes, or jobs of a cluster at a time; -1 for one per core.

    Raises:
        ValueError: `jobs` is out of range.
        RefusedError: Workers are lost time and again.
    """
    return (result for _, result in _in_turn(calls, total, jobs))


def in_order(calls: Iterable[Any], jobs: int = -1) -> list[Any]:
    """What calls give, in their order; see `results`."""
    calls = list(calls)
    return [result for _, result in sorted(_in_turn(calls, len(calls), jobs), key=lambda pair: pair[0])]


def _in_turn(calls: Iterable[Any], total: int, jobs: int) -> Iterator[tuple[int, Any]]:
    check_jobs(jobs)
    waiting: dict[int, Any] = {}  # what was handed over and has given nothing

    def handed_over() -> Iterator[Any]:
        for i, call in enumerate(calls):
            waiting[i] = call
            yield joblib.delayed(_numbered)(i, call)

    again, fresh = [], handed_over()
    for _ in range(TRIES):
        backend = get_active_backend()[0]
        if isinstance(backend, Futures):
            backend.total = total
        parallel: Any = joblib.Parallel(n_jobs=min(jobs, max(total, 1)), return_as="generator_unordered")
        try:
            for i, result in parallel(itertools.chain(again, fresh)):
                del waiting[i]
                yield i, result
            return
        except TerminatedWorkerError:
            again = [joblib.delayed(_numbered)(i, call) for i, call in waiting.items()]
    raise RefusedError(f"workers were lost {TRIES} times, for want of memory perhaps: fewer jobs need less of it")
