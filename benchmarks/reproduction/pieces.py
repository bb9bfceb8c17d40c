"""Measurements in named pieces, each kept in a file, so that a killed run goes on; and the command around them."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import joblib
import msgspec
import tyro
from tqdm import tqdm

from fdi_gym.clusters import on, results
from fdi_gym.commands.arguments import Backend, Cluster
from fdi_gym.files import RefusedError, read_json, write_whole

Jobs = dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]  # name: function and its arguments


def reference(plant: str) -> dict[str, Any]:
    """The printed figures of a plant's folder, with their sources."""
    return tomllib.loads((Path(__file__).parent / plant / "reference.toml").read_text(encoding="utf-8"))


def finished(folder: Path, names: Jobs) -> dict[str, Any]:
    """The pieces that are there, undamaged, of those that are named."""
    found = {}
    for name in names:
        try:
            found[name] = read_json(_file(folder, name), object, "piece")
        except RefusedError:  # there is none, or it is damaged
            continue
    return found


def pieces(folder: Path, jobs: Jobs, workers: int = -1) -> dict[str, Any]:
    """Run named jobs in parallel, those that are not finished, and read all."""
    folder.mkdir(parents=True, exist_ok=True)
    done = finished(folder, jobs)
    missing = {name: job for name, job in jobs.items() if name not in done}
    if missing:
        tasks = (joblib.delayed(_one)(_file(folder.resolve(), name), *job) for name, job in missing.items())
        for _ in tqdm(results(tasks, len(missing), workers), total=len(missing), unit="piece"):
            pass
        done |= finished(folder, missing)
    return {name: done[name] for name in jobs}


def _file(folder: Path, name: str) -> Path:
    return folder / f"{name.replace('/', '_')}.json"


def _one(file: Path, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    write_whole(file, msgspec.json.encode(function(*arguments)))


@dataclasses.dataclass
class Arguments:
    """What is measured, and where it goes."""

    quick: bool = False
    """A small sample, to see that all works; its figures are not comparable, and its page stays with its pieces."""
    page_only: bool = False
    """Measure nothing: the page of the pieces that are finished."""
    work: Path = Path("runs/reproduction")
    """Folder of the finished pieces."""
    pages: Path = Path("leaderboards/reproduction")
    """Folder of the page and its figures."""
    workers: int = -1
    """Processes, or jobs of a cluster at a time; -1 for one per core."""
    backend: Backend = "loky"
    """Where they run: processes of this machine, or a cluster."""
    cluster: Cluster = dataclasses.field(default_factory=dict)
    """What the cluster is told, as name and value in turn; see docs/pages/clusters.md."""


def command(
    plant: str, plan: Callable[[bool], Jobs], write: Callable[[dict[str, Any], bool, Path], None], partial: bool = False
) -> None:
    """Measure what is missing and write the page: the command line of a plant's folder.

    Args:
        plant: Name of the folder.
        plan: The jobs, for a quick run or a whole one.
        write: Writes the page and its figures from pieces, quick or not, to a path.
        partial: The page can be made of a part of the pieces.
    """
    arguments = tyro.cli(Arguments, description=f"Reference figures of {plant}, measured again.")
    work = arguments.work / plant / ("quick" if arguments.quick else "full")
    jobs = plan(arguments.quick)
    with on(arguments.backend, arguments.cluster, arguments.work):
        found = finished(work, jobs) if arguments.page_only else pieces(work, jobs, arguments.workers)
    if len(found) < len(jobs) and not partial:
        raise SystemExit(f"{len(jobs) - len(found)} of {len(jobs)} pieces are not finished in {work}: leave out --page-only")
    page = (work if arguments.quick else arguments.pages) / f"{plant}.md"
    page.parent.mkdir(parents=True, exist_ok=True)
    write(found, arguments.quick, page)
    print(page)
