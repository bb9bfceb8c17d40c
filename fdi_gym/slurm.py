"""Jobs of Slurm, by submitit, as futures."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple

import submitit
from submitit.core.utils import FailedJobError, UncompletedJobError

from fdi_gym.files import RefusedError

PAUSE = 0.2  # s, between looks at the jobs; submitit asks Slurm itself far less often
MINUTES = 60  # of a job, unless told otherwise
_NUMBERS = {"timeout_min": int, "mem_gb": float, "nodes": int, "cpus_per_task": int, "gpus_per_node": int,
            "tasks_per_node": int}  # fmt: skip


class _Job(NamedTuple):
    job: Any
    future: Future[Any]
    call: tuple[Any, ...]
    tries: int


class Jobs:
    """Calls as jobs of Slurm; one that ends without a result, killed or out of time, is submitted again.

    Args:
        folder: Of their scripts, arguments, results and logs; removed when all has gone well.
        told: Parameters of submitit's AutoExecutor, as text; `executor` is "slurm" or "local".
        tries: How often a call is submitted.

    Raises:
        ValueError: There is no such parameter, or Slurm is not here.
    """

    def __init__(self, folder: Path, told: Mapping[str, str], tries: int):
        told = {"timeout_min": str(MINUTES), "name": "fdi-gym", **told}
        where = told.pop("executor", "slurm")
        if where not in ("slurm", "local"):
            raise ValueError(f"executor is slurm or local, not {where!r}")
        if where == "slurm" and shutil.which("sbatch") is None:
            raise ValueError("there is no Slurm here: no sbatch. '--cluster executor local' tries it without")
        try:
            self._executor = submitit.AutoExecutor(folder, cluster=where)
            self._executor.update_parameters(**{key: _NUMBERS.get(key, str)(value) for key, value in told.items()})
        except (NameError, TypeError, ValueError, AssertionError) as error:
            raise ValueError(f"submitit: {' '.join(str(error).split())[:500]}") from None
        self._folder, self._tries, self._ended, self._failed = folder, tries, False, False
        self._under_way: list[_Job] = []
        self._lock = threading.Lock()
        self._watcher = threading.Thread(target=self._watch, daemon=True)

    def workers(self) -> int:
        """Nobody knows how many jobs Slurm lets run.

        Raises:
            ValueError: Always.
        """
        raise ValueError("say how many jobs may be in Slurm's queue at a time: --jobs 20, for example")

    def __enter__(self) -> Jobs:
        self._watcher.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended = True
        self._watcher.join()
        for entry in self._under_way:
            entry.job.cancel(check=False)
        if error[0] is None and not self._failed:
            shutil.rmtree(self._folder, ignore_errors=True)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """A future of what a call gives."""
        future: Future[Any] = Future()
        self._begin(future, (function, *arguments), 1)
        return future

    def _begin(self, future: Future[Any], call: tuple[Any, ...], tries: int) -> None:
        try:
            job = self._executor.submit(*call)
        except Exception as error:  # whatever sbatch says; raised here, joblib would wait for ever
            self._refuse(future, f"a job cannot be submitted: {' '.join(str(error).split())[-300:]}")
            return
        with self._lock:
            self._under_way.append(_Job(job, future, call, tries))

    def _watch(self) -> None:
        while not self._ended:
            for entry in list(self._under_way):
                if entry.job.done():
                    with self._lock:
                        self._under_way.remove(entry)
                    self._finish(entry)
            time.sleep(PAUSE)

    def _finish(self, entry: _Job) -> None:
        try:
            result = entry.job.result()
        except UncompletedJobError as error:
            lost = not isinstance(error, FailedJobError)  # no error of the call's, which would be its result
            if lost and entry.tries < self._tries:
                self._begin(entry.future, entry.call, entry.tries + 1)
            else:
                self._refuse(entry.future, f"job {entry.job.job_id} failed: {' '.join(str(error).split())[-300:]}")
        except Exception as error:
            self._refuse(entry.future, f"job {entry.job.job_id}: {error}")
        else:
            entry.future.set_result(result)

    def _refuse(self, future: Future[Any], what: str) -> None:
        self._failed = True
        future.set_exception(RefusedError(f"{what} (logs are in {self._folder})"))
